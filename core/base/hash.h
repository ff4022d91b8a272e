// Content addresses: SHA-256 (FIPS 180-4, by OpenSSL).
#pragma once

#include <array>
#include <compare>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <span>
#include <string>
#include <string_view>

#include "core/base/status.h"

namespace farpoint {

// A SHA-256 value. The all-zero digest stands for "none".
struct Digest {
  std::array<uint8_t, 32> bytes{};

  auto operator<=>(const Digest&) const = default;
  bool empty() const { return *this == Digest{}; }
  // 64 lower-case hexadecimal digits.
  std::string Hex() const;
  // kInvalidArgument unless `text` is exactly 64 hexadecimal digits.
  static absl::StatusOr<Digest> FromHex(std::string_view text);
};

// Incremental hashing. Not thread-safe. Finish() may be called once.
class Sha256 {
 public:
  Sha256();
  ~Sha256();
  Sha256(const Sha256&) = delete;
  Sha256& operator=(const Sha256&) = delete;

  Sha256& Update(std::span<const std::byte> data);
  Sha256& Update(std::string_view text);
  // Little-endian, fixed width: the same bytes on every machine.
  Sha256& UpdateU32(uint32_t value);
  Sha256& UpdateU64(uint64_t value);
  Digest Finish();

 private:
  struct Context;
  std::unique_ptr<Context> context_;
};

Digest HashBytes(std::span<const std::byte> data);

struct DigestHasher {
  size_t operator()(const Digest& d) const {
    size_t h = 0;
    for (int i = 0; i < 8; ++i) h = (h << 8) | d.bytes[i];
    return h;
  }
};

}  // namespace farpoint

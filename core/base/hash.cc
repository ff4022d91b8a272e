#include "core/base/hash.h"

#include <openssl/evp.h>

#include "core/base/check.h"

namespace farpoint {

namespace {

int HexValue(char c) {
  if (c >= '0' && c <= '9') return c - '0';
  if (c >= 'a' && c <= 'f') return c - 'a' + 10;
  if (c >= 'A' && c <= 'F') return c - 'A' + 10;
  return -1;
}

}  // namespace

std::string Digest::Hex() const {
  static constexpr char kDigits[] = "0123456789abcdef";
  std::string text;
  text.reserve(64);
  for (uint8_t b : bytes) {
    text.push_back(kDigits[b >> 4]);
    text.push_back(kDigits[b & 15]);
  }
  return text;
}

absl::StatusOr<Digest> Digest::FromHex(std::string_view text) {
  Digest d;
  if (text.size() != 64) {
    return absl::InvalidArgumentError("a content hash has 64 hexadecimal digits, this one has " +
                                      std::to_string(text.size()));
  }
  for (size_t i = 0; i < 32; ++i) {
    const int high = HexValue(text[2 * i]);
    const int low = HexValue(text[2 * i + 1]);
    if (high < 0 || low < 0) {
      return absl::InvalidArgumentError("a content hash holds a character that is no hex digit");
    }
    d.bytes[i] = static_cast<uint8_t>(high * 16 + low);
  }
  return d;
}

struct Sha256::Context {
  EVP_MD_CTX* evp = EVP_MD_CTX_new();
  ~Context() { EVP_MD_CTX_free(evp); }
};

Sha256::Sha256() : context_(std::make_unique<Context>()) {
  FP_CHECK(EVP_DigestInit_ex(context_->evp, EVP_sha256(), nullptr) == 1);
}

Sha256::~Sha256() = default;

Sha256& Sha256::Update(std::span<const std::byte> data) {
  FP_CHECK(EVP_DigestUpdate(context_->evp, data.data(), data.size()) == 1);
  return *this;
}

Sha256& Sha256::Update(std::string_view text) {
  return Update(std::as_bytes(std::span(text.data(), text.size())));
}

Sha256& Sha256::UpdateU32(uint32_t value) {
  std::array<std::byte, 4> le;
  for (int i = 0; i < 4; ++i) le[i] = static_cast<std::byte>(value >> (8 * i));
  return Update(le);
}

Sha256& Sha256::UpdateU64(uint64_t value) {
  return UpdateU32(static_cast<uint32_t>(value)).UpdateU32(static_cast<uint32_t>(value >> 32));
}

Digest Sha256::Finish() {
  Digest d;
  unsigned size = 0;
  FP_CHECK(EVP_DigestFinal_ex(context_->evp, d.bytes.data(), &size) == 1);
  FP_CHECK(size == d.bytes.size());
  return d;
}

Digest HashBytes(std::span<const std::byte> data) { return Sha256().Update(data).Finish(); }

}  // namespace farpoint

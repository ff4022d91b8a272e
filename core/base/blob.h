// Immutable bytes with shared ownership, in memory or mapped from a file. Copying a Blob copies a
// pointer. Thread-safe: nothing can be changed.
#pragma once

#include <cstddef>
#include <memory>
#include <span>
#include <string>
#include <string_view>
#include <vector>

#include "core/base/aligned.h"
#include "core/base/bulk_vector.h"
#include "core/base/hash.h"
#include "core/base/status.h"

namespace farpoint {

class Blob {
 public:
  // Empty.
  Blob() = default;

  static Blob FromAligned(AlignedVector<std::byte> bytes);  // no copy
  static Blob FromBulk(BulkVector<std::byte> bytes);        // no copy
  static Blob FromVector(const std::vector<std::byte>& bytes) {
    return FromAligned(AlignedVector<std::byte>(bytes.begin(), bytes.end()));
  }
  static Blob FromString(std::string_view bytes);
  // Maps the file read-only. kNotFound, kPermissionDenied or kUnavailable, naming the path.
  // Who truncates a mapped file kills its readers: cache files are replaced by rename only.
  static absl::StatusOr<Blob> MapFile(const std::string& path);

  std::span<const std::byte> bytes() const { return bytes_; }
  size_t size() const { return bytes_.size(); }
  Digest Hash() const { return HashBytes(bytes_); }

 private:
  std::shared_ptr<const void> owner_;
  std::span<const std::byte> bytes_;  // at a multiple of kBlobAlignment
};

// Writes `path`.part, flushes it to the disk and renames it, so that `path` is whole or absent.
absl::Status WriteFileAtomically(const std::string& path, std::span<const std::byte> bytes);

// Reads a whole file; kNotFound or kUnavailable name the path, kResourceExhausted if it is larger
// than `max_bytes`.
absl::StatusOr<Blob> ReadFile(const std::string& path, size_t max_bytes = size_t{1} << 36);

}  // namespace farpoint

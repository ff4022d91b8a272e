// Little-endian binary records with checked sizes. What our own byte formats are made of; their
// layout is described in docs/protocol.md.
#pragma once

#include <bit>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <span>
#include <string>
#include <string_view>
#include <type_traits>
#include <vector>

#include "core/base/aligned.h"
#include "core/base/blob.h"
#include "core/base/status.h"

namespace farpoint {

static_assert(std::endian::native == std::endian::little, "byte formats are little-endian");

// Appends to a growing buffer. Arrays start at multiples of kBlobAlignment, so that a mapped blob
// can be viewed in place.
class ByteWriter {
 public:
  template <typename T>
  requires std::is_trivially_copyable_v<T>
  void Put(const T& value) {
    const size_t at = bytes_.size();
    bytes_.resize(at + sizeof(T));
    std::memcpy(bytes_.data() + at, &value, sizeof(T));
  }
  void PutString(std::string_view text) {
    Put<uint32_t>(static_cast<uint32_t>(text.size()));
    const size_t at = bytes_.size();
    bytes_.resize(at + text.size());
    if (!text.empty()) std::memcpy(bytes_.data() + at, text.data(), text.size());
  }
  // u64 count, zero bytes up to a multiple of kBlobAlignment, then the elements.
  template <typename T>
  requires std::is_trivially_copyable_v<T>
  void PutArray(std::span<const T> values) {
    Put<uint64_t>(values.size());
    bytes_.resize((bytes_.size() + kBlobAlignment - 1) / kBlobAlignment * kBlobAlignment);
    const size_t at = bytes_.size();
    bytes_.resize(at + values.size_bytes());
    if (!values.empty()) std::memcpy(bytes_.data() + at, values.data(), values.size_bytes());
  }
  size_t size() const { return bytes_.size(); }
  // A copy, for small records.
  std::vector<std::byte> Take() const { return {bytes_.begin(), bytes_.end()}; }
  // Moves the bytes out without a copy.
  Blob TakeBlob() { return Blob::FromAligned(std::move(bytes_)); }

 private:
  AlignedVector<std::byte> bytes_;
};

// Reads what ByteWriter wrote. Every read is checked against what is left: kDataLoss names the
// field and its offset. Nothing is allocated from a size that was not checked.
class ByteReader {
 public:
  explicit ByteReader(std::span<const std::byte> bytes) : bytes_(bytes) {}

  template <typename T>
  requires std::is_trivially_copyable_v<T> absl::Status Get(T& value, std::string_view field) {
    if (bytes_.size() - at_ < sizeof(T)) return Short(field);
    std::memcpy(&value, bytes_.data() + at_, sizeof(T));
    at_ += sizeof(T);
    return absl::OkStatus();
  }
  absl::Status GetString(std::string& text, std::string_view field, size_t max_size = 1 << 16) {
    uint32_t size = 0;
    FP_RETURN_IF_ERROR(Get(size, field));
    if (size > max_size || size > bytes_.size() - at_) return Short(field);
    text.assign(reinterpret_cast<const char*>(bytes_.data()) + at_, size);
    at_ += size;
    return absl::OkStatus();
  }
  // The view points into the blob. The bytes must start at a multiple of
  // kBlobAlignment (a Blob does); kDataLoss otherwise if T asks for more than 16.
  template <typename T>
  requires std::is_trivially_copyable_v<T> absl::Status GetArray(std::span<const T>& values,
                                                                 std::string_view field) {
    uint64_t count = 0;
    FP_RETURN_IF_ERROR(Get(count, field));
    const size_t aligned = (at_ + kBlobAlignment - 1) / kBlobAlignment * kBlobAlignment;
    if (aligned > bytes_.size() || count > (bytes_.size() - aligned) / sizeof(T)) {
      return Short(field);
    }
    if (reinterpret_cast<uintptr_t>(bytes_.data()) % alignof(T) != 0) {
      return absl::DataLossError("field '" + std::string(field) + "' is not aligned in memory");
    }
    values = {reinterpret_cast<const T*>(bytes_.data() + aligned), static_cast<size_t>(count)};
    at_ = aligned + static_cast<size_t>(count) * sizeof(T);
    return absl::OkStatus();
  }
  size_t remaining() const { return bytes_.size() - at_; }
  absl::Status ExpectEnd() const {
    if (at_ == bytes_.size()) return absl::OkStatus();
    return absl::DataLossError(std::to_string(bytes_.size() - at_) +
                               " bytes follow the end of the record");
  }

 private:
  absl::Status Short(std::string_view field) const {
    return absl::DataLossError("field '" + std::string(field) + "' at byte " + std::to_string(at_) +
                               " does not fit into the " + std::to_string(bytes_.size()) +
                               " bytes of the record");
  }
  std::span<const std::byte> bytes_;
  size_t at_ = 0;
};

}  // namespace farpoint

#include "core/image/npy_io.h"

#include <cstring>
#include <optional>
#include <span>
#include <string_view>

#include "core/base/blob.h"

namespace farpoint {

namespace {

constexpr int64_t kMaxSide = 65536;
constexpr size_t kMaxHeader = 65536;

// What the header's dictionary says; empty where a key is missing.
struct NpyHeader {
  std::optional<std::string> descr;
  std::optional<bool> fortran_order;
  std::optional<std::vector<int64_t>> shape;
};

// Parses the subset of Python literals that NumPy writes: a dictionary of one string, one truth
// value and one tuple of integers.
class HeaderParser {
 public:
  explicit HeaderParser(std::string_view text) : text_(text) {}

  // False if the text is anything else; at() tells where.
  bool Parse(NpyHeader& header) {
    if (!Take('{')) return false;
    while (!Take('}')) {
      std::string key;
      if (!String(key) || !Take(':')) return false;
      if (key == "descr" && !header.descr) {
        if (!String(header.descr.emplace())) return false;
      } else if (key == "fortran_order" && !header.fortran_order) {
        if (!Truth(header.fortran_order.emplace())) return false;
      } else if (key == "shape" && !header.shape) {
        if (!Tuple(header.shape.emplace())) return false;
      } else {
        return false;
      }
      if (!Take(',')) {
        if (!Take('}')) return false;
        break;
      }
    }
    SkipSpace();
    return at_ == text_.size();
  }
  size_t at() const { return at_; }

 private:
  void SkipSpace() {
    while (at_ < text_.size() && (text_[at_] == ' ' || text_[at_] == '\n')) ++at_;
  }
  bool Take(char c) {
    SkipSpace();
    if (at_ >= text_.size() || text_[at_] != c) return false;
    ++at_;
    return true;
  }
  bool String(std::string& value) {
    SkipSpace();
    if (at_ >= text_.size() || (text_[at_] != '\'' && text_[at_] != '"')) return false;
    const size_t end = text_.find(text_[at_], at_ + 1);
    if (end == std::string_view::npos) return false;
    value = text_.substr(at_ + 1, end - at_ - 1);
    at_ = end + 1;
    return true;
  }
  bool Truth(bool& value) {
    SkipSpace();
    for (const std::string_view word : {"True", "False"}) {
      if (text_.substr(at_, word.size()) == word) {
        value = word == "True";
        at_ += word.size();
        return true;
      }
    }
    return false;
  }
  bool Tuple(std::vector<int64_t>& values) {
    if (!Take('(')) return false;
    while (!Take(')')) {
      SkipSpace();
      int64_t value = 0;
      size_t digits = 0;
      for (; at_ < text_.size() && text_[at_] >= '0' && text_[at_] <= '9'; ++at_) {
        if (++digits > 15) return false;
        value = value * 10 + (text_[at_] - '0');
      }
      if (digits == 0 || values.size() == 8) return false;
      values.push_back(value);
      if (!Take(',')) return Take(')');
    }
    return true;
  }

  std::string_view text_;
  size_t at_ = 0;
};

template <typename T>
void Widen(std::span<const std::byte> bytes, std::vector<double>& values) {
  for (size_t i = 0; i < values.size(); ++i) {
    T v;
    std::memcpy(&v, bytes.data() + i * sizeof(T), sizeof(T));
    values[i] = static_cast<double>(v);
  }
}

}  // namespace

absl::StatusOr<NpyArray2d> ReadNpy2d(const std::string& path) {
  FP_ASSIGN_OR_RETURN(const Blob blob, Blob::MapFile(path));
  const std::span<const std::byte> bytes = blob.bytes();
  const std::string name = "'" + path + "'";
  if (bytes.size() < 10 || std::memcmp(bytes.data(), "\x93NUMPY", 6) != 0) {
    return absl::InvalidArgumentError(name + " is not a .npy file");
  }
  const int version = std::to_integer<int>(bytes[6]);
  if (version < 1 || version > 3) {
    return absl::InvalidArgumentError(name + ": .npy format version " + std::to_string(version) +
                                      " is not known, only 1 to 3");
  }
  const size_t prefix = version == 1 ? 10 : 12;
  size_t header_size = 0;
  for (size_t i = prefix; i-- > 8;) {
    if (i < bytes.size()) header_size = header_size << 8 | std::to_integer<size_t>(bytes[i]);
  }
  if (bytes.size() < prefix || header_size > bytes.size() - prefix || header_size > kMaxHeader) {
    return absl::DataLossError(name + ": the header does not fit into the file of " +
                               std::to_string(bytes.size()) + " bytes");
  }
  NpyHeader header;
  HeaderParser parser({reinterpret_cast<const char*>(bytes.data()) + prefix, header_size});
  if (!parser.Parse(header) || !header.descr || !header.fortran_order || !header.shape) {
    return absl::DataLossError(name +
                               ": the header is no dictionary of descr, fortran_order and "
                               "shape (byte " +
                               std::to_string(prefix + parser.at()) + ")");
  }
  if (*header.fortran_order) {
    return absl::InvalidArgumentError(name +
                                      " is in Fortran order; save numpy.ascontiguousarray()");
  }
  if (header.shape->size() != 2 || (*header.shape)[0] < 1 || (*header.shape)[1] < 1 ||
      (*header.shape)[0] > kMaxSide || (*header.shape)[1] > kMaxSide) {
    return absl::InvalidArgumentError(name +
                                      ": the array must have the two dimensions height and "
                                      "width, from 1 to " +
                                      std::to_string(kMaxSide));
  }
  const std::string& type = *header.descr;
  size_t item = 0;
  if (type == "|b1" || type == "|u1") item = 1;
  if (type == "<f4") item = 4;
  if (type == "<f8") item = 8;
  if (item == 0) {
    return absl::InvalidArgumentError(name + ": dtype '" + type.substr(0, 32) +
                                      "' is not read; save it as bool, uint8, float32 or float64");
  }
  NpyArray2d array;
  array.rows = static_cast<int>((*header.shape)[0]);
  array.cols = static_cast<int>((*header.shape)[1]);
  const size_t count = static_cast<size_t>(array.rows) * static_cast<size_t>(array.cols);
  const std::span<const std::byte> payload = bytes.subspan(prefix + header_size);
  if (payload.size() != count * item) {
    return absl::DataLossError(name + " holds " + std::to_string(payload.size()) +
                               " bytes of values instead of " + std::to_string(count * item));
  }
  array.values.resize(count);
  if (item == 1) Widen<uint8_t>(payload, array.values);
  if (item == 4) Widen<float>(payload, array.values);
  if (item == 8) Widen<double>(payload, array.values);
  return array;
}

}  // namespace farpoint

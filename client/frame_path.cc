#include "client/frame_path.h"

#include <algorithm>
#include <cstdio>

namespace farpoint {
namespace {

constexpr size_t kMaxDigits = 16;

// The length of the place at the start of `text`, 0 if none is there.
size_t PlaceAt(std::string_view text, size_t& digits) {
  if (text[0] == '#') {
    const size_t end = text.find_first_not_of('#');
    digits = end == std::string_view::npos ? text.size() : end;
    return digits;
  }
  if (text[0] != '%') return 0;
  size_t at = 1;
  digits = 0;
  if (at < text.size() && text[at] == '0') {
    ++at;
    while (at < text.size() && text[at] >= '0' && text[at] <= '9') {
      digits = std::min<size_t>(digits * 10 + static_cast<size_t>(text[at] - '0'), kMaxDigits + 1);
      ++at;
    }
    if (digits == 0) return 0;
  }
  return at < text.size() && text[at] == 'd' ? at + 1 : 0;
}

}  // namespace

absl::StatusOr<FramePath> FramePath::Parse(std::string_view path) {
  FramePath result;
  const size_t slash = path.rfind('/');
  size_t start = slash == std::string_view::npos ? 0 : slash + 1;
  result.before_ = path.substr(0, start);
  std::string* target = &result.before_;
  while (start < path.size()) {
    size_t digits = 0;
    const size_t length = PlaceAt(path.substr(start), digits);
    if (length == 0) {
      target->push_back(path[start++]);
      continue;
    }
    if (result.has_place_) {
      return absl::InvalidArgumentError(
          "has two places for the frame's number; leave one, e.g. out.####.exr");
    }
    if (digits > kMaxDigits) {
      return absl::InvalidArgumentError("the frame's number may have at most " +
                                        std::to_string(kMaxDigits) + " digits");
    }
    result.has_place_ = true;
    result.digits_ = static_cast<int>(digits);
    target = &result.after_;
    start += length;
  }
  return result;
}

std::string FramePath::For(int32_t frame) const {
  if (!has_place_) return before_;
  char number[32];
  std::snprintf(number, sizeof(number), "%0*d", digits_, frame);
  return before_ + number + after_;
}

}  // namespace farpoint

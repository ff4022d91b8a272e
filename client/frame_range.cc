#include "client/frame_range.h"

#include <charconv>
#include <cstdlib>
#include <unordered_set>

namespace farpoint {
namespace {

std::string_view Trim(std::string_view text) {
  while (!text.empty() && text.front() == ' ') text.remove_prefix(1);
  while (!text.empty() && text.back() == ' ') text.remove_suffix(1);
  return text;
}

// Takes a number from the front of `text`.
bool TakeNumber(std::string_view& text, int32_t& number) {
  const auto result = std::from_chars(text.data(), text.data() + text.size(), number);
  if (result.ec != std::errc()) return false;
  text.remove_prefix(static_cast<size_t>(result.ptr - text.data()));
  return true;
}

bool TakeSign(std::string_view& text, char sign) {
  if (text.empty() || text[0] != sign) return false;
  text.remove_prefix(1);
  return true;
}

absl::Status TooMany() {
  return absl::InvalidArgumentError("names more than " + std::to_string(kMaxFrames) +
                                    " frames; split them over several jobs");
}

}  // namespace

absl::StatusOr<std::vector<int32_t>> ParseFrameRange(std::string_view text) {
  std::vector<int32_t> frames;
  std::unordered_set<int32_t> seen;
  while (true) {
    const size_t comma = text.find(',');
    const std::string_view part = Trim(text.substr(0, comma));
    std::string_view rest = part;
    int32_t first = 0, last = 0, step = 1;
    bool good = TakeNumber(rest, first);
    last = first;
    if (good && TakeSign(rest, '-')) {
      good = TakeNumber(rest, last);
      if (good && TakeSign(rest, 'x')) good = TakeNumber(rest, step) && step >= 1;
    }
    if (!good || !rest.empty()) {
      return absl::InvalidArgumentError("'" + std::string(part.substr(0, 64)) +
                                        "' is not a range of frames; expected a, a-b or a-bxN with "
                                        "commas, e.g. 1-10x2,15");
    }
    // In 64 bits: the ends may be 2^31 - 1 apart, and the step may lead beyond either.
    const int64_t count = std::abs(int64_t{last} - first) / step + 1;
    if (count > static_cast<int64_t>(kMaxFrames)) return TooMany();
    const int64_t stride = last < first ? -int64_t{step} : step;
    for (int64_t i = 0; i < count; ++i) {
      const auto frame = static_cast<int32_t>(first + i * stride);
      if (seen.insert(frame).second) frames.push_back(frame);
    }
    if (frames.size() > kMaxFrames) return TooMany();
    if (comma == std::string_view::npos) return frames;
    text.remove_prefix(comma + 1);
  }
}

std::string FrameRangeText(std::span<const int32_t> frames) {
  std::string text;
  for (size_t i = 0; i < frames.size();) {
    // The longest run of one stride; two frames are no run unless they are neighbours.
    size_t end = i + 1;
    int64_t stride = 0;
    if (end < frames.size()) {
      stride = int64_t{frames[end]} - frames[i];
      while (end < frames.size() && int64_t{frames[end]} - frames[end - 1] == stride) ++end;
    }
    const size_t count = end - i;
    const int64_t step = std::abs(stride);
    if (!text.empty()) text += ",";
    text += std::to_string(frames[i]);
    if (step == 0 || (count == 2 && step != 1)) {
      ++i;
      continue;
    }
    text += "-" + std::to_string(frames[end - 1]);
    if (step != 1) text += "x" + std::to_string(step);
    i = end;
  }
  return text;
}

}  // namespace farpoint

// File names with a place for the frame's number: "out.####.exr", "out.%04d.exr".
#pragma once

#include <cstdint>
#include <string>
#include <string_view>

#include "core/base/status.h"

namespace farpoint {

// A run of '#' stands for the number with at least as many digits; %d and %0Nd are printf's. Only
// the last component of the path is looked at. A larger number takes more digits, so different
// frames have different names.
class FramePath {
 public:
  // kInvalidArgument for a name with more than one place, or one for more than 16 digits.
  static absl::StatusOr<FramePath> Parse(std::string_view path);

  bool has_place() const { return has_place_; }
  // The name as it was given if there is no place.
  std::string For(int32_t frame) const;

 private:
  std::string before_, after_;
  int digits_ = 0;
  bool has_place_ = false;
};

}  // namespace farpoint

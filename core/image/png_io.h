// 8-bit PNG files. The only include of libpng is in png_io.cc.
#pragma once

#include <cstddef>
#include <cstdint>
#include <span>
#include <string>
#include <vector>

#include "core/base/status.h"

namespace farpoint {

// The bytes of a file. `rgb`: height x width x 3, sRGB, rows top down. kInvalidArgument if its size
// does not match.
absl::StatusOr<std::vector<std::byte>> EncodePng(int width, int height,
                                                 std::span<const uint8_t> rgb);

// The same, written to `path`.part, flushed, renamed. Errors name the path.
absl::Status WritePng(const std::string& path, int width, int height, std::span<const uint8_t> rgb);

}  // namespace farpoint

// 8-bit PNG files. The only include of libpng is in png_io.cc.
#pragma once

#include <cstdint>
#include <span>
#include <string>

#include "core/base/status.h"

namespace farpoint {

// `rgb`: height x width x 3, sRGB, rows top down. Written to `path`.part, flushed, renamed.
// kInvalidArgument if the size of `rgb` does not match; kUnavailable and others name the path.
absl::Status WritePng(const std::string& path, int width, int height, std::span<const uint8_t> rgb);

}  // namespace farpoint

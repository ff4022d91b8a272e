// Radiance pictures (.hdr, RGBE) to floats.
#pragma once

#include <cstddef>
#include <cstdint>
#include <span>
#include <string>
#include <vector>

#include "core/base/status.h"
#include "core/math/vec.h"

namespace farpoint {

struct HdrImage {
  uint32_t width = 0, height = 0;
  std::vector<Rgb> pixels;  // rows from the top
};

// kInvalidArgument names the picture and says why it cannot be read, or that it has more than
// `max_pixels`, which is checked before anything is allocated. Thread-safe.
absl::StatusOr<HdrImage> DecodeHdr(const std::string& name, std::span<const std::byte> bytes,
                                   int64_t max_pixels);

}  // namespace farpoint

// What a layer stores for a value. Private to core/image: film, file and hash must agree on it.
#pragma once

#include <bit>
#include <cmath>
#include <cstdint>

#include "core/math/half.h"

namespace farpoint {

// Round to nearest even; finite values beyond the range become the largest half; -0 becomes +0.
// Infinities stay, so that a broken kernel is not hidden behind the largest half, and every NaN
// becomes the one quiet NaN.
inline uint16_t StoredHalf(float f) {
  if (std::isnan(f)) return 0x7e00;
  if (std::isinf(f)) return f > 0 ? 0x7c00 : 0xfc00;
  const uint16_t h = FloatToHalf(f);
  return h == 0x8000 ? uint16_t{0} : h;
}

// The same for layers stored in binary32.
inline float StoredFloat(float f) {
  if (std::isnan(f)) return std::bit_cast<float>(0x7fc00000u);
  return f == 0.0f ? 0.0f : f;
}

}  // namespace farpoint

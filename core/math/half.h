// IEEE 754 binary16, round to nearest even, by the F16C instructions (part of x86-64-v3). Finite
// values beyond the range become the largest half (65504) instead of infinity.
#pragma once

#include <immintrin.h>

#include <cstdint>

namespace farpoint {

inline constexpr float kMaxHalf = 65504.0f;

inline uint16_t FloatToHalf(float f) {
  f = f > kMaxHalf ? kMaxHalf : (f < -kMaxHalf ? -kMaxHalf : f);
  return static_cast<uint16_t>(_cvtss_sh(f, _MM_FROUND_TO_NEAREST_INT));
}
inline float HalfToFloat(uint16_t h) { return _cvtsh_ss(h); }

}  // namespace farpoint

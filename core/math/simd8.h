// Eight floats side by side, on AVX2, part of the instruction set that every build requires.
// Operators are lane-wise IEEE operations in the written order: nothing is fused.
#pragma once

#include <immintrin.h>

#include <cstdint>

namespace farpoint {

using F8 = float __attribute__((vector_size(32)));
using M8 = int32_t __attribute__((vector_size(32)));  // lane mask: 0 or -1
using U8 = uint32_t __attribute__((vector_size(32)));

inline F8 Load8(const float* p) { return reinterpret_cast<F8>(_mm256_load_ps(p)); }  // 32-aligned
inline void Store8(float* p, F8 v) { _mm256_store_ps(p, reinterpret_cast<__m256>(v)); }
inline F8 Set8(float s) { return reinterpret_cast<F8>(_mm256_set1_ps(s)); }
inline F8 Sqrt8(F8 v) { return reinterpret_cast<F8>(_mm256_sqrt_ps(reinterpret_cast<__m256>(v))); }
inline F8 Abs8(F8 v) {
  return reinterpret_cast<F8>(_mm256_andnot_ps(_mm256_set1_ps(-0.0f), reinterpret_cast<__m256>(v)));
}
// b where a is NaN
inline F8 Max8(F8 a, F8 b) {
  return reinterpret_cast<F8>(
      _mm256_max_ps(reinterpret_cast<__m256>(a), reinterpret_cast<__m256>(b)));
}
inline F8 Min8(F8 a, F8 b) {
  return reinterpret_cast<F8>(
      _mm256_min_ps(reinterpret_cast<__m256>(a), reinterpret_cast<__m256>(b)));
}
// To the nearest whole number, halves to the even one.
inline F8 Round8(F8 v) {
  return reinterpret_cast<F8>(
      _mm256_round_ps(reinterpret_cast<__m256>(v), _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC));
}
inline F8 Select8(M8 mask, F8 yes, F8 no) {
  return reinterpret_cast<F8>(_mm256_blendv_ps(
      reinterpret_cast<__m256>(no), reinterpret_cast<__m256>(yes), reinterpret_cast<__m256>(mask)));
}
// Bit k is lane k's mask.
inline unsigned Bits8(M8 mask) {
  return static_cast<unsigned>(_mm256_movemask_ps(reinterpret_cast<__m256>(mask)));
}
// The lanes whose bits are set: the inverse of Bits8.
inline M8 Mask8(unsigned bits) {
  const M8 bit = {1, 2, 4, 8, 16, 32, 64, 128};
  const auto all = static_cast<int32_t>(bits);
  return (M8{all, all, all, all, all, all, all, all} & bit) != 0;
}
// ((l0 + l4) + (l2 + l6)) + ((l1 + l5) + (l3 + l7)): one order for all.
inline float Sum8(F8 v) {
  return ((v[0] + v[4]) + (v[2] + v[6])) + ((v[1] + v[5]) + (v[3] + v[7]));
}

}  // namespace farpoint

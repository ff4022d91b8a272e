// Four doubles side by side, for what eight floats cannot hold: see simd8.h.
#pragma once

#include <immintrin.h>

#include <cstdint>

#include "core/math/simd8.h"

namespace farpoint {

using D4 = double __attribute__((vector_size(32)));
using M4 = int64_t __attribute__((vector_size(32)));  // lane mask: 0 or -1

inline D4 Set4(double s) { return reinterpret_cast<D4>(_mm256_set1_pd(s)); }
inline D4 Sqrt4(D4 v) { return reinterpret_cast<D4>(_mm256_sqrt_pd(reinterpret_cast<__m256d>(v))); }
inline D4 Abs4(D4 v) {
  return reinterpret_cast<D4>(_mm256_andnot_pd(_mm256_set1_pd(-0.0), reinterpret_cast<__m256d>(v)));
}
// b where a is NaN
inline D4 Max4(D4 a, D4 b) {
  return reinterpret_cast<D4>(
      _mm256_max_pd(reinterpret_cast<__m256d>(a), reinterpret_cast<__m256d>(b)));
}
inline D4 Min4(D4 a, D4 b) {
  return reinterpret_cast<D4>(
      _mm256_min_pd(reinterpret_cast<__m256d>(a), reinterpret_cast<__m256d>(b)));
}
// Toward zero.
inline D4 Truncate4(D4 v) {
  return reinterpret_cast<D4>(
      _mm256_round_pd(reinterpret_cast<__m256d>(v), _MM_FROUND_TO_ZERO | _MM_FROUND_NO_EXC));
}
inline D4 Select4(M4 mask, D4 yes, D4 no) {
  return reinterpret_cast<D4>(_mm256_blendv_pd(reinterpret_cast<__m256d>(no),
                                               reinterpret_cast<__m256d>(yes),
                                               reinterpret_cast<__m256d>(mask)));
}
inline unsigned Bits4(M4 mask) {
  return static_cast<unsigned>(_mm256_movemask_pd(reinterpret_cast<__m256d>(mask)));
}
// Lanes 0 to 3 (half 0) or 4 to 7 (half 1).
inline D4 Half4(F8 v, int half) {
  const auto all = reinterpret_cast<__m256>(v);
  return reinterpret_cast<D4>(
      _mm256_cvtps_pd(half == 0 ? _mm256_castps256_ps128(all) : _mm256_extractf128_ps(all, 1)));
}
inline D4 Half4(const U8& v, int half) {
  const auto all = reinterpret_cast<__m256i>(v);
  const __m256i wide = _mm256_cvtepu32_epi64(half == 0 ? _mm256_castsi256_si128(all)
                                                       : _mm256_extracti128_si256(all, 1));
  // The low digits of 2^52 + v.
  const __m256i large = _mm256_set1_epi64x(0x4330000000000000);
  return reinterpret_cast<D4>(
      _mm256_sub_pd(_mm256_castsi256_pd(_mm256_or_si256(wide, large)), _mm256_set1_pd(0x1p52)));
}
// Both halves, rounded.
inline F8 Join8(D4 lower, D4 upper) {
  return reinterpret_cast<F8>(_mm256_set_m128(_mm256_cvtpd_ps(reinterpret_cast<__m256d>(upper)),
                                              _mm256_cvtpd_ps(reinterpret_cast<__m256d>(lower))));
}

}  // namespace farpoint

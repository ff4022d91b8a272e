#include "core/pbgi/closed_pixels.h"

#include <immintrin.h>

#include <algorithm>
#include <bit>
#include <cmath>
#include <cstring>

#include "core/base/check.h"

namespace farpoint {

namespace {

constexpr int kBytes = 32;  // of a vector

__m256i LoadBytes(const uint8_t* p) {
  return _mm256_loadu_si256(reinterpret_cast<const __m256i*>(p));
}
void StoreBytes(uint8_t* p, __m256i v) { _mm256_storeu_si256(reinterpret_cast<__m256i*>(p), v); }

}  // namespace

ClosedPixels::ClosedPixels(const MicrobufferMap& map)
    : map_(map), side_(static_cast<int>(map.side())) {
  FP_CHECK(map.kind() == BufferMap::kOctahedral && side_ >= kLargest);
  // Half a pixel's diagonal in the octahedron's square [-1, 1]², times 3: a step there is at most
  // sqrt(3) as long on the octahedron, which nowhere lies nearer to the origin than 1 / sqrt(3).
  pixel_radius_ = 3.0f * 1.4143f / static_cast<float>(side_);
  least_pixel_sr_ =
      *std::min_element(map.solid_angle(), map.solid_angle() + static_cast<size_t>(map.pixels()));
  const int padded = side_ + 2 * kLargest;
  stride_ = (padded + kBytes - 1) / kBytes * kBytes;
  // A row and a vector more, for loads beyond the last.
  const auto bytes = static_cast<size_t>((padded + 1) * stride_ + kBytes);
  closed_.assign(map.padded() + kBytes, 0);
  squares_.assign(bytes, 0);
  mask_.assign(bytes, 0);
  next_.assign(bytes, 0);
  const int n = side_;
  for (int row = -kLargest; row < n + kLargest; ++row) {
    for (int column = -kLargest; column < n + kLargest; ++column) {
      if (column >= 0 && column < n && row >= 0 && row < n) continue;
      border_.push_back(static_cast<uint32_t>((row + kLargest) * stride_ + column + kLargest));
      source_.push_back(static_cast<uint32_t>(map.Wrap(column, row)));
    }
  }
}

void ClosedPixels::Find(const Microbuffer& buffer, const CutView& view, Splat splat,
                        float distance_m, float leaf_radius_m) {
  FP_DCHECK(&buffer.map() == &map_);
  // Below every horizon: further than 90° from every receiver's normal, all of the pixel.
  const float lowest = view.sin_spread + pixel_radius_;
  const F8 below = Set8(lowest < 1.0f ? -lowest : -2.0f);
  const V8 normal(view.normal);
  const F8 one = Set8(1.0f), distance = Set8(distance_m);
  const F8 opaque_before = Set8(distance_m - kOpaqueDiscScale * 1.001f * leaf_radius_m);
  full_ = 0;
  for (uint32_t p = 0; p < map_.padded(); p += 8) {
    const F8 depth = Load8(buffer.depth() + p);
    unsigned full;
    if (splat == Splat::kOpaque) {
      full = Bits8(depth <= opaque_before);
    } else {
      const F8 coverage = Load8(buffer.coverage() + p);
      full = Bits8((coverage >= one) |
                   ((coverage > Set8(kFullFrom)) & (distance > Set8(kDepthJump) * depth)));
    }
    const F8 height = normal.x * Load8(map_.dir(0) + p) + normal.y * Load8(map_.dir(1) + p) +
                      normal.z * Load8(map_.dir(2) + p);
    const unsigned unseen = Bits8(height < below);
    full_ += static_cast<uint32_t>(std::popcount(full & ~unseen));
    const uint64_t bytes = _pdep_u64(full | unseen, 0x0101010101010101ull) * 255;
    std::memcpy(&closed_[p], &bytes, sizeof bytes);
  }
  for (int j = 0; j < side_; ++j) {
    std::memcpy(&mask_[static_cast<size_t>((j + kLargest) * stride_ + kLargest)],
                &closed_[static_cast<size_t>(j * side_)], static_cast<size_t>(side_));
  }
  for (size_t i = 0; i < border_.size(); ++i) mask_[border_[i]] = closed_[source_[i]];

  // A square of side k + 1 begins where four of side k do, one beside the other. What lies beyond
  // the borders' copies is open.
  const size_t end = static_cast<size_t>((side_ + 2 * kLargest) * stride_);
  std::fill(squares_.begin(), squares_.end(), 0);
  for (int side = 1; side <= kLargest; ++side) {
    __m256i any = _mm256_setzero_si256();
    for (size_t at = 0; at < end; at += kBytes) {
      const uint8_t* const p = &mask_[at];
      const __m256i begins = LoadBytes(p);
      StoreBytes(&squares_[at], _mm256_sub_epi8(LoadBytes(&squares_[at]), begins));  // - (-1)
      const __m256i larger =
          _mm256_and_si256(_mm256_and_si256(begins, LoadBytes(p + 1)),
                           _mm256_and_si256(LoadBytes(p + stride_), LoadBytes(p + stride_ + 1)));
      any = _mm256_or_si256(any, larger);
      StoreBytes(&next_[at], larger);
    }
    if (_mm256_testz_si256(any, any) != 0) break;
    mask_.swap(next_);
  }
}

ClosedPixels::Places ClosedPixels::At(const V8& w) const {
  const F8 zero = Set8(0.0f), one = Set8(1.0f), half = Set8(0.5f);
  const auto n = static_cast<float>(side_);
  const F8 inverse = one / (Abs8(w.x) + Abs8(w.y) + Abs8(w.z));
  F8 p = w.x * inverse, q = w.y * inverse;
  const auto sign = [&](F8 v) { return Select8(v >= zero, one, -one); };
  const M8 lower = w.z < zero;
  const F8 fold_p = (one - Abs8(q)) * sign(p), fold_q = (one - Abs8(p)) * sign(q);
  p = Select8(lower, fold_p, p);
  q = Select8(lower, fold_q, q);
  const F8 most = Set8(n);
  const F8 u = Min8(Max8((p * half + half) * most, zero), most);
  const F8 v = Min8(Max8((q * half + half) * most, zero), most);
  const F8 last = Set8(n - 1.0f);
  const __m256i i = _mm256_cvttps_epi32(reinterpret_cast<__m256>(Min8(u, last)));
  const __m256i j = _mm256_cvttps_epi32(reinterpret_cast<__m256>(Min8(v, last)));
  const __m256i pixel = _mm256_add_epi32(_mm256_mullo_epi32(j, _mm256_set1_epi32(side_)), i);
  return {u, v, reinterpret_cast<F8>(_mm256_i32gather_ps(map_.solid_angle(), pixel, 4))};
}

unsigned ClosedPixels::AllClosed(const Places& at, F8 half) const {
  const auto floor = [](F8 x) {
    return _mm256_cvttps_epi32(_mm256_floor_ps(reinterpret_cast<__m256>(x)));
  };
  // Halves too large to be known are left out; so is what is no number.
  constexpr float kMostHalf = 0.5f * kLargest;
  const M8 known = half < Set8(kMostHalf);
  half = Select8(known, half, Set8(0.0f));
  const __m256i i0 = floor(at.u - half), i1 = floor(at.u + half);
  const __m256i j0 = floor(at.v - half), j1 = floor(at.v + half);
  const __m256i side = _mm256_max_epi32(_mm256_sub_epi32(i1, i0), _mm256_sub_epi32(j1, j0));
  const __m256i place = _mm256_add_epi32(_mm256_mullo_epi32(j0, _mm256_set1_epi32(stride_)), i0);
  // Four bytes are read of which the lowest counts; there is room behind the last.
  const uint8_t* const first = &squares_[static_cast<size_t>(kLargest * stride_ + kLargest)];
  const __m256i square =
      _mm256_and_si256(_mm256_i32gather_epi32(reinterpret_cast<const int*>(first), place, 1),
                       _mm256_set1_epi32(255));
  // side is one less than the box's.
  return Bits8(known & reinterpret_cast<M8>(_mm256_cmpgt_epi32(square, side)));
}

ClosedPixels::Reach ClosedPixels::ReachAbout(const V8& w, F8 angle_rad) const {
  // With s = |x| + |y| + |z|, a coordinate of the octahedron's square is x / s or its fold
  // 1 - |x / s|. With a = |x| / s its gradient on the sphere is sqrt(1 - 2 a + 3 a²) / s; those of
  // a and s are at most sqrt(2). A pixel's solid angle is the mean of s³ over its area.
  const F8 zero = Set8(0.0f), one = Set8(1.0f), two = Set8(2.0f), three = Set8(3.0f);
  const F8 move = Set8(1.4143f) * angle_rad;
  const F8 s = Abs8(w.x) + Abs8(w.y) + Abs8(w.z);
  const F8 inverse_s = one / s, least_s = Max8(s - move, one);
  const auto steepest2 = [&](F8 a) {  // convex in a
    const F8 low = Max8(a - move, zero), high = Min8(a + move, one);
    return Max8(one - two * low + three * low * low, one - two * high + three * high * high);
  };
  const F8 steep2 = Max8(steepest2(Abs8(w.x) * inverse_s), steepest2(Abs8(w.y) * inverse_s));
  const F8 least_of_pixel = Max8(least_s - Set8(1.4143f * pixel_radius_), one);
  const auto n = static_cast<float>(side_);
  return {Sqrt8(steep2) / least_s * Set8(0.5f * n),
          Max8(Set8(4.0f / (n * n)) * least_of_pixel * least_of_pixel * least_of_pixel,
               Set8(least_pixel_sr_))};
}

}  // namespace farpoint

#include "core/render/pixel_filter.h"

#include <algorithm>

#include "core/math/elementary.h"
#include "core/math/sampling.h"

namespace farpoint {

namespace {

// x in [-1, 1], in units of half the width.
double Kernel(PixelFilter filter, double x) {
  switch (filter) {
    case PixelFilter::kBox:
      return 1;
    case PixelFilter::kTriangle:
      return 1 - (x < 0 ? -x : x);
    case PixelFilter::kGaussian:
      // σ is a third of half the width.
      return DetExp(-4.5 * x * x) - DetExp(-4.5);
    case PixelFilter::kBlackmanHarris:
      // Harris 1978, four terms, -92 dB; its sum at ±1 is 6e-5.
      return 0.35875 + 0.48829 * DetSinCos(kPi * x).cos + 0.14128 * DetSinCos(2 * kPi * x).cos +
             0.01168 * DetSinCos(3 * kPi * x).cos;
  }
  return 0;
}

}  // namespace

PixelFilterSampler::PixelFilterSampler(PixelFilter filter, float width_px)
    : half_width_px_(0.5f * width_px), box_(filter == PixelFilter::kBox) {
  // Simpson's rule within each interval.
  std::array<double, kIntervals + 1> sums{};
  const double step = 2.0 / kIntervals;
  for (int i = 0; i < kIntervals; ++i) {
    const double x = -1 + step * i;
    sums[i + 1] = sums[i] + step / 6 *
                                (Kernel(filter, x) + 4 * Kernel(filter, x + 0.5 * step) +
                                 Kernel(filter, x + step));
  }
  for (int i = 0; i <= kIntervals; ++i) cdf_[i] = static_cast<float>(sums[i] / sums[kIntervals]);
}

float PixelFilterSampler::Inverse(float u) const {
  if (box_) return half_width_px_ * (2.0f * u - 1.0f);
  // The first node above u; the density within an interval is taken as constant.
  const auto it = std::upper_bound(cdf_.begin() + 1, cdf_.end() - 1, u);
  const size_t i = static_cast<size_t>(it - cdf_.begin()) - 1;
  const float below = cdf_[i], mass = cdf_[i + 1] - below;
  const float t = mass > 0.0f ? std::clamp((u - below) / mass, 0.0f, 1.0f) : 0.5f;
  return half_width_px_ * (2.0f * (static_cast<float>(i) + t) / kIntervals - 1.0f);
}

Vec2f SamplePosition(const PixelFilterSampler& filter, uint64_t seed, uint32_t spp, int x, int y,
                     uint32_t s) {
  if (spp == 1) return {0.5f, 0.5f};
  constexpr uint64_t kKeyPixel = 1;
  const uint32_t scramble = static_cast<uint32_t>(
      HashKey(seed, kKeyPixel, static_cast<uint64_t>(x), static_cast<uint64_t>(y)));
  const Vec2f offset = filter.Sample(OwenSobol(s, 0, scramble), OwenSobol(s, 1, scramble));
  return {0.5f + offset.x, 0.5f + offset.y};
}

}  // namespace farpoint

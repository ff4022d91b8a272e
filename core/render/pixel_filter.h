// Where the samples of a pixel lie: drawn from the pixel filter's density about its centre, so
// that all samples count alike (Ernst, Stamminger, Greiner, "Filter Importance Sampling", 2006).
#pragma once

#include <array>

#include "core/math/vec.h"
#include "core/render/settings.h"

namespace farpoint {

// The filter k(x) k(y), k symmetric and zero beyond width / 2 from the centre:
//   box 1; triangle 1 - |x|; gaussian e^(-x²/(2σ²)) - e^(-h²/(2σ²)) with σ = width / 6;
//   blackman-harris 0.35875 + 0.48829 cos πx + 0.14128 cos 2πx + 0.01168 cos 3πx,
// with |x| <= h, h = width / 2 (x in units of h for triangle and blackman-harris).
// Immutable; thread-safe.
class PixelFilterSampler {
 public:
  // `width_px` > 0.
  PixelFilterSampler(PixelFilter filter, float width_px);

  // (u, v) in [0, 1)² -> offset from the pixel's centre, pixels; exact to 1e-4 of the width. Its
  // density is k(x) k(y) / (∫ k)².
  Vec2f Sample(float u, float v) const { return {Inverse(u), Inverse(v)}; }

 private:
  static constexpr int kIntervals = 512;
  float Inverse(float u) const;

  float half_width_px_;
  bool box_;
  // The integral of k up to each node, over [-1, 1], normalised to [0, 1].
  std::array<float, kIntervals + 1> cdf_{};
};

// Where sample s of the `spp` of pixel (x, y) lies, from the pixel's top left, in pixels: by the
// filter, from Owen-scrambled Sobol' points of the pixel and the seed; the centre if there is only
// one. Samples may lie in neighbouring pixels.
Vec2f SamplePosition(const PixelFilterSampler& filter, uint64_t seed, uint32_t spp, int x, int y,
                     uint32_t s);

}  // namespace farpoint

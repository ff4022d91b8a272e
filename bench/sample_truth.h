// The truth at the very samples of pixels: what path tracing says of the irradiance that an image
// of so many samples per pixel should show. Where samples lie is part of the image, so an image and
// its truth differ by nothing but the gather.
#pragma once

#include <array>
#include <cstdint>
#include <span>
#include <vector>

#include "bench/sparse_reference.h"
#include "core/base/executor.h"
#include "core/render/settings.h"

namespace farpoint {

// By pixel, in the order in which pixels were asked for.
struct SampleTruth {
  std::vector<uint8_t> hit;   // any of the samples hit a surface
  std::vector<uint8_t> edge;  // see EdgePixels
  // Mean over the samples that hit, W/m²: two independent estimates, as in SparseReference.
  std::array<std::vector<Rgb>, 2> half;
  // The same of ambient occlusion, three times the same value; empty if it was not asked for.
  std::array<std::vector<Rgb>, 2> occlusion_half;
  uint64_t rays = 0;

  Rgb Mean(size_t i) const { return (half[0][i] + half[1][i]) * 0.5f; }
};

// TraceIndirect at the samples that a render of `settings` (spp, filter, seed, bounces) has in the
// pixels: `paths` per pixel in all, shared out among its samples and the two halves, at least 8 for
// each. `occlusion`: of ambient occlusion, too. `seed` is that of the paths. kInvalidArgument:
// settings that no render takes.
absl::StatusOr<SampleTruth> TraceSampleTruth(const SparseFrame& frame,
                                             const RenderSettings& settings,
                                             std::span<const PixelPosition> pixels, uint32_t paths,
                                             uint64_t seed, Executor& executor,
                                             bool occlusion = false);

// Not 0 where a pixel shows more than one surface: of 16 samples by the filter some hit and some do
// not, or two of them have normals more than 26° apart or lie further off each other's tangent
// planes than two pixels are wide there.
std::vector<uint8_t> EdgePixels(const SparseFrame& frame, const RenderSettings& settings,
                                std::span<const PixelPosition> pixels, Executor& executor);

}  // namespace farpoint

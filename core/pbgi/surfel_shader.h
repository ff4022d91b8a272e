// Direct shading of surfels (paper §1.1: "the points are shaded from the light sources –
// accounting for direct shadows only").
#pragma once

#include "core/base/executor.h"
#include "core/base/stats.h"
#include "core/light/light_sampler.h"
#include "core/pbgi/surfel.h"

namespace farpoint {

struct ShadeOptions {
  uint32_t light_samples = 16;  // per side and light, before the factor below
  uint64_t seed = 0;
  bool no_skip = false;
};

// A gather averages many surfels, so each takes a quarter of a receiver's shadow rays.
inline constexpr uint32_t kSurfelLightShare = 4;

// Both sides of every surfel: radiance = albedo / pi * E. Which sides are visible is decided by
// four rays that leave the side: if all of them hit back faces, and no light reaches the side, it
// lies inside a closed object. Surfels are independent of each other: any number of threads gives
// the same result. Adds counts "shadow_rays", "interior_rays" and skipped "surfel_sides_inside",
// "surfel_sides_black" to `stats`.
SurfelShading ShadeSurfels(const SurfelCloud& cloud, const RayAccel& accel,
                           const LightSampler& lights, const ShadeOptions& options,
                           Executor& executor, Stats& stats);

}  // namespace farpoint

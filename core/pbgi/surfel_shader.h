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
  bool skip_black = true;  // sides that reflect nothing
  unsigned needless = 0;   // NeedlessLight
};

// A gather averages many surfels, so each takes a quarter of a receiver's shadow rays.
inline constexpr uint32_t kSurfelLightShare = 4;

// Seeds a surfel's rays by what it is, not by where it stands in the cloud.
uint64_t SurfelKey(const SurfelCloud& cloud, size_t i, const PreparedScene& scene, uint64_t seed);

// The sides that are open: not inside a closed object as far as four rays that leave the side tell
// (all of them hit back faces). A matter of geometry alone, whatever the lights. Surfels are
// independent of each other: any number of threads gives the same result. Adds the count
// "interior_rays" to `stats`.
SurfelSides FindOpenSides(const SurfelCloud& cloud, const RayAccel& accel, uint64_t seed,
                          Executor& executor, Stats& stats);

// Both sides of every surfel: radiance = albedo / pi * E. Visible are the sides that are open and
// those that a probe of the lights reaches all the same. Surfels are independent of each other.
// Adds the count "shadow_rays" and skipped "surfel_sides_inside", "surfel_sides_black",
// "shadow_rays" and "environment_terms" to `stats`.
SurfelShading ShadeSurfels(const SurfelCloud& cloud, const SurfelSides& open_sides,
                           const RayAccel& accel, const LightSampler& lights,
                           const ShadeOptions& options, Executor& executor, Stats& stats);

}  // namespace farpoint

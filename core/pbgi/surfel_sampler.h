// Blue-noise (Poisson-disc) sampling of all surfaces (paper §4: "Poisson Disk sampling").
#pragma once

#include <cstdint>

#include "core/base/executor.h"
#include "core/pbgi/surfel.h"
#include "core/scene/prepared_scene.h"

namespace farpoint {

// The number of surfels when the user names none: one for each square of edge diagonal/500,
// between 100,000 and 4,000,000. Depends on the scene only, never on the camera.
uint64_t DefaultSurfelCount(const PreparedScene& scene);

// About `count` surfels, spread so that the density is the same everywhere. Each object is
// sampled on its own, seeded by its content, so that it keeps its surfels when others change or
// when it is translated (to rounding; a rotation draws new ones); an object of any area gets at
// least one. Candidates, eight for each surfel, are stratified by area, left out in the holes of
// alpha masks and thinned by dart throwing, in a random order within cubes of 16 spacings; then
// each candidate gives its area to the nearest surfel, so that areas sum to the surface's without
// its holes (to rounding) and follow the local density. The same result for any number of threads.
// Objects run in parallel, one object on one thread: a single large one takes its whole time.
SurfelCloud SampleSurfels(const PreparedScene& scene, uint64_t count, uint64_t seed,
                          Executor& executor);

}  // namespace farpoint

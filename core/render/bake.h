// What is done once per scene state, on the coordinator: prepare, sample surfels, shade them,
// build the point tree. Its products are immutable blobs named by their SHA-256.
//
// Each stage depends on less than the scene (docs/decisions/0014-stages-of-a-bake.md):
//   surfels of an object   its shape, the holes of its mask, spacing and seed
//   topology               the surfels, the geometry that rays meet, the seed
//   radiance               the topology, the prepared scene with its lights and materials,
//                          light samples and seed
// With a cache, a stage whose inputs are those of an earlier bake takes its product. The blobs are
// the same, bit by bit, with any cache and without one.
#pragma once

#include <atomic>

#include "core/base/blob.h"
#include "core/base/executor.h"
#include "core/base/stats.h"
#include "core/base/status.h"
#include "core/render/bake_cache.h"
#include "core/render/settings.h"
#include "core/scene/scene.h"

namespace farpoint {

struct BakedScene {
  Blob prepared_scene;
  Blob tree_topology;  // surfels and hierarchy; empty for pt, which needs none
  Blob tree_radiance;  // reflected radiance per node; empty for pt
};

struct BakeOptions {
  // The least distance between surfels. 0: from settings.points and this scene. Frames of an
  // animation take that of one pose (SurfelSpacing), or their surfels would not stay in place.
  float surfel_spacing_m = 0;
  BakeCache* cache = nullptr;                 // null: every stage is done; must outlive the call
  const std::atomic<bool>* cancel = nullptr;  // looked at between the stages; null: never
};

// Adds its stage seconds and counts to `stats`; with a cache also skipped "bake_stages" (surfels of
// all objects, topology, radiance: up to 3), "objects_kept", "surfels_kept" (of kept objects, not
// sampled again) and "surfels_shaded_kept". settings.no_skip leaves the cache alone.
// Further skipped: "textures" (not decoded), "bakes_without_light" and what ShadeSurfels adds.
// kInvalidArgument if the scene cannot be rendered; kCancelled.
absl::StatusOr<BakedScene> Bake(const Scene& scene, const RenderSettings& settings,
                                Executor& executor, Stats& stats, const BakeOptions& options = {});

// The spacing that Bake takes for this scene if told none. 0 if there is no surface.
absl::StatusOr<float> SurfelSpacing(const Scene& scene, const RenderSettings& settings,
                                    Executor& executor);

}  // namespace farpoint

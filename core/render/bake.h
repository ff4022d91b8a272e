// What is done once per scene state, on the coordinator: prepare, sample surfels, shade them,
// build the point tree. Its products are immutable blobs named by their SHA-256.
#pragma once

#include "core/base/blob.h"
#include "core/base/executor.h"
#include "core/base/stats.h"
#include "core/base/status.h"
#include "core/render/settings.h"
#include "core/scene/scene.h"

namespace farpoint {

struct BakedScene {
  Blob prepared_scene;
  Blob tree_topology;  // surfels and hierarchy; empty for pt, which needs none
  Blob tree_radiance;  // reflected radiance per node; empty for pt
};

// Adds its stage seconds and counts to `stats`. kInvalidArgument if the scene cannot be rendered.
absl::StatusOr<BakedScene> Bake(const Scene& scene, const RenderSettings& settings,
                                Executor& executor, Stats& stats);

}  // namespace farpoint

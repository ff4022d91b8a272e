// What glossy receivers reflect: rays by the visible normals of their own lobe, stratified, which
// read the radiance of surfels where they end (SurfelAtlas), or shade what lies near or is itself
// glossy afresh. The same rays bring the mirror images of emitters and the environment, as the
// share of direct light that multiple importance sampling leaves to the BRDF.
#pragma once

#include <cstdint>

#include "core/base/stats.h"
#include "core/light/light_sampler.h"
#include "core/pbgi/receiver_cluster.h"
#include "core/render/glossy_point.h"
#include "core/render/loaded_scene.h"
#include "core/render/settings.h"

namespace farpoint {

class GlossyGatherer {
 public:
  // All must outlive the gatherer. The scene's bundles must be prepared.
  GlossyGatherer(const LoadedSceneData& scene, const RenderSettings& settings);

  struct Reflected {
    Rgb direct;    // W/(m² sr), by the diffuse and the glossy part
    Rgb indirect;  // W/(m² sr), by the glossy part
  };
  // `receiver` and `point` are the same place. `wants_direct`, `wants_indirect`: else 0.
  // `light_samples`: of the receiver. Adds to `rays` and `counters` what it took.
  Reflected Reflect(const Receiver& receiver, const GlossyPoint& point, uint64_t key,
                    uint32_t light_samples, bool wants_direct, bool wants_indirect,
                    LightCounters& counters, Stats& stats) const;

 private:
  const LoadedSceneData& scene_;
  const RenderSettings& settings_;
  const SurfelAtlas* atlas_ = nullptr;     // null: shade every hit
  const SurfelAtlas* indirect_ = nullptr;  // what shaded hits get by further bounces; null: nothing
  float near_m_ = 0;                       // hits nearer than this are shaded afresh
  uint32_t count_ = 0;                     // rays of a receiver with a wide lobe
};

}  // namespace farpoint

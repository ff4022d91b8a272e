// What one receiver sees along rays: reflected light, never emission. What lies far brings the
// radiance of its surfel; what lies near, where a surfel's size would show, and what is glossy,
// whose radiance depends on the direction, is shaded afresh.
#pragma once

#include <array>
#include <cstdint>
#include <span>

#include "core/accel/ray_accel.h"
#include "core/light/light_sampler.h"
#include "core/pbgi/receiver_cluster.h"
#include "core/pbgi/surfel_atlas.h"
#include "core/render/loaded_scene.h"
#include "core/render/ray_hits.h"

namespace farpoint {

// Below this many surfel spacings from the receiver a hit is shaded afresh.
inline constexpr float kNearSpacings = 2.0f;

// For one thread.
class HitReader {
 public:
  // `atlas` null: every hit is shaded. `indirect`: what shaded hits get by further bounces; null:
  // nothing. `near_m`: hits nearer than this are shaded. `light_key` seeds their shadow rays. The
  // scene must outlive the reader; its bundles must be prepared. `shades` false: all radiance is 0.
  HitReader(const LoadedSceneData& scene, const SurfelAtlas* atlas, const SurfelAtlas* indirect,
            float near_m, const Receiver& receiver, uint64_t light_key, bool shades = true)
      : scene_(scene),
        atlas_(atlas),
        indirect_(indirect),
        near_m_(near_m),
        origin_(receiver.Leave()),
        offset_m_(receiver.offset_m),
        light_key_(light_key),
        shades_(shades) {}

  // Rays to be read together: up to kRaysTogether.
  struct Rays {
    uint32_t count = 0;
    std::array<Vec3f, kRaysTogether> direction;
    std::array<uint32_t, kRaysTogether> index;  // tells a ray from the receiver's others
    std::array<uint32_t, kRaysTogether> stratum;
    // Results: the hit (kNoTriangle: none), the reflected radiance that arrives against the
    // direction and 1 / the distance, 0: nothing there.
    std::array<RayHit, kRaysTogether> hit;
    std::array<Rgb, kRaysTogether> radiance;
    std::array<float, kRaysTogether> inverse_distance;

    void Add(const Vec3f& w, uint32_t ray_index, uint32_t of) {
      direction[count] = w;
      index[count] = ray_index;
      stratum[count++] = of;
    }
  };

  void Read(Rays& rays);
  // Where they hit, only.
  void Trace(Rays& rays);
  // Again one ray that may have slipped between two triangles.
  void ReadAgain(Rays& rays, uint32_t i);

  LightCounters counters;
  uint64_t traced = 0, again = 0, read = 0, shaded = 0, glossy = 0;

 private:
  void ReadHits(Rays& rays);
  Rgb ShadeGlossy(const Rays& rays, uint32_t i);

  const LoadedSceneData& scene_;
  const SurfelAtlas* const atlas_;
  const SurfelAtlas* const indirect_;
  const float near_m_;
  const Vec3f origin_;
  const float offset_m_;
  const uint64_t light_key_;
  const bool shades_;
};

}  // namespace farpoint

// A point of a glossy surface as it is seen from one direction, and the direct light that it
// reflects there.
//
// Direct light is what emitters, lights and the environment send without a detour, reflected by the
// whole BRDF: highlights and mirror images of emitters are direct light. It is estimated by
// multiple importance sampling [Veach and Guibas 1995, balance heuristic]: samples of the lights
// serve the diffuse part and share the glossy one with rays that the BRDF draws; lights without
// extent are sampled as lights only.
#pragma once

#include <cstdint>

#include "core/accel/ray_accel.h"
#include "core/light/light_sampler.h"
#include "core/math/microfacet.h"
#include "core/math/vec.h"

namespace farpoint {

class GlossyPoint {
 public:
  // What a ray along the unit direction `w` hits, on the side that it comes from. Precondition:
  // PreparedScene::IsGlossy(hit.triangle).
  GlossyPoint(const RayAccel& accel, const RayHit& hit, const Vec3f& w);

  const SurfacePoint& surface() const { return surface_; }
  const MicrofacetBrdf& brdf() const { return brdf_; }
  Vec3f ToWorld(const Vec3f& w_local) const { return frame_.ToWorld(w_local); }
  Vec3f ToLocal(const Vec3f& w) const {
    return {Dot(w, frame_.t), Dot(w, frame_.b), Dot(w, frame_.n)};
  }
  bool Carries(const Vec3f& w, const Vec3f& w_local) const {
    return w_local.z > 0.0f && Dot(w, surface_.ng) > 0.0f;
  }

  // An unbiased estimate of the direct light, W/(m² sr), of one sample of each kind of light,
  // `index` of the sequence `key`, and one ray drawn by (u, v). Adds that ray to `rays`.
  Rgb Direct(const RayAccel& accel, const LightSampler& lights, uint64_t key, uint32_t index,
             float u, float v, LightCounters& counters, uint64_t& rays) const;

 private:
  GlossyPoint(const RayAccel& accel, const RayHit& hit, const Vec3f& w, const SurfacePoint& at);

  SurfacePoint surface_;
  Frame frame_;
  MicrofacetBrdf brdf_;
};

// For LightSampler::Reflected: the BRDF, its glossy part by what light samples are worth beside
// rays that the BRDF draws.
class GlossyReflector final : public Reflector {
 public:
  // `rays` of BRDF::SampleGlossy beside each light sample; 0: none, the lights' samples count
  // whole. Both must outlive the reflector.
  GlossyReflector(const GlossyPoint& point, float rays) : point_(point), rays_(rays) {}
  Rgb Toward(const Vec3f& w, float density_sr) const override;

 private:
  const GlossyPoint& point_;
  const float rays_;
};

}  // namespace farpoint

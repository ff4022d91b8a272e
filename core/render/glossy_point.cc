#include "core/render/glossy_point.h"

#include <cmath>
#include <limits>
#include <optional>

namespace farpoint {

namespace {

SurfacePoint SurfaceOf(const RayAccel& accel, const RayHit& hit, const Vec3f& w) {
  const PreparedScene& scene = accel.scene();
  SurfacePoint at;
  at.p = scene.PointOn(hit.triangle, hit.b1, hit.b2);
  at.ng = scene.GeometricNormal(hit.triangle);
  at.n = scene.ShadingNormal(hit.triangle, hit.b1, hit.b2, at.ng);
  if (Dot(at.ng, w) > 0.0f) {
    at.ng = -at.ng;
    at.n = -at.n;
  }
  at.offset_m = accel.SurfaceOffsetM(hit.triangle, at.p, at.ng);
  return at;
}

}  // namespace

GlossyPoint::GlossyPoint(const RayAccel& accel, const RayHit& hit, const Vec3f& w)
    : GlossyPoint(accel, hit, w, SurfaceOf(accel, hit, w)) {}

GlossyPoint::GlossyPoint(const RayAccel& accel, const RayHit& hit, const Vec3f& w,
                         const SurfacePoint& at)
    : surface_(at),
      frame_(at.n),
      brdf_(accel.scene().MicrofacetAt(hit.triangle, hit.b1, hit.b2),
            Vec3f(-Dot(w, frame_.t), -Dot(w, frame_.b), -Dot(w, frame_.n))) {}

Rgb GlossyPoint::Direct(const RayAccel& accel, const LightSampler& lights, uint64_t key,
                        uint32_t index, float u, float v, LightCounters& counters,
                        uint64_t& rays) const {
  const bool extended = lights.has_emitters() || lights.has_sky();
  Rgb sum = lights.Reflected(surface_, GlossyReflector(*this, extended ? 1.0f : 0.0f), 1, key,
                             index, 2, counters);
  if (!extended) return sum;
  const Vec3f local = brdf_.SampleGlossy(u, v), w = frame_.ToWorld(local);
  if (!Carries(w, local)) return sum;
  ++rays;
  const std::optional<RayHit> hit = accel.Intersect(surface_.Leave(), w);
  const LightSampler::Seen seen =
      hit ? lights.EmissionSeen(surface_, *hit) : lights.EnvironmentSeen(surface_, w);
  if (!(MaxComponent(seen.radiance) > 0.0f)) return sum;
  const float all = seen.density_sr + brdf_.GlossyPdf(local);
  if (all > 0.0f) sum += seen.radiance * brdf_.Evaluate(local).glossy * (local.z / all);
  return sum;
}

Rgb GlossyReflector::Toward(const Vec3f& w, float density_sr) const {
  const Vec3f local = point_.ToLocal(w);
  const MicrofacetBrdf::Value f = point_.brdf().Evaluate(local);
  if (!(rays_ > 0.0f) || !(density_sr <= std::numeric_limits<float>::max())) {
    return f.diffuse + f.glossy;
  }
  const float all = density_sr + rays_ * point_.brdf().GlossyPdf(local);
  return all > 0.0f ? f.diffuse + f.glossy * (density_sr / all) : f.diffuse;
}

}  // namespace farpoint

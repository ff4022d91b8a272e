#include "core/render/path_tracer.h"

#include <algorithm>
#include <cmath>

#include "core/math/elementary.h"
#include "core/math/sampling.h"

namespace farpoint {

namespace {
constexpr uint32_t kBatches = 8;
}

TracedIrradiance TraceIndirect(const RayAccel& accel, const LightSampler& lights,
                               const Receiver& receiver, uint32_t paths, uint64_t key,
                               LightCounters& counters, uint64_t& rays) {
  const PreparedScene& scene = accel.scene();
  const Frame frame(receiver.normal);
  const Vec3f origin = accel.LeaveSurface(receiver.position, receiver.geometric_normal);
  const uint32_t seed = static_cast<uint32_t>(HashKey(key, 11));
  Vec3d sum;
  Vec3d batch[kBatches];
  uint32_t batch_count[kBatches] = {};
  for (uint32_t i = 0; i < paths; ++i) {
    const uint32_t b = static_cast<uint32_t>(uint64_t{i} * kBatches / paths);
    ++batch_count[b];
    const Vec3f w = frame.ToWorld(CosineHemisphere(OwenSobol(i, 0, seed), OwenSobol(i, 1, seed)));
    // Directions that the shading normal allows and the surface does not carry nothing.
    if (!(Dot(w, receiver.geometric_normal) > 0.0f)) continue;
    ++rays;
    const std::optional<RayHit> hit = accel.Intersect(origin, w);
    if (!hit) continue;
    const SurfaceSample surface = scene.Surface(hit->triangle, hit->b1, hit->b2);
    if (!(MaxComponent(surface.albedo) > 0.0f)) continue;
    Vec3f ng = scene.GeometricNormal(hit->triangle);
    Vec3f ns = scene.ShadingNormal(hit->triangle, hit->b1, hit->b2, ng);
    if (Dot(ng, w) > 0.0f) {
      ng = -ng;
      ns = -ns;
    }
    const Vec3f y = scene.PointOn(hit->triangle, hit->b1, hit->b2);
    const Rgb e = lights.Irradiance(y, ng, ns, 1, HashKey(key, 12), i, 2, counters);
    const Vec3d radiance = Vec3d(surface.albedo * e) / kPi;
    sum += radiance;
    batch[b] += radiance;
  }
  TracedIrradiance out;
  const Vec3d mean = sum / static_cast<double>(paths);
  out.irradiance = Rgb(mean * kPi);
  if (paths >= kBatches) {
    Vec3d variance;
    for (uint32_t b = 0; b < kBatches; ++b) {
      const Vec3d d = batch[b] / static_cast<double>(batch_count[b]) - mean;
      variance += d * d;
    }
    variance = variance / (kBatches * (kBatches - 1.0));
    out.standard_error =
        Rgb(Vec3d(std::sqrt(variance.x), std::sqrt(variance.y), std::sqrt(variance.z)) * kPi);
  }
  return out;
}

}  // namespace farpoint

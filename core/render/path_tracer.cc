#include "core/render/path_tracer.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <optional>

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
  const uint64_t light_key = HashKey(key, 12);
  Vec3d sum;
  Vec3d batch[kBatches];
  uint32_t batch_count[kBatches] = {};
  // Directions, rays and light by turns of a few paths: what follows each other does the same work,
  // and a twentieth less time goes by on small scenes.
  constexpr uint32_t kTurn = 32;
  std::array<Vec3f, kTurn> directions;
  std::array<std::optional<RayHit>, kTurn> hits;
  for (uint32_t first = 0; first < paths; first += kTurn) {
    const uint32_t count = std::min(kTurn, paths - first);
    for (uint32_t k = 0; k < count; ++k) {
      directions[k] = frame.ToWorld(
          CosineHemisphere(OwenSobol(first + k, 0, seed), OwenSobol(first + k, 1, seed)));
    }
    for (uint32_t k = 0; k < count; ++k) {
      hits[k].reset();
      // Directions that the shading normal allows and the surface does not carry nothing.
      if (!(Dot(directions[k], receiver.geometric_normal) > 0.0f)) continue;
      ++rays;
      hits[k] = accel.Intersect(origin, directions[k]);
    }
    for (uint32_t k = 0; k < count; ++k) {
      const uint32_t i = first + k;
      const uint32_t b = static_cast<uint32_t>(uint64_t{i} * kBatches / paths);
      ++batch_count[b];
      const std::optional<RayHit>& hit = hits[k];
      if (!hit) continue;
      const SurfaceSample surface = scene.Surface(hit->triangle, hit->b1, hit->b2);
      if (!(MaxComponent(surface.albedo) > 0.0f)) continue;
      Vec3f ng = scene.GeometricNormal(hit->triangle);
      Vec3f ns = scene.ShadingNormal(hit->triangle, hit->b1, hit->b2, ng);
      if (Dot(ng, directions[k]) > 0.0f) {
        ng = -ng;
        ns = -ns;
      }
      const Vec3f y = scene.PointOn(hit->triangle, hit->b1, hit->b2);
      const Rgb e = lights.Irradiance(y, ng, ns, 1, light_key, i, 2, counters);
      const Vec3d radiance = Vec3d(surface.albedo * e) / kPi;
      sum += radiance;
      batch[b] += radiance;
    }
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

#include "core/render/path_tracer.h"

#include <algorithm>
#include <array>
#include <bit>
#include <cmath>
#include <optional>
#include <span>

#include "core/math/sampling.h"
#include "core/math/vec8.h"
#include "core/render/ray_hits.h"

namespace farpoint {

namespace {

constexpr uint32_t kBatches = 8;
// The paths of batch b are FirstOf(b) up to FirstOf(b + 1).
uint32_t FirstOf(uint32_t batch, uint32_t paths) {
  return static_cast<uint32_t>((uint64_t{batch} * paths + kBatches - 1) / kBatches);
}

}  // namespace

TracedIrradiance TraceIndirect(const RayAccel& accel, const LightSampler& lights,
                               const Receiver& receiver, uint32_t paths, uint32_t bounces,
                               uint64_t key, LightCounters& counters, uint64_t& rays,
                               unsigned needless, bool keep_black) {
  const PreparedScene& scene = accel.scene();
  const Frame8 frame{V8(receiver.normal)};
  const V8 ng(receiver.geometric_normal);
  const Vec3f origin = receiver.Leave();
  const auto seed = static_cast<uint32_t>(HashKey(key, 11));
  const OwenSobolAxis axis_u(0, seed), axis_v(1, seed);
  const uint64_t light_key = HashKey(key, 12);
  Vec3d batch[kBatches];
  const auto batch_of = [&](uint32_t path) { return uint64_t{path} * kBatches / paths; };
  RayHits hits;
  const U8 lanes = {0, 1, 2, 3, 4, 5, 6, 7};
  for (uint32_t first = 0; first < paths; first += kRaysTogether) {
    const uint32_t count = std::min(kRaysTogether, paths - first);
    std::array<Vec3f, kRaysTogether> directions;
    uint64_t leaving = 0;  // bit k: path k
    for (uint32_t k = 0; k < count; k += kHitLanes) {
      const U8 index = lanes + (first + k);
      const V8 w = frame.ToWorld(CosineHemisphere8(axis_u.PointsOf(index), axis_v.PointsOf(index)));
      // Directions that the shading normal allows and the surface does not carry nothing.
      leaving |= uint64_t{Bits8(Dot(w, ng) > Set8(0.0f))} << k;
      for (uint32_t l = 0; l < kHitLanes; ++l) directions[k + l] = w.Lane(l);
    }
    if (count < kRaysTogether) leaving &= (uint64_t{1} << count) - 1;
    std::array<Vec3f, kRaysTogether> origins;
    std::array<Rgb, kRaysTogether> throughput;  // of the paths, before the vertex at hand
    origins.fill(origin);
    throughput.fill(Rgb(1));
    for (uint32_t bounce = 1; leaving != 0; ++bounce) {
      const auto order_seed = static_cast<uint32_t>(HashKey(key, 13, bounce));
      rays += static_cast<uint64_t>(std::popcount(leaving));
      hits.count = 0;
      for (; leaving != 0; leaving &= leaving - 1) {
        const auto k = static_cast<uint32_t>(std::countr_zero(leaving));
        const std::optional<RayHit> hit = accel.Intersect(origins[k], directions[k]);
        if (!hit) continue;
        const uint32_t i = hits.count++;
        hits.ray[i] = k;
        // Scrambles of the same points keep their order of strata: later bounces see the points
        // in another order, or paths would not fill the space of their directions.
        hits.index[i] = bounce == 1 ? first + k : OwenShuffledIndex(first + k, order_seed);
        hits.triangle[i] = hit->triangle;
        hits.b1[i] = hit->b1;
        hits.b2[i] = hit->b2;
      }
      for (uint32_t i = 0; i < hits.count; ++i) hits.direction.Set(i, directions[hits.ray[i]]);
      const uint32_t met = hits.count;
      KeepWhatReflects(scene, hits, keep_black);
      counters.skipped_black += met - hits.count;
      std::array<SurfacePoints8, kRaysTogether / kHitLanes> points;
      std::array<V8, kRaysTogether / kHitLanes> irradiance;
      const size_t groups = SurfacesOf(hits, points);
      lights.IrradianceEach(std::span(points).first(groups),
                            bounce == 1 ? light_key : HashKey(light_key, bounce), 2,
                            std::span(irradiance).first(groups), counters, needless);
      const bool last = bounce >= bounces;
      const auto next_order_seed = static_cast<uint32_t>(HashKey(key, 13, bounce + 1));
      const auto next_seed = static_cast<uint32_t>(HashKey(key, 11, bounce));
      for (uint32_t i = 0; i < hits.count; ++i) {
        const Rgb arriving = irradiance[i / kHitLanes].Lane(i % kHitLanes);
        // Textures are looked up where light arrives, or the path goes on.
        if (last && !(MaxComponent(arriving) > 0.0f)) continue;
        const uint32_t k = hits.ray[i];
        throughput[k] *= scene.Surface(hits.triangle[i], hits.b1[i], hits.b2[i]).albedo;
        batch[batch_of(first + k)] += Vec3d(throughput[k] * arriving);
        if (last || !(MaxComponent(throughput[k]) > 0.0f)) continue;
        const SurfacePoint at = points[i / kHitLanes].Lane(i % kHitLanes);
        const uint32_t index = OwenShuffledIndex(first + k, next_order_seed);
        const Vec3f w = Frame(at.n).ToWorld(
            CosineHemisphere(OwenSobol(index, 0, next_seed), OwenSobol(index, 1, next_seed)));
        if (!(Dot(w, at.ng) > 0.0f)) continue;
        origins[k] = at.Leave();
        directions[k] = w;
        leaving |= uint64_t{1} << k;
      }
    }
  }
  TracedIrradiance out;
  Vec3d sum;
  for (const Vec3d& b : batch) sum += b;
  // Of albedo E: its mean is pi times that of the radiance.
  const Vec3d mean = sum / static_cast<double>(paths);
  out.irradiance = Rgb(mean);
  if (paths >= kBatches) {
    Vec3d variance;
    for (uint32_t b = 0; b < kBatches; ++b) {
      const uint32_t size = FirstOf(b + 1, paths) - FirstOf(b, paths);
      const Vec3d d = batch[b] / static_cast<double>(size) - mean;
      variance += d * d;
    }
    variance = variance / (kBatches * (kBatches - 1.0));
    out.standard_error =
        Rgb(Vec3d(std::sqrt(variance.x), std::sqrt(variance.y), std::sqrt(variance.z)));
  }
  return out;
}

}  // namespace farpoint

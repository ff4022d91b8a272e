#include "bench/sample_truth.h"

#include <algorithm>
#include <atomic>
#include <cmath>
#include <optional>

#include "core/math/sampling.h"
#include "core/render/ambient_occlusion.h"
#include "core/render/camera_rays.h"
#include "core/render/loaded_scene.h"
#include "core/render/path_tracer.h"
#include "core/render/pixel_filter.h"
#include "core/render/record_gatherer.h"

namespace farpoint {

namespace {

constexpr uint32_t kEdgeSamples = 16;
constexpr float kEdgeCosine = 0.9f;
constexpr float kEdgeFootprints = 2.0f;

// What the samples of pixels hit.
class Sampler {
 public:
  Sampler(const SparseFrame& frame, const RenderSettings& settings)
      : scene_(static_cast<const LoadedSceneData&>(*frame.scene)),
        settings_(settings),
        rays_(frame.camera, frame.film, scene_.scene->origin()),
        filter_(settings.filter, settings.filter_width()) {}

  std::optional<Receiver> At(const PixelPosition& pixel, uint32_t spp, uint32_t s) const {
    const Vec2f offset = SamplePosition(filter_, settings_.seed, spp, pixel.x, pixel.y, s);
    const Vec3f w = rays_.Direction(pixel.x + static_cast<double>(offset.x),
                                    pixel.y + static_cast<double>(offset.y));
    const std::optional<RayHit> hit = FirstSeen(*scene_.accel, rays_.eye(), w);
    if (!hit) return std::nullopt;
    return ReceiverOfHit(*scene_.accel, *hit, w);
  }
  bool IsEdge(const PixelPosition& pixel) const {
    std::vector<Receiver> seen;
    for (uint32_t s = 0; s < kEdgeSamples; ++s) {
      if (const std::optional<Receiver> r = At(pixel, kEdgeSamples, s)) seen.push_back(*r);
    }
    if (seen.empty()) return false;
    if (seen.size() < kEdgeSamples) return true;
    for (const Receiver& a : seen) {
      const float most = kEdgeFootprints * rays_.FootprintAt(a.position);
      for (const Receiver& b : seen) {
        if (Dot(a.normal, b.normal) < kEdgeCosine ||
            std::fabs(Dot(a.geometric_normal, b.position - a.position)) > most) {
          return true;
        }
      }
    }
    return false;
  }
  const LoadedSceneData& scene() const { return scene_; }

 private:
  const LoadedSceneData& scene_;
  const RenderSettings& settings_;
  const CameraRays rays_;
  const PixelFilterSampler filter_;
};

}  // namespace

absl::StatusOr<SampleTruth> TraceSampleTruth(const SparseFrame& frame,
                                             const RenderSettings& settings,
                                             std::span<const PixelPosition> pixels, uint32_t paths,
                                             uint64_t seed, Executor& executor, bool occlusion) {
  FP_RETURN_IF_ERROR(ValidateSettings(settings));
  const Sampler sampler(frame, settings);
  const uint32_t each = std::max(8u, paths / (2 * settings.spp));
  SampleTruth truth;
  truth.hit.assign(pixels.size(), 0);
  for (auto& half : truth.half) half.assign(pixels.size(), Rgb());
  for (auto& half : truth.occlusion_half) half.assign(occlusion ? pixels.size() : 0, Rgb());
  const float distance_m = AoDistance(settings, *sampler.scene().scene);
  std::atomic<uint64_t> rays{0};
  executor.ForEach(pixels.size(), 1, [&](size_t i) {
    const PixelPosition& pixel = pixels[i];
    std::array<Vec3d, 2> sum;
    std::array<double, 2> open{};
    uint32_t hits = 0;
    LightCounters counters;
    uint64_t traced = 0;
    for (uint32_t s = 0; s < settings.spp; ++s) {
      const std::optional<Receiver> receiver = sampler.At(pixel, settings.spp, s);
      if (!receiver) continue;
      ++hits;
      for (uint64_t half = 0; half < 2; ++half) {
        const uint64_t key = HashKey(HashKey(seed, half, s), static_cast<uint64_t>(pixel.x),
                                     static_cast<uint64_t>(pixel.y));
        sum[half] += Vec3d(TraceIndirect(*sampler.scene().accel, *sampler.scene().lights, *receiver,
                                         each, settings.bounces, key, counters, traced)
                               .irradiance);
        if (occlusion) {
          open[half] += static_cast<double>(TraceAmbientOcclusion(*sampler.scene().accel, *receiver,
                                                                  distance_m, each, key, traced));
        }
      }
    }
    rays += traced;
    truth.hit[i] = hits > 0;
    for (size_t half = 0; half < 2 && hits > 0; ++half) {
      truth.half[half][i] = Rgb(sum[half] / static_cast<double>(hits));
      if (occlusion) truth.occlusion_half[half][i] = Rgb(static_cast<float>(open[half] / hits));
    }
  });
  truth.rays = rays;
  truth.edge = EdgePixels(frame, settings, pixels, executor);
  return truth;
}

std::vector<uint8_t> EdgePixels(const SparseFrame& frame, const RenderSettings& settings,
                                std::span<const PixelPosition> pixels, Executor& executor) {
  const Sampler sampler(frame, settings);
  std::vector<uint8_t> edge(pixels.size(), 0);
  executor.ForEach(pixels.size(), 64, [&](size_t i) { edge[i] = sampler.IsEdge(pixels[i]); });
  return edge;
}

}  // namespace farpoint

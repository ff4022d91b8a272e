#include "core/render/glossy_gatherer.h"

#include <array>

#include "core/math/sampling.h"
#include "core/render/hit_reader.h"

namespace farpoint {

namespace {

// Narrower lobes get twice the rays: what they see, such as a highlight, is seen by few of them. On
// the glossy Cornell box 512 rays at roughness 0.3 err as 256 do at 0.5.
constexpr float kNarrowAlpha = 0.2f;

enum : uint64_t { kKeyDirections = 61, kKeyHits = 62, kKeyLights = 63 };

}  // namespace

GlossyGatherer::GlossyGatherer(const LoadedSceneData& scene, const RenderSettings& settings)
    : scene_(scene), settings_(settings) {
  if (settings.point_based() && scene.tree != nullptr && !scene.tree->empty()) {
    atlas_ = &scene.Atlas();
    indirect_ = scene.IndirectAtlas();
    near_m_ = kNearSpacings * atlas_->spacing_m();
  }
  switch (settings.quality) {
    case Quality::kDraft:
      count_ = 64;
      break;
    case Quality::kNormal:
      count_ = 256;
      break;
    case Quality::kFine:
      count_ = 1024;
      break;
  }
}

GlossyGatherer::Reflected GlossyGatherer::Reflect(const Receiver& receiver,
                                                  const GlossyPoint& point, uint64_t key,
                                                  uint32_t light_samples, bool wants_direct,
                                                  bool wants_indirect, LightCounters& counters,
                                                  Stats& stats) const {
  Reflected out;
  const LightSampler& lights = *scene_.lights;
  const bool extended = lights.has_emitters() || lights.has_sky();
  const uint32_t count = point.brdf().alpha() < kNarrowAlpha ? 2 * count_ : count_;
  const auto n = static_cast<float>(light_samples), m = static_cast<float>(count);
  if (wants_direct) {
    out.direct = lights.Reflected(receiver.surface(), GlossyReflector(point, extended ? m / n : 0),
                                  light_samples, HashKey(key, kKeyLights), 0, 0, counters,
                                  LightSampler::kOfReceivers, true, NeedlessLightOf(settings_));
  }
  if (!wants_indirect && !(wants_direct && extended)) return out;
  HitReader reader(scene_, atlas_, indirect_, near_m_, receiver, HashKey(key, kKeyHits));
  const auto seed = static_cast<uint32_t>(HashKey(key, kKeyDirections));
  HitReader::Rays rays;
  std::array<Vec3f, kRaysTogether> local;
  Vec3d direct, indirect;
  const auto flush = [&] {
    if (wants_indirect) {
      reader.Read(rays);
    } else {
      reader.Trace(rays);
    }
    for (uint32_t i = 0; i < rays.count; ++i) {
      const Rgb glossy = point.brdf().Evaluate(local[i]).glossy * local[i].z;
      const float pdf = point.brdf().GlossyPdf(local[i]);
      if (wants_indirect && pdf > 0.0f) indirect += Vec3d(rays.radiance[i] * glossy * (1.0f / pdf));
      if (!wants_direct || !extended) continue;
      const LightSampler::Seen seen =
          rays.hit[i].triangle != kNoTriangle
              ? lights.EmissionSeen(receiver.surface(), rays.hit[i])
              : lights.EnvironmentSeen(receiver.surface(), rays.direction[i]);
      const float all = n * seen.density_sr + m * pdf;
      if (MaxComponent(seen.radiance) > 0.0f && all > 0.0f) {
        direct += Vec3d(seen.radiance * glossy * (1.0f / all));
      }
    }
    rays.count = 0;
  };
  for (uint32_t i = 0; i < count; ++i) {
    const Vec3f along = point.brdf().SampleGlossy(OwenSobol(i, 0, seed), OwenSobol(i, 1, seed));
    const Vec3f w = point.ToWorld(along);
    if (!point.Carries(w, along)) continue;
    local[rays.count] = along;
    rays.Add(w, i, 0);
    if (rays.count == kRaysTogether) flush();
  }
  flush();
  out.direct += Rgb(direct);
  out.indirect = Rgb(indirect / static_cast<double>(count));
  counters.rays += reader.counters.rays;
  counters.skipped_facing_away += reader.counters.skipped_facing_away;
  stats.counts["rays"] += reader.traced;
  stats.counts["glossy_rays"] += reader.traced;
  stats.counts["hits_shaded"] += reader.shaded + reader.glossy;
  stats.skipped["hits_read_from_surfels"] += reader.read;
  return out;
}

}  // namespace farpoint

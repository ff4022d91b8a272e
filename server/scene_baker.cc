#include "server/scene_baker.h"

#include <bit>

#include "core/base/clock.h"
#include "core/base/executor.h"
#include "core/scene/importer.h"
#include "proto/convert.h"

namespace farpoint {

namespace {

absl::Status CheckNotStopped(const std::atomic<bool>& cancel) {
  if (cancel.load()) return absl::CancelledError("the bake was stopped");
  return absl::OkStatus();
}

void HashPart(Sha256& hash, std::string_view part) {
  hash.UpdateU64(part.size());
  hash.Update(part);
}

// Adds the time until its end to the stage of importing.
class ImportTimer {
 public:
  explicit ImportTimer(Stats& stats) : stats_(stats) {}
  ~ImportTimer() {
    constexpr auto kImport = static_cast<size_t>(Stage::kImport);
    stats_.seconds[kImport] += ThreadCpuSeconds() - cpu_start_;
    stats_.wall_seconds[kImport] += std::chrono::duration<double>(clock_.Now() - start_).count();
  }

 private:
  Stats& stats_;
  const SteadyClock clock_;
  const TimePoint start_ = clock_.Now();
  const double cpu_start_ = ThreadCpuSeconds();
};

class CoreBaker final : public SceneBaker {
 public:
  CoreBaker(unsigned threads, uint64_t cache_bytes) : executor_(threads), cache_(cache_bytes) {}

  absl::StatusOr<BakeResult> Bake(const AssetBundle& asset, const JobSpec& spec,
                                  std::optional<double> time_s,
                                  const std::atomic<bool>& cancel) override {
    BakeResult result;
    FP_RETURN_IF_ERROR(CheckNotStopped(cancel));
    ImportedScene imported;
    {
      ImportTimer timer(result.stats);
      FP_ASSIGN_OR_RETURN(imported, Import(asset, spec, time_s));
      result.made_up_camera = imported.scene.cameras.empty();
      const SceneOverrides& o = spec.overrides;
      EnsureCameraAndLight(imported, /*light_chosen=*/!o.suns.empty() || !o.lights.empty() ||
                                         o.sky.has_value() || o.environment.has_value());
      if (spec.settings.materials == Materials::kLambert) NoteHiddenGloss(imported);
    }
    FP_RETURN_IF_ERROR(CheckNotStopped(cancel));

    BakeOptions options;
    options.cache = &cache_;
    options.cancel = &cancel;
    if (time_s && imported.animation && spec.settings.point_based()) {
      ImportTimer timer(result.stats);
      FP_ASSIGN_OR_RETURN(options.surfel_spacing_m, SpacingAtRest(asset, spec));
      FP_RETURN_IF_ERROR(CheckNotStopped(cancel));
    }
    FP_ASSIGN_OR_RETURN(result.blobs, farpoint::Bake(imported.scene, spec.settings, executor_,
                                                     result.stats, options));
    FP_RETURN_IF_ERROR(CheckNotStopped(cancel));
    result.cameras = std::move(imported.scene.cameras);
    result.notes = std::move(imported.notes);
    result.animated = imported.animation.has_value();
    return result;
  }

 private:
  static absl::StatusOr<ImportedScene> Import(const AssetBundle& asset, const JobSpec& spec,
                                              std::optional<double> time_s) {
    ImportOptions options;
    options.light_units = spec.light_units;
    options.max_triangles = spec.limits.max_triangles;
    options.time_s = time_s;
    options.gloss = spec.settings.materials == Materials::kGltf;
    FP_ASSIGN_OR_RETURN(ImportedScene imported, ImportScene(asset, options));
    FP_RETURN_IF_ERROR(ApplyOverrides(spec.overrides, asset, imported.scene));
    return imported;
  }

  // The spacing of the scene at rest, for all of its frames: it may not depend on a frame, or the
  // surfels of objects that stand still would change from one to the next.
  absl::StatusOr<float> SpacingAtRest(const AssetBundle& asset, const JobSpec& spec) {
    Sha256 hash;
    HashPart(hash, "spacing at rest");
    HashPart(hash, BakeKey(spec).Hex());
    const Digest key = hash.Finish();
    if (const auto known = cache_.Find<float>(key)) return *known;
    FP_ASSIGN_OR_RETURN(const ImportedScene rest, Import(asset, spec, std::nullopt));
    FP_ASSIGN_OR_RETURN(const float spacing_m, SurfelSpacing(rest.scene, spec.settings, executor_));
    cache_.Put(key, std::make_shared<const float>(spacing_m), sizeof(float));
    return spacing_m;
  }

  Executor executor_;
  BakeCache cache_;
};

}  // namespace

std::shared_ptr<SceneBaker> MakeCoreBaker(unsigned threads, uint64_t cache_bytes) {
  return std::make_shared<CoreBaker>(threads, cache_bytes);
}

Digest BakeKey(const JobSpec& spec) {
  JobSpec relevant;
  relevant.asset_root = spec.asset_root;
  relevant.asset_files = spec.asset_files;
  relevant.overrides = spec.overrides;
  relevant.light_units = spec.light_units;
  relevant.settings = spec.settings;
  // What only tiles need. pt and irrcache have no surfels; the others share surfels and tree, but
  // for how many there are by default.
  RenderSettings& s = relevant.settings;
  const RenderSettings any;
  const bool fewer = s.points == 0 && s.reads_surfels_by_rays();
  s.integrator = s.point_based() ? any.integrator : Integrator::kPt;
  s.spp = any.spp;
  s.filter = any.filter;
  s.filter_width_px = any.filter_width_px;
  s.paths = any.paths;
  if (!s.point_based()) s.bounces = any.bounces;
  s.microbuffer = any.microbuffer;
  s.buffer_map = any.buffer_map;
  s.splat = any.splat;
  s.clusters = any.clusters;
  s.fill = fewer || !s.point_based() ? any.fill : Fill::kCut;
  s.quality = any.quality;
  s.cache_error = any.cache_error;
  s.cache_samples = any.cache_samples;
  s.ao_distance_m = any.ao_distance_m;
  s.epsilon = any.epsilon;
  s.normal_weight = any.normal_weight;
  s.kmeans_iterations = any.kmeans_iterations;
  s.layers = any.layers;
  s.tile_px = any.tile_px;
  s.no_skip = any.no_skip;
  Sha256 hash;
  HashPart(hash, FARPOINT_VERSION);
  // No maps and no unknown fields: the serialisation of one process and version is canonical.
  HashPart(hash, ToWire(relevant).SerializeAsString());
  return hash.Finish();
}

Digest BakeKeyAt(const JobSpec& spec, std::optional<double> time_s) {
  Sha256 hash;
  HashPart(hash, BakeKey(spec).Hex());
  hash.UpdateU64(time_s ? 1 : 0);
  hash.UpdateU64(time_s ? std::bit_cast<uint64_t>(*time_s) : 0);
  return hash.Finish();
}

}  // namespace farpoint

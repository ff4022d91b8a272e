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

class CoreBaker final : public SceneBaker {
 public:
  explicit CoreBaker(unsigned threads) : executor_(threads) {}

  absl::StatusOr<BakeResult> Bake(const AssetBundle& asset, const JobSpec& spec,
                                  std::optional<double> time_s,
                                  const std::atomic<bool>& cancel) override {
    BakeResult result;
    ImportOptions options;
    options.light_units = spec.light_units;
    options.max_triangles = spec.limits.max_triangles;
    options.time_s = time_s;
    FP_RETURN_IF_ERROR(CheckNotStopped(cancel));

    const SteadyClock clock;
    const TimePoint start = clock.Now();
    const double cpu_start = ThreadCpuSeconds();
    FP_ASSIGN_OR_RETURN(ImportedScene imported, ImportScene(asset, options));
    FP_RETURN_IF_ERROR(ApplyOverrides(spec.overrides, asset, imported.scene));
    result.made_up_camera = imported.scene.cameras.empty();
    EnsureCameraAndLight(imported);
    constexpr auto kImport = static_cast<size_t>(Stage::kImport);
    result.stats.seconds[kImport] += ThreadCpuSeconds() - cpu_start;
    result.stats.wall_seconds[kImport] +=
        std::chrono::duration<double>(clock.Now() - start).count();
    FP_RETURN_IF_ERROR(CheckNotStopped(cancel));

    FP_ASSIGN_OR_RETURN(result.blobs,
                        farpoint::Bake(imported.scene, spec.settings, executor_, result.stats));
    FP_RETURN_IF_ERROR(CheckNotStopped(cancel));
    result.cameras = std::move(imported.scene.cameras);
    result.notes = std::move(imported.notes);
    result.animated = imported.animation.has_value();
    return result;
  }

 private:
  Executor executor_;
};

void HashPart(Sha256& hash, std::string_view part) {
  hash.UpdateU64(part.size());
  hash.Update(part);
}

}  // namespace

std::shared_ptr<SceneBaker> MakeCoreBaker(unsigned threads) {
  return std::make_shared<CoreBaker>(threads);
}

Digest BakeKey(const JobSpec& spec) {
  JobSpec relevant;
  relevant.asset_root = spec.asset_root;
  relevant.asset_files = spec.asset_files;
  relevant.overrides = spec.overrides;
  relevant.light_units = spec.light_units;
  relevant.settings = spec.settings;
  // What only tiles need. fpbgi, pbgi and dpbgi share surfels and tree; pt has none.
  RenderSettings& s = relevant.settings;
  const RenderSettings any;
  if (s.integrator != Integrator::kPt) s.integrator = any.integrator;
  s.spp = any.spp;
  s.filter = any.filter;
  s.filter_width_px = any.filter_width_px;
  s.paths = any.paths;
  s.microbuffer = any.microbuffer;
  s.buffer_map = any.buffer_map;
  s.splat = any.splat;
  s.clusters = any.clusters;
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

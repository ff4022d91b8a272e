#include "core/render/bake.h"

#include <chrono>

#include "core/accel/ray_accel.h"
#include "core/base/clock.h"
#include "core/light/light_sampler.h"
#include "core/pbgi/point_tree.h"
#include "core/pbgi/surfel_sampler.h"
#include "core/pbgi/surfel_shader.h"
#include "core/scene/prepared_scene.h"

namespace farpoint {

namespace {

// Wall seconds of a stage; its thread-seconds are bounded by wall × threads and reported as the
// process's processor time over the stage.
class StageTimer {
 public:
  StageTimer(Stats& stats, Stage stage)
      : stats_(stats),
        stage_(static_cast<int>(stage)),
        wall_(std::chrono::steady_clock::now()),
        cpu_(ProcessCpuSeconds()) {}
  ~StageTimer() {
    stats_.wall_seconds[stage_] +=
        std::chrono::duration<double>(std::chrono::steady_clock::now() - wall_).count();
    stats_.seconds[stage_] += ProcessCpuSeconds() - cpu_;
  }

 private:
  Stats& stats_;
  int stage_;
  std::chrono::steady_clock::time_point wall_;
  double cpu_;
};

}  // namespace

absl::StatusOr<BakedScene> Bake(const Scene& scene, const RenderSettings& settings,
                                Executor& executor, Stats& stats) {
  FP_RETURN_IF_ERROR(ValidateSettings(settings));
  BakedScene baked;
  std::shared_ptr<const PreparedScene> prepared;
  std::shared_ptr<const RayAccel> accel;
  {
    StageTimer timer(stats, Stage::kImport);
    FP_ASSIGN_OR_RETURN(prepared, PreparedScene::Prepare(scene, executor));
    baked.prepared_scene = prepared->blob();
  }
  stats.counts["triangles"] = prepared->triangles().size();
  stats.bytes["scene"] = baked.prepared_scene.size();
  if (settings.integrator == Integrator::kPt) return baked;

  {
    StageTimer timer(stats, Stage::kImport);
    FP_ASSIGN_OR_RETURN(accel, RayAccel::Build(prepared));
  }
  const LightSampler lights(accel);
  SurfelCloud cloud;
  if (lights.any_light() || settings.no_skip) {
    StageTimer timer(stats, Stage::kSample);
    const uint64_t count = settings.points != 0 ? settings.points : DefaultSurfelCount(*prepared);
    cloud = SampleSurfels(*prepared, count, settings.seed, executor);
  } else {
    ++stats.skipped["bakes_without_light"];
  }
  SurfelShading shading;
  {
    StageTimer timer(stats, Stage::kShade);
    ShadeOptions options;
    options.light_samples = settings.light_samples;
    options.seed = settings.seed;
    options.no_skip = settings.no_skip;
    shading = ShadeSurfels(cloud, *accel, lights, options, executor, stats);
  }
  {
    StageTimer timer(stats, Stage::kTree);
    PointTree::Blobs blobs = PointTree::Build(cloud, shading, executor);
    baked.tree_topology = std::move(blobs.topology);
    baked.tree_radiance = std::move(blobs.radiance);
  }
  stats.counts["surfels"] = cloud.size();
  stats.bytes["tree"] = baked.tree_topology.size() + baked.tree_radiance.size();
  FP_ASSIGN_OR_RETURN(const auto tree,
                      PointTree::FromBlobs(baked.tree_topology, baked.tree_radiance));
  stats.counts["nodes"] = tree->node_count();
  return baked;
}

}  // namespace farpoint

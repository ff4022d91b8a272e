// path_tracer/against_embree/SCENE   irradiance of receivers all over the frame, 64 paths each, by
//                                    turns with the same rays as bare calls of Embree; SCENE is
//                                    cornell, and sponza where FARPOINT_SCENES has it
#include <cstdlib>
#include <filesystem>
#include <string>

#include "bench/bench_scene.h"
#include "bench/micro_workload.h"
#include "core/base/clock.h"
#include "core/math/sampling.h"
#include "core/render/camera_rays.h"
#include "core/render/path_tracer.h"
#include "core/render/record_gatherer.h"

namespace farpoint {

namespace {

constexpr uint32_t kPaths = 64;
constexpr uint64_t kSeed = 1;

struct Workload {
  std::shared_ptr<const RayAccel> accel;
  std::unique_ptr<const LightSampler> lights;
  std::vector<Receiver> receivers;
  std::vector<TracedRay> rays;  // of all receivers, as pt traces them
  size_t hits = 0;
};

absl::StatusOr<Workload> Make(const std::string& name, const SceneChanges& changes, int side,
                              Executor& executor) {
  Workload work;
  FP_ASSIGN_OR_RETURN(const BenchScene source, MakeBenchScene(name, false, changes));
  FP_ASSIGN_OR_RETURN(const auto scene, PreparedScene::Prepare(source.scene, executor));
  FP_ASSIGN_OR_RETURN(work.accel, RayAccel::Build(scene));
  work.lights = std::make_unique<LightSampler>(work.accel);
  const FilmSpec film{side, side, {0, 0, side, side}};
  const CameraRays camera(source.scene.cameras.front(), film, scene->origin());
  for (int y = 0; y < side; ++y) {
    for (int x = 0; x < side; ++x) {
      const Vec3f w = camera.Direction(x + 0.5, y + 0.5);
      const std::optional<RayHit> hit = work.accel->Intersect(camera.eye(), w);
      if (hit) work.receivers.push_back(ReceiverOfHit(*work.accel, *hit, w));
    }
  }
  FP_ASSIGN_OR_RETURN(const auto recorder, RayAccel::Build(scene, &work.rays));
  const LightSampler lights(recorder);
  LightCounters counters;
  uint64_t path_rays = 0;
  for (size_t i = 0; i < work.receivers.size(); ++i) {
    TraceIndirect(*recorder, lights, work.receivers[i], kPaths, 1, HashKey(kSeed, i), counters,
                  path_rays);
  }
  // A shadow ray that ends where it starts counts, but is not traced.
  if (work.rays.size() > path_rays + counters.rays || work.rays.empty()) {
    return absl::InternalError("pt traces rays that it does not count");
  }
  work.hits = work.accel->TraceBare(work.rays);
  return work;
}

void AgainstEmbree(benchmark::State& state, const std::string& name, const SceneChanges& changes,
                   int side, Executor& executor) {
  const absl::StatusOr<Workload> work = Make(name, changes, side, executor);
  if (!work.ok()) {
    state.SkipWithError(std::string(work.status().message()).c_str());
    return;
  }
  double traced_s = 0, bare_s = 0;
  double count = 0;
  for (auto _ : state) {
    const double start = ThreadCpuSeconds();
    LightCounters counters;
    uint64_t rays = 0;
    for (size_t i = 0; i < work->receivers.size(); ++i) {
      benchmark::DoNotOptimize(TraceIndirect(*work->accel, *work->lights, work->receivers[i],
                                             kPaths, 1, HashKey(kSeed, i), counters, rays));
    }
    const double middle = ThreadCpuSeconds();
    const size_t hits = work->accel->TraceBare(work->rays);
    const double end = ThreadCpuSeconds();
    if (hits != work->hits) state.SkipWithError("the same rays hit otherwise");
    traced_s += middle - start;
    bare_s += end - middle;
    count += static_cast<double>(work->rays.size());
  }
  state.counters["pt_rays_per_s"] = count / traced_s;
  state.counters["embree_rays_per_s"] = count / bare_s;
  state.counters["pt_over_embree"] = bare_s / traced_s;
}

}  // namespace

void RegisterPathTracerBenchmarks(MicroWorkload& work) {
  const bool quick = work.quick;
  const int side = quick ? 8 : 32;
  benchmark::RegisterBenchmark("path_tracer/against_embree/cornell", [&work,
                                                                      side](benchmark::State& s) {
    AgainstEmbree(s, "cornell", {}, side, work.executor);
  })->Unit(benchmark::kMillisecond);
  const char* folder = std::getenv("FARPOINT_SCENES");
  if (quick || folder == nullptr) return;
  const std::string sponza = (std::filesystem::path(folder) / "sponza/Sponza.gltf").string();
  std::error_code error;
  if (!std::filesystem::exists(sponza, error)) return;
  const SceneChanges changes{.sun = AccuracySun{{0.3, 1, 0.1}, Rgb(10, 10, 10)},
                             .view = AccuracyView{{9, 0.8, -0.3}, {-8, 4, -0.3}, 57}};
  benchmark::RegisterBenchmark("path_tracer/against_embree/sponza", [=,
                                                                     &work](benchmark::State& s) {
    AgainstEmbree(s, sponza, changes, side, work.executor);
  })->Unit(benchmark::kMillisecond);
}

}  // namespace farpoint

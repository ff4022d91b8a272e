// surfel_sampler/sample   blue-noise surfels over the whole scene
// surfel_shader/open_sides  which sides do not lie inside a closed object, 1 to 4 rays a side
// surfel_shader/shade     direct light on both sides of each, 4 shadow rays a light (16 / 4)
#include "bench/micro_workload.h"

namespace farpoint {

namespace {

void Sample(benchmark::State& state, MicroWorkload& work) {
  size_t surfels = 0;
  for (auto _ : state) {
    surfels =
        SampleSurfels(work.description, *work.scene, work.surfel_count, 1, work.executor).size();
  }
  SetRate(state, "surfels_per_s",
          static_cast<double>(surfels) * static_cast<double>(state.iterations()));
}

void OpenSides(benchmark::State& state, MicroWorkload& work) {
  Stats stats;
  for (auto _ : state) {
    benchmark::DoNotOptimize(
        FindOpenSides(work.cloud, *work.accel, work.shade.seed, work.executor, stats));
  }
  const double tested =
      static_cast<double>(work.cloud.size()) * static_cast<double>(state.iterations());
  SetRate(state, "surfels_per_s", tested);
  SetRate(state, "rays_per_s", static_cast<double>(stats.counts["interior_rays"]));
}

void Shade(benchmark::State& state, MicroWorkload& work) {
  Stats stats;
  for (auto _ : state) {
    benchmark::DoNotOptimize(ShadeSurfels(work.cloud, work.open_sides, *work.accel, *work.lights,
                                          work.shade, work.executor, stats));
  }
  const double shaded =
      static_cast<double>(work.cloud.size()) * static_cast<double>(state.iterations());
  const double rays = static_cast<double>(stats.counts["shadow_rays"]);
  SetRate(state, "surfels_per_s", shaded);
  SetRate(state, "rays_per_s", rays);
  state.counters["rays_per_surfel"] = shaded > 0 ? rays / shaded : 0;
}

}  // namespace

void RegisterSurfelBenchmarks(MicroWorkload& work) {
  benchmark::RegisterBenchmark("surfel_sampler/sample", [&](benchmark::State& s) {
    Sample(s, work);
  })->Unit(benchmark::kMillisecond);
  benchmark::RegisterBenchmark("surfel_shader/open_sides", [&](benchmark::State& s) {
    OpenSides(s, work);
  })->Unit(benchmark::kMillisecond);
  benchmark::RegisterBenchmark("surfel_shader/shade", [&](benchmark::State& s) {
    Shade(s, work);
  })->Unit(benchmark::kMillisecond);
}

}  // namespace farpoint

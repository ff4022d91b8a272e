// ray_accel/intersect/coherent     nearest hit of a block's primary rays, in raster order
// ray_accel/intersect/incoherent   of cosine-distributed rays from the block's receivers
// ray_accel/occluded/incoherent    any hit of the same rays
#include "bench/micro_workload.h"

namespace farpoint {

namespace {

void Intersect(benchmark::State& state, const MicroWorkload& work,
               const std::vector<MicroRay>& rays) {
  size_t hits = 0;
  for (auto _ : state) {
    hits = 0;
    for (const MicroRay& r : rays) hits += work.accel->Intersect(r.origin, r.direction).has_value();
    benchmark::DoNotOptimize(hits);
  }
  SetRate(state, "rays_per_s",
          static_cast<double>(rays.size()) * static_cast<double>(state.iterations()));
  state.counters["hit_fraction"] = static_cast<double>(hits) / static_cast<double>(rays.size());
}

void Occluded(benchmark::State& state, const MicroWorkload& work,
              const std::vector<MicroRay>& rays) {
  size_t hits = 0;
  for (auto _ : state) {
    hits = 0;
    for (const MicroRay& r : rays) hits += work.accel->Occluded(r.origin, r.direction);
    benchmark::DoNotOptimize(hits);
  }
  SetRate(state, "rays_per_s",
          static_cast<double>(rays.size()) * static_cast<double>(state.iterations()));
  state.counters["hit_fraction"] = static_cast<double>(hits) / static_cast<double>(rays.size());
}

}  // namespace

void RegisterRayAccelBenchmarks(const MicroWorkload& work) {
  benchmark::RegisterBenchmark("ray_accel/intersect/coherent", [&](benchmark::State& s) {
    Intersect(s, work, work.coherent);
  })->Unit(benchmark::kMicrosecond);
  benchmark::RegisterBenchmark("ray_accel/intersect/incoherent", [&](benchmark::State& s) {
    Intersect(s, work, work.incoherent);
  })->Unit(benchmark::kMicrosecond);
  benchmark::RegisterBenchmark("ray_accel/occluded/incoherent", [&](benchmark::State& s) {
    Occluded(s, work, work.incoherent);
  })->Unit(benchmark::kMicrosecond);
}

}  // namespace farpoint

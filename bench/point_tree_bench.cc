// point_tree/build   sort, hierarchy and blobs from shaded surfels
// point_tree/view    checking the blobs and viewing them in place, as a worker does
#include "bench/micro_workload.h"

namespace farpoint {

namespace {

void Build(benchmark::State& state, MicroWorkload& work) {
  size_t bytes = 0;
  for (auto _ : state) {
    const PointTree::Blobs blobs = PointTree::Build(work.cloud, work.shading, work.executor);
    bytes = blobs.topology.size() + blobs.radiance.size();
  }
  const double surfels = static_cast<double>(work.cloud.size());
  SetRate(state, "surfels_per_s", surfels * static_cast<double>(state.iterations()));
  state.counters["bytes_per_surfel"] = static_cast<double>(bytes) / surfels;
}

void View(benchmark::State& state, const MicroWorkload& work) {
  for (auto _ : state) {
    const auto tree = PointTree::FromBlobs(work.blobs.topology, work.blobs.radiance);
    if (!tree.ok()) {
      state.SkipWithError("the tree's own blobs were refused");
      break;
    }
    benchmark::DoNotOptimize(tree->get());
  }
  SetRate(state, "surfels_per_s",
          static_cast<double>(work.cloud.size()) * static_cast<double>(state.iterations()));
  SetRate(state, "bytes_per_s",
          static_cast<double>(work.tree->size_bytes()) * static_cast<double>(state.iterations()));
}

}  // namespace

void RegisterPointTreeBenchmarks(MicroWorkload& work) {
  benchmark::RegisterBenchmark("point_tree/build", [&](benchmark::State& s) {
    Build(s, work);
  })->Unit(benchmark::kMillisecond);
  benchmark::RegisterBenchmark("point_tree/view", [&](benchmark::State& s) {
    View(s, work);
  })->Unit(benchmark::kMillisecond);
}

}  // namespace farpoint

// point_tree/build   sort, hierarchy and blobs from shaded surfels
// point_tree/view    checking the blobs and viewing them in place, as a worker does
// point_tree/against_embree   building the tree of a million surfels, by turns with rtcBuildBVH
//                             over their discs' boxes, one thread each
#include <algorithm>
#include <cmath>
#include <string>
#include <vector>

#include "bench/micro_workload.h"
#include "core/accel/bare_bvh.h"
#include "core/base/clock.h"
#include "core/pbgi/surfel_sampler.h"

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

// Boxes of discs.
std::vector<Box3f> BoxesOf(const SurfelCloud& cloud) {
  std::vector<Box3f> boxes(cloud.size());
  for (size_t i = 0; i < cloud.size(); ++i) {
    const float radius = std::sqrt(cloud.area_m2[i] * 0.31830989f);
    const Vec3f& n = cloud.normal[i];
    const Vec3f half = Vec3f(std::sqrt(std::max(0.0f, 1.0f - n.x * n.x)),
                             std::sqrt(std::max(0.0f, 1.0f - n.y * n.y)),
                             std::sqrt(std::max(0.0f, 1.0f - n.z * n.z))) *
                       radius;
    boxes[i].min = cloud.position[i] - half;
    boxes[i].max = cloud.position[i] + half;
  }
  return boxes;
}

void AgainstEmbree(benchmark::State& state, MicroWorkload& work) {
  const uint64_t count = work.quick ? 5'000 : 1'000'000;
  const SurfelCloud cloud = SampleSurfels(work.description, *work.scene, count, 1, work.executor);
  SurfelShading shading;
  shading.front.assign(cloud.size(), Rgb(1, 1, 1));
  shading.back.assign(cloud.size(), Rgb());
  shading.visible_sides.assign(cloud.size(), kFrontVisible | kBackVisible);
  const std::vector<Box3f> boxes = BoxesOf(cloud);
  const auto embree = BareBvh::Create(work.executor.threads());
  if (!embree.ok()) {
    state.SkipWithError(std::string(embree.status().message()).c_str());
    return;
  }
  double tree_s = 0, medium_s = 0, low_s = 0;
  size_t bytes = 0;
  for (auto _ : state) {
    const double start = ProcessCpuSeconds();
    const PointTree::Blobs blobs = PointTree::Build(cloud, shading, work.executor);
    bytes = blobs.topology.size() + blobs.radiance.size();
    const double tree_end = ProcessCpuSeconds();
    const auto medium = (*embree)->Build(boxes, BareBvh::Quality::kMedium);
    const double medium_end = ProcessCpuSeconds();
    const auto low = (*embree)->Build(boxes, BareBvh::Quality::kLow);
    const double low_end = ProcessCpuSeconds();
    if (!medium.ok() || !low.ok()) {
      state.SkipWithError("Embree built no hierarchy");
      return;
    }
    tree_s += tree_end - start;
    medium_s += medium_end - tree_end;
    low_s += low_end - medium_end;
  }
  const double surfels =
      static_cast<double>(cloud.size()) * static_cast<double>(state.iterations());
  state.counters["surfels_per_s"] = surfels / tree_s;
  state.counters["embree_medium_per_s"] = surfels / medium_s;
  state.counters["embree_low_per_s"] = surfels / low_s;
  state.counters["time_over_embree_medium"] = tree_s / medium_s;
  state.counters["time_over_embree_low"] = tree_s / low_s;
  state.counters["bytes_per_surfel"] =
      static_cast<double>(bytes) / static_cast<double>(cloud.size());
}

}  // namespace

void RegisterPointTreeBenchmarks(MicroWorkload& work) {
  benchmark::RegisterBenchmark("point_tree/build", [&](benchmark::State& s) {
    Build(s, work);
  })->Unit(benchmark::kMillisecond);
  benchmark::RegisterBenchmark("point_tree/against_embree", [&](benchmark::State& s) {
    AgainstEmbree(s, work);
  })->Unit(benchmark::kMillisecond);
  benchmark::RegisterBenchmark("point_tree/view", [&](benchmark::State& s) {
    View(s, work);
  })->Unit(benchmark::kMillisecond);
}

}  // namespace farpoint

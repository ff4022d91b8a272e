// What the kernels work on, made once: the Cornell box as the renderer sees it. *_bench.cc read it,
// and nothing in it changes afterwards.
#pragma once

#include <benchmark/benchmark.h>

#include <cstdint>
#include <memory>
#include <vector>

#include "core/accel/ray_accel.h"
#include "core/base/executor.h"
#include "core/light/light_sampler.h"
#include "core/pbgi/microbuffer_map.h"
#include "core/pbgi/point_tree.h"
#include "core/pbgi/receiver_cluster.h"
#include "core/pbgi/surfel.h"
#include "core/pbgi/surfel_sampler.h"
#include "core/pbgi/surfel_shader.h"
#include "core/pbgi/tree_cut.h"
#include "core/scene/prepared_scene.h"

namespace farpoint {

struct MicroRay {
  Vec3f origin, direction;
};

// A view of a cluster with what its cut leaves near, and the views of its members.
struct ClusterViews {
  CutView view;
  PackedNearNodes near;
  std::vector<CutView> members;
};

struct MicroWorkload {
  // 100,000 surfels and the middle block of 256x256 pixels; quick: 5,000, of 64x64.
  static absl::StatusOr<std::unique_ptr<MicroWorkload>> Make(bool quick);

  bool quick = false;
  Executor executor{1};
  uint64_t surfel_count = 0;  // asked for
  ShadeOptions shade;
  Scene description;
  std::shared_ptr<const PreparedScene> scene;
  std::shared_ptr<const RayAccel> accel;
  std::unique_ptr<const LightSampler> lights;
  SurfelCloud cloud;
  SurfelSides open_sides;
  SurfelShading shading;
  PointTree::Blobs blobs;
  std::shared_ptr<const PointTree> tree;

  std::vector<Receiver> receivers;          // of one block, at most 1024
  ClusterParams cluster_params;             // k = 100
  std::vector<CutView> receiver_views;      // one per receiver
  std::vector<ClusterViews> cluster_views;  // clusters of more than one receiver
  MicrobufferMap octahedral{BufferMap::kOctahedral, 32}, cosine{BufferMap::kCosine, 32};

  std::vector<MicroRay> coherent;    // primary rays of the block, in raster order
  std::vector<MicroRay> incoherent;  // cosine-distributed, eight from each receiver

  const MicrobufferMap& map(BufferMap kind) const {
    return kind == BufferMap::kOctahedral ? octahedral : cosine;
  }
  CutParams cut_params(BufferMap kind) const {
    return {0.1f, kind, map(kind).reference_solid_angle()};
  }
};

inline constexpr const char* NameOf(BufferMap kind) {
  return kind == BufferMap::kOctahedral ? "octahedral" : "cosine";
}

// A counter of events per second of processor time; `name` ends in _per_s.
inline void SetRate(benchmark::State& state, const char* name, double events) {
  state.counters[name] = benchmark::Counter(events, benchmark::Counter::kIsRate);
}

// Each adds the benchmarks of one unit. The workload must outlive the run.
void RegisterReceiverClusterBenchmarks(const MicroWorkload& work);
void RegisterTreeCutBenchmarks(const MicroWorkload& work);
void RegisterMicrobufferBenchmarks(const MicroWorkload& work);
void RegisterPointTreeBenchmarks(MicroWorkload& work);
void RegisterSurfelBenchmarks(MicroWorkload& work);
void RegisterRayAccelBenchmarks(const MicroWorkload& work);
void RegisterPathTracerBenchmarks(MicroWorkload& work);

}  // namespace farpoint

// tree_cut/alone/MAP   the cut of one receiver from the root (pbgi), the block's receivers in turn
// tree_cut/cluster     the cut shared by a cluster (§3.2), far and near, the clusters in turn
// tree_cut/receiver    a receiver's own cut below its cluster's near nodes (§3.3)
// tree_cut/same_cuts   the cuts of alone, and the same by the call for clusters, by turns
// tree_cut/pack        copying a cluster's near nodes into groups
// tree_cut/sort        ordering a receiver's cut from the root front to back
#include <algorithm>

#include "bench/micro_workload.h"
#include "core/base/clock.h"

namespace farpoint {

namespace {

void SetCutCounters(benchmark::State& state, double receivers_or_clusters, const char* rate,
                    const CutCounters& counters, size_t nodes) {
  const double n = std::max(1.0, static_cast<double>(state.iterations()));
  SetRate(state, rate, receivers_or_clusters);
  SetRate(state, "node_groups_per_s", static_cast<double>(counters.groups_visited));
  state.counters["node_groups_per_cut"] = static_cast<double>(counters.groups_visited) / n;
  state.counters["nodes_per_cut"] = static_cast<double>(nodes) / n;
}

void Alone(benchmark::State& state, const MicroWorkload& work, BufferMap map) {
  const CutParams params = work.cut_params(map);
  std::vector<CutNode> cut;
  CutCounters counters;
  size_t i = 0, nodes = 0;
  for (auto _ : state) {
    cut.clear();
    ComputeClusterCut(*work.tree, work.receiver_views[i], params, cut, nullptr, counters);
    nodes += cut.size();
    if (++i == work.receiver_views.size()) i = 0;
  }
  SetCutCounters(state, static_cast<double>(state.iterations()), "receivers_per_s", counters,
                 nodes);
}

void Cluster(benchmark::State& state, const MicroWorkload& work) {
  const CutParams params = work.cut_params(BufferMap::kOctahedral);
  std::vector<CutNode> far;
  std::vector<NearNode> near;
  CutCounters counters;
  size_t i = 0, nodes = 0;
  for (auto _ : state) {
    far.clear();
    near.clear();
    ComputeClusterCut(*work.tree, work.cluster_views[i].view, params, far, &near, counters);
    nodes += far.size() + near.size();
    if (++i == work.cluster_views.size()) i = 0;
  }
  SetCutCounters(state, static_cast<double>(state.iterations()), "clusters_per_s", counters, nodes);
}

// The cuts of pbgi's receivers, and the same by the call that fpbgi's clusters make, by turns.
void SameCuts(benchmark::State& state, const MicroWorkload& work) {
  const CutParams params = work.cut_params(BufferMap::kOctahedral);
  std::vector<CutNode> pbgi, fpbgi;
  std::vector<NearNode> near;
  CutCounters pbgi_counters, fpbgi_counters;
  double pbgi_s = 0, fpbgi_s = 0;
  for (auto _ : state) {
    // A pass over all receivers each: reading the clock costs nothing then.
    const double start = ThreadCpuSeconds();
    for (const CutView& view : work.receiver_views) {
      pbgi.clear();
      ComputeClusterCut(*work.tree, view, params, pbgi, nullptr, pbgi_counters);
    }
    const double middle = ThreadCpuSeconds();
    for (const CutView& view : work.receiver_views) {
      fpbgi.clear();
      near.clear();
      ComputeClusterCut(*work.tree, view, params, fpbgi, &near, fpbgi_counters);
    }
    const double end = ThreadCpuSeconds();
    pbgi_s += middle - start;
    fpbgi_s += end - middle;
  }
  // What has no far side is near, for a cluster of one too.
  if (pbgi_counters.groups_visited != fpbgi_counters.groups_visited ||
      pbgi.size() != fpbgi.size() + near.size()) {
    state.SkipWithError("the two made different cuts");
    return;
  }
  const double groups = static_cast<double>(pbgi_counters.groups_visited);
  state.counters["pbgi_node_groups_per_s"] = groups / pbgi_s;
  state.counters["fpbgi_node_groups_per_s"] = groups / fpbgi_s;
  state.counters["pbgi_over_fpbgi"] = fpbgi_s / pbgi_s;
}

void ReceiverCut(benchmark::State& state, const MicroWorkload& work) {
  const CutParams params = work.cut_params(BufferMap::kOctahedral);
  std::vector<CutNode> cut;
  CutCounters counters;
  size_t c = 0, m = 0, nodes = 0;
  for (auto _ : state) {
    const ClusterViews& views = work.cluster_views[c];
    cut.clear();
    ComputeReceiverCut(*work.tree, views.members[m], params, views.near, cut, counters);
    nodes += cut.size();
    if (++m == views.members.size()) {
      m = 0;
      if (++c == work.cluster_views.size()) c = 0;
    }
  }
  SetCutCounters(state, static_cast<double>(state.iterations()), "receivers_per_s", counters,
                 nodes);
}

void Pack(benchmark::State& state, const MicroWorkload& work) {
  PackedNearNodes packed;
  size_t i = 0, nodes = 0;
  for (auto _ : state) {
    const std::vector<NearNode>& near = work.cluster_views[i].near.nodes;
    packed.Pack(*work.tree, near);
    benchmark::DoNotOptimize(packed.groups.data());
    nodes += near.size();
    if (++i == work.cluster_views.size()) i = 0;
  }
  SetRate(state, "nodes_per_s", static_cast<double>(nodes));
}

void Sort(benchmark::State& state, const MicroWorkload& work) {
  std::vector<CutNode> unsorted, scratch;
  CutCounters counters;
  ComputeClusterCut(*work.tree, work.receiver_views.front(),
                    work.cut_params(BufferMap::kOctahedral), unsorted, nullptr, counters);
  // Fresh copies for many calls at once, so that stopping the clock costs next to nothing.
  std::vector<std::vector<CutNode>> copies(64);
  size_t i = copies.size();
  for (auto _ : state) {
    if (i == copies.size()) {
      state.PauseTiming();
      for (std::vector<CutNode>& copy : copies) copy = unsorted;
      i = 0;
      state.ResumeTiming();
    }
    SortFrontToBack(copies[i++], scratch);
    benchmark::ClobberMemory();
  }
  SetRate(state, "nodes_per_s",
          static_cast<double>(unsorted.size()) * static_cast<double>(state.iterations()));
  state.counters["nodes_per_cut"] = static_cast<double>(unsorted.size());
}

}  // namespace

void RegisterTreeCutBenchmarks(const MicroWorkload& work) {
  for (const BufferMap map : {BufferMap::kOctahedral, BufferMap::kCosine}) {
    benchmark::RegisterBenchmark((std::string("tree_cut/alone/") + NameOf(map)).c_str(),
                                 [&work, map](benchmark::State& s) { Alone(s, work, map); });
  }
  benchmark::RegisterBenchmark("tree_cut/cluster", [&](benchmark::State& s) { Cluster(s, work); });
  benchmark::RegisterBenchmark("tree_cut/receiver",
                               [&](benchmark::State& s) { ReceiverCut(s, work); });
  benchmark::RegisterBenchmark("tree_cut/same_cuts", [&](benchmark::State& s) {
    SameCuts(s, work);
  })->Unit(benchmark::kMillisecond);
  benchmark::RegisterBenchmark("tree_cut/pack", [&](benchmark::State& s) { Pack(s, work); });
  benchmark::RegisterBenchmark("tree_cut/sort", [&](benchmark::State& s) { Sort(s, work); });
}

}  // namespace farpoint

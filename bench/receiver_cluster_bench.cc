// receiver_cluster/assign    each receiver of a block to the nearest of k = 100 first centres
// receiver_cluster/cluster   the whole of §3.1: k-means, re-seeding, splitting
#include "bench/micro_workload.h"

namespace farpoint {

namespace {

void Assign(benchmark::State& state, const MicroWorkload& work) {
  for (auto _ : state) {
    benchmark::DoNotOptimize(AssignClusters(work.receivers, work.cluster_params));
  }
  SetRate(state, "receivers_per_s",
          static_cast<double>(work.receivers.size()) * static_cast<double>(state.iterations()));
}

void Cluster(benchmark::State& state, const MicroWorkload& work) {
  size_t clusters = 0;
  for (auto _ : state) clusters = ClusterReceivers(work.receivers, work.cluster_params).size();
  SetRate(state, "receivers_per_s",
          static_cast<double>(work.receivers.size()) * static_cast<double>(state.iterations()));
  state.counters["clusters"] = static_cast<double>(clusters);
}

}  // namespace

void RegisterReceiverClusterBenchmarks(const MicroWorkload& work) {
  benchmark::RegisterBenchmark("receiver_cluster/assign",
                               [&](benchmark::State& s) { Assign(s, work); });
  benchmark::RegisterBenchmark("receiver_cluster/cluster",
                               [&](benchmark::State& s) { Cluster(s, work); });
}

}  // namespace farpoint

// microbuffer/map/MAP               the table of a 32x32 map
// microbuffer/rasterize/MAP/SPLAT   clearing a buffer and drawing the sorted cut of one receiver
// microbuffer/convolve/MAP/SPLAT            one buffer to irradiance
// microbuffer/convolve_near/MAP/SPLAT       a far and a near buffer, composited on the way
#include <algorithm>
#include <string>

#include "bench/micro_workload.h"
#include "core/pbgi/microbuffer.h"

namespace farpoint {

namespace {

// Cuts of receivers spread over the block.
constexpr size_t kViews = 16;

struct SortedCut {
  CutView view;
  std::vector<CutNode> nodes;
};

std::vector<SortedCut> MakeCuts(const MicroWorkload& work, BufferMap map) {
  std::vector<SortedCut> cuts;
  std::vector<CutNode> scratch;
  CutCounters counters;
  const size_t stride = std::max<size_t>(1, work.receiver_views.size() / kViews);
  for (size_t i = 0; i < work.receiver_views.size() && cuts.size() < kViews; i += stride) {
    SortedCut& cut = cuts.emplace_back();
    cut.view = work.receiver_views[i];
    ComputeClusterCut(*work.tree, cut.view, work.cut_params(map), cut.nodes, nullptr, counters);
    SortFrontToBack(cut.nodes, scratch);
  }
  return cuts;
}

void MakeMap(benchmark::State& state, BufferMap map) {
  for (auto _ : state) {
    const MicrobufferMap made(map, 32);
    benchmark::DoNotOptimize(made.solid_angle());
  }
  SetRate(state, "pixels_per_s", 32.0 * 32.0 * static_cast<double>(state.iterations()));
}

void Rasterize(benchmark::State& state, const MicroWorkload& work, BufferMap map, Splat splat) {
  const std::vector<SortedCut> cuts = MakeCuts(work, map);
  Microbuffer buffer(work.map(map));
  RasterCounters counters;
  size_t i = 0;
  for (auto _ : state) {
    buffer.Clear();
    RasterizeCut(*work.tree, cuts[i].view, cuts[i].nodes, splat, buffer, counters);
    benchmark::ClobberMemory();
    if (++i == cuts.size()) i = 0;
  }
  const double n = std::max(1.0, static_cast<double>(state.iterations()));
  SetRate(state, "buffers_per_s", n);
  SetRate(state, "splats_per_s", static_cast<double>(counters.splats));
  state.counters["splats_per_buffer"] = static_cast<double>(counters.splats) / n;
}

void Convolve(benchmark::State& state, const MicroWorkload& work, BufferMap map, Splat splat,
              bool with_near) {
  const std::vector<SortedCut> cuts = MakeCuts(work, map);
  const SortedCut& cut = cuts.front();
  Microbuffer far(work.map(map)), near(work.map(map));
  RasterCounters counters;
  // The nearest quarter of the cut is the near buffer.
  const std::span<const CutNode> nodes = cut.nodes;
  const size_t quarter = with_near ? nodes.size() / 4 : 0;
  RasterizeCut(*work.tree, cut.view, nodes.subspan(quarter), splat, far, counters);
  RasterizeCut(*work.tree, cut.view, nodes.first(quarter), splat, near, counters);
  for (auto _ : state) {
    benchmark::DoNotOptimize(
        ConvolveCosine(far, with_near ? &near : nullptr, cut.view.normal, splat));
  }
  SetRate(state, "receivers_per_s", static_cast<double>(state.iterations()));
}

}  // namespace

void RegisterMicrobufferBenchmarks(const MicroWorkload& work) {
  for (const BufferMap map : {BufferMap::kOctahedral, BufferMap::kCosine}) {
    benchmark::RegisterBenchmark((std::string("microbuffer/map/") + NameOf(map)).c_str(),
                                 [map](benchmark::State& s) { MakeMap(s, map); });
    for (const Splat splat : {Splat::kCoverage, Splat::kOpaque}) {
      const std::string kind =
          std::string(NameOf(map)) + "/" + (splat == Splat::kCoverage ? "coverage" : "opaque");
      benchmark::RegisterBenchmark(
          ("microbuffer/rasterize/" + kind).c_str(),
          [&work, map, splat](benchmark::State& s) { Rasterize(s, work, map, splat); });
      benchmark::RegisterBenchmark(
          ("microbuffer/convolve/" + kind).c_str(),
          [&work, map, splat](benchmark::State& s) { Convolve(s, work, map, splat, false); });
      benchmark::RegisterBenchmark(
          ("microbuffer/convolve_near/" + kind).c_str(),
          [&work, map, splat](benchmark::State& s) { Convolve(s, work, map, splat, true); });
    }
  }
}

}  // namespace farpoint

// What a view sees of the point tree, drawn into a microbuffer: cut, order, rasterization, and
// little of it for what lies behind a filled part of the buffer.
#pragma once

#include <optional>
#include <span>
#include <vector>

#include "core/pbgi/closed_pixels.h"
#include "core/pbgi/microbuffer.h"
#include "core/pbgi/microbuffer_map.h"
#include "core/pbgi/point_tree.h"
#include "core/pbgi/tree_cut.h"

namespace farpoint {

struct HiddenCounters {
  uint64_t nodes = 0;  // of cuts, not drawn: they touch closed pixels only
};

// One thread; one object serves many views, without allocating once it is warm.
class CutDrawer {
 public:
  // Asking pays where at least one node in so many is hidden.
  static constexpr size_t kWorthwhilePart = 8;

  // Parts of the work, for whoever measures.
  enum class Part { kCut, kRaster };

  // All must outlive this. `hide`: leaves out nodes and whole subtrees that touch closed pixels
  // only (core/pbgi/closed_pixels.h), as long as that pays. The irradiance that receivers of the
  // view convolve from the buffer is the same, bit by bit; pixels below their horizons are not. Of
  // no effect for the cosine map and for the smallest buffers.
  CutDrawer(const PointTree& tree, const MicrobufferMap& map, const CutParams& params, Splat splat,
            bool hide);

  // Clears `buffer` and draws the cut of ComputeClusterCut into it. `near` as there. Calls
  // charge(part) after each piece of work. The number of nodes in the cut.
  template <typename Charge>
  size_t Draw(const CutView& view, std::vector<NearNode>* near, Microbuffer& buffer,
              CutCounters& cut_counters, RasterCounters& raster_counters,
              HiddenCounters& hidden_counters, Charge&& charge) {
    buffer.Clear();
    cut_.clear();
    if (!Asks()) {
      ComputeClusterCut(tree_, view, params_, cut_, near, cut_counters);
      charge(Part::kCut);
      SortFrontToBack(cut_, scratch_);
      RasterizeCut(tree_, view, cut_, splat_, buffer, raster_counters);
      charge(Part::kRaster);
      return cut_.size();
    }
    size_t nodes = 0, left_out = 0;
    const uint64_t subtrees = cut_counters.hidden_subtrees;
    shells_.Start(view, near);
    const ClosedPixels* closed = nullptr;
    while (shells_.Next(closed, cut_, cut_counters)) {
      charge(Part::kCut);
      nodes += cut_.size();
      SortFrontToBack(cut_, scratch_);
      left_out += DrawSorted(view, buffer, raster_counters);
      cut_.clear();
      if (!shells_.done()) closed = Find(view, buffer, shells_.distance_m());
      charge(Part::kRaster);
    }
    hidden_counters.nodes += left_out;
    Learn(nodes, left_out, cut_counters.hidden_subtrees - subtrees);
    return nodes;
  }

 private:
  bool Asks() { return closed_ && idle_-- <= 0; }
  // Null if too little is closed for asking to pay.
  const ClosedPixels* Find(const CutView& view, const Microbuffer& buffer, float distance_m);
  // Draws cut_, less what is hidden. How many nodes that is.
  size_t DrawSorted(const CutView& view, Microbuffer& buffer, RasterCounters& counters);
  void Learn(size_t nodes, size_t left_out, uint64_t subtrees);

  const PointTree& tree_;
  const CutParams& params_;
  const Splat splat_;
  ShellCut shells_;
  std::optional<ClosedPixels> closed_;
  int idle_ = 0, next_idle_ = 0;  // views to come for which nothing is asked
  std::vector<CutNode> cut_, scratch_;
};

}  // namespace farpoint

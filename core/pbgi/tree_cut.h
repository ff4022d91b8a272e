// Tree cuts: the level of detail of the scene that a receiver, or a whole cluster, sees
// (paper §1.1, §3.2, §3.3).
#pragma once

#include <bit>
#include <cstdint>
#include <span>
#include <vector>

#include "core/math/vec.h"
#include "core/pbgi/gather_params.h"
#include "core/pbgi/point_tree.h"

namespace farpoint {

// Who looks: one receiver, or all receivers of a cluster at once. A single receiver is the cluster
// with radius 0, spread 0 and margin 0, so that both go through the same code.
struct CutView {
  Vec3f position;        // of the (active) receiver, relative to the scene's origin
  Vec3f normal;          // unit; the receiver's, or the cluster's mean
  float radius_m = 0;    // R_c: the farthest receiver from the active one
  float sin_spread = 0;  // of the largest angle between a receiver's normal and `normal`;
                         // 1 if that is 90° or more: then nothing lies below every horizon
  float cos_spread = 1;
  float margin_m = 0;  // max over receivers x of n_x·(p_active - p_x), at least 0: how far a
                       // horizon lies below the active receiver's
  // A receiver looks from the back of its own triangle: the sides that only such receivers can see
  // (core/pbgi/surfel.h) count as visible.
  bool sees_inside = false;
};

inline constexpr float kCutPixels = 4.0f;
// What rises above the horizon by no more than this sine is culled: quantised normals do not tell
// it from the plane that the receiver lies in. A ring of that height has its square, 4e-6, of the
// cosine-weighted hemisphere.
inline constexpr float kHorizonSine = 0x1p-9f;

// When to descend.
struct CutParams {
  // far: R_c < epsilon (d - r); near: R_c >= epsilon (d + r) (§3.2 with its erratum,
  // docs/paper-map.md: the measure γ = R_c / d is small for far nodes). What lies between is near
  // if it is fine enough or a surfel, else it descends.
  float epsilon = 0.1f;
  // A node is fine enough if its sphere's solid angle pi r²/d² is at most that of kCutPixels
  // pixels in its direction: a node is flat and seen at an angle, so what it covers is less.
  // kOctahedral: pixel_sr everywhere; kCosine: pixel_sr / cos theta.
  BufferMap map = BufferMap::kOctahedral;
  float pixel_sr = 0.01f;
  // Leave out what no receiver can see: nodes below all horizons, which changes what pixels hold
  // that a horizon cuts, and those of which only invisible sides are seen, which changes no bit of
  // a buffer.
  bool skip_below_horizon = true, skip_invisible_side = true;
};

// A node of a cut, with what drawing it needs: most nodes are drawn without a look into the tree.
struct CutNode {
  uint32_t slot;     // group * 8 + lane
  float distance_m;  // from the view's position to the node's centre
  Vec3f direction;   // unit, from the view to the node's centre, world
  // Ω = A_visible |n·w| / d² [sr]; negative if the node shows its back.
  float signed_solid_angle;
};

// A node where the traversal stopped because it is near some receiver of the cluster.
struct NearNode {
  uint32_t slot;
  int32_t level;
};

struct CutCounters {
  uint64_t groups_visited = 0;   // eight node tests each
  uint64_t below_horizon = 0;    // nodes culled: below every receiver's horizon
  uint64_t invisible_side = 0;   // nodes culled: only sides that cannot be seen
  uint64_t hidden_subtrees = 0;  // left out: they touch closed pixels only
};

// The cut seen from `view`, starting at the root: nodes that are fine enough, or surfels, appended
// to `far` in traversal order; with radius_m > 0, nodes too near to share appended to `near`.
// With radius 0 and no sharing wanted, pass near = nullptr: everything goes to `far`.
void ComputeClusterCut(const PointTree& tree, const CutView& view, const CutParams& params,
                       std::vector<CutNode>& far, std::vector<NearNode>* near,
                       CutCounters& counters);

// The cut of one receiver below the near nodes of its cluster's cut (§3.3).
// `near_groups` is the packed form of the near nodes (PackNearNodes).
struct PackedNearNodes {
  std::vector<NodeGroup> groups;  // copies, eight to a group, rest empty
  std::vector<NearNode> nodes;    // parallel to the lanes
  void Pack(const PointTree& tree, std::span<const NearNode> near);
};
void ComputeReceiverCut(const PointTree& tree, const CutView& view, const CutParams& params,
                        const PackedNearNodes& near, std::vector<CutNode>& cut,
                        CutCounters& counters);

class ClosedPixels;

// The cut of ComputeClusterCut in shells, from near to far. Between two shells the caller draws
// what he got and finds out which pixels are closed; subtrees that touch no other are left out.
//
// All nodes of a shell lie beyond those of the shells before, by what SortFrontToBack tells apart,
// and come in the order of ComputeClusterCut. So the shells, each sorted, are the sorted cut, less
// what is hidden. One thread; one object serves many views.
class ShellCut {
 public:
  // Both must outlive this.
  ShellCut(const PointTree& tree, const CutParams& params);

  // `near` as of ComputeClusterCut; must outlive the shells.
  void Start(const CutView& view, std::vector<NearNode>* near);
  // Appends the next shell to `cut`, which may come out empty; the first holds all near nodes.
  // False: there is none. `closed` (null: nothing is) must hold for distances from distance_m() on.
  bool Next(const ClosedPixels* closed, std::vector<CutNode>& cut, CutCounters& counters);
  // The least distance of what is to come.
  float distance_m() const { return distance_m_; }
  bool done() const { return items_.empty(); }

 private:
  // A node of the cut, or (level >= 0) a group still to be visited: node.slot is the group,
  // node.distance_m a bound below the distances of all nodes in it.
  struct Item {
    CutNode node;
    int32_t level;
  };

  const PointTree& tree_;
  const CutParams& params_;
  std::vector<float> ends_m_;  // of the shells but the last
  CutView view_;
  std::vector<NearNode>* near_ = nullptr;
  size_t shell_ = 0;
  float distance_m_ = 0;
  std::vector<Item> items_, later_;  // in the order of ComputeClusterCut
  std::vector<CutNode> beyond_;
};

// The literal, slow version of both: one node at a time, recursive, straight from the paper and
// the rules above. The oracle of the tests.
void ComputeClusterCutLiteral(const PointTree& tree, const CutView& view, const CutParams& params,
                              std::vector<CutNode>& far, std::vector<NearNode>* near);

// Orders a cut front to back: by distance to within 2^-7, ties by traversal order. Stable and
// deterministic; linear.
void SortFrontToBack(std::vector<CutNode>& cut, std::vector<CutNode>& scratch);
// The least distance that SortFrontToBack does not tell from this one.
inline float SortKeyFloor(float distance_m) {
  return std::bit_cast<float>(std::bit_cast<uint32_t>(distance_m) & 0xffff0000u);
}

}  // namespace farpoint

// The point tree: the hierarchy over surfels (paper §1.1), eight children to a node.
//
// Topology is implicit. Surfels are sorted along a Hilbert curve within six classes of normal
// direction (the signed dominant axis) and cut into runs of eight; level l + 1 has one node for
// each group of eight of level l. So children of the node with index i of level l are slots
// 8 i … 8 i + 7 of level l - 1; there are no pointers, every group but the last of a level is
// full, and normals below a node lie within 55° of an axis, which makes its projected area in most
// directions the exact dot product of two vectors: Σ A_k n_k · ω = (Σ A_k n_k) · ω.
//
// A *slot* is one node (a surfel at level 0); a *group* is eight slots stored side by side for
// SIMD. Slots beyond the last node of a level are empty: area 0 and radius -1.
#pragma once

#include <array>
#include <cstdint>
#include <memory>
#include <span>
#include <vector>

#include "core/base/aligned.h"
#include "core/base/blob.h"
#include "core/base/executor.h"
#include "core/base/status.h"
#include "core/pbgi/surfel.h"

namespace farpoint {

inline constexpr uint32_t kLanes = 8;

// Eight nodes. Lengths in metres, positions relative to the scene's origin.
struct alignas(32) NodeGroup {
  float cx[kLanes], cy[kLanes], cz[kLanes];  // area-weighted centre
  float radius[kLanes];     // of a sphere about the centre that holds all discs; -1: empty slot
  float thickness[kLanes];  // half height along the mean normal of all discs below
  float nx[kLanes], ny[kLanes], nz[kLanes];  // Σ A n / Σ A: as short as the normals spread
  float sin_cone[kLanes];    // sine of the largest angle to the mean normal; 1: 90° or more
  float area[kLanes];        // Σ A, m²
  float front_area[kLanes];  // Σ A of surfels whose front is visible (in the topology blob: open)
  float back_area[kLanes];   // Σ A of surfels whose back is visible
};
static_assert(sizeof(NodeGroup) == 384);

// What the nodes of a group reflect to the front (towards +n) and to the back: means weighted by
// visible area.
struct alignas(32) RadianceGroup {
  struct Sides {
    Rgb front, back;
  } lane[kLanes];
};
static_assert(sizeof(RadianceGroup) == 192);

class PointTree {
 public:
  struct Blobs {
    Blob topology, radiance;
  };
  // What does not depend on the lights: where the surfels stand in the tree, and the nodes.
  struct Topology {
    Blob blob;
    std::vector<uint32_t> order;  // by slot of level 0: the surfel that it holds
  };

  // Sorts, builds and serialises, in O(n). `open_sides` are the sides that are visible whatever
  // the lights. The result does not depend on the number of threads. An empty cloud gives a tree
  // without levels.
  static Topology BuildTopology(const SurfelCloud& cloud, const SurfelSides& open_sides,
                                Executor& executor);
  // The radiance that belongs to a topology of `cloud` and `open_sides`. Sides that are visible
  // (shading.visible_sides) but not open go by name into this blob, so that the topology stays what
  // it is when the lights change. An open side is always visible.
  static Blob BuildRadiance(const Topology& topology, const SurfelCloud& cloud,
                            const SurfelSides& open_sides, const SurfelShading& shading,
                            Executor& executor);
  // Both, where all visible sides are open.
  static Blobs Build(const SurfelCloud& cloud, const SurfelShading& shading, Executor& executor);

  // Views the blobs in place; the nodes are copied if sides are visible that are not open.
  // kDataLoss unless every size, count and value is as Build makes them: finite, radii and
  // areas >= 0, levels that fit. The two must belong together.
  static absl::StatusOr<std::shared_ptr<const PointTree>> FromBlobs(Blob topology, Blob radiance);

  // Nodes of all levels of a tree over `surfels`, surfels included.
  static uint64_t NodeCount(uint64_t surfels);

  uint64_t surfel_count() const { return surfel_count_; }
  uint64_t node_count() const { return node_count_; }  // all levels, surfels included
  int levels() const { return static_cast<int>(first_group_.size()); }
  bool empty() const { return first_group_.empty(); }
  // The group that holds the root's children, and its level.
  uint32_t root_group() const { return first_group_.back(); }
  int root_level() const { return levels() - 1; }
  // The group of the children of slot `slot` of level `level` >= 1.
  uint32_t ChildGroup(int level, uint32_t slot) const {
    return first_group_[level - 1] + (slot - first_group_[level] * kLanes);
  }
  const NodeGroup& group(uint32_t g) const { return groups_[g]; }
  const RadianceGroup& radiance(uint32_t g) const { return radiance_[g]; }
  std::span<const NodeGroup> groups() const { return groups_; }
  uint32_t first_group(int level) const { return first_group_[level]; }
  // Whether any surfel reflects anything.
  bool lit() const { return lit_; }
  size_t size_bytes() const {
    return topology_.size() + radiance_blob_.size() + own_groups_.size() * sizeof(NodeGroup);
  }

 private:
  // Makes sides visible that are not open: entries slot * 2 + (0 front, 1 back), ascending.
  absl::Status AddVisible(std::span<const uint32_t> lit_sides);

  Blob topology_, radiance_blob_;
  AlignedVector<NodeGroup> own_groups_;  // if they differ from the blob's
  uint64_t surfel_count_ = 0, node_count_ = 0;
  std::vector<uint32_t> first_group_;  // by level
  std::span<const NodeGroup> groups_;
  std::span<const RadianceGroup> radiance_;
  bool lit_ = false;
};

// The class (0..5) and the position along the Hilbert curve by which surfels are sorted; x, y, z
// in [0, 2^16). Skilling, "Programming the Hilbert curve", 2004.
uint64_t HilbertIndex(uint32_t x, uint32_t y, uint32_t z);
unsigned NormalClass(const Vec3f& n);

}  // namespace farpoint

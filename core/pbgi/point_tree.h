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
// SIMD, quantised (core/pbgi/packed_nodes.h). Slots beyond the last node of a level are empty:
// area 0 and radius -1.
#pragma once

#include <array>
#include <cstdint>
#include <memory>
#include <span>
#include <vector>

#include "core/base/blob.h"
#include "core/base/bulk_vector.h"
#include "core/base/executor.h"
#include "core/base/status.h"
#include "core/pbgi/packed_nodes.h"
#include "core/pbgi/surfel.h"

namespace farpoint {

// What the nodes of a group reflect to the front (towards +n) and to the back: means weighted by
// visible area.
struct RadianceSides {
  Rgb front, back;
};
struct RadianceGroup {
  RadianceSides lane[kLanes];
};

// RadianceSides of eight slots (RadianceUnit).
struct alignas(64) PackedRadiance {
  uint32_t front[kLanes], back[kLanes];
};
static_assert(sizeof(PackedRadiance) == 64);

// One surfel, unpacked.
struct Surfel {
  Vec3f position, normal;
  float radius_m;
};

class PointTree {
 public:
  struct Blobs {
    Blob topology, radiance;
  };
  // What does not depend on the lights: where the surfels stand in the tree, and the nodes.
  struct Topology {
    Blob blob;
    BulkVector<uint32_t> order;  // by slot of level 0: the surfel that it holds
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
  uint32_t group_count() const { return static_cast<uint32_t>(surfels_.size() + nodes_.size()); }
  uint32_t first_group(int level) const { return first_group_[level]; }
  // As they are stored: groups of level 0, and those of the others.
  const PackedSurfels& packed_surfels(uint32_t g) const { return surfels_[g]; }
  const PackedNodes& packed_nodes(uint32_t g) const { return nodes_[g - surfels_.size()]; }
  // Unpacked copies.
  NodeGroup group(uint32_t g) const {
    return g < surfels_.size() ? Unpack(surfels_[g]) : Unpack(packed_nodes(g));
  }
  Surfel surfel(uint32_t slot) const {
    const PackedSurfels& s = surfels_[slot / kLanes];
    const uint32_t k = slot % kLanes;
    return {CentreIn(s.frame, s.x[k], s.y[k], s.z[k]), UnpackNormal(s.normal[k]),
            HalfToFloat(s.radius[k]) * s.frame.unit};
  }
  RadianceSides radiance_of(uint32_t slot) const {
    const PackedRadiance& r = radiance_[slot / kLanes];
    const uint32_t k = slot % kLanes;
    return {unit_.Unpack(r.front[k]), unit_.Unpack(r.back[k])};
  }
  Rgb radiance_of(uint32_t slot, bool front) const {
    const PackedRadiance& r = radiance_[slot / kLanes];
    return unit_.Unpack((front ? r.front : r.back)[slot % kLanes]);
  }
  // Whether surfels gathered from surfels; if not, indirect_of must not be asked.
  bool has_indirect() const { return !indirect_.empty(); }
  // The irradiance [W/m²] that further bounces bring to a side of a surfel: a part of what it
  // reflects.
  Rgb indirect_of(uint32_t slot, bool front) const {
    const PackedRadiance& r = indirect_[slot / kLanes];
    return indirect_unit_.Unpack((front ? r.front : r.back)[slot % kLanes]);
  }
  // Bit 0: the front of a surfel is visible; bit 1: its back.
  unsigned visible_sides(uint32_t slot) const {
    return surfels_[slot / kLanes].normal[slot % kLanes] >> 30;
  }
  RadianceGroup radiance(uint32_t g) const {
    RadianceGroup sides;
    for (uint32_t k = 0; k < kLanes; ++k) sides.lane[k] = radiance_of(g * kLanes + k);
    return sides;
  }
  // Whether any surfel reflects anything.
  bool lit() const { return lit_; }
  // The radius of the largest surfel.
  float largest_radius_m() const { return largest_radius_m_; }
  // The most that a side of an inner node has of visible area over the disc of its radius: 1 on
  // flat surfaces, more where surfaces lie in layers. At least 1.
  float most_layers() const { return most_layers_; }
  size_t size_bytes() const {
    return topology_.size() + radiance_blob_.size() + own_surfels_.size() * sizeof(PackedSurfels) +
           own_nodes_.size() * sizeof(PackedNodes);
  }

 private:
  // Makes sides visible that are not open: entries slot * 2 + (0 front, 1 back), ascending.
  absl::Status AddVisible(std::span<const uint32_t> lit_sides);
  void FindExtremes();

  Blob topology_, radiance_blob_;
  // If they differ from the blob's.
  BulkVector<PackedSurfels> own_surfels_;
  BulkVector<PackedNodes> own_nodes_;
  uint64_t surfel_count_ = 0, node_count_ = 0;
  std::vector<uint32_t> first_group_;       // by level
  std::span<const PackedSurfels> surfels_;  // groups of level 0
  std::span<const PackedNodes> nodes_;      // of the others
  std::span<const PackedRadiance> radiance_, indirect_;
  RadianceUnit unit_, indirect_unit_;
  bool lit_ = false;
  float largest_radius_m_ = 0, most_layers_ = 1;
};

// The class (0..5) and the position along the Hilbert curve by which surfels are sorted; x, y, z
// in [0, 2^16). Skilling, "Programming the Hilbert curve", 2004.
uint64_t HilbertIndex(uint32_t x, uint32_t y, uint32_t z);
// Of eight points at once.
std::array<uint64_t, kLanes> HilbertIndex8(U8 x, U8 y, U8 z);
unsigned NormalClass(const Vec3f& n);

}  // namespace farpoint

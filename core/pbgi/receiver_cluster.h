// Variational clustering of a block's receivers (paper §3.1).
#pragma once

#include <cstdint>
#include <span>
#include <vector>

#include "core/accel/surface_offset.h"
#include "core/math/vec.h"

namespace farpoint {

// A shaded image sample, as the gather needs it. Positions are relative to the scene's origin.
struct Receiver {
  Vec3f position;
  Vec3f normal;            // unit shading normal, towards the viewer
  Vec3f geometric_normal;  // unit, towards the viewer
  bool on_back = false;    // the viewer sees the back of the triangle
  float offset_m = 0;      // how far off the surface rays start: SurfaceOffset

  Vec3f Leave() const { return position + geometric_normal * offset_m; }  // where they start
  SurfacePoint surface() const { return {position, geometric_normal, normal, offset_m}; }
};

struct ClusterParams {
  uint32_t k = 100;         // clusters asked for; never more than receivers
  uint32_t iterations = 5;  // of the k-means loop; fewer if it converges
  // α = normal_weight × squared diagonal of the receivers' bounding box. Erratum: the paper says
  // the diagonal itself, a length against a squared length, which would make the result depend on
  // the scene's unit; with α in m² scaling a scene changes nothing.
  float normal_weight = 1.0f;
  uint64_t seed_key = 0;  // from the block's coordinates, never from time, thread or tile
};

struct ReceiverCluster {
  std::vector<uint32_t> members;  // indices of receivers, ascending, not empty
  uint32_t active = 0;            // the member nearest to the centre under D
  Vec3f mean_normal;              // unit
  float radius_m = 0;             // R_c: largest distance of a member from the active receiver
  float sin_spread = 0,
        cos_spread = 1;      // of the largest angle between a member's normal and the mean
  float margin_m = 0;        // see CutView::margin_m
  bool sees_inside = false;  // any member is on_back
};

// D(x, c) = |p_c - p_x|² + α |n_c - n_x|² (§3.1).
// k-means from k distinct receivers drawn by `seed_key`; ties go to the lower index; an empty
// cluster is re-seeded with the receiver that is worst served. Afterwards a cluster across a depth
// or normal edge is split: while a member's normal is more than 60° from the mean, or R_c exceeds
// four times the root mean square distance of its members, at most 2 k clusters in all. Clusters
// come in a fixed order; every receiver is in exactly one. No receivers: no clusters.
std::vector<ReceiverCluster> ClusterReceivers(std::span<const Receiver> receivers,
                                              const ClusterParams& params);

// The literal version: straight from §3.1, without splitting. Returns each receiver's cluster.
std::vector<uint32_t> AssignClustersLiteral(std::span<const Receiver> receivers,
                                            const ClusterParams& params);
// The assignment that ClusterReceivers starts from, fast. Equal to the literal one.
std::vector<uint32_t> AssignClusters(std::span<const Receiver> receivers,
                                     const ClusterParams& params);

}  // namespace farpoint

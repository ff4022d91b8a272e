#include "core/pbgi/tree_cut.h"

#include <algorithm>
#include <bit>
#include <cmath>

#include "core/base/check.h"
#include "core/math/elementary.h"
#include "core/math/simd8.h"

namespace farpoint {

namespace {

// Below this squared length of the mean normal a node's surfels look in such different directions
// that it is no disc at any distance: descend.
constexpr float kMinCoherence2 = 0.5f;
// Discs whose plane passes within this part of their radius of the receiver, with agreeing
// normals, are the receiver's own surface seen through its curvature or folds.
constexpr float kSelfPlaneFactor = 0.6f;
constexpr float kSelfNormalCosine = 0.5f;
// Pixels of the cosine map grow towards the horizon; their growth counts up to here.
constexpr float kMinZenithCosine = 0.1f;

// Eight lanes' verdicts as bit masks.
struct Verdict {
  unsigned splat = 0;  // take the node as it is
  unsigned descend = 0;
  unsigned near = 0;        // stop here, receivers go on
  F8 dx, dy, dz, distance;  // from the view to the centre
  F8 facing;                // mean normal · (dx, dy, dz)
};

// Appends the lanes of `mask` to the cut.
void Append(const NodeGroup& g, const Verdict& verdict, unsigned mask, bool sees_inside,
            const uint32_t* slots, uint32_t first_slot, std::vector<CutNode>& cut) {
  const F8 zero = Set8(0.0f);
  const F8 inverse = Set8(1.0f) / verdict.distance;
  const F8 front_area = Load8(g.front_area), back_area = Load8(g.back_area);
  const M8 front = verdict.facing < zero;
  F8 area = Select8(front, front_area, back_area);
  if (sees_inside) area = Max8(front_area, back_area);
  // |facing| / d is the cosine; the sign of the result tells the side.
  const F8 omega = -verdict.facing * area * inverse * inverse * inverse;
  alignas(32) float w[5][8];
  Store8(w[0], verdict.dx * inverse);
  Store8(w[1], verdict.dy * inverse);
  Store8(w[2], verdict.dz * inverse);
  Store8(w[3], verdict.distance);
  Store8(w[4], omega);
  for (; mask != 0; mask &= mask - 1) {
    const int k = std::countr_zero(mask);
    // A node exactly at the view has no direction.
    if (!(w[3][k] > 0.0f)) continue;
    const uint32_t slot = slots != nullptr ? slots[k] : first_slot + static_cast<uint32_t>(k);
    cut.push_back({slot, w[3][k], {w[0][k], w[1][k], w[2][k]}, w[4][k]});
  }
}

// View and parameters, spread to eight lanes.
struct LaneView {
  F8 px, py, pz, nx, ny, nz;
  F8 radius, epsilon, sin_spread, cos_spread, margin, size_limit, zero;
  bool flat, everything_visible_above, sees_inside, cosine_map, sharing;

  LaneView(const CutView& view, const CutParams& params, bool want_near)
      : px(Set8(view.position.x)),
        py(Set8(view.position.y)),
        pz(Set8(view.position.z)),
        nx(Set8(view.normal.x)),
        ny(Set8(view.normal.y)),
        nz(Set8(view.normal.z)),
        radius(Set8(view.radius_m)),
        epsilon(Set8(params.epsilon)),
        sin_spread(Set8(view.sin_spread)),
        cos_spread(Set8(view.cos_spread)),
        margin(Set8(view.margin_m)),
        size_limit(Set8(params.pixel_sr * kCutPixels * kInvPif)),
        zero(Set8(0)),
        flat(view.sin_spread == 0.0f),
        everything_visible_above(view.sin_spread >= 1.0f),
        sees_inside(view.sees_inside),
        cosine_map(params.map == BufferMap::kCosine),
        sharing(want_near) {}
};

Verdict Judge(const NodeGroup& g, const LaneView& v, bool leaf, CutCounters& counters) {
  const F8 dx = Load8(g.cx) - v.px;
  const F8 dy = Load8(g.cy) - v.py;
  const F8 dz = Load8(g.cz) - v.pz;
  const F8 r = Load8(g.radius);
  const F8 mx = Load8(g.nx), my = Load8(g.ny), mz = Load8(g.nz);
  const F8 d2 = dx * dx + dy * dy + dz * dz;
  const F8 d = Sqrt8(d2);
  const F8 height = v.nx * dx + v.ny * dy + v.nz * dz;  // above the view's horizon plane
  const F8 facing = mx * dx + my * dy + mz * dz;        // < 0: its front looks at the view
  const F8 n_dot_m = v.nx * mx + v.ny * my + v.nz * mz;
  const F8 one = Set8(1.0f);
  const M8 used = r >= v.zero;

  // How far the node reaches beyond its centre towards the normal(s): a flat node's discs lie in a
  // slab, which is much thinner than its sphere.
  const F8 tilt = Sqrt8(Max8(one - n_dot_m * n_dot_m, v.zero));
  F8 reach, top;
  if (v.flat) {
    reach = Min8(r, r * tilt + Load8(g.thickness));
    top = height + reach + v.margin;
  } else {
    reach = Min8(r, r * Min8(one, tilt + v.sin_spread) + Load8(g.thickness));
    // max over the cone of normals of n·(c - p): |v| if the direction lies in the cone.
    const F8 lateral = Sqrt8(Max8(d2 - height * height, v.zero));
    const F8 turned = height * v.cos_spread + lateral * v.sin_spread;
    top = Select8(height >= d * v.cos_spread, d, turned) + reach + v.margin;
  }
  M8 alive = used;
  if (!v.everything_visible_above) {
    const M8 above = top > v.zero;
    counters.below_horizon += std::popcount(Bits8(used & ~above));
    alive &= above;
  }

  // Every disc turns the same side to every receiver, and that side cannot be seen.
  const F8 front_area = Load8(g.front_area), back_area = Load8(g.back_area);
  const F8 seen_front = v.sees_inside ? Max8(front_area, back_area) : front_area;
  const F8 seen_back = v.sees_inside ? Max8(front_area, back_area) : back_area;
  const F8 mean_length2 = mx * mx + my * my + mz * mz;
  {
    const F8 unit_facing = facing / Sqrt8(Max8(mean_length2, Set8(1e-30f)));
    const F8 slack = d * Load8(g.sin_cone) + r + v.radius;
    const M8 all_front = -unit_facing > slack;
    const M8 all_back = unit_facing > slack;
    const M8 invisible = (all_front & (seen_front <= v.zero)) | (all_back & (seen_back <= v.zero)) |
                         ((seen_front <= v.zero) & (seen_back <= v.zero));
    counters.invisible_side += std::popcount(Bits8(alive & invisible));
    alive &= ~invisible;
  }

  Verdict out;
  out.distance = d;
  out.dx = dx;
  out.dy = dy;
  out.dz = dz;
  out.facing = facing;
  // pi r² / d² against the pixel's solid angle.
  F8 limit = v.size_limit * d2;
  if (v.cosine_map) {
    const F8 zenith = Max8(height / Max8(d, Set8(1e-30f)), Set8(kMinZenithCosine));
    limit = limit / zenith;
  }
  const M8 coarse = (r * r > limit) | (mean_length2 < Set8(kMinCoherence2));
  M8 far = alive, near = alive & ~alive;
  if (v.sharing) {
    far = alive & (v.radius < v.epsilon * (d - r));
    near = alive & (v.radius >= v.epsilon * (d + r));
  }
  if (leaf) {
    // A surfel that straddles the border between near and far is near, too.
    near = v.sharing ? (alive & ~far) : near;
    const M8 own_surface =
        (Abs8(facing) < Set8(kSelfPlaneFactor) * r) & (Abs8(n_dot_m) > Set8(kSelfNormalCosine));
    out.splat = Bits8(far & ~own_surface);
    out.near = Bits8(near);
  } else {
    // Descending a node that is fine enough would cut it finer than a receiver alone does.
    if (v.sharing) near |= alive & ~far & ~coarse;
    out.splat = Bits8(far & ~coarse);
    out.near = Bits8(near);
    out.descend = Bits8(alive & ~near & ~(far & ~coarse));
  }
  return out;
}

struct Pending {
  uint32_t group;
  int32_t level;
};

// 8-ary, at most 12 levels for 2^31 surfels, up to seven siblings wait on each.
constexpr int kMaxPending = 8 * 13;

void Descend(const PointTree& tree, const LaneView& lanes, Pending first, std::vector<CutNode>& far,
             std::vector<NearNode>* near, CutCounters& counters) {
  Pending stack[kMaxPending];
  int size = 0;
  stack[size++] = first;
  while (size > 0) {
    const Pending at = stack[--size];
    ++counters.groups_visited;
    const Verdict verdict = Judge(tree.group(at.group), lanes, at.level == 0, counters);
    if (verdict.splat != 0) {
      Append(tree.group(at.group), verdict, verdict.splat, lanes.sees_inside, nullptr,
             at.group * kLanes, far);
    }
    for (unsigned m = verdict.near; m != 0; m &= m - 1) {
      near->push_back({at.group * kLanes + static_cast<uint32_t>(std::countr_zero(m)), at.level});
    }
    for (unsigned m = verdict.descend; m != 0; m &= m - 1) {
      const uint32_t slot = at.group * kLanes + static_cast<uint32_t>(std::countr_zero(m));
      FP_DCHECK(size < kMaxPending);
      const uint32_t child = tree.ChildGroup(at.level, slot);
      _mm_prefetch(reinterpret_cast<const char*>(&tree.group(child)), _MM_HINT_T0);
      stack[size++] = {child, at.level - 1};
    }
  }
}

}  // namespace

void ComputeClusterCut(const PointTree& tree, const CutView& view, const CutParams& params,
                       std::vector<CutNode>& far, std::vector<NearNode>* near,
                       CutCounters& counters) {
  if (tree.empty()) return;
  const LaneView lanes(view, params, near != nullptr);
  Descend(tree, lanes, {tree.root_group(), tree.root_level()}, far, near, counters);
}

void PackedNearNodes::Pack(const PointTree& tree, std::span<const NearNode> near) {
  nodes.assign(near.begin(), near.end());
  // Surfels first, so that a group is all surfels or judged as inner nodes (each lane's level is
  // looked up when it descends).
  std::stable_sort(nodes.begin(), nodes.end(), [](const NearNode& a, const NearNode& b) {
    return (a.level == 0) > (b.level == 0);
  });
  const size_t leaves = static_cast<size_t>(
      std::count_if(nodes.begin(), nodes.end(), [](const NearNode& n) { return n.level == 0; }));
  // Pad the surfels to whole groups.
  const size_t padded_leaves = (leaves + kLanes - 1) / kLanes * kLanes;
  nodes.insert(nodes.begin() + static_cast<std::ptrdiff_t>(leaves), padded_leaves - leaves,
               NearNode{~0u, 0});
  groups.resize((nodes.size() + kLanes - 1) / kLanes);
  for (size_t i = 0; i < groups.size() * kLanes; ++i) {
    NodeGroup& g = groups[i / kLanes];
    const uint32_t k = i % kLanes;
    if (i >= nodes.size() || nodes[i].slot == ~0u) {
      g.cx[k] = g.cy[k] = g.cz[k] = 0;
      g.radius[k] = -1;
      g.thickness[k] = g.nx[k] = g.ny[k] = g.nz[k] = g.sin_cone[k] = 0;
      g.area[k] = g.front_area[k] = g.back_area[k] = 0;
      continue;
    }
    const NodeGroup& from = tree.group(nodes[i].slot / kLanes);
    const uint32_t s = nodes[i].slot % kLanes;
    g.cx[k] = from.cx[s];
    g.cy[k] = from.cy[s];
    g.cz[k] = from.cz[s];
    g.radius[k] = from.radius[s];
    g.thickness[k] = from.thickness[s];
    g.nx[k] = from.nx[s];
    g.ny[k] = from.ny[s];
    g.nz[k] = from.nz[s];
    g.sin_cone[k] = from.sin_cone[s];
    g.area[k] = from.area[s];
    g.front_area[k] = from.front_area[s];
    g.back_area[k] = from.back_area[s];
  }
}

void ComputeReceiverCut(const PointTree& tree, const CutView& view, const CutParams& params,
                        const PackedNearNodes& near, std::vector<CutNode>& cut,
                        CutCounters& counters) {
  const LaneView lanes(view, params, /*want_near=*/false);
  for (size_t gi = 0; gi < near.groups.size(); ++gi) {
    const bool leaf = near.nodes[gi * kLanes].level == 0;
    ++counters.groups_visited;
    const Verdict verdict = Judge(near.groups[gi], lanes, leaf, counters);
    if (verdict.splat != 0) {
      uint32_t slots[kLanes] = {};
      for (uint32_t k = 0; k < kLanes && gi * kLanes + k < near.nodes.size(); ++k) {
        slots[k] = near.nodes[gi * kLanes + k].slot;
      }
      Append(near.groups[gi], verdict, verdict.splat, lanes.sees_inside, slots, 0, cut);
    }
    for (unsigned m = verdict.descend; m != 0; m &= m - 1) {
      const NearNode& n = near.nodes[gi * kLanes + std::countr_zero(m)];
      Descend(tree, lanes, {tree.ChildGroup(n.level, n.slot), n.level - 1}, cut, nullptr, counters);
    }
  }
}

void SortFrontToBack(std::vector<CutNode>& cut, std::vector<CutNode>& scratch) {
  // The upper 16 bits of a non-negative float order it to within 2^-7; two passes of 8 bits.
  scratch.resize(cut.size());
  for (int pass = 0; pass < 2; ++pass) {
    const int shift = 16 + 8 * pass;
    uint32_t count[257] = {};
    for (const CutNode& n : cut) {
      ++count[((std::bit_cast<uint32_t>(n.distance_m) >> shift) & 255u) + 1];
    }
    for (int i = 0; i < 256; ++i) count[i + 1] += count[i];
    for (const CutNode& n : cut) {
      scratch[count[(std::bit_cast<uint32_t>(n.distance_m) >> shift) & 255u]++] = n;
    }
    cut.swap(scratch);
  }
}

}  // namespace farpoint

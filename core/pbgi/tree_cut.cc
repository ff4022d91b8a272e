#include "core/pbgi/tree_cut.h"

#include <algorithm>
#include <bit>
#include <cmath>
#include <cstddef>
#include <limits>
#include <type_traits>

#include "core/base/check.h"
#include "core/base/fp_trap.h"
#include "core/math/elementary.h"
#include "core/math/simd8.h"
#include "core/math/transpose8.h"
#include "core/math/vec8.h"
#include "core/pbgi/closed_pixels.h"
#include "core/pbgi/packed_nodes.h"

namespace farpoint {

namespace {

// Discs whose plane passes within this part of their radius of the receiver, with agreeing
// normals, are the receiver's own surface seen through its curvature or folds.
constexpr float kSelfPlaneFactor = 0.6f;
constexpr float kSelfNormalCosine = 0.5f;
// Pixels of the cosine map grow towards the horizon; their growth counts up to here.
constexpr float kMinZenithCosine = 0.1f;

// View and parameters, spread to eight lanes. Lengths in metres.
struct LaneView {
  Vec3f position;
  float radius_m, margin_m;
  V8 normal;
  F8 epsilon, sin_spread, cos_spread, size_limit, zero;
  bool flat, everything_visible_above, sees_inside, cosine_map, sharing, skip_invisible_side;

  LaneView(const CutView& view, const CutParams& params, bool want_near)
      : position(view.position),
        radius_m(view.radius_m),
        margin_m(view.margin_m),
        normal(view.normal),
        epsilon(Set8(params.epsilon)),
        sin_spread(Set8(view.sin_spread)),
        cos_spread(Set8(view.cos_spread)),
        size_limit(Set8(params.pixel_sr * kCutPixels * kInvPif)),
        zero(Set8(0)),
        flat(view.sin_spread == 0.0f),
        everything_visible_above(view.sin_spread >= 1.0f || !params.skip_below_horizon),
        sees_inside(view.sees_inside),
        cosine_map(params.map == BufferMap::kCosine),
        sharing(want_near),
        skip_invisible_side(params.skip_invisible_side) {}
};

// 1 / unit, of a power of two, without a division.
inline float InverseOfPower(float unit) {
  return std::bit_cast<float>((254u << 23) - std::bit_cast<uint32_t>(unit));
}

// Eight nodes as they are stored: lengths are in a unit of the group's own, a power of two, in
// which a view compares them as they are; all rules are of ratios. Fields are read where they are
// needed.
template <typename Packed>
class StoredLanes {
 public:
  StoredLanes(const Packed& g, const LaneView& v)
      : g_(g), normal_(g.normal), inverse_unit_(InverseOfPower(g.frame.unit)) {
    const auto from_view = [&](const uint16_t* steps, int axis, float view) {
      return LoadWholes(steps) + Set8((g.frame.origin[axis] - view) * inverse_unit_);
    };
    offset_ = {from_view(g.x, 0, v.position.x), from_view(g.y, 1, v.position.y),
               from_view(g.z, 2, v.position.z)};
  }
  const V8& offset() const { return offset_; }  // from the view to the centre
  float unit_m() const { return g_.frame.unit; }
  float inverse_unit() const { return inverse_unit_; }
  F8 radius() const { return LoadHalves(g_.radius); }  // < 0: empty slot
  // The mean normal is `normal_steps` times `normal_step`.
  const V8& normal_steps() const { return normal_.steps; }
  F8 normal_step() const { return Set8(kInverseNormalSteps); }
  // Bit k: that side of lane k is visible.
  unsigned front() const { return normal_.front(); }
  unsigned back() const { return normal_.back(); }
  // Of inner nodes.
  F8 thickness() const { return LoadHalves(g_.thickness); }
  F8 sin_cone() const { return LoadHalves(g_.sin_cone); }
  F8 inverse_length() const { return Abs8(LoadHalves(g_.inverse_length)); }
  unsigned scattered() const {  // bit k: no disc at any distance (kMinCoherence2)
    const auto signs = _mm_load_si128(reinterpret_cast<const __m128i*>(g_.inverse_length));
    return static_cast<unsigned>(_mm_movemask_epi8(_mm_packs_epi16(signs, signs))) & 0xffu;
  }
  // Visible areas in squared units.
  F8 front_area() const {
    if constexpr (std::is_same_v<Packed, PackedSurfels>) {
      return Select8(normal_.word << 1 < 0, DiscArea(radius()), Set8(0.0f));
    } else {
      return LoadHalves(g_.front_area) * Set8(kAreaUnits);
    }
  }
  F8 back_area() const {
    if constexpr (std::is_same_v<Packed, PackedSurfels>) {
      return Select8(normal_.word, DiscArea(radius()), Set8(0.0f));
    } else {
      return LoadHalves(g_.back_area) * Set8(kAreaUnits);
    }
  }

 private:
  const Packed& g_;
  NormalLanes normal_;
  float inverse_unit_;
  V8 offset_;
};

// The same of nodes that are unpacked: in metres.
class UnpackedLanes {
 public:
  UnpackedLanes(const NodeGroup& g, const LaneView& v)
      : g_(g),
        offset_(Load8(g.cx) - Set8(v.position.x), Load8(g.cy) - Set8(v.position.y),
                Load8(g.cz) - Set8(v.position.z)),
        normal_(Load8(g.nx), Load8(g.ny), Load8(g.nz)) {}
  const V8& offset() const { return offset_; }
  float unit_m() const { return 1.0f; }
  float inverse_unit() const { return 1.0f; }
  F8 radius() const { return Load8(g_.radius); }
  const V8& normal_steps() const { return normal_; }
  F8 normal_step() const { return Set8(1.0f); }
  unsigned front() const { return Bits8(front_area() > Set8(0.0f)); }
  unsigned back() const { return Bits8(back_area() > Set8(0.0f)); }
  F8 thickness() const { return Load8(g_.thickness); }
  F8 sin_cone() const { return Load8(g_.sin_cone); }
  F8 inverse_length() const { return Load8(g_.inverse_length); }
  unsigned scattered() const { return Bits8(Dot(normal_, normal_) < Set8(kMinCoherence2)); }
  F8 front_area() const { return Load8(g_.front_area); }
  F8 back_area() const { return Load8(g_.back_area); }

 private:
  const NodeGroup& g_;
  V8 offset_, normal_;
};

// Eight lanes' verdicts as bit masks.
struct Verdict {
  unsigned splat = 0;  // take the node as it is
  unsigned descend = 0;
  unsigned near = 0;  // stop here, receivers go on
  F8 distance;        // in units of the lanes
  F8 facing;          // mean normal · offset; < 0: its front looks at the view
};

// Appends the lanes of `mask`, not empty, to the cut; those of `slots`.
template <typename Lanes>
inline void Append(const Lanes& n, const Verdict& verdict, unsigned mask, bool sees_inside,
                   U8 slots, std::vector<CutNode>& cut) {
  // A node exactly at the view has no direction.
  mask &= Bits8(verdict.distance > Set8(0.0f));
  const F8 inverse = Set8(1.0f) / verdict.distance;
  const F8 front_area = n.front_area(), back_area = n.back_area();
  F8 area = Select8(reinterpret_cast<M8>(verdict.facing), front_area, back_area);
  if (sees_inside) area = Max8(front_area, back_area);
  // |facing| / d is the cosine; the sign of the result tells the side.
  const F8 omega = -verdict.facing * area * inverse * inverse * inverse;
  const auto row = [](F8 v) { return reinterpret_cast<__m256>(v); };
  static_assert(sizeof(CutNode) == 6 * sizeof(float) && offsetof(CutNode, distance_m) == 4 &&
                offsetof(CutNode, direction) == 8 && offsetof(CutNode, signed_solid_angle) == 20);
  __m256 nodes[8] = {row(reinterpret_cast<F8>(slots)),
                     row(verdict.distance * Set8(n.unit_m())),
                     row(n.offset().x * inverse),
                     row(n.offset().y * inverse),
                     row(n.offset().z * inverse),
                     row(omega),
                     _mm256_setzero_ps(),
                     _mm256_setzero_ps()};
  Transpose8(nodes);
  // Whole rows are written, each over the end of the one before it: room for one more.
  const size_t size = cut.size(), count = static_cast<size_t>(std::popcount(mask));
  cut.resize(size + count + 1);
  CutNode* out = cut.data() + size;
  for (uint32_t k = 0; k < kLanes; ++k) {
    if ((mask >> k & 1u) == 0) continue;
    _mm256_storeu_ps(reinterpret_cast<float*>(out++), nodes[k]);
  }
  cut.resize(size + count);
}

template <bool kLeaf, typename Lanes>
inline Verdict Judge(const Lanes& n, const LaneView& v, CutCounters& counters) {
  const F8 one = Set8(1.0f), step = n.normal_step();
  const V8 offset = n.offset();
  const F8 r = n.radius();
  const F8 d2 = Dot(offset, offset);
  const F8 d = Sqrt8(d2);
  const F8 height = Dot(v.normal, offset);  // above the view's horizon plane
  const F8 facing = Dot(n.normal_steps(), offset) * step;
  const F8 n_dot_m = Dot(v.normal, n.normal_steps()) * step;
  const F8 radius = Set8(v.radius_m * n.inverse_unit());

  // How far the node reaches beyond its centre towards the normal(s): a flat node's discs lie in a
  // slab, which is much thinner than its sphere.
  unsigned alive = Bits8(r >= v.zero);
  if (!v.everything_visible_above) {
    const F8 tilt = Sqrt8(Max8(one - n_dot_m * n_dot_m, v.zero));
    const F8 turn = v.flat ? tilt : Min8(one, tilt + v.sin_spread);
    F8 reach = r * turn;
    if constexpr (!kLeaf) reach = Min8(r, reach + n.thickness());
    F8 top = height;
    if (!v.flat) {
      // max over the cone of normals of n·(c - p): |v| if the direction lies in the cone.
      const F8 lateral = Sqrt8(Max8(d2 - height * height, v.zero));
      const F8 turned = height * v.cos_spread + lateral * v.sin_spread;
      top = Select8(height >= d * v.cos_spread, d, turned);
    }
    const F8 margin = Set8(v.margin_m * n.inverse_unit());
    const F8 least = Max8(d - r, v.zero) * Set8(kHorizonSine);
    const unsigned above = Bits8(top + reach + margin > least);
    counters.below_horizon += static_cast<unsigned>(std::popcount(alive & ~above));
    alive &= above;
  }

  // Every disc turns the same side to every receiver, and that side cannot be seen.
  const unsigned front = n.front(), back = n.back();
  const unsigned seen_front = v.sees_inside ? front | back : front;
  const unsigned seen_back = v.sees_inside ? front | back : back;
  if (v.skip_invisible_side && (alive & ~(seen_front & seen_back)) != 0) {
    F8 unit_facing = facing, slack = r + radius;
    if constexpr (!kLeaf) {
      unit_facing = facing * n.inverse_length();
      slack = d * n.sin_cone() + slack;
    }
    const unsigned all_front = Bits8(-unit_facing > slack);
    const unsigned all_back = Bits8(unit_facing > slack);
    const unsigned invisible =
        (all_front & ~seen_front) | (all_back & ~seen_back) | ~(seen_front | seen_back);
    counters.invisible_side += static_cast<unsigned>(std::popcount(alive & invisible));
    alive &= ~invisible;
  }

  Verdict out;
  out.distance = d;
  out.facing = facing;
  unsigned far = alive, near = 0;
  if (v.sharing) {
    far = alive & Bits8(radius < v.epsilon * (d - r));
    near = alive & Bits8(radius >= v.epsilon * (d + r));
  }
  if constexpr (kLeaf) {
    // A surfel that straddles the border between near and far is near, too.
    if (v.sharing) near = alive & ~far;
    const unsigned own_surface = Bits8((Abs8(facing) < Set8(kSelfPlaneFactor) * r) &
                                       (Abs8(n_dot_m) > Set8(kSelfNormalCosine)));
    out.splat = far & ~own_surface;
    out.near = near;
  } else {
    // pi r² / d² against the pixel's solid angle.
    F8 limit = v.size_limit * d2;
    if (v.cosine_map) {
      const F8 zenith = Max8(height / Max8(d, Set8(1e-30f)), Set8(kMinZenithCosine));
      limit = limit / zenith;
    }
    const unsigned coarse = Bits8(r * r > limit) | n.scattered();
    // Descending a node that is fine enough would cut it finer than a receiver alone does.
    if (v.sharing) near |= alive & ~far & ~coarse;
    out.splat = far & ~coarse;
    out.near = near;
    out.descend = alive & ~near & ~out.splat;
  }
  return out;
}

// Where shells end, in diagonals of the tree.
constexpr float kShellEnds[] = {1.0f / 8};

struct Pending {
  uint32_t group;
  int32_t level;
};

// 8-ary, at most 12 levels for 2^31 surfels, up to seven siblings wait on each.
constexpr int kMaxPending = 8 * 13;

void Prefetch(const PointTree& tree, uint32_t group, int level) {
  const auto* bytes = level == 0 ? reinterpret_cast<const char*>(&tree.packed_surfels(group))
                                 : reinterpret_cast<const char*>(&tree.packed_nodes(group));
  _mm_prefetch(bytes, _MM_HINT_T0);
  _mm_prefetch(bytes + 64, _MM_HINT_T0);
}

void Descend(const PointTree& tree, const LaneView& lanes, Pending first, std::vector<CutNode>& far,
             std::vector<NearNode>* near, CutCounters& counters) {
  Pending stack[kMaxPending];
  int size = 0;
  stack[size++] = first;
  const U8 iota = {0, 1, 2, 3, 4, 5, 6, 7};
  const auto visit = [&]<typename Packed>(const Packed& group, const Pending& at) {
    const StoredLanes<Packed> nodes(group, lanes);
    const Verdict verdict = Judge<std::is_same_v<Packed, PackedSurfels>>(nodes, lanes, counters);
    if (verdict.splat != 0) {
      Append(nodes, verdict, verdict.splat, lanes.sees_inside, iota + at.group * kLanes, far);
    }
    for (unsigned m = verdict.near; m != 0; m &= m - 1) {
      near->push_back({at.group * kLanes + static_cast<uint32_t>(std::countr_zero(m)), at.level});
    }
    return verdict.descend;
  };
  while (size > 0) {
    const Pending at = stack[--size];
    ++counters.groups_visited;
    if (at.level == 0) {
      visit(tree.packed_surfels(at.group), at);
      continue;
    }
    const unsigned descend = visit(tree.packed_nodes(at.group), at);
    for (unsigned m = descend; m != 0; m &= m - 1) {
      const uint32_t slot = at.group * kLanes + static_cast<uint32_t>(std::countr_zero(m));
      FP_DCHECK(size < kMaxPending);
      const uint32_t child = tree.ChildGroup(at.level, slot);
      Prefetch(tree, child, at.level - 1);
      stack[size++] = {child, at.level - 1};
    }
  }
}

// Part of its radius by which a quantised node may miss what lies below it
// (core/pbgi/packed_nodes.h has 2^-15), and relative slack of distances.
constexpr float kRadiusSlack = 1.001f, kDistanceSlack = 0.9999f;

// Solid angle of the largest node that is drawn as a box, in pixels of mean size: kCutPixels, or of
// a surfel on the largest pixels, 2.9 times as large.
constexpr float kLargestBoxPixels = 2.9f * kExactDiscPixels * kExactDiscPixels;
static_assert(kLargestBoxPixels >= kCutPixels);

// Part of a node's size over that of one that a cut leaves whole from which it is asked whether it
// is hidden.
constexpr float kWorthwhileSize = 6.0f;

// The tree's extent.
float DiagonalOf(const PointTree& tree) {
  Box3f box;
  const NodeGroup g = tree.group(tree.root_group());
  for (uint32_t k = 0; k < kLanes; ++k) {
    if (g.radius[k] < 0) continue;
    const Vec3f centre(g.cx[k], g.cy[k], g.cz[k]);
    box.Extend(centre - Vec3f(g.radius[k]));
    box.Extend(centre + Vec3f(g.radius[k]));
  }
  return Length(box.max - box.min);
}

}  // namespace

ShellCut::ShellCut(const PointTree& tree, const CutParams& params) : tree_(tree), params_(params) {
  if (tree.empty()) return;
  const float diagonal_m = DiagonalOf(tree);
  for (const float part : kShellEnds) ends_m_.push_back(SortKeyFloor(part * diagonal_m));
}

void ShellCut::Start(const CutView& view, std::vector<NearNode>* near) {
  view_ = view;
  near_ = near;
  shell_ = 0;
  distance_m_ = 0;
  items_.clear();
  if (tree_.empty()) return;
  items_.push_back({{tree_.root_group(), 0.0f, {}, 0.0f}, tree_.root_level()});
}

bool ShellCut::Next(const ClosedPixels* closed, std::vector<CutNode>& cut, CutCounters& counters) {
  if (items_.empty()) return false;
  const LaneView lanes(view_, params_, near_ != nullptr);
  const float end_m =
      shell_ < ends_m_.size() ? ends_m_[shell_++] : std::numeric_limits<float>::infinity();
  const U8 iota = {0, 1, 2, 3, 4, 5, 6, 7};
  const F8 from_m = Set8(distance_m_);
  // Takes out of a verdict subtrees that touch closed pixels only. What may lie before the shell is
  // let be: closed pixels are so for what lies in it and beyond.
  const auto leave_out_hidden = [&]<typename Lanes>(const Lanes& nodes, Verdict& verdict) {
    // Those that are just a little too large would be asked for too little work.
    const F8 worthwhile = lanes.size_limit * Set8(kWorthwhileSize);
    if ((verdict.descend & Bits8(nodes.radius() * nodes.radius() >
                                 worthwhile * verdict.distance * verdict.distance)) == 0) {
      return;
    }
    const FpTrapPause pause;  // lanes that are not asked
    const F8 zero = Set8(0.0f);
    const F8 d = verdict.distance, inverse_d = Set8(1.0f) / d;
    const V8 w = nodes.offset() * inverse_d;
    const ClosedPixels::Places places = closed->At(w);
    const F8 r = nodes.radius();
    const F8 reach_r = r * Set8(kRadiusSlack);
    const F8 nearest = (d - reach_r) * Set8(kDistanceSlack);
    const M8 behind = nearest * Set8(nodes.unit_m()) >= from_m;
    // Discs drawn pixel by pixel reach beyond their radius by the rest of their kernels' support.
    const F8 leaf = Set8(tree_.largest_radius_m() * nodes.inverse_unit());
    const M8 discs = DiscArea(leaf) >
                     Set8(kExactDiscPixels * kExactDiscPixels * 0.99f * closed->least_pixel_sr()) *
                         nearest * nearest;
    const F8 reach =
        Select8(discs, reach_r + Set8(kKernelSupport - 1.0f) * Min8(reach_r, leaf), reach_r);
    const F8 sine = reach * inverse_d;
    // At least the arc sine, up to 0.6.
    const F8 angle = sine + Set8(0.21f) * sine * sine * sine;
    const ClosedPixels::Reach image = closed->ReachAbout(w, angle);
    // The centre of a node below lies within the sphere less its own radius, x in radians; its box
    // ends box_per_rad x from there.
    const F8 box_per_rad = Set8(0.5f * kCoverageBoxScale * 1.001f) *
                           Sqrt8(Set8(kPif * tree_.most_layers()) / image.least_pixel_sr);
    const F8 sphere = reach_r / nearest;
    const F8 x = Min8(sphere, Set8(std::sqrt(kLargestBoxPixels * params_.pixel_sr * kInvPif)));
    const F8 boxes = image.px_per_rad * sphere + Max8(box_per_rad - image.px_per_rad, zero) * x;
    const F8 half = Max8(image.px_per_rad * angle, boxes) + Set8(0.01f);
    const unsigned hidden = verdict.descend &
                            Bits8((sine < Set8(0.6f)) & (nearest > zero) & behind) &
                            closed->AllClosed(places, half);
    counters.hidden_subtrees += static_cast<unsigned>(std::popcount(hidden));
    verdict.descend &= ~hidden;
  };
  later_.clear();
  Item stack[kMaxPending];
  const auto visit = [&]<typename Packed>(const Packed& group, const Item& at, F8& least_m) {
    const StoredLanes<Packed> nodes(group, lanes);
    constexpr bool kLeaf = std::is_same_v<Packed, PackedSurfels>;
    Verdict verdict = Judge<kLeaf>(nodes, lanes, counters);
    if constexpr (!kLeaf) {
      if (closed != nullptr) leave_out_hidden(nodes, verdict);
    }
    const uint32_t first = at.node.slot * kLanes;
    const F8 unit = Set8(nodes.unit_m());
    if (verdict.splat != 0) {
      const unsigned inside = Bits8(verdict.distance * unit < Set8(end_m));
      if ((verdict.splat & inside) != 0) {
        Append(nodes, verdict, verdict.splat & inside, lanes.sees_inside, iota + first, cut);
      }
      if ((verdict.splat & ~inside) != 0) {
        beyond_.clear();
        Append(nodes, verdict, verdict.splat & ~inside, lanes.sees_inside, iota + first, beyond_);
        for (const CutNode& n : beyond_) later_.push_back({n, -1});
      }
    }
    for (unsigned m = verdict.near; m != 0; m &= m - 1) {
      near_->push_back({first + static_cast<uint32_t>(std::countr_zero(m)), at.level});
    }
    const F8 least = (verdict.distance - nodes.radius() * Set8(kRadiusSlack)) * unit;
    least_m = least * Set8(kDistanceSlack);
    if (lanes.sharing) {
      // What may hold near nodes does not wait.
      const M8 far = Set8(lanes.radius_m * kRadiusSlack) < lanes.epsilon * least;
      least_m = Select8(far, least_m, Set8(-1.0f));
    }
    return verdict.descend;
  };
  for (const Item& item : items_) {
    if (item.node.distance_m >= end_m) {
      later_.push_back(item);
      continue;
    }
    if (item.level < 0) {
      cut.push_back(item.node);
      continue;
    }
    int size = 0;
    stack[size++] = item;
    while (size > 0) {
      const Item at = stack[--size];
      if (at.node.distance_m >= end_m) {
        later_.push_back(at);
        continue;
      }
      ++counters.groups_visited;
      F8 least_m;
      if (at.level == 0) {
        visit(tree_.packed_surfels(at.node.slot), at, least_m);
        continue;
      }
      const unsigned descend = visit(tree_.packed_nodes(at.node.slot), at, least_m);
      for (unsigned m = descend; m != 0; m &= m - 1) {
        const auto k = static_cast<uint32_t>(std::countr_zero(m));
        FP_DCHECK(size < kMaxPending);
        const uint32_t child = tree_.ChildGroup(at.level, at.node.slot * kLanes + k);
        if (least_m[k] < end_m) Prefetch(tree_, child, at.level - 1);
        stack[size++] = {{child, least_m[k], {}, 0.0f}, at.level - 1};
      }
    }
  }
  distance_m_ = end_m;
  items_.swap(later_);
  return true;
}

void ComputeClusterCut(const PointTree& tree, const CutView& view, const CutParams& params,
                       std::vector<CutNode>& far, std::vector<NearNode>* near,
                       CutCounters& counters) {
  if (tree.empty()) return;
  const LaneView lanes(view, params, near != nullptr);
  Descend(tree, lanes, {tree.root_group(), tree.root_level()}, far, near, counters);
}

namespace {

void CopyLane(const NodeGroup& from, uint32_t lane, NodeGroup& to, uint32_t at) {
  to.cx[at] = from.cx[lane];
  to.cy[at] = from.cy[lane];
  to.cz[at] = from.cz[lane];
  to.radius[at] = from.radius[lane];
  to.thickness[at] = from.thickness[lane];
  to.nx[at] = from.nx[lane];
  to.ny[at] = from.ny[lane];
  to.nz[at] = from.nz[lane];
  to.sin_cone[at] = from.sin_cone[lane];
  to.inverse_length[at] = from.inverse_length[lane];
  to.front_area[at] = from.front_area[lane];
  to.back_area[at] = from.back_area[lane];
}

}  // namespace

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
  NodeGroup empty{};
  empty.radius[0] = -1;
  groups.resize((nodes.size() + kLanes - 1) / kLanes);
  for (size_t i = 0; i < groups.size() * kLanes; ++i) {
    NodeGroup& g = groups[i / kLanes];
    const uint32_t k = i % kLanes;
    if (i >= nodes.size() || nodes[i].slot == ~0u) {
      CopyLane(empty, 0, g, k);
    } else {
      CopyLane(tree.group(nodes[i].slot / kLanes), nodes[i].slot % kLanes, g, k);
    }
  }
}

void ComputeReceiverCut(const PointTree& tree, const CutView& view, const CutParams& params,
                        const PackedNearNodes& near, std::vector<CutNode>& cut,
                        CutCounters& counters) {
  const LaneView lanes(view, params, /*want_near=*/false);
  for (size_t gi = 0; gi < near.groups.size(); ++gi) {
    const bool leaf = near.nodes[gi * kLanes].level == 0;
    ++counters.groups_visited;
    const UnpackedLanes nodes(near.groups[gi], lanes);
    const Verdict verdict =
        leaf ? Judge<true>(nodes, lanes, counters) : Judge<false>(nodes, lanes, counters);
    const auto append = [&](unsigned mask) {
      U8 slots = {};
      for (uint32_t k = 0; k < kLanes && gi * kLanes + k < near.nodes.size(); ++k) {
        slots[k] = near.nodes[gi * kLanes + k].slot;
      }
      Append(nodes, verdict, mask, lanes.sees_inside, slots, cut);
    };
    // In the order of the near nodes, whatever others share their group: the order of nodes equally
    // far must not depend on what was left out.
    unsigned splat = verdict.splat;
    for (unsigned m = verdict.descend; m != 0; m &= m - 1) {
      const unsigned before = splat & ((m & -m) - 1u);
      if (before != 0) append(before);
      splat &= ~before;
      const NearNode& n = near.nodes[gi * kLanes + std::countr_zero(m)];
      Descend(tree, lanes, {tree.ChildGroup(n.level, n.slot), n.level - 1}, cut, nullptr, counters);
    }
    if (splat != 0) append(splat);
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

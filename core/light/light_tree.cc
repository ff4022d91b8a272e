#include "core/light/light_tree.h"

#include <algorithm>
#include <cmath>
#include <utility>

#include "core/base/fp_trap.h"
#include "core/math/elementary.h"
#include "core/math/simd4d.h"

namespace farpoint {

namespace {

constexpr int kBins = 16;
// Beyond this depth parts are halved by their number, which bounds the depth of the tree.
constexpr unsigned kMaxCostDepth = 48;
// A cosine is not taken smaller than this where light can arrive: the mean over a node is not 0
// where the bound is.
constexpr float kLeastCosine = 0.02f;

// What a part costs: its power times the square of its size (the surface area heuristic's measure,
// which for flat parts is not 0).
double CostOf(const Box3f& box, double power) {
  if (box.empty()) return 0;
  return power * Length2(Vec3d(box.max) - Vec3d(box.min));
}

// The smallest cone about both (pbrt, 4th edition, 3.8.4). With two_sided an axis may be turned.
void Widen(LightBounds& a, const LightBounds& b, bool two_sided) {
  if (a.cos_cone <= -1.0f) return;
  if (b.cos_cone <= -1.0f) {
    a.cos_cone = -1.0f;
    return;
  }
  const Vec3d u(a.axis);
  Vec3d v(b.axis);
  if (two_sided && Dot(u, v) < 0) v = -v;
  const double angle_a = DetAcos(static_cast<double>(a.cos_cone));
  const double angle_b = DetAcos(static_cast<double>(b.cos_cone));
  const Vec3d cross = Cross(u, v);
  const double between = DetAtan2(Length(cross), Dot(u, v));
  if (std::min(between + angle_b, kPi) <= angle_a) return;
  if (std::min(between + angle_a, kPi) <= angle_b) {
    a.axis = Vec3f(v);
    a.cos_cone = b.cos_cone;
    return;
  }
  const double angle = 0.5 * (angle_a + between + angle_b);
  const Vec3d side = NormalizeOr(Cross(cross, u), Vec3d());
  if (angle >= kPi || side == Vec3d()) {
    a.cos_cone = -1.0f;
    return;
  }
  const SinCos turn = DetSinCos(angle - angle_a);
  a.axis = Vec3f(NormalizeOr(u * turn.cos + side * turn.sin, u));
  // The axis was rounded.
  a.cos_cone = std::max(-1.0f, static_cast<float>(DetSinCos(angle).cos) - 1e-6f);
}

void Merge(LightBounds& a, const LightBounds& b, bool two_sided) {
  if (a.power == 0.0f) {
    a = b;
    return;
  }
  a.box.min = Min(a.box.min, b.box.min);
  a.box.max = Max(a.box.max, b.box.max);
  Widen(a, b, two_sided);
  a.power += b.power;
  a.reach_m = std::max(a.reach_m, b.reach_m);
}

struct Part {
  std::span<uint32_t> items;
  double cost;
};

Part MakePart(std::span<const LightBounds> lights, std::span<uint32_t> items) {
  Box3f box;
  double power = 0;
  for (const uint32_t i : items) {
    box.Extend(lights[i].box.min);
    box.Extend(lights[i].box.max);
    power += static_cast<double>(lights[i].power);
  }
  return {items, CostOf(box, power)};
}

// Where to cut `items`, which are put in order: by 16 bins along each axis, at the least cost.
size_t Split(std::span<const LightBounds> lights, std::span<uint32_t> items, bool by_cost) {
  const auto center = [&](uint32_t i, int axis) {
    return lights[i].box.min[axis] * 0.5f + lights[i].box.max[axis] * 0.5f;
  };
  Box3f centers;
  for (const uint32_t i : items) centers.Extend({center(i, 0), center(i, 1), center(i, 2)});
  const Vec3f size = centers.max - centers.min;
  struct Bin {
    Box3f box;
    double power = 0;
    size_t count = 0;
    void Add(const Bin& b) {
      if (b.count == 0) return;
      box.Extend(b.box.min);
      box.Extend(b.box.max);
      power += b.power;
      count += b.count;
    }
  };
  const auto bin_of = [&](uint32_t i, int axis) {
    const float t = (center(i, axis) - centers.min[axis]) / size[axis];
    return std::clamp(static_cast<int>(t * kBins), 0, kBins - 1);
  };
  double best = std::numeric_limits<double>::infinity();
  int best_axis = -1, best_bin = 0;
  for (int axis = 0; axis < 3 && by_cost; ++axis) {
    if (!(size[axis] > 0.0f)) continue;
    std::array<Bin, kBins> bins;
    for (const uint32_t i : items) {
      Bin& bin = bins[static_cast<size_t>(bin_of(i, axis))];
      bin.box.Extend(lights[i].box.min);
      bin.box.Extend(lights[i].box.max);
      bin.power += static_cast<double>(lights[i].power);
      ++bin.count;
    }
    std::array<double, kBins> cost_above{};
    Bin above;
    for (size_t b = kBins - 1; b > 0; --b) {
      above.Add(bins[b]);
      cost_above[b] = CostOf(above.box, above.power);
    }
    Bin below;
    for (size_t b = 0; b + 1 < kBins; ++b) {
      below.Add(bins[b]);
      if (below.count == 0 || below.count == items.size()) continue;
      const double cost = CostOf(below.box, below.power) + cost_above[b + 1];
      if (cost < best) {
        best = cost;
        best_axis = axis;
        best_bin = static_cast<int>(b);
      }
    }
  }
  if (best_axis >= 0) {
    const auto middle = std::stable_partition(
        items.begin(), items.end(), [&](uint32_t i) { return bin_of(i, best_axis) <= best_bin; });
    return static_cast<size_t>(middle - items.begin());
  }
  // All in one place, or too deep: by number, along the longest side.
  int axis = size.x >= size.y ? 0 : 1;
  if (size.z > size[axis]) axis = 2;
  std::stable_sort(items.begin(), items.end(),
                   [&](uint32_t a, uint32_t b) { return center(a, axis) < center(b, axis); });
  return items.size() / 2;
}

}  // namespace

LightTree::LightTree(std::span<const LightBounds> lights, Emission emission) : emission_(emission) {
  if (lights.empty()) return;
  std::vector<uint32_t> items(lights.size());
  for (uint32_t i = 0; i < items.size(); ++i) items[i] = i;
  LightBounds bounds;
  root_ = Build(lights, items, 0, bounds);
  FindParents();
}

uint32_t LightTree::Build(std::span<const LightBounds> lights, std::span<uint32_t> items,
                          unsigned depth, LightBounds& bounds) {
  const bool two_sided = emission_ == Emission::kTwoSidedCosine;
  if (items.size() <= kWidth) {
    const auto block = static_cast<uint32_t>(order_.size() / kWidth);
    for (const uint32_t i : items) {
      Merge(bounds, lights[i], two_sided);
      order_.push_back(i);
    }
    order_.resize(size_t{block + 1} * kWidth, kNone);
    return kBlock + block;
  }
  // The part of the greatest cost that is no block yet is cut until there are eight.
  std::vector<Part> parts{MakePart(lights, items)};
  while (parts.size() < kWidth) {
    size_t worst = parts.size();
    for (size_t i = 0; i < parts.size(); ++i) {
      if (parts[i].items.size() <= kWidth) continue;
      if (worst == parts.size() || parts[i].cost > parts[worst].cost) worst = i;
    }
    if (worst == parts.size()) break;
    const std::span<uint32_t> whole = parts[worst].items;
    const size_t cut = Split(lights, whole, depth < kMaxCostDepth);
    parts[worst] = MakePart(lights, whole.first(cut));
    parts.insert(parts.begin() + static_cast<ptrdiff_t>(worst) + 1,
                 MakePart(lights, whole.subspan(cut)));
  }
  const auto at = static_cast<uint32_t>(nodes_.size());
  nodes_.emplace_back();
  Node node{};
  for (size_t k = 0; k < parts.size(); ++k) {
    LightBounds part;
    node.child[k] = Build(lights, parts[k].items, depth + 1, part);
    const Vec3f c = part.box.min * 0.5f + part.box.max * 0.5f;
    node.x[k] = c.x;
    node.y[k] = c.y;
    node.z[k] = c.z;
    // Rounded up: the sphere holds the box.
    node.radius[k] = Length(Max(part.box.max - c, c - part.box.min)) * 1.000001f;
    node.axis_x[k] = part.axis.x;
    node.axis_y[k] = part.axis.y;
    node.axis_z[k] = part.axis.z;
    node.cos_cone[k] = part.cos_cone;
    node.sin_cone[k] = std::sqrt(std::max(0.0f, 1.0f - part.cos_cone * part.cos_cone));
    node.power[k] = part.power;
    node.reach[k] = part.reach_m;
    Merge(bounds, part, two_sided);
  }
  nodes_[at] = node;
  return at;
}

double LightTree::ProbabilityInBlock(const Weights& weights, uint32_t chosen) {
  double total = 0;
  uint32_t positive = 0;
  for (const float w : weights) {
    total += static_cast<double>(w);
    positive += w > 0 ? 1u : 0u;
  }
  if (!(total > 0) || !(weights[chosen] > 0)) return 0;
  double sum = 0, before = 0, below = 0;
  for (uint32_t k = 0; k <= chosen; ++k) {
    if (!(weights[k] > 0)) continue;
    sum += static_cast<double>(weights[k]);
    before = below;
    below = sum / total;
    if (positive == 2 && sum < total) below = AtAnEighth(below);
  }
  return below - before;
}

void LightTree::FindParents() {
  parent_of_node_.resize(nodes_.size());
  parent_of_block_.resize(order_.size() / kWidth);
  for (uint32_t i = 0; i < nodes_.size(); ++i) {
    for (uint32_t k = 0; k < kWidth; ++k) {
      if (!(nodes_[i].power[k] > 0)) continue;
      const uint32_t child = nodes_[i].child[k];
      ((child & kBlock) != 0 ? parent_of_block_[child & ~kBlock] : parent_of_node_[child]) = {i, k};
    }
  }
}

LightTree::Choices8 LightTree::ChooseInBlock8(std::span<const F8> weights, const U8& u_bits) {
  const FpTrapPause pause;  // lanes that are left out
  constexpr double kBelowOne = 1.0 - 0x1p-53;
  const D4 zero = Set4(0.0), one = Set4(1.0);
  std::array<D4, 2> probability, rest, chosen, any;
  for (int h = 0; h < 2; ++h) {
    const D4 u = Half4(u_bits, h) * Set4(0x1p-32);
    D4 total = zero, positive = zero;
    for (const F8& w : weights) {
      const D4 weight = Half4(w, h);
      total += weight;
      positive += Select4(weight > zero, one, zero);
    }
    const M4 two = positive == Set4(2.0);
    M4 open = total > zero;
    any[h] = Select4(open, one, zero);
    D4 sum = zero, before = zero, below = zero, at = zero;
    for (size_t k = 0; k < weights.size(); ++k) {
      const D4 weight = Half4(weights[k], h);
      const M4 here = open & (weight > zero);
      sum += Select4(here, weight, zero);
      D4 border = sum / total;
      // As AtAnEighth.
      const D4 eighths = Truncate4(border * Set4(8.0) + Set4(0.5));
      border = Select4(two & (sum < total) & (eighths > zero) & (eighths < Set4(8.0)),
                       eighths * Set4(0.125), border);
      at = Select4(here, Set4(static_cast<double>(k)), at);
      before = Select4(here, below, before);
      below = Select4(here, border, below);
      open &= ~(here & (u < below));
    }
    probability[h] = below - before;
    rest[h] = Min4(Max4((u - before) / probability[h], zero), Set4(kBelowOne));
    chosen[h] = at;
  }
  Choices8 out;
  out.place = reinterpret_cast<U8>(__builtin_convertvector(Join8(chosen[0], chosen[1]), M8));
  out.probability = Join8(probability[0], probability[1]);
  out.u = Join8(rest[0], rest[1]);
  out.any = Join8(any[0], any[1]) > Set8(0.0f);
  return out;
}

void LightTree::NodeWeights(const Node& node, const Vec3f& p, const Vec3f& n,
                            Weights& weights) const {
  const F8 zero = Set8(0), one = Set8(1), least = Set8(kLeastCosine);
  const F8 vx = Load8(node.x.data()) - Set8(p.x), vy = Load8(node.y.data()) - Set8(p.y),
           vz = Load8(node.z.data()) - Set8(p.z);
  const F8 radius = Load8(node.radius.data());
  const F8 d2 = vx * vx + vy * vy + vz * vz, d = Sqrt8(d2);
  const F8 height = vx * Set8(n.x) + vy * Set8(n.y) + vz * Set8(n.z);
  const M8 inside = d <= radius;
  // The sphere's half angle seen from p, and the receiver's angle to its nearest direction.
  const F8 inverse_d = one / Max8(d, Set8(std::numeric_limits<float>::min()));
  const F8 sin_b = Min8(radius * inverse_d, one), cos_b = Sqrt8(one - sin_b * sin_b);
  const F8 cos_i = Min8(Max8(height * inverse_d, -one), one);
  const F8 sin_i = Sqrt8(one - cos_i * cos_i);
  const F8 receiver = Select8(inside | (cos_i >= cos_b), one, cos_i * cos_b + sin_i * sin_b);
  // The emitters' angle to their cone, less the sphere's.
  F8 cos_w = -(vx * Load8(node.axis_x.data()) + vy * Load8(node.axis_y.data()) +
               vz * Load8(node.axis_z.data())) *
             inverse_d;
  const bool two_sided = emission_ == Emission::kTwoSidedCosine;
  if (two_sided) cos_w = Abs8(cos_w);
  cos_w = Min8(Max8(cos_w, -one), one);
  const F8 sin_w = Sqrt8(one - cos_w * cos_w);
  const F8 cos_o = Load8(node.cos_cone.data()), sin_o = Load8(node.sin_cone.data());
  // cos(o + b), and whether o + b reaches half a turn.
  const F8 cos_ob = cos_o * cos_b - sin_o * sin_b, sin_ob = sin_o * cos_b + cos_o * sin_b;
  const M8 within = inside | (sin_ob <= zero) | (cos_w >= cos_ob);
  F8 emitter;
  if (two_sided) {
    emitter = Max8(Select8(within, one, cos_w * cos_ob + sin_w * sin_ob), least);
  } else {
    emitter = Select8(within, one, zero);
  }
  const F8 near2 = Max8(d2, Set8(0.5f) * radius * radius);
  const M8 reaches = (height > -radius) & (d - radius < Load8(node.reach.data())) & (near2 > zero);
  const F8 weight = Load8(node.power.data()) * Max8(receiver, least) * emitter / near2;
  // Also against what is too small or too large for a float.
  Store8(weights.data(), Select8(reaches, Min8(Max8(weight, zero), Set8(1e30f)), zero));
}

}  // namespace farpoint

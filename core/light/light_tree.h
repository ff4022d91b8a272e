// A light tree (Conty Estevez and Kulla 2018, "Importance Sampling of Many Lights with Adaptive
// Tree Splitting"; bounds of light as in pbrt, 4th edition, 12.6.3) of eight children a node. Its
// leaves are blocks of up to eight lights, which the caller weighs himself, as exactly as he likes.
//
// A light is bounded by a box, a cone of directions and a power. What a node may send to a point:
//   power cosθ_receiver cosθ_emitter / d²,
// each cosine the largest that sphere and cone allow, d² at least what the node's own size is. It
// is 0 only where nothing can arrive. The choice among a node's children goes by the sums over
// *their* children (or by the blocks themselves), so each step looks six binary levels ahead: near
// a node its own bound says little.
#pragma once

#include <algorithm>
#include <array>
#include <cstdint>
#include <limits>
#include <optional>
#include <span>
#include <vector>

#include "core/math/simd8.h"
#include "core/math/vec.h"

namespace farpoint {

struct LightBounds {
  Box3f box;
  // The cone of normals (kTwoSidedCosine) or of directions of emission (kCone): unit axis and
  // cosine of the half angle; -1: all directions.
  Vec3f axis{0, 0, 1};
  float cos_cone = -1;
  float power = 0;  // > 0; in any unit common to the tree, at most 2^120
  float reach_m = std::numeric_limits<float>::infinity();  // sends nothing farther than that
};

// Immutable; thread-safe.
class LightTree {
 public:
  static constexpr uint32_t kWidth = 8;
  static constexpr uint32_t kNone = ~0u;
  enum class Emission {
    kTwoSidedCosine,  // Lambertian surfaces that emit from both sides
    kCone,            // the same in all directions of the cone
  };
  using Weights = std::array<float, kWidth>;

  LightTree() = default;  // empty: there is nothing to choose
  // O(n log n). The tree is a function of the lights in their order; scaling all lengths by a power
  // of two changes nothing.
  LightTree(std::span<const LightBounds> lights, Emission emission);

  bool empty() const { return order_.empty(); }
  // Block b of lights: indices order()[8 b] to order()[8 b + 7], the last ones kNone where the
  // block has fewer.
  std::span<const uint32_t> order() const { return order_; }

  // Weights of nodes and blocks for one point, kept while draws are made for it.
  class Cache {
   public:
    Cache() { key_.fill(kNone); }

   private:
    friend class LightTree;
    static constexpr uint32_t kSlots = 32;
    static uint32_t SlotOf(uint32_t at) { return (2 * at + (at >> 31)) % kSlots; }
    std::array<uint32_t, kSlots> key_;
    alignas(32) std::array<Weights, kSlots> weight_;
  };
  struct Choice {
    uint32_t place;      // index into order()
    double probability;  // > 0
  };
  // Draws a light for the point `p` with normal `n` by u in [0, 1), which becomes the place within
  // what was chosen, again in [0, 1). `cache` was used for no other point and normal.
  // `block_weights(b, weights)` sets the weights (finite, >= 0; 0 for an empty place) of block b,
  // always the same for one p and n. None if nothing can arrive.
  template <typename BlockWeights>
  std::optional<Choice> Choose(const Vec3f& p, const Vec3f& n, double& u, Cache& cache,
                               const BlockWeights& block_weights) const;
  // The probability by which Choose takes the light at `place` (not an empty one).
  template <typename BlockWeights>
  double ProbabilityOf(uint32_t place, const Vec3f& p, const Vec3f& n, Cache& cache,
                       const BlockWeights& block_weights) const;
  // True of up to eight lights: Choose is then ChooseInBlock of the weights of block 0.
  bool is_one_block() const { return root_ == kBlock; }
  static std::optional<Choice> ChooseInBlock(const Weights& weights, double& u);
  // The same for eight points at once, to the same bits.
  struct Choices8 {
    U8 place;
    F8 probability, u;
    M8 any;
  };
  // weights[i]: of light i, for each point, up to the last one that there is; `u` in 2^-32.
  static Choices8 ChooseInBlock8(std::span<const F8> weights, const U8& u);

 private:
  struct alignas(32) Node {
    Weights x, y, z, radius;  // bounding spheres of the children
    Weights axis_x, axis_y, axis_z, cos_cone, sin_cone;
    Weights power, reach;                // 0: no child
    std::array<uint32_t, kWidth> child;  // a node, or kBlock + a block
  };
  static constexpr uint32_t kBlock = 1u << 31;

  // The border between two halves of a light, such as the triangles of a quad, at the nearest whole
  // eighth: each then takes whole elementary intervals of a Sobol' sequence, which is worth more
  // than exact shares.
  static double AtAnEighth(double border) {
    const double eighths = static_cast<double>(static_cast<int>(border * 8.0 + 0.5));
    return eighths > 0.0 && eighths < 8.0 ? eighths / 8.0 : border;
  }
  uint32_t Build(std::span<const LightBounds> lights, std::span<uint32_t> items, unsigned depth,
                 LightBounds& bounds);
  void NodeWeights(const Node& node, const Vec3f& p, const Vec3f& n, Weights& weights) const;
  // Of the children of the node, or the lights of the block, `at`.
  template <typename BlockWeights>
  const Weights& WeightsOf(uint32_t at, const Vec3f& p, const Vec3f& n, Cache& cache,
                           const BlockWeights& block_weights) const;
  // By which ChooseInBlock takes `chosen`.
  static double ProbabilityInBlock(const Weights& weights, uint32_t chosen);
  void FindParents();

  Emission emission_ = Emission::kCone;
  uint32_t root_ = kNone;
  std::vector<Node> nodes_;
  std::vector<uint32_t> order_;
  struct Parent {
    uint32_t node = kNone, child = 0;
  };
  std::vector<Parent> parent_of_node_, parent_of_block_;
};

inline std::optional<LightTree::Choice> LightTree::ChooseInBlock(const Weights& weights,
                                                                 double& u) {
  constexpr double kBelowOne = 1.0 - 0x1p-53;
  double total = 0;
  uint32_t positive = 0;
  for (const float w : weights) {
    total += static_cast<double>(w);
    positive += w > 0 ? 1u : 0u;
  }
  if (!(total > 0)) return std::nullopt;
  // Side by side in [0, 1).
  uint32_t chosen = 0;
  double sum = 0, before = 0, below = 0;
  for (uint32_t k = 0; k < kWidth; ++k) {
    if (!(weights[k] > 0)) continue;
    chosen = k;
    sum += static_cast<double>(weights[k]);
    before = below;
    below = sum / total;
    if (positive == 2 && sum < total) below = AtAnEighth(below);
    if (u < below) break;
  }
  u = std::clamp((u - before) / (below - before), 0.0, kBelowOne);
  return Choice{chosen, below - before};
}

template <typename BlockWeights>
std::optional<LightTree::Choice> LightTree::Choose(const Vec3f& p, const Vec3f& n, double& u,
                                                   Cache& cache,
                                                   const BlockWeights& block_weights) const {
  double probability = 1;
  uint32_t at = root_;
  if (at == kNone) return std::nullopt;
  for (;;) {
    const uint32_t index = at & ~kBlock;
    const std::optional<Choice> step = ChooseInBlock(WeightsOf(at, p, n, cache, block_weights), u);
    if (!step) return std::nullopt;
    probability *= step->probability;
    if ((at & kBlock) != 0) return Choice{index * kWidth + step->place, probability};
    at = nodes_[index].child[step->place];
  }
}

template <typename BlockWeights>
const LightTree::Weights& LightTree::WeightsOf(uint32_t at, const Vec3f& p, const Vec3f& n,
                                               Cache& cache,
                                               const BlockWeights& block_weights) const {
  const uint32_t index = at & ~kBlock;
  const uint32_t slot = Cache::SlotOf(at);
  Weights& weight = cache.weight_[slot];
  if (cache.key_[slot] == at) return weight;
  cache.key_[slot] = at;
  if ((at & kBlock) != 0) {
    block_weights(index, weight);
    return weight;
  }
  const Node& node = nodes_[index];
  alignas(32) Weights bound, below;
  NodeWeights(node, p, n, bound);
  for (uint32_t k = 0; k < kWidth; ++k) {
    weight[k] = 0;
    if (!(bound[k] > 0)) continue;
    const uint32_t child = node.child[k];
    if ((child & kBlock) != 0) {
      block_weights(child & ~kBlock, below);
    } else {
      NodeWeights(nodes_[child], p, n, below);
    }
    for (const float w : below) weight[k] += w;
  }
  return weight;
}

template <typename BlockWeights>
double LightTree::ProbabilityOf(uint32_t place, const Vec3f& p, const Vec3f& n, Cache& cache,
                                const BlockWeights& block_weights) const {
  const uint32_t block = place / kWidth;
  double probability =
      ProbabilityInBlock(WeightsOf(block | kBlock, p, n, cache, block_weights), place % kWidth);
  for (Parent at = parent_of_block_[block]; at.node != kNone && probability > 0;
       at = parent_of_node_[at.node]) {
    probability *= ProbabilityInBlock(WeightsOf(at.node, p, n, cache, block_weights), at.child);
  }
  return probability;
}

}  // namespace farpoint

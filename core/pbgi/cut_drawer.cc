#include "core/pbgi/cut_drawer.h"

#include <algorithm>
#include <bit>
#include <cstddef>

#include "core/base/fp_trap.h"
#include "core/math/simd8.h"
#include "core/math/transpose8.h"

namespace farpoint {

namespace {

// With fewer full pixels than one in so many, asking costs more than it saves.
constexpr uint32_t kWorthwhile = 16;
// A sorted cut is drawn in pieces; before each it is found out what is closed. The first piece, and
// how much longer the next one is.
constexpr size_t kFirstPiece = 1024;
// Views that do not ask after one of which little was hidden, doubled each time up to a limit.
constexpr int kIdleViews = 31, kMostIdleViews = 255;

// Copies the nodes of `cut` that touch open pixels to `out`, which has room for them and eight
// more. `cut` may be read up to eight bytes beyond its end. The number of those.
size_t KeepOpen(std::span<const CutNode> cut, const ClosedPixels& closed, uint32_t first_inner_slot,
                float leaf_radius_m, CutNode* out) {
  const FpTrapPause pause;  // lanes beyond the end
  CutNode* const begin = out;
  // Surfels that are boxes whatever their size, by squared distance and solid angle.
  const F8 disc = Set8(3.1416f * leaf_radius_m * leaf_radius_m);
  const F8 box_pixels = Set8(0.99f * kExactDiscPixels * kExactDiscPixels);
  for (size_t i = 0; i < cut.size(); i += 8) {
    const size_t count = std::min<size_t>(8, cut.size() - i);
    __m256 rows[8], lanes[8];
    for (size_t k = 0; k < 8; ++k) {
      rows[k] = _mm256_loadu_ps(reinterpret_cast<const float*>(&cut[i + std::min(k, count - 1)]));
      lanes[k] = rows[k];
    }
    Transpose8(lanes);
    const auto lane = [&](int k) { return reinterpret_cast<F8>(lanes[k]); };
    const auto slot = reinterpret_cast<__m256i>(lanes[0]);
    const F8 d = lane(1), omega = Abs8(lane(5));
    const ClosedPixels::Places places = closed.At({lane(2), lane(3), lane(4)});
    const F8 half = Set8(0.5f * kCoverageBoxScale * 1.001f) * Sqrt8(omega / places.solid_angle);
    const auto inner = reinterpret_cast<M8>(_mm256_cmpeq_epi32(
        _mm256_max_epu32(slot, _mm256_set1_epi32(static_cast<int>(first_inner_slot))), slot));
    const M8 box = inner | (disc <= box_pixels * places.solid_angle * d * d);
    const unsigned hidden = Bits8(box) & closed.AllClosed(places, half);
    unsigned kept = ~hidden & ((1u << count) - 1u);
    // Whole rows are written, each over the end of the one before it.
    for (; kept != 0; kept &= kept - 1) {
      _mm256_storeu_ps(reinterpret_cast<float*>(out++), rows[std::countr_zero(kept)]);
    }
  }
  return static_cast<size_t>(out - begin);
}

}  // namespace

CutDrawer::CutDrawer(const PointTree& tree, const MicrobufferMap& map, const CutParams& params,
                     Splat splat, bool hide)
    : tree_(tree), params_(params), splat_(splat), shells_(tree, params) {
  if (hide && map.kind() == BufferMap::kOctahedral && map.side() >= ClosedPixels::kLargest) {
    closed_.emplace(map);
  }
}

const ClosedPixels* CutDrawer::Find(const CutView& view, const Microbuffer& buffer,
                                    float distance_m) {
  closed_->Find(buffer, view, splat_, distance_m, tree_.largest_radius_m());
  return closed_->full() >= closed_->map().pixels() / kWorthwhile ? &*closed_ : nullptr;
}

size_t CutDrawer::DrawSorted(const CutView& view, Microbuffer& buffer, RasterCounters& counters) {
  const uint32_t first_inner_slot = tree_.levels() > 1 ? tree_.first_group(1) * kLanes : ~0u;
  const size_t size = cut_.size();
  cut_.resize(size + 1);  // may be read
  scratch_.resize(size + 8);
  size_t left_out = 0, piece = kFirstPiece;
  for (size_t begin = 0; begin < size;) {
    const size_t count = size - begin < 2 * piece ? size - begin : piece;
    std::span<const CutNode> nodes(cut_.data() + begin, count);
    const ClosedPixels* const closed =
        buffer.empty() ? nullptr : Find(view, buffer, SortKeyFloor(nodes.front().distance_m));
    if (closed != nullptr) {
      const size_t kept =
          KeepOpen(nodes, *closed, first_inner_slot, tree_.largest_radius_m(), scratch_.data());
      left_out += count - kept;
      nodes = {scratch_.data(), kept};
    }
    RasterizeCut(tree_, view, nodes, splat_, buffer, counters);
    begin += count;
    piece += piece / 2;
  }
  return left_out;
}

void CutDrawer::Learn(size_t nodes, size_t left_out, uint64_t subtrees) {
  // A subtree is worth many nodes.
  const size_t saved = left_out + 16 * static_cast<size_t>(subtrees);
  const size_t all = nodes + 16 * static_cast<size_t>(subtrees);
  next_idle_ = saved * kWorthwhilePart < all
                   ? std::clamp(2 * next_idle_ + 1, kIdleViews, kMostIdleViews)
                   : 0;
  idle_ = next_idle_;
}

}  // namespace farpoint

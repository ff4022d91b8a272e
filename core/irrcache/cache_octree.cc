#include "core/irrcache/cache_octree.h"

#include <algorithm>

namespace farpoint {

namespace {

// Cells below this part of the largest coordinate are smaller than what floats can tell apart.
constexpr float kLeastSide = 1.0f / (1 << 20);

}  // namespace

CacheOctree::CacheOctree(const Box3f& bounds) : cells_(1) {
  const Vec3f extent = bounds.empty() ? Vec3f(1) : bounds.max - bounds.min;
  const Vec3f centre = bounds.empty() ? Vec3f() : bounds.Center();
  // A little more, so that rounding leaves no point outside; a single point has no extent.
  least_side_ = kLeastSide * std::max(MaxAbs(centre), MaxComponent(extent));
  side_ = std::max(1.01f * MaxComponent(extent), least_side_);
  low_ = centre - Vec3f(0.5f * side_);
}

float CacheOctree::Distance2(const Vec3f& p, const Vec3f& low, float side) {
  float sum = 0;
  for (int axis = 0; axis < 3; ++axis) {
    const float d = std::max({low[axis] - p[axis], 0.0f, p[axis] - (low[axis] + side)});
    sum += d * d;
  }
  return sum;
}

void CacheOctree::Insert(uint32_t id, const Vec3f& centre, float radius_m) {
  InsertIn(0, low_, side_, id, centre, radius_m);
}

void CacheOctree::InsertIn(int32_t cell, const Vec3f& low, float side, uint32_t id,
                           const Vec3f& centre, float radius_m) {
  const float half = 0.5f * side;
  // Cells at least as wide as the sphere: it overlaps eight of them at most.
  if (half < 2.0f * radius_m || half <= least_side_) {
    int32_t& first = cells_[static_cast<size_t>(cell)].first;
    entries_.push_back({id, first});
    first = static_cast<int32_t>(entries_.size() - 1);
    return;
  }
  for (uint32_t i = 0; i < 8; ++i) {
    const Vec3f child_low = ChildLow(low, half, i);
    if (!(Distance2(centre, child_low, half) <= radius_m * radius_m)) continue;
    int32_t child = cells_[static_cast<size_t>(cell)].children[i];
    if (child < 0) {
      child = static_cast<int32_t>(cells_.size());
      cells_.emplace_back();
      cells_[static_cast<size_t>(cell)].children[i] = child;
    }
    InsertIn(child, child_low, half, id, centre, radius_m);
  }
}

}  // namespace farpoint

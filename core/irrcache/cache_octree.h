// Spheres of influence, found by the points within them: an octree in whose cells lie the spheres
// that overlap them and are not much smaller (Ward, Rubinstein and Clear 1988, §3). A sphere lies
// in at most eight cells, and all that can hold a point lie in the cells from the root to the one
// about the point.
#pragma once

#include <array>
#include <cstdint>
#include <vector>

#include "core/math/vec.h"

namespace farpoint {

// Queries are thread-safe among themselves, not with Insert.
class CacheOctree {
 public:
  // `bounds` hold all centres and points; the root is 1 % larger, against rounding.
  explicit CacheOctree(const Box3f& bounds);

  // Radius positive. The tree keeps no radii: spheres may shrink afterwards.
  void Insert(uint32_t id, const Vec3f& centre, float radius_m);

  // Calls visit(id) for the spheres that may hold `p`, each once: all that do, and some that do
  // not. The order depends on the order of insertion only.
  template <typename Visit>
  void AtPoint(const Vec3f& p, Visit&& visit) const {
    Vec3f low = low_;
    float side = side_;
    for (int32_t cell = 0; cell >= 0;) {
      VisitCell(cells_[static_cast<size_t>(cell)].first, visit);
      side *= 0.5f;
      uint32_t child = 0;
      for (int axis = 0; axis < 3; ++axis) {
        if (p[axis] >= low[axis] + side) {
          child |= 1u << axis;
          low[axis] += side;
        }
      }
      cell = cells_[static_cast<size_t>(cell)].children[child];
    }
  }

  // Calls visit(id) for all whose centre lies within `radius_m` of p, and for others near; one may
  // come several times.
  template <typename Visit>
  void Near(const Vec3f& p, float radius_m, Visit&& visit) const {
    NearIn(0, low_, side_, p, radius_m, visit);
  }

 private:
  struct Cell {
    std::array<int32_t, 8> children{-1, -1, -1, -1, -1, -1, -1, -1};
    int32_t first = -1;  // of its entries
  };
  struct Entry {
    uint32_t id;
    int32_t next;
  };

  static float Distance2(const Vec3f& p, const Vec3f& low, float side);
  void InsertIn(int32_t cell, const Vec3f& low, float side, uint32_t id, const Vec3f& centre,
                float radius_m);

  template <typename Visit>
  void VisitCell(int32_t entry, Visit& visit) const {
    for (; entry >= 0; entry = entries_[static_cast<size_t>(entry)].next) {
      visit(entries_[static_cast<size_t>(entry)].id);
    }
  }
  template <typename Visit>
  void NearIn(int32_t cell, const Vec3f& low, float side, const Vec3f& p, float radius_m,
              Visit& visit) const {
    if (!(Distance2(p, low, side) <= radius_m * radius_m)) return;
    const Cell& c = cells_[static_cast<size_t>(cell)];
    VisitCell(c.first, visit);
    const float half = 0.5f * side;
    for (uint32_t i = 0; i < 8; ++i) {
      if (c.children[i] < 0) continue;
      NearIn(c.children[i], ChildLow(low, half, i), half, p, radius_m, visit);
    }
  }
  static Vec3f ChildLow(const Vec3f& low, float half, uint32_t child) {
    return {low.x + (child & 1 ? half : 0.0f), low.y + (child & 2 ? half : 0.0f),
            low.z + (child & 4 ? half : 0.0f)};
  }

  Vec3f low_;
  float side_, least_side_;
  std::vector<Cell> cells_;
  std::vector<Entry> entries_;
};

}  // namespace farpoint

// Dart throwing within one cube of the surfel sampler, and the share of the cube's candidates that
// each surfel gets. Both go through candidates sorted by cell, so that what lies about a point
// lies side by side in memory.
#pragma once

#include <array>
#include <cstdint>
#include <span>
#include <vector>

#include "core/base/aligned.h"
#include "core/math/vec.h"
#include "core/pbgi/candidate_lanes.h"

namespace farpoint {

// Surfels compete only with those of the same side of a thin sheet: normals nearer than this.
inline constexpr float kSameSheetCosine = 0.5f;

struct AcceptedCandidate {
  Vec3f position;
  uint32_t triangle;
  Vec2f barycentric;
  uint32_t share;  // candidates that are nearest to it
  uint32_t cell;   // within its cube: (z * kCubeCells + y) * kCubeCells + x
};

// What one thread needs to work on a cube; used for one cube after the other. Cells of the cube
// have coordinates 0 to kCubeCells - 1 along each axis, those of its neighbours -1 and kCubeCells.
class CubeDarts {
 public:
  struct LocalCell {
    int x, y, z;
  };

  // A new cube whose cells, and distances between surfels, are `cell` wide.
  void Clear(float cell);
  // The candidates of `lanes` whose bits are set in `inside` lie in the cube, whose first cell is
  // (x, y, z) modulo 2^25. `normal` is that of the triangle.
  void Add(const CandidateLanes& lanes, unsigned inside, const std::array<uint32_t, 3>& first_cell,
           uint32_t triangle, const Vec3f& normal);
  size_t candidates() const { return raw_.size(); }
  // A surfel of a neighbour, or for AssignShares also of the cube; all come before Throw or
  // AssignShares. `share` must stay where it is until then. Cells beyond -1 … kCubeCells are
  // ignored.
  void AddSurfel(const LocalCell& cell, const Vec3f& position, const Vec3f& normal,
                 uint32_t* share);

  // Takes candidates in a random order that `random` seeds, leaves out those with a surfel of the
  // same sheet within less than a cell's width, and appends the others to `accepted`.
  void Throw(uint64_t random, std::vector<AcceptedCandidate>& accepted);
  // Adds each candidate to the share of the nearest surfel of the same sheet in its own cell and
  // the 26 about it (relaxed atomic additions: several cubes may add to one surfel at a time).
  void AssignShares();

 private:
  struct Raw {
    Vec3f position;
    uint32_t triangle;
    Vec2f barycentric;
    Vec3f normal;
    uint32_t cell;  // (z * kCubeCells + y) * kCubeCells + x
  };
  struct Surfel {
    Vec3f position, normal;
    uint32_t cell;  // (z * kGridSide + y) * kGridSide + x, one layer of the neighbours' cells first
    uint32_t* share;
  };
  // Positions and normals side by side, padded by at least eight elements that are no one's
  // neighbour (normal 0).
  struct Lanes {
    AlignedVector<float> x, y, z, nx, ny, nz;

    void Resize(size_t count);
    void Set(size_t i, const Vec3f& p, const Vec3f& n) {
      x[i] = p.x;
      y[i] = p.y;
      z[i] = p.z;
      nx[i] = n.x;
      ny[i] = n.y;
      nz[i] = n.z;
    }
  };
  static constexpr int kGridSide = kCubeCells + 2;

  // Sorts items by cell, rows of cells along x side by side: those of cells [x0, x1] of a row are
  // first(row, x0) … first(row, x1 + 1) - 1.
  template <int kSide>
  class CellStarts {
   public:
    // `cell_of(i)` for i in [0, count); `place(i, at)` is called once for each item.
    template <typename CellOf, typename Place>
    void Sort(size_t count, bool last_first, const CellOf& cell_of, const Place& place);
    uint32_t first(int row, int x) const {
      return starts_[static_cast<size_t>(row * (kSide + 1) + x)];
    }
    bool any(int row) const { return rows_[static_cast<size_t>(row)] != 0; }

   private:
    std::array<uint32_t, kSide * kSide*(kSide + 1)> starts_;  // of rows with anything in them
    std::array<uint32_t, kSide * kSide> rows_;                // items
    std::array<uint32_t, kSide * kSide * kSide> counts_;
  };

  void SortCandidates();
  // No surfel may stand any more within a cell's width of this one.
  void Close(const LocalCell& cell, const Vec3f& position, const Vec3f& normal);

  float cell2_ = 0;
  std::vector<Raw> raw_;
  std::vector<Surfel> surfels_;

  CellStarts<kCubeCells> candidate_starts_;
  CellStarts<kGridSide> surfel_starts_;
  Lanes sorted_;                    // candidates by cell
  AlignedVector<int32_t> open_;     // parallel to sorted_: -1, or 0 once a surfel is too near
  std::vector<uint32_t> place_of_;  // by raw candidate: in sorted_
  std::vector<uint32_t> raw_of_;    // by place: the raw candidate
  std::vector<uint32_t> order_;
  Lanes by_cell_;                    // surfels by cell
  std::vector<uint32_t> surfel_of_;  // by place in by_cell_
  Lanes near_;                       // surfels about one cell
  AlignedVector<uint32_t> near_place_;
  std::vector<uint32_t> shares_;  // by place in by_cell_
};

}  // namespace farpoint

// Where the candidates of the surfel sampler lie: space cut into cells, triangles cut into leaves
// with a few candidates each, eight of them at a time.
#pragma once

#include <array>
#include <bit>
#include <cstdint>

#include "core/math/sampling.h"
#include "core/math/simd8.h"
#include "core/math/vec8.h"

namespace farpoint {

// A cell is one spacing wide, a cube kCubeCells cells.
inline constexpr int kCubeBits = 4;
inline constexpr int kCubeCells = 1 << kCubeBits;
// Cells count modulo 2^25 along each axis, cubes modulo 2^21: those so far apart share a place in
// the tables, but never a distance.
inline constexpr int kCubeCoordinateBits = 21;
inline constexpr int32_t kCellMask = (int32_t{1} << (kCubeCoordinateBits + kCubeBits)) - 1;

// Space in cells, counted from the corner of the shape's box.
struct Lattice {
  Vec3f origin;
  float inverse_cell;

  // The cell's coordinate along axis x, y or z of the points at `p`, in [0, 2^25).
  U8 CellOf(F8 p, float origin_on_axis) const {
    // Clamped to what floats count exactly with room, whatever the shape.
    const F8 most = Set8(0x1p50f);
    const F8 c = Max8(Min8((p - Set8(origin_on_axis)) * Set8(inverse_cell), most), -most);
    // All exact: powers of two, and a difference of multiples of one ulp.
    const auto cell = _mm256_floor_ps(reinterpret_cast<__m256>(c));
    const auto periods = _mm256_round_ps(_mm256_mul_ps(cell, _mm256_set1_ps(0x1p-25f)),
                                         _MM_FROUND_TO_ZERO | _MM_FROUND_NO_EXC);
    const auto rest = _mm256_sub_ps(cell, _mm256_mul_ps(periods, _mm256_set1_ps(0x1p25f)));
    return reinterpret_cast<U8>(_mm256_cvttps_epi32(rest)) & static_cast<uint32_t>(kCellMask);
  }
};

// A part of a triangle with a few candidates.
struct CandidateLeaf {
  static constexpr uint32_t kMaxCandidates = 32;
  std::array<Vec2f, 3> corner;  // barycentric
  uint32_t triangle;
  uint32_t kept;  // a bit for each candidate that lies in no hole
  uint64_t seed;
};

// Eight candidates of a leaf.
struct CandidateLanes {
  F8 b1, b2;    // barycentric weights of vertices 1 and 2
  V8 position;  // in the shape's frame
  U8 cell_x, cell_y, cell_z;
  uint32_t first;  // lane k is candidate first + k
  uint32_t kept;   // bit k: lane k is a candidate in no hole
};

// Calls visit(lanes) for the candidates of a leaf on the triangle (a, a + e1, a + e2): a Kronecker
// sequence of the plastic number (Roberts 2018, "The unreasonable effectiveness of quasirandom
// sequences"), started at random and folded onto the leaf.
template <typename Visit>
void ForCandidates(const CandidateLeaf& leaf, const Vec3f& a, const Vec3f& e1, const Vec3f& e2,
                   const Lattice& lattice, Visit&& visit) {
  const Vec2f b0 = leaf.corner[0];
  const Vec2f d1{leaf.corner[1].x - b0.x, leaf.corner[1].y - b0.y};
  const Vec2f d2{leaf.corner[2].x - b0.x, leaf.corner[2].y - b0.y};
  const auto seed_u = static_cast<uint32_t>(leaf.seed >> 32);
  const auto seed_v = static_cast<uint32_t>(leaf.seed);
  const V8 va(a), v1(e1), v2(e2);
  const U8 iota = {0, 1, 2, 3, 4, 5, 6, 7};
  CandidateLanes lanes;
  for (lanes.first = 0; lanes.first < CandidateLeaf::kMaxCandidates; lanes.first += 8) {
    const uint32_t rest = leaf.kept >> lanes.first;
    if (rest == 0) break;
    lanes.kept = rest & 0xffu;
    if (lanes.kept == 0) continue;
    const U8 k = iota + lanes.first;
    U8 u = k * 0xc13fa9a9u + seed_u;
    U8 v = k * 0x91e10da5u + seed_v;
    const U8 folded = reinterpret_cast<U8>(u > ~v);
    u ^= folded;  // all bits turned where the point lies beyond the diagonal
    v ^= folded;
    const auto to_unit = [](U8 bits) {
      return __builtin_convertvector(reinterpret_cast<M8>(bits >> 8), F8) *
             Set8(1.0f / 16777216.0f);
    };
    const F8 fu = to_unit(u), fv = to_unit(v);
    lanes.b1 = Set8(b0.x) + Set8(d1.x) * fu + Set8(d2.x) * fv;
    lanes.b2 = Set8(b0.y) + Set8(d1.y) * fu + Set8(d2.y) * fv;
    lanes.position = va + v1 * lanes.b1 + v2 * lanes.b2;
    lanes.cell_x = lattice.CellOf(lanes.position.x, lattice.origin.x);
    lanes.cell_y = lattice.CellOf(lanes.position.y, lattice.origin.y);
    lanes.cell_z = lattice.CellOf(lanes.position.z, lattice.origin.z);
    visit(lanes);
  }
}

}  // namespace farpoint

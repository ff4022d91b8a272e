// Cells of surface that are fixed in the scene: where a moving camera finds its gather records
// again.
//
// A cell is a square of side h, a power of two, in the coordinate plane that the surface faces most
// (its `face`), within a layer of height h across it. Its place is the point where a probe meets a
// surface first that crosses the layer (and a quarter of h more on either side) at a point of the
// square's middle, jittered by the cell's own coordinates. So the place is a function of the cell,
// the scene and the seed; a camera decides which cells are asked for, and how large, and may refuse
// places that it does not see.
#pragma once

#include <compare>
#include <cstddef>
#include <cstdint>

#include "core/pbgi/receiver_cluster.h"

namespace farpoint {

struct WorldCell {
  int64_t i = 0, j = 0, layer = 0;
  int16_t exponent = 0;  // h = 2^exponent metres
  int16_t face = 0;      // 2 axis + (1: the surface faces the axis' positive end)

  auto operator<=>(const WorldCell&) const = default;
};

// Well mixed; without the exponent, so that a scene scaled by a power of two has the same places
// and rays.
uint64_t HashOf(const WorldCell& cell, uint64_t seed);

struct WorldCellHash {
  size_t operator()(const WorldCell& cell) const { return HashOf(cell, 0); }
};

// The cell of a receiver, h in (side_m / 2, side_m], or more where floats near the receiver are too
// coarse for that. side_m > 0.
WorldCell CellOf(const Receiver& receiver, float side_m, uint64_t seed);

struct CellProbe {
  Vec3f origin, direction;  // unit
  float length_m;
};

CellProbe ProbeOf(const WorldCell& cell, uint64_t seed);

}  // namespace farpoint

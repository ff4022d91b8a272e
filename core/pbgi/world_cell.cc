#include "core/pbgi/world_cell.h"

#include <algorithm>
#include <cmath>
#include <limits>

#include "core/math/sampling.h"

namespace farpoint {

namespace {

// Part of the square's side within which its place lies.
constexpr float kJitter = 0.5f;
// The layers' borders, in h: not where floors are built.
constexpr float kLayerOffset = 0.37f;
// What a probe sees beyond its layer, in h.
constexpr float kBeyond = 0.25f;
// A cell is at least so many (binary) digits below the largest coordinate.
constexpr int kDigits = 18;
enum : uint64_t { kKeyPlace = 41 };

// The exponent of the largest power of two that is not above x > 0.
int FloorLog2(float x) {
  int exponent;
  std::frexp(x, &exponent);
  return exponent - 1;
}

// The probe's point in the square, in units of h.
void PlaceInSquare(const WorldCell& cell, uint64_t seed, float& u, float& v) {
  WorldCell square = cell;
  square.layer = 0;
  const uint64_t bits = HashKey(HashOf(square, seed), kKeyPlace);
  const auto jittered = [](int64_t at, uint64_t random) {
    return static_cast<float>(at) + 0.5f * (1 - kJitter) +
           kJitter * ToUnitFloat(static_cast<uint32_t>(random));
  };
  u = jittered(cell.i, bits);
  v = jittered(cell.j, bits >> 32);
}

}  // namespace

uint64_t HashOf(const WorldCell& cell, uint64_t seed) {
  return HashKey(seed, static_cast<uint64_t>(cell.i), static_cast<uint64_t>(cell.j),
                 static_cast<uint64_t>(cell.layer), static_cast<uint64_t>(cell.face));
}

WorldCell CellOf(const Receiver& receiver, float side_m, uint64_t seed) {
  const Vec3f& p = receiver.position;
  const Vec3f& n = receiver.geometric_normal;
  const float steep[3] = {std::fabs(n.x), std::fabs(n.y), std::fabs(n.z)};
  const int axis = static_cast<int>(std::max_element(steep, steep + 3) - steep);
  const int a = (axis + 1) % 3, b = (axis + 2) % 3;
  WorldCell cell;
  cell.face = static_cast<int16_t>(2 * axis + (n[axis] > 0.0f ? 1 : 0));
  int exponent = FloorLog2(std::max(side_m, std::numeric_limits<float>::min()));
  const float largest = std::max({std::fabs(p.x), std::fabs(p.y), std::fabs(p.z)});
  if (largest > 0.0f) exponent = std::max(exponent, FloorLog2(largest) - kDigits);
  cell.exponent = static_cast<int16_t>(exponent);
  // Exact but for denormals.
  const float u = std::ldexp(p[a], -exponent), v = std::ldexp(p[b], -exponent);
  cell.i = static_cast<int64_t>(std::floor(u));
  cell.j = static_cast<int64_t>(std::floor(v));
  float pu, pv;
  PlaceInSquare(cell, seed, pu, pv);
  const float slope = 1.0f / n[axis];
  const float w = std::ldexp(p[axis], -exponent) - ((pu - u) * n[a] + (pv - v) * n[b]) * slope;
  cell.layer = static_cast<int64_t>(std::floor(w + kLayerOffset));
  return cell;
}

CellProbe ProbeOf(const WorldCell& cell, uint64_t seed) {
  const int axis = cell.face / 2;
  const bool positive = cell.face % 2 != 0;
  float u, v;
  PlaceInSquare(cell, seed, u, v);
  const float bottom = static_cast<float>(cell.layer) - kLayerOffset - kBeyond;
  const float length = 1 + 2 * kBeyond;
  CellProbe probe;
  probe.origin[(axis + 1) % 3] = std::ldexp(u, cell.exponent);
  probe.origin[(axis + 2) % 3] = std::ldexp(v, cell.exponent);
  probe.origin[axis] = std::ldexp(positive ? bottom + length : bottom, cell.exponent);
  probe.direction[axis] = positive ? -1.0f : 1.0f;
  probe.length_m = std::ldexp(length, cell.exponent);
  return probe;
}

}  // namespace farpoint

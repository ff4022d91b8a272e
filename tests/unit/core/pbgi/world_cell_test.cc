#include "core/pbgi/world_cell.h"

#include <gtest/gtest.h>

#include <cmath>
#include <set>

#include "core/math/sampling.h"

namespace farpoint {
namespace {

float U(uint64_t i, uint64_t k) { return ToUnitFloat(static_cast<uint32_t>(HashKey(5, i, k))); }

Receiver On(const Vec3f& p, const Vec3f& n) {
  Receiver r;
  r.position = p;
  r.normal = r.geometric_normal = n;
  return r;
}

// Receivers of a plane agree about the cells' places: a probe meets the plane within the cell, and
// the point that it meets lies in the same cell, or in the layer beside it.
TEST(WorldCell, TheProbeMeetsTheReceiversPlaneInItsCell) {
  size_t same = 0;
  for (uint64_t i = 0; i < 3000; ++i) {
    const Vec3f n = UniformSphere(U(i, 0), U(i, 1));
    const Vec3f p = Vec3f(U(i, 2), U(i, 3), U(i, 4)) * 20.0f - Vec3f(10);
    const float side = 0.01f + U(i, 5);
    const WorldCell cell = CellOf(On(p, n), side, 7);
    const float h = std::ldexp(1.0f, cell.exponent);
    EXPECT_LE(h, side);
    EXPECT_GT(h, 0.5f * side);
    const CellProbe probe = ProbeOf(cell, 7);
    EXPECT_LT(Dot(probe.direction, n), -0.57f);
    EXPECT_NEAR(Length(probe.direction), 1, 1e-6);
    const float t = Dot(p - probe.origin, n) / Dot(probe.direction, n);
    ASSERT_GE(t, 0.25f * h - 1e-4f);
    ASSERT_LE(t, probe.length_m - 0.25f * h + 1e-4f);
    const Vec3f met = probe.origin + probe.direction * t;
    // A square's diagonal apart, on a plane that may be steep.
    EXPECT_LT(Length(met - p), 1.42f * 1.74f * h);
    same += CellOf(On(met, n), side, 7) == cell;
  }
  EXPECT_GT(same, 2990u);
}

// Scaling by a power of two changes no cell but its exponent.
TEST(WorldCell, ScalesByPowersOfTwo) {
  for (uint64_t i = 0; i < 500; ++i) {
    const Vec3f n = UniformSphere(U(i, 0), U(i, 1));
    const Vec3f p = Vec3f(U(i, 2), U(i, 3), U(i, 4)) - Vec3f(0.5f);
    const WorldCell cell = CellOf(On(p, n), 0.05f, 1);
    for (const int e : {-30, 3, 40}) {
      WorldCell scaled = CellOf(On(p * std::ldexp(1.0f, e), n), std::ldexp(0.05f, e), 1);
      EXPECT_EQ(scaled.exponent, cell.exponent + e);
      scaled.exponent = cell.exponent;
      EXPECT_EQ(scaled, cell);
    }
  }
}

TEST(WorldCell, SidesOfASheetAndSeedsDiffer) {
  const WorldCell up = CellOf(On({0.3f, 0.2f, 0}, {0, 0, 1}), 0.1f, 1);
  const WorldCell down = CellOf(On({0.3f, 0.2f, 0}, {0, 0, -1}), 0.1f, 1);
  EXPECT_NE(up, down);
  EXPECT_GT(ProbeOf(up, 1).origin.z, 0);
  EXPECT_LT(ProbeOf(down, 1).origin.z, 0);
  EXPECT_NE(ProbeOf(up, 1).origin.x, ProbeOf(up, 2).origin.x);
  std::set<uint64_t> hashes;
  for (int64_t i = -20; i < 20; ++i) {
    for (int64_t j = -20; j < 20; ++j) hashes.insert(HashOf({i, j, i - j, -3, 2}, 9));
  }
  EXPECT_EQ(hashes.size(), 1600u);
}

// Far from the origin and close to the eye a cell is no finer than floats are.
TEST(WorldCell, IsNoFinerThanFloats) {
  const Receiver far = On({1e6f, -3e5f, 2e4f}, {0, 1, 0});
  const WorldCell cell = CellOf(far, 1e-20f, 1);
  EXPECT_GE(std::ldexp(1.0f, cell.exponent), 1e6f / (1 << 20));
  const CellProbe probe = ProbeOf(cell, 1);
  EXPECT_LT(Length(probe.origin - far.position), 3 * std::ldexp(1.0f, cell.exponent));
  // On the origin itself, seen from there.
  const WorldCell none = CellOf(On({0, 0, 0}, {1, 0, 0}), 0, 1);
  EXPECT_TRUE(std::isfinite(ProbeOf(none, 1).length_m));
}

}  // namespace
}  // namespace farpoint

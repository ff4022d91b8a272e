#include "core/pbgi/packed_nodes.h"

#include <gtest/gtest.h>

#include <cmath>
#include <limits>

#include "core/math/elementary.h"
#include "core/math/sampling.h"

namespace farpoint {
namespace {

float Uniform(uint64_t a, uint64_t b) { return ToUnitFloat(static_cast<uint32_t>(HashKey(a, b))); }

TEST(PackedNodes, AxesAreExactAndOtherNormalsNear) {
  for (const Vec3f& axis : {Vec3f(1, 0, 0), Vec3f(-1, 0, 0), Vec3f(0, 1, 0), Vec3f(0, -1, 0),
                            Vec3f(0, 0, 1), Vec3f(0, 0, -1), Vec3f(0, 0, 0)}) {
    EXPECT_EQ(UnpackNormal(PackNormal(axis)), axis);
  }
  for (uint64_t i = 0; i < 20000; ++i) {
    const Vec3f n =
        UniformSphere(Uniform(1, i), Uniform(2, i)) * (i % 2 == 0 ? 1.0f : Uniform(3, i));
    const uint32_t word = PackNormal(n);
    EXPECT_EQ(word & (kPackedFront | kPackedBack), 0u);
    EXPECT_LE(MaxAbs(UnpackNormal(word) - n), 0.5f / 511 + 1e-6f);
  }
}

TEST(PackedNodes, LanesEqualSingles) {
  alignas(32) uint32_t words[kLanes];
  for (uint64_t i = 0; i < 200; ++i) {
    for (uint32_t k = 0; k < kLanes; ++k) {
      words[k] = PackNormal(UniformSphere(Uniform(i, 2 * k), Uniform(i, 2 * k + 1))) |
                 (static_cast<uint32_t>(HashKey(i, k)) & (kPackedFront | kPackedBack));
    }
    const NormalLanes lanes(words);
    for (uint32_t k = 0; k < kLanes; ++k) {
      EXPECT_EQ(lanes.steps.Lane(k) * kInverseNormalSteps, UnpackNormal(words[k]));
      EXPECT_EQ((lanes.front() >> k & 1u) != 0, (words[k] & kPackedFront) != 0);
      EXPECT_EQ((lanes.back() >> k & 1u) != 0, (words[k] & kPackedBack) != 0);
    }
  }
}

TEST(PackedNodes, HalvesRoundAsTheirNamesSay) {
  for (uint64_t i = 0; i < 20000; ++i) {
    const float x = std::ldexp(Uniform(7, i), static_cast<int>(HashKey(8, i) % 40) - 24);
    const float above = HalfToFloat(HalfAbove(x)), below = HalfToFloat(HalfBelow(x));
    EXPECT_GE(above, x);
    EXPECT_LE(below, x);
    EXPECT_LE(above - below, std::max(x * 0x1p-10f, 0x1p-24f));
    EXPECT_TRUE(HalfToFloat(HalfNearest(x)) == above || HalfToFloat(HalfNearest(x)) == below);
    EXPECT_EQ(HalfNearest(x) != 0, x > 0.0f);
  }
  EXPECT_EQ(HalfNearest(1e-30f), 1u);
  EXPECT_EQ(HalfAbove(0.0f), 0u);
}

TEST(PackedNodes, PowersOfTwoAbove) {
  EXPECT_EQ(PowerOfTwoAbove(1.0f), 1.0f);
  EXPECT_EQ(PowerOfTwoAbove(1.0000001f), 2.0f);
  EXPECT_EQ(PowerOfTwoAbove(0.3f), 0.5f);
  EXPECT_EQ(PowerOfTwoAbove(0.0f), 0x1p-126f);
  EXPECT_EQ(PowerOfTwoAbove(std::numeric_limits<float>::max()), 0x1p127f);
}

TEST(RadianceUnit, HoldsNineBitsOfTheBrightestChannel) {
  for (const float brightest : {1e-18f, 0.01f, 1.0f, 511.5f, 1e6f, 1e25f}) {
    const RadianceUnit unit = RadianceUnit::For(brightest);
    for (uint64_t i = 0; i < 5000; ++i) {
      const float scale = brightest * std::ldexp(1.0f, -static_cast<int>(HashKey(4, i) % 28));
      const Rgb c(scale * Uniform(1, i), scale * Uniform(2, i), scale * Uniform(3, i));
      const Rgb got = unit.Unpack(unit.Pack(c));
      EXPECT_LE(MaxAbs(got - c), MaxComponent(c) * 0x1p-9f) << brightest;
    }
    const Rgb most(brightest, brightest, 0);
    EXPECT_LE(MaxAbs(unit.Unpack(unit.Pack(most)) - most), brightest * 0x1p-9f);
  }
}

TEST(RadianceUnit, RoundsToTheNearestWithoutBias) {
  const RadianceUnit unit = RadianceUnit::For(1.0f);
  double sum = 0, exact = 0;
  for (uint64_t i = 0; i < 100000; ++i) {
    const float x = 0.25f + 0.75f * Uniform(5, i);
    sum += static_cast<double>(unit.Unpack(unit.Pack(Rgb(x, x, x))).y);
    exact += static_cast<double>(x);
  }
  EXPECT_NEAR(sum / exact, 1.0, 2e-5);
}

TEST(RadianceUnit, OnlyBlackIsBlack) {
  const RadianceUnit unit = RadianceUnit::For(1e6f);
  EXPECT_EQ(unit.Pack(Rgb()), 0u);
  for (int c = 0; c < 3; ++c) {
    Rgb faint;
    faint[c] = 1e-20f;
    const Rgb got = unit.Unpack(unit.Pack(faint));
    EXPECT_GT(got[c], 0.0f);
    EXPECT_LT(got[c], 1e-3f);
    EXPECT_EQ(got[(c + 1) % 3], 0.0f);
  }
}

}  // namespace
}  // namespace farpoint

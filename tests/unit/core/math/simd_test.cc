#include <gtest/gtest.h>

#include <cmath>
#include <limits>
#include <random>

#include "core/math/elementary8.h"
#include "core/math/simd4d.h"
#include "core/math/vec8.h"

namespace farpoint {
namespace {

constexpr int kSamples = 100000;

F8 Uniform8(std::mt19937& random, float low, float high) {
  std::uniform_real_distribution<float> uniform(low, high);
  F8 v;
  for (int k = 0; k < 8; ++k) v[k] = uniform(random);
  return v;
}

TEST(Mask8, IsTheInverseOfBits8) {
  for (unsigned bits = 0; bits < 256; ++bits) EXPECT_EQ(Bits8(Mask8(bits)), bits);
}

TEST(Round8, TakesHalvesToTheEvenNumber) {
  const F8 rounded = Round8(F8{0.5f, 1.5f, 2.5f, -0.5f, -1.5f, 0.49f, 0.51f, -7.0f});
  const float expected[8] = {0, 2, 2, 0, -2, 0, 1, -7};
  for (int k = 0; k < 8; ++k) EXPECT_EQ(rounded[k], expected[k]);
}

TEST(Half4, HalvesJoinToTheWhole) {
  const F8 v = {1, -2, 0.1f, 3e38f, 1e-38f, 5, 6, -0.25f};
  const F8 joined = Join8(Half4(v, 0), Half4(v, 1));
  const U8 bits = {0, 1, 0x80000000u, 0xffffffffu, 0xfffffffeu, 12345, 1u << 24, (1u << 24) + 1};
  for (int k = 0; k < 8; ++k) {
    EXPECT_EQ(joined[k], v[k]);
    EXPECT_EQ(Half4(bits, k / 4)[k % 4], static_cast<double>(bits[k]));
  }
}

TEST(DetSinCos8, StaysWithinItsStatedErrors) {
  std::mt19937 random(1);
  double worst = 0, worst_eighth = 0;
  for (int i = 0; i < kSamples; ++i) {
    const F8 x = Uniform8(random, -100, 100), near = x * Set8(kPif / 400.0f);
    const SinCos8 far = DetSinCos8(x), eighth = DetSinCosEighth8(near);
    for (int k = 0; k < 8; ++k) {
      const SinCos exact = DetSinCos(x[k]), exact_eighth = DetSinCos(near[k]);
      worst =
          std::max({worst, std::fabs(far.sin[k] - exact.sin), std::fabs(far.cos[k] - exact.cos)});
      worst_eighth = std::max({worst_eighth, std::fabs(eighth.sin[k] - exact_eighth.sin),
                               std::fabs(eighth.cos[k] - exact_eighth.cos)});
    }
  }
  EXPECT_LT(worst, 2e-7);
  EXPECT_LT(worst_eighth, 1e-7);
}

TEST(DetAtan2Upper8, StaysWithinItsStatedRelativeError) {
  std::mt19937 random(2);
  double worst = 0;
  for (int i = 0; i < kSamples; ++i) {
    // Of all sizes: quotients from 2^-24 to 2^24.
    const F8 e = Uniform8(random, -24, 24), x = Uniform8(random, -1, 1);
    F8 y = Uniform8(random, 0, 1);
    for (int k = 0; k < 8; ++k) y[k] = std::ldexp(y[k], static_cast<int>(e[k]));
    const F8 angle = DetAtan2Upper8(y, x);
    for (int k = 0; k < 8; ++k) {
      const double exact = DetAtan2(y[k], x[k]);
      worst = std::max(worst, std::fabs(angle[k] - exact) / std::max(exact, 1e-30));
    }
  }
  EXPECT_LT(worst, 3e-7);
  const F8 axes = DetAtan2Upper8(F8{0, 0, 1, 1, 0, 1, 2, 0}, F8{0, 1, 0, 1, -1, -1, 0, 3});
  EXPECT_EQ(axes[0], 0.0f);
  EXPECT_EQ(axes[1], 0.0f);
  EXPECT_FLOAT_EQ(axes[2], 0.5f * kPif);
  EXPECT_FLOAT_EQ(axes[3], 0.25f * kPif);
  EXPECT_FLOAT_EQ(axes[4], kPif);
  EXPECT_FLOAT_EQ(axes[5], 0.75f * kPif);
}

TEST(V8, LanesAreThoseOfVec3) {
  std::mt19937 random(3);
  for (int i = 0; i < 1000; ++i) {
    const V8 a(Uniform8(random, -3, 3), Uniform8(random, -3, 3), Uniform8(random, -3, 3));
    const V8 b(Uniform8(random, -3, 3), Uniform8(random, -3, 3), Uniform8(random, -3, 3));
    const V8 unit = NormalizeOr(a, b);
    const Frame8 frame(unit);
    const V8 world = frame.ToWorld(b), sum = a + b * Dot(a, b) - (-a) / Length2(b);
    for (size_t k = 0; k < 8; ++k) {
      const Vec3f ak = a.Lane(k), bk = b.Lane(k);
      EXPECT_EQ(unit.Lane(k), NormalizeOr(ak, bk));
      EXPECT_EQ(Normalize(a).Lane(k), Normalize(ak));
      EXPECT_EQ(world.Lane(k), Frame(unit.Lane(k)).ToWorld(bk));
      EXPECT_EQ(sum.Lane(k), ak + bk * Dot(ak, bk) - (-ak) / Length2(bk));
    }
  }
}

TEST(V8, NormalizeFallsBackWhereThereIsNoDirection) {
  V8 v(Vec3f(0, 3e30f, 0));
  v.SetLane(1, Vec3f());
  v.SetLane(2, Vec3f(std::numeric_limits<float>::infinity(), 0, 0));
  v.SetLane(3, Vec3f(1e-42f, 0, 0));
  for (int c = 0; c < 3; ++c) {
    Vec3f bad(1, 1, 1);
    bad[c] = std::numeric_limits<float>::quiet_NaN();
    v.SetLane(static_cast<size_t>(4 + c), bad);
  }
  const V8 n = NormalizeOr(v, V8(Vec3f(0, 0, 1)));
  EXPECT_EQ(n.Lane(0), Vec3f(0, 1, 0));
  for (size_t k = 1; k < 7; ++k) EXPECT_EQ(n.Lane(k), Vec3f(0, 0, 1)) << k;
}

TEST(Frame8, HasTheSignOfZeroToo) {
  V8 n(Vec3f(1, 0, 0.0f));
  n.SetLane(1, Vec3f(1, 0, -0.0f));
  n.SetLane(2, Vec3f(0, 0, -1));
  const Frame8 frame(n);
  for (size_t k = 0; k < 3; ++k) {
    EXPECT_EQ(frame.t.Lane(k), Frame(n.Lane(k)).t);
    EXPECT_EQ(frame.b.Lane(k), Frame(n.Lane(k)).b);
  }
}

}  // namespace
}  // namespace farpoint

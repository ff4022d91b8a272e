#include "core/math/elementary.h"

#include <gtest/gtest.h>

#include <cmath>
#include <limits>
#include <random>

namespace farpoint {
namespace {

// The reference is libm in 80-bit long double, whose own error is below 1e-18.
constexpr int kSamples = 200000;

double Uniform(std::mt19937_64& random, double low, double high) {
  return std::uniform_real_distribution<double>(low, high)(random);
}

TEST(DetSinCos, StaysWithinItsStatedError) {
  std::mt19937_64 random(1);
  double worst = 0;
  for (int i = 0; i < kSamples; ++i) {
    const double x = Uniform(random, -100, 100);
    const SinCos sc = DetSinCos(x);
    worst = std::max(worst, static_cast<double>(fabsl(sc.sin - sinl(x))));
    worst = std::max(worst, static_cast<double>(fabsl(sc.cos - cosl(x))));
  }
  EXPECT_LT(worst, 1e-14);
}

TEST(DetSinCos, LargeAnglesKeepTheirQuadrant) {
  std::mt19937_64 random(2);
  for (int i = 0; i < kSamples; ++i) {
    const double x = Uniform(random, -1e6, 1e6);
    const SinCos sc = DetSinCos(x);
    ASSERT_NEAR(sc.sin, static_cast<double>(sinl(x)), 1e-12) << x;
    ASSERT_NEAR(sc.cos, static_cast<double>(cosl(x)), 1e-12) << x;
  }
}

TEST(DetSinCos, IsOddAndEvenAndExactAtZero) {
  EXPECT_EQ(DetSinCos(0).sin, 0.0);
  EXPECT_EQ(DetSinCos(0).cos, 1.0);
  for (double x = 0.001; x < 100; x *= 1.37) {
    EXPECT_EQ(DetSinCos(-x).sin, -DetSinCos(x).sin);
    EXPECT_EQ(DetSinCos(-x).cos, DetSinCos(x).cos);
  }
}

TEST(DetTan, IsTheQuotient) {
  for (double x = -1.5; x <= 1.5; x += 0.01) {
    const double expected = static_cast<double>(tanl(x));
    EXPECT_NEAR(DetTan(x), expected, 1e-13 * (1 + expected * expected)) << x;
  }
}

TEST(DetAtan2, StaysWithinItsStatedError) {
  std::mt19937_64 random(3);
  double worst = 0;
  for (int i = 0; i < kSamples; ++i) {
    const double scale = std::ldexp(1.0, static_cast<int>(random() % 200) - 100);
    const double y = scale * Uniform(random, -1, 1), x = scale * Uniform(random, -1, 1);
    worst = std::max(worst, static_cast<double>(fabsl(DetAtan2(y, x) - atan2l(y, x))));
  }
  for (const double x : {-2.0, -1e-300, 0.0, 1e-300, 2.0}) {
    for (const double y : {-1.0, -1e-300, 0.0, 1e-300, 1.0}) {
      if (x == 0 && y == 0) continue;
      worst = std::max(worst, static_cast<double>(fabsl(DetAtan2(y, x) - atan2l(y, x))));
    }
  }
  EXPECT_LT(worst, 1e-14);
  EXPECT_EQ(DetAtan2(0, 0), 0.0);
}

TEST(DetAcos, StaysWithinItsStatedErrors) {
  std::mt19937_64 random(4);
  double worst = 0, worst_at_the_ends = 0;
  for (int i = 0; i < kSamples; ++i) {
    const double x = Uniform(random, -1, 1);
    worst = std::max(worst, static_cast<double>(fabsl(DetAcos(x) - acosl(x))));
  }
  for (double d = 1e-15; d < 1; d *= 1.5) {
    for (const double x : {1 - d, d - 1}) {
      const double error = static_cast<double>(fabsl(DetAcos(x) - acosl(x)));
      double& bound = d <= 1e-15 ? worst_at_the_ends : worst;
      bound = std::max(bound, error);
    }
  }
  EXPECT_LT(worst, 1e-14);
  EXPECT_LT(worst_at_the_ends, 1e-8);
  EXPECT_EQ(DetAcos(1), 0.0);
  EXPECT_EQ(DetAcos(2), 0.0);
  EXPECT_NEAR(DetAcos(-1), kPi, 1e-15);
  EXPECT_NEAR(DetAcos(-7), kPi, 1e-15);
}

TEST(DetExp, StaysWithinItsStatedRelativeError) {
  std::mt19937_64 random(5);
  double worst = 0;
  for (int i = 0; i < kSamples; ++i) {
    const double x = i % 2 ? Uniform(random, -707, 707) : Uniform(random, -2, 2);
    const long double expected = expl(x);
    worst = std::max(worst, static_cast<double>(fabsl((DetExp(x) - expected) / expected)));
  }
  EXPECT_LT(worst, 1e-14);
}

TEST(DetExp, IsTotal) {
  EXPECT_EQ(DetExp(0), 1.0);
  EXPECT_EQ(DetExp(-709), 0.0);
  EXPECT_EQ(DetExp(-std::numeric_limits<double>::infinity()), 0.0);
  EXPECT_EQ(DetExp(1000), DetExp(708));
  EXPECT_TRUE(std::isfinite(DetExp(std::numeric_limits<double>::infinity())));
}

TEST(DetLog, StaysWithinItsStatedError) {
  std::mt19937_64 random(6);
  double worst = 0;
  for (int i = 0; i < kSamples; ++i) {
    const double x =
        i % 2 ? std::ldexp(Uniform(random, 1, 2), static_cast<int>(random() % 2040) - 1020)
              : Uniform(random, 0.5, 2);
    const long double expected = logl(x);
    const double error = static_cast<double>(fabsl(DetLog(x) - expected));
    worst = std::max(worst, error / std::max(1.0, static_cast<double>(fabsl(expected))));
  }
  EXPECT_LT(worst, 1e-14);
  EXPECT_EQ(DetLog(1), 0.0);
}

TEST(DetPow, AgreesWithLibm) {
  std::mt19937_64 random(7);
  for (int i = 0; i < kSamples; ++i) {
    const double x = Uniform(random, 1e-3, 10), y = Uniform(random, -4, 4);
    const double expected = static_cast<double>(powl(x, y));
    ASSERT_NEAR(DetPow(x, y) / expected, 1.0, 1e-13) << x << " " << y;
  }
  EXPECT_EQ(DetPow(0, 2), 0.0);
  EXPECT_EQ(DetPow(-1, 2), 0.0);
}

TEST(Srgb, RoundTripsAndMeetsItsPublishedPoints) {
  EXPECT_EQ(SrgbToLinear(0), 0.0);
  EXPECT_NEAR(SrgbToLinear(1), 1.0, 1e-14);
  EXPECT_NEAR(LinearToSrgb(1), 1.0, 1e-14);
  EXPECT_NEAR(SrgbToLinear(0.5), 0.21404114048223255, 1e-14);
  for (int i = 0; i <= 255; ++i) {
    const double v = i / 255.0;
    EXPECT_NEAR(LinearToSrgb(SrgbToLinear(v)), v, 1e-12) << i;
  }
}

}  // namespace
}  // namespace farpoint

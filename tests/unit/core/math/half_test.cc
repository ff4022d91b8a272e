#include "core/math/half.h"

#include <gtest/gtest.h>

#include <cmath>
#include <limits>

namespace farpoint {
namespace {

// The value of a finite half by the definition of binary16.
double Defined(uint16_t h) {
  const int exponent = h >> 10 & 31, fraction = h & 1023;
  const double magnitude =
      exponent == 0 ? std::ldexp(fraction, -24) : std::ldexp(1024 + fraction, exponent - 25);
  return h & 0x8000 ? -magnitude : magnitude;
}

TEST(Half, EveryFinitePatternHasItsDefinedValueAndRoundTrips) {
  for (uint32_t h = 0; h < 0x10000; ++h) {
    if ((h >> 10 & 31) == 31) continue;
    const float f = HalfToFloat(static_cast<uint16_t>(h));
    ASSERT_EQ(f, Defined(static_cast<uint16_t>(h))) << h;
    ASSERT_EQ(FloatToHalf(f), h) << h;
  }
}

TEST(Half, RoundsToTheNearestAndTiesToEven) {
  for (uint16_t h = 0; h < 0x7bff; ++h) {
    const float low = HalfToFloat(h), high = HalfToFloat(h + 1);
    const float middle = 0.5f * (low + high);  // exact: one more bit than a half has
    ASSERT_EQ(FloatToHalf(middle), h % 2 == 0 ? h : h + 1) << h;
    ASSERT_EQ(FloatToHalf(std::nextafter(middle, low)), h) << h;
    ASSERT_EQ(FloatToHalf(std::nextafter(middle, high)), h + 1) << h;
  }
}

TEST(Half, FiniteValuesBeyondTheRangeBecomeTheLargest) {
  for (const float f : {65504.0f, 65505.0f, 65520.0f, 1e6f, std::numeric_limits<float>::max()}) {
    EXPECT_EQ(HalfToFloat(FloatToHalf(f)), kMaxHalf);
    EXPECT_EQ(HalfToFloat(FloatToHalf(-f)), -kMaxHalf);
  }
}

TEST(Half, NanStaysNan) {
  EXPECT_TRUE(std::isnan(HalfToFloat(FloatToHalf(std::numeric_limits<float>::quiet_NaN()))));
}

}  // namespace
}  // namespace farpoint

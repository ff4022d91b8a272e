// Checked by hand against an independent script as well: docs/decisions/0010-image-metrics.md.
#include "core/image/flip_metric.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>

#include "core/math/sampling.h"

namespace farpoint {
namespace {

constexpr int kSize = 48;

RgbImage Constant(float r, float g, float b) {
  RgbImage image = {ImagePlane(kSize, kSize), ImagePlane(kSize, kSize), ImagePlane(kSize, kSize)};
  const float color[3] = {r, g, b};
  for (size_t c = 0; c < 3; ++c) std::ranges::fill(image[c].values, color[c]);
  return image;
}

RgbImage Noise(float scale) {
  RgbImage image = Constant(0, 0, 0);
  for (size_t c = 0; c < 3; ++c) {
    for (size_t i = 0; i < image[c].values.size(); ++i) {
      image[c].values[i] = scale * ToUnitFloat(static_cast<uint32_t>(HashKey(c, i)));
    }
  }
  return image;
}

std::vector<uint8_t> All() { return std::vector<uint8_t>(kSize * kSize, 1); }

double Mean(const ImagePlane& plane) {
  double sum = 0;
  for (const float v : plane.values) sum += v;
  return sum / static_cast<double>(plane.values.size());
}

TEST(LdrFlip, IsZeroForIdenticalImagesAndSymmetric) {
  const RgbImage a = Noise(1.0f), b = Constant(0.2f, 0.5f, 0.3f);
  EXPECT_EQ(Mean(LdrFlip(a, a, kFlipPixelsPerDegree)), 0.0);
  const ImagePlane ab = LdrFlip(a, b, kFlipPixelsPerDegree),
                   ba = LdrFlip(b, a, kFlipPixelsPerDegree);
  for (size_t i = 0; i < ab.values.size(); ++i) ASSERT_NEAR(ab.values[i], ba.values[i], 1e-6);
  EXPECT_GT(Mean(ab), 0.05);
}

// On flat images only the colour term is left. Green against blue is the largest difference, 1 by
// construction. Black against white: HyAB = 100, 100^0.7 = 25.12 over the knee of 0.4 · 41.28.
TEST(LdrFlip, FlatImagesHaveTheClosedForm) {
  const double flip = Mean(LdrFlip(Constant(0, 1, 0), Constant(0, 0, 1), kFlipPixelsPerDegree));
  EXPECT_NEAR(flip, 1.0, 1e-4);
  const double white = Mean(LdrFlip(Constant(0, 0, 0), Constant(1, 1, 1), kFlipPixelsPerDegree));
  EXPECT_NEAR(white, 0.95 + 0.05 * (25.119 - 0.4 * 41.276) / (0.6 * 41.276), 2e-4);
}

TEST(LdrFlip, StaysInTheUnitInterval) {
  for (const RgbImage& other : {Constant(0, 0, 0), Constant(1, 1, 1), Constant(1, 0, 0)}) {
    for (const float v : LdrFlip(Noise(1.0f), other, kFlipPixelsPerDegree).values) {
      ASSERT_GE(v, 0.0f);
      ASSERT_LE(v, 1.0f);
    }
  }
}

TEST(FlipExposures, TakeMaximumAndMedianToTheSameTone) {
  RgbImage image = Constant(1, 1, 1);
  image[0].values[0] = image[1].values[0] = image[2].values[0] = 16.0f;
  const ExposureRange range = FlipExposures(image, All());
  EXPECT_NEAR(range.stop_stops - range.start_stops, 4.0, 1e-5);  // 16 : 1
  EXPECT_EQ(range.count, 4);
  // The curve's value at the exposed median is 0.85.
  const double x = std::exp2(range.stop_stops);
  EXPECT_NEAR((0.36 * 2.51 * x * x + 0.018 * x) / (0.36 * 2.43 * x * x + 0.354 * x + 0.14), 0.85,
              1e-6);
}

TEST(FlipExposures, ABlackImageHasARange) {
  const ExposureRange range = FlipExposures(Constant(0, 0, 0), All());
  EXPECT_TRUE(std::isfinite(range.start_stops));
  EXPECT_TRUE(std::isfinite(range.stop_stops));
  EXPECT_EQ(range.count, 2);
}

TEST(HdrFlip, IsAtLeastEachOfItsExposures) {
  const RgbImage a = Noise(8.0f), b = Noise(7.0f);
  const ExposureRange range = FlipExposures(b, All());
  const double all = Mean(HdrFlip(a, b, range, kFlipPixelsPerDegree));
  const double first =
      Mean(HdrFlip(a, b, {range.start_stops, range.start_stops, 1}, kFlipPixelsPerDegree));
  EXPECT_GT(all, 0.0);
  EXPECT_GE(all, first);
  EXPECT_EQ(Mean(HdrFlip(a, a, range, kFlipPixelsPerDegree)), 0.0);
}

TEST(HdrFlip, DoesNotChangeWithTheUnitOfRadiance) {
  const RgbImage a = Noise(1.0f), b = Constant(0.4f, 0.4f, 0.4f);
  RgbImage a8 = a, b8 = b;
  for (size_t c = 0; c < 3; ++c) {
    for (float& v : a8[c].values) v *= 8.0f;
    for (float& v : b8[c].values) v *= 8.0f;
  }
  EXPECT_NEAR(Mean(HdrFlip(a, b, FlipExposures(b, All()), kFlipPixelsPerDegree)),
              Mean(HdrFlip(a8, b8, FlipExposures(b8, All()), kFlipPixelsPerDegree)), 1e-5);
}

TEST(HdrFlip, SurvivesNegativeAndHugeValues) {
  const RgbImage a = Constant(-1, 1e30f, 0), b = Constant(0.5f, 0.5f, 0.5f);
  for (const float v : HdrFlip(a, b, FlipExposures(b, All()), kFlipPixelsPerDegree).values) {
    ASSERT_TRUE(v >= 0.0f && v <= 1.0f);
  }
}

}  // namespace
}  // namespace farpoint

// Checked by hand against other programs as well: docs/decisions/0010-image-metrics.md.
#include "core/image/yee_metric.h"

#include <gtest/gtest.h>

#include <algorithm>

#include "core/math/sampling.h"

namespace farpoint {
namespace {

constexpr int kSize = 64;

RgbImage Constant(float r, float g, float b, int size = kSize) {
  RgbImage image = {ImagePlane(size, size), ImagePlane(size, size), ImagePlane(size, size)};
  const float color[3] = {r, g, b};
  for (size_t c = 0; c < 3; ++c) std::ranges::fill(image[c].values, color[c]);
  return image;
}

int64_t Count(const RgbImage& a, const RgbImage& b) {
  const std::vector<uint8_t> mask(a[0].values.size(), 1);
  return CountPerceptiblyDifferent(a, b, mask, {});
}

TEST(Yee, IdenticalImagesHaveNone) {
  RgbImage image = Constant(0, 0, 0);
  for (size_t c = 0; c < 3; ++c) {
    for (size_t i = 0; i < image[c].values.size(); ++i) {
      image[c].values[i] = ToUnitFloat(static_cast<uint32_t>(HashKey(c, i)));
    }
  }
  EXPECT_EQ(Count(image, image), 0);
}

// On flat images there is no masking: the threshold is the threshold versus intensity at the mean
// luminance. At 51.5 cd/m² (log 1.712): 10^((0.249 · 1.712 + 0.65)^2.7 − 0.72) = 3.16 cd/m².
TEST(Yee, FlatImagesDifferExactlyBeyondTheThreshold) {
  EXPECT_EQ(Count(Constant(0.5f, 0.5f, 0.5f), Constant(0.531f, 0.531f, 0.531f)), 0);
  EXPECT_EQ(Count(Constant(0.5f, 0.5f, 0.5f), Constant(0.5325f, 0.5325f, 0.5325f)), kSize * kSize);
}

TEST(Yee, ABigStepInLuminanceIsSeenEverywhere) {
  EXPECT_EQ(Count(Constant(0.1f, 0.1f, 0.1f), Constant(0.9f, 0.9f, 0.9f)), kSize * kSize);
}

// Equal luminance, other hue.
TEST(Yee, AHueIsSeenInLightButNotInTheDark) {
  const float r = 0.1f, g = r * 0.2126729f / 0.7151522f;
  const RgbImage red = Constant(0.5f + r, 0.5f - g, 0.5f), grey = Constant(0.5f, 0.5f, 0.5f);
  EXPECT_EQ(Count(red, grey), kSize * kSize);
  const RgbImage dark_red = Constant(0.0005f + r * 1e-3f, 0.0005f - g * 1e-3f, 0.0005f);
  EXPECT_EQ(Count(dark_red, Constant(0.0005f, 0.0005f, 0.0005f)), 0);
}

// A checkerboard hides what a flat image shows: masking.
TEST(Yee, ContrastMasks) {
  RgbImage busy = Constant(0.5f, 0.5f, 0.5f), busy_brighter = busy;
  for (size_t c = 0; c < 3; ++c) {
    for (int y = 0; y < kSize; ++y) {
      for (int x = 0; x < kSize; ++x) {
        const float v = (x / 4 + y / 4) % 2 ? 0.8f : 0.2f;
        busy[c].Row(y)[x] = v;
        busy_brighter[c].Row(y)[x] = v + 0.04f;
      }
    }
  }
  EXPECT_EQ(Count(Constant(0.5f, 0.5f, 0.5f), Constant(0.54f, 0.54f, 0.54f)), kSize * kSize);
  EXPECT_LT(Count(busy, busy_brighter), kSize * kSize / 4);
}

TEST(Yee, MapMarksWhereTheImagesDiffer) {
  const RgbImage a = Constant(0.5f, 0.5f, 0.5f);
  RgbImage b = a;
  for (ImagePlane& plane : b) plane.Row(kSize / 2)[kSize / 2] = 0.9f;
  std::vector<uint8_t> mask(a[0].values.size(), 1);
  const size_t centre = static_cast<size_t>(kSize / 2) * kSize + kSize / 2;
  std::vector<uint8_t> differs = PerceptiblyDifferent(a, b, mask, {});
  EXPECT_EQ(differs[centre], 1);
  EXPECT_EQ(differs[0], 0);
  EXPECT_EQ(std::count(differs.begin(), differs.end(), 1),
            CountPerceptiblyDifferent(a, b, mask, {}));
  mask[centre] = 0;
  differs = PerceptiblyDifferent(a, b, mask, {});
  EXPECT_EQ(differs[centre], 0);
}

TEST(Yee, IsSymmetricAndCountsTheMaskOnly) {
  RgbImage a = Constant(0.3f, 0.4f, 0.5f), b = a;
  for (size_t i = 0; i < a[0].values.size(); ++i) {
    b[i % 3].values[i] += 0.2f * ToUnitFloat(static_cast<uint32_t>(HashKey(i)));
  }
  const int64_t all = Count(a, b);
  EXPECT_GT(all, 0);
  EXPECT_EQ(Count(b, a), all);
  std::vector<uint8_t> upper(a[0].values.size(), 0), lower(a[0].values.size(), 1);
  std::fill_n(upper.begin(), upper.size() / 2, 1);
  std::fill_n(lower.begin(), lower.size() / 2, 0);
  EXPECT_EQ(CountPerceptiblyDifferent(a, b, upper, {}) + CountPerceptiblyDifferent(a, b, lower, {}),
            all);
}

}  // namespace
}  // namespace farpoint

#include "core/pbgi/microbuffer_map.h"

#include <gtest/gtest.h>

#include "core/math/elementary.h"
#include "core/math/sampling.h"

namespace farpoint {
namespace {

class Octahedral : public testing::TestWithParam<uint32_t> {};

TEST_P(Octahedral, SolidAnglesSumToTheSphere) {
  const MicrobufferMap map(BufferMap::kOctahedral, GetParam());
  double omega = 0;
  Vec3d v;
  for (uint32_t p = 0; p < map.pixels(); ++p) {
    omega += map.solid_angle()[p];
    v += Vec3d(map.weight(0)[p], map.weight(1)[p], map.weight(2)[p]);
    EXPECT_GT(map.solid_angle()[p], 0.0f);
  }
  EXPECT_NEAR(omega, 4 * kPi, 4 * kPi * 1e-6);
  EXPECT_NEAR(Length(v), 0, 1e-5);  // no direction is favoured
}

TEST_P(Octahedral, WeightsPointIntoTheirPixel) {
  // Pixels of less than four on a side are larger than a hemisphere's quarter: no one direction.
  const MicrobufferMap map(BufferMap::kOctahedral, std::max(4u, GetParam()));
  for (uint32_t p = 0; p < map.pixels(); ++p) {
    const Vec3f v(map.weight(0)[p], map.weight(1)[p], map.weight(2)[p]);
    const Vec3f c(map.dir(0)[p], map.dir(1)[p], map.dir(2)[p]);
    // |V| <= Ω, close to it for a small pixel, and V is near the centre's direction.
    EXPECT_LE(Length(v), map.solid_angle()[p] * 1.00001f);
    EXPECT_GT(Dot(Normalize(v), c), GetParam() >= 16 ? 0.99f : 0.85f) << p;
  }
}

TEST_P(Octahedral, CosineWeightsSumToPi) {
  const uint32_t side = std::max(16u, GetParam());
  const MicrobufferMap map(BufferMap::kOctahedral, side);
  for (uint32_t i = 0; i < 64; ++i) {
    const Vec3f n = UniformSphere(OwenSobol(i, 0, 1), OwenSobol(i, 1, 1));
    double sum = 0;
    for (uint32_t p = 0; p < map.pixels(); ++p) {
      sum +=
          std::max(0.0f, n.x * map.weight(0)[p] + n.y * map.weight(1)[p] + n.z * map.weight(2)[p]);
    }
    // Exact but for the pixels that straddle the horizon.
    EXPECT_NEAR(sum, kPi, kPi * 4.0 / (side * side)) << i;
  }
}

TEST_P(Octahedral, ProjectInvertsUnproject) {
  const uint32_t side = GetParam();
  const MicrobufferMap map(BufferMap::kOctahedral, side);
  for (uint32_t i = 0; i < 1000; ++i) {
    const float u = OwenSobol(i, 0, 3) * static_cast<float>(side);
    const float v = OwenSobol(i, 1, 3) * static_cast<float>(side);
    const Vec3f w = map.Unproject(u, v);
    EXPECT_NEAR(Length(w), 1.0f, 1e-6f);
    const Vec2f back = map.Project(w);
    EXPECT_LT(Length(map.Unproject(back.x, back.y) - w), 1e-5f);
  }
}

TEST_P(Octahedral, WrapGivesTheNeighbourOnTheSphere) {
  const int n = static_cast<int>(GetParam());
  if (n < 8) return;
  const MicrobufferMap map(BufferMap::kOctahedral, GetParam());
  const auto centre = [&](int32_t p) { return Vec3f(map.dir(0)[p], map.dir(1)[p], map.dir(2)[p]); };
  const float pixel_rad = 6.0f / static_cast<float>(n);  // the widest pixels
  for (int i = 0; i < n; ++i) {
    EXPECT_LT(Length(centre(map.Wrap(i, -1)) - centre(map.Wrap(i, 0))), pixel_rad);
    EXPECT_LT(Length(centre(map.Wrap(i, n)) - centre(map.Wrap(i, n - 1))), pixel_rad);
    EXPECT_LT(Length(centre(map.Wrap(-1, i)) - centre(map.Wrap(0, i))), pixel_rad);
    EXPECT_LT(Length(centre(map.Wrap(n, i)) - centre(map.Wrap(n - 1, i))), pixel_rad);
  }
}

INSTANTIATE_TEST_SUITE_P(Sides, Octahedral, testing::Values(1, 2, 3, 8, 15, 24, 32, 33, 64));

TEST(CosineMap, EachPixelHasTheSameCosineWeight) {
  for (const uint32_t side : {1u, 4u, 23u, 24u, 64u}) {
    const MicrobufferMap map(BufferMap::kCosine, side);
    double cosine = 0;
    for (uint32_t p = 0; p < map.pixels(); ++p) cosine += map.weight(2)[p];
    EXPECT_NEAR(cosine, kPi, kPi * 1e-6) << side;
  }
}

TEST(CosineMap, ProjectInvertsUnproject) {
  const MicrobufferMap map(BufferMap::kCosine, 24);
  for (uint32_t i = 0; i < 1000; ++i) {
    const float u = OwenSobol(i, 0, 3) * 24, v = OwenSobol(i, 1, 3) * 24;
    const Vec3f w = map.Unproject(u, v);
    EXPECT_GE(w.z, 0.0f);
    const Vec2f back = map.Project(w);
    EXPECT_NEAR(back.x, u, 2e-3f);
    EXPECT_NEAR(back.y, v, 2e-3f);
  }
}

TEST(CosineMap, HasNoNeighbourBelowTheHorizon) {
  const MicrobufferMap map(BufferMap::kCosine, 24);
  EXPECT_EQ(map.Wrap(-1, 3), -1);
  EXPECT_EQ(map.Wrap(3, 24), -1);
  EXPECT_EQ(map.Wrap(3, 5), 5 * 24 + 3);
}

}  // namespace
}  // namespace farpoint

#include "core/math/vec.h"

#include <gtest/gtest.h>

#include <limits>

#include "core/math/sampling.h"

namespace farpoint {
namespace {

TEST(Vec3, ProductsObeyTheirIdentities) {
  const Vec3d a(1, 2, 3), b(-4, 5, 0.5), c(7, -1, 2);
  EXPECT_EQ(Dot(a, b), 7.5);
  EXPECT_EQ(Cross(Vec3d(1, 0, 0), Vec3d(0, 1, 0)), Vec3d(0, 0, 1));
  EXPECT_EQ(Dot(Cross(a, b), a), 0.0);
  EXPECT_EQ(Dot(Cross(a, b), b), 0.0);
  EXPECT_EQ(Dot(a, Cross(b, c)), Dot(b, Cross(c, a)));
  EXPECT_EQ(Length(Vec3d(3, 4, 12)), 13.0);
  EXPECT_EQ(Length2(a), 14.0);
}

TEST(Vec3, IndexingAgreesWithTheNames) {
  Vec3f v(1, 2, 3);
  for (int i = 0; i < 3; ++i) EXPECT_EQ(v[i], static_cast<float>(i + 1));
  v[1] = 9;
  EXPECT_EQ(v.y, 9.0f);
  EXPECT_EQ(MaxAbs(Vec3f(-5, 2, 4)), 5.0f);
  EXPECT_EQ(MaxComponent(Vec3f(-5, 2, 4)), 4.0f);
}

TEST(NormalizeOr, IsUnitForEveryExponent) {
  for (int e = -126; e <= 126; e += 7) {
    const Vec3f v = Vec3f(std::ldexp(1.0f, e), std::ldexp(-1.7f, e), std::ldexp(0.3f, e));
    const Vec3f n = NormalizeOr(v, Vec3f(9, 9, 9));
    EXPECT_NEAR(Length(n), 1.0f, 2e-7f) << e;
    EXPECT_GT(n.x, 0.0f);
    EXPECT_LT(n.y, 0.0f);
  }
}

TEST(NormalizeOr, FallsBackWhereThereIsNoDirection) {
  const Vec3f fallback(0, 0, 1);
  const float inf = std::numeric_limits<float>::infinity();
  const float nan = std::numeric_limits<float>::quiet_NaN();
  EXPECT_EQ(NormalizeOr(Vec3f(0, 0, 0), fallback), fallback);
  EXPECT_EQ(NormalizeOr(Vec3f(1e-45f, 0, 0), fallback), fallback);
  EXPECT_EQ(NormalizeOr(Vec3f(inf, 0, 0), fallback), fallback);
  EXPECT_EQ(NormalizeOr(Vec3f(nan, 0, 0), fallback), fallback);
  EXPECT_EQ(NormalizeOr(Vec3f(1, nan, 0), fallback), fallback);
  EXPECT_EQ(NormalizeOr(Vec3f(1, 0, nan), fallback), fallback);
}

TEST(IsFinite, SeesEachComponent) {
  const float inf = std::numeric_limits<float>::infinity();
  EXPECT_TRUE(IsFinite(Vec3f(1, 2, 3)));
  EXPECT_FALSE(IsFinite(Vec3f(inf, 2, 3)));
  EXPECT_FALSE(IsFinite(Vec3f(1, -inf, 3)));
  EXPECT_FALSE(IsFinite(Vec3f(1, 2, std::numeric_limits<float>::quiet_NaN())));
}

TEST(Luminance, OfWhiteIsOne) { EXPECT_NEAR(Luminance(Rgb(1, 1, 1)), 1.0f, 1e-7f); }

TEST(Box3, GrowsFromEmpty) {
  Box3d box;
  EXPECT_TRUE(box.empty());
  EXPECT_EQ(box.Diagonal(), 0.0);
  box.Extend(Vec3d(1, 2, 3));
  EXPECT_FALSE(box.empty());
  EXPECT_EQ(box.Center(), Vec3d(1, 2, 3));
  EXPECT_EQ(box.Diagonal(), 0.0);
  box.Extend(Vec3d(-2, 6, 3));
  EXPECT_EQ(box.min, Vec3d(-2, 2, 3));
  EXPECT_EQ(box.max, Vec3d(1, 6, 3));
  EXPECT_EQ(box.Diagonal(), 5.0);
}

TEST(Frame, IsOrthonormalAndRightHandedForEveryNormal) {
  std::vector<Vec3f> normals = {{0, 0, 1},  {0, 0, -1},     {1, 0, 0},
                                {0, -1, 0}, {1e-8f, 0, -1}, {0, -1e-8f, -1}};
  for (uint32_t i = 0; i < 4096; ++i) {
    normals.push_back(UniformSphere(OwenSobol(i, 0, 7), OwenSobol(i, 1, 7)));
  }
  for (const Vec3f& n : normals) {
    const Frame frame(n);
    EXPECT_NEAR(Length(frame.t), 1.0f, 1e-6f);
    EXPECT_NEAR(Length(frame.b), 1.0f, 1e-6f);
    EXPECT_NEAR(Dot(frame.t, frame.b), 0.0f, 1e-6f);
    EXPECT_NEAR(Dot(frame.t, n), 0.0f, 1e-6f);
    EXPECT_NEAR(Dot(frame.b, n), 0.0f, 1e-6f);
    EXPECT_GT(Dot(Cross(frame.t, frame.b), n), 0.99f);
    EXPECT_EQ(frame.ToWorld(Vec3f(0, 0, 1)), n);
  }
}

}  // namespace
}  // namespace farpoint

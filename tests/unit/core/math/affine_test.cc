#include "core/math/affine.h"

#include <gtest/gtest.h>

#include <vector>

#include "core/math/sampling.h"

namespace farpoint {
namespace {

double Unit(uint64_t key) { return static_cast<double>(Mix64(key) >> 11) * 0x1p-53 * 2.0 - 1.0; }

Affine Random(uint64_t seed) {
  Affine a;
  for (int i = 0; i < 3; ++i) {
    for (int k = 0; k < 3; ++k) a.column[i][k] = Unit(HashKey(seed, i, k));
    a.translation[i] = 10 * Unit(HashKey(seed, 9, i));
  }
  return a;
}

void ExpectNear(const Vec3d& a, const Vec3d& b, double tolerance) {
  for (int i = 0; i < 3; ++i) EXPECT_NEAR(a[i], b[i], tolerance);
}

TEST(Affine, TheDefaultChangesNothing) {
  const Affine identity;
  EXPECT_EQ(identity.Point({1, 2, 3}), Vec3d(1, 2, 3));
  EXPECT_EQ(identity.Vector({1, 2, 3}), Vec3d(1, 2, 3));
  EXPECT_EQ(identity.Normal({0, 1, 0}), Vec3d(0, 1, 0));
  EXPECT_EQ(identity.Determinant(), 1.0);
}

TEST(Affine, VectorsAreNotTranslated) {
  Affine a;
  a.translation = {5, 6, 7};
  EXPECT_EQ(a.Point({1, 1, 1}), Vec3d(6, 7, 8));
  EXPECT_EQ(a.Vector({1, 1, 1}), Vec3d(1, 1, 1));
}

TEST(Affine, AProductAppliesTheRightFactorFirst) {
  for (uint64_t seed = 0; seed < 20; ++seed) {
    const Affine a = Random(seed), b = Random(seed + 100);
    const Vec3d p(0.3, -2, 5);
    ExpectNear((a * b).Point(p), a.Point(b.Point(p)), 1e-12);
    ExpectNear((a * b).Vector(p), a.Vector(b.Vector(p)), 1e-12);
    EXPECT_NEAR((a * b).Determinant(), a.Determinant() * b.Determinant(), 1e-12);
  }
}

TEST(Affine, NormalsStayPerpendicularAndKeepTheirSide) {
  int mirrored = 0;
  for (uint64_t seed = 0; seed < 50; ++seed) {
    const Affine a = Random(seed);
    mirrored += a.Determinant() < 0;
    const Vec3d t(1, 0.2, 0), b(0, 1, -0.4), n = Cross(t, b);
    const Vec3d n_world = a.Normal(n);
    EXPECT_NEAR(Dot(n_world, a.Vector(t)), 0.0, 1e-12);
    EXPECT_NEAR(Dot(n_world, a.Vector(b)), 0.0, 1e-12);
    // A point above the face stays above it, mirrored or not.
    EXPECT_GT(Dot(n_world, a.Vector(n)), 0.0);
  }
  EXPECT_GT(mirrored, 5);
}

TEST(Affine, NormalsOfAFlattenedObjectExist) {
  Affine flat;
  flat.column[2] = {0, 0, 0};
  EXPECT_EQ(flat.Normal({0.3, -0.1, 1}), Vec3d(0, 0, 1));
}

}  // namespace
}  // namespace farpoint

#include "core/scene/polygon.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <vector>

#include "core/math/elementary.h"
#include "core/math/sampling.h"

namespace farpoint {
namespace {

float Unit(uint64_t key) { return ToUnitFloat(static_cast<uint32_t>(key)); }

Vec3d AreaOf(const Vec3d& a, const Vec3d& b, const Vec3d& c) { return Cross(b - a, c - a) * 0.5; }

// The triangles cover the polygon once: no area is negative along its normal, and they sum to it.
void ExpectCovered(const std::vector<Vec3d>& polygon) {
  std::vector<std::array<uint32_t, 3>> triangles;
  ASSERT_TRUE(TriangulatePolygon(polygon, triangles));
  ASSERT_EQ(triangles.size(), polygon.size() - 2);
  Vec3d whole;
  for (size_t i = 1; i + 1 < polygon.size(); ++i) {
    whole += AreaOf(polygon[0], polygon[i], polygon[i + 1]);
  }
  const Vec3d normal = Normalize(whole);
  double sum = 0;
  for (const auto& t : triangles) {
    const double area = Dot(AreaOf(polygon[t[0]], polygon[t[1]], polygon[t[2]]), normal);
    EXPECT_GE(area, -1e-12 * Length(whole));
    sum += area;
  }
  EXPECT_NEAR(sum, Length(whole), 1e-9 * Length(whole));
}

TEST(TriangulatePolygon, CoversConcavePolygonsOnce) {
  // An L, a U, an arrow; each from every start and in both directions.
  const std::vector<std::vector<Vec3d>> shapes = {
      {{0, 0, 0}, {2, 0, 0}, {2, 1, 0}, {1, 1, 0}, {1, 2, 0}, {0, 2, 0}},
      {{0, 0, 1}, {3, 0, 1}, {3, 3, 1}, {2, 3, 1}, {2, 1, 1}, {1, 1, 1}, {1, 3, 1}, {0, 3, 1}},
      {{0, 0, 0}, {2, 1, 0}, {0, 2, 0}, {0.5, 1, 0}},
      // A corner on the line between its neighbours.
      {{0, 0, 0}, {1, 0, 0}, {2, 0, 0}, {2, 2, 0}, {1, 0.5, 0}, {0, 2, 0}}};
  for (std::vector<Vec3d> shape : shapes) {
    for (size_t start = 0; start < shape.size(); ++start) {
      std::rotate(shape.begin(), shape.begin() + 1, shape.end());
      ExpectCovered(shape);
      ExpectCovered({shape.rbegin(), shape.rend()});
    }
  }
}

TEST(TriangulatePolygon, CoversStarsInAnyPlane) {
  for (uint64_t seed = 0; seed < 200; ++seed) {
    const size_t n = 5 + seed % 60;
    const Vec3d u = Normalize(Vec3d(Unit(HashKey(seed, 1)) - 0.5f, Unit(HashKey(seed, 2)) - 0.5f,
                                    Unit(HashKey(seed, 3)) + 0.1f));
    const Vec3d v = Normalize(Cross(u, Vec3d(0.3, 0.9, -0.2)));
    std::vector<Vec3d> star;
    for (size_t i = 0; i < n; ++i) {
      const double angle = 2 * kPi * static_cast<double>(i) / static_cast<double>(n);
      const double radius = 0.1 + Unit(HashKey(seed, 9, i));
      const auto [sine, cosine] = DetSinCos(angle);
      star.push_back(Vec3d(100, 200, 300) + u * (radius * cosine) + v * (radius * sine));
    }
    ExpectCovered(star);
  }
}

TEST(TriangulatePolygon, CutsQuadrilateralsAlongTheShorterInnerDiagonal) {
  std::vector<std::array<uint32_t, 3>> triangles;
  EXPECT_TRUE(TriangulatePolygon(std::vector<Vec3d>{{0, 0, 0}, {1, 0, 0}, {5, 4, 0}, {0, 1, 0}},
                                 triangles));
  EXPECT_EQ(triangles, (std::vector<std::array<uint32_t, 3>>{{1, 2, 3}, {1, 3, 0}}));
  triangles.clear();
  // Concave at corner 3: the shorter diagonal 1-3 is the only one inside.
  EXPECT_TRUE(TriangulatePolygon(std::vector<Vec3d>{{0, 0, 0}, {9, 0, 0}, {0, 9, 0}, {1, 1, 0}},
                                 triangles));
  EXPECT_EQ(triangles, (std::vector<std::array<uint32_t, 3>>{{1, 2, 3}, {1, 3, 0}}));
}

TEST(TriangulatePolygon, SaysWhereNothingIsClean) {
  std::vector<std::array<uint32_t, 3>> triangles;
  const std::vector<Vec3d> bow_tie = {{0, 0, 0}, {2, 2, 0}, {2, 0, 0}, {0, 2.5, 0}};
  EXPECT_FALSE(TriangulatePolygon(bow_tie, triangles));
  EXPECT_EQ(triangles.size(), 2u);
  triangles.clear();
  EXPECT_FALSE(TriangulatePolygon(std::vector<Vec3d>(7, Vec3d(1, 2, 3)), triangles));
  EXPECT_EQ(triangles.size(), 5u);
}

TEST(TriangulatePolygon, EndsForTheLargestTangle) {
  std::vector<Vec3d> tangle;
  for (size_t i = 0; i < kMaxPolygonCorners; ++i) {
    tangle.emplace_back(Unit(HashKey(i, 1)), Unit(HashKey(i, 2)), 0);
  }
  std::vector<std::array<uint32_t, 3>> triangles;
  EXPECT_FALSE(TriangulatePolygon(tangle, triangles));
  EXPECT_EQ(triangles.size(), tangle.size() - 2);
}

TEST(CornerIndex, GivesEqualCornersOneVertex) {
  CornerIndex index(4);
  std::vector<uint32_t> first;
  for (uint32_t round = 0; round < 2; ++round) {
    for (uint32_t i = 0; i < 5000; ++i) {
      const uint32_t vertex = index.VertexOf({i / 4, i % 2, i % 4 / 2});
      if (round == 0) {
        EXPECT_EQ(vertex, i);
      }
      EXPECT_EQ(vertex, i);
    }
  }
  EXPECT_EQ(index.corners().size(), 5000u);
}

TEST(MeanColor, WeighsByArea) {
  Mesh mesh;
  mesh.positions = {{0, 0, 0}, {1, 0, 0}, {0, 1, 0}, {0, 0, 0}, {3, 0, 0}, {0, 1, 0}};
  mesh.triangles = {{0, 1, 2}, {3, 4, 5}};
  const Rgb red(1, 0, 0), blue(0, 0, 1);
  const std::vector<Rgb> colors = {red, red, red, blue, blue, blue};
  const Rgb mean = MeanColor(mesh, colors);
  EXPECT_FLOAT_EQ(mean.x, 0.25f);
  EXPECT_FLOAT_EQ(mean.z, 0.75f);
  mesh.positions.assign(6, Vec3f());
  EXPECT_FLOAT_EQ(MeanColor(mesh, colors).x, 0.5f);
}

TEST(OffsetFor, MovesOnlyWhatLiesFarAway) {
  Box3d box;
  box.Extend(Vec3d(-1, 5, 0));
  box.Extend(Vec3d(1, 7, 2));
  EXPECT_EQ(OffsetFor(box), Vec3d());
  Box3d far;
  far.Extend(Vec3d(1e6, 0, 0));
  far.Extend(Vec3d(1e6 + 2, 2, 2));
  EXPECT_EQ(OffsetFor(far), Vec3d(1e6 + 1, 1, 1));
  EXPECT_EQ(OffsetFor(Box3d()), Vec3d());
}

}  // namespace
}  // namespace farpoint

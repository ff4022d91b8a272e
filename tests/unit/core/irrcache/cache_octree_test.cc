#include "core/irrcache/cache_octree.h"

#include <gtest/gtest.h>

#include <algorithm>

#include "core/math/sampling.h"

namespace farpoint {
namespace {

struct Sphere {
  Vec3f centre;
  float radius;
};

float Random(uint64_t i, uint64_t k) {
  return ToUnitFloat(static_cast<uint32_t>(HashKey(9, i, k)));
}

Vec3f RandomPoint(uint64_t i, uint64_t k) {
  return {Random(i, k), Random(i, k + 1), Random(i, k + 2)};
}

// Radii over four decades, centres all over the bounds and on their faces.
std::vector<Sphere> RandomSpheres(size_t count) {
  std::vector<Sphere> spheres(count);
  for (size_t i = 0; i < count; ++i) {
    Vec3f c = RandomPoint(i, 0);
    if (i % 5 == 0) c.y = 0;
    if (i % 7 == 0) c.x = 1;
    spheres[i] = {c, 2.0f * static_cast<float>(std::pow(10.0, -4.0 * Random(i, 4)))};
  }
  return spheres;
}

CacheOctree TreeOf(const std::vector<Sphere>& spheres, const Box3f& bounds) {
  CacheOctree tree(bounds);
  for (uint32_t i = 0; i < spheres.size(); ++i) {
    tree.Insert(i, spheres[i].centre, spheres[i].radius);
  }
  return tree;
}

const Box3f kUnit{Vec3f(0), Vec3f(1)};

TEST(CacheOctree, QueriesAtPointsEqualBruteForce) {
  const std::vector<Sphere> spheres = RandomSpheres(2000);
  const CacheOctree tree = TreeOf(spheres, kUnit);
  size_t visits = 0, hits = 0;
  for (uint64_t q = 0; q < 1500; ++q) {
    Vec3f p = RandomPoint(q, 10);
    // Some on the bounds, some in the middle of small spheres.
    if (q % 4 == 0) p.z = q % 8 == 0 ? 0.0f : 1.0f;
    if (q % 3 == 0) p = spheres[q % spheres.size()].centre;
    const auto holds = [&](uint32_t id) {
      return Length(spheres[id].centre - p) <= spheres[id].radius;
    };
    std::vector<uint32_t> found, expected;
    tree.AtPoint(p, [&](uint32_t id) {
      ++visits;
      if (holds(id)) found.push_back(id);
    });
    for (uint32_t id = 0; id < spheres.size(); ++id) {
      if (holds(id)) expected.push_back(id);
    }
    std::sort(found.begin(), found.end());
    EXPECT_EQ(found, expected) << q;  // each once
    hits += expected.size();
  }
  // It looks at little else.
  EXPECT_LT(visits, 8 * hits);
}

TEST(CacheOctree, NearFindsAllCentresWithinTheRadius) {
  const std::vector<Sphere> spheres = RandomSpheres(1000);
  const CacheOctree tree = TreeOf(spheres, kUnit);
  for (uint64_t q = 0; q < 300; ++q) {
    const Vec3f p = RandomPoint(q, 20);
    const float radius = 0.5f * Random(q, 30);
    std::vector<bool> found(spheres.size());
    tree.Near(p, radius, [&](uint32_t id) { found[id] = true; });
    for (uint32_t id = 0; id < spheres.size(); ++id) {
      if (Length(spheres[id].centre - p) < radius) {
        EXPECT_TRUE(found[id]) << q << " " << id;
      }
    }
  }
}

TEST(CacheOctree, OrderFollowsInsertion) {
  const std::vector<Sphere> spheres = RandomSpheres(200);
  const CacheOctree a = TreeOf(spheres, kUnit), b = TreeOf(spheres, kUnit);
  for (uint64_t q = 0; q < 50; ++q) {
    std::vector<uint32_t> from_a, from_b;
    a.AtPoint(RandomPoint(q, 40), [&](uint32_t id) { from_a.push_back(id); });
    b.AtPoint(RandomPoint(q, 40), [&](uint32_t id) { from_b.push_back(id); });
    EXPECT_EQ(from_a, from_b);
  }
}

TEST(CacheOctree, DegenerateBoundsAndTinySpheresWork) {
  for (const Box3f& bounds : {Box3f{Vec3f(5), Vec3f(5)}, Box3f{Vec3f(0), Vec3f(1, 0, 0)}}) {
    CacheOctree tree(bounds);
    const Vec3f p = bounds.min;
    tree.Insert(7, p, 1e-30f);
    tree.Insert(8, p, 1e30f);
    std::vector<uint32_t> found;
    tree.AtPoint(p, [&](uint32_t id) { found.push_back(id); });
    std::sort(found.begin(), found.end());
    EXPECT_EQ(found, (std::vector<uint32_t>{7, 8}));
  }
}

}  // namespace
}  // namespace farpoint

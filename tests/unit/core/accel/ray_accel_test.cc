#include "core/accel/ray_accel.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <string>
#include <utility>
#include <vector>

#include "core/base/executor.h"
#include "core/scene/procedural.h"
#include "tests/unit/core/accel/brute_force.h"
#include "tests/unit/core/scene/scene_test_util.h"

namespace farpoint {
namespace {

std::shared_ptr<const RayAccel> BuildAccel(const Scene& scene) {
  Executor executor(1);
  auto prepared = PreparedScene::Prepare(scene, executor);
  EXPECT_TRUE(prepared.ok()) << prepared.status();
  auto accel = RayAccel::Build(*prepared);
  EXPECT_TRUE(accel.ok()) << accel.status();
  return *accel;
}

Scene SceneOf(Mesh mesh) {
  Scene scene;
  if (mesh.material >= 0) scene.materials.resize(static_cast<size_t>(mesh.material) + 1);
  scene.meshes.push_back(std::move(mesh));
  scene.instances.push_back({"only", 0, {}});
  return scene;
}

// `count` triangles of size about `size` in the cube [-1, 1]³.
Scene MakeSoup(size_t count, double size, uint64_t seed) {
  TestRandom random(seed);
  Mesh mesh;
  for (size_t i = 0; i < count; ++i) {
    const Vec3d centre(random.Uniform(-1, 1), random.Uniform(-1, 1), random.Uniform(-1, 1));
    for (int k = 0; k < 3; ++k) {
      mesh.positions.push_back(Vec3f(centre + random.Direction() * (size * random.Uniform())));
    }
    const auto first = static_cast<uint32_t>(3 * i);
    mesh.triangles.push_back({first, first + 1, first + 2});
  }
  return SceneOf(std::move(mesh));
}

// A closed ball of `rings` x 2 `rings` faces with shared vertices, its poles included.
Mesh MakeBall(int rings) {
  Mesh mesh;
  const int segments = 2 * rings;
  for (int i = 0; i <= rings; ++i) {
    for (int j = 0; j < segments; ++j) {
      const SinCos t = DetSinCos(kPi * i / rings), p = DetSinCos(2 * kPi * j / segments);
      const double r = i == 0 || i == rings ? 0.0 : t.sin;
      mesh.positions.push_back(Vec3f(Vec3d(r * p.cos, t.cos, r * p.sin)));
    }
  }
  const auto at = [&](int i, int j) { return static_cast<uint32_t>(i * segments + j % segments); };
  for (int i = 0; i < rings; ++i) {
    for (int j = 0; j < segments; ++j) {
      if (i > 0) mesh.triangles.push_back({at(i, j), at(i, j + 1), at(i + 1, j)});
      if (i + 1 < rings) mesh.triangles.push_back({at(i, j + 1), at(i + 1, j + 1), at(i + 1, j)});
    }
  }
  return mesh;
}

// The scene scaled about the world's origin, then moved.
Scene Placed(Scene scene, double scale, const Vec3d& offset) {
  for (Instance& instance : scene.instances) {
    Affine& m = instance.world_from_mesh;
    for (Vec3d& column : m.column) column = column * scale;
    m.translation = m.translation * scale + offset;
  }
  return scene;
}

Vec3f PointIn(const Box3f& box, TestRandom& random) {
  const Vec3f size = box.max - box.min;
  return box.min + Vec3f(size.x * static_cast<float>(random.Uniform()),
                         size.y * static_cast<float>(random.Uniform()),
                         size.z * static_cast<float>(random.Uniform()));
}

// Compares both queries with the loop over all triangles for `rays` random rays from inside the
// bounds, of directions of any length. A ray within rounding of an edge may go either way.
void ExpectEqualsBruteForce(const Scene& description, int rays, uint64_t seed) {
  const auto accel = BuildAccel(description);
  const PreparedScene& scene = accel->scene();
  TestRandom random(seed);
  int hits = 0, misses = 0, ambiguous = 0;
  for (int i = 0; i < rays; ++i) {
    SCOPED_TRACE("ray " + std::to_string(i));
    const Vec3f origin = PointIn(scene.bounds(), random);
    const Vec3f direction(random.Direction() * std::exp2(random.Uniform(-4, 4)));
    const std::vector<Crossing> all = AllCrossings(scene, origin, direction);
    const auto first_certain = std::find_if(
        all.begin(), all.end(), [](const Crossing& c) { return c.certain && c.t > c.t_error; });
    ambiguous += first_certain != all.begin();

    const std::optional<RayHit> hit = accel->Intersect(origin, direction);
    if (!hit) {
      ++misses;
      EXPECT_EQ(first_certain, all.end());
    } else {
      ++hits;
      const auto same = std::find_if(
          all.begin(), all.end(), [&](const Crossing& c) { return c.triangle == hit->triangle; });
      ASSERT_NE(same, all.end()) << "hit a triangle that the ray does not meet";
      const double tolerance = 1e-5 * same->t + same->t_error;
      EXPECT_NEAR(hit->t, same->t, tolerance);
      if (first_certain != all.end()) {
        EXPECT_LE(hit->t, first_certain->t + tolerance + first_certain->t_error);
      }
      if (same->certain) {
        const Vec3d there = Vec3d(origin) + Vec3d(direction) * static_cast<double>(hit->t);
        const Vec3d on(scene.PointOn(hit->triangle, hit->b1, hit->b2));
        EXPECT_LE(Length(there - on), 2e-5 * (static_cast<double>(scene.diagonal_m())));
      }
    }

    // Occlusion along the whole ray and up to a random distance.
    EXPECT_EQ(accel->Occluded(origin, direction), hit.has_value());
    const double t_max = static_cast<double>(scene.diagonal_m()) * random.Uniform() /
                         static_cast<double>(Length(direction));
    bool must = false, may = false;
    for (const Crossing& c : all) {
      must = must || (c.certain && c.t > c.t_error && c.t < t_max - c.t_error - 1e-5 * c.t);
      may = may || c.t < t_max + c.t_error + 1e-5 * c.t;
    }
    const bool occluded = accel->Occluded(origin, direction, static_cast<float>(t_max));
    EXPECT_TRUE(occluded || !must);
    EXPECT_TRUE(!occluded || may);
  }
  EXPECT_GT(hits, rays / 10);
  EXPECT_LT(ambiguous, rays / 20);
}

TEST(RayAccel, EqualsBruteForceOnSoups) {
  ExpectEqualsBruteForce(MakeSoup(2000, 0.2, 1), 500, 1);
  ExpectEqualsBruteForce(MakeSoup(50, 1.5, 2), 2000, 2);
  ExpectEqualsBruteForce(MakeSoup(1, 1.0, 3), 2000, 3);
  // Slivers, ten thousand times longer than wide.
  Scene slivers = MakeSoup(500, 1.0, 4);
  slivers.instances[0].world_from_mesh.column[1] = {0, 1e-4, 0};
  ExpectEqualsBruteForce(slivers, 500, 4);
}

TEST(RayAccel, EqualsBruteForceOnTheProjectsScenes) {
  ExpectEqualsBruteForce(MakeCornellBox(), 3000, 5);
  ExpectEqualsBruteForce(MakeFurnace(0.5f, 1.0f), 3000, 6);
  ExpectEqualsBruteForce(MakeCity(1, 7), 400, 7);
}

TEST(RayAccel, EqualsBruteForceAtOtherScalesAndPlaces) {
  const Scene soup = MakeSoup(500, 0.4, 8);
  for (const double scale : {1e-3, 1e3}) {
    ExpectEqualsBruteForce(Placed(soup, scale, {}), 200, 8);
    ExpectEqualsBruteForce(Placed(soup, scale, Vec3d(1e6, -2e6, 3e6) * scale), 200, 9);
  }
}

TEST(RayAccel, AnEmptySceneIsMissed) {
  const auto accel = BuildAccel(Scene());
  EXPECT_FALSE(accel->Intersect({0, 0, 0}, {0, 0, 1}).has_value());
  EXPECT_FALSE(accel->Occluded({0, 0, 0}, {1, 0, 0}));

  // One of nothing but degenerate triangles is empty, too.
  Mesh line;
  line.positions = {{0, 0, 0}, {1, 1, 1}, {2, 2, 2}};
  line.triangles = {{0, 1, 2}, {0, 0, 1}};
  const auto flat = BuildAccel(SceneOf(line));
  EXPECT_EQ(flat->scene().dropped_triangles(), 2u);
  EXPECT_FALSE(flat->Intersect({1, 1, -1}, {0, 0, 1}).has_value());
}

// One quad in the plane z = 0 over [-1, 1]², uv from (0, 0) to (1, 1).
Mesh UnitQuad(int32_t material, float z) {
  Mesh mesh;
  mesh.positions = {{-1, -1, z}, {1, -1, z}, {1, 1, z}, {-1, 1, z}};
  mesh.uv[0] = {{0, 0}, {1, 0}, {1, 1}, {0, 1}};
  mesh.triangles = {{0, 1, 2}, {0, 2, 3}};
  mesh.material = material;
  return mesh;
}

// Masked quads at z = 0, 1, ... and an opaque one behind them. The left half of the mask is a hole.
Scene MaskedLayers(int layers, bool nearest) {
  Scene scene;
  Material opaque, mask;
  mask.alpha_mode = AlphaMode::kMask;
  mask.alpha_cutoff = 0.5f;
  mask.base_color_texture.texture = 0;
  scene.materials = {opaque, mask};
  Texture texture;
  texture.name = "mask";
  texture.encoded = Blob::FromString(MakePng(2, 1, {255, 255, 255, 0, 255, 255, 255, 255}));
  texture.wrap_s = texture.wrap_t = WrapMode::kClampToEdge;
  texture.nearest = nearest;
  scene.textures.push_back(texture);
  for (int i = 0; i <= layers; ++i) {
    scene.meshes.push_back(UnitQuad(i < layers ? 1 : 0, static_cast<float>(i)));
    scene.instances.push_back({"layer", static_cast<uint32_t>(i), {}});
  }
  return scene;
}

TEST(RayAccel, AlphaMasksAreHolesForBothQueries) {
  constexpr int kLayers = 5;
  const auto accel = BuildAccel(MaskedLayers(kLayers, true));
  ASSERT_TRUE(accel->scene().has_alpha_masks());
  const Vec3f shift(-accel->scene().origin());
  TestRandom random(1);
  for (int i = 0; i < 500; ++i) {
    const float x = static_cast<float>(random.Uniform(-0.99, 0.99));
    const float y = static_cast<float>(random.Uniform(-0.99, 0.99));
    const Vec3f front = Vec3f(x, y, -1) + shift;
    const auto hit = accel->Intersect(front, {0, 0, 1});
    ASSERT_TRUE(hit.has_value());
    EXPECT_NEAR(hit->t, x < 0 ? kLayers + 1 : 1, 1e-5) << x << " " << y;
    EXPECT_EQ(accel->Occluded(front, {0, 0, 1}, kLayers + 0.5f), x >= 0);
    EXPECT_TRUE(accel->Occluded(front, {0, 0, 1}));
    // From behind, in front of the opaque quad.
    const Vec3f back = Vec3f(x, y, kLayers - 0.5f) + shift;
    EXPECT_EQ(accel->Intersect(back, {0, 0, -1}).has_value(), x >= 0);
    EXPECT_EQ(accel->Occluded(back, {0, 0, -1}), x >= 0);
  }
}

TEST(RayAccel, AlphaIsInterpolatedAndComparedWithTheCutoff) {
  // Bilinear: alpha grows from 0 at u = 1/4 to 1 at u = 3/4. The cut-off 0.3 lies at u = 0.4.
  Scene scene = MaskedLayers(1, false);
  scene.materials[1].alpha_cutoff = 0.3f;
  const auto accel = BuildAccel(scene);
  const Vec3f shift(-accel->scene().origin());
  for (int i = 0; i < 1000; ++i) {
    const float u = (static_cast<float>(i) + 0.5f) / 1000;
    if (std::fabs(u - 0.4f) < 1e-4f) continue;
    const Vec3f origin = Vec3f(2 * u - 1, 0.123f, -1) + shift;
    EXPECT_EQ(accel->Occluded(origin, {0, 0, 1}, 1.5f), u > 0.4f) << u;
    const auto hit = accel->Intersect(origin, {0, 0, 1});
    ASSERT_TRUE(hit.has_value());
    EXPECT_NEAR(hit->t, u > 0.4f ? 1 : 2, 1e-5) << u;
  }
  ExpectEqualsBruteForce(scene, 1000, 11);
}

TEST(RayAccel, AlphaWithoutATextureIsTheMaterials) {
  Scene scene = SceneOf(UnitQuad(0, 0));
  scene.materials[0].alpha_mode = AlphaMode::kMask;
  for (const float alpha : {0.0f, 0.49f, 0.5f, 1.0f}) {
    scene.materials[0].base_alpha = alpha;
    const auto accel = BuildAccel(scene);
    EXPECT_EQ(accel->Occluded({0.1f, 0.2f, -1}, {0, 0, 1}), alpha >= 0.5f) << alpha;
    EXPECT_EQ(accel->Intersect({0.1f, 0.2f, -1}, {0, 0, 1}).has_value(), alpha >= 0.5f) << alpha;
  }
}

// What escapes of rays from inside a closed convex surface, aimed at points of its edges and
// exactly at its vertices.
struct Escapes {
  int edge_rays = 0, edge_escapes = 0;
  int vertex_rays = 0, vertex_escapes = 0;
};
Escapes CountEscapes(const Scene& description, uint64_t seed) {
  const auto accel = BuildAccel(description);
  const PreparedScene& scene = accel->scene();
  TestRandom random(seed);
  const Vec3f centre = scene.bounds().Center();
  Escapes n;
  const auto escapes = [&](const Vec3f& target) {
    // Between the centre and a vertex: inside, as the surface is convex.
    const Vec3f vertex = scene.vertices()[random.Index(scene.vertices().size())];
    const Vec3f origin = centre + (vertex - centre) * static_cast<float>(random.Uniform(0, 0.9));
    const bool hit = accel->Intersect(origin, target - origin).has_value();
    EXPECT_EQ(accel->Occluded(origin, target - origin), hit);
    std::array<Vec3f, 8> origins, directions;
    origins.fill(origin);
    directions.fill(target - origin);
    constexpr float kFar = std::numeric_limits<float>::infinity();
    EXPECT_EQ(
        accel->Occluded8(origins, directions,
                         std::array{kFar, kFar, kFar, kFar, kFar, kFar, kFar, kFar}, 0xff, true),
        hit ? 0xffu : 0u);
    return hit ? 0 : 1;
  };
  for (const PreparedTriangle& t : scene.triangles()) {
    for (int k = 0; k < 3; ++k) {
      const Vec3f a = scene.vertices()[t.vertex[k]], b = scene.vertices()[t.vertex[(k + 1) % 3]];
      if (a == b) continue;
      for (int i = 0; i < 10; ++i) {
        n.edge_escapes +=
            escapes(i == 0 ? (a + b) * 0.5f : a + (b - a) * static_cast<float>(random.Uniform()));
        ++n.edge_rays;
      }
      for (int i = 0; i < 2; ++i) n.vertex_escapes += escapes(a);
      n.vertex_rays += 2;
    }
  }
  return n;
}

TEST(RayAccel, RaysThroughEdgesAndCornersOfABoxDoNotEscape) {
  Scene turned = MakeFurnace(0.5f, 1.0f);
  const SinCos a = DetSinCos(0.7), b = DetSinCos(1.9);
  turned.instances[0].world_from_mesh = {
      {Vec3d(a.cos, a.sin, 0) * 3.1, Vec3d(-a.sin * b.cos, a.cos * b.cos, b.sin) * 0.17,
       Vec3d(a.sin * b.sin, -a.cos * b.sin, b.cos) * 1.3},
      {12345.678, -777.77, 98765.4}};
  for (uint64_t seed = 0; seed < 50; ++seed) {
    for (const Scene& scene : {MakeFurnace(0.5f, 1.0f), turned}) {
      const Escapes n = CountEscapes(scene, seed);
      EXPECT_EQ(n.edge_escapes, 0);
      EXPECT_EQ(n.vertex_escapes, 0);
    }
  }
}

TEST(RayAccel, RaysThroughEdgesOfABallDoNotEscape) {
  Scene flat = SceneOf(MakeBall(12));
  const SinCos a = DetSinCos(0.7);
  flat.instances[0].world_from_mesh = {
      {Vec3d(a.cos, a.sin, 0) * 3.1, Vec3d(-a.sin, a.cos, 0) * 0.17, {0, 0, 1.3}},
      {12345.678, -777.77, 98765.4}};
  for (const Scene& scene : {SceneOf(MakeBall(16)), flat}) {
    const Escapes n = CountEscapes(scene, 1);
    EXPECT_EQ(n.edge_escapes, 0) << "of " << n.edge_rays;
    // At a vertex of six triangles the signs of their edge tests may contradict each other.
    EXPECT_LT(n.vertex_escapes, 0.01 * n.vertex_rays);
  }
}

TEST(RayAccel, DistanceIsInUnitsOfTheDirectionAndBoundedByTMax) {
  // The second quad keeps the prepared scene's origin away from the first.
  Scene scene = SceneOf(UnitQuad(-1, 4));
  scene.meshes.push_back(UnitQuad(-1, -4));
  scene.instances.push_back({"other", 1, {}});
  const auto accel = BuildAccel(scene);
  ASSERT_EQ(accel->scene().origin(), Vec3d(0, 0, 0));
  const Vec3f origin(0.25f, 0.125f, 0);
  for (const float length : {0.25f, 1.0f, 2.0f, 64.0f}) {
    const Vec3f w(0, 0, length);
    const float t = 4 / length;
    const auto hit = accel->Intersect(origin, w);
    ASSERT_TRUE(hit.has_value());
    EXPECT_NEAR(hit->t, t, 1e-6f * t);
    const float below = t * (1 - 1e-5f), above = t * (1 + 1e-5f);
    EXPECT_FALSE(accel->Intersect(origin, w, below).has_value());
    EXPECT_FALSE(accel->Occluded(origin, w, below));
    EXPECT_TRUE(accel->Intersect(origin, w, above).has_value());
    EXPECT_TRUE(accel->Occluded(origin, w, above));
    // Both ends belong to the range; here the arithmetic is exact.
    EXPECT_TRUE(accel->Intersect(origin, w, t).has_value());
    EXPECT_TRUE(accel->Occluded(origin, w, t));
    EXPECT_FALSE(accel->Intersect(origin, w, 0).has_value());
    EXPECT_FALSE(accel->Occluded(origin, w, 0));
  }
  // Nothing behind the origin is hit.
  EXPECT_FALSE(accel->Intersect({0.25f, 0.125f, 5}, {0, 0, 1}).has_value());
  EXPECT_FALSE(accel->Occluded({0.25f, 0.125f, 5}, {0, 0, 1}));
}

// Half masked quads amid a soup, and something opaque before and after them in the order.
Scene MaskedSoup() {
  Scene scene = MaskedLayers(3, false);
  Mesh soup = MakeSoup(3000, 0.15, 77).meshes[0];
  soup.material = 0;
  for (Vec3f& p : soup.positions) p.z += 1.5f;
  scene.instances.push_back({"soup", static_cast<uint32_t>(scene.meshes.size()), {}});
  scene.meshes.push_back(std::move(soup));
  return scene;
}

TEST(RayAccel, EightRaysAreBlockedAsEachIsAlone) {
  const auto accel = BuildAccel(MaskedSoup());
  ASSERT_TRUE(accel->scene().has_alpha_masks());
  TestRandom random(6);
  constexpr int kGroups = 4000;
  int blocked = 0, asked = 0, different = 0;
  for (int i = 0; i < kGroups; ++i) {
    const bool one_point = i % 2 == 0;
    std::array<Vec3f, 8> origins, directions;
    std::array<float, 8> t_max;
    const Vec3d towards = random.Direction();
    for (size_t k = 0; k < 8; ++k) {
      origins[k] =
          one_point && k > 0
              ? origins[0]
              : Vec3f(Vec3d(random.Uniform(-1, 1), random.Uniform(-1, 1), random.Uniform(-1, 1)));
      directions[k] = Vec3f(Normalize(towards + 0.2 * random.Direction()));
      t_max[k] = static_cast<float>(random.Uniform(0, 2));
    }
    const unsigned mask = static_cast<unsigned>(random.Index(256));
    const unsigned got = accel->Occluded8(origins, directions, t_max, mask, one_point);
    EXPECT_EQ(got & ~mask, 0u);
    for (size_t k = 0; k < 8; ++k) {
      if ((mask >> k & 1) == 0) continue;
      ++asked;
      blocked += static_cast<int>(got >> k & 1);
      different += accel->Occluded(origins[k], directions[k], t_max[k]) != ((got >> k & 1) != 0);
    }
  }
  EXPECT_GT(blocked, asked / 5);
  EXPECT_LT(blocked, asked - asked / 5);
  EXPECT_EQ(different, 0);
}

TEST(RayAccel, ABundleMeetsWhatItsRaysMeetAlone) {
  const Scene scene = MaskedSoup();
  const auto accel = BuildAccel(scene);
  ASSERT_TRUE(accel->scene().has_alpha_masks());
  ASSERT_TRUE(accel->PrepareBundles().ok());
  TestRandom random(5);
  uint64_t hits = 0, different = 0, on_masks = 0;
  constexpr uint64_t kBundles = 500, kRays = 40;
  for (uint64_t i = 0; i < kBundles; ++i) {
    const Vec3f origin(Vec3d(random.Uniform(-1, 1), random.Uniform(-1, 1), random.Uniform(-1, 1)));
    std::array<Vec3f, kRays> directions;
    std::array<RayHit, kRays> got;
    for (Vec3f& w : directions) w = Vec3f(random.Direction());
    accel->IntersectBundle(origin, directions, got);
    for (size_t k = 0; k < kRays; ++k) {
      const auto want = accel->Intersect(origin, directions[k]);
      // Edges are met by another arithmetic.
      if (want.has_value() != (got[k].triangle != kNoTriangle) ||
          (want && want->triangle != got[k].triangle)) {
        ++different;
        continue;
      }
      if (!want) continue;
      ++hits;
      on_masks += accel->scene().MaterialOf(want->triangle).alpha_cutoff >= 0;
      EXPECT_NEAR(got[k].t, want->t, 1e-4f * want->t);
      EXPECT_NEAR(got[k].b1, want->b1, 2e-3f);
      EXPECT_NEAR(got[k].b2, want->b2, 2e-3f);
      EXPECT_EQ(got[k].front, want->front);
      const Vec3f n = accel->scene().GeometricNormal(want->triangle);
      if (std::fabs(Dot(n, directions[k])) > 1e-3f) {
        EXPECT_EQ(want->front, Dot(n, directions[k]) < 0);
      }
    }
  }
  EXPECT_GT(hits, kBundles * kRays / 2);
  EXPECT_GT(on_masks, hits / 10);
  EXPECT_LT(different, kBundles * kRays / 5000);
}

TEST(RayAccel, BarycentricsAreThoseOfThePreparedTriangle) {
  const auto accel = BuildAccel(MakeSoup(40, 1.0, 12));
  const PreparedScene& scene = accel->scene();
  TestRandom random(12);
  int compared = 0;
  for (int i = 0; i < 500; ++i) {
    const auto t = static_cast<uint32_t>(random.Index(scene.triangles().size()));
    const auto [b1, b2] = random.Barycentric();
    const Vec3f target = scene.PointOn(t, static_cast<float>(b1), static_cast<float>(b2));
    // From so near that hardly anything lies between.
    const Vec3f n = scene.GeometricNormal(t);
    const auto hit = accel->Intersect(target + n * 1e-3f, -n, 2e-3f);
    if (!hit || hit->triangle != t) continue;  // another triangle or an edge
    ++compared;
    EXPECT_LT(Length(scene.PointOn(t, hit->b1, hit->b2) - target), 2e-6f);
  }
  EXPECT_GT(compared, 450);
}

// A ray that leaves a surface, however grazing, hits neither the triangle that it leaves nor one
// in its plane.
void ExpectLeaves(const Scene& description, uint64_t seed, bool crowded = true) {
  const auto accel = BuildAccel(description);
  const PreparedScene& scene = accel->scene();
  TestRandom random(seed);
  int own = 0, coplanar = 0, hits = 0;
  constexpr int kRays = 4000;
  for (int i = 0; i < kRays; ++i) {
    const auto triangle = static_cast<uint32_t>(random.Index(scene.triangles().size()));
    const auto [b1, b2] = random.Barycentric();
    const Vec3f p = scene.PointOn(triangle, static_cast<float>(b1), static_cast<float>(b2));
    Vec3f ng = scene.GeometricNormal(triangle);
    if (random.Uniform() < 0.5) ng = -ng;
    const Vec3d n(ng);
    Vec3d w = random.CosineDirection(n);
    if (i % 4 == 0) w = Normalize(w - n * (Dot(w, n) * (1 - std::exp2(random.Uniform(-20, 0)))));
    const Vec3f direction(w);
    if (!(Dot(direction, ng) > 0)) continue;
    const auto hit = accel->Intersect(accel->LeaveSurface(triangle, p, ng), direction);
    if (!hit) continue;
    ++hits;
    own += hit->triangle == triangle;
    const Vec3f other = scene.GeometricNormal(hit->triangle);
    const float height = Dot(scene.vertices()[scene.triangles()[hit->triangle].vertex[0]] - p, ng);
    coplanar += std::fabs(Dot(other, ng)) > 1 - 1e-6f &&
                std::fabs(height) < 0.5f * accel->SurfaceOffsetM(triangle, p, ng);
  }
  EXPECT_EQ(own, 0);
  EXPECT_EQ(coplanar, 0);
  if (crowded) {
    EXPECT_GT(hits, kRays / 10);
  }
}

TEST(RayAccel, LeavingRaysMissTheirSurface) {
  const std::pair<const char*, Scene> scenes[] = {{"Cornell box", MakeCornellBox()},
                                                  {"city", MakeCity(1, 3)},
                                                  {"soup", MakeSoup(300, 0.5, 5)},
                                                  {"ball", SceneOf(MakeBall(20))}};
  for (const auto& [name, scene] : scenes) {
    const double diagonal = static_cast<double>(BuildAccel(scene)->scene().diagonal_m());
    for (const double scale : {1e-3, 1.0, 1e3}) {
      for (const double away : {0.0, 1e6}) {
        SCOPED_TRACE(std::string(name) + ", scale " + std::to_string(scale) + ", away " +
                     std::to_string(away));
        ExpectLeaves(Placed(scene, scale, Vec3d(0.6, -0.5, 0.62) * (away * scale * diagonal)), 21);
      }
    }
  }
}

TEST(RayAccel, LeavingRaysMissLargeTriangles) {
  // Of 2·10^5 m, alone and between small ones; along an axis, nearly so, and any way.
  TestRandom random(23);
  for (const double tilt : {0.0, 1e-5, 1e-3, 1.0}) {
    SCOPED_TRACE(tilt);
    Mesh mesh = MakeSoup(30, 0.5, 6).meshes[0];
    for (int i = 0; i < 60; ++i) {
      const double y = random.Uniform(-3, 3);
      for (int k = 0; k < 3; ++k) {
        const double x = random.Uniform(-1e5, 1e5), z = random.Uniform(-1e5, 1e5);
        mesh.positions.push_back(Vec3f(Vec3d(x, y + tilt * (x - 0.4 * z), z)));
      }
      const auto first = static_cast<uint32_t>(mesh.positions.size() - 3);
      mesh.triangles.push_back({first, first + 1, first + 2});
    }
    ExpectLeaves(SceneOf(std::move(mesh)), 24, /*crowded=*/false);
  }
}

TEST(RayAccel, WhatLiesFarAwayMovesNoRay) {
  const Scene room = MakeCornellBox();
  const auto alone = BuildAccel(room);
  for (const double away : {1e3, 1e6, 1e9}) {
    SCOPED_TRACE(away);
    Scene scene = room;
    Mesh mesh = MakeSoup(1, 1.0, 3).meshes[0];
    scene.meshes.push_back(mesh);
    Instance stray;
    stray.mesh = static_cast<uint32_t>(scene.meshes.size() - 1);
    for (Vec3f& p : scene.meshes.back().positions) p = p + Vec3f(Vec3d(0.4, -0.3, 1) * away);
    scene.instances.push_back(stray);
    const auto beside = BuildAccel(scene);
    for (uint32_t t = 0; t < alone->scene().triangles().size(); ++t) {
      const auto offset_of = [&](const RayAccel& accel) {
        return accel.SurfaceOffsetM(t, accel.scene().PointOn(t, 0.3f, 0.3f),
                                    accel.scene().GeometricNormal(t));
      };
      // The origin lies elsewhere in the room.
      EXPECT_LT(offset_of(*beside), 2.5f * offset_of(*alone)) << t;
      EXPECT_GT(offset_of(*beside), 0.0f);
    }
  }
}

TEST(RayAccel, EightOffsetsAreThoseOfEachAlone) {
  TestRandom random(31);
  for (int round = 0; round < 100; ++round) {
    V8 v[5];
    const double size = std::exp2(random.Uniform(-20, 20));
    for (V8& of : v) {
      for (size_t k = 0; k < 8; ++k) of.SetLane(k, Vec3f(random.Direction() * size));
    }
    const F8 together = SurfaceOffset(v[0], v[1], v[2], v[3], v[4]);
    for (size_t k = 0; k < 8; ++k) {
      EXPECT_EQ(together[k], SurfaceOffset(v[0].Lane(k), v[1].Lane(k), v[2].Lane(k), v[3].Lane(k),
                                           v[4].Lane(k)));
    }
  }
}

TEST(RayAccel, IsTheSameWhenBuiltAgain) {
  const Scene scene = MakeCity(1, 5);
  const auto a = BuildAccel(scene), b = BuildAccel(scene);
  TestRandom random(30);
  for (int i = 0; i < 2000; ++i) {
    const Vec3f origin = PointIn(a->scene().bounds(), random);
    const Vec3f direction(random.Direction());
    const auto x = a->Intersect(origin, direction), y = b->Intersect(origin, direction);
    ASSERT_EQ(x.has_value(), y.has_value());
    if (!x) continue;
    EXPECT_EQ(x->triangle, y->triangle);
    EXPECT_EQ(x->t, y->t);
    EXPECT_EQ(x->b1, y->b1);
    EXPECT_EQ(x->b2, y->b2);
  }
}

TEST(RayAccel, RecordsItsQueriesAndBareCallsAnswerThemAlike) {
  Executor executor(1);
  const auto prepared = PreparedScene::Prepare(MakeSoup(200, 0.3, 5), executor);
  ASSERT_TRUE(prepared.ok());
  std::vector<TracedRay> rays;
  const auto recorder = RayAccel::Build(*prepared, &rays);
  const auto accel = RayAccel::Build(*prepared);
  ASSERT_TRUE(recorder.ok() && accel.ok());
  TestRandom random(6);
  size_t hits = 0;
  for (int i = 0; i < 500; ++i) {
    const Vec3f origin(random.Direction() * 2.0), direction(random.Direction());
    const float t_max = i % 3 == 0 ? 1.5f : std::numeric_limits<float>::infinity();
    if (i % 2 == 0) {
      hits += (*recorder)->Intersect(origin, direction, t_max).has_value();
    } else {
      hits += (*recorder)->Occluded(origin, direction, t_max);
    }
    ASSERT_EQ(rays.size(), static_cast<size_t>(i) + 1);
    EXPECT_EQ(rays.back().origin, origin);
    EXPECT_EQ(rays.back().direction, direction);
    EXPECT_EQ(rays.back().t_max, t_max);
    EXPECT_EQ(rays.back().any_hit, i % 2 != 0);
  }
  EXPECT_GT(hits, 5u);
  EXPECT_LT(hits, 480u);
  EXPECT_EQ((*accel)->TraceBare(rays), hits);
  EXPECT_EQ(rays.size(), 500u);
  EXPECT_EQ((*accel)->TraceBare({}), 0u);
}

}  // namespace
}  // namespace farpoint

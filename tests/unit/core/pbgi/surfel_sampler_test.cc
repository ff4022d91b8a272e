#include "core/pbgi/surfel_sampler.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>

#include "core/math/elementary.h"
#include "core/math/sampling.h"
#include "core/scene/procedural.h"
#include "tests/unit/core/scene/scene_test_util.h"

namespace farpoint {
namespace {

std::shared_ptr<const PreparedScene> Prepare(const Scene& scene) {
  Executor executor(1);
  return PreparedScene::Prepare(scene, executor).value();
}

SurfelCloud Sample(const Scene& scene, uint64_t count, uint64_t seed = 0, unsigned threads = 2) {
  Executor executor(threads);
  return SampleSurfels(scene, *Prepare(scene), count, seed, executor);
}

double SceneArea(const PreparedScene& scene) {
  double area = 0;
  for (uint32_t t = 0; t < scene.triangles().size(); ++t) area += scene.TriangleArea(t);
  return area;
}

Affine RotationAboutY(double angle) {
  const SinCos sc = DetSinCos(angle);
  Affine m;
  m.column[0] = {sc.cos, 0, -sc.sin};
  m.column[2] = {sc.sin, 0, sc.cos};
  return m;
}

// A square metre in the plane z = 0, of `n` by `n` quads cut in two, and its vertices jittered
// along the surface, so that triangles differ in size and shape.
Mesh JitteredSquare(int n, double jitter) {
  Mesh mesh;
  mesh.name = "square";
  for (int j = 0; j <= n; ++j) {
    for (int i = 0; i <= n; ++i) {
      const auto u = [&](uint64_t k) {
        const bool border = i == 0 || j == 0 || i == n || j == n;
        const uint64_t key = HashKey(static_cast<uint64_t>(i), static_cast<uint64_t>(j), k);
        return border ? 0.0 : jitter * (ToUnitFloat(static_cast<uint32_t>(key)) - 0.5) / n;
      };
      mesh.positions.push_back({static_cast<float>(static_cast<double>(i) / n + u(0)),
                                static_cast<float>(static_cast<double>(j) / n + u(1)), 0});
    }
  }
  const auto at = [n](int i, int j) { return static_cast<uint32_t>(j * (n + 1) + i); };
  for (int j = 0; j < n; ++j) {
    for (int i = 0; i < n; ++i) {
      mesh.triangles.push_back({at(i, j), at(i + 1, j), at(i + 1, j + 1)});
      mesh.triangles.push_back({at(i, j), at(i + 1, j + 1), at(i, j + 1)});
    }
  }
  return mesh;
}

Scene SceneOf(Mesh mesh) {
  Scene scene;
  scene.meshes.push_back(std::move(mesh));
  scene.instances.emplace_back();
  return scene;
}

TEST(SurfelSampler, GivesAboutTheCountAndTheWholeArea) {
  const Scene scene = MakeCornellBox();
  const double area_m2 = SceneArea(*Prepare(scene));
  for (const uint64_t n : {2000u, 20000u, 88880u}) {
    const SurfelCloud cloud = Sample(scene, n);
    EXPECT_NEAR(static_cast<double>(cloud.size()), static_cast<double>(n),
                0.08 * static_cast<double>(n));
    double area = 0;
    for (const float a : cloud.area_m2) area += a;
    EXPECT_NEAR(area, area_m2, 1e-4 * area_m2);
  }
}

struct BlueNoise {
  size_t count = 0;
  double closest = 1e30;   // pair, in mean spacings
  double widest_gap = 0;   // from a point of the square to its nearest surfel, in mean spacings
  double area_spread = 0;  // standard deviation over mean
};

BlueNoise MeasureSquare(const SurfelCloud& cloud, const Vec3f& corner) {
  BlueNoise b;
  b.count = cloud.size();
  const double spacing = 1.0 / std::sqrt(static_cast<double>(cloud.size()));
  for (size_t i = 0; i < cloud.size(); ++i) {
    for (size_t j = i + 1; j < cloud.size(); ++j) {
      b.closest = std::min(b.closest, Length(Vec3d(cloud.position[i]) - Vec3d(cloud.position[j])));
    }
  }
  constexpr int kProbes = 200;
  for (int y = 0; y < kProbes; ++y) {
    for (int x = 0; x < kProbes; ++x) {
      const Vec3d p = Vec3d(corner) + Vec3d((x + 0.5) / kProbes, (y + 0.5) / kProbes, 0);
      double nearest = 1e30;
      for (const Vec3f& q : cloud.position) nearest = std::min(nearest, Length(Vec3d(q) - p));
      b.widest_gap = std::max(b.widest_gap, nearest);
    }
  }
  double mean = 0, square = 0;
  for (const float a : cloud.area_m2) {
    mean += a;
    square += static_cast<double>(a) * static_cast<double>(a);
  }
  mean /= static_cast<double>(cloud.size());
  square /= static_cast<double>(cloud.size());
  b.area_spread = std::sqrt(square - mean * mean) / mean;
  b.closest /= spacing;
  b.widest_gap /= spacing;
  return b;
}

class SurfelSamplerMesh : public testing::TestWithParam<int> {};

// From one large quad to triangles smaller than a surfel, with 1,500 surfels in all of them.
TEST_P(SurfelSamplerMesh, IsBlueNoise) {
  const Scene scene = SceneOf(JitteredSquare(GetParam(), 0.4));
  const auto prepared = Prepare(scene);
  const BlueNoise b = MeasureSquare(Sample(scene, 1500), prepared->bounds().min);
  RecordProperty("closest", std::to_string(b.closest));
  RecordProperty("widest_gap", std::to_string(b.widest_gap));
  RecordProperty("area_spread", std::to_string(b.area_spread));
  EXPECT_NEAR(static_cast<double>(b.count), 1500, 0.06 * 1500);
  EXPECT_GT(b.closest, 0.70);
  // A maximal set would leave no point farther away than the least distance; eight candidates to a
  // surfel leave some, in corners most of all.
  EXPECT_LT(b.widest_gap, 1.2);
  EXPECT_LT(b.area_spread, 0.3);
}

INSTANTIATE_TEST_SUITE_P(Quads, SurfelSamplerMesh, testing::Values(1, 3, 12, 40, 150));

TEST(SurfelSampler, IsTheSameForAnyNumberOfThreads) {
  // 40,000 surfels: several cubes and pieces for each thread.
  const Scene scene = SceneOf(JitteredSquare(60, 0.5));
  const SurfelCloud a = Sample(scene, 40000, 3, 1);
  for (const unsigned threads : {2u, 5u}) {
    const SurfelCloud b = Sample(scene, 40000, 3, threads);
    EXPECT_EQ(a.position, b.position);
    EXPECT_EQ(a.area_m2, b.area_m2);
    EXPECT_EQ(a.barycentric, b.barycentric);
  }
  EXPECT_NE(a.position, Sample(scene, 40000, 4, 1).position);
}

TEST(SurfelSampler, AnObjectThatIsMovedOrTurnedKeepsItsSurfels) {
  // Moves that change the scene's bounds, and with them the origin and the rounding of every
  // vertex; rotations; and all of that for a scaled and a mirrored instance.
  for (const double scale : {1.0, 0.3, -1.7}) {
    Scene scene = MakeCornellBox();
    const size_t last = scene.instances.size() - 1;
    for (Vec3d& column : scene.instances[last].world_from_mesh.column) column *= scale;
    const Affine rest = scene.instances[last].world_from_mesh;
    const SurfelCloud before = Sample(scene, 8000);
    uint64_t moved = 0;
    for (const double angle : {0.0, 0.3, 1.0, 2.5, 4.4}) {
      for (const double shift : {0.1, 7.7, 12345.678}) {
        Affine m = RotationAboutY(angle) * rest;
        m.translation = rest.translation + Vec3d(shift, shift / 3, -shift * 0.7);
        scene.instances[last].world_from_mesh = m;
        const SurfelCloud after = Sample(scene, 8000);
        EXPECT_EQ(before.triangle, after.triangle) << scale << " " << angle << " " << shift;
        EXPECT_EQ(before.barycentric, after.barycentric);
        EXPECT_EQ(before.area_m2, after.area_m2);
        moved += before.position != after.position;
      }
    }
    EXPECT_EQ(moved, 15u);
  }
}

TEST(SurfelSampler, AStretchedObjectKeepsItsSurfelsWhenMoved) {
  Scene scene = SceneOf(JitteredSquare(4, 0.5));
  scene.instances[0].world_from_mesh.column[0] *= 100;  // beyond what is free of its rotation
  const SurfelCloud before = Sample(scene, 3000);
  double area = 0;
  for (const float a : before.area_m2) area += a;
  EXPECT_NEAR(area, 100, 1e-3);
  EXPECT_NEAR(static_cast<double>(before.size()), 3000, 240);
  scene.instances[0].world_from_mesh.translation = {1.1, 2.2, 3.3};
  const SurfelCloud after = Sample(scene, 3000);
  EXPECT_EQ(before.barycentric, after.barycentric);
  EXPECT_EQ(before.area_m2, after.area_m2);
}

TEST(SurfelSampler, ScalingByAPowerOfTwoScalesTheSurfels) {
  Scene scene = MakeCornellBox();
  const SurfelCloud before = Sample(scene, 5000);
  for (Instance& instance : scene.instances) {
    for (Vec3d& column : instance.world_from_mesh.column) column *= 0.125;
    instance.world_from_mesh.translation *= 0.125;
  }
  const SurfelCloud after = Sample(scene, 5000);
  EXPECT_EQ(before.triangle, after.triangle);
  EXPECT_EQ(before.barycentric, after.barycentric);
  ASSERT_EQ(before.size(), after.size());
  for (size_t i = 0; i < before.size(); ++i) {
    EXPECT_EQ(before.position[i] * 0.125f, after.position[i]);
    EXPECT_EQ(before.area_m2[i] / 64, after.area_m2[i]);
  }
}

// Another unit of length leaves no trace, but for the rounding of positions.
TEST(SurfelSampler, ScalingKeepsTheSurfels) {
  const Scene scene = MakeCornellBox();
  const SurfelCloud before = Sample(scene, 5000);
  for (const double scale : {1e-3, 0.3, 1.9, 12.7, 1e3}) {
    Scene scaled = scene;
    for (Instance& instance : scaled.instances) {
      for (Vec3d& column : instance.world_from_mesh.column) column *= scale;
      instance.world_from_mesh.translation *= scale;
    }
    const SurfelCloud after = Sample(scaled, 5000);
    EXPECT_EQ(before.triangle, after.triangle) << scale;
    EXPECT_EQ(before.barycentric, after.barycentric) << scale;
    EXPECT_EQ(Prepare(scene)->objects()[0].content_key, Prepare(scaled)->objects()[0].content_key);
  }
}

TEST(SurfelSampler, KeysNameWhatDecides) {
  const Scene scene = MakeCornellBox();
  const auto prepared = Prepare(scene);
  Executor executor(1);
  const auto shapes = MakeObjectShapes(scene, *prepared, executor);
  const auto key = [&](size_t object, float spacing, uint64_t seed) {
    return ObjectSampler(shapes[object], *prepared, object, spacing, seed, executor).key();
  };
  EXPECT_EQ(key(0, 0.01f, 0), key(0, 0.01f, 0));
  EXPECT_NE(key(0, 0.01f, 0), key(0, 0.0101f, 0));
  EXPECT_NE(key(0, 0.01f, 0), key(0, 0.01f, 1));
  EXPECT_NE(key(0, 0.01f, 0), key(shapes.size() - 1, 0.01f, 0));
}

TEST(SurfelSampler, ThinSheetsKeepBothOfTheirSides) {
  // Two squares a hundredth of a spacing apart that face away from each other: each has its own.
  Mesh mesh = JitteredSquare(1, 0);
  const auto n = static_cast<uint32_t>(mesh.positions.size());
  for (uint32_t i = 0; i < n; ++i) mesh.positions.push_back(mesh.positions[i] - Vec3f(0, 0, 3e-4f));
  const size_t triangles = mesh.triangles.size();
  for (size_t t = 0; t < triangles; ++t) {
    const auto& v = mesh.triangles[t];
    mesh.triangles.push_back({v[0] + n, v[2] + n, v[1] + n});
  }
  const SurfelCloud cloud = Sample(SceneOf(std::move(mesh)), 2000);
  size_t up = 0;
  for (const Vec3f& normal : cloud.normal) up += normal.z > 0;
  EXPECT_NEAR(static_cast<double>(up), 1000, 60);
  EXPECT_NEAR(static_cast<double>(cloud.size() - up), 1000, 60);
}

TEST(SurfelSampler, LongSliversHaveTheirArea) {
  // 1,000 m by 1 mm beside a square metre.
  Scene scene = SceneOf(JitteredSquare(1, 0));
  Mesh sliver;
  sliver.positions = {{0, 0, 1}, {577.0f, 577.0f, 578.0f}, {0, 0.001f, 1}};
  sliver.triangles = {{0, 1, 2}};
  scene.meshes.push_back(sliver);
  scene.instances.emplace_back();
  scene.instances.back().mesh = 1;
  const SurfelCloud cloud = Sample(scene, 2000);
  double area = 0;
  for (const float a : cloud.area_m2) area += a;
  EXPECT_NEAR(area, 1 + 0.5 * 0.001 * 577 * std::sqrt(2.0), 1e-5);
}

TEST(SurfelSampler, HolesOfAlphaMasksAreNoSurface) {
  // A square metre whose left half (u < 1/2) is a hole.
  Scene scene;
  Texture texture;
  texture.name = "mask";
  texture.nearest = true;
  texture.encoded = Blob::FromString(MakePng(2, 1, {255, 255, 255, 0, 255, 255, 255, 255}));
  scene.textures.push_back(texture);
  Material material;
  material.alpha_mode = AlphaMode::kMask;
  material.base_color_texture.texture = 0;
  scene.materials.push_back(material);
  Mesh mesh;
  mesh.positions = {{0, 0, 0}, {1, 0, 0}, {1, 1, 0}, {0, 1, 0}};
  mesh.uv[0] = {{0, 0}, {1, 0}, {1, 1}, {0, 1}};
  mesh.triangles = {{0, 1, 2}, {0, 2, 3}};
  mesh.material = 0;
  scene.meshes.push_back(mesh);
  scene.instances.emplace_back();
  Executor executor(1);
  const auto prepared = PreparedScene::Prepare(scene, executor);
  ASSERT_TRUE(prepared.ok()) << prepared.status();
  ASSERT_TRUE((*prepared)->has_alpha_masks());
  const auto key = [&](const Scene& s) {
    const auto p = PreparedScene::Prepare(s, executor).value();
    const auto shapes = MakeObjectShapes(s, *p, executor);
    return ObjectSampler(shapes[0], *p, 0, 0.02f, 0, executor).key();
  };
  const Digest before = key(scene);
  const SurfelCloud cloud = SampleSurfels(scene, **prepared, 2000, 0, executor);
  ASSERT_GT(cloud.size(), 500u);
  double area = 0;
  for (size_t i = 0; i < cloud.size(); ++i) {
    EXPECT_GE(cloud.position[i].x + (*prepared)->origin().x, 0.5);
    area += cloud.area_m2[i];
  }
  EXPECT_NEAR(area, 0.5, 0.005);
  // Another picture with the same holes leaves the key, other holes do not.
  scene.textures[0].encoded = Blob::FromString(MakePng(2, 1, {9, 9, 9, 0, 99, 99, 99, 255}));
  EXPECT_EQ(key(scene), before);
  scene.textures[0].encoded = Blob::FromString(MakePng(2, 1, {9, 9, 9, 255, 99, 99, 99, 0}));
  EXPECT_NE(key(scene), before);
}

TEST(SurfelSampler, ObjectsInOnePlaceAreSampledOnce) {
  const Scene scene = MakeCornellBox();
  const SurfelCloud once = Sample(scene, 5000);
  Scene twice = scene;
  for (const Instance& instance : scene.instances) twice.instances.push_back(instance);
  const SurfelCloud cloud = Sample(twice, 5000);
  EXPECT_EQ(cloud.position, once.position);
  EXPECT_EQ(cloud.area_m2, once.area_m2);
  // Next to each other they are two.
  for (size_t i = scene.instances.size(); i < twice.instances.size(); ++i) {
    twice.instances[i].world_from_mesh.translation.y += 1e-3;
  }
  const SurfelCloud apart = Sample(twice, 10000);
  EXPECT_GT(apart.size(), once.size() * 19 / 10);
  // What has holes hides nothing.
  Scene holes;
  Material mask;
  mask.alpha_mode = AlphaMode::kMask;
  mask.base_alpha = 0.1f;
  holes.materials = {mask, Material()};
  for (const int32_t material : {0, 1}) {
    Mesh mesh = JitteredSquare(1, 0);
    mesh.material = material;
    holes.meshes.push_back(mesh);
    holes.instances.emplace_back();
    holes.instances.back().mesh = static_cast<uint32_t>(material);
  }
  EXPECT_GT(Sample(holes, 1000).size(), 400u);
}

TEST(SurfelSampler, SmallObjectsGetAtLeastOne) {
  const Scene scene = MakeCornellBox();
  const auto prepared = Prepare(scene);
  const SurfelCloud cloud = Sample(scene, 1);
  std::vector<bool> seen(prepared->objects().size());
  for (const uint32_t t : cloud.triangle) seen[prepared->triangles()[t].object] = true;
  for (const bool s : seen) EXPECT_TRUE(s);
  EXPECT_EQ(Sample(scene, 0).size(), 0u);
}

TEST(SurfelSpacing, ChangesInSteps) {
  EXPECT_EQ(SurfelSpacingM({}, 100), 0);
  EXPECT_EQ(SurfelSpacingM({1, 1}, 0), 0);
  // About sqrt(area / count), in steps of less than 0.8 %.
  EXPECT_NEAR(SurfelSpacingM({4, 3}, 10000), 0.759 * 0.02, 0.004 * 0.02);
  EXPECT_EQ(SurfelSpacingM({4, 3}, 10000), SurfelSpacingM({std::nextafter(4.0, 5.0), 3}, 10000));
  // Another unit, another length, the same in parts of the scene.
  EXPECT_EQ(SurfelSpacingM({16, 12}, 10000), 2 * SurfelSpacingM({4, 3}, 10000));
  for (const double scale : {1e-3, 0.3, 7.7, 1e3}) {
    EXPECT_FLOAT_EQ(SurfelSpacingM({4 * scale * scale, 3 * scale * scale}, 10000),
                    static_cast<float>(scale) * SurfelSpacingM({4, 3}, 10000));
  }
  // 500 squares along the diagonal, within the limits.
  constexpr uint64_t kAny = ~uint64_t{0}, kLeast = 100'000;
  EXPECT_NEAR(DefaultSurfelSpacingM({2, 2}, 1, kLeast, kAny), 0.759 / 500, 0.07 * 0.759 / 500);
  EXPECT_NEAR(DefaultSurfelSpacingM({2, 2}, 1, kLeast, 125'000), 0.759 / 250, 0.07 * 0.759 / 250);
  EXPECT_NEAR(DefaultSurfelSpacingM({0.001, 0.001}, 1, kLeast, kAny),
              0.759 * std::sqrt(0.001 / 1e5), 2e-5 * 0.8);
  EXPECT_NEAR(DefaultSurfelSpacingM({1, 1}, 1, kLeast, 7), 0.759 * std::sqrt(1 / 1e5),
              0.07 * 0.0024);
  EXPECT_NEAR(DefaultSurfelSpacingM({1, 1}, 1, 10'000, 7), 0.759 * std::sqrt(1 / 1e4),
              0.07 * 0.0076);
  EXPECT_EQ(DefaultSurfelSpacingM({}, 0, kLeast, kAny), 0);
}

}  // namespace
}  // namespace farpoint

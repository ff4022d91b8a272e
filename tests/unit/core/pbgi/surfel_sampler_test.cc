#include "core/pbgi/surfel_sampler.h"

#include <gtest/gtest.h>

#include <algorithm>

#include "core/scene/procedural.h"
#include "tests/unit/core/scene/scene_test_util.h"

namespace farpoint {
namespace {

std::shared_ptr<const PreparedScene> Cornell() {
  Executor executor(1);
  return PreparedScene::Prepare(MakeCornellBox(), executor).value();
}

double SceneArea(const PreparedScene& scene) {
  double area = 0;
  for (uint32_t t = 0; t < scene.triangles().size(); ++t) area += scene.TriangleArea(t);
  return area;
}

TEST(SurfelSampler, GivesAboutTheCountAndTheWholeArea) {
  const auto scene = Cornell();
  Executor executor(2);
  for (const uint64_t n : {2000u, 20000u, 88880u}) {
    const SurfelCloud cloud = SampleSurfels(*scene, n, 0, executor);
    EXPECT_NEAR(static_cast<double>(cloud.size()), static_cast<double>(n),
                0.08 * static_cast<double>(n));
    double area = 0;
    for (const float a : cloud.area_m2) area += a;
    EXPECT_NEAR(area, SceneArea(*scene), 1e-4 * SceneArea(*scene));
  }
}

TEST(SurfelSampler, IsBlueNoise) {
  const auto scene = Cornell();
  Executor executor(2);
  const SurfelCloud cloud = SampleSurfels(*scene, 5000, 0, executor);
  const double spacing = std::sqrt(SceneArea(*scene) / 5000);
  // No two surfels of one surface are closer than about 0.78 of the mean spacing.
  double closest = 1e30;
  for (size_t i = 0; i < cloud.size(); ++i) {
    for (size_t j = i + 1; j < cloud.size(); ++j) {
      if (Dot(cloud.normal[i], cloud.normal[j]) < 0.99f) continue;
      if (scene->triangles()[cloud.triangle[i]].object !=
          scene->triangles()[cloud.triangle[j]].object) {
        continue;
      }
      closest =
          std::min(closest, static_cast<double>(Length(cloud.position[i] - cloud.position[j])));
    }
  }
  EXPECT_GT(closest, 0.7 * spacing);
  // And areas follow the local density: they vary little.
  double mean = 0, square = 0;
  for (const float a : cloud.area_m2) {
    mean += a;
    square += static_cast<double>(a) * static_cast<double>(a);
  }
  mean /= static_cast<double>(cloud.size());
  square /= static_cast<double>(cloud.size());
  EXPECT_LT(std::sqrt(square - mean * mean), 0.3 * mean);
}

TEST(SurfelSampler, IsTheSameForAnyNumberOfThreads) {
  const auto scene = Cornell();
  Executor one(1), four(4);
  const SurfelCloud a = SampleSurfels(*scene, 10000, 3, one);
  const SurfelCloud b = SampleSurfels(*scene, 10000, 3, four);
  EXPECT_EQ(a.position, b.position);
  EXPECT_EQ(a.area_m2, b.area_m2);
  EXPECT_NE(a.position, SampleSurfels(*scene, 10000, 4, one).position);
}

TEST(SurfelSampler, AnObjectKeepsItsSurfelsWhenItsPeersChange) {
  Scene scene = MakeCornellBox();
  Executor executor(1);
  const auto before = PreparedScene::Prepare(scene, executor).value();
  const SurfelCloud a = SampleSurfels(*before, 8000, 0, executor);
  // The last object moves by a tenth of a metre; the rest must not notice.
  scene.instances.back().world_from_mesh.translation += Vec3d(0.1, 0, 0.1);
  const auto after = PreparedScene::Prepare(scene, executor).value();
  ASSERT_EQ(before->origin(), after->origin());  // the bounding box is the walls'
  const SurfelCloud b = SampleSurfels(*after, 8000, 0, executor);
  const uint32_t last = static_cast<uint32_t>(before->objects().size() - 1);
  std::vector<Vec3f> pa, pb;
  for (size_t i = 0; i < a.size(); ++i) {
    if (before->triangles()[a.triangle[i]].object != last) pa.push_back(a.position[i]);
  }
  for (size_t i = 0; i < b.size(); ++i) {
    if (after->triangles()[b.triangle[i]].object != last) pb.push_back(b.position[i]);
  }
  EXPECT_EQ(pa, pb);
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
  const SurfelCloud cloud = SampleSurfels(**prepared, 2000, 0, executor);
  ASSERT_GT(cloud.size(), 500u);
  double area = 0;
  for (size_t i = 0; i < cloud.size(); ++i) {
    EXPECT_GE(cloud.position[i].x + (*prepared)->origin().x, 0.5);
    area += cloud.area_m2[i];
  }
  EXPECT_NEAR(area, 0.5, 0.005);
}

TEST(SurfelSampler, SmallObjectsGetAtLeastOne) {
  const auto scene = Cornell();
  Executor executor(1);
  const SurfelCloud cloud = SampleSurfels(*scene, 1, 0, executor);
  std::vector<bool> seen(scene->objects().size());
  for (const uint32_t t : cloud.triangle) seen[scene->triangles()[t].object] = true;
  for (const bool s : seen) EXPECT_TRUE(s);
  EXPECT_EQ(SampleSurfels(*scene, 0, 0, executor).size(), 0u);
}

}  // namespace
}  // namespace farpoint

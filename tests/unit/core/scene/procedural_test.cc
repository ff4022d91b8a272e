#include "core/scene/procedural.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cmath>
#include <map>

#include "core/base/executor.h"
#include "core/math/elementary.h"
#include "core/scene/prepared_scene.h"

namespace farpoint {
namespace {

std::shared_ptr<const PreparedScene> PrepareOk(const Scene& scene) {
  Executor executor(2);
  auto prepared = PreparedScene::Prepare(scene, executor);
  EXPECT_TRUE(prepared.ok()) << prepared.status();
  return *prepared;
}

double AreaOf(const PreparedScene& p, const PreparedObject& object) {
  double area = 0;
  for (uint64_t t = 0; t < object.triangle_count; ++t) {
    area += p.TriangleArea(static_cast<uint32_t>(object.first_triangle + t));
  }
  return area;
}

// Numbers as published, in units of 100 mm.
TEST(CornellBox, HasThePublishedGeometry) {
  const Scene scene = MakeCornellBox();
  ASSERT_EQ(scene.meshes.size(), 8u);
  std::map<std::string, const Mesh*> mesh;
  for (const Mesh& m : scene.meshes) mesh[m.name] = &m;
  const auto holds = [&](const char* name, const Vec3f& p) {
    const auto& all = mesh.at(name)->positions;
    return std::find(all.begin(), all.end(), p) != all.end();
  };
  EXPECT_TRUE(holds("floor", {5.528f, 0, 0}));
  EXPECT_TRUE(holds("floor", {5.496f, 0, 5.592f}));
  EXPECT_TRUE(holds("light", {3.43f, 5.488f, 2.27f}));
  EXPECT_TRUE(holds("light", {2.13f, 5.488f, 3.32f}));
  EXPECT_TRUE(holds("left", {5.56f, 5.488f, 5.592f}));
  EXPECT_TRUE(holds("short", {1.3f, 1.65f, 0.65f}));
  EXPECT_TRUE(holds("short", {2.9f, 0, 1.14f}));
  EXPECT_TRUE(holds("tall", {4.23f, 3.3f, 2.47f}));
  EXPECT_TRUE(holds("tall", {4.72f, 0, 4.06f}));
  const auto color = [&](const char* name) {
    return scene.materials[static_cast<size_t>(mesh.at(name)->material)].base_color;
  };
  EXPECT_EQ(color("back"), Rgb(0.725f, 0.71f, 0.68f));
  EXPECT_EQ(color("left"), Rgb(0.63f, 0.065f, 0.05f));
  EXPECT_EQ(color("right"), Rgb(0.14f, 0.45f, 0.091f));
  EXPECT_EQ(color("light"), Rgb(0, 0, 0));
  EXPECT_EQ(scene.materials[3].emission, Rgb(17, 12, 4));
  ASSERT_EQ(scene.cameras.size(), 1u);
  EXPECT_EQ(scene.cameras[0].eye, Vec3d(2.78, 2.73, -8));
  EXPECT_NEAR(std::tan(0.5 * scene.cameras[0].yfov_rad), 0.0125 / 0.035, 1e-6);
}

TEST(CornellBox, IsClosedAndItsCeilingHasNoOverlap) {
  const auto p = PrepareOk(MakeCornellBox());
  EXPECT_EQ(p->triangles().size(), 38u);
  EXPECT_EQ(p->emissive_triangles().size(), 2u);
  const double ceiling = AreaOf(*p, p->objects()[1]), light = AreaOf(*p, p->objects()[2]);
  EXPECT_NEAR(light, 1.3 * 1.05, 1e-5);
  EXPECT_NEAR(ceiling + light, 5.56 * 5.592, 1e-4);
  // Front sides face the inside of the box and the outside of the blocks.
  const Vec3f center = Vec3f(Vec3d(2.78, 2.73, 2.8) - p->origin());
  for (uint32_t o = 0; o < 6; ++o) {
    const auto t = static_cast<uint32_t>(p->objects()[o].first_triangle);
    EXPECT_GT(Dot(p->GeometricNormal(t), center - p->PointOn(t, 0.3f, 0.3f)), 0) << o;
  }
}

TEST(Furnace, IsAClosedBoxThatFacesInwards) {
  const auto p = PrepareOk(MakeFurnace(0.25f, 3));
  ASSERT_EQ(p->triangles().size(), 12u);
  EXPECT_EQ(p->origin(), Vec3d());
  EXPECT_NEAR(AreaOf(*p, p->objects()[0]), 24, 1e-5);
  Vec3d sum;
  double solid_angle = 0;
  for (uint32_t t = 0; t < 12; ++t) {
    const Vec3f n = p->GeometricNormal(t), c = p->PointOn(t, 1.0f / 3, 1.0f / 3);
    EXPECT_LT(Dot(n, c), 0);
    sum += Vec3d(n) * double{p->TriangleArea(t)};
    // Van Oosterom and Strackee 1983.
    Vec3d v[3];
    for (int k = 0; k < 3; ++k) v[k] = Normalize(Vec3d(p->vertices()[p->triangles()[t].vertex[k]]));
    solid_angle += 2 * std::atan2(std::fabs(Dot(v[0], Cross(v[1], v[2]))),
                                  1 + Dot(v[0], v[1]) + Dot(v[1], v[2]) + Dot(v[2], v[0]));
  }
  EXPECT_NEAR(Length(sum), 0, 1e-6);
  EXPECT_NEAR(solid_angle, 4 * kPi, 1e-6);
  EXPECT_EQ(p->Surface(5, 0.1f, 0.1f).albedo, Rgb(0.25f));
  EXPECT_EQ(p->Surface(5, 0.1f, 0.1f).emission, Rgb(3));
}

TEST(City, DependsOnItsSeedOnly) {
  const auto hash = [](unsigned blocks, uint64_t seed) {
    return PrepareOk(MakeCity(blocks, seed))->blob().Hash();
  };
  EXPECT_EQ(hash(2, 5), hash(2, 5));
  EXPECT_NE(hash(2, 5), hash(2, 6));
  EXPECT_NE(hash(2, 5), hash(3, 5));
}

TEST(City, ScalesWithItsBlocksAndHasNoDegenerateTriangle) {
  double per_block[2];
  int k = 0;
  for (const unsigned blocks : {4u, 8u}) {
    const auto p = PrepareOk(MakeCity(blocks, 1));
    EXPECT_EQ(p->dropped_triangles(), 0u);
    per_block[k++] = static_cast<double>(p->triangles().size()) / (blocks * blocks);
    EXPECT_NEAR(p->bounds().max.x - p->bounds().min.x, blocks * 60.0 + 32, 1);
  }
  EXPECT_NEAR(per_block[0] / per_block[1], 1, 0.2);
  EXPECT_GT(per_block[1] * 64, 100'000);
  EXPECT_LT(per_block[1] * 64, 400'000);
}

TEST(City, InstancesItsPartsAndMirrorsSome) {
  const Scene scene = MakeCity(8, 1);
  EXPECT_GT(scene.instances.size(), 10 * scene.meshes.size());
  size_t mirrored = 0;
  for (const Instance& instance : scene.instances) {
    mirrored += instance.world_from_mesh.Determinant() < 0;
  }
  EXPECT_GT(mirrored, 100u);
  EXPECT_LT(mirrored, scene.instances.size() / 2);
  ASSERT_EQ(scene.cameras.size(), 2u);
  EXPECT_EQ(scene.cameras[0].name, "street");
  EXPECT_LT(scene.cameras[0].eye.y, 3);
  EXPECT_EQ(scene.cameras[1].name, "aerial");
  for (const unsigned blocks : {0u, 1u, 2u}) {
    EXPECT_GT(MakeCity(blocks, 1).instances.size(), 10u);
  }
}

// Nothing hangs in the air or below the ground.
TEST(City, StandsOnTheGround) {
  const Scene scene = MakeCity(3, 1);
  std::map<std::pair<std::string, double>, double> lowest;
  for (const Instance& instance : scene.instances) {
    double& low =
        lowest
            .try_emplace({instance.name, instance.world_from_mesh.translation.x +
                                             1e4 * instance.world_from_mesh.translation.z},
                         1e9)
            .first->second;
    for (const Vec3f& p : scene.meshes[instance.mesh].positions) {
      low = std::min(low, instance.world_from_mesh.Point(Vec3d(p)).y);
    }
  }
  for (const auto& [key, low] : lowest) {
    EXPECT_GE(low, -1e-6) << key.first;
    EXPECT_LE(low, 0.3) << key.first;
  }
}

}  // namespace
}  // namespace farpoint

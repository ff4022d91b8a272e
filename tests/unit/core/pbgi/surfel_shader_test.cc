#include "core/pbgi/surfel_shader.h"

#include <gtest/gtest.h>

#include "core/math/elementary.h"
#include "core/pbgi/surfel_sampler.h"
#include "core/scene/procedural.h"

namespace farpoint {
namespace {

struct Shaded {
  std::shared_ptr<const PreparedScene> scene;
  SurfelCloud cloud;
  SurfelSides open_sides;
  SurfelShading shading;
  Stats stats;
};

Shaded Shade(const Scene& description, uint64_t n, unsigned threads = 1) {
  Executor executor(threads);
  Shaded s;
  s.scene = PreparedScene::Prepare(description, executor).value();
  const auto accel = RayAccel::Build(s.scene).value();
  const LightSampler lights(accel);
  s.cloud = SampleSurfels(description, *s.scene, n, 0, executor);
  s.open_sides = FindOpenSides(s.cloud, *accel, 0, executor, s.stats);
  s.shading =
      ShadeSurfels(s.cloud, s.open_sides, *accel, lights, ShadeOptions(), executor, s.stats);
  return s;
}

TEST(SurfelShader, FurnaceWallsReflectRhoL) {
  // Inside a closed box of emission L every wall receives pi L and reflects rho L.
  const Shaded s = Shade(MakeFurnace(0.5f, 2.0f), 20000);
  double sum = 0;
  size_t lit = 0;
  for (size_t i = 0; i < s.cloud.size(); ++i) {
    const float inner = std::max(s.shading.front[i].x, s.shading.back[i].x);
    sum += inner;
    lit += inner > 0;
  }
  EXPECT_EQ(lit, s.cloud.size());
  EXPECT_NEAR(sum / static_cast<double>(lit), 1.0, 0.02);
}

TEST(SurfelShader, IsTheSameForAnyNumberOfThreads) {
  const Shaded a = Shade(MakeCornellBox(), 5000, 1), b = Shade(MakeCornellBox(), 5000, 3);
  EXPECT_EQ(a.shading.front, b.shading.front);
  EXPECT_EQ(a.shading.back, b.shading.back);
  EXPECT_EQ(a.shading.visible_sides, b.shading.visible_sides);
}

TEST(SurfelShader, InsidesOfClosedObjectsAreInvisible) {
  // The Cornell box's blocks have no bottom: their insides see the floor's front and stay visible.
  // A closed box in a lit room: its inside is not.
  Scene scene = MakeFurnace(0.5f, 1.0f);
  Mesh box;
  box.name = "closed box";
  const float s = 0.2f;
  for (int i = 0; i < 8; ++i) {
    box.positions.push_back({i & 1 ? s : -s, i & 2 ? s : -s, i & 4 ? s : -s});
  }
  // Outward faces.
  const uint32_t quads[6][4] = {{0, 2, 3, 1}, {4, 5, 7, 6}, {0, 1, 5, 4},
                                {2, 6, 7, 3}, {0, 4, 6, 2}, {1, 3, 7, 5}};
  for (const auto& q : quads) {
    box.triangles.push_back({q[0], q[1], q[2]});
    box.triangles.push_back({q[0], q[2], q[3]});
  }
  scene.meshes.push_back(box);
  Instance instance;
  instance.mesh = static_cast<uint32_t>(scene.meshes.size() - 1);
  scene.instances.push_back(instance);
  const Shaded shaded = Shade(scene, 5000);
  const uint32_t object = static_cast<uint32_t>(shaded.scene->objects().size() - 1);
  int inside = 0, outside = 0;
  for (size_t i = 0; i < shaded.cloud.size(); ++i) {
    if (shaded.scene->triangles()[shaded.cloud.triangle[i]].object != object) continue;
    const Vec3f out = shaded.cloud.position[i] + Vec3f(shaded.scene->origin());
    const bool front_out = Dot(shaded.cloud.normal[i], out) > 0;
    const uint8_t out_bit = front_out ? kFrontVisible : kBackVisible;
    const uint8_t in_bit = front_out ? kBackVisible : kFrontVisible;
    outside += (shaded.shading.visible_sides[i] & out_bit) != 0;
    inside += (shaded.shading.visible_sides[i] & in_bit) != 0;
  }
  EXPECT_GT(outside, 50);
  EXPECT_EQ(inside, 0);
  EXPECT_GT(shaded.stats.skipped.at("surfel_sides_inside"), 0u);
}

}  // namespace
}  // namespace farpoint

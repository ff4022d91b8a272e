#include "core/scene/quad_mesh.h"

#include <gtest/gtest.h>

namespace farpoint {
namespace {

const Quad kFloor = {{{0, 0, 0}, {0, 0, 1}, {1, 0, 1}, {1, 0, 0}}};

TEST(QuadMesh, FrontsFollowTheOrderOfCorners) {
  const Mesh mesh = MeshOfQuads("floor", 3, {kFloor});
  EXPECT_EQ(mesh.name, "floor");
  EXPECT_EQ(mesh.material, 3);
  ASSERT_EQ(mesh.triangles.size(), 2u);
  float area = 0;
  for (const auto& t : mesh.triangles) {
    const Vec3f a = mesh.positions[t[0]];
    const Vec3f n = Cross(mesh.positions[t[1]] - a, mesh.positions[t[2]] - a);
    EXPECT_GT(n.y, 0);
    area += 0.5f * Length(n);
  }
  EXPECT_FLOAT_EQ(area, 1);
}

TEST(QuadMesh, EachQuadHasItsOwnVerticesAndTheSceneAnInstance) {
  Scene scene;
  AddQuads("first", 0, {kFloor}, scene);
  AddQuads("second", 1, {kFloor, kFloor}, scene);
  ASSERT_EQ(scene.meshes.size(), 2u);
  EXPECT_EQ(scene.meshes[1].positions.size(), 8u);
  EXPECT_EQ(scene.meshes[1].triangles.size(), 4u);
  ASSERT_EQ(scene.instances.size(), 2u);
  EXPECT_EQ(scene.instances[1].name, "second");
  EXPECT_EQ(scene.instances[1].mesh, 1u);
}

TEST(QuadMesh, LambertMaterialsHaveNoMetal) {
  const Material m = LambertMaterial("lamp", Rgb(0.5f), Rgb(3));
  EXPECT_EQ(m.metallic, 0);
  EXPECT_EQ(m.base_color, Rgb(0.5f));
  EXPECT_EQ(m.emission, Rgb(3));
}

}  // namespace
}  // namespace farpoint

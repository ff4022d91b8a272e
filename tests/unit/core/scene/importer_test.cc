#include "core/scene/importer.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>

#include "core/base/executor.h"
#include "core/scene/prepared_scene.h"
#include "core/scene/procedural.h"
#include "tests/unit/core/scene/scene_test_util.h"

namespace farpoint {
namespace {

using ::testing::HasSubstr;
using ::testing::IsEmpty;

TEST(ImportScene, RefusesUnknownExtensions) {
  const auto imported = ImportScene({"scene.fbx", {{"scene.fbx", Blob()}}}, {});
  EXPECT_EQ(imported.status().code(), absl::StatusCode::kInvalidArgument);
  EXPECT_THAT(std::string(imported.status().message()), HasSubstr(".gltf"));
}

TEST(ImportScene, NeedsItsMainFile) {
  EXPECT_EQ(ImportScene({"scene.gltf", {}}, {}).status().code(), absl::StatusCode::kNotFound);
}

TEST(EnsureCameraAndLight, FramesEveryCornerOfTheScene) {
  ImportedScene imported;
  imported.scene = MakeFurnace(0.5f, 1);
  imported.scene.cameras.clear();
  imported.scene.instances[0].world_from_mesh.column[0] = {30, 0, 0};
  imported.scene.instances[0].world_from_mesh.translation = {1e5, 20, -7};
  EnsureCameraAndLight(imported, /*light_chosen=*/false);
  ASSERT_EQ(imported.scene.cameras.size(), 1u);
  ASSERT_EQ(imported.notes.size(), 1u);
  EXPECT_THAT(imported.notes[0], HasSubstr("no camera"));
  EXPECT_THAT(imported.scene.lights, IsEmpty());  // it glows
  const Camera& camera = imported.scene.cameras[0];
  EXPECT_NEAR(Dot(camera.right, camera.up), 0, 1e-12);
  EXPECT_NEAR(Length(camera.up), 1, 1e-12);
  for (const Vec3f& p : imported.scene.meshes[0].positions) {
    const Vec3d d = imported.scene.instances[0].world_from_mesh.Point(Vec3d(p)) - camera.eye;
    const double depth = Dot(d, camera.forward);
    ASSERT_GT(depth, 0);
    const double half = std::tan(0.5 * camera.yfov_rad);
    EXPECT_LE(std::fabs(Dot(d, camera.up)) / depth, half);
    EXPECT_LE(std::fabs(Dot(d, camera.right)) / depth, half);
  }
}

TEST(EnsureCameraAndLight, LightsOnlyWhatIsDark) {
  const auto notes_of = [](const Scene& scene, bool light_chosen = false) {
    ImportedScene imported;
    imported.scene = scene;
    EnsureCameraAndLight(imported, light_chosen);
    return imported.notes;
  };
  Scene dark = MakeFurnace(0.5f, 0);
  ASSERT_EQ(notes_of(dark).size(), 1u);
  EXPECT_THAT(notes_of(dark)[0], HasSubstr("no light"));
  EXPECT_THAT(notes_of(dark, /*light_chosen=*/true), IsEmpty());
  EXPECT_THAT(notes_of(MakeCornellBox()), IsEmpty());
  EXPECT_THAT(notes_of(MakeCity(1, 1)), IsEmpty());
  Scene sky = dark;
  sky.environment.sky = {0, 0, 1};
  EXPECT_THAT(notes_of(sky), IsEmpty());
  Scene off = dark;
  off.lights.push_back(PunctualLight());
  EXPECT_THAT(notes_of(off), testing::SizeIs(1));
  Scene unused = dark;
  unused.materials.push_back(unused.materials[0]);
  unused.materials[1].emission = {1, 1, 1};
  EXPECT_THAT(notes_of(unused), testing::SizeIs(1));
  Scene empty = MakeCornellBox();
  empty.instances.clear();
  EXPECT_THAT(notes_of(empty, true), testing::ElementsAre(HasSubstr("no triangles")));
}

}  // namespace
}  // namespace farpoint

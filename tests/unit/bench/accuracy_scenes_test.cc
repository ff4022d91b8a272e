#include "bench/accuracy_scenes.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <set>

#include "core/scene/procedural.h"
#include "tests/unit/bench/temp_folder.h"

namespace farpoint {
namespace {

using ::testing::HasSubstr;

TEST(AccuracyScenes, NamesAreUniqueAndFound) {
  for (const bool quick : {false, true}) {
    std::set<std::string> names;
    for (const AccuracyCase& c : AccuracyCases(quick)) {
      EXPECT_TRUE(names.insert(c.name).second) << c.name;
      EXPECT_GT(c.rr_bar, 0) << c.name;
      EXPECT_GT(c.bias_bar, 0) << c.name;
      const auto found = FindAccuracyCase(c.name, quick);
      ASSERT_TRUE(found.ok());
      EXPECT_EQ(found->scene, c.scene);
    }
  }
  const auto unknown = FindAccuracyCase("nowhere", false);
  EXPECT_EQ(unknown.status().code(), absl::StatusCode::kInvalidArgument);
  EXPECT_THAT(std::string(unknown.status().message()), HasSubstr("macross"));
}

TEST(AccuracyScenes, CommandsHoldAllFlags) {
  const AccuracyCase c = FindAccuracyCase("sponza-sky-1280", false).value();
  EXPECT_EQ(
      CommandOf(c),
      "sponza/Sponza.gltf --resolution 1280x1000 --eye 9,0.8,-0.3 --target -8,4,-0.3 --fov 57 "
      "--sun 0.3,1,0.1:10,10,10 --sky 0.5,0.6,0.8");
}

TEST(AccuracyScenes, CamerasLookAtTheirTarget) {
  const Camera camera = CameraOf({{1, 2, 3}, {4, 2, -1}, 90}).value();
  EXPECT_NEAR(Dot(camera.forward, Vec3d(0.6, 0, -0.8)), 1, 1e-12);
  EXPECT_NEAR(camera.up.y, 1, 1e-12);
  // To the right of somebody who looks along -z is +x.
  EXPECT_GT(Dot(camera.right, Vec3d(0.8, 0, 0.6)), 0.999);
  EXPECT_NEAR(camera.yfov_rad, 1.5707963267948966, 1e-12);
  EXPECT_FALSE(CameraOf({{0, 0, 0}, {0, 1, 0}, 60}).ok());
  EXPECT_FALSE(CameraOf({{1, 1, 1}, {1, 1, 1}, 60}).ok());
}

TEST(AccuracyScenes, WhatIsMissingIsSaid) {
  const TempFolder folder;
  const AccuracyCase sponza = FindAccuracyCase("sponza-sun", false).value();
  std::string missing;
  auto loaded = LoadAccuracyScene(sponza, {}, false, missing);
  ASSERT_TRUE(loaded.ok());
  EXPECT_FALSE(*loaded);
  EXPECT_THAT(missing, HasSubstr("--scenes"));
  loaded = LoadAccuracyScene(sponza, {folder.path().string(), ""}, false, missing);
  ASSERT_TRUE(loaded.ok());
  EXPECT_FALSE(*loaded);
  EXPECT_THAT(missing, HasSubstr(folder / "sponza/Sponza.gltf"));
  const AccuracyCase cornell = FindAccuracyCase("cornell", false).value();
  loaded = LoadAccuracyScene(cornell, {folder.path().string(), ""}, false, missing);
  ASSERT_TRUE(loaded.ok());
  EXPECT_FALSE(*loaded);
  EXPECT_THAT(missing, HasSubstr("--references"));
}

TEST(AccuracyScenes, LightsAndCameraReplaceTheScenes) {
  const TempFolder folder;
  ASSERT_TRUE(WriteGltf(MakeCity(1, 1), folder / "city.gltf").ok());
  AccuracyCase c;
  c.scene = "city.gltf";
  std::string missing;
  const auto plain = LoadAccuracyScene(c, {folder.path().string(), ""}, false, missing);
  ASSERT_TRUE(plain.ok() && *plain) << plain.status() << missing;
  EXPECT_EQ((*plain)->camera.name, "street");

  c.sun = AccuracySun{{0, 2, 0}, Rgb(1, 2, 3)};
  c.sky = Rgb(4, 5, 6);
  c.view = AccuracyView{{0, 1, 0}, {1, 1, 0}, 40};
  const auto changed = LoadAccuracyScene(c, {folder.path().string(), ""}, false, missing);
  ASSERT_TRUE(changed.ok() && *changed) << changed.status();
  const Scene& scene = (*changed)->scene;
  ASSERT_EQ(scene.lights.size(), 1u);
  EXPECT_EQ(scene.lights[0].kind, PunctualKind::kDirectional);
  EXPECT_EQ(scene.lights[0].direction, Vec3d(0, -1, 0));
  EXPECT_EQ(scene.lights[0].intensity, Rgb(1, 2, 3));
  EXPECT_EQ(scene.environment.sky, Rgb(4, 5, 6));
  EXPECT_NEAR((*changed)->camera.forward.x, 1, 1e-12);
}

}  // namespace
}  // namespace farpoint

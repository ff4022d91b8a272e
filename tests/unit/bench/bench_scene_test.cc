#include "bench/bench_scene.h"

#include <gtest/gtest.h>

#include "core/scene/procedural.h"
#include "tests/unit/bench/temp_folder.h"

namespace farpoint {
namespace {

TEST(BenchScene, OwnScenesHaveACamera) {
  for (const char* name : {"cornell", "city", "furnace"}) {
    const auto scene = MakeBenchScene(name, true);
    ASSERT_TRUE(scene.ok()) << scene.status();
    EXPECT_FALSE(scene->scene.cameras.empty()) << name;
    EXPECT_FALSE(scene->scene.instances.empty()) << name;
    EXPECT_TRUE(scene->notes.empty()) << name;
  }
}

TEST(BenchScene, SmallCityIsSmaller) {
  const auto small = MakeBenchScene("city", true), large = MakeBenchScene("city", false);
  ASSERT_TRUE(small.ok() && large.ok());
  EXPECT_LT(small->scene.instances.size(), large->scene.instances.size());
}

TEST(BenchScene, FileWithoutLightAndCameraGetsBothAndSaysSo) {
  const TempFolder folder;
  Scene scene = MakeCornellBox();
  scene.cameras.clear();
  scene.lights.clear();
  for (Material& m : scene.materials) m.emission = Rgb();
  ASSERT_TRUE(WriteGltf(scene, folder / "dark.gltf").ok());
  const auto made = MakeBenchScene(folder / "dark.gltf", false);
  ASSERT_TRUE(made.ok()) << made.status();
  EXPECT_EQ(made->scene.cameras.size(), 1u);
  EXPECT_FALSE(made->scene.lights.empty());
  EXPECT_EQ(made->notes.size(), 2u);
}

TEST(BenchScene, MissingFileIsNamed) {
  const auto scene = MakeBenchScene("no-such-scene.gltf", false);
  EXPECT_EQ(scene.status().code(), absl::StatusCode::kNotFound);
  EXPECT_NE(std::string(scene.status().message()).find("no-such-scene.gltf"), std::string::npos);
}

}  // namespace
}  // namespace farpoint

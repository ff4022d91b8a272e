// Damaged and impossible input is refused, embedded and farmed alike, in a line that names the file
// and with the exit code that says whose fault it is.
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <filesystem>
#include <functional>
#include <nlohmann/json.hpp>

#include "tests/integration/farm.h"

namespace farpoint {
namespace {

using testing::AllOf;
using testing::HasSubstr;
using testing::StartsWith;
using Json = nlohmann::json;

class Refusal : public testing::Test {
 protected:
  static void SetUpTestSuite() {
    farm_ = new Farm;
    farm_->StartServer();
    farm_->StartWorker();
    std::filesystem::copy(SceneFile("cornell.gltf"), farm_->File("good.gltf"));
    for (const auto& entry : std::filesystem::directory_iterator(FARPOINT_SCENE_FOLDER)) {
      if (entry.path().extension() != ".bin") continue;
      std::filesystem::copy(entry.path(), farm_->folder());
    }
  }
  static void TearDownTestSuite() { delete farm_; }

  static Json GoodScene() { return Json::parse(farm_->Read("good.gltf")); }

  // Both ways of rendering refuse `scene` with exit code 42 and a first line that holds `words`.
  static void ExpectRefused(const std::string& scene, const std::vector<std::string>& words) {
    for (const bool farmed : {false, true}) {
      std::vector<std::string> args = {farmed ? "submit" : "render",
                                       scene,
                                       "-o",
                                       farm_->File("refused.exr"),
                                       "--resolution",
                                       "32x32",
                                       "--points",
                                       "200",
                                       "--quiet"};
      if (farmed) args = farm_->WithCoordinator(args);
      const RunResult result = farm_->Client(args);
      SCOPED_TRACE(args[0] + " says: " + result.err);
      EXPECT_EQ(result.exit_code, 42);
      const std::string line = result.err.substr(0, result.err.find('\n'));
      EXPECT_THAT(line, StartsWith("farpoint: error: "));
      for (const std::string& word : words) EXPECT_THAT(line, HasSubstr(word));
      EXPECT_FALSE(std::filesystem::exists(farm_->File("refused.exr")));
    }
  }

  static Farm* farm_;
};
Farm* Refusal::farm_ = nullptr;

TEST_F(Refusal, TheUndamagedSceneIsFine) {
  const RunResult result =
      farm_->Client({"render", farm_->File("good.gltf"), "-o", farm_->File("good.exr"),
                     "--resolution", "32x32", "--points", "200", "--quiet"});
  EXPECT_EQ(result.exit_code, 0) << result.err;
  EXPECT_EQ(result.err, "");
}

TEST_F(Refusal, OfAMissingScene) { ExpectRefused(farm_->File("none.gltf"), {"none.gltf"}); }

TEST_F(Refusal, OfASceneThatIsCutOff) {
  const std::string text = farm_->Read("good.gltf");
  for (const size_t size : {size_t{0}, size_t{1}, text.size() / 3, text.size() - 2}) {
    ExpectRefused(farm_->Write("cut.gltf", text.substr(0, size)), {"cut.gltf"});
  }
}

TEST_F(Refusal, OfAFileThatIsNoGlb) {
  ExpectRefused(farm_->Write("noise.glb", std::string(1000, '\x5a')), {"noise.glb"});
  ExpectRefused(farm_->Write("short.glb", "glTF"), {"short.glb"});
}

TEST_F(Refusal, OfABufferThatIsMissingOrShort) {
  Json scene = GoodScene();
  ASSERT_FALSE(scene["buffers"].empty());
  scene["buffers"][0]["uri"] = "gone.bin";
  ExpectRefused(farm_->Write("gone.gltf", scene.dump()), {"gone.gltf", "gone.bin"});
  farm_->Write("half.bin", "too short");
  scene["buffers"][0]["uri"] = "half.bin";
  ExpectRefused(farm_->Write("half.gltf", scene.dump()), {"half.gltf", "buffers"});
}

TEST_F(Refusal, OfIndicesThatPointNowhere) {
  const std::vector<std::pair<const char*, std::function<void(Json&)>>> damages = {
      {"mesh", [](Json& s) { s["nodes"][0]["mesh"] = 9999; }},
      {"accessor",
       [](Json& s) { s["meshes"][0]["primitives"][0]["attributes"]["POSITION"] = 9999; }},
      {"bufferView", [](Json& s) { s["accessors"][0]["bufferView"] = 9999; }},
      {"accessor count", [](Json& s) { s["accessors"][0]["count"] = 1000000000; }},
      {"view length", [](Json& s) { s["bufferViews"][0]["byteLength"] = 1000000000; }},
      {"negative", [](Json& s) { s["accessors"][0]["count"] = -1; }},
  };
  for (const auto& [name, damage] : damages) {
    SCOPED_TRACE(name);
    Json scene = GoodScene();
    damage(scene);
    ExpectRefused(farm_->Write("bad.gltf", scene.dump()), {"bad.gltf"});
  }
}

TEST_F(Refusal, OfAJobFileNamesItsPlaceAndTheNearestKey) {
  ExpectRefused(farm_->Write("cut.json", R"({"asset": {"root": "good.gltf")"), {"cut.json"});
  ExpectRefused(
      farm_->Write("typo.json", R"({"asset": {"root": "good.gltf"}, "settings": {"cluster": 4}})"),
      {"typo.json", "cluster", "clusters"});
  ExpectRefused(farm_->Write("range.json",
                             R"({"asset": {"root": "good.gltf"}, "settings": {"spp": 100000}})"),
                {"range.json", "spp"});
  ExpectRefused(farm_->Write("gone.json", R"({"asset": {"root": "gone_scene.gltf"}})"),
                {"gone_scene.gltf"});
}

TEST_F(Refusal, OfACameraThatTheSceneDoesNotHave) {
  for (const bool farmed : {false, true}) {
    std::vector<std::string> args = {farmed ? "submit" : "render",
                                     farm_->File("good.gltf"),
                                     "-o",
                                     farm_->File("refused.exr"),
                                     "--camera",
                                     "nobody",
                                     "--resolution",
                                     "32x32",
                                     "--points",
                                     "200"};
    if (farmed) args = farm_->WithCoordinator(args);
    const RunResult result = farm_->Client(args);
    EXPECT_EQ(result.exit_code, 42);
    EXPECT_THAT(result.err, HasSubstr("'nobody'"));
  }
}

TEST_F(Refusal, OfAnOutputThatCannotBeWrittenComesBeforeTheWork) {
  const RunResult result =
      farm_->Client({"render", farm_->File("good.gltf"), "-o", farm_->File("no/such/a.exr")});
  EXPECT_EQ(result.exit_code, 42);
  EXPECT_THAT(result.err, AllOf(StartsWith("farpoint: error: -o "), HasSubstr("no/such")));
}

TEST_F(Refusal, OfWrongUsageIsExitCode2) {
  const std::string good = farm_->File("good.gltf");
  for (const std::vector<std::string>& args : std::vector<std::vector<std::string>>{
           {},
           {"rendr"},
           {"render"},
           {"render", good},
           {"render", good, "-o", "a.exr", "--spp", "0"},
           {"render", good, "-o", "a.exr", "--fill", "x"},
           {"render", good, "-o", "a.exr", "--integrator", "radiosity"},
           {"render", good, "-o", "a.exr", "--clusters", "adapt"},
           {"render", good, "-o", "a.exr", "--bounces", "0"},
           {"render", good, "-o", "a.exr", "--eye", "0,0,0"},
           {"render", "scene.fbx", "-o", "a.exr"},
           {"submit", good, "-o", "a.exr"},
           {"status", "--coordinator", "nonsense"}}) {
    const RunResult result = farm_->Client(args);
    SCOPED_TRACE(testing::PrintToString(args) + result.err);
    EXPECT_EQ(result.exit_code, 2);
    EXPECT_THAT(result.err, StartsWith("farpoint: error: "));
    EXPECT_EQ(result.out, "");
  }
}

TEST_F(Refusal, HelpAndVersionAreNone) {
  for (const std::vector<std::string>& args :
       {std::vector<std::string>{"--help"}, {"--version"}, {"render", "--help"}}) {
    const RunResult result = farm_->Client(args);
    EXPECT_EQ(result.exit_code, 0);
    EXPECT_THAT(result.out, StartsWith("farpoint"));
    EXPECT_EQ(result.err, "");
  }
}

}  // namespace
}  // namespace farpoint

#include "client/job_request.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "tests/unit/client/temp_folder.h"

namespace farpoint {
namespace {

using testing::AllOf;
using testing::HasSubstr;
using testing::StartsWith;

constexpr char kGltf[] = R"({"asset": {"version": "2.0"},
  "buffers": [{"uri": "data/mesh.bin", "byteLength": 4}]})";

class PrepareRequestTest : public testing::Test {
 protected:
  void SetUp() override {
    folder_.Write("scenes/a.gltf", kGltf);
    folder_.Write("scenes/data/mesh.bin", "1234");
  }
  absl::StatusOr<PreparedRequest> Prepare(const std::string& scene,
                                          std::vector<GivenFlag> flags = {}) {
    return PrepareRequest(scene, flags, usage_error_);
  }
  std::string Job(const std::string& text) { return folder_.Write("jobs/job.json", text); }
  // The message of a file that is to blame.
  std::string FileError(const std::string& scene) {
    const auto request = Prepare(scene);
    EXPECT_FALSE(request.ok());
    EXPECT_FALSE(usage_error_);
    return std::string(request.status().message());
  }

  TempFolder folder_;
  bool usage_error_ = true;
};

TEST_F(PrepareRequestTest, CollectsTheScenesFiles) {
  const auto request = Prepare(folder_.File("scenes/a.gltf"), {{"--spp", "2"}});
  ASSERT_TRUE(request.ok()) << request.status();
  EXPECT_EQ(request->spec.settings.spp, 2u);
  EXPECT_EQ(request->spec.asset_root, request->asset.root);
  ASSERT_EQ(request->spec.asset_files.size(), 2u);
  for (const auto& [uri, digest] : request->spec.asset_files) {
    EXPECT_EQ(request->asset.files.at(uri).Hash(), digest) << uri;
  }
  EXPECT_EQ(request->spec.asset_files.count("data/mesh.bin"), 1u);
}

TEST_F(PrepareRequestTest, AJobFileNamesItsAssetFromItsOwnFolder) {
  const auto request =
      Prepare(Job(R"({"asset": {"root": "../scenes/a.gltf"}, "settings": {"spp": 3, "clusters": 9},
              "film": {"width_px": 64, "height_px": 48}, "title": "t"})"),
              {{"--spp", "5"}});
  ASSERT_TRUE(request.ok()) << request.status();
  EXPECT_EQ(request->spec.settings.spp, 5u) << "the flag overrides the file";
  EXPECT_EQ(request->spec.settings.clusters, 9u);
  EXPECT_EQ(request->spec.film.width, 64);
  EXPECT_EQ(request->spec.asset_files.size(), 2u);
}

TEST_F(PrepareRequestTest, AnUnknownKeyOfAJobFileIsNamedWithTheNearestOne) {
  const std::string path =
      Job(R"({"asset": {"root": "../scenes/a.gltf"}, "settings": {"light_sampels": 3}})");
  EXPECT_THAT(FileError(path),
              AllOf(HasSubstr(path), HasSubstr("light_sampels"), HasSubstr("light_samples")));
}

TEST_F(PrepareRequestTest, DamagedJobFilesAreTheFilesFault) {
  for (const char* text :
       {"", "{", "[]", "{\"asset\": 3}", "{\"settings\": {\"spp\": \"many\"}}"}) {
    const std::string path = Job(text);
    EXPECT_THAT(FileError(path), HasSubstr(path)) << text;
  }
  EXPECT_THAT(FileError(Job("{}")), HasSubstr("asset.root"));
  EXPECT_THAT(FileError(Job(R"({"asset": {"root": "../scenes/a.gltf"}, "settings": {"spp": 0}})")),
              AllOf(StartsWith(folder_.File("jobs/job.json")), HasSubstr("spp")));
  EXPECT_THAT(FileError(Job(R"({"asset": {"root": "job.json"}})")), HasSubstr("job file"));
  EXPECT_THAT(FileError(Job(R"({"asset": {"root": "a.obj"}})")), HasSubstr("not built yet"));
  EXPECT_THAT(FileError(Job(R"({"asset": {"root": "../scenes/a.gltf", "files": [{"uri": "x"}]}})")),
              HasSubstr("asset.files"));
}

TEST_F(PrepareRequestTest, MissingFilesAreNamed) {
  EXPECT_THAT(FileError(folder_.File("none.gltf")), HasSubstr("none.gltf"));
  EXPECT_THAT(FileError(folder_.File("none.json")), HasSubstr("none.json"));
  folder_.Write("scenes/b.gltf",
                R"({"asset": {"version": "2.0"}, "buffers": [{"uri": "gone.bin"}]})");
  EXPECT_THAT(FileError(folder_.File("scenes/b.gltf")), HasSubstr("gone.bin"));
}

TEST_F(PrepareRequestTest, BadFlagsAreTheCommandLinesFault) {
  EXPECT_FALSE(Prepare(folder_.File("scenes/a.gltf"), {{"--spp", "0"}}).ok());
  EXPECT_TRUE(usage_error_);
  EXPECT_FALSE(Prepare("scene.obj").ok());
  EXPECT_TRUE(usage_error_);
}

JobSpec SomeSpec() {
  JobSpec spec;
  spec.asset_root = "a.gltf";
  spec.asset_files["a.gltf"] = HashBytes({});
  spec.film = {64, 64, {0, 0, 64, 64}};
  return spec;
}

TEST(JobHash, IsDeafToWhatChangesNoPixel) {
  const JobSpec spec = SomeSpec();
  JobSpec other = spec;
  other.settings.tile_px = 32;
  other.settings.no_skip = true;
  other.title = "another title";
  other.priority = 5;
  other.limits.max_seconds = 3;
  EXPECT_EQ(JobHash(spec), JobHash(other));
  EXPECT_EQ(ImageSettingsJson(spec), ImageSettingsJson(other));
}

TEST(JobHash, HearsWhatChangesThePixels) {
  const JobSpec spec = SomeSpec();
  std::vector<JobSpec> others(6, spec);
  others[0].settings.seed = 1;
  others[1].film.crop.x1 = 32;
  others[2].camera = CameraName{"front"};
  others[3].overrides.sky = Rgb(1, 1, 1);
  others[4].asset_files["a.gltf"] = Sha256().Update("x").Finish();
  others[5].light_units = LightUnits::kRaw;
  for (const JobSpec& other : others) {
    EXPECT_NE(JobHash(spec), JobHash(other));
    EXPECT_NE(ImageSettingsJson(spec), ImageSettingsJson(other));
  }
}

}  // namespace
}  // namespace farpoint

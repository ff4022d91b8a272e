#include "client/job_request.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <sys/stat.h>

#include <filesystem>

#include "core/image/exr_io.h"
#include "tests/unit/client/temp_folder.h"

namespace farpoint {
namespace {

using testing::AllOf;
using testing::ElementsAre;
using testing::HasSubstr;
using testing::IsEmpty;
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
  EXPECT_THAT(FileError(Job(R"({"asset": {"root": "job.json"}})")),
              AllOf(HasSubstr("job file"), HasSubstr(".ply")));
  EXPECT_THAT(FileError(Job(R"({"asset": {"root": "a.xyz"}})")),
              AllOf(HasSubstr("asset.root"), HasSubstr(".gltf")));
  EXPECT_THAT(FileError(Job(R"({"asset": {"root": "../scenes/a.gltf", "files": [{"uri": "x"}]}})")),
              HasSubstr("asset.files"));
}

// A lat-long map of one colour.
std::string WriteMap(const std::string& path) {
  Film film({0, 0, 8, 4}, {Layer::kIrradiance});
  EXPECT_TRUE(WriteExr(path, film, 8, 4, {}, ExrCompression::kZip).ok());
  return path;
}
std::string WriteEnvironment(const std::string& path) {
  Film film({0, 0, 8, 4}, {Layer::kBeauty});
  for (float& value : film.Plane(Layer::kBeauty, 0)) value = 2;
  EXPECT_TRUE(WriteExr(path, film, 8, 4, {}, ExrCompression::kZip).ok());
  return path;
}

TEST_F(PrepareRequestTest, AnEnvironmentMapBecomesAFileOfTheAsset) {
  std::filesystem::create_directories(folder_.File("maps"));
  const std::string path = WriteEnvironment(folder_.File("maps/day.exr"));
  const auto request = Prepare(
      folder_.File("scenes/a.gltf"),
      {{"--env", path}, {"--env-rotation", "90"}, {"--env-scale", "2"}, {"--env-up", "0,0,1"}});
  ASSERT_TRUE(request.ok()) << request.status();
  const auto& environment = request->spec.overrides.environment;
  ASSERT_TRUE(environment.has_value());
  EXPECT_EQ(environment->uri, "env/day.exr");
  EXPECT_EQ(environment->rotation_deg, 90);
  EXPECT_EQ(environment->scale, Rgb(2, 2, 2));
  EXPECT_EQ(environment->up.z, 1);
  EXPECT_EQ(request->asset.files.at("env/day.exr").Hash(),
            request->spec.asset_files.at("env/day.exr"));
}

TEST_F(PrepareRequestTest, AJobFileNamesItsMapFromItsOwnFolder) {
  std::filesystem::create_directories(folder_.File("maps"));
  WriteEnvironment(folder_.File("maps/day.exr"));
  const std::string night = WriteEnvironment(folder_.File("maps/night.exr"));
  const std::string job = Job(R"({"asset": {"root": "../scenes/a.gltf"}, "overrides":
      {"environment": {"uri": "../maps/day.exr", "rotation_deg": 30}}})");
  auto request = Prepare(job);
  ASSERT_TRUE(request.ok()) << request.status();
  EXPECT_EQ(request->spec.overrides.environment->uri, "env/day.exr");
  EXPECT_EQ(request->spec.overrides.environment->rotation_deg, 30);
  request = Prepare(job, {{"--env", night}, {"--env-scale", "1,0.5,0"}});
  ASSERT_TRUE(request.ok()) << request.status();
  EXPECT_EQ(request->spec.overrides.environment->uri, "env/night.exr");
  EXPECT_EQ(request->spec.overrides.environment->rotation_deg, 30) << "what no flag names stays";
  EXPECT_EQ(request->spec.overrides.environment->scale, Rgb(1, 0.5f, 0));
  EXPECT_FALSE(request->asset.files.contains("env/day.exr"));
}

TEST_F(PrepareRequestTest, AMapThatCannotBeReadIsNamedBeforeAnythingIsSent) {
  const auto error = [&](const std::string& path) {
    const auto request = Prepare(folder_.File("scenes/a.gltf"), {{"--env", path}});
    EXPECT_FALSE(request.ok());
    EXPECT_FALSE(usage_error_);
    return std::string(request.status().message());
  };
  EXPECT_THAT(error(folder_.File("none.exr")), HasSubstr("none.exr"));
  EXPECT_THAT(error(folder_.Write("text.exr", "no image")), HasSubstr("text.exr"));
  EXPECT_THAT(error(WriteMap(folder_.File("layers.exr"))), HasSubstr("layers.exr"));
  EXPECT_FALSE(Prepare(folder_.File("scenes/a.gltf"), {{"--env-rotation", "3"}}).ok());
  EXPECT_TRUE(usage_error_);
}

TEST_F(PrepareRequestTest, AJobFileMayStartWithAByteOrderMark) {
  const auto request =
      Prepare(Job("\xEF\xBB\xBF"
                  R"({"asset": {"root": "../scenes/a.gltf"}})"));
  EXPECT_TRUE(request.ok()) << request.status();
}

TEST_F(PrepareRequestTest, WhatIsNoRegularFileIsRefusedWithoutWaiting) {
  for (const char* name : {"fifo.obj", "fifo.json"}) {
    ASSERT_EQ(mkfifo(folder_.File(name).c_str(), 0600), 0);
    EXPECT_THAT(FileError(folder_.File(name)), HasSubstr("is not a regular file"));
  }
  std::filesystem::create_directory(folder_.File("folder.obj"));
  EXPECT_THAT(FileError(folder_.File("folder.obj")), HasSubstr("is not a regular file"));
}

TEST_F(PrepareRequestTest, NotesWhatHasNoEffect) {
  const std::string still = folder_.Write("scenes/still.gltf", R"({"asset": {"version": "2.0"}})");
  EXPECT_THAT(Prepare(still)->notes, IsEmpty());
  EXPECT_THAT(Prepare(still, {{"--fps", "25"}})->notes, ElementsAre(HasSubstr("--fps")));
  EXPECT_THAT(Prepare(still, {{"--fps", "25"}, {"--frames", "1-2"}})->notes,
              ElementsAre(HasSubstr("no animation")));
}

TEST_F(PrepareRequestTest, WarnsOfFlagsThatCannotMatterInTheModeOfAllFlags) {
  const std::string still = folder_.Write("scenes/still.gltf", R"({"asset": {"version": "2.0"}})");
  EXPECT_THAT(Prepare(still, {{"--cache-error", "0.1"}})->warnings,
              ElementsAre(HasSubstr("--cache-error")));
  EXPECT_THAT(Prepare(still, {{"--cache-error", "0.1"}, {"--integrator", "irrcache"}})->warnings,
              IsEmpty());
  // A job file's settings count as the mode; its own are not warned of.
  const std::string job = Job(
      R"({"asset": {"root": "../scenes/a.gltf"}, "settings": {"integrator": "INTEGRATOR_PT", "points": 99}})");
  EXPECT_THAT(Prepare(job)->warnings, IsEmpty());
  EXPECT_THAT(Prepare(job, {{"--points", "99"}})->warnings,
              ElementsAre(HasSubstr("--integrator pt")));
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
  EXPECT_FALSE(Prepare("scene.xyz").ok());
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
  other.after = {JobId{"a1"}};
  other.start_paused = true;
  other.fps = 30;  // of a still
  EXPECT_EQ(JobHash(spec), JobHash(other));
  EXPECT_EQ(ImageSettingsJson(spec), ImageSettingsJson(other));
}

// Cuts leave out nodes below the horizon, which changes them a little.
TEST(JobHash, HearsOfSkippingWhereCutsAreMade) {
  for (const int way : {0, 1, 2, 3}) {
    JobSpec spec = SomeSpec();
    if (way == 1) spec.settings.integrator = Integrator::kPbgi;
    if (way == 2) spec.settings.fill = Fill::kCut;
    if (way == 3) spec.settings.integrator = Integrator::kPt;
    JobSpec other = spec;
    other.settings.no_skip = true;
    const bool cuts = way == 1 || way == 2;
    EXPECT_EQ(JobHash(spec) != JobHash(other), cuts) << way;
    EXPECT_EQ(ImageSettingsJson(spec) != ImageSettingsJson(other), cuts) << way;
  }
}

TEST(JobHash, HearsWhatChangesThePixels) {
  const JobSpec spec = SomeSpec();
  std::vector<JobSpec> others(8, spec);
  others[0].settings.seed = 1;
  others[1].film.crop.x1 = 32;
  others[2].camera = CameraName{"front"};
  others[3].overrides.sky = Rgb(1, 1, 1);
  others[4].asset_files["a.gltf"] = Sha256().Update("x").Finish();
  others[5].light_units = LightUnits::kRaw;
  others[6].frames = {0};
  others[7].settings.filter = PixelFilter::kBox;
  for (const JobSpec& other : others) {
    EXPECT_NE(JobHash(spec), JobHash(other));
    EXPECT_NE(ImageSettingsJson(spec), ImageSettingsJson(other));
  }
}

TEST(JobHash, OfAFrameKnowsItsTimeAndNotItsNeighbours) {
  JobSpec spec = SomeSpec(), other = spec;
  spec.frames = {1, 2, 3};
  other.frames = {3, 9};
  EXPECT_EQ(JobHash(SpecOfFrame(spec, 2)), JobHash(SpecOfFrame(other, 0)));
  EXPECT_NE(JobHash(SpecOfFrame(spec, 1)), JobHash(SpecOfFrame(spec, 2)));
  other.fps = 25;
  EXPECT_NE(JobHash(SpecOfFrame(spec, 2)), JobHash(SpecOfFrame(other, 0)));
  const JobSpec still = SomeSpec();
  EXPECT_EQ(JobHash(SpecOfFrame(still, 0)), JobHash(still));
}

}  // namespace
}  // namespace farpoint

#include "client/reports.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <nlohmann/json.hpp>

#include "client/job_request.h"
#include "tests/unit/client/sample_job.h"

namespace farpoint {
namespace {

using Json = nlohmann::json;
using testing::ElementsAre;
using testing::UnorderedElementsAre;

std::vector<std::string> Keys(const Json& json) {
  std::vector<std::string> keys;
  for (const auto& [key, value] : json.items()) keys.push_back(key);
  return keys;
}

Digest SomeDigest(const char* text) { return Sha256().Update(text).Finish(); }

TEST(StatisticsJson, HasExactlyItsKeysEvenOfNothing) {
  const Json json = Json::parse(StatisticsJson({}, {}, false, 0));
  EXPECT_THAT(Keys(json), UnorderedElementsAre("seconds", "wall_seconds", "counts", "skipped",
                                               "bytes", "hash"));
  EXPECT_THAT(Keys(json["seconds"]),
              UnorderedElementsAre("import", "sample", "shade", "tree", "broadcast", "primary",
                                   "direct", "cluster", "cut", "raster", "composite", "convolve",
                                   "trace", "total", "wall"));
  EXPECT_THAT(
      Keys(json["wall_seconds"]),
      UnorderedElementsAre("import", "sample", "shade", "tree", "broadcast", "primary", "direct",
                           "cluster", "cut", "raster", "composite", "convolve", "trace"));
  EXPECT_THAT(Keys(json["counts"]),
              UnorderedElementsAre("triangles", "surfels", "nodes", "receivers", "blocks",
                                   "clusters", "cut_nodes", "rays"));
  EXPECT_THAT(Keys(json["bytes"]), UnorderedElementsAre("tree", "scene", "peak_rss"));
  EXPECT_THAT(Keys(json["hash"]), UnorderedElementsAre("scene", "tree", "image"));
  for (const auto& [key, value] : json["seconds"].items()) EXPECT_EQ(value, 0) << key;
  EXPECT_TRUE(json["skipped"].is_object());
}

TEST(StatisticsJson, CarriesTheNumbers) {
  Stats stats;
  stats.seconds[static_cast<int>(Stage::kCut)] = 1.5;
  stats.seconds[static_cast<int>(Stage::kTree)] = 0.25;
  stats.wall_seconds[static_cast<int>(Stage::kCut)] = 0.75;
  stats.counts["surfels"] = 12345678901;
  stats.skipped["black_receivers"] = 7;
  stats.bytes["tree"] = 99;
  const SceneBlobs blobs{SomeDigest("scene"), SomeDigest("topology"), SomeDigest("radiance")};
  const FrameReport still{.file = "o.exr", .blobs = blobs, .image_hash = SomeDigest("image")};
  const Json json = Json::parse(StatisticsJson(stats, std::vector{still}, false, 3.5));
  EXPECT_EQ(json["seconds"]["cut"], 1.5);
  EXPECT_EQ(json["seconds"]["total"], 1.75);
  EXPECT_EQ(json["seconds"]["wall"], 3.5);
  EXPECT_EQ(json["wall_seconds"]["cut"], 0.75);
  EXPECT_EQ(json["counts"]["surfels"], 12345678901);
  EXPECT_EQ(json["skipped"]["black_receivers"], 7);
  EXPECT_EQ(json["bytes"]["tree"], 99);
  EXPECT_EQ(json["hash"]["scene"], SomeDigest("scene").Hex());
  EXPECT_EQ(json["hash"]["tree"], TreeHash(blobs).Hex());
  EXPECT_EQ(json["hash"]["image"], SomeDigest("image").Hex());
}

TEST(TreeHash, CountsTopologyAndRadianceAndKnowsNone) {
  const SceneBlobs blobs{SomeDigest("s"), SomeDigest("t"), SomeDigest("r")};
  SceneBlobs relit = blobs, regrown = blobs, moved = blobs;
  relit.tree_radiance = SomeDigest("r2");
  regrown.tree_topology = SomeDigest("t2");
  moved.prepared_scene = SomeDigest("s2");
  EXPECT_NE(TreeHash(blobs), TreeHash(relit));
  EXPECT_NE(TreeHash(blobs), TreeHash(regrown));
  EXPECT_EQ(TreeHash(blobs), TreeHash(moved));
  EXPECT_TRUE(TreeHash({SomeDigest("s"), {}, {}}).empty());
  const FrameReport bare{.blobs = {SomeDigest("s"), {}, {}}};
  EXPECT_EQ(Json::parse(StatisticsJson({}, std::vector{bare}, false, 0))["hash"]["tree"], "");
}

TEST(JobStatusJson, HasWhatOthersRely) {
  JobStatus status = MakeSampleJob({64, 64, {0, 0, 64, 64}}).info.status;
  status.reissued = 2;
  status.refused_results = 3;
  status.eta_s = 1.5;
  Json json = Json::parse(JobStatusJson(status));
  EXPECT_EQ(json["id"], "0badcafe");
  EXPECT_EQ(json["state"], "done");
  EXPECT_EQ(json["tiles"],
            Json({{"queued", 0}, {"leased", 0}, {"committed", 4}, {"failed", 0}, {"total", 4}}));
  EXPECT_EQ(json["reissued"], 2);
  EXPECT_EQ(json["refused_results"], 3);
  EXPECT_EQ(json["eta_s"], 1.5);
  EXPECT_TRUE(json["error"].is_null());
  EXPECT_EQ(json["frames"], Json({{"total", 1}, {"baked", 1}, {"done", 1}}));
  EXPECT_EQ(json["after"], Json::array());
  status.after = {JobId{"a1"}, JobId{"b2"}};
  EXPECT_EQ(Json::parse(JobStatusJson(status))["after"], Json({"a1", "b2"}));
  EXPECT_EQ(Json::parse(JobsJson(std::vector{status, status})).size(), 2u);
  status.eta_s.reset();
  status.state = JobState::kFailed;
  status.error = absl::InvalidArgumentError("no light \xff");  // not UTF-8
  json = Json::parse(JobStatusJson(status));
  EXPECT_TRUE(json["eta_s"].is_null());
  EXPECT_EQ(json["state"], "failed");
  EXPECT_EQ(json["error"].get<std::string>().substr(0, 8), "no light");
}

TEST(FarmStatusJson, ListsJobsAndWorkers) {
  FarmStatus status;
  EXPECT_EQ(Json::parse(FarmStatusJson(status)),
            Json({{"jobs", Json::array()}, {"workers", Json::array()}}));
  status.jobs.resize(2);
  status.workers.resize(1);
  status.workers[0].name = "node7";
  status.workers[0].committed = 5;
  const Json json = Json::parse(FarmStatusJson(status));
  EXPECT_EQ(json["jobs"].size(), 2u);
  EXPECT_EQ(json["workers"][0]["name"], "node7");
  EXPECT_EQ(json["workers"][0]["committed"], 5);
}

TEST(FarmStatusText, HasALinePerJobAndWorker) {
  FarmStatus status;
  status.jobs.push_back(MakeSampleJob({64, 64, {0, 0, 64, 64}}).info.status);
  status.jobs[0].title = std::string(600, 't');  // longer than any buffer
  status.workers.resize(1);
  status.workers[0].name = "node7";
  const std::string text = FarmStatusText(status);
  EXPECT_NE(text.find("0badcafe  done       0      4/4          -"), std::string::npos) << text;
  EXPECT_NE(text.find(status.jobs[0].title), std::string::npos);
  EXPECT_NE(text.find("node7"), std::string::npos) << text;
  EXPECT_NE(WorkersText(status.workers).find("node7"), std::string::npos);
  EXPECT_EQ(Json::parse(WorkersJson(status.workers))["workers"][0]["name"], "node7");
  EXPECT_EQ(WorkersText(status.workers).find("gone"), std::string::npos);
  status.workers[0].gone = true;
  EXPECT_NE(WorkersText(status.workers).find("node7 (gone)"), std::string::npos);
  EXPECT_EQ(Json::parse(WorkersJson(status.workers))["workers"][0]["gone"], true);
  EXPECT_NE(WorkersText({}).find("no worker is registered"), std::string::npos);

  status.jobs[0] = MakeSampleJob({64, 64, {0, 0, 64, 64}}, {1, 2, 3}).info.status;
  status.jobs[0].state = JobState::kPaused;
  status.jobs[0].priority = -5;
  status.jobs[0].after = {JobId{"a1"}};
  const std::string sequence = FarmStatusText(status);
  EXPECT_NE(sequence.find("paused     -5     12/12        3/3"), std::string::npos) << sequence;
  EXPECT_NE(sequence.find("after a1"), std::string::npos) << sequence;
}

TEST(ExplanationJson, HasTheLines) {
  const Json json = Json::parse(ExplanationJson(JobId{"a1"}, {{"waits for b2", "no workers"}}));
  EXPECT_EQ(json, Json({{"id", "a1"}, {"lines", {"waits for b2", "no workers"}}}));
}

JobEvent EventWith(JobEventBody body) {
  JobEvent event;
  event.sequence = 4;
  event.body = std::move(body);
  event.unix_ms = 1'700'000'000'123;
  return event;
}

TEST(Log, IsOneLineWithTimeLevelAndPlace) {
  LogLine line{LogLevel::kWarning, "the lease was lost:\nno news", 17, 2, "node7"};
  EXPECT_EQ(LogText(EventWith(line)),
            "2023-11-14T22:13:20.123Z  warning  tile 17, attempt 2, worker node7: the lease was "
            "lost: no news");
  EXPECT_EQ(LogText(EventWith(std::string("no camera"))),
            "2023-11-14T22:13:20.123Z  info     no camera");
  EXPECT_EQ(LogText(EventWith(TileCommitted{3, {}})),
            "2023-11-14T22:13:20.123Z  info     tile 3: committed");
  JobEvent failed = EventWith(JobState::kFailed);
  failed.status.error = absl::InvalidArgumentError("no such mesh");
  EXPECT_EQ(LogText(failed), "2023-11-14T22:13:20.123Z  error    the job is failed: no such mesh");
  failed.unix_ms = 0;
  EXPECT_EQ(LogText(failed).substr(0, 3), "-  ");
  EXPECT_EQ(LogText(EventWith(std::monostate())), "");
  EXPECT_EQ(LogJson(EventWith(std::monostate())), "");
}

TEST(Log, IsOneObjectPerLine) {
  const LogLine line{LogLevel::kError, "bad \xff\n", 17, 2, "node7"};
  const std::string text = LogJson(EventWith(line));
  EXPECT_EQ(text.find('\n'), std::string::npos);
  const Json json = Json::parse(text);
  EXPECT_EQ(json["time"], "2023-11-14T22:13:20.123Z");
  EXPECT_EQ(json["sequence"], 4);
  EXPECT_EQ(json["level"], "error");
  EXPECT_EQ(json["tile"], 17);
  EXPECT_EQ(json["attempt"], 2);
  EXPECT_EQ(json["worker"], "node7");
  const Json state = Json::parse(LogJson(EventWith(JobState::kPaused)));
  EXPECT_EQ(state["state"], "paused");
  EXPECT_FALSE(state.contains("tile"));
}

TEST(StatisticsJson, OfASequenceListsItsFrames) {
  std::vector<FrameReport> frames(2);
  frames[0] = {9, "o.9.exr", {SomeDigest("s9"), SomeDigest("t"), SomeDigest("r")}, SomeDigest("i9"),
               0, 1.5};
  frames[1] = {3, "o.3.exr", {SomeDigest("s3"), SomeDigest("t"), SomeDigest("r")}, SomeDigest("i3"),
               2, 2.5};
  const Json json = Json::parse(StatisticsJson({}, frames, true, 3));
  ASSERT_EQ(json["frames"].size(), 2u);
  EXPECT_EQ(json["frames"][0]["frame"], 9);
  EXPECT_EQ(json["frames"][0]["file"], "o.9.exr");
  EXPECT_EQ(json["frames"][0]["hash"]["image"], SomeDigest("i9").Hex());
  EXPECT_EQ(json["frames"][0]["written_s"], 1.5);
  EXPECT_EQ(json["frames"][1]["missing_tiles"], 2);
  std::swap(frames[0], frames[1]);
  EXPECT_EQ(Json::parse(StatisticsJson({}, frames, true, 3))["hash"], json["hash"])
      << "the order of writing is no property of the sequence";
  frames[0].image_hash = SomeDigest("other");
  const Json changed = Json::parse(StatisticsJson({}, frames, true, 3));
  EXPECT_NE(changed["hash"]["image"], json["hash"]["image"]);
  EXPECT_EQ(changed["hash"]["scene"], json["hash"]["scene"]);
}

TEST(ComparisonJson, HasItsMeasuresAndNullForWhatDoesNotExist) {
  CompareResult result;
  result.mse = 0.25;
  result.rel_rmse = 0.5;
  result.rr = 0.4;
  result.bias = -0.1;
  result.max_abs = 3;
  result.pdp = 17;
  result.flip = 0.02;
  result.hash_equal = true;
  Json json = Json::parse(ComparisonJson(result));
  EXPECT_EQ(json["mse"], 0.25);
  EXPECT_EQ(json["rel_rmse"], 0.5);
  EXPECT_EQ(json["rr"], 0.4);
  EXPECT_EQ(json["bias"], -0.1);
  EXPECT_EQ(json["max_abs"], 3);
  EXPECT_EQ(json["pdp"], 17);
  EXPECT_EQ(json["flip"], 0.02);
  EXPECT_EQ(json["hash_equal"], true);
  EXPECT_EQ(json["noise"], 0);
  EXPECT_EQ(json["noise_above_error"], false);
  EXPECT_FALSE(ComparisonWarning(result).has_value());
  result.noise = 0.75;
  result.noise_above_error = true;
  result.rr.reset();
  json = Json::parse(ComparisonJson(result));
  EXPECT_TRUE(json["rr"].is_null());
  EXPECT_EQ(json["noise"], 0.75);
  EXPECT_EQ(json["noise_above_error"], true);
  ASSERT_TRUE(ComparisonWarning(result).has_value());
  EXPECT_NE(ComparisonWarning(result)->find("--noise 0.75"), std::string::npos);
  EXPECT_NE(ComparisonWarning(result)->find("rel_rmse 0.5"), std::string::npos);
  EXPECT_NE(ComparisonText(result).find("hash       equal"), std::string::npos);
}

TEST(ImageMetadata, SaysWhereAnImageComesFrom) {
  const SampleJob job = MakeSampleJob({64, 32, {0, 0, 64, 32}});
  JobInfo info = job.info;
  info.frames[0].camera.world_to_camera[12] = 7;
  info.frames[0].camera.world_to_ndc[3] = 9;
  info.spec.title = "a title";
  const ExrMetadata metadata = ImageMetadata(info, 0, SomeDigest("image"), ExrCompression::kZip, 0);
  EXPECT_EQ(metadata.strings.at("farpoint:version"), FARPOINT_VERSION);
  EXPECT_EQ(metadata.strings.at("farpoint:jobHash"), JobHash(info.spec).Hex());
  EXPECT_EQ(metadata.strings.at("farpoint:imageHash"), SomeDigest("image").Hex());
  const Json settings = Json::parse(metadata.strings.at("farpoint:settings"));
  EXPECT_EQ(settings["film"]["width_px"], 64);
  EXPECT_EQ(metadata.matrices.at("worldToCamera")[12], 7);
  EXPECT_EQ(metadata.matrices.at("worldToNDC")[3], 9);
  EXPECT_EQ(metadata.strings.at("comments"), "a title");
  EXPECT_EQ(metadata.strings.at("software"), "farpoint " FARPOINT_VERSION);
  EXPECT_FALSE(metadata.frames_per_second.has_value());
  EXPECT_TRUE(metadata.ints.empty());
  EXPECT_FALSE(metadata.strings.contains("farpoint:lossy"));
}

TEST(ImageMetadata, OfAFrameHasItsNumberItsTimeAndItsCamera) {
  JobInfo info = MakeSampleJob({64, 32, {0, 0, 64, 32}}, {10, 12}).info;
  info.spec.fps = 25;
  const ExrMetadata metadata = ImageMetadata(info, 1, SomeDigest("image"), ExrCompression::kZip, 0);
  EXPECT_EQ(metadata.ints.at("farpoint:frame"), 12);
  EXPECT_EQ(metadata.ints.at("imageCounter"), 12);
  EXPECT_EQ(metadata.frames_per_second, 25);
  EXPECT_EQ(metadata.matrices.at("worldToCamera")[0], 2) << "of the second frame";
  EXPECT_EQ(metadata.strings.at("farpoint:jobHash"), JobHash(SpecOfFrame(info.spec, 1)).Hex());
  EXPECT_EQ(Json::parse(metadata.strings.at("farpoint:settings"))["frames"], Json({12}));
}

TEST(ImageMetadata, PromisesNoHashThatTheFileDoesNotHave) {
  const JobInfo info = MakeSampleJob({64, 32, {0, 0, 64, 32}}).info;
  const ExrMetadata lossy = ImageMetadata(info, 0, SomeDigest("image"), ExrCompression::kDwaa, 0);
  EXPECT_FALSE(lossy.strings.contains("farpoint:imageHash"));
  EXPECT_EQ(lossy.strings.at("farpoint:renderedHash"), SomeDigest("image").Hex());
  EXPECT_EQ(lossy.strings.at("farpoint:lossy"), "dwaa");
  const ExrMetadata partial = ImageMetadata(info, 0, SomeDigest("image"), ExrCompression::kZip, 3);
  EXPECT_EQ(partial.ints.at("farpoint:missingTiles"), 3);
}

TEST(PeakResidentBytes, IsPlausible) {
  EXPECT_GT(PeakResidentBytes(), uint64_t{1} << 20);
  EXPECT_LT(PeakResidentBytes(), uint64_t{1} << 40);
}

}  // namespace
}  // namespace farpoint

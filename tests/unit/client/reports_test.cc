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
  const Json json = Json::parse(StatisticsJson({}, {}, {}, 0));
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
  const Json json = Json::parse(StatisticsJson(stats, blobs, SomeDigest("image"), 3.5));
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
  EXPECT_EQ(Json::parse(StatisticsJson({}, {SomeDigest("s"), {}, {}}, {}, 0))["hash"]["tree"], "");
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
  EXPECT_NE(text.find("0badcafe  done       4/4"), std::string::npos) << text;
  EXPECT_NE(text.find("node7"), std::string::npos) << text;
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
  result.rr.reset();
  json = Json::parse(ComparisonJson(result));
  EXPECT_TRUE(json["rr"].is_null());
  EXPECT_NE(ComparisonText(result).find("hash       equal"), std::string::npos);
}

TEST(ImageMetadata, SaysWhereAnImageComesFrom) {
  const SampleJob job = MakeSampleJob({64, 32, {0, 0, 64, 32}});
  JobInfo info = job.info;
  info.camera.world_to_camera[12] = 7;
  info.camera.world_to_ndc[3] = 9;
  const ExrMetadata metadata = ImageMetadata(info, SomeDigest("image"));
  EXPECT_EQ(metadata.strings.at("farpoint:version"), FARPOINT_VERSION);
  EXPECT_EQ(metadata.strings.at("farpoint:jobHash"), JobHash(info.spec).Hex());
  EXPECT_EQ(metadata.strings.at("farpoint:imageHash"), SomeDigest("image").Hex());
  const Json settings = Json::parse(metadata.strings.at("farpoint:settings"));
  EXPECT_EQ(settings["film"]["width_px"], 64);
  EXPECT_EQ(metadata.matrices.at("worldToCamera")[12], 7);
  EXPECT_EQ(metadata.matrices.at("worldToNDC")[3], 9);
}

TEST(PeakResidentBytes, IsPlausible) {
  EXPECT_GT(PeakResidentBytes(), uint64_t{1} << 20);
  EXPECT_LT(PeakResidentBytes(), uint64_t{1} << 40);
}

}  // namespace
}  // namespace farpoint

#include "server/scene_baker.h"

#include <gtest/gtest.h>

#include "core/scene/procedural.h"
#include "tests/unit/server/temp_folder.h"

namespace farpoint {
namespace {

JobSpec SmallJob() {
  JobSpec job;
  job.asset_root = "a.gltf";
  job.asset_files["a.gltf"] = Sha256().Update("a").Finish();
  job.film = {.width = 64, .height = 32, .crop = {0, 0, 64, 32}};
  job.settings.points = 500;
  return job;
}

TEST(BakeKey, ChangesWithWhatABakeReads) {
  const Digest key = BakeKey(SmallJob());
  EXPECT_EQ(BakeKey(SmallJob()), key);
  const std::vector<std::function<void(JobSpec&)>> changes = {
      [](JobSpec& j) { j.asset_files["a.gltf"] = Sha256().Update("b").Finish(); },
      [](JobSpec& j) { j.asset_files["b.png"] = Sha256().Update("b").Finish(); },
      [](JobSpec& j) { j.settings.points = 501; },
      [](JobSpec& j) { j.settings.seed = 1; },
      [](JobSpec& j) { j.settings.light_samples = 3; },
      [](JobSpec& j) { j.settings.integrator = Integrator::kPt; },
      [](JobSpec& j) { j.light_units = LightUnits::kRaw; },
      [](JobSpec& j) { j.overrides.sky = Rgb(0, 0, 0); },
      [](JobSpec& j) { j.overrides.albedo = Rgb(0, 0, 0); },
      [](JobSpec& j) {
        j.overrides.suns = {{{0, 1, 0}, {1, 1, 1}}};
      },
      [](JobSpec& j) { j.overrides.lights.resize(1); },
      [](JobSpec& j) { j.overrides.environment = EnvironmentOverride{.uri = "a.exr"}; },
      [](JobSpec& j) { j.overrides.materials = {{.name = "m", .emission = Rgb(1, 1, 1)}}; },
  };
  for (size_t i = 0; i < changes.size(); ++i) {
    JobSpec job = SmallJob();
    changes[i](job);
    EXPECT_NE(BakeKey(job), key) << "change " << i;
  }
}

TEST(BakeKey, IsBlindToCameraFilmAndTiles) {
  JobSpec job = SmallJob();
  job.film = {.width = 99, .height = 99, .crop = {0, 0, 99, 99}};
  job.camera = CameraName{"x"};
  job.title = "t";
  job.priority = 4;
  job.limits.max_pixels = 1 << 20;
  job.settings.integrator = Integrator::kPbgi;
  job.settings.spp = 4;
  job.settings.cache_error = 0.4f;
  job.settings.ao_distance_m = 2.5f;
  job.settings.cache_samples = 333;
  job.settings.tile_px = 32;
  job.settings.layers = {Layer::kBeauty};
  job.settings.filter = PixelFilter::kBox;
  job.settings.filter_width_px = 3;
  job.frames = {1, 2};
  job.fps = 12;
  job.after = {{"00000001"}};
  job.start_paused = true;
  EXPECT_EQ(BakeKey(job), BakeKey(SmallJob()));
}

// What is read by rays needs fewer surfels than what is seen as discs, unless the user says how
// many.
TEST(BakeKey, TellsTheDefaultNumbersOfSurfelsApart) {
  JobSpec rays = SmallJob();
  ASSERT_TRUE(rays.settings.reads_surfels_by_rays());
  JobSpec discs = rays, cuts = rays, clusters = rays;
  discs.settings.integrator = Integrator::kPbgi;
  cuts.settings.fill = Fill::kCut;
  clusters.settings.clusters = 64;
  for (const uint64_t points : {uint64_t{0}, uint64_t{5000}}) {
    for (JobSpec* job : {&rays, &discs, &cuts, &clusters}) job->settings.points = points;
    EXPECT_EQ(BakeKey(discs), BakeKey(cuts));
    EXPECT_EQ(BakeKey(discs), BakeKey(clusters));
    EXPECT_EQ(BakeKey(discs) == BakeKey(rays), points != 0);
  }
}

TEST(BakeKey, OfAnAnimatedSceneChangesWithTime) {
  const JobSpec job = SmallJob();
  const Digest rest = BakeKeyAt(job, std::nullopt);
  EXPECT_NE(rest, BakeKey(job));
  EXPECT_NE(rest, BakeKeyAt(job, 0.0));
  EXPECT_NE(BakeKeyAt(job, 1.0), BakeKeyAt(job, 0.0));
  EXPECT_EQ(BakeKeyAt(job, 1.0), BakeKeyAt(job, 1.0));
}

TEST(CoreBaker, BakesAnAssetAndStopsWhenTold) {
  TempFolder folder;
  ASSERT_TRUE(WriteGltf(MakeCornellBox(), folder / "cornell.gltf").ok());
  const auto asset = CollectAsset(folder / "cornell.gltf");
  ASSERT_TRUE(asset.ok()) << asset.status();
  const auto baker = MakeCoreBaker(1);
  JobSpec spec = SmallJob();
  spec.settings.light_samples = 1;
  std::atomic<bool> cancel = false;
  const auto result = baker->Bake(*asset, spec, std::nullopt, cancel);
  ASSERT_TRUE(result.ok()) << result.status();
  EXPECT_GT(result->blobs.prepared_scene.size(), 0u);
  EXPECT_GT(result->blobs.tree_topology.size(), 0u);
  EXPECT_FALSE(result->cameras.empty());
  EXPECT_FALSE(result->made_up_camera);
  EXPECT_GT(result->stats.wall_seconds[static_cast<size_t>(Stage::kImport)], 0);
  cancel = true;
  EXPECT_TRUE(absl::IsCancelled(baker->Bake(*asset, spec, std::nullopt, cancel).status()));
}

TEST(CoreBaker, BakesAgainOnlyWhatChanged) {
  TempFolder folder;
  ASSERT_TRUE(WriteGltf(MakeCornellBox(), folder / "cornell.gltf").ok());
  const auto asset = CollectAsset(folder / "cornell.gltf");
  ASSERT_TRUE(asset.ok()) << asset.status();
  const auto warm = MakeCoreBaker(2), forgetful = MakeCoreBaker(1, 0);
  const std::atomic<bool> cancel = false;
  JobSpec spec = SmallJob();
  spec.settings.light_samples = 2;
  const auto bake = [&](SceneBaker& baker) {
    auto result = baker.Bake(*asset, spec, std::nullopt, cancel);
    EXPECT_TRUE(result.ok()) << result.status();
    return *std::move(result);
  };
  const auto skipped = [](const BakeResult& result, const char* key) -> uint64_t {
    const auto it = result.stats.skipped.find(key);
    return it == result.stats.skipped.end() ? 0 : it->second;
  };
  const BakeResult first = bake(*warm);
  EXPECT_EQ(skipped(first, "bake_stages"), 0u);
  const BakeResult again = bake(*warm);
  EXPECT_EQ(skipped(again, "bake_stages"), 3u);
  spec.overrides.suns = {{{0, 0.1, -1}, {1, 1, 1}}};
  const BakeResult sun = bake(*warm), cold = bake(*forgetful);
  EXPECT_EQ(skipped(sun, "bake_stages"), 2u);
  EXPECT_EQ(skipped(cold, "bake_stages"), 0u);
  EXPECT_EQ(sun.blobs.tree_topology.Hash(), first.blobs.tree_topology.Hash());
  EXPECT_EQ(sun.blobs.tree_topology.Hash(), cold.blobs.tree_topology.Hash());
  EXPECT_EQ(sun.blobs.tree_radiance.Hash(), cold.blobs.tree_radiance.Hash());
  EXPECT_NE(sun.blobs.tree_radiance.Hash(), first.blobs.tree_radiance.Hash());
}

// A square that stands still and one that grows from edge 1 to edge 9 in a second.
constexpr char kGrowingSquare[] = R"({"asset":{"version":"2.0"},"scene":0,
 "scenes":[{"nodes":[0,1]}],"nodes":[{"mesh":0},{"mesh":0,"translation":[0,0,3]}],
 "meshes":[{"primitives":[{"attributes":{"POSITION":0},"indices":1}]}],
 "animations":[{"samplers":[{"input":2,"output":3}],
  "channels":[{"sampler":0,"target":{"node":1,"path":"scale"}}]}],
 "accessors":[
  {"bufferView":0,"componentType":5126,"count":4,"type":"VEC3","min":[0,0,0],"max":[1,1,0]},
  {"bufferView":1,"componentType":5123,"count":6,"type":"SCALAR"},
  {"bufferView":2,"componentType":5126,"count":2,"type":"SCALAR","min":[0],"max":[1]},
  {"bufferView":3,"componentType":5126,"count":2,"type":"VEC3"}],
 "bufferViews":[{"buffer":0,"byteLength":48},{"buffer":0,"byteOffset":48,"byteLength":12},
  {"buffer":0,"byteOffset":60,"byteLength":8},{"buffer":0,"byteOffset":68,"byteLength":24}],
 "buffers":[{"byteLength":92,"uri":"data:application/octet-stream;base64,@"}]})";
// Its 92 bytes: four positions, six indices, two times, two scales.
constexpr char kGrowingSquareData[] =
    "AAAAAAAAAAAAAAAAAACAPwAAAAAAAAAAAACAPwAAgD8AAAAAAAAAAAAAgD8AAAAAAAABAAIAAAACAAMA"
    "AAAAAAAAgD8AAIA/AACAPwAAgD8AABBBAAAQQQAAEEE=";

TEST(CoreBaker, FramesHaveTheDensityOfTheSceneAtRest) {
  std::string gltf = kGrowingSquare;
  gltf.replace(gltf.find('@'), 1, kGrowingSquareData);
  AssetBundle asset;
  asset.root = "a.gltf";
  asset.files["a.gltf"] = Blob::FromString(gltf);
  const auto baker = MakeCoreBaker(1), forgetful = MakeCoreBaker(1, 0);
  const std::atomic<bool> cancel = false;
  JobSpec spec = SmallJob();
  spec.settings.light_samples = 1;
  const auto surfels = [&](SceneBaker& b, std::optional<double> time_s) {
    auto result = b.Bake(asset, spec, time_s, cancel);
    EXPECT_TRUE(result.ok()) << result.status();
    return std::pair(result->stats.counts["surfels"], result->stats.skipped["surfels_kept"]);
  };
  // 500 on two square metres, at rest and at the beginning.
  const uint64_t at_rest = surfels(*baker, std::nullopt).first;
  EXPECT_NEAR(static_cast<double>(at_rest), 500, 50);
  EXPECT_EQ(surfels(*baker, 0.0).first, at_rest);
  // At the end there are 82 m², as dense as before, and the square that stands still has its own.
  const auto [at_end, kept] = surfels(*baker, 1.0);
  EXPECT_NEAR(static_cast<double>(at_end), 500.0 * 82 / 2, 0.06 * 500 * 41);
  EXPECT_NEAR(static_cast<double>(kept), 250, 25);
  // Whoever bakes that frame first has the same.
  EXPECT_EQ(surfels(*forgetful, 1.0).first, at_end);
}

TEST(CoreBaker, ABrokenAssetIsThePersonsErrorNotOurs) {
  AssetBundle asset;
  asset.root = "a.gltf";
  asset.files["a.gltf"] = Blob::FromString("{ not json");
  std::atomic<bool> cancel = false;
  EXPECT_TRUE(absl::IsInvalidArgument(
      MakeCoreBaker(1)->Bake(asset, SmallJob(), std::nullopt, cancel).status()));
}

}  // namespace
}  // namespace farpoint

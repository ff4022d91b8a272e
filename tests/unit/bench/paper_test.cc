#include "bench/paper.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cmath>
#include <numeric>
#include <set>

#include "core/math/sampling.h"
#include "tests/unit/bench/paper_testing.h"
#include "tests/unit/bench/temp_folder.h"

namespace farpoint {
namespace {

using ::testing::HasSubstr;

TEST(SampleBlocks, AreDistinctSquaresOfTheGridInRasterOrder) {
  const std::vector<PixelRect> blocks = SampleBlocks(203, 101, 60, 1);
  ASSERT_EQ(blocks.size(), 60u);
  std::pair<int, int> last{-1, -1};
  for (const PixelRect& b : blocks) {
    EXPECT_EQ(b.x0 % 8, 0);
    EXPECT_EQ(b.y0 % 8, 0);
    EXPECT_EQ(b.x1, std::min(203, b.x0 + 8));
    EXPECT_EQ(b.y1, std::min(101, b.y0 + 8));
    EXPECT_LT(last, std::pair(b.y0, b.x0));
    last = {b.y0, b.x0};
  }
  EXPECT_NE(SampleBlocks(203, 101, 60, 2), blocks);
}

TEST(SampleBlocks, SpreadOverTheFrame) {
  int quarter[4] = {};
  for (const PixelRect& b : SampleBlocks(1280, 1000, 256, 0)) {
    ++quarter[2 * (b.y0 >= 500) + (b.x0 >= 640)];
  }
  for (const int n : quarter) EXPECT_NEAR(n, 64, 4);
}

TEST(SampleBlocks, AreAllThereAreIfMoreAreAsked) {
  int64_t area = 0;
  const std::vector<PixelRect> blocks = SampleBlocks(20, 17, 1000, 0);
  for (const PixelRect& b : blocks) area += b.area();
  EXPECT_EQ(blocks.size(), 9u);
  EXPECT_EQ(area, 20 * 17);
}

TEST(MiddleCrop, HoldsWholeBlocksInTheMiddle) {
  EXPECT_EQ(MiddleCrop(1280, 1000), (PixelRect{480, 352, 800, 640}));
  EXPECT_EQ(MiddleCrop(1024, 1024), (PixelRect{384, 384, 640, 640}));
  EXPECT_EQ(MiddleCrop(20, 10), (PixelRect{0, 0, 20, 10}));
  EXPECT_FALSE(MiddleCrop(1, 1).empty());
}

TEST(EstimateTotal, IsExactIfTimeFollowsSize) {
  const double size[] = {64, 64, 40, 8}, value[] = {128, 128, 80, 16};
  const TotalEstimate e = EstimateTotal(value, size, 1000);
  EXPECT_DOUBLE_EQ(e.total, 2000);
  EXPECT_NEAR(e.error, 0, 1e-9);
}

TEST(EstimateTotal, ErrorCoversTheTruth) {
  // A frame of 4096 blocks; samples of 64 of them. Two standard errors hold in 95 of 100.
  std::vector<double> frame_value, frame_size;
  for (uint64_t i = 0; i < 4096; ++i) {
    frame_size.push_back(32 + 32 * ToUnitFloat(static_cast<uint32_t>(HashKey(i, 1) >> 32)));
    frame_value.push_back(frame_size.back() *
                          (1 + 3 * ToUnitFloat(static_cast<uint32_t>(HashKey(i, 2) >> 32))));
  }
  const double truth = std::accumulate(frame_value.begin(), frame_value.end(), 0.0);
  const double sizes = std::accumulate(frame_size.begin(), frame_size.end(), 0.0);
  int within = 0;
  for (uint64_t trial = 0; trial < 200; ++trial) {
    std::vector<double> value, size;
    for (uint64_t i = 0; i < 64; ++i) {
      const size_t at = HashKey(trial, i, 3) % 4096;
      value.push_back(frame_value[at]);
      size.push_back(frame_size[at]);
    }
    const TotalEstimate e = EstimateTotal(value, size, sizes);
    within += std::fabs(e.total - truth) < 2 * e.error;
  }
  EXPECT_GE(within, 180);
  EXPECT_LT(within, 200);
}

TEST(EstimateTotal, OfNothingIsNothing) {
  EXPECT_EQ(EstimateTotal({}, {}, 5).total, 0);
  const double zero[] = {0, 0};
  EXPECT_EQ(EstimateTotal(zero, zero, 5).total, 0);
}

TEST(SearchMicrobuffer, FindsTheNearestSide) {
  for (const double target : {0.5, 9.0, 100.0, 130.0, 333.0, 575.0, 9999.0}) {
    int calls = 0;
    const auto trials = SearchMicrobuffer(24, target, [&](uint32_t side) -> absl::StatusOr<double> {
      ++calls;
      return static_cast<double>(side) * side;
    });
    ASSERT_TRUE(trials.ok());
    EXPECT_LE(calls, 5);
    const uint32_t found = NearestTrial(*trials, target).microbuffer;
    for (uint32_t side = 1; side <= 24; ++side) {
      const auto distance = [&](uint32_t s) { return std::fabs(std::log(s * s / target)); };
      EXPECT_LE(distance(found), distance(side) + 1e-12) << target;
    }
  }
}

TEST(SearchMicrobuffer, StopsAtAnError) {
  const auto trials = SearchMicrobuffer(
      24, 1, [](uint32_t) -> absl::StatusOr<double> { return absl::InternalError("no"); });
  EXPECT_EQ(trials.status().code(), absl::StatusCode::kInternal);
}

TEST(PaperScenes, AreThoseOfTheTable) {
  ASSERT_EQ(PaperScenes().size(), 4u);
  for (const PaperScene& s : PaperScenes()) {
    const auto found = FindPaperScene(s.name);
    ASSERT_TRUE(found.ok());
    EXPECT_EQ(*found, &s);
    EXPECT_NEAR(s.published.points, static_cast<double>(s.points), 1.0);
    // What the paper's text says of its table: 2.2 to 3.8, 3.4 to 5.2 and 1.4 to 3.2.
    const PublishedRow& p = s.published;
    EXPECT_GT(p.total_pbgi_s / p.total_fpbgi_s, 2.15);
    EXPECT_LT(p.total_pbgi_s / p.total_fpbgi_s, 3.85);
    EXPECT_GT(p.cut_pbgi_s / p.cut_fpbgi_s, 3.35);
    EXPECT_LT(p.cut_pbgi_s / p.cut_fpbgi_s, 5.25);
    EXPECT_GT(p.raster_pbgi_s / p.raster_fpbgi_s, 1.35);
    EXPECT_LT(p.raster_pbgi_s / p.raster_fpbgi_s, 3.25);
  }
  EXPECT_THAT(std::string(FindPaperScene("teapot").status().message()), HasSubstr("sponza"));
}

TEST(PaperScenes, BunnyStandsInItsRoom) {
  const TempFolder folder;
  std::filesystem::create_directories(folder / "bunny");
  // A tetrahedron of height 2 stands for it.
  std::ofstream(folder / "bunny/stanford-bunny.obj")
      << "v 0 1 0\nv 1 1 0\nv 0 1 1\nv 0 3 0\nf 1 2 3\nf 1 2 4\nf 2 3 4\nf 3 1 4\n";
  std::string missing;
  const auto scene = FindPaperScene("bunny");
  ASSERT_TRUE(scene.ok());
  const auto view = LoadPaperScene(**scene, folder.path().string(), false, missing);
  ASSERT_TRUE(view.ok()) << view.status();
  ASSERT_TRUE(view->has_value()) << missing;
  const Scene& s = (*view)->scene;
  EXPECT_EQ(s.instances.size(), 5u);
  ASSERT_EQ(s.lights.size(), 1u);
  EXPECT_LT(s.lights[0].direction.y, 0);
  const Mesh& floor = s.meshes[1];
  for (const Vec3f& p : floor.positions) EXPECT_EQ(p.y, 1.0f);
  // The camera looks at the object from the room's open side.
  EXPECT_LT((*view)->camera.forward.z, -0.9);
  EXPECT_GT((*view)->camera.eye.z, 3.0);
}

TEST(PaperScenes, WhatIsNotThereIsSaid) {
  const TempFolder folder;
  for (const std::string& dir : {std::string(), folder.path().string()}) {
    std::string missing;
    const auto view = LoadPaperScene(**FindPaperScene("sponza"), dir, true, missing);
    ASSERT_TRUE(view.ok()) << view.status();
    EXPECT_FALSE(view->has_value());
    EXPECT_THAT(missing, HasSubstr("Sponza.gltf"));
  }
}

TEST(Paper, HasAllFigures) {
  ASSERT_TRUE(TinyPaper().ok()) << TinyPaper().status();
  ASSERT_EQ(TinyPaper()->scenes.size(), 1u);
  const PaperSceneReport& s = TinyPaper()->scenes[0];
  EXPECT_EQ(s.width, 96);
  EXPECT_GT(s.surfels, 1000u);
  EXPECT_EQ(s.blocks, 8u);
  EXPECT_EQ(s.block_pixels, 512u);
  EXPECT_GT(s.block_receivers, 300u);
  EXPECT_EQ(s.crop, (PixelRect{32, 32, 64, 64}));
  EXPECT_EQ(s.compared, s.crop);
  EXPECT_GT(s.white, 0);
  for (const PaperIntegrator* r : {&s.pbgi, &s.fpbgi, &s.dpbgi}) {
    EXPECT_GT(r->times.gather, 0);
    EXPECT_GT(r->crop_gather, 0);
    EXPECT_EQ(r->truth.pixels, s.reference_pixels);
    EXPECT_GT(r->truth.rr, 0);
  }
  // Tiny, but the same image. How coarse dpbgi is depends on the machine.
  EXPECT_LT(s.pbgi.truth.rr, 1.5);
  EXPECT_LT(s.fpbgi.truth.rr, 1.5);
  EXPECT_GT(s.pbgi.times.gather_error, 0);
  EXPECT_EQ(s.fpbgi.times.gather_error, 0);  // nothing of it is extrapolated
  EXPECT_EQ(s.pbgi.microbuffer, 64u);
  EXPECT_EQ(s.fpbgi.clusters, 100u);
  EXPECT_EQ(s.fpbgi.epsilon, 0.1);
  EXPECT_FALSE(s.pbgi.difference.has_value());
  ASSERT_TRUE(s.fpbgi.difference && s.dpbgi.difference);
  EXPECT_GT(s.fpbgi.difference->mse, 0);
  EXPECT_GT(s.fpbgi.difference->mse_error, 0);
  EXPECT_GT(s.reference_paths, 0u);
}

TEST(Paper, StagesOfTheGatherSumToIt) {
  ASSERT_TRUE(TinyPaper().ok()) << TinyPaper().status();
  const PaperSceneReport& s = TinyPaper()->scenes[0];
  for (const PaperIntegrator* r : {&s.pbgi, &s.fpbgi, &s.dpbgi}) {
    const double sum = std::accumulate(r->times.seconds.begin(), r->times.seconds.end(), 0.0);
    EXPECT_NEAR(sum, r->times.gather, 1e-9 + 1e-6 * sum);
  }
}

TEST(Paper, SweepHasTheDefaultAndItsImage) {
  ASSERT_TRUE(TinyPaper().ok()) << TinyPaper().status();
  const PaperSceneReport& s = TinyPaper()->scenes[0];
  std::set<std::pair<uint32_t, double>> settings;
  bool has_default = false;
  for (const PaperSweepPoint& p : s.sweep) {
    settings.insert({p.clusters, p.epsilon});
    EXPECT_GT(p.gather, 0);
    EXPECT_NEAR(p.speed_up, s.pbgi_crop_gather / p.gather, 1e-9);
    if (p.clusters != s.fpbgi.clusters || p.epsilon != s.fpbgi.epsilon) continue;
    has_default = true;
    // The crop alone is the same pixels as the crop of the frame.
    EXPECT_EQ(p.mse, s.fpbgi.difference->crop_mse);
    EXPECT_EQ(p.pdp, s.fpbgi.difference->crop_pdp);
  }
  EXPECT_TRUE(has_default);
  EXPECT_EQ(settings.size(), s.sweep.size());
  EXPECT_EQ(settings.size(), 4u);
}

TEST(Paper, DegradedIsTheNearestOfItsTrials) {
  ASSERT_TRUE(TinyPaper().ok()) << TinyPaper().status();
  const PaperSceneReport& s = TinyPaper()->scenes[0];
  EXPECT_EQ(NearestTrial(s.trials, s.fpbgi.times.gather).microbuffer, s.dpbgi.microbuffer);
  EXPECT_GE(s.trials.size(), 2u);
}

TEST(Paper, PicturesHaveTheirSizes) {
  ASSERT_TRUE(TinyPaper().ok()) << TinyPaper().status();
  std::set<std::string> names;
  for (const PaperPicture& p : TinyPaper()->scenes[0].pictures) {
    names.insert(p.name);
    EXPECT_EQ(p.rgb.size(), static_cast<size_t>(p.width) * static_cast<size_t>(p.height) * 3);
    EXPECT_EQ(p.width, p.name == "fpbgi-frame" ? 96 : 32) << p.name;
  }
  for (const char* name : {"fpbgi-frame", "pbgi", "fpbgi", "dpbgi", "fpbgi-difference",
                           "dpbgi-difference", "fpbgi-seen", "dpbgi-seen", "sweep-k16-e0.1"}) {
    EXPECT_TRUE(names.contains(name)) << name;
  }
}

TEST(Paper, SampleTellsOfTheWholeFrame) {
  ASSERT_TRUE(TinyPaper().ok()) << TinyPaper().status();
  ASSERT_TRUE(TinyFullPaper().ok()) << TinyFullPaper().status();
  const PaperSceneReport &part = TinyPaper()->scenes[0], &full = TinyFullPaper()->scenes[0];
  EXPECT_EQ(full.compared, (PixelRect{0, 0, 96, 96}));
  EXPECT_EQ(full.pbgi.times.gather_error, 0);
  EXPECT_EQ(full.fpbgi.difference->mse_error, 0);
  EXPECT_EQ(full.fpbgi.difference->mse, full.fpbgi.difference->crop_mse);
  // White depends on the pixels that were rendered, and the MSE on white squared; errors beside.
  EXPECT_NEAR(part.white, full.white, 0.3 * full.white);
  EXPECT_NEAR(part.fpbgi.difference->mse, full.fpbgi.difference->mse,
              4 * part.fpbgi.difference->mse_error + 0.5 * full.fpbgi.difference->mse);
  // The same pixels, values and truth.
  EXPECT_EQ(part.pbgi.truth.rel_rmse, full.pbgi.truth.rel_rmse);
  EXPECT_EQ(part.fpbgi.truth.rel_rmse, full.fpbgi.truth.rel_rmse);
}

TEST(Paper, OtherParametersAreInForce) {
  ASSERT_TRUE(TinyPaper().ok()) << TinyPaper().status();
  PaperOptions options = TinyPaperOptions();
  options.splat = Splat::kCoverage;
  options.microbuffer = 16;
  const auto other = RunPaper(options, [](std::string_view) {});
  ASSERT_TRUE(other.ok()) << other.status();
  EXPECT_EQ(other->scenes[0].pbgi.microbuffer, 16u);
  EXPECT_EQ(other->scenes[0].fpbgi.microbuffer, 16u);
  EXPECT_LE(other->scenes[0].dpbgi.microbuffer, 16u);
  // Another splat in other buffers is another image.
  EXPECT_GT(std::fabs(other->scenes[0].pbgi.truth.rr / TinyPaper()->scenes[0].pbgi.truth.rr - 1),
            0.02);
}

TEST(Paper, ScenesThatAreMissingAreLeftOutOrRefused) {
  PaperOptions options = TinyPaperOptions();
  options.scene = "sponza";
  const auto refused = RunPaper(options, [](std::string_view) {});
  EXPECT_EQ(refused.status().code(), absl::StatusCode::kNotFound);
  options.scene = "teapot";
  EXPECT_EQ(RunPaper(options, [](std::string_view) {}).status().code(),
            absl::StatusCode::kInvalidArgument);
}

TEST(Paper, TooLargeAFrameIsRefused) {
  PaperOptions options = TinyPaperOptions();
  options.width = 100'000;
  options.height = 1;
  EXPECT_EQ(RunPaper(options, [](std::string_view) {}).status().code(),
            absl::StatusCode::kInvalidArgument);
}

}  // namespace
}  // namespace farpoint

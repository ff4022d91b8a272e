#include "worker/tile_runner.h"

#include <gtest/gtest.h>

#include <map>
#include <string>
#include <vector>

#include "core/image/film.h"
#include "tests/unit/server/fake_render.h"

namespace farpoint {
namespace {

class FakeSource final : public BlobSource {
 public:
  Digest Add(const std::string& content) {
    const Blob blob = Blob::FromString(content);
    blobs[blob.Hash()] = blob;
    return blob.Hash();
  }
  absl::StatusOr<Blob> Get(const Digest& digest, const std::function<bool()>& progress) override {
    ++gets;
    if (progress && !progress()) return absl::CancelledError("dropped");
    const auto at = blobs.find(digest);
    if (at == blobs.end()) return absl::NotFoundError("no blob");
    return at->second;
  }
  std::map<Digest, Blob> blobs;
  int gets = 0;
};

class TileRunnerTest : public ::testing::Test {
 protected:
  TileWork Work(const std::string& job, const std::string& scene, const PixelRect& rect) {
    TileWork work;
    work.lease = {"lease"};
    work.attempt = 4;
    work.job = {job};
    work.rect = rect;
    work.frame.film = {.width = 64, .height = 64, .crop = {0, 0, 64, 64}};
    work.frame.settings.layers = {Layer::kBeauty};
    work.blobs.prepared_scene = source_.Add(scene);
    return work;
  }
  FakeSource source_;
  Executor executor_{1};
  std::atomic<bool> cancel_ = false;
  TileProgress progress_;
};

TEST_F(TileRunnerTest, RendersWhatTheLeaseSays) {
  const FakeRenderer renderer;
  TileRunner runner(renderer, source_, executor_, 2);
  const PixelRect rect{32, 0, 64, 32};
  const auto result = runner.Run(Work("j", "scene", rect), progress_, cancel_);
  ASSERT_TRUE(result.ok()) << result.status();
  EXPECT_EQ(result->lease, LeaseId{"lease"});
  EXPECT_EQ(result->attempt, 4u);
  EXPECT_EQ(result->sha256, result->bytes.Hash());
  const auto film = DecodeFilm(result->bytes.bytes());
  ASSERT_TRUE(film.ok());
  EXPECT_EQ(ImageHash(*film), ImageHash(FakeTile(rect, {Layer::kBeauty})));
  EXPECT_EQ(result->stats.counts.at("receivers"), 1024u);
  EXPECT_GT(progress_.counter.load(), 3u);
  EXPECT_EQ(progress_.fraction.load(), 1.f);
}

TEST_F(TileRunnerTest, AJobsSceneIsLoadedOnceAndTheLastOnesAreKept) {
  const FakeRenderer renderer;
  TileRunner runner(renderer, source_, executor_, 2);
  const PixelRect rect{0, 0, 32, 32};
  const auto run = [&](const std::string& job, const std::string& scene) {
    ASSERT_TRUE(runner.Run(Work(job, scene, rect), progress_, cancel_).ok());
  };
  run("a", "1");
  run("a", "1");
  run("b", "1");  // another camera on the same scene
  EXPECT_EQ(renderer.loads.load(), 1);
  run("c", "2");
  run("a", "1");
  EXPECT_EQ(renderer.loads.load(), 2);
  run("d", "3");  // puts out "2"
  run("a", "1");
  EXPECT_EQ(renderer.loads.load(), 3);
  run("c", "2");
  EXPECT_EQ(renderer.loads.load(), 4);
}

TEST_F(TileRunnerTest, FramesOfAnAnimationShareAScene) {
  const FakeRenderer renderer;
  TileRunner runner(renderer, source_, executor_, 1);
  // Nothing but the camera moves: the blobs are the same.
  uint64_t skipped = 0;
  for (const uint32_t frame : {0u, 0u, 1u, 1u, 0u}) {
    TileWork work = Work("j", "scene", {0, 0, 32, 32});
    work.frame_index = frame;
    auto result = runner.Run(work, progress_, cancel_);
    ASSERT_TRUE(result.ok());
    skipped += result->stats.skipped["scene_broadcasts"];
  }
  EXPECT_EQ(renderer.frames.load(), 3);
  EXPECT_EQ(renderer.loads.load(), 1);
  EXPECT_EQ(source_.gets, 1);
  EXPECT_EQ(skipped, 2u);
}

TEST_F(TileRunnerTest, CancelEndsDownloadsAndRenders) {
  const FakeRenderer renderer([this](const PixelRect&, const std::atomic<bool>* cancel) {
    cancel_ = true;
    return cancel->load() ? absl::CancelledError("seen") : absl::OkStatus();
  });
  TileRunner runner(renderer, source_, executor_, 1);
  const TileWork work = Work("j", "scene", {0, 0, 32, 32});
  EXPECT_TRUE(absl::IsCancelled(runner.Run(work, progress_, cancel_).status()));
  EXPECT_TRUE(absl::IsCancelled(
      runner.Run(Work("k", "other", {0, 0, 32, 32}), progress_, cancel_).status()));
}

TEST_F(TileRunnerTest, AFailureLeavesTheNextTileUnharmed) {
  const FakeRenderer renderer;
  TileRunner runner(renderer, source_, executor_, 1);
  TileWork work = Work("j", "scene", {0, 0, 32, 32});
  work.blobs.tree_topology = Sha256().Update("missing").Finish();
  EXPECT_TRUE(absl::IsNotFound(runner.Run(work, progress_, cancel_).status()));
  source_.Add("missing");
  EXPECT_TRUE(runner.Run(work, progress_, cancel_).ok());
}

TEST_F(TileRunnerTest, ACarefulTileTellsOfEachBlockBeforeIt) {
  std::vector<std::string> seen;  // places told and blocks begun, in order
  const FakeRenderer renderer([&](const PixelRect& rect, const std::atomic<bool>*) {
    EXPECT_TRUE(progress_.rendering);
    seen.push_back("render " + std::to_string(rect.x0) + "," + std::to_string(rect.y0));
    return rect.x0 == 32 && rect.y0 == 32 && seen.size() > 100 ? absl::InternalError("boom")
                                                               : absl::OkStatus();
  });
  TileRunner runner(renderer, source_, executor_, 1);
  // Cut by a crop on two sides.
  const PixelRect rect{0, 0, 50, 64};
  TileWork work = Work("j", "scene", rect);
  const auto plain = runner.Run(work, progress_, cancel_);
  ASSERT_TRUE(plain.ok()) << plain.status();
  EXPECT_EQ(progress_.place(), "");
  EXPECT_FALSE(progress_.rendering) << "what follows is the network's";
  seen.clear();
  work.careful = true;
  progress_.tell = [&] { seen.push_back("told " + progress_.place().substr(0, 10)); };
  const auto careful = runner.Run(work, progress_, cancel_);
  ASSERT_TRUE(careful.ok()) << careful.status();
  EXPECT_EQ(careful->sha256, plain->sha256);
  EXPECT_EQ(careful->stats.counts.at("receivers"), plain->stats.counts.at("receivers"));
  EXPECT_EQ(seen, (std::vector<std::string>{"told block 0, 0", "render 0,0", "told block 1, 0",
                                            "render 32,0", "told block 0, 1", "render 0,32",
                                            "told block 1, 1", "render 32,32"}));
  seen.resize(100);
  const auto failed = runner.Run(work, progress_, cancel_);
  EXPECT_EQ(failed.status().code(), absl::StatusCode::kInternal);
  EXPECT_NE(failed.status().message().find("block 1, 1"), std::string_view::npos);
}

}  // namespace
}  // namespace farpoint

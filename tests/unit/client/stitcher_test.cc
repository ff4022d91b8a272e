#include "client/stitcher.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cstring>

#include "tests/unit/client/sample_job.h"

namespace farpoint {
namespace {

using testing::ElementsAre;
using testing::HasSubstr;

const FilmSpec kFilm{100, 70, {0, 0, 100, 70}};
const FilmSpec kCrop{100, 70, {33, 5, 90, 66}};

TileData WithBytes(const TileData& tile, std::vector<std::byte> bytes) {
  TileData changed = tile;
  changed.bytes = Blob::FromVector(std::move(bytes));
  return changed;
}

TEST(Stitcher, MakesTheImageOfItsTiles) {
  for (const FilmSpec& film : {kFilm, kCrop}) {
    const SampleJob job = MakeSampleJob(film);
    auto stitcher = Stitcher::Create(job.info, 0);
    ASSERT_TRUE(stitcher.ok()) << stitcher.status();
    for (const TileData& tile : job.tiles) EXPECT_TRUE(stitcher->Add(tile).ok());
    EXPECT_TRUE(stitcher->Missing().empty());
    const Film whole = SampleFilm(film.crop, job.info.spec.settings.layers);
    EXPECT_EQ(stitcher->film().rect(), film.crop);
    EXPECT_EQ(ImageHash(stitcher->film()), ImageHash(whole));
  }
}

TEST(Stitcher, DoesNotDependOnTheOrderOfTiles) {
  const SampleJob job = MakeSampleJob(kFilm);
  auto forward = Stitcher::Create(job.info, 0);
  auto backward = Stitcher::Create(job.info, 0);
  for (size_t i = 0; i < job.tiles.size(); ++i) {
    ASSERT_TRUE(forward->Add(job.tiles[i]).ok());
    ASSERT_TRUE(backward->Add(job.tiles[job.tiles.size() - 1 - i]).ok());
  }
  EXPECT_EQ(ImageHash(forward->film()), ImageHash(backward->film()));
}

TEST(Stitcher, KnowsWhatIsMissing) {
  const SampleJob job = MakeSampleJob({64, 64, {0, 0, 64, 64}});
  auto stitcher = Stitcher::Create(job.info, 0);
  ASSERT_TRUE(stitcher->Add(job.tiles[2]).ok());
  EXPECT_THAT(stitcher->Missing(), ElementsAre(0, 1, 3));
  ASSERT_TRUE(stitcher->Add(job.tiles[2]).ok()) << "a repeated tile is harmless";
  EXPECT_THAT(stitcher->Missing(), ElementsAre(0, 1, 3));
}

TEST(Stitcher, RefusesADamagedTileAndStaysAsItWas) {
  const SampleJob job = MakeSampleJob({64, 32, {0, 0, 64, 32}});
  auto stitcher = Stitcher::Create(job.info, 0);
  const auto bytes = job.tiles[0].bytes.bytes();
  for (size_t at = 0; at < bytes.size(); at += 97) {
    std::vector<std::byte> flipped(bytes.begin(), bytes.end());
    flipped[at] ^= std::byte{1};
    const absl::Status status = stitcher->Add(WithBytes(job.tiles[0], flipped));
    EXPECT_TRUE(absl::IsDataLoss(status)) << at;
    EXPECT_THAT(std::string(status.message()), HasSubstr("tile 0"));
  }
  EXPECT_TRUE(absl::IsDataLoss(
      stitcher->Add(WithBytes(job.tiles[0], {bytes.begin(), bytes.begin() + bytes.size() / 2}))));
  EXPECT_TRUE(absl::IsDataLoss(stitcher->Add(WithBytes(job.tiles[0], {}))));
  EXPECT_THAT(stitcher->Missing(), ElementsAre(0, 1));
  EXPECT_EQ(stitcher->film().Get(Layer::kBeauty, 0, 5, 5), 0);
}

TEST(Stitcher, DoesNotBelieveATilesOwnHash) {
  const SampleJob job = MakeSampleJob({64, 32, {0, 0, 64, 32}});
  auto stitcher = Stitcher::Create(job.info, 0);
  TileData other = job.tiles[1];
  other.tile = 0;  // whole and with its own hash, but not the tile that was announced
  EXPECT_TRUE(absl::IsDataLoss(stitcher->Add(other)));
}

TEST(Stitcher, RefusesOtherPixelsAndLayersEvenIfTheHashIsRight) {
  SampleJob job = MakeSampleJob({64, 32, {0, 0, 64, 32}});
  const auto announce = [&](const Film& film) {
    TileData tile = job.tiles[0];
    tile.bytes = Blob::FromVector(EncodeFilm(film));
    job.info.tiles[0].sha256 = tile.bytes.Hash();
    return tile;
  };
  const TileData moved = announce(SampleFilm({32, 0, 64, 32}, job.info.spec.settings.layers));
  EXPECT_TRUE(absl::IsDataLoss(Stitcher::Create(job.info, 0)->Add(moved)));
  const TileData poorer = announce(SampleFilm({0, 0, 32, 32}, {Layer::kBeauty}));
  EXPECT_TRUE(absl::IsDataLoss(Stitcher::Create(job.info, 0)->Add(poorer)));
}

TEST(Stitcher, RefusesATileNumberThatDoesNotExist) {
  const SampleJob job = MakeSampleJob({64, 32, {0, 0, 64, 32}});
  auto stitcher = Stitcher::Create(job.info, 0);
  TileData tile = job.tiles[0];
  tile.tile = 2;
  EXPECT_TRUE(absl::IsDataLoss(stitcher->Add(tile)));
}

TEST(Stitcher, WantsTilesThatCoverTheCropOnce) {
  const SampleJob job = MakeSampleJob(kFilm);
  JobInfo gap = job.info;
  gap.tiles.pop_back();
  EXPECT_TRUE(absl::IsInvalidArgument(Stitcher::Create(gap, 0).status()));
  JobInfo twice = job.info;
  twice.tiles[1] = twice.tiles[0];
  EXPECT_TRUE(absl::IsInvalidArgument(Stitcher::Create(twice, 0).status()));
  JobInfo outside = job.info;
  outside.tiles[0].rect.x0 = -1;
  EXPECT_TRUE(absl::IsInvalidArgument(Stitcher::Create(outside, 0).status()));
  JobInfo none = job.info;
  none.tiles.clear();
  EXPECT_TRUE(absl::IsInvalidArgument(Stitcher::Create(none, 0).status()));
}

TEST(Stitcher, StitchesOneFrameOfASequence) {
  const SampleJob job = MakeSampleJob(kCrop, {7, 3, 12});
  const size_t count = job.tiles.size() / 3;
  for (uint32_t frame = 0; frame < 3; ++frame) {
    EXPECT_TRUE(TilesOfFrame(job.info, frame).complete());
    auto stitcher = Stitcher::Create(job.info, frame);
    ASSERT_TRUE(stitcher.ok()) << stitcher.status();
    EXPECT_EQ(stitcher->Missing().size(), count);
    EXPECT_EQ(stitcher->Missing().front(), frame * count);
    for (size_t i = 0; i < count; ++i) {
      ASSERT_TRUE(stitcher->Add(job.tiles[frame * count + i]).ok());
    }
    EXPECT_EQ(ImageHash(stitcher->film()),
              ImageHash(SampleFilm(kCrop.crop, job.info.spec.settings.layers, frame)));
    const TileData& other = job.tiles[frame == 0 ? count : 0];
    EXPECT_TRUE(absl::IsDataLoss(stitcher->Add(other))) << "a tile of another frame";
  }
  EXPECT_FALSE(Stitcher::Create(job.info, 3).ok());
  JobInfo mixed = job.info;
  mixed.tiles[count].frame = 0;
  EXPECT_TRUE(absl::IsInvalidArgument(Stitcher::Create(mixed, 1).status()));
}

TEST(Stitcher, LeavesOutWhatIsNotCommittedIfThatIsWanted) {
  SampleJob job = MakeSampleJob({64, 64, {0, 0, 64, 64}}, {1, 2});
  job.info.tiles[5].sha256 = {};
  const FrameTiles tiles = TilesOfFrame(job.info, 1);
  EXPECT_FALSE(tiles.complete());
  EXPECT_EQ(tiles.committed, 3u);
  EXPECT_EQ(tiles.total, 4u);
  EXPECT_TRUE(absl::IsFailedPrecondition(Stitcher::Create(job.info, 1).status()));
  auto stitcher = Stitcher::Create(job.info, 1, /*partial=*/true);
  ASSERT_TRUE(stitcher.ok()) << stitcher.status();
  EXPECT_THAT(stitcher->Missing(), ElementsAre(4, 6, 7));
  for (const uint32_t tile : {4, 6, 7}) ASSERT_TRUE(stitcher->Add(job.tiles[tile]).ok());
  EXPECT_TRUE(stitcher->Missing().empty());
  EXPECT_NE(stitcher->film().Get(Layer::kBeauty, 0, 31, 31), 0);
  EXPECT_EQ(stitcher->film().Get(Layer::kBeauty, 0, 32, 31), 0) << "the missing tile";
}

TEST(TilesOfFrame, OfNothingIsNotComplete) {
  EXPECT_FALSE(TilesOfFrame({}, 0).complete());
  JobInfo unbaked = MakeSampleJob(kFilm).info;
  unbaked.tiles.clear();
  EXPECT_FALSE(TilesOfFrame(unbaked, 0).complete());
  EXPECT_FALSE(Stitcher::Create(unbaked, 0, true).ok());
}

TEST(Stitcher, WantsEveryTileCommitted) {
  JobInfo info = MakeSampleJob(kFilm).info;
  info.tiles[3].sha256 = {};
  const absl::Status status = Stitcher::Create(info, 0).status();
  EXPECT_TRUE(absl::IsFailedPrecondition(status));
  EXPECT_THAT(std::string(status.message()), HasSubstr("tile 3"));
}

}  // namespace
}  // namespace farpoint

#include "core/image/tile_rect.h"

#include <gtest/gtest.h>

#include <vector>

namespace farpoint {
namespace {

TEST(PixelRect, IsHalfOpen) {
  const PixelRect r{2, 3, 5, 7};
  EXPECT_EQ(r.area(), 12);
  EXPECT_TRUE(r.Contains(2, 3));
  EXPECT_TRUE(r.Contains(4, 6));
  EXPECT_FALSE(r.Contains(5, 6));
  EXPECT_FALSE(r.Contains(4, 7));
  EXPECT_EQ((PixelRect{5, 0, 2, 9}.area()), 0);
  EXPECT_TRUE((PixelRect{0, 0, 4, 4}.Intersect({4, 0, 8, 4}).empty()));
}

TEST(ValidateFilm, AcceptsWhatIsStatedAndRefusesTheRest) {
  const auto code = [](int w, int h, PixelRect crop) { return ValidateFilm({w, h, crop}).code(); };
  const auto kOk = absl::StatusCode::kOk;
  const auto kBad = absl::StatusCode::kInvalidArgument;
  EXPECT_EQ(code(1, 1, {0, 0, 1, 1}), kOk);
  EXPECT_EQ(code(65536, 16384, {0, 0, 65536, 16384}), kOk);
  EXPECT_EQ(code(65536, 16385, {0, 0, 1, 1}), kBad);
  EXPECT_EQ(code(65537, 1, {0, 0, 1, 1}), kBad);
  EXPECT_EQ(code(0, 1, {0, 0, 1, 1}), kBad);
  EXPECT_EQ(code(1, -1, {0, 0, 1, 1}), kBad);
  EXPECT_EQ(code(100, 100, {10, 10, 10, 20}), kBad);
  EXPECT_EQ(code(100, 100, {0, 0, 101, 100}), kBad);
  EXPECT_EQ(code(100, 100, {-1, 0, 50, 50}), kBad);
  EXPECT_EQ(code(100, 100, {99, 99, 100, 100}), kOk);
}

// Each pixel of `whole` lies in exactly one of `parts`.
void ExpectPartition(const std::vector<PixelRect>& parts, const PixelRect& whole) {
  std::vector<int> covered(static_cast<size_t>(whole.area()));
  for (const PixelRect& p : parts) {
    EXPECT_FALSE(p.empty());
    EXPECT_TRUE(whole.Contains(p));
    for (int y = p.y0; y < p.y1; ++y) {
      for (int x = p.x0; x < p.x1; ++x) {
        ++covered[static_cast<size_t>((y - whole.y0) * whole.width() + x - whole.x0)];
      }
    }
  }
  for (const int n : covered) ASSERT_EQ(n, 1);
}

TEST(TilesOf, PartitionTheCropOnAGridAnchoredAtTheFrame) {
  for (const PixelRect crop : {PixelRect{0, 0, 300, 200}, PixelRect{31, 33, 100, 130},
                               PixelRect{64, 64, 128, 128}, PixelRect{299, 199, 300, 200}}) {
    for (const int tile : {32, 64, 96, 1024}) {
      const std::vector<PixelRect> tiles = TilesOf({300, 200, crop}, tile);
      ExpectPartition(tiles, crop);
      for (size_t i = 0; i < tiles.size(); ++i) {
        EXPECT_TRUE(tiles[i].x0 == crop.x0 || tiles[i].x0 % tile == 0);
        EXPECT_TRUE(tiles[i].y0 == crop.y0 || tiles[i].y0 % tile == 0);
        EXPECT_EQ(tiles[i].x0 / tile, (tiles[i].x1 - 1) / tile);
        EXPECT_EQ(tiles[i].y0 / tile, (tiles[i].y1 - 1) / tile);
        if (i > 0) {  // raster order
          EXPECT_TRUE(tiles[i - 1].y0 < tiles[i].y0 ||
                      (tiles[i - 1].y0 == tiles[i].y0 && tiles[i - 1].x0 < tiles[i].x0));
        }
      }
    }
  }
}

TEST(BlocksOf, AreWholeGridCellsClippedToTheFrameOnly) {
  const PixelRect frame{0, 0, 100, 70};
  const std::vector<PixelRect> blocks = BlocksOf({33, 31, 97, 33}, frame);
  const std::vector<PixelRect> expected = {{32, 0, 64, 32},  {64, 0, 96, 32},  {96, 0, 100, 32},
                                           {32, 32, 64, 64}, {64, 32, 96, 64}, {96, 32, 100, 64}};
  EXPECT_EQ(blocks, expected);
  ExpectPartition(BlocksOf(frame, frame), frame);
  EXPECT_TRUE(BlocksOf({100, 0, 120, 20}, frame).empty());
}

TEST(BlocksOf, ATileOfWholeBlocksHasOnlyItsOwn) {
  const PixelRect frame{0, 0, 256, 256};
  for (const PixelRect& tile : TilesOf({256, 256, frame}, 64)) {
    ExpectPartition(BlocksOf(tile, frame), tile);
  }
}

}  // namespace
}  // namespace farpoint

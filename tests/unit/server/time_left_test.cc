#include "server/time_left.h"

#include <gtest/gtest.h>

#include <cmath>
#include <functional>
#include <numeric>
#include <vector>

namespace farpoint {
namespace {

constexpr int kSide = 64;

// `across` × `down` tiles of 64 pixels, in raster order.
std::vector<PixelRect> Tiles(int across, int down) {
  std::vector<PixelRect> tiles;
  for (int y = 0; y < down; ++y) {
    for (int x = 0; x < across; ++x) {
      tiles.push_back({x * kSide, y * kSide, (x + 1) * kSide, (y + 1) * kSide});
    }
  }
  return tiles;
}

// In steps of the golden ratio, as a worker that is alone gets them.
std::vector<uint32_t> Spread(uint32_t count) {
  std::vector<uint32_t> order;
  std::vector<bool> taken(count);
  for (uint32_t k = 0; k < count; ++k) {
    auto at = static_cast<uint32_t>(uint64_t{count} * (k * 2654435769u) >> 32);
    while (taken[at]) at = (at + 1) % count;
    taken[at] = true;
    order.push_back(at);
  }
  return order;
}

std::vector<uint32_t> InOrder(uint32_t count) {
  std::vector<uint32_t> order(count);
  std::iota(order.begin(), order.end(), 0u);
  return order;
}

using Check = std::function<void(size_t done, double left, double truth)>;

// Commits `order`, each tile after cost(tile) seconds; `check` after each but the last.
void Play(TimeLeft left, const std::vector<uint32_t>& order,
          const std::function<double(uint32_t)>& cost, const Check& check) {
  std::vector<double> ends;
  for (const uint32_t tile : order) {
    ends.push_back((ends.empty() ? 0 : ends.back()) + cost(tile));
  }
  EXPECT_FALSE(left.SecondsLeft(1));
  for (size_t j = 0; j + 1 < order.size(); ++j) {
    left.Commit(order[j], ends[j]);
    const std::optional<double> shown = left.SecondsLeft(ends[j]);
    ASSERT_TRUE(shown);
    check(j + 1, *shown, ends.back() - ends[j]);
  }
  left.Commit(order.back(), ends.back());
  EXPECT_EQ(left.SecondsLeft(ends.back()), 0);
}

// The cost of pixels that no tile before was near, within `reach` of a tile.
std::function<double(uint32_t)> SharedCost(int across, int down, double own, double shared) {
  return [=, near = std::vector<bool>(size_t(across * kSide / 8) * size_t(down * kSide / 8))](
             uint32_t tile) mutable {
    const int x0 = static_cast<int>(tile) % across * kSide,
              y0 = static_cast<int>(tile) / across * kSide;
    int fresh = 0;
    for (int y = std::max(0, y0 - 24); y < std::min(down * kSide, y0 + kSide + 24); y += 8) {
      for (int x = std::max(0, x0 - 24); x < std::min(across * kSide, x0 + kSide + 24); x += 8) {
        const size_t cell = static_cast<size_t>(y / 8) * static_cast<size_t>(across * kSide / 8) +
                            static_cast<size_t>(x / 8);
        fresh += near[cell] ? 0 : 1;
        near[cell] = true;
      }
    }
    return own + shared * fresh / 64.0;
  };
}

TEST(TimeLeft, IsCloseForTilesThatCostAlike) {
  for (const double usual : {0.04, 0.25}) {
    Play(
        TimeLeft(100, 100, Tiles(10, 10), {}, usual), Spread(100), [](uint32_t) { return 0.5; },
        [&](size_t done, double left, double truth) {
          if (done >= 20) {
            EXPECT_NEAR(left + 0.5 * static_cast<double>(done),
                        truth + 0.5 * static_cast<double>(done), (usual < 0.1 ? 0.15 : 0.25) * 50)
                << usual << " " << done;
          }
        });
  }
}

TEST(TimeLeft, KnowsWhatNeighboursShare) {
  // A third of the cost of a frame is shared; the first tiles make it for those around them.
  for (const std::vector<uint32_t>& order : {Spread(100), InOrder(100)}) {
    double linear_worst = 0, worst = 0;
    Play(TimeLeft(100, 100, Tiles(10, 10), {}, 0.25), order, SharedCost(10, 10, 2, 1),
         [&](size_t done, double left, double truth) {
           if (done < 20) return;
           const double gone = 300 - truth;
           worst = std::max(worst, std::abs(left - truth) / 300);
           linear_worst = std::max(
               linear_worst, std::abs(gone * (100.0 / static_cast<double>(done)) - 300) / 300);
         });
    EXPECT_LT(worst, 0.15);
    if (order != InOrder(100)) {
      EXPECT_GT(linear_worst, 0.25) << "a case that tells nothing";
    }
  }
}

// Rows that grow dearer are known from the first tiles if those are spread.
TEST(TimeLeft, TilesThatAreSpreadTellOfTheOthers) {
  const auto cost = [](uint32_t tile) { return 0.1 + 0.2 * (tile / 10); };
  double spread = 0, in_order = 0;
  Play(TimeLeft(100, 100, Tiles(10, 10), {}, 0.04), Spread(100), cost,
       [&](size_t done, double left, double truth) {
         if (done >= 20) spread = std::max(spread, std::abs(left - truth) / 100);
       });
  Play(TimeLeft(100, 100, Tiles(10, 10), {}, 0.04), InOrder(100), cost,
       [&](size_t done, double left, double truth) {
         if (done >= 20) in_order = std::max(in_order, std::abs(left - truth) / 100);
       });
  EXPECT_LT(spread, 0.15);
  EXPECT_GT(in_order, 0.3);
}

TEST(TimeLeft, LearnsAFramesShapeFromTheOneBefore) {
  // Ten tiles a frame: the fifth takes half of the frame's time. The first frame takes twice as
  // long.
  Play(
      TimeLeft(80, 10, Tiles(5, 2), {}, 0.25), InOrder(80),
      [](uint32_t tile) { return (tile < 10 ? 2 : 1) * (tile % 10 == 4 ? 4.5 : 0.5); },
      [](size_t done, double left, double truth) {
        if (done >= 20) {
          EXPECT_NEAR(left, truth, 0.02 * truth + 1e-6) << done;
        }
      });
}

TEST(TimeLeft, GoesOnBetweenTwoTilesAndNeverFallsBelowZero) {
  TimeLeft left(10, 10, Tiles(5, 2), {}, 0.04);
  for (uint32_t j = 0; j < 5; ++j) left.Commit(j, j + 1);
  EXPECT_NEAR(*left.SecondsLeft(5.5), *left.SecondsLeft(5) - 0.5, 1e-9);
  // The tile that is late may be nearly done, the others are not.
  EXPECT_NEAR(*left.SecondsLeft(500), *left.SecondsLeft(7), 1e-9);
  EXPECT_GT(*left.SecondsLeft(500), 3);
}

TEST(TimeLeft, CountsFromWhatWasThere) {
  std::vector<uint32_t> done(50), rest;
  std::iota(done.begin(), done.end(), 0u);
  TimeLeft left(100, 100, Tiles(10, 10), done, 0.04);
  EXPECT_FALSE(left.SecondsLeft(3));
  for (uint32_t j = 50; j < 75; ++j) left.Commit(j, j - 49);
  EXPECT_NEAR(*left.SecondsLeft(25), 25, 4);
}

TEST(TimeLeft, TakesAnyTiles) {
  // Without rectangles, of no size, and one that is all.
  const std::vector<PixelRect> nothing(4);
  for (TimeLeft left : {TimeLeft(4, 4, {}, {}, 0.25), TimeLeft(4, 4, nothing, {}, 0.25),
                        TimeLeft(4, 0, Tiles(2, 2), {}, 0.25)}) {
    for (uint32_t tile = 0; tile < 3; ++tile) left.Commit(tile, tile);
    EXPECT_GE(*left.SecondsLeft(3), 0);
    EXPECT_TRUE(std::isfinite(*left.SecondsLeft(3)));
  }
  TimeLeft one(1, 1, Tiles(1, 1), {}, 0.25);
  EXPECT_FALSE(one.SecondsLeft(0));
  one.Commit(0, 1);
  EXPECT_EQ(one.SecondsLeft(1), 0);
  // A frame whose cells are larger than 8 pixels.
  const std::vector<PixelRect> large = {{0, 0, 1 << 15, 1 << 14}, {0, 1 << 14, 1 << 15, 1 << 15}};
  TimeLeft huge(2, 2, large, {}, 0.04);
  huge.Commit(0, 10);
  EXPECT_NEAR(*huge.SecondsLeft(10), 10, 0.5);
}

}  // namespace
}  // namespace farpoint

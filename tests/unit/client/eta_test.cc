#include "client/eta.h"

#include <gtest/gtest.h>

#include <cmath>

namespace farpoint {
namespace {

JobStatus Status(uint32_t committed, uint32_t total, uint32_t frames = 1) {
  JobStatus status;
  status.state = committed == total ? JobState::kDone : JobState::kRendering;
  status.tiles = {.queued = total - committed, .committed = committed, .total = total};
  status.frames = {.total = frames, .baked = frames, .done = committed / (total / frames)};
  return status;
}

JobStatus In(JobState state) {
  JobStatus status;
  status.state = state;
  return status;
}

// Tells of `total` tiles, the j-th committed at time_of(j), 100 s after a bake began; calls
// `check(j, left, truth)` after each but the last.
template <typename TimeOf, typename Check>
void Play(uint32_t total, uint32_t frames, const TimeOf& time_of, const Check& check) {
  EtaEstimator eta;
  eta.Update(In(JobState::kQueued), 0);
  eta.Update(In(JobState::kBaking), 1);
  EXPECT_FALSE(eta.SecondsLeft(50)) << "a bake says nothing of tiles";
  eta.Update(Status(0, total, frames), 101);
  EXPECT_FALSE(eta.SecondsLeft(101));
  for (uint32_t j = 1; j < total; ++j) {
    eta.Update(Status(j, total, frames), 101 + time_of(j));
    const auto left = eta.SecondsLeft(101 + time_of(j));
    ASSERT_TRUE(left);
    check(j, *left, time_of(total) - time_of(j));
  }
  eta.Update(Status(total, total, frames), 101 + time_of(total));
  EXPECT_FALSE(eta.SecondsLeft(101 + time_of(total)));
}

TEST(Eta, IsCloseForTilesThatCostAlike) {
  Play(
      100, 1, [](uint32_t j) { return 0.5 * j; },
      [](uint32_t j, double left, double truth) {
        if (j >= 20) {
          EXPECT_NEAR(left, truth, 0.15 * truth + 0.01) << j;
        }
      });
}

TEST(Eta, FollowsTilesThatGrowCheaper) {
  // Half of the time is over after a third of the tiles.
  const auto time = [](uint32_t j) { return 60 * std::pow(j / 200.0, 0.63); };
  Play(200, 1, time, [&](uint32_t j, double left, double truth) {
    if (j < 40) return;
    EXPECT_NEAR(left, truth, 0.4 * truth + 0.5) << j;
    const double linear = time(j) * (200.0 - j) / j;
    EXPECT_LT(std::abs(left - truth), std::abs(linear - truth) + 1e-9) << j;
  });
}

TEST(Eta, LearnsAFramesShapeFromTheOneBefore) {
  // Ten tiles a frame: one takes half of the frame's time. The first frame takes twice as long.
  const auto within = [](uint32_t tile) { return tile < 4 ? tile * 0.5 : 5.5 + (tile - 4) * 0.5; };
  const auto time = [&](uint32_t j) {
    const uint32_t frame = j / 10, tile = j % 10;
    const double before = frame == 0 ? 0 : 17.0 + (frame - 1) * 8.5;
    return before + (frame == 0 ? 2 : 1) * within(tile) * (tile == 0 ? 0 : 1);
  };
  Play(80, 8, time, [&](uint32_t j, double left, double truth) {
    if (j >= 20) {
      EXPECT_NEAR(left, truth, 0.02 * truth + 1e-6) << j;
    }
  });
}

TEST(Eta, GoesOnBetweenTwoTilesAndNeverFallsBelowZero) {
  EtaEstimator eta;
  eta.Update(Status(0, 10), 0);
  for (uint32_t j = 1; j <= 5; ++j) eta.Update(Status(j, 10), j);
  EXPECT_NEAR(*eta.SecondsLeft(5.5), *eta.SecondsLeft(5) - 0.5, 1e-9);
  // The tile that is late may be nearly done, the others are not.
  EXPECT_NEAR(*eta.SecondsLeft(500), *eta.SecondsLeft(7), 1e-9);
  EXPECT_GT(*eta.SecondsLeft(500), 3);
}

TEST(Eta, APauseDoesNotCount) {
  EtaEstimator eta;
  eta.Update(Status(0, 10), 0);
  for (uint32_t j = 1; j <= 5; ++j) eta.Update(Status(j, 10), j);
  const double before = *eta.SecondsLeft(5);
  JobStatus paused = Status(5, 10);
  paused.state = JobState::kPaused;
  eta.Update(paused, 5);
  EXPECT_FALSE(eta.SecondsLeft(300));
  eta.Update(Status(5, 10), 1005);
  EXPECT_NEAR(*eta.SecondsLeft(1005), before, 1e-9);
}

TEST(Eta, CountsFromWhereItCameInAndAnewAfterARequeue) {
  EtaEstimator eta;
  eta.Update(Status(50, 100), 1000);
  EXPECT_FALSE(eta.SecondsLeft(1000));
  for (uint32_t j = 1; j <= 25; ++j) eta.Update(Status(50 + j, 100), 1000 + j);
  EXPECT_NEAR(*eta.SecondsLeft(1025), 25, 4);
  eta.Update(Status(0, 100), 1030);  // all of it again
  EXPECT_FALSE(eta.SecondsLeft(1030));
  for (uint32_t j = 1; j <= 50; ++j) eta.Update(Status(j, 100), 1030 + 2 * j);
  EXPECT_NEAR(*eta.SecondsLeft(1130), 100, 15);
}

}  // namespace
}  // namespace farpoint

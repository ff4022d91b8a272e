#include "core/base/clock.h"

#include <gtest/gtest.h>

namespace farpoint {
namespace {

TEST(FakeClock, MovesOnlyByHand) {
  FakeClock clock;
  const TimePoint start = clock.Now();
  EXPECT_EQ(clock.Now(), start);
  clock.Advance(std::chrono::milliseconds(1500));
  EXPECT_EQ(clock.Now() - start, std::chrono::milliseconds(1500));
}

TEST(ThreadCpuSeconds, GrowsWithWork) {
  const double start = ThreadCpuSeconds();
  volatile double sink = 0;
  for (int i = 0; i < 20'000'000; ++i) sink = sink + i;
  EXPECT_GT(ThreadCpuSeconds(), start + 1e-3);
}

}  // namespace
}  // namespace farpoint

#include "core/base/pulse.h"

#include <gtest/gtest.h>

#include <chrono>
#include <thread>

#include "core/base/executor.h"

namespace farpoint {
namespace {

TEST(Pulse, GrowsWithStepsButNotWithEachOfThem) {
  // Another period of this thread begins.
  std::this_thread::sleep_for(std::chrono::milliseconds(20));
  const uint64_t before = Pulses();
  Pulse();
  EXPECT_EQ(Pulses(), before + 1);
  constexpr int kSteps = 1'000'000;
  for (int i = 0; i < kSteps; ++i) Pulse();
  EXPECT_LT(Pulses() - before, uint64_t{kSteps} / 100);
}

TEST(Pulse, ComesFromLoopsOfOneThreadAndOfSeveral) {
  for (const unsigned threads : {1u, 2u}) {
    Executor executor(threads);
    const uint64_t before = Pulses();
    executor.ForEach(20, 1,
                     [](size_t) { std::this_thread::sleep_for(std::chrono::milliseconds(2)); });
    EXPECT_GE(Pulses() - before, 10u) << threads;
  }
}

}  // namespace
}  // namespace farpoint

#include "core/base/executor.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <atomic>
#include <chrono>
#include <mutex>
#include <set>
#include <thread>
#include <utility>
#include <vector>

namespace farpoint {
namespace {

TEST(Executor, CallsEachIndexExactlyOnce) {
  for (const unsigned threads : {1u, 2u, 5u}) {
    Executor executor(threads);
    EXPECT_EQ(executor.threads(), threads);
    for (const size_t count : {0, 1, 7, 1000, 100000}) {
      for (const size_t grain : {0, 1, 64, 1000000}) {
        std::vector<std::atomic<int>> calls(count);
        executor.ForEach(count, grain, [&](size_t i) { ++calls[i]; });
        EXPECT_TRUE(std::all_of(calls.begin(), calls.end(), [](const auto& n) { return n == 1; }))
            << threads << " threads, " << count << " indices, grain " << grain;
      }
    }
  }
}

TEST(Executor, PieceBordersDependOnThePieceOnly) {
  std::set<std::pair<size_t, size_t>> expected;
  for (size_t begin = 0; begin < 1003; begin += 100) {
    expected.insert({begin, std::min<size_t>(begin + 100, 1003)});
  }
  for (const unsigned threads : {1u, 2u, 3u, 8u}) {
    Executor executor(threads);
    std::mutex mutex;
    std::set<std::pair<size_t, size_t>> pieces;
    size_t calls = 0;
    executor.ForEachPiece(1003, 100, [&](size_t begin, size_t end) {
      const std::lock_guard lock(mutex);
      pieces.insert({begin, end});
      ++calls;
    });
    EXPECT_EQ(pieces, expected) << threads;
    EXPECT_EQ(calls, expected.size()) << threads;
  }
}

TEST(Executor, APieceOfZeroCountsAsOne) {
  Executor executor(2);
  std::atomic<size_t> sum{0};
  executor.ForEachPiece(10, 0, [&](size_t begin, size_t end) {
    EXPECT_EQ(end, begin + 1);
    sum += begin;
  });
  EXPECT_EQ(sum, 45u);
}

TEST(Executor, ZeroMeansAllUsableCores) {
  EXPECT_GE(Executor(0).threads(), 1u);
  EXPECT_LE(Executor(0).threads(), std::max(1u, std::thread::hardware_concurrency()));
}

TEST(Executor, OneThreadIsTheCallers) {
  Executor executor(1);
  const std::thread::id caller = std::this_thread::get_id();
  executor.ForEach(100, 1, [&](size_t) { EXPECT_EQ(std::this_thread::get_id(), caller); });
}

TEST(Executor, RunsAtMostThreadsBodiesAtOnce) {
  Executor executor(2);
  std::atomic<int> running{0}, most{0};
  executor.ForEach(200, 1, [&](size_t) {
    const int now = ++running;
    int seen = most;
    while (now > seen && !most.compare_exchange_weak(seen, now)) {
    }
    std::this_thread::sleep_for(std::chrono::microseconds(200));
    --running;
  });
  EXPECT_LE(most, 2);
}

}  // namespace
}  // namespace farpoint

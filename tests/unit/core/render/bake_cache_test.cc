#include "core/render/bake_cache.h"

#include <gtest/gtest.h>

#include <thread>
#include <vector>

namespace farpoint {
namespace {

Digest Key(uint64_t i) { return Sha256().UpdateU64(i).Finish(); }

TEST(BakeCache, DropsTheLeastRecentlyUsedBeyondItsLimit) {
  BakeCache cache(100);
  for (uint64_t i = 0; i < 3; ++i) cache.Put(Key(i), std::make_shared<const uint64_t>(i), 30);
  ASSERT_NE(cache.Find<uint64_t>(Key(0)), nullptr);  // used: now 1 is the oldest
  cache.Put(Key(3), std::make_shared<const uint64_t>(3), 30);
  EXPECT_EQ(cache.Find<uint64_t>(Key(1)), nullptr);
  for (const uint64_t i : {0u, 2u, 3u}) {
    const auto value = cache.Find<uint64_t>(Key(i));
    ASSERT_NE(value, nullptr) << i;
    EXPECT_EQ(*value, i);
  }
  EXPECT_EQ(cache.size_bytes(), 90u);
  // One that fills it alone drops all others, one that is larger is not kept.
  cache.Put(Key(4), std::make_shared<const uint64_t>(4), 100);
  EXPECT_EQ(cache.size_bytes(), 100u);
  cache.Put(Key(5), std::make_shared<const uint64_t>(5), 101);
  EXPECT_EQ(cache.Find<uint64_t>(Key(5)), nullptr);
  EXPECT_NE(cache.Find<uint64_t>(Key(4)), nullptr);
}

TEST(BakeCache, KeepsTheFirstValueOfAKeyAndValuesInUse) {
  BakeCache cache(10);
  cache.Put(Key(0), std::make_shared<const uint64_t>(7), 10);
  cache.Put(Key(0), std::make_shared<const uint64_t>(8), 10);
  const auto held = cache.Find<uint64_t>(Key(0));
  EXPECT_EQ(*held, 7u);
  EXPECT_EQ(cache.size_bytes(), 10u);
  cache.Put(Key(1), std::make_shared<const uint64_t>(9), 10);
  EXPECT_EQ(cache.Find<uint64_t>(Key(0)), nullptr);
  EXPECT_EQ(*held, 7u);
}

TEST(BakeCache, OfNoBytesKeepsNothing) {
  BakeCache cache(0);
  cache.Put(Key(0), std::make_shared<const uint64_t>(7), 1);
  EXPECT_EQ(cache.Find<uint64_t>(Key(0)), nullptr);
  EXPECT_EQ(cache.size_bytes(), 0u);
}

TEST(BakeCache, TakesManyThreads) {
  BakeCache cache(50);
  std::vector<std::thread> threads;
  std::atomic<int> wrong = 0;
  for (uint64_t t = 0; t < 4; ++t) {
    threads.emplace_back([&, t] {
      for (uint64_t i = 0; i < 2000; ++i) {
        const uint64_t k = (i * 7 + t) % 16;
        cache.Put(Key(k), std::make_shared<const uint64_t>(k), 10);
        if (const auto value = cache.Find<uint64_t>(Key((i + t) % 16))) {
          wrong += *value != (i + t) % 16;
        }
      }
    });
  }
  for (std::thread& thread : threads) thread.join();
  EXPECT_EQ(wrong, 0);
  EXPECT_LE(cache.size_bytes(), 50u);
}

}  // namespace
}  // namespace farpoint

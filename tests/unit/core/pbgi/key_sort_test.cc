#include "core/pbgi/key_sort.h"

#include <gtest/gtest.h>

#include <algorithm>

#include "core/math/sampling.h"

namespace farpoint {
namespace {

TEST(SortByKey, EqualsAStableSort) {
  Executor one(1), three(3);
  for (const size_t n : {0u, 1u, 2u, 100u, 4096u, 4097u, 300'000u}) {
    // All bits; few different keys; one bit; all the same.
    for (const uint64_t mask :
         {~uint64_t{0}, uint64_t{0xf0000700000003}, uint64_t{1} << 40, uint64_t{0}}) {
      BulkVector<KeyedIndex> items(n);
      for (size_t i = 0; i < n; ++i) {
        items[i] = {HashKey(n, i) & mask, static_cast<uint32_t>(i)};
      }
      BulkVector<KeyedIndex> expected = items, other = items;
      std::stable_sort(expected.begin(), expected.end(),
                       [](const KeyedIndex& a, const KeyedIndex& b) { return a.key < b.key; });
      SortByKey(items, one);
      SortByKey(other, three);
      for (size_t i = 0; i < n; ++i) {
        ASSERT_EQ(items[i].key, expected[i].key);
        ASSERT_EQ(items[i].index, expected[i].index);
        ASSERT_EQ(other[i].index, expected[i].index);
      }
    }
  }
}

}  // namespace
}  // namespace farpoint

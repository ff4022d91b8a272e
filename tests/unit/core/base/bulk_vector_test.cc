#include "core/base/bulk_vector.h"

#include <gtest/gtest.h>

#include <cstdint>
#include <numeric>

namespace farpoint {
namespace {

TEST(BulkVector, HoldsSmallAndLarge) {
  // Around the size from which on pages are its own, and a whole number of huge pages.
  for (const size_t bytes : {size_t{1}, size_t{1000}, (size_t{4} << 20) - 4, size_t{4} << 20,
                             (size_t{4} << 20) + 4, size_t{6} << 20, (size_t{6} << 20) + 4096}) {
    BulkVector<uint32_t> v((bytes + 3) / 4);
    EXPECT_EQ(reinterpret_cast<uintptr_t>(v.data()) % 64, 0u);
    std::iota(v.begin(), v.end(), 7u);
    BulkVector<uint32_t> copy = v;
    v.push_back(1);
    copy.push_back(1);
    EXPECT_EQ(v, copy);
    EXPECT_EQ(v.front(), 7u);
    EXPECT_EQ(v[v.size() - 2], 6u + static_cast<uint32_t>(v.size() - 1));
    const uint32_t* const data = v.data();
    const BulkVector<uint32_t> moved = std::move(v);
    EXPECT_EQ(moved.data(), data);
    EXPECT_EQ(moved, copy);
  }
}

TEST(BulkVector, ValuesThatAreGivenAreSet) {
  const BulkVector<uint64_t> v(1'000'000, 5u);
  for (const uint64_t x : v) ASSERT_EQ(x, 5u);
  BulkVector<uint64_t> w(10, 1u);
  w.resize(2'000'000, 3u);
  EXPECT_EQ(w[9], 1u);
  EXPECT_EQ(w[10], 3u);
  EXPECT_EQ(w.back(), 3u);
}

}  // namespace
}  // namespace farpoint

#include "worker/fingerprint.h"

#include <gtest/gtest.h>

namespace farpoint {
namespace {

TEST(Fingerprint, IsTheSameForAnyNumberOfThreads) {
  Executor one(1), three(3);
  const auto a = ComputeFingerprint(one), b = ComputeFingerprint(three);
  ASSERT_TRUE(a.ok()) << a.status();
  ASSERT_TRUE(b.ok()) << b.status();
  EXPECT_EQ(a->Hex(), b->Hex());
  EXPECT_FALSE(a->empty());
}

}  // namespace
}  // namespace farpoint

#include "core/accel/accel_version.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

namespace farpoint {
namespace {

TEST(AccelVersion, NamesOneOfTheSupportedEmbrees) {
  const auto version = AccelVersion();
  ASSERT_TRUE(version.ok()) << version.status();
  EXPECT_THAT(*version, testing::MatchesRegex("embree (3\\.1[3-9]|4)\\.[0-9]+(\\.[0-9]+)?"));
  EXPECT_EQ(*AccelVersion(), *version);
}

}  // namespace
}  // namespace farpoint

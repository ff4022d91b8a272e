#include "core/base/nearest_name.h"

#include <gtest/gtest.h>

#include <vector>

namespace farpoint {
namespace {

TEST(EditDistance, CountsInsertionsRemovalsReplacementsAndSwaps) {
  EXPECT_EQ(EditDistance("", ""), 0);
  EXPECT_EQ(EditDistance("abc", "abc"), 0);
  EXPECT_EQ(EditDistance("", "abc"), 3);
  EXPECT_EQ(EditDistance("abc", "ab"), 1);
  EXPECT_EQ(EditDistance("abc", "axc"), 1);
  EXPECT_EQ(EditDistance("resolutoin", "resolution"), 1);
  EXPECT_EQ(EditDistance("kitten", "sitting"), 3);
}

TEST(EditDistance, IsSymmetric) {
  EXPECT_EQ(EditDistance("--points", "--splat"), EditDistance("--splat", "--points"));
}

TEST(NearestName, FindsTheTypingError) {
  const std::vector<std::string> known = {"--resolution", "--crop", "--points", "--paths"};
  EXPECT_EQ(NearestName("--resolutoin", known), "--resolution");
  EXPECT_EQ(NearestName("--point", known), "--points");
  EXPECT_EQ(NearestName("--pahts", known), "--paths");
}

TEST(NearestName, TakesAnAbbreviationForItsWord) {
  const std::vector<std::string> known = {"--sky", "--resolution"};
  EXPECT_EQ(NearestName("--res", known), "--resolution");
}

TEST(NearestName, SuggestsNothingWhereNothingIsNear) {
  const std::vector<std::string> known = {"--resolution", "--light-samples"};
  EXPECT_EQ(NearestName("--foo", known), "");
  EXPECT_EQ(NearestName("anything", {}), "");
}

}  // namespace
}  // namespace farpoint

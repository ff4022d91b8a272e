#include "client/frame_range.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <algorithm>
#include <random>
#include <set>

namespace farpoint {
namespace {

using testing::ElementsAre;
using testing::HasSubstr;

std::vector<int32_t> Parse(std::string_view text) {
  const auto frames = ParseFrameRange(text);
  EXPECT_TRUE(frames.ok()) << frames.status();
  return frames.ok() ? *frames : std::vector<int32_t>();
}

TEST(FrameRange, NamesFramesRangesAndSteps) {
  EXPECT_THAT(Parse("7"), ElementsAre(7));
  EXPECT_THAT(Parse("0-3"), ElementsAre(0, 1, 2, 3));
  EXPECT_THAT(Parse("1-10x2,15"), ElementsAre(1, 3, 5, 7, 9, 15));
  EXPECT_THAT(Parse("1-10x100"), ElementsAre(1));
  EXPECT_THAT(Parse(" 3 , 5-6 "), ElementsAre(3, 5, 6));
  EXPECT_THAT(Parse("007-009"), ElementsAre(7, 8, 9));
}

TEST(FrameRange, RunsDownwardsToo) {
  EXPECT_THAT(Parse("3-1"), ElementsAre(3, 2, 1));
  EXPECT_THAT(Parse("10-1x4"), ElementsAre(10, 6, 2));
}

TEST(FrameRange, KnowsFramesBeforeTheFirst) {
  EXPECT_THAT(Parse("-1"), ElementsAre(-1));
  EXPECT_THAT(Parse("-2-1"), ElementsAre(-2, -1, 0, 1));
  EXPECT_THAT(Parse("-5--3"), ElementsAre(-5, -4, -3));
  EXPECT_THAT(Parse("1--3x2"), ElementsAre(1, -1, -3));
  EXPECT_THAT(Parse("-2147483648"), ElementsAre(INT32_MIN));
}

TEST(FrameRange, NamesNoFrameTwiceAndKeepsTheOrder) {
  EXPECT_THAT(Parse("5,1-6,5,6"), ElementsAre(5, 1, 2, 3, 4, 6));
  EXPECT_THAT(Parse("1-9x2,1-9x3"), ElementsAre(1, 3, 5, 7, 9, 4));
  EXPECT_THAT(Parse("2-2"), ElementsAre(2));
}

TEST(FrameRange, ReachesTheLastNumberThereIs) {
  EXPECT_THAT(Parse("2147483646-2147483647"), ElementsAre(2147483646, 2147483647));
  EXPECT_THAT(Parse("2147483647-0x2147483647"), ElementsAre(2147483647, 0));
  EXPECT_THAT(Parse("2147483640-2147483647x5"), ElementsAre(2147483640, 2147483645));
}

TEST(FrameRange, RefusesEverythingElse) {
  for (const char* text : {"",
                           ",",
                           "1,",
                           ",1",
                           "1,,2",
                           "a",
                           "1-",
                           "-",
                           "1---2",
                           "1-2-3",
                           "1x2",
                           "1-5x",
                           "1-5x0",
                           "1-5x-1",
                           "1-5:2",
                           "1 - 5",
                           "1.5",
                           "2147483648",
                           "1-2147483648",
                           "1-5x2147483648",
                           "99999999999999999999",
                           "+1",
                           "1-10X2",
                           "1..5",
                           "#"}) {
    const auto frames = ParseFrameRange(text);
    EXPECT_TRUE(absl::IsInvalidArgument(frames.status())) << "'" << text << "'";
    EXPECT_THAT(std::string(frames.status().message()), HasSubstr("e.g. 1-10x2,15"));
  }
  EXPECT_THAT(std::string(ParseFrameRange("1,x-3,5").status().message()), HasSubstr("'x-3'"));
}

TEST(FrameRange, BoundsTheirNumberBeforeItMakesThem) {
  EXPECT_EQ(Parse("0-99999").size(), kMaxFrames);
  EXPECT_EQ(Parse("0-99999,5-70000").size(), kMaxFrames) << "repeated ones do not count";
  for (const char* text :
       {"0-100000", "-2147483648-2147483647", "0-99999,100000", "0-60000,90000-150000"}) {
    const auto frames = ParseFrameRange(text);
    EXPECT_THAT(std::string(frames.status().message()), HasSubstr("more than 100000")) << text;
  }
}

TEST(FrameRange, TheTextOfFramesNamesThem) {
  EXPECT_EQ(FrameRangeText({}), "");
  EXPECT_EQ(FrameRangeText(std::vector<int32_t>{4}), "4");
  EXPECT_EQ(FrameRangeText(std::vector<int32_t>{1, 2, 3, 7}), "1-3,7");
  EXPECT_EQ(FrameRangeText(std::vector<int32_t>{1, 3, 5, 7, 9, 15}), "1-9x2,15");
  EXPECT_EQ(FrameRangeText(std::vector<int32_t>{9, 8, 7}), "9-7");
  EXPECT_EQ(FrameRangeText(std::vector<int32_t>{1, 5, 6, 7}), "1,5-7");
}

TEST(FrameRange, TextAndFramesAreInverse) {
  std::mt19937 random(1);
  for (int round = 0; round < 500; ++round) {
    std::vector<int32_t> frames(1 + random() % 12);
    const uint32_t span = round % 2 == 0 ? 16 : 0x7fffffff;
    for (int32_t& frame : frames) frame = static_cast<int32_t>(random() % span) - 8;
    std::set<int32_t> seen;
    std::erase_if(frames, [&](int32_t frame) { return !seen.insert(frame).second; });
    EXPECT_EQ(Parse(FrameRangeText(frames)), frames) << FrameRangeText(frames);
  }
}

}  // namespace
}  // namespace farpoint

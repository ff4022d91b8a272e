#include "client/frame_path.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

namespace farpoint {
namespace {

using testing::HasSubstr;

std::string For(std::string_view path, int32_t frame) {
  const auto parsed = FramePath::Parse(path);
  EXPECT_TRUE(parsed.ok()) << parsed.status();
  return parsed.ok() ? parsed->For(frame) : "";
}

TEST(FramePath, FillsHashesAndPrintfs) {
  EXPECT_EQ(For("out.####.exr", 7), "out.0007.exr");
  EXPECT_EQ(For("out.#.exr", 7), "out.7.exr");
  EXPECT_EQ(For("######.exr", 42), "000042.exr");
  EXPECT_EQ(For("out.%04d.exr", 7), "out.0007.exr");
  EXPECT_EQ(For("out.%d.exr", 7), "out.7.exr");
  EXPECT_EQ(For("shot_%02d_beauty.exr", 0), "shot_00_beauty.exr");
}

TEST(FramePath, LargerNumbersTakeMoreDigits) {
  EXPECT_EQ(For("o.##.exr", 12345), "o.12345.exr");
  EXPECT_EQ(For("o.%02d.exr", 2147483647), "o.2147483647.exr");
  EXPECT_EQ(For("o.####.exr", -7), "o.-007.exr");
  EXPECT_EQ(For("o.%016d.exr", 1), "o.0000000000000001.exr");
}

TEST(FramePath, LeavesFoldersAndOtherNamesAlone) {
  EXPECT_EQ(For("/shots/#12/%d/out.##.exr", 3), "/shots/#12/%d/out.03.exr");
  for (const char* name :
       {"out.exr", "a/b.exr", "50%.exr", "%x.exr", "%4d.exr", "%0d.exr", "%", "/#/out.exr", ""}) {
    const auto path = FramePath::Parse(name);
    ASSERT_TRUE(path.ok()) << name;
    EXPECT_FALSE(path->has_place()) << name;
    EXPECT_EQ(path->For(9), name);
  }
  EXPECT_TRUE(FramePath::Parse("a.#.exr")->has_place());
}

TEST(FramePath, RefusesTwoPlacesAndAbsurdWidths) {
  for (const char* name : {"a.##.##.exr", "a.#.%d.exr", "%d%d.exr"}) {
    EXPECT_THAT(std::string(FramePath::Parse(name).status().message()), HasSubstr("two places"))
        << name;
  }
  EXPECT_TRUE(absl::IsInvalidArgument(FramePath::Parse("#################.exr").status()));
  EXPECT_TRUE(absl::IsInvalidArgument(FramePath::Parse("%099999999999999999999d.exr").status()));
}

}  // namespace
}  // namespace farpoint

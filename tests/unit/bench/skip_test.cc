#include "bench/skip.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <algorithm>
#include <nlohmann/json.hpp>
#include <sstream>
#include <string>

#include "bench/program.h"
#include "bench/skip_report.h"
#include "tests/unit/bench/temp_folder.h"

namespace farpoint {
namespace {

using ::testing::HasSubstr;
using ::testing::IsEmpty;

void Ignore(std::string_view) {}

class SkipCase : public testing::TestWithParam<std::string> {};

// The quick form of `farpoint-bench skip`: bits, errors and counters.
TEST_P(SkipCase, KeepsItsPromises) {
  SkipOptions options;
  options.quick = true;
  options.cases = {GetParam()};
  const auto report = RunSkip(options, Ignore);
  ASSERT_TRUE(report.ok()) << report.status();
  ASSERT_EQ(report->rows.size(), 1u);
  const SkipRow& row = report->rows.front();
  EXPECT_EQ(row.name, GetParam());
  EXPECT_THAT(row.failures(), IsEmpty());
  ASSERT_FALSE(row.sides.empty());
  EXPECT_TRUE(row.sides.front().profits);
  for (const SkipSide& side : row.sides) {
    EXPECT_GT(side.without_s, 0) << side.scene;
    // Where there is nothing to leave out, next to nothing is.
    if (!side.profits) {
      EXPECT_LE(side.skipped, row.sides.front().skipped) << side.scene;
    }
  }
}

INSTANTIATE_TEST_SUITE_P(Quick, SkipCase, testing::ValuesIn(SkipNames()), [](const auto& info) {
  std::string name = info.param;
  std::replace(name.begin(), name.end(), '-', '_');
  return name;
});

TEST(SkipRow, FailsByBitsErrorsAndCounters) {
  SkipRow row;
  row.counter = "textures";
  row.sides.resize(2);
  row.sides[0].profits = true;
  row.sides[0].skipped = 3;
  EXPECT_THAT(row.failures(), IsEmpty());
  row.sides[1].bits_equal = false;
  EXPECT_EQ(row.failures().size(), 1u);
  row.exact = false;
  row.rr_bar = 0.1;
  row.sides[1].rr = 0.05;
  EXPECT_THAT(row.failures(), IsEmpty());
  row.sides[1].rr = 0.2;
  EXPECT_EQ(row.failures().size(), 1u);
  row.sides[0].skipped = 0;
  EXPECT_EQ(row.failures().size(), 2u);
}

TEST(Skip, UnknownCasesAreRefused) {
  SkipOptions options;
  options.cases = {"textures", "nothing"};
  const auto report = RunSkip(options, Ignore);
  EXPECT_EQ(report.status().code(), absl::StatusCode::kInvalidArgument);
  EXPECT_THAT(std::string(report.status().message()), HasSubstr("hidden-nodes"));
}

TEST(Skip, LeavesItsReports) {
  const TempFolder folder;
  std::ostringstream out, err;
  EXPECT_EQ(RunBench({"skip", "--quick", "--case", "environment", "--case", "bake-stages", "-o",
                      folder / "out"},
                     out, err),
            0)
      << err.str();
  EXPECT_THAT(out.str(), HasSubstr("same bits"));
  const auto json = nlohmann::json::parse(ReadText(folder / "out/skip.json"));
  EXPECT_EQ(json["failures"], 0);
  ASSERT_EQ(json["rows"].size(), 2u);
  EXPECT_EQ(json["rows"][0]["counter"], "environment_terms");
  EXPECT_GT(json["rows"][0]["sides"][0]["skipped"], 0);
  EXPECT_EQ(json["rows"][0]["sides"][1]["skipped"], 0);
  EXPECT_EQ(json["rows"][1]["sides"][0]["skipped"], 3);
  EXPECT_THAT(ReadText(folder / "out/skip.html"), HasSubstr("</html>"));
}

}  // namespace
}  // namespace farpoint

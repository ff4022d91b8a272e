#include "bench/figures.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cmath>
#include <filesystem>
#include <map>
#include <nlohmann/json.hpp>

#include "tests/unit/bench/temp_folder.h"

namespace farpoint {
namespace {

TEST(Figures, AreWrittenWithTheirErrorsAndTimes) {
  const TempFolder folder;
  FiguresOptions options;
  options.quick = true;
  options.threads = 2;
  const auto report = RunFigures(options, folder.path().string(), [](std::string_view) {});
  ASSERT_TRUE(report.ok()) << report.status();
  EXPECT_THAT(report->files,
              testing::ElementsAre("surfels.png", "clusters.png", "cut.png", "microbuffers.png",
                                   "layers.png", "parameter-quality.png", "parameter-clusters.png",
                                   "parameter-epsilon.png", "parameter-microbuffer.png",
                                   "parameter-points.png", "bounces.png", "ambient-occlusion.png"));
  for (const std::string& file : report->files) {
    EXPECT_GT(std::filesystem::file_size(folder.path() / file), 500u) << file;
  }
  std::map<std::string, std::map<std::string, FigureRow>> rows;
  for (const FigureRow& row : report->rows) {
    rows[row.parameter][row.value] = row;
    EXPECT_GT(row.gather_s, 0) << row.parameter << row.value;
    EXPECT_GE(row.rr, 0) << row.parameter << row.value;
    EXPECT_LT(row.rr, 0.5) << row.parameter << row.value;
    EXPECT_LT(std::abs(row.bias), 0.1) << row.parameter << row.value;
  }
  EXPECT_GT(report->noise, 0);
  EXPECT_LT(report->noise, 0.2);
  // What the pictures shall show.
  EXPECT_LT(rows["--microbuffer"]["32"].rr, rows["--microbuffer"]["8"].rr);
  const auto json = nlohmann::json::parse(FiguresJson(*report));
  EXPECT_EQ(json["rows"].size(), report->rows.size());
  EXPECT_THAT(FiguresTables(*report), testing::HasSubstr("| `--epsilon` |"));
}

}  // namespace
}  // namespace farpoint

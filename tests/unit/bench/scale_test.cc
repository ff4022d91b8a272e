#include "bench/scale.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <nlohmann/json.hpp>

#include "bench/scale_report.h"

namespace farpoint {
namespace {

using ::testing::HasSubstr;

const absl::StatusOr<ScaleReport>& TinyReport() {
  static const absl::StatusOr<ScaleReport> report = [] {
    ScaleOptions options;
    options.quick = true;
    options.scene = "cornell";
    options.width = options.height = 32;
    options.points = 500;
    options.clusters = 8;
    options.reference_budget_s = 0.05;
    options.threads = 2;
    return RunScale(options, [](std::string_view) {});
  }();
  return report;
}

TEST(Scale, MeasuresEveryFrameNumberOfSurfelsAndThreads) {
  ASSERT_TRUE(TinyReport().ok()) << TinyReport().status();
  const ScaleReport& r = *TinyReport();
  ASSERT_EQ(r.bakes.size(), 4u);
  ASSERT_EQ(r.frames.size(), 6u);
  const uint64_t points[] = {500, 500, 2000, 8000};
  for (size_t i = 0; i < 4; ++i) {
    const ScaleBake& b = r.bakes[i];
    EXPECT_EQ(b.points, points[i]);
    EXPECT_EQ(b.threads, i == 1 ? 1u : 2u);
    EXPECT_NEAR(static_cast<double>(b.surfels), static_cast<double>(b.points),
                0.2 * static_cast<double>(b.points));
    EXPECT_GT(b.thread_s(), 0);
    EXPECT_GT(b.bytes_per_surfel(), 20);
    EXPECT_LT(b.bytes_per_surfel(), 30);
  }
  const int widths[] = {8, 16, 32, 16, 16, 16};
  for (size_t i = 0; i < 6; ++i) {
    const ScaleFrame& f = r.frames[i];
    EXPECT_EQ(f.width, widths[i]);
    EXPECT_EQ(f.threads, i == 3 ? 1u : 2u);
    EXPECT_GT(f.receivers, 0u);
    EXPECT_GT(f.gather.median, 0);
    EXPECT_GE(f.gather.median, f.per_cluster.median);
    EXPECT_GT(f.error.pixels, 0u);
    EXPECT_GT(f.error.rr, 0);
    EXPECT_LT(f.error.rr, 2);
  }
  // One thread and two: the same bits.
  EXPECT_EQ(r.frames[1].hash, r.frames[3].hash);
  EXPECT_EQ(r.bakes[0].tree_hash, r.bakes[1].tree_hash);
  EXPECT_NE(r.frames[1].hash, r.frames[4].hash);
}

ScaleFrame Frame(int side, uint64_t points, unsigned threads, double per_cluster, double gather) {
  ScaleFrame f;
  f.width = f.height = side;
  f.points = points;
  f.threads = threads;
  f.per_cluster = {per_cluster, per_cluster, per_cluster};
  f.gather = {gather, gather, gather};
  return f;
}
ScaleBake Prepared(uint64_t points, unsigned threads, double seconds) {
  ScaleBake b;
  b.points = points;
  b.threads = threads;
  b.seconds[static_cast<size_t>(Stage::kSample)] = seconds / 2;
  b.seconds[static_cast<size_t>(Stage::kTree)] = seconds / 2;
  b.seconds[static_cast<size_t>(Stage::kImport)] = 100;  // does not count
  return b;
}

TEST(Scale, GrowthIsTheRatioToTheFrameThatItGrewFrom) {
  ScaleReport r;
  r.bakes = {Prepared(10, 2, 1), Prepared(10, 1, 0.8), Prepared(40, 2, 4), Prepared(160, 2, 18)};
  r.frames = {Frame(8, 10, 2, 1, 2),     Frame(16, 10, 2, 1.3, 3), Frame(32, 10, 2, 1.5, 7),
              Frame(16, 10, 1, 1.25, 2), Frame(16, 40, 2, 2.6, 6), Frame(16, 160, 2, 3.9, 4.5)};
  const std::vector<ScaleGrowth> g = GrowthOf(r);
  ASSERT_EQ(g.size(), 5u);
  EXPECT_EQ(g[0].axis, "pixels");
  EXPECT_EQ(g[0].from, "8x8");
  EXPECT_EQ(g[0].to, "16x16");
  EXPECT_EQ(g[0].factor, 4);
  EXPECT_EQ(g[0].per_cluster, 1.3);
  EXPECT_EQ(g[0].gather, 1.5);
  EXPECT_EQ(g[0].preparation, 0);
  EXPECT_EQ(g[1].from, "16x16");
  EXPECT_NEAR(g[1].gather, 7.0 / 3, 1e-12);
  EXPECT_EQ(g[2].axis, "threads");
  EXPECT_EQ(g[2].factor, 2);
  EXPECT_EQ(g[2].gather, 1.5);
  EXPECT_EQ(g[2].preparation, 1.25);
  EXPECT_EQ(g[3].axis, "surfels");
  EXPECT_EQ(g[3].factor, 4);
  EXPECT_EQ(g[3].gather, 2);
  EXPECT_EQ(g[3].preparation, 4);
  EXPECT_EQ(g[4].to, "160");
  EXPECT_EQ(g[4].gather, 1.5);
  EXPECT_EQ(g[4].preparation, 18);
  EXPECT_TRUE(GrowthOf(ScaleReport()).empty());
}

TEST(Scale, ReportsSayWhatWasMeasured) {
  ASSERT_TRUE(TinyReport().ok()) << TinyReport().status();
  const auto json = nlohmann::json::parse(ScaleJson(*TinyReport()));
  EXPECT_EQ(json["benchmark"], "scale");
  EXPECT_EQ(json["settings"]["scene"], "cornell");
  EXPECT_EQ(json["bakes"].size(), 4u);
  EXPECT_EQ(json["frames"].size(), 6u);
  EXPECT_EQ(json["growth"].size(), 5u);
  EXPECT_TRUE(json["growth"][0]["preparation"].is_null());
  EXPECT_GT(json["growth"][4]["preparation"], 0);
  const std::string table = ScaleTable(*TinyReport());
  EXPECT_THAT(table, HasSubstr("bytes/surfel"));
  EXPECT_THAT(table, HasSubstr("32x32"));
  EXPECT_THAT(ScaleHtml(*TinyReport()), HasSubstr("</html>"));
}

TEST(Scale, RefusesFramesThatCannotBeHalvedTwice) {
  ScaleOptions options;
  options.quick = true;
  options.width = 30;
  options.height = 32;
  const auto report = RunScale(options, [](std::string_view) {});
  EXPECT_EQ(report.status().code(), absl::StatusCode::kInvalidArgument);
  EXPECT_THAT(std::string(report.status().message()), HasSubstr("--resolution 30x32"));
}

TEST(Scale, NamesASceneThatIsNotThere) {
  ScaleOptions options;
  options.quick = true;
  options.scene = "sponza";
  options.scenes_dir = "/nowhere";
  const auto report = RunScale(options, [](std::string_view) {});
  EXPECT_EQ(report.status().code(), absl::StatusCode::kInvalidArgument);
  EXPECT_THAT(std::string(report.status().message()), HasSubstr("--scenes"));
}

}  // namespace
}  // namespace farpoint

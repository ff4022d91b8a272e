#include "proto/metrics_text.h"

#include <gtest/gtest.h>

#include <limits>

namespace farpoint {
namespace {

TEST(MetricsText, EscapesLabelsAndHelp) {
  MetricsText text;
  text.Family("a_total", "counter", "Of \\ and\nlines.");
  text.Sample(0.5, {{"x", "say \"\\n\"\n"}, {"y", ""}});
  EXPECT_EQ(text.Take(),
            "# HELP a_total Of \\\\ and\\nlines.\n# TYPE a_total counter\n"
            "a_total{x=\"say \\\"\\\\n\\\"\\n\",y=\"\"} 0.5\n");
}

TEST(MetricsText, HistogramsAddUp) {
  DurationHistogram histogram;
  histogram.Observe(0.005);  // bounds belong to their bucket
  histogram.Observe(1.5);
  histogram.Observe(1e9);
  histogram.Observe(std::numeric_limits<double>::quiet_NaN());
  histogram.Observe(-1);
  MetricsText text;
  text.Family("h_seconds", "histogram", "Some.");
  text.Histogram(histogram.Read());
  const std::string lines = text.Take();
  EXPECT_NE(lines.find("h_seconds_bucket{le=\"0.005\"} 3\n"), std::string::npos) << lines;
  EXPECT_NE(lines.find("h_seconds_bucket{le=\"1\"} 3\n"), std::string::npos) << lines;
  EXPECT_NE(lines.find("h_seconds_bucket{le=\"2\"} 4\n"), std::string::npos) << lines;
  EXPECT_NE(lines.find("h_seconds_bucket{le=\"600\"} 4\n"), std::string::npos) << lines;
  EXPECT_NE(lines.find("h_seconds_bucket{le=\"+Inf\"} 5\n"), std::string::npos) << lines;
  EXPECT_NE(lines.find("h_seconds_count 5\n"), std::string::npos) << lines;
}

}  // namespace
}  // namespace farpoint

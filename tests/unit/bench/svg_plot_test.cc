#include "bench/svg_plot.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cmath>
#include <limits>
#include <regex>

namespace farpoint {
namespace {

using ::testing::HasSubstr;
using ::testing::Not;

struct Circle {
  double x, y;
};

// Of the points alone: the legend's circles have no outline.
std::vector<Circle> PointsOf(const std::string& svg) {
  const std::regex circle("<circle cx='([0-9.]+)' cy='([0-9.]+)' r='[0-9.]+' fill='[^']+' stroke=");
  std::vector<Circle> circles;
  for (std::sregex_iterator i(svg.begin(), svg.end(), circle), end; i != end; ++i) {
    circles.push_back({std::stod((*i)[1]), std::stod((*i)[2])});
  }
  return circles;
}

LogLogPlot PlotOf(std::vector<PlotPoint> points) {
  LogLogPlot plot;
  plot.x_label = "time";
  plot.y_label = "error";
  plot.series.push_back({"pt", "#123456", std::move(points)});
  return plot;
}

TEST(SvgPlot, EqualRatiosAreEqualDistances) {
  const auto c = PointsOf(RenderSvg(PlotOf({{1, 0.4}, {4, 0.2}, {16, 0.1}}), nullptr));
  ASSERT_EQ(c.size(), 3u);
  EXPECT_NEAR(c[1].x - c[0].x, c[2].x - c[1].x, 0.21);
  EXPECT_NEAR(c[1].y - c[0].y, c[2].y - c[1].y, 0.21);
  EXPECT_GT(c[1].x, c[0].x);
  EXPECT_GT(c[1].y, c[0].y);  // less error is lower
}

TEST(SvgPlot, PointsLieInsideWhateverTheirRange) {
  for (const double scale : {1e-12, 1e-3, 1.0, 1e9}) {
    const auto c = PointsOf(RenderSvg(
        PlotOf({{scale, scale}, {1.0001 * scale, 1e6 * scale}, {scale * 1e6, scale}}), nullptr));
    ASSERT_EQ(c.size(), 3u);
    for (const Circle& p : c) {
      EXPECT_GE(p.x, 0);
      EXPECT_LE(p.x, 880);
      EXPECT_GE(p.y, 0);
      EXPECT_LE(p.y, 520);
    }
  }
}

TEST(SvgPlot, OnePointHasAPlace) {
  EXPECT_EQ(PointsOf(RenderSvg(PlotOf({{1, 1}}), nullptr)).size(), 1u);
}

TEST(SvgPlot, WhatALogarithmDoesNotHaveIsCountedAndLeftOut) {
  const double nan = std::numeric_limits<double>::quiet_NaN();
  const double inf = std::numeric_limits<double>::infinity();
  int left_out = -1;
  const std::string svg =
      RenderSvg(PlotOf({{1, 1}, {0, 1}, {1, 0}, {-1, 1}, {nan, 1}, {1, inf}}), &left_out);
  EXPECT_EQ(left_out, 5);
  EXPECT_EQ(PointsOf(svg).size(), 1u);
  EXPECT_THAT(svg, Not(HasSubstr("nan")));
  EXPECT_THAT(svg, Not(HasSubstr("inf")));
}

TEST(SvgPlot, AnEmptyPlotIsAPlot) {
  int left_out = -1;
  const std::string svg = RenderSvg(PlotOf({}), &left_out);
  EXPECT_EQ(left_out, 0);
  EXPECT_THAT(svg, HasSubstr("</svg>"));
}

TEST(SvgPlot, LineJoinsItsPointsByTime) {
  std::vector<PlotPoint> points = {{4, 0.1}, {1, 0.4}, {2, 0.9}};
  points[0].on_line = points[1].on_line = true;
  const std::string svg = RenderSvg(PlotOf(points), nullptr);
  const auto c = PointsOf(svg);
  ASSERT_EQ(c.size(), 3u);
  std::smatch line;
  ASSERT_TRUE(std::regex_search(svg, line,
                                std::regex("points='([0-9.]+),([0-9.]+) ([0-9.]+),([0-9.]+) '")));
  EXPECT_DOUBLE_EQ(std::stod(line[1]), c[1].x);
  EXPECT_DOUBLE_EQ(std::stod(line[3]), c[0].x);
}

TEST(SvgPlot, TextsAreEscaped) {
  LogLogPlot plot = PlotOf({{1, 1, 0, 0, "<script>&\"'"}});
  plot.series[0].name = "a<b";
  const std::string svg = RenderSvg(plot, nullptr);
  EXPECT_THAT(svg, Not(HasSubstr("<script>")));
  EXPECT_THAT(svg, HasSubstr("&lt;script&gt;&amp;&quot;&#39;"));
  EXPECT_THAT(svg, HasSubstr("a&lt;b"));
}

TEST(SvgPlot, LevelIsDrawnWhereItHasAPlace) {
  LogLogPlot plot = PlotOf({{1, 0.1}, {2, 0.5}});
  plot.level = {0.2, "noise"};
  EXPECT_THAT(RenderSvg(plot, nullptr), HasSubstr(">noise<"));
  plot.level->y = 1e-6;
  EXPECT_THAT(RenderSvg(plot, nullptr), Not(HasSubstr(">noise<")));
}

}  // namespace
}  // namespace farpoint

// Plots with two logarithmic axes, as SVG that can stand inside an HTML page: no script, no font,
// no file beside it.
#pragma once

#include <optional>
#include <string>
#include <string_view>
#include <vector>

namespace farpoint {

struct PlotPoint {
  double x = 0, y = 0;
  double x_min = 0, x_max = 0;  // drawn as a bar if they are positive and differ
  std::string title;            // shown while the mouse rests on the point
  bool hollow = false;          // drawn as a ring
  bool on_line = false;         // the series' line goes through it
};
struct PlotSeries {
  std::string name;
  std::string color;  // of SVG
  std::vector<PlotPoint> points;
};
// A dashed line across the plot.
struct PlotLevel {
  double y = 0;
  std::string name;
};
struct LogLogPlot {
  std::string x_label, y_label;
  std::vector<PlotSeries> series;
  std::optional<PlotLevel> level;  // not drawn below or above the points' decades
};

// Points that are not finite and positive have no place on such axes: they are left out, and
// `left_out` (may be null) gets their number. Texts are escaped.
std::string RenderSvg(const LogLogPlot& plot, int* left_out);

// & < > " ' as entities.
std::string EscapeXml(std::string_view text);

}  // namespace farpoint

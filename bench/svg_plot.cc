#include "bench/svg_plot.h"

#include <algorithm>
#include <cmath>
#include <limits>

#include "absl/strings/str_format.h"
#include "bench/text.h"

namespace farpoint {

namespace {

// In SVG user units.
constexpr double kWidth = 880, kHeight = 520;
constexpr double kLeft = 76, kRight = 150, kTop = 20, kBottom = 58;
constexpr double kRadius = 4.5;

bool HasPlace(const PlotPoint& p) {
  return std::isfinite(p.x) && std::isfinite(p.y) && p.x > 0 && p.y > 0;
}

// Positions along one axis: low and high are ends in log10, first and last in user units.
struct Axis {
  double low = 0, high = 1, first = 0, last = 1;

  double At(double value) const {
    return first + (std::log10(value) - low) / (high - low) * (last - first);
  }
};

// Widened to the next 1, 2 or 5 at both ends.
void Widen(double min, double max, Axis& axis) {
  static constexpr double kSteps[] = {1, 2, 5, 10};
  const double low_decade = std::pow(10.0, std::floor(std::log10(min)));
  double low = low_decade;
  for (const double s : kSteps) {
    if (s * low_decade < min) low = s * low_decade;
  }
  const double high_decade = std::pow(10.0, std::floor(std::log10(max)));
  double high = 10 * high_decade;
  for (int i = 3; i >= 0; --i) {
    if (kSteps[i] * high_decade > max) high = kSteps[i] * high_decade;
  }
  axis.low = std::log10(low);
  axis.high = std::log10(high);
}

// The 1, 2 and 5 of every decade of the axis; only the 1 if there are many decades.
std::vector<double> Ticks(const Axis& axis) {
  std::vector<double> ticks;
  constexpr double kSlack = 1e-9;
  for (int d = static_cast<int>(std::floor(axis.low)); d <= std::ceil(axis.high); ++d) {
    for (const double s : {1.0, 2.0, 5.0}) {
      if (s != 1.0 && axis.high - axis.low > 3.5) continue;
      const double value = s * std::pow(10.0, d);
      const double at = std::log10(value);
      if (at >= axis.low - kSlack && at <= axis.high + kSlack) ticks.push_back(value);
    }
  }
  return ticks;
}

std::string Line(double x0, double y0, double x1, double y1, std::string_view attributes) {
  return absl::StrFormat("<line x1='%.1f' y1='%.1f' x2='%.1f' y2='%.1f' %s/>\n", x0, y0, x1, y1,
                         attributes);
}

std::string Text(double x, double y, std::string_view attributes, std::string_view text) {
  return absl::StrFormat("<text x='%.1f' y='%.1f' %s>%s</text>\n", x, y, attributes,
                         EscapeXml(text));
}

std::string Point(const PlotPoint& p, const std::string& color, const Axis& ax, const Axis& ay) {
  const double x = ax.At(p.x), y = ay.At(p.y);
  std::string svg = Concat({"<g><title>", EscapeXml(p.title), "</title>\n"});
  if (p.x_min > 0 && p.x_max > p.x_min) {
    svg += Line(ax.At(p.x_min), y, ax.At(p.x_max), y,
                Concat({"stroke='", color, "' stroke-width='1.5' opacity='.6'"}));
  }
  absl::StrAppendFormat(&svg,
                        "<circle cx='%.1f' cy='%.1f' r='%.1f' fill='%s' stroke='%s' "
                        "stroke-width='1.5'%s/></g>\n",
                        x, y, kRadius, p.hollow ? "none" : color, color,
                        p.on_line ? "" : " opacity='.4'");
  return svg;
}

}  // namespace

std::string EscapeXml(std::string_view text) {
  std::string escaped;
  for (const char c : text) {
    switch (c) {
      case '&':
        escaped += "&amp;";
        break;
      case '<':
        escaped += "&lt;";
        break;
      case '>':
        escaped += "&gt;";
        break;
      case '"':
        escaped += "&quot;";
        break;
      case '\'':
        escaped += "&#39;";
        break;
      default:
        escaped += c;
    }
  }
  return escaped;
}

std::string RenderSvg(const LogLogPlot& plot, int* left_out) {
  int without_place = 0;
  double x_min = std::numeric_limits<double>::infinity(), x_max = 0;
  double y_min = x_min, y_max = 0;
  for (const PlotSeries& series : plot.series) {
    for (const PlotPoint& p : series.points) {
      if (!HasPlace(p)) {
        ++without_place;
        continue;
      }
      x_min = std::min({x_min, p.x, p.x_min > 0 ? p.x_min : p.x});
      x_max = std::max({x_max, p.x, p.x_max});
      y_min = std::min(y_min, p.y);
      y_max = std::max(y_max, p.y);
    }
  }
  if (left_out != nullptr) *left_out = without_place;

  Axis ax, ay;
  ax.first = kLeft;
  ax.last = kWidth - kRight;
  ay.first = kHeight - kBottom;
  ay.last = kTop;
  if (x_max > 0) {
    Widen(x_min, x_max, ax);
    Widen(y_min, y_max, ay);
  }

  std::string svg = absl::StrFormat(
      "<svg xmlns='http://www.w3.org/2000/svg' viewBox='0 0 %.0f %.0f' role='img' "
      "font-family='sans-serif' font-size='12' fill='currentColor'>\n",
      kWidth, kHeight);
  const std::string_view grid = "stroke='currentColor' stroke-width='.5' opacity='.25'";
  for (const double t : Ticks(ax)) {
    const double x = ax.At(t);
    svg += Line(x, ay.first, x, ay.last, grid);
    svg += Text(x, ay.first + 18, "text-anchor='middle'", absl::StrFormat("%g", t));
  }
  for (const double t : Ticks(ay)) {
    const double y = ay.At(t);
    svg += Line(ax.first, y, ax.last, y, grid);
    svg += Text(ax.first - 8, y + 4, "text-anchor='end'", absl::StrFormat("%g", t));
  }
  svg += Line(ax.first, ay.first, ax.last, ay.first, "stroke='currentColor'");
  svg += Line(ax.first, ay.first, ax.first, ay.last, "stroke='currentColor'");
  svg += Text((ax.first + ax.last) / 2, kHeight - 14, "text-anchor='middle'", plot.x_label);
  const double middle = (ay.first + ay.last) / 2;
  svg += Text(18, middle,
              absl::StrFormat("text-anchor='middle' transform='rotate(-90 18 %.1f)'", middle),
              plot.y_label);
  if (plot.level && plot.level->y > 0 && std::log10(plot.level->y) >= ay.low &&
      std::log10(plot.level->y) <= ay.high) {
    const double y = ay.At(plot.level->y);
    svg +=
        Line(ax.first, y, ax.last, y, "stroke='currentColor' stroke-dasharray='6 4' opacity='.7'");
    svg += Text(ax.last - 4, y - 5, "text-anchor='end'", plot.level->name);
  }

  double legend_y = kTop + 8;
  for (const PlotSeries& series : plot.series) {
    const std::string color = EscapeXml(series.color);
    std::vector<const PlotPoint*> line;
    for (const PlotPoint& p : series.points) {
      if (HasPlace(p) && p.on_line) line.push_back(&p);
    }
    std::sort(line.begin(), line.end(),
              [](const PlotPoint* a, const PlotPoint* b) { return a->x < b->x; });
    if (line.size() > 1) {
      svg += Concat({"<polyline fill='none' stroke='", color, "' stroke-width='1.8' points='"});
      for (const PlotPoint* p : line) {
        absl::StrAppendFormat(&svg, "%.1f,%.1f ", ax.At(p->x), ay.At(p->y));
      }
      svg += "'/>\n";
    }
    for (const PlotPoint& p : series.points) {
      if (HasPlace(p)) svg += Point(p, color, ax, ay);
    }
    absl::StrAppendFormat(&svg, "<circle cx='%.1f' cy='%.1f' r='%.1f' fill='%s'/>\n", ax.last + 22,
                          legend_y, kRadius, color);
    svg += Text(ax.last + 34, legend_y + 4, "", series.name);
    legend_y += 22;
  }
  return svg + "</svg>\n";
}

}  // namespace farpoint

// The pieces of a report that is one HTML file: it loads nothing, runs nothing and looks the same
// from a mail as from a disk. All texts are plain and are escaped here.
#pragma once

#include <cstdint>
#include <span>
#include <string>
#include <string_view>
#include <vector>

#include "bench/svg_plot.h"
#include "core/base/status.h"

namespace farpoint {

struct HtmlTable {
  std::vector<std::string> head;
  std::vector<std::vector<std::string>> rows;  // each as long as the head
  int left_columns = 1;  // so many columns from the left are text; the others are numbers
};

struct HtmlFact {
  std::string term, text;
};

struct HtmlFigure {
  int width = 0, height = 0;
  std::span<const uint8_t> rgb;  // height x width x 3, sRGB, rows top down
  std::string caption;
};

class HtmlPage {
 public:
  // The title is the first heading, too.
  explicit HtmlPage(std::string_view title);

  void Heading(std::string_view text);
  void Subheading(std::string_view text);
  void Paragraph(std::string_view text);
  void Facts(std::span<const HtmlFact> facts);
  void Table(const HtmlTable& table);
  // Points without a place on logarithmic axes are counted below the caption.
  void Plot(const LogLogPlot& plot, std::string_view caption);
  // Side by side where the window is wide enough, each at most at its own size; small pixels stay
  // sharp. kInvalidArgument if a picture's size does not match.
  absl::Status Figures(std::span<const HtmlFigure> figures);

  // The whole file. Nothing can be added afterwards.
  std::string Finish() &&;

 private:
  void Element(std::string_view tag, std::string_view text);

  std::string html_;
};

// "data:image/png;base64,…". kInvalidArgument if the size of `rgb` does not match.
absl::StatusOr<std::string> PngDataUri(int width, int height, std::span<const uint8_t> rgb);

// RFC 4648, with padding.
std::string Base64(std::span<const std::byte> bytes);

}  // namespace farpoint

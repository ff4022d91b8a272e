#include "bench/html_page.h"

#include <algorithm>
#include <utility>

#include "absl/strings/str_format.h"
#include "bench/text.h"
#include "core/image/png_io.h"

namespace farpoint {

namespace {

constexpr std::string_view kStyle = R"(
:root { color-scheme: light dark; }
body { font: 15px/1.45 sans-serif; max-width: 84rem; margin: 2rem auto; padding: 0 1rem; }
p, dl, h1, h2, h3 { max-width: 60rem; }
svg { width: 100%; max-width: 60rem; height: auto; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; margin: 1rem 0; }
.wide { overflow-x: auto; }
th, td { text-align: right; padding: .2rem .7rem; border-bottom: 1px solid #8884;
         white-space: nowrap; }
.text { text-align: left; }
dt { font-weight: bold; } dd { margin: 0 0 .4rem 0; }
.figures { display: flex; flex-wrap: wrap; gap: 1rem; align-items: flex-start; }
figure { margin: 0; max-width: 100%; }
img { max-width: 100%; height: auto; image-rendering: pixelated; display: block; }
figcaption { padding: .3rem 0; width: 0; min-width: 100%; }
)";

// Smaller pictures are shown at twice or four times their size.
constexpr int kSmall = 200, kTiny = 80;

std::string Row(std::string_view tag, const std::vector<std::string>& cells, int left_columns) {
  std::string row = "<tr>";
  for (size_t i = 0; i < cells.size(); ++i) {
    Append(row, {"<", tag, static_cast<int>(i) < left_columns ? " class='text'>" : ">",
                 EscapeXml(cells[i]), "</", tag, ">"});
  }
  return row + "</tr>\n";
}

}  // namespace

std::string Base64(std::span<const std::byte> bytes) {
  constexpr std::string_view kDigits =
      "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
  std::string text;
  text.reserve((bytes.size() + 2) / 3 * 4);
  for (size_t i = 0; i < bytes.size(); i += 3) {
    const size_t have = std::min<size_t>(3, bytes.size() - i);
    uint32_t bits = 0;
    for (size_t j = 0; j < 3; ++j) {
      bits = bits << 8 | (j < have ? std::to_integer<uint32_t>(bytes[i + j]) : 0u);
    }
    for (size_t j = 0; j < 4; ++j) {
      text += j <= have ? kDigits[bits >> (18 - 6 * j) & 63u] : '=';
    }
  }
  return text;
}

absl::StatusOr<std::string> PngDataUri(int width, int height, std::span<const uint8_t> rgb) {
  FP_ASSIGN_OR_RETURN(const std::vector<std::byte> png, EncodePng(width, height, rgb));
  return "data:image/png;base64," + Base64(png);
}

HtmlPage::HtmlPage(std::string_view title) {
  const std::string escaped = EscapeXml(title);
  html_ = Concat(
      {"<!DOCTYPE html>\n<html lang='en'><head><meta charset='utf-8'>\n"
       "<meta name='viewport' content='width=device-width'>\n<title>",
       escaped, "</title>\n<style>", kStyle, "</style></head><body>\n<h1>", escaped, "</h1>\n"});
}

void HtmlPage::Element(std::string_view tag, std::string_view text) {
  Append(html_, {"<", tag, ">", EscapeXml(text), "</", tag, ">\n"});
}
void HtmlPage::Heading(std::string_view text) { Element("h2", text); }
void HtmlPage::Subheading(std::string_view text) { Element("h3", text); }
void HtmlPage::Paragraph(std::string_view text) { Element("p", text); }

void HtmlPage::Facts(std::span<const HtmlFact> facts) {
  html_ += "<dl>\n";
  for (const HtmlFact& fact : facts) {
    Element("dt", fact.term);
    Element("dd", fact.text);
  }
  html_ += "</dl>\n";
}

void HtmlPage::Table(const HtmlTable& table) {
  html_ += "<div class='wide'><table>\n" + Row("th", table.head, table.left_columns);
  for (const std::vector<std::string>& row : table.rows) {
    html_ += Row("td", row, table.left_columns);
  }
  html_ += "</table></div>\n";
}

void HtmlPage::Plot(const LogLogPlot& plot, std::string_view caption) {
  int left_out = 0;
  Append(html_, {RenderSvg(plot, &left_out), "<p>", EscapeXml(caption)});
  if (left_out > 0) {
    Append(html_, {" ", std::to_string(left_out),
                   " points are zero in one of the two and have no place on these axes."});
  }
  html_ += "</p>\n";
}

absl::Status HtmlPage::Figures(std::span<const HtmlFigure> figures) {
  std::string html = "<div class='figures'>\n";
  for (const HtmlFigure& f : figures) {
    FP_ASSIGN_OR_RETURN(const std::string uri, PngDataUri(f.width, f.height, f.rgb));
    const int times = f.width <= kTiny ? 4 : f.width <= kSmall ? 2 : 1;
    Append(html, {absl::StrFormat("<figure><img width='%d' height='%d' alt='", f.width * times,
                                  f.height * times),
                  EscapeXml(f.caption), "' src='", uri, "'>\n<figcaption>", EscapeXml(f.caption),
                  "</figcaption></figure>\n"});
  }
  html_ += html + "</div>\n";
  return absl::OkStatus();
}

std::string HtmlPage::Finish() && { return std::move(html_) + "</body></html>\n"; }

}  // namespace farpoint

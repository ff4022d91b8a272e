#include "bench/html_page.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "core/image/png_io.h"

namespace farpoint {
namespace {

using ::testing::EndsWith;
using ::testing::HasSubstr;
using ::testing::Not;
using ::testing::StartsWith;

std::string EncodedText(std::string_view text) {
  return Base64(std::as_bytes(std::span(text.data(), text.size())));
}

TEST(Base64, GivesTheVectorsOfRfc4648) {
  EXPECT_EQ(EncodedText(""), "");
  EXPECT_EQ(EncodedText("f"), "Zg==");
  EXPECT_EQ(EncodedText("fo"), "Zm8=");
  EXPECT_EQ(EncodedText("foo"), "Zm9v");
  EXPECT_EQ(EncodedText("foob"), "Zm9vYg==");
  EXPECT_EQ(EncodedText("fooba"), "Zm9vYmE=");
  EXPECT_EQ(EncodedText("foobar"), "Zm9vYmFy");
  EXPECT_EQ(EncodedText("\xff\xfe\xfb"), "//77");
}

TEST(PngDataUri, HoldsTheFile) {
  const std::vector<uint8_t> rgb(size_t{3} * 4 * 2, 7);
  const auto uri = PngDataUri(4, 2, rgb);
  ASSERT_TRUE(uri.ok()) << uri.status();
  EXPECT_EQ(*uri, "data:image/png;base64," + Base64(*EncodePng(4, 2, rgb)));
  EXPECT_THAT(*uri, StartsWith("data:image/png;base64,iVBORw0KGgo"));  // PNG's signature
}

TEST(PngDataUri, RefusesWrongSizes) {
  const std::vector<uint8_t> rgb(12);
  EXPECT_EQ(PngDataUri(3, 2, rgb).status().code(), absl::StatusCode::kInvalidArgument);
  EXPECT_EQ(PngDataUri(0, 0, {}).status().code(), absl::StatusCode::kInvalidArgument);
}

// A page with one of everything; `text` wherever a text can stand.
std::string PageWith(const std::string& text) {
  HtmlPage page(text);
  page.Heading(text);
  page.Subheading(text);
  page.Paragraph(text);
  page.Facts(std::vector<HtmlFact>{{text, text}});
  page.Table({{text, text}, {{text, text}}, 1});
  LogLogPlot plot;
  plot.x_label = plot.y_label = text;
  plot.series = {
      {text, "#000", {{1, 1, 0, 0, text, false, true}, {2, 0, 0, 0, text, false, true}}}};
  page.Plot(plot, text);
  const std::vector<uint8_t> rgb(size_t{3} * 300 * 1);
  EXPECT_TRUE(page.Figures(std::vector<HtmlFigure>{{300, 1, rgb, text}}).ok());
  return std::move(page).Finish();
}

TEST(HtmlPage, IsSelfContained) {
  const std::string html = PageWith("word");
  EXPECT_THAT(html, StartsWith("<!DOCTYPE html>"));
  EXPECT_THAT(html, EndsWith("</body></html>\n"));
  for (const char* loads : {"<script", "href=", "url(", "@import", "<link", "<iframe"}) {
    EXPECT_THAT(html, Not(HasSubstr(loads)));
  }
  // Pictures are inside, and the only address is the name of SVG's namespace.
  size_t sources = 0, addresses = 0;
  for (size_t at = 0; (at = html.find("src=", at)) != std::string::npos; ++at, ++sources) {
    EXPECT_EQ(html.compare(at, 16, "src='data:image/"), 0);
  }
  for (size_t at = 0; (at = html.find("http", at)) != std::string::npos; ++at) ++addresses;
  EXPECT_EQ(sources, 1u);
  EXPECT_EQ(addresses, 1u);
}

TEST(HtmlPage, TextsAreEscapedEverywhere) {
  const std::string html = PageWith("<b>'\"&");
  EXPECT_THAT(html, Not(HasSubstr("<b>")));
  EXPECT_THAT(html, Not(HasSubstr("&amp;lt;")));  // and only once
  EXPECT_THAT(html, HasSubstr("&lt;b&gt;&#39;&quot;&amp;"));
}

TEST(HtmlPage, PointsWithoutPlaceAreCounted) {
  EXPECT_THAT(PageWith("word"), HasSubstr("word 1 points are zero"));
}

TEST(HtmlPage, TextColumnsAreMarked) {
  HtmlPage page("t");
  page.Table({{"a", "b", "c"}, {{"1", "2", "3"}}, 2});
  const std::string html = std::move(page).Finish();
  EXPECT_THAT(html, HasSubstr("<tr><td class='text'>1</td><td class='text'>2</td><td>3</td></tr>"));
}

TEST(HtmlPage, SmallPicturesAreShownLarger) {
  HtmlPage page("t");
  const std::vector<uint8_t> rgb(size_t{3} * 50 * 10);
  ASSERT_TRUE(page.Figures(std::vector<HtmlFigure>{{50, 10, rgb, "small"}}).ok());
  EXPECT_THAT(std::move(page).Finish(), HasSubstr("width='200' height='40'"));
}

TEST(HtmlPage, RefusesPicturesOfAnotherSize) {
  HtmlPage page("t");
  const std::vector<uint8_t> rgb(10);
  EXPECT_EQ(page.Figures(std::vector<HtmlFigure>{{5, 5, rgb, "x"}}).code(),
            absl::StatusCode::kInvalidArgument);
}

}  // namespace
}  // namespace farpoint

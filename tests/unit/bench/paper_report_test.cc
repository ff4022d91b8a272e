#include "bench/paper_report.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <nlohmann/json.hpp>

#include "tests/unit/bench/paper_testing.h"

namespace farpoint {
namespace {

using ::testing::HasSubstr;
using ::testing::Not;
using Json = nlohmann::json;

size_t CountOf(const std::string& text, std::string_view what) {
  size_t n = 0;
  for (size_t at = 0; (at = text.find(what, at)) != std::string::npos; ++at) ++n;
  return n;
}

TEST(PaperJson, HasOursAndThePapers) {
  ASSERT_TRUE(TinyPaper().ok()) << TinyPaper().status();
  const Json json = Json::parse(PaperJson(*TinyPaper()));
  EXPECT_EQ(json["benchmark"], "paper");
  EXPECT_EQ(json["quick"], true);
  ASSERT_EQ(json["scenes"].size(), 1u);
  const Json& s = json["scenes"][0];
  const PaperSceneReport& r = TinyPaper()->scenes[0];
  EXPECT_EQ(s["name"], "cornell");
  EXPECT_EQ(s["sample"]["blocks"], 8);
  EXPECT_EQ(s["sweep"].size(), r.sweep.size());
  EXPECT_EQ(s["dpbgi_trials"].size(), r.trials.size());
  EXPECT_EQ(s["published"]["pdp"], 103);
  EXPECT_EQ(s["published"]["cut_s"]["pbgi"], 147.6);
  ASSERT_EQ(s["integrators"].size(), 3u);
  EXPECT_EQ(s["integrators"][0]["integrator"], "pbgi");
  EXPECT_TRUE(s["integrators"][0]["to_pbgi"].is_null());
  EXPECT_TRUE(s["integrators"][0]["epsilon"].is_null());
  EXPECT_EQ(s["integrators"][1]["epsilon"], 0.1);
  EXPECT_EQ(s["integrators"][1]["to_pbgi"]["mse"], r.fpbgi.difference->mse);
  EXPECT_EQ(s["integrators"][1]["seconds"]["gather"], r.fpbgi.times.gather);
  EXPECT_EQ(s["integrators"][1]["seconds"]["full"],
            r.primary_s + r.direct_s + r.fpbgi.times.gather);
  EXPECT_EQ(s["integrators"][2]["to_pt"]["rr"], r.dpbgi.truth.rr);
}

TEST(PaperJson, NameThatIsNoUtf8StaysJson) {
  PaperReport report;
  report.left_out = {{"sponza", "a\xff/Sponza.gltf is not there"}};
  EXPECT_TRUE(Json::accept(PaperJson(report)));
}

TEST(PaperHtml, HoldsTablesPlotsAndPictures) {
  ASSERT_TRUE(TinyPaper().ok()) << TinyPaper().status();
  const auto html = PaperHtml(*TinyPaper());
  ASSERT_TRUE(html.ok()) << html.status();
  EXPECT_EQ(CountOf(*html, "<svg"), 4u);
  EXPECT_EQ(CountOf(*html, "<img"), TinyPaper()->scenes[0].pictures.size());
  for (const char* text : {"Table 1", "Figure 2", "Figures 4 and 5", "8.79e-06", "103 (98)", "8x8",
                           "quick: a check", "2.20×", "fpbgi k=100 ε=0.1 64²"}) {
    EXPECT_THAT(*html, HasSubstr(text));
  }
  for (const char* loads : {"<script", "href=", "url(", "@import", "<link", "<iframe"}) {
    EXPECT_THAT(*html, Not(HasSubstr(loads)));
  }
}

TEST(PaperHtml, SaysWhatWasSampledAndWhatWasNot) {
  ASSERT_TRUE(TinyFullPaper().ok()) << TinyFullPaper().status();
  const auto sampled = PaperHtml(*TinyPaper()), full = PaperHtml(*TinyFullPaper());
  ASSERT_TRUE(sampled.ok() && full.ok());
  EXPECT_THAT(*sampled, HasSubstr("pbgi and dpbgi ran on 8 blocks of 8x8 pixels (512 pixels"));
  EXPECT_THAT(*sampled, HasSubstr("A check of the extrapolated speed-ups"));
  EXPECT_THAT(*full, HasSubstr("pbgi and dpbgi rendered whole frames (--full)"));
  EXPECT_THAT(*full, Not(HasSubstr("extrapolated")));
}

TEST(PaperHtml, ScenesThatAreLeftOutAreSaidAndEscaped) {
  PaperReport report;
  report.left_out = {{"bunny", "<b>/bunny.obj is not there"}};
  const auto html = PaperHtml(report);
  ASSERT_TRUE(html.ok()) << html.status();
  EXPECT_THAT(*html, HasSubstr("Left out: bunny"));
  EXPECT_THAT(*html, HasSubstr("&lt;b&gt;/bunny.obj"));
  EXPECT_THAT(PaperTable(report), HasSubstr("bunny left out"));
}

TEST(PaperTable, HasARowForEach) {
  ASSERT_TRUE(TinyPaper().ok()) << TinyPaper().status();
  const std::string table = PaperTable(*TinyPaper());
  for (const char* text : {"cornell farpoint", "cornell paper", "pbgi 64px", "dpbgi",
                           "fpbgi k=100 eps=0.1 64px", "pt, ", "8 blocks"}) {
    EXPECT_THAT(table, HasSubstr(text));
  }
}

}  // namespace
}  // namespace farpoint

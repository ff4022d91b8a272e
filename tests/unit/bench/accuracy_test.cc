#include "bench/accuracy.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <nlohmann/json.hpp>

#include "bench/accuracy_report.h"
#include "bench/program.h"
#include "tests/unit/bench/temp_folder.h"

namespace farpoint {
namespace {

using ::testing::HasSubstr;
using ::testing::Not;

TEST(CompareSparse, KnowsErrorsOfKnownImages) {
  const std::vector<Rgb> truth = {Rgb(1), Rgb(3)};
  const std::vector<Rgb> image = {Rgb(1.2f), Rgb(3.2f)};
  const ErrorFigures e = CompareSparse(image, truth, 0);
  EXPECT_EQ(e.pixels, 2u);
  EXPECT_NEAR(e.mean, 2, 1e-6);
  EXPECT_NEAR(e.rel_rmse, 0.1, 1e-6);
  EXPECT_NEAR(e.rr, 0.1, 1e-6);
  EXPECT_NEAR(e.bias, 0.1, 1e-6);
  EXPECT_NEAR(e.bias_error, 0, 1e-6);
  EXPECT_NEAR(e.max, 0.1, 1e-6);
  const ErrorFigures quadrature = CompareSparse(image, truth, 0.06);
  EXPECT_NEAR(quadrature.rr, 0.08, 1e-6);
  EXPECT_NEAR(quadrature.rel_rmse, 0.1, 1e-6);
}

TEST(CompareSparse, SpreadOverPixelsIsItsError) {
  // Errors of 0 and 0.2 by turns: mean square 0.02, its deviation over pixels 0.02.
  std::vector<Rgb> truth(100, Rgb(1)), image;
  for (int i = 0; i < 100; ++i) image.push_back(Rgb(i % 2 == 0 ? 1.0f : 1.2f));
  const ErrorFigures e = CompareSparse(image, truth, 0);
  EXPECT_NEAR(e.rr, std::sqrt(0.02), 1e-6);
  EXPECT_NEAR(e.rr_error, 0.02 / std::sqrt(99.0) / (2 * std::sqrt(0.02)), 1e-6);
  EXPECT_NEAR(e.bias_error, 0.1 / std::sqrt(99.0), 1e-6);
}

TEST(CompareSparse, IsNothingWithoutScale) {
  EXPECT_EQ(CompareSparse({}, {}, 0).pixels, 0u);
  const std::vector<Rgb> dark(3, Rgb());
  EXPECT_EQ(CompareSparse(dark, dark, 0).pixels, 0u);
}

TEST(Verdict, NeedsBothBarsAndAGoodReference) {
  AccuracyCase c;
  c.rr_bar = 0.06;
  c.bias_bar = 0.01;
  ErrorFigures e;
  e.rr = 0.05;
  e.bias = -0.009;
  e.noise = 0.0199;
  EXPECT_EQ(VerdictOf(c, e), Verdict::kHolds);
  e.noise = 0.021;
  EXPECT_EQ(VerdictOf(c, e), Verdict::kNoisy);
  e.bias = -0.011;
  EXPECT_EQ(VerdictOf(c, e), Verdict::kFails);
  e.bias = 0;
  e.rr = 0.061;
  EXPECT_EQ(VerdictOf(c, e), Verdict::kFails);
}

TEST(Verdict, OfAChecksFailsWithOneFigure) {
  AccuracyCheck check;
  check.values = {{"information", 99, 0, 0}, {"small", 0.001, 0, 0.01}};
  EXPECT_EQ(check.verdict(), Verdict::kHolds);
  check.values.push_back({"large", 0.02, 0, 0.01});
  EXPECT_EQ(check.verdict(), Verdict::kFails);
}

AccuracyOptions Quick(std::vector<std::string> cases) {
  AccuracyOptions options;
  options.quick = true;
  options.points = 2000;
  options.light_samples = 8;
  options.threads = 2;
  options.cases = std::move(cases);
  return options;
}

void Ignore(std::string_view) {}

TEST(Accuracy, RefusesUnknownCasesAndSettingsBeforeItWorks) {
  const auto unknown = RunAccuracy(Quick({"cornell", "nowhere"}), Ignore);
  EXPECT_EQ(unknown.status().code(), absl::StatusCode::kInvalidArgument);
  EXPECT_THAT(std::string(unknown.status().message()), HasSubstr("leak-room"));
  AccuracyOptions wrong = Quick({"cornell"});
  wrong.clusters = 5000;
  EXPECT_EQ(RunAccuracy(wrong, Ignore).status().code(), absl::StatusCode::kInvalidArgument);
}

TEST(Accuracy, MeasuresCasesAndKeepsTheirReferences) {
  const TempFolder folder;
  AccuracyOptions options = Quick({"cornell", "furnace"});
  options.reference_dir = folder / "refs";
  const auto first = RunAccuracy(options, Ignore);
  ASSERT_TRUE(first.ok()) << first.status();
  ASSERT_EQ(first->results.size(), 2u);
  const AccuracyResult& cornell = first->results[0];
  EXPECT_GT(cornell.indirect.rr, 0);
  EXPECT_LT(cornell.indirect.rr, 0.3);
  EXPECT_LT(std::fabs(cornell.indirect.bias), 0.1);
  EXPECT_GT(cornell.indirect.pixels, 50u);
  EXPECT_GT(cornell.us_per_receiver, 0);
  EXPECT_GT(cornell.samples_per_pixel, 0);
  EXPECT_EQ(cornell.pictures.size(), 4u);
  const AccuracyResult& furnace = first->results[1];
  EXPECT_EQ(furnace.indirect.pixels, 64u * 48u);
  EXPECT_LT(furnace.indirect.rr, 0.05);
  EXPECT_LT(furnace.beauty.rr, 0.1);

  const auto again = RunAccuracy(options, Ignore);
  ASSERT_TRUE(again.ok()) << again.status();
  EXPECT_EQ(again->results[0].indirect.rr, cornell.indirect.rr);
  EXPECT_THAT(again->results[0].truth, HasSubstr("earlier run"));
  EXPECT_THAT(cornell.truth, Not(HasSubstr("earlier run")));
}

TEST(Accuracy, LeavesItsReports) {
  const TempFolder folder;
  std::ostringstream out, err;
  const int code =
      RunBench({"accuracy", "--quick",   "--points",      "2000",        "--case",
                "city",     "--case",    "seams-cornell", "--case",      "seams-sponza",
                "--case",   "leak-wall", "--case",        "flicker-pan", "--quality",
                "draft",    "--scenes",  folder / "none", "-o",          folder / "out"},
               out, err);
  ASSERT_EQ(code, 0) << err.str();
  EXPECT_THAT(out.str(), HasSubstr("--quality draft"));
  EXPECT_THAT(out.str(), HasSubstr("left out: seams-sponza"));
  EXPECT_THAT(out.str(), HasSubstr("flicker-pan: city --resolution 48x32"));
  const auto json = nlohmann::json::parse(ReadText(folder / "out/accuracy.json"));
  EXPECT_EQ(json["benchmark"], "accuracy");
  ASSERT_EQ(json["cases"].size(), 1u);
  EXPECT_EQ(json["cases"][0]["name"], "city");
  EXPECT_GT(json["cases"][0]["irradiance"]["rr"], 0);
  ASSERT_EQ(json["checks"].size(), 3u);
  EXPECT_EQ(json["checks"][1]["name"], "leak-wall");
  EXPECT_EQ(json["checks"][1]["values"].size(), 4u);
  EXPECT_EQ(json["checks"][2]["values"][0]["bar"], nullptr);
  EXPECT_EQ(json["left_out"].size(), 1u);
  const std::string html = ReadText(folder / "out/accuracy.html");
  EXPECT_THAT(html, HasSubstr("data:image/png;base64,"));
  EXPECT_THAT(html, HasSubstr("leak-wall"));
  EXPECT_THAT(html, Not(HasSubstr("src=\"http")));
  EXPECT_TRUE(std::filesystem::exists(folder / "out/city-error.png"));
  EXPECT_TRUE(std::filesystem::exists(folder / "out/seams-cornell-contrast.png"));
}

TEST(Accuracy, MistakesOfItsCommandLineEndWithUsage) {
  const TempFolder folder;
  const auto run = [&](std::vector<std::string> args) {
    std::ostringstream out, err;
    args.insert(args.begin(), "accuracy");
    args.insert(args.end(), {"-o", folder.path().string()});
    return RunBench(args, out, err);
  };
  EXPECT_EQ(run({"--quality", "best"}), 2);
  EXPECT_EQ(run({"--fill", "sand"}), 2);
  EXPECT_EQ(run({"--clusters", "2000"}), 2);
  EXPECT_EQ(run({"--case", "nowhere"}), 2);
}

}  // namespace
}  // namespace farpoint

#include "bench/command_line.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

namespace farpoint {
namespace {

using ::testing::AllOf;
using ::testing::HasSubstr;
using ::testing::Not;

std::string MessageOf(const std::vector<std::string>& args) {
  const auto line = ParseBenchCommandLine(args);
  return line.ok() ? "" : std::string(line.status().message());
}

TEST(BenchCommandLine, ParetoTakesAll) {
  const auto line = ParseBenchCommandLine(
      {"pareto", "--scene",     "city", "--resolution",    "320x200", "--reference",
       "r.exr",  "--ref-layer", "x",    "--mask",          "m.npy",   "--noise",
       "0.005",  "--points",    "1234", "--light-samples", "8",       "--seed",
       "9",      "--repeat",    "5",    "--threads",       "1",       "--quick",
       "-o",     "there"});
  ASSERT_TRUE(line.ok()) << line.status();
  EXPECT_FALSE(line->print.has_value());
  EXPECT_EQ(line->verb, BenchVerb::kPareto);
  EXPECT_EQ(line->output_dir, "there");
  const ParetoOptions& p = line->pareto;
  EXPECT_EQ(p.scene, "city");
  EXPECT_EQ(p.width, 320);
  EXPECT_EQ(p.height, 200);
  EXPECT_EQ(p.reference_path, "r.exr");
  EXPECT_EQ(p.ref_layer, "x");
  EXPECT_EQ(p.mask_path, "m.npy");
  EXPECT_EQ(p.noise, 0.005);
  EXPECT_EQ(p.points, 1234u);
  EXPECT_EQ(p.light_samples, 8u);
  EXPECT_EQ(p.seed, 9u);
  EXPECT_EQ(p.repeat, 5u);
  EXPECT_EQ(p.threads, 1u);
  EXPECT_TRUE(p.quick);
}

TEST(BenchCommandLine, ParetoChangesTheSceneAndChoosesCurves) {
  const auto line = ParseBenchCommandLine(
      {"pareto", "--scene", "s.gltf", "--sun", "0.3,1,0.1:10,9,8", "--sky", "0.5,0.6,0.8", "--eye",
       "9,0.8,-0.3", "--target", "-8,4,-0.3", "--fov", "57", "--curves", "adaptive,pt,irrcache"});
  ASSERT_TRUE(line.ok()) << line.status();
  const ParetoOptions& p = line->pareto;
  ASSERT_TRUE(p.changes.sun && p.changes.sky && p.changes.view);
  EXPECT_EQ(p.changes.sun->to_sun, Vec3d(0.3, 1, 0.1));
  EXPECT_EQ(p.changes.sun->irradiance, Rgb(10, 9, 8));
  EXPECT_EQ(*p.changes.sky, Rgb(0.5f, 0.6f, 0.8f));
  EXPECT_EQ(p.changes.view->eye, Vec3d(9, 0.8, -0.3));
  EXPECT_EQ(p.changes.view->target, Vec3d(-8, 4, -0.3));
  EXPECT_EQ(p.changes.view->yfov_deg, 57);
  EXPECT_EQ(p.curves,
            (std::vector{ParetoCurve::kAdaptive, ParetoCurve::kPt, ParetoCurve::kIrrcache}));
  EXPECT_THAT(MessageOf({"pareto", "--sun", "1,2,3"}), HasSubstr("--sun 1,2,3"));
  EXPECT_THAT(MessageOf({"pareto", "--sky", "1,2"}), HasSubstr("--sky 1,2"));
  EXPECT_THAT(MessageOf({"pareto", "--eye", "1,2,3"}), HasSubstr("--target"));
  EXPECT_THAT(MessageOf({"pareto", "--target", "1,2,3"}), HasSubstr("--eye"));
  EXPECT_THAT(MessageOf({"pareto", "--eye", "x", "--target", "1,2,3"}), HasSubstr("--eye x"));
  EXPECT_THAT(MessageOf({"pareto", "--curves", "pt,no"}), HasSubstr("'no'"));
}

TEST(BenchCommandLine, ParetoNeedsNothing) {
  const auto line = ParseBenchCommandLine({"pareto"});
  ASSERT_TRUE(line.ok()) << line.status();
  EXPECT_EQ(line->pareto.scene, "cornell");
  EXPECT_EQ(line->pareto.width, 0);
  EXPECT_FALSE(line->pareto.noise.has_value());
  EXPECT_FALSE(line->pareto.quick);
  EXPECT_EQ(line->output_dir, "out/bench");
}

TEST(BenchCommandLine, PaperTakesAll) {
  const auto line = ParseBenchCommandLine(
      {"paper",    "--scene",       "city", "--scenes",           "s",   "--resolution",
       "320x200",  "--points",      "1234", "--blocks",           "12",  "--splat",
       "coverage", "--microbuffer", "32",   "--reference-budget", "0.5", "--light-samples",
       "8",        "--seed",        "9",    "--threads",          "1",   "--quick",
       "-o",       "there"});
  ASSERT_TRUE(line.ok()) << line.status();
  EXPECT_EQ(line->verb, BenchVerb::kPaper);
  EXPECT_EQ(line->output_dir, "there");
  const PaperOptions& p = line->paper;
  EXPECT_EQ(p.scene, "city");
  EXPECT_EQ(p.scenes_dir, "s");
  EXPECT_EQ(p.width, 320);
  EXPECT_EQ(p.height, 200);
  EXPECT_EQ(p.points, 1234u);
  EXPECT_EQ(p.blocks, 12u);
  EXPECT_EQ(p.reference_budget_s, 0.5);
  EXPECT_EQ(p.splat, Splat::kCoverage);
  EXPECT_EQ(p.microbuffer, 32u);
  EXPECT_EQ(p.light_samples, 8u);
  EXPECT_EQ(p.seed, 9u);
  EXPECT_EQ(p.threads, 1u);
  EXPECT_TRUE(p.quick);
  EXPECT_FALSE(p.full);
  const auto full = ParseBenchCommandLine({"paper", "--full"});
  ASSERT_TRUE(full.ok()) << full.status();
  EXPECT_TRUE(full->paper.full);
}

TEST(BenchCommandLine, PaperRefusesWhatDoesNotFit) {
  EXPECT_THAT(MessageOf({"paper", "--full", "--blocks", "9"}), HasSubstr("--full"));
  EXPECT_THAT(MessageOf({"paper", "--resolution", "wide"}), HasSubstr("wide"));
  EXPECT_NE(MessageOf({"paper", "--blocks", "1"}), "");
  EXPECT_THAT(MessageOf({"paper", "--splat", "round"}), HasSubstr("round"));
}

TEST(BenchCommandLine, MicroTakesAll) {
  const auto line = ParseBenchCommandLine({"micro", "--quick", "--filter", "sort$", "-o", "d"});
  ASSERT_TRUE(line.ok()) << line.status();
  EXPECT_EQ(line->verb, BenchVerb::kMicro);
  EXPECT_TRUE(line->micro.quick);
  EXPECT_EQ(line->micro.filter, "sort$");
  EXPECT_EQ(line->output_dir, "d");
}

TEST(BenchCommandLine, RebakeTakesAll) {
  const auto line =
      ParseBenchCommandLine({"rebake",   "--scene", "city",      "--sun",    "0.5,1,-2:3,4,5.5",
                             "--sky",    "1,2,3",   "--points",  "77",       "--light-samples",
                             "9",        "--seed",  "3",         "--object", "4",
                             "--repeat", "2",       "--threads", "1",        "--cache-mib",
                             "5",        "-o",      "d"});
  ASSERT_TRUE(line.ok()) << line.status();
  EXPECT_EQ(line->verb, BenchVerb::kRebake);
  const RebakeOptions& r = line->rebake;
  EXPECT_EQ(r.scene, "city");
  ASSERT_TRUE(r.changes.sun && r.changes.sky);
  EXPECT_EQ(r.changes.sun->to_sun, Vec3d(0.5, 1, -2));
  EXPECT_EQ(r.changes.sun->irradiance, Rgb(3, 4, 5.5f));
  EXPECT_EQ(*r.changes.sky, Rgb(1, 2, 3));
  EXPECT_EQ(r.points, 77u);
  EXPECT_EQ(r.light_samples, 9u);
  EXPECT_EQ(r.seed, 3u);
  EXPECT_EQ(r.object, 4u);
  EXPECT_EQ(r.repeat, 2u);
  EXPECT_EQ(r.threads, 1u);
  EXPECT_EQ(r.cache_bytes, uint64_t{5} << 20);
  for (const char* sun : {"1,2,3", "1,2:3,4,5", "0,0,0:1,1,1", "1,2,3:1,1,x", "1,2,3:1,1,nan"}) {
    EXPECT_THAT(MessageOf({"rebake", "--sun", sun}), HasSubstr("--sun")) << sun;
  }
  EXPECT_THAT(MessageOf({"rebake", "--sky", "1,2"}), HasSubstr("--sky"));
}

TEST(BenchCommandLine, LightsTakesAll) {
  const auto line = ParseBenchCommandLine({"lights", "--light-samples", "9", "--receivers", "7",
                                           "--reference-samples", "99", "--seed", "3", "--quick"});
  ASSERT_TRUE(line.ok()) << line.status();
  EXPECT_EQ(line->verb, BenchVerb::kLights);
  EXPECT_EQ(line->lights.light_samples, 9u);
  EXPECT_EQ(line->lights.receivers, 7u);
  EXPECT_EQ(line->lights.reference_samples, 99u);
  EXPECT_EQ(line->lights.seed, 3u);
  EXPECT_TRUE(line->lights.quick);
  EXPECT_THAT(MessageOf({"lights", "--receivers", "0"}), HasSubstr("--receivers"));
}

TEST(BenchCommandLine, StabilityTakesItsFlags) {
  const auto line =
      ParseBenchCommandLine({"stability", "--case", "mirror", "--scenes", "dir", "--points", "77",
                             "--light-samples", "3", "--seed", "5", "--threads", "2", "--quick"});
  ASSERT_TRUE(line.ok()) << line.status();
  EXPECT_EQ(line->verb, BenchVerb::kStability);
  EXPECT_EQ(line->stability.cases, std::vector<std::string>{"mirror"});
  EXPECT_EQ(line->stability.scenes_dir, "dir");
  EXPECT_EQ(line->stability.points, 77u);
  EXPECT_EQ(line->stability.light_samples, 3u);
  EXPECT_EQ(line->stability.seed, 5u);
  EXPECT_EQ(line->stability.threads, 2u);
  EXPECT_TRUE(line->stability.quick);
  EXPECT_THAT(MessageOf({"stability", "--points", "0"}), HasSubstr("--points"));
}

TEST(BenchCommandLine, UnknownScenesAreUsageErrorsThatListTheKnownOnes) {
  EXPECT_THAT(MessageOf({"accuracy", "--case", "cornell", "--case", "nope"}),
              AllOf(HasSubstr("--case nope"), HasSubstr("macross"), HasSubstr("leak-wall")));
  // The large ones are none of a quick run.
  EXPECT_THAT(MessageOf({"accuracy", "--quick", "--case", "macross"}),
              AllOf(HasSubstr("--case macross"), HasSubstr("--quick")));
  EXPECT_THAT(MessageOf({"paper", "--scene", "foo"}),
              AllOf(HasSubstr("--scene foo"), HasSubstr("cornell, bunny, city, sponza")));
  EXPECT_THAT(MessageOf({"stability", "--case", "mirror", "--case", "nope"}),
              AllOf(HasSubstr("--case nope"), HasSubstr("mirror"), HasSubstr("thin-wall")));
  EXPECT_THAT(MessageOf({"skip", "--case", "textures", "--case", "nope"}),
              AllOf(HasSubstr("--case nope"), HasSubstr("textures"), HasSubstr("hidden-nodes")));
  EXPECT_TRUE(ParseBenchCommandLine({"accuracy", "--case", "leak-room"}).ok());
  EXPECT_TRUE(ParseBenchCommandLine({"paper", "--scene", "city"}).ok());
}

TEST(BenchCommandLine, TheServiceHasItsFlags) {
  const auto line = ParseBenchCommandLine({"service", "--quick", "--case", "kills", "--case",
                                           "load", "--seed", "7", "--bin", "/programs"});
  ASSERT_TRUE(line.ok()) << line.status();
  EXPECT_EQ(line->verb, BenchVerb::kService);
  EXPECT_TRUE(line->service.quick);
  EXPECT_EQ(line->service.cases, (std::vector<std::string>{"kills", "load"}));
  EXPECT_EQ(line->service.seed, 7u);
  EXPECT_EQ(line->service.bin_dir, "/programs");
  EXPECT_THAT(MessageOf({"service", "--case", "nope"}),
              AllOf(HasSubstr("--case nope"), HasSubstr("schedules"), HasSubstr("states")));
}

TEST(BenchCommandLine, HelpListsWhatThereIs) {
  const auto line = ParseBenchCommandLine({"--help"});
  ASSERT_TRUE(line.ok() && line->print.has_value());
  EXPECT_THAT(*line->print, HasSubstr("  pareto "));
  EXPECT_THAT(*line->print, HasSubstr("  micro "));
  EXPECT_THAT(*line->print, HasSubstr("  rebake "));
  EXPECT_THAT(*line->print, HasSubstr("  lights "));
  EXPECT_THAT(*line->print, HasSubstr("  paper "));
  EXPECT_THAT(*line->print, HasSubstr("  stability "));
  EXPECT_THAT(*line->print, HasSubstr("  scale "));
  EXPECT_THAT(*line->print, HasSubstr("  skip "));
  EXPECT_THAT(*line->print, HasSubstr("  service "));
}

TEST(BenchCommandLine, HelpOfAVerbListsItsFlags) {
  const auto line = ParseBenchCommandLine({"pareto", "--help"});
  ASSERT_TRUE(line.ok() && line->print.has_value());
  for (const char* flag : {"--scene", "--resolution", "--reference", "--ref-layer", "--mask",
                           "--noise", "--quick", "--repeat", "--output"}) {
    EXPECT_THAT(*line->print, HasSubstr(flag));
  }
}

TEST(BenchCommandLine, VersionIsPrinted) {
  const auto line = ParseBenchCommandLine({"--version"});
  ASSERT_TRUE(line.ok() && line->print.has_value());
  EXPECT_EQ(*line->print, std::string("farpoint-bench ") + FARPOINT_VERSION + "\n");
}

TEST(BenchCommandLine, MistakesAreRefused) {
  const std::vector<std::vector<std::string>> wrong = {
      {},
      {"fast"},
      {"pareto", "micro"},
      {"pareto", "--unknown"},
      {"pareto", "--resolution", "64"},
      {"pareto", "--resolution", "64x"},
      {"pareto", "--resolution", "64x0"},
      {"pareto", "--resolution", "-64x64"},
      {"pareto", "--resolution", "64x64x64"},
      {"pareto", "--repeat", "0"},
      {"pareto", "--points", "0"},
      {"pareto", "--noise", "0.1"},  // of which reference?
      {"pareto", "--ref-layer", "E"},
      {"pareto", "--reference", "r.exr", "--noise", "-1"},
      {"pareto", "--reference", "r.exr", "--reference-paths", "64"},
      {"pareto", "--reference-paths", "4"},  // too few for a standard error
      {"micro", "--scene", "cornell"},
      {"micro", "-o", ""},
  };
  for (const auto& args : wrong) {
    const auto line = ParseBenchCommandLine(args);
    EXPECT_EQ(line.status().code(), absl::StatusCode::kInvalidArgument)
        << ::testing::PrintToString(args);
  }
}

}  // namespace
}  // namespace farpoint

#include "bench/program.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <nlohmann/json.hpp>
#include <sstream>

#include "tests/unit/bench/temp_folder.h"

namespace farpoint {
namespace {

using ::testing::HasSubstr;

struct Ran {
  int code;
  std::string out, err;
};

Ran RunArgs(const std::vector<std::string>& args) {
  std::ostringstream out, err;
  const int code = RunBench(args, out, err);
  return {code, out.str(), err.str()};
}

TEST(BenchProgram, ParetoLeavesItsReports) {
  const TempFolder folder;
  // The folder is made.
  const Ran ran = RunArgs({"pareto", "--quick", "--resolution", "32x32", "--points", "2000", "-o",
                           folder / "deep/down"});
  ASSERT_EQ(ran.code, 0) << ran.err;
  EXPECT_THAT(ran.out, HasSubstr("us/receiver"));
  EXPECT_THAT(ran.out, HasSubstr(folder / "deep/down/pareto.html"));
  const auto json = nlohmann::json::parse(ReadText(folder / "deep/down/pareto.json"));
  EXPECT_EQ(json["benchmark"], "pareto");
  EXPECT_EQ(json["film"]["width"], 32);
  EXPECT_THAT(ReadText(folder / "deep/down/pareto.html"), HasSubstr("</html>"));
}

TEST(BenchProgram, PaperLeavesItsReports) {
  const TempFolder folder;
  const Ran ran =
      RunArgs({"paper", "--quick", "--scene", "city", "--resolution", "64x32", "--points", "1000",
               "--blocks", "4", "--reference-budget", "0.2", "-o", folder.path().string()});
  ASSERT_EQ(ran.code, 0) << ran.err;
  EXPECT_THAT(ran.out, HasSubstr("city    paper"));
  const auto json = nlohmann::json::parse(ReadText(folder / "paper.json"));
  EXPECT_EQ(json["scenes"][0]["film"]["height"], 32);
  EXPECT_EQ(json["scenes"][0]["sample"]["blocks"], 4);
  EXPECT_THAT(ReadText(folder / "paper.html"), HasSubstr("</html>"));
}

TEST(BenchProgram, ScaleLeavesItsReports) {
  const TempFolder folder;
  const Ran ran =
      RunArgs({"scale", "--quick", "--scene", "cornell", "--resolution", "16x16", "--points", "300",
               "--clusters", "4", "--reference-budget", "0.05", "-o", folder.path().string()});
  ASSERT_EQ(ran.code, 0) << ran.err;
  EXPECT_THAT(ran.out, HasSubstr("preparation"));
  EXPECT_EQ(nlohmann::json::parse(ReadText(folder / "scale.json"))["settings"]["clusters"], 4);
  EXPECT_THAT(ReadText(folder / "scale.html"), HasSubstr("</html>"));
}

TEST(BenchProgram, MicroLeavesItsReport) {
  const TempFolder folder;
  const Ran ran =
      RunArgs({"micro", "--quick", "--filter", "tree_cut", "-o", folder.path().string()});
  ASSERT_EQ(ran.code, 0) << ran.err;
  EXPECT_THAT(ran.out, HasSubstr("tree_cut/sort"));
  EXPECT_EQ(nlohmann::json::parse(ReadText(folder / "micro.json"))["benchmarks"].size(), 7u);
}

TEST(BenchProgram, MistakesEndWithUsage) {
  EXPECT_EQ(RunArgs({}).code, 2);
  EXPECT_EQ(RunArgs({"pareto", "--resolution", "big"}).code, 2);
  EXPECT_THAT(RunArgs({"pareto", "--resolution", "big"}).err, HasSubstr("big"));
}

TEST(BenchProgram, WrongSceneIsPermanent) {
  const TempFolder folder;
  const Ran ran =
      RunArgs({"pareto", "--quick", "--scene", folder / "none.gltf", "-o", folder.path().string()});
  EXPECT_EQ(ran.code, 42);
  EXPECT_THAT(ran.err, HasSubstr("none.gltf"));
  EXPECT_TRUE(std::filesystem::is_empty(folder.path()));
}

TEST(BenchProgram, FolderThatIsAFileIsRefused) {
  const TempFolder folder;
  std::ofstream(folder / "file") << "x";
  EXPECT_EQ(RunArgs({"micro", "--quick", "-o", folder / "file"}).code, 42);
}

TEST(BenchProgram, HelpAndVersionSucceed) {
  EXPECT_EQ(RunArgs({"--help"}).code, 0);
  EXPECT_EQ(RunArgs({"micro", "--help"}).code, 0);
  EXPECT_THAT(RunArgs({"--version"}).out, HasSubstr("farpoint-bench"));
}

}  // namespace
}  // namespace farpoint

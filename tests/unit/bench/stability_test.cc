#include "bench/stability.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <nlohmann/json.hpp>
#include <sstream>
#include <string>

#include "bench/program.h"
#include "bench/stability_report.h"
#include "bench/stability_scenes.h"
#include "core/scene/procedural.h"
#include "tests/unit/bench/temp_folder.h"

namespace farpoint {
namespace {

using ::testing::HasSubstr;

// What is known not to hold (docs/numerics.md): a figure of the quick form and what it may be at
// most. One that holds after all has to leave the list.
struct Known {
  std::string_view name, integrator, what;
  double most;
};
constexpr Known kKnown[] = {
    // Third powers of such lengths are no normal floats.
    {"scale-powers-of-two", "fpbgi", "scale 2^40: values whose bits differ", 1000},
    {"scale-powers-of-two", "fpbgi", "scale 2^-30: values whose bits differ", 2000},
    {"scale-powers-of-two", "pbgi", "scale 2^-30: values whose bits differ", 1000},
    {"scale-powers-of-two", "pt", "scale 2^-30: values whose bits differ", 2000},
    // Records lie in cells of the world whose side is a power of two in metres.
    {"scale-thousands", "fpbgi", "scale 0.001: rr", 0.06},
    {"scale-thousands", "fpbgi", "scale 1000: rr", 0.06},
    // Sides that only someone inside a closed object sees are left out of the gather.
    {"lights-on-surfaces", "pbgi", "a light inside the tall box: rr against pt", 2},
    {"lights-on-surfaces", "pbgi", "a light inside the tall box: bias, without its sign", 1.3},
    {"cameras-in-walls", "pbgi", "inside the tall box: largest E over the room's mean", 0.6},
    // The ground takes nearly all of the surfels.
    {"strays", "pbgi", "a ground of +-1000 m: rr against pt", 1},
    {"strays", "pbgi", "a ground of +-1000 m: the bias moves by", 0.7},
    {"strays", "pbgi", "a ground of +-100000 m: rr against pt", 1},
    {"strays", "pbgi", "a ground of +-100000 m: the bias moves by", 0.7},
    {"strays", "pbgi", "a ground of +-1000 m, all turned by 37°: rr against pt", 1},
    {"strays", "pbgi", "a ground of +-1000 m, all turned by 37°: the bias moves by", 0.7},
    // 2,500 surfels leave gaps.
    {"thin-wall", "pbgi", "a wall of no thickness: mean leak", 0.01},
    {"thin-wall", "pbgi", "a wall of a tenth of the surfels' spacing: mean leak", 0.01},
};

void Ignore(std::string_view) {}

class StabilityCase : public testing::TestWithParam<std::string> {};

// The quick form of `farpoint-bench stability`.
TEST_P(StabilityCase, Holds) {
  StabilityOptions options;
  options.quick = true;
  options.threads = 2;
  options.cases = {GetParam()};
  const auto report = RunStability(options, Ignore);
  ASSERT_TRUE(report.ok()) << report.status();
  ASSERT_EQ(report->results.size(), 1u);
  const StabilityResult& result = report->results.front();
  EXPECT_GE(result.values.size(), 2u);
  size_t met = 0;
  for (const StabilityValue& v : result.values) {
    const auto known = std::find_if(std::begin(kKnown), std::end(kKnown), [&](const Known& k) {
      return k.name == result.name && k.integrator == v.integrator && k.what == v.what;
    });
    if (known == std::end(kKnown)) {
      EXPECT_TRUE(v.holds()) << v.integrator << ", " << v.what << ": " << v.value << " > " << v.bar;
    } else {
      ++met;
      EXPECT_FALSE(v.holds()) << v.integrator << ", " << v.what << ": take it off the list";
      EXPECT_LE(v.value, known->most) << v.integrator << ", " << v.what;
    }
  }
  EXPECT_EQ(met, static_cast<size_t>(
                     std::count_if(std::begin(kKnown), std::end(kKnown),
                                   [&](const Known& k) { return k.name == result.name; })));
}

INSTANTIATE_TEST_SUITE_P(Quick, StabilityCase, testing::ValuesIn(StabilityNames()),
                         [](const auto& info) {
                           std::string name = info.param;
                           std::replace(name.begin(), name.end(), '-', '_');
                           return name;
                         });

TEST(StabilityValue, FailsAboveItsBarAndIfItIsNoNumber) {
  StabilityResult result;
  result.values = {{"fpbgi", "a", 0.5, 0, 0.5},
                   {"fpbgi", "b", 0.6, 0, 0.5},
                   {"pt", "c", std::numeric_limits<double>::quiet_NaN(), 0, 0.5}};
  EXPECT_TRUE(result.values[0].holds());
  EXPECT_FALSE(result.values[1].holds());
  EXPECT_FALSE(result.values[2].holds());
  EXPECT_EQ(result.failures(), 2u);
}

TEST(Stability, UnknownCasesAreRefused) {
  StabilityOptions options;
  options.cases = {"mirror", "nothing"};
  const auto report = RunStability(options, Ignore);
  EXPECT_EQ(report.status().code(), absl::StatusCode::kInvalidArgument);
  EXPECT_THAT(std::string(report.status().message()), HasSubstr("thin-wall"));
}

TEST(Stability, LeavesItsReportsAndFailsByItsExitCode) {
  StabilityReport report;
  report.results.resize(1);
  report.results[0].name = "mirror";
  report.results[0].scene = "cornell";
  report.results[0].values = {{"fpbgi", "holds <so>", 0.5, 0.01, 1}, {"pt", "fails", 2, 0, 1}};
  report.left_out = {{"sponza", "not there"}};
  const auto json = nlohmann::json::parse(StabilityJson(report));
  EXPECT_EQ(json["failures"], 1);
  EXPECT_EQ(json["cases"][0]["values"][0]["reference_noise"], 0.01);
  EXPECT_EQ(json["cases"][0]["values"][1]["holds"], false);
  EXPECT_THAT(StabilityTable(report), HasSubstr("mirror, cornell, pt, fails: 2 > 1"));
  EXPECT_THAT(StabilityTable(report), HasSubstr("left out: sponza"));
  EXPECT_THAT(StabilityHtml(report), HasSubstr("holds &lt;so&gt;"));

  const TempFolder folder;
  std::ostringstream out, err;
  EXPECT_EQ(
      RunBench({"stability", "--quick", "--case", "refusals", "-o", folder / "out"}, out, err), 0)
      << err.str();
  EXPECT_THAT(out.str(), HasSubstr("refusals"));
  EXPECT_EQ(nlohmann::json::parse(ReadText(folder / "out/stability.json"))["failures"], 0);
  EXPECT_THAT(ReadText(folder / "out/stability.html"), HasSubstr("refusals"));
  EXPECT_EQ(RunBench({"stability", "--quick", "--case", "scale-thousands", "-o", folder / "out"},
                     out, err),
            42);
  EXPECT_THAT(err.str(), HasSubstr("above their bar"));
}

TEST(StabilityScenes, ChangesKeepTheSurface) {
  const Scene box = MakeCornellBox();
  const auto area = [](const Scene& scene) {
    double sum = 0;
    for (const Instance& instance : scene.instances) {
      const Mesh& mesh = scene.meshes[instance.mesh];
      for (const auto& t : mesh.triangles) {
        const auto p = [&](int i) {
          return instance.world_from_mesh.Point(Vec3d(mesh.positions[t[static_cast<size_t>(i)]]));
        };
        sum += 0.5 * Length(Cross(p(1) - p(0), p(2) - p(0)));
      }
    }
    return sum;
  };
  const double whole = area(box);
  EXPECT_NEAR(area(Permuted(box, 3)), whole, 1e-9 * whole);
  EXPECT_NEAR(area(Split(box)), whole, 1e-6 * whole);
  EXPECT_NEAR(area(WithNeedles(box)), whole, 1e-6 * whole);
  EXPECT_NEAR(area(WithFlatTriangles(box)), whole, 1e-6 * whole);
  EXPECT_NEAR(area(WithDuplicates(box)), 2 * whole, 1e-9 * whole);
  const StabilityScene source{box, box.cameras.front()};
  EXPECT_NEAR(area(Transformed(source, RotationAbout({1, 2, 3}, 1.0), 1).scene), whole,
              1e-9 * whole);
  EXPECT_NEAR(area(Transformed(source, ScalingBy(3), 3).scene), 9 * whole, 1e-8 * whole);
  EXPECT_NE(Permuted(box, 3).meshes.back().triangles, box.meshes.front().triangles);
  EXPECT_GT(Split(box).instances.size(), box.instances.size());
}

}  // namespace
}  // namespace farpoint

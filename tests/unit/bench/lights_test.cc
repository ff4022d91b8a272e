#include "bench/lights.h"

#include <gtest/gtest.h>

#include <cmath>
#include <map>
#include <nlohmann/json.hpp>
#include <set>
#include <string>

namespace farpoint {
namespace {

TEST(LightsBench, AQuickRunMeasuresEveryKind) {
  LightsOptions options;
  options.quick = true;
  options.receivers = 20;
  const auto report = RunLights(options, {});
  ASSERT_TRUE(report.ok()) << report.status();
  std::set<std::string> kinds;
  for (const LightsCase& c : report->cases) {
    kinds.insert(c.kind);
    EXPECT_GT(c.us_per_receiver, 0) << c.kind;
    EXPECT_LT(c.rr, 0.5) << c.kind << " " << c.lights;
    EXPECT_LT(std::fabs(c.bias), 0.1) << c.kind << " " << c.lights;
    if (c.kind == "points" && c.lights <= 10) {
      EXPECT_LT(c.rr, 1e-6);
    }
    // Never more rays than samples where lights are drawn.
    if (c.lights > 32) {
      EXPECT_LE(c.rays_per_receiver, 32) << c.kind << " " << c.lights;
    }
  }
  EXPECT_EQ(kinds, (std::set<std::string>{"box", "furnace", "points", "spots", "emitters", "map",
                                          "sun map"}));
  const auto json = nlohmann::json::parse(LightsJson(*report));
  EXPECT_EQ(json["cases"].size(), report->cases.size());
  EXPECT_EQ(json["light_samples"], 32);
  const std::string table = LightsTable(*report);
  EXPECT_NE(table.find("sun map"), std::string::npos);
}

}  // namespace
}  // namespace farpoint

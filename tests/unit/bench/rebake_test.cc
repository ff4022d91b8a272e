#include "bench/rebake.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <nlohmann/json.hpp>

namespace farpoint {
namespace {

TEST(Rebake, ReportsWhatEachChangeKept) {
  RebakeOptions options;
  options.quick = true;
  options.threads = 2;
  options.changes.sun = AccuracySun{{0.1, 0.2, 1}, Rgb(1, 1, 1)};
  const auto report = RunRebake(options, [](std::string_view) {});
  ASSERT_TRUE(report.ok()) << report.status();
  const auto json = nlohmann::json::parse(RebakeJson(*report));
  const uint64_t surfels = json["surfels"];
  EXPECT_GT(surfels, 10'000u);
  ASSERT_EQ(json["cases"].size(), 7u);
  const auto skipped = [&](size_t i, const char* key) -> uint64_t {
    const auto& of = json["cases"][i]["warm_skipped"];
    return of.contains(key) ? of[key].get<uint64_t>() : 0;
  };
  EXPECT_EQ(json["cases"][0]["name"], "same");
  EXPECT_EQ(skipped(0, "bake_stages"), 3u);
  EXPECT_EQ(skipped(0, "surfels_shaded_kept"), surfels);
  for (const size_t light_or_material : {1u, 2u, 3u}) {
    EXPECT_EQ(skipped(light_or_material, "bake_stages"), 2u);
    EXPECT_EQ(skipped(light_or_material, "surfels_kept"), surfels);
    EXPECT_TRUE(json["cases"][light_or_material]["topology_same_as_before"].get<bool>());
    EXPECT_EQ(json["cases"][light_or_material]["warm_counts"].count("interior_rays"), 0u);
  }
  for (const size_t moved : {4u, 5u}) {
    EXPECT_EQ(skipped(moved, "surfels_kept"), surfels) << moved;
    EXPECT_FALSE(json["cases"][moved]["topology_same_as_before"].get<bool>());
  }
  EXPECT_THAT(RebakeTable(*report), testing::HasSubstr("object moved"));
}

}  // namespace
}  // namespace farpoint

#include "bench/micro.h"

#include <gtest/gtest.h>

#include <cmath>
#include <map>
#include <nlohmann/json.hpp>
#include <sstream>
#include <vector>

#include "tests/unit/bench/temp_folder.h"

namespace farpoint {
namespace {

// Names are stable, so that the history stays comparable: name -> a counter that it must have.
const std::map<std::string, std::vector<std::string>> kBenchmarks = {
    {"receiver_cluster/assign", {"receivers_per_s"}},
    {"receiver_cluster/cluster", {"receivers_per_s", "clusters"}},
    {"tree_cut/alone/octahedral", {"receivers_per_s", "node_groups_per_s", "nodes_per_cut"}},
    {"tree_cut/alone/cosine", {"receivers_per_s", "node_groups_per_s", "nodes_per_cut"}},
    {"tree_cut/cluster", {"clusters_per_s", "node_groups_per_s", "nodes_per_cut"}},
    {"tree_cut/receiver", {"receivers_per_s", "node_groups_per_s", "nodes_per_cut"}},
    {"tree_cut/same_cuts",
     {"pbgi_node_groups_per_s", "fpbgi_node_groups_per_s", "pbgi_over_fpbgi"}},
    {"tree_cut/pack", {"nodes_per_s"}},
    {"tree_cut/sort", {"nodes_per_s", "nodes_per_cut"}},
    {"microbuffer/map/octahedral", {"pixels_per_s"}},
    {"microbuffer/map/cosine", {"pixels_per_s"}},
    {"microbuffer/rasterize/octahedral/coverage", {"splats_per_s", "splats_per_buffer"}},
    {"microbuffer/rasterize/octahedral/opaque", {"splats_per_s", "splats_per_buffer"}},
    {"microbuffer/rasterize/cosine/coverage", {"splats_per_s", "splats_per_buffer"}},
    {"microbuffer/rasterize/cosine/opaque", {"splats_per_s", "splats_per_buffer"}},
    {"microbuffer/convolve/octahedral/coverage", {"receivers_per_s"}},
    {"microbuffer/convolve/octahedral/opaque", {"receivers_per_s"}},
    {"microbuffer/convolve/cosine/coverage", {"receivers_per_s"}},
    {"microbuffer/convolve/cosine/opaque", {"receivers_per_s"}},
    {"microbuffer/convolve_near/octahedral/coverage", {"receivers_per_s"}},
    {"microbuffer/convolve_near/octahedral/opaque", {"receivers_per_s"}},
    {"microbuffer/convolve_near/cosine/coverage", {"receivers_per_s"}},
    {"microbuffer/convolve_near/cosine/opaque", {"receivers_per_s"}},
    {"point_tree/build", {"surfels_per_s", "bytes_per_surfel"}},
    {"point_tree/against_embree",
     {"surfels_per_s", "embree_medium_per_s", "embree_low_per_s", "time_over_embree_medium",
      "time_over_embree_low", "bytes_per_surfel"}},
    {"point_tree/view", {"surfels_per_s", "bytes_per_s"}},
    {"surfel_sampler/sample", {"surfels_per_s"}},
    {"surfel_shader/open_sides", {"surfels_per_s", "rays_per_s"}},
    {"surfel_shader/shade", {"surfels_per_s", "rays_per_s", "rays_per_surfel"}},
    {"ray_accel/intersect/coherent", {"rays_per_s", "hit_fraction"}},
    {"ray_accel/intersect/incoherent", {"rays_per_s", "hit_fraction"}},
    {"ray_accel/occluded/incoherent", {"rays_per_s", "hit_fraction"}},
    {"path_tracer/against_embree/cornell",
     {"pt_rays_per_s", "embree_rays_per_s", "pt_over_embree"}},
};

TEST(Micro, EveryKernelRunsAndCounts) {
  const TempFolder folder;
  MicroOptions options;
  options.json_path = folder / "micro.json";
  options.quick = true;
  std::ostringstream out;
  const absl::Status status = RunMicro(options, out);
  ASSERT_TRUE(status.ok()) << status;
  const auto json = nlohmann::json::parse(ReadText(options.json_path));
  EXPECT_EQ(json["context"]["farpoint_version"], FARPOINT_VERSION);
  EXPECT_EQ(json["context"]["quick"], "true");
  std::map<std::string, nlohmann::json> found;
  for (const auto& entry : json["benchmarks"]) {
    const std::string name = entry["name"];
    EXPECT_TRUE(kBenchmarks.contains(name)) << name << " is new: add it here";
    EXPECT_FALSE(entry.contains("error_occurred")) << name;
    found[name] = entry;
  }
  for (const auto& [name, counters] : kBenchmarks) {
    ASSERT_TRUE(found.contains(name)) << name;
    EXPECT_GT(found[name]["cpu_time"].get<double>(), 0.0) << name;
    for (const std::string& counter : counters) {
      ASSERT_TRUE(found[name].contains(counter)) << name << " " << counter;
      const double value = found[name][counter];
      EXPECT_TRUE(std::isfinite(value) && value > 0) << name << " " << counter << " " << value;
    }
    EXPECT_NE(out.str().find(name), std::string::npos);
  }
  EXPECT_LE(found["ray_accel/intersect/coherent"]["hit_fraction"].get<double>(), 1.0);
  // Both ask about the same rays.
  EXPECT_EQ(found["ray_accel/intersect/incoherent"]["hit_fraction"],
            found["ray_accel/occluded/incoherent"]["hit_fraction"]);
  // A group of eight surfels and one of their radiances, and a share of what is above.
  const double bytes = found["point_tree/build"]["bytes_per_surfel"];
  EXPECT_GT(bytes, (112 + 64) / 8.0);
  EXPECT_LT(bytes, 28);
}

TEST(Micro, FilterChooses) {
  const TempFolder folder;
  MicroOptions options;
  options.json_path = folder / "micro.json";
  options.quick = true;
  options.filter = "convolve/octahedral";
  std::ostringstream out;
  ASSERT_TRUE(RunMicro(options, out).ok());
  const auto json = nlohmann::json::parse(ReadText(options.json_path));
  ASSERT_EQ(json["benchmarks"].size(), 2u);
  EXPECT_FALSE(std::filesystem::exists(options.json_path + ".part"));
}

TEST(Micro, FilterWithoutMatchIsRefused) {
  const TempFolder folder;
  MicroOptions options;
  options.json_path = folder / "micro.json";
  options.quick = true;
  options.filter = "nothing-is-called-this";
  std::ostringstream out;
  const absl::Status status = RunMicro(options, out);
  EXPECT_EQ(status.code(), absl::StatusCode::kInvalidArgument);
  EXPECT_NE(std::string(status.message()).find(options.filter), std::string::npos);
  EXPECT_TRUE(std::filesystem::is_empty(folder.path()));
}

TEST(Micro, UnwritablePlaceIsAnErrorAndNotTheEnd) {
  const TempFolder folder;
  MicroOptions options;
  options.json_path = folder / "missing/micro.json";
  options.quick = true;
  std::ostringstream out;
  EXPECT_FALSE(RunMicro(options, out).ok());
}

}  // namespace
}  // namespace farpoint

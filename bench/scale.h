// How cost grows: with the pixels of one view, with the surfels, and with the threads.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <functional>
#include <optional>
#include <string>
#include <string_view>
#include <vector>

#include "bench/accuracy.h"
#include "bench/pareto.h"
#include "core/base/stats.h"
#include "core/base/status.h"
#include "core/render/settings.h"

namespace farpoint {

// 0 and empty mean the default named at the field; after the comma, that of a quick run.
struct ScaleOptions {
  std::string scene;       // of PaperScenes(): sponza, or the city where there is none; city
  std::string scenes_dir;  // as of paper
  // Of the largest frame, multiples of 4: 1280x1000, 64x64. The others have half and a quarter of
  // its width and height.
  int width = 0, height = 0;
  uint64_t points = 0;  // the fewest surfels: 1,000,000, 2,000. The others are 4 and 16 times those
  Quality quality = Quality::kNormal;
  uint32_t clusters = 0;  // k per block; 0: adaptive
  uint32_t light_samples = 32;
  uint64_t seed = 0;
  size_t reference_pixels = 0;    // 1500, 16
  double reference_budget_s = 0;  // thread-seconds for each frame: 60, 0.5
  std::string reference_dir;      // keeps references from run to run; empty: nowhere
  unsigned repeat = 0;            // renders of each frame: 3, 1
  unsigned threads = 0;           // all cores
  bool quick = false;
};

// One bake.
struct ScaleBake {
  uint64_t points = 0;  // asked for
  unsigned threads = 0;
  uint64_t triangles = 0, surfels = 0, nodes = 0;
  std::array<double, kStageCount> seconds{}, wall_seconds{};
  // The most that the process held at a time beyond what it held before, with the scene's file in
  // memory: prepared scene, rays' structure, surfels, tree. None where the system does not tell.
  std::optional<uint64_t> peak_bytes;
  uint64_t scene_bytes = 0, tree_bytes = 0;
  std::string tree_hash;  // of both blobs

  // sample + shade + tree.
  double thread_s() const;
  double wall_s() const;
  double bytes_per_surfel() const;
};

// One frame at one number of surfels and threads. Seconds are thread-seconds.
struct ScaleFrame {
  int width = 0, height = 0;
  uint64_t points = 0;
  unsigned threads = 0;
  uint64_t receivers = 0, clusters = 0, rays = 0, node_visits = 0;
  Spread gather;       // all stages of indirect light
  Spread per_cluster;  // of them cluster, cut, raster and trace: what clusters, and not receivers,
                       // cost (with k per block also the receivers' own cuts and buffers)
  Spread wall;         // of the whole frame, primary rays included
  std::array<Spread, kStageCount> stage;
  ErrorFigures error;  // of irradiance against a path tracer at some pixels
  std::string hash;    // of the irradiance; the same for every repeat and number of threads
};

// What grew, from one frame or bake to another.
struct ScaleGrowth {
  std::string axis;      // "pixels", "surfels", "threads"
  std::string from, to;  // "320x250", "1,000,000", "1"
  double factor = 0;     // of the axis
  // Ratios of thread-seconds; 0: not there.
  double per_cluster = 0, gather = 0, preparation = 0;
};

struct ScaleReport {
  ScaleOptions options;  // as they were in force
  std::string date_utc, cpu;
  double load_average_start = 0, load_average_end = 0;
  std::vector<std::string> notes;
  std::vector<ScaleBake> bakes;
  std::vector<ScaleFrame> frames;
  std::vector<ScaleGrowth> growth;
};

// Bakes the scene with each number of surfels, with all threads and with one. Renders all frames
// with the fewest surfels, the middle one also with the others, and with one thread. Each repeat
// loads the scene anew, so that none finds what another left; loading, with the places of surfels,
// is not in the times. `progress` gets a line now and then. kInvalidArgument: settings that do not
// fit, a scene that is not there. kInternal if repeats or numbers of threads differ in a bit.
absl::StatusOr<ScaleReport> RunScale(const ScaleOptions& options,
                                     const std::function<void(std::string_view)>& progress);

// The ratios of a report's bakes and frames.
std::vector<ScaleGrowth> GrowthOf(const ScaleReport& report);

}  // namespace farpoint

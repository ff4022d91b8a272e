// Time against error: every integrator, at several settings, on the same receivers, scene, surfels
// and lights in one run.
#pragma once

#include <array>
#include <cstdint>
#include <functional>
#include <map>
#include <optional>
#include <span>
#include <string>
#include <string_view>
#include <vector>

#include "core/base/stats.h"
#include "core/base/status.h"
#include "core/render/settings.h"

namespace farpoint {

// 0 and empty mean the default named at the field; after the comma, that of a quick run.
struct ParetoOptions {
  std::string scene = "cornell";  // see MakeBenchScene
  int width = 0, height = 0;      // the reference file's; without one 256x256, 64x64
  std::string reference_path;     // an EXR; empty: a path-traced one is made
  std::string ref_layer;          // of the file: its "irradiance" or, without one, R, G and B
  std::string mask_path;          // see ReadMask; empty: the pixels whose primary ray hits
  std::optional<double> noise;    // the file's standard error over its mean; none: unknown, as 0
  uint32_t reference_paths = 0;   // of the reference made here: 8192, 2048
  uint64_t points = 0;            // surfels: the scene's default, 20,000
  uint32_t light_samples = 32;    // of the surfels, see RenderSettings
  uint64_t seed = 0;
  unsigned repeat = 0;   // renders of each configuration: 3, 1
  unsigned threads = 0;  // all cores
  bool quick = false;    // few configurations, few samples: a check that all works
};

// Over the repeats. Of an even number the median is the mean of the middle two.
struct Spread {
  double median = 0, min = 0, max = 0;
};
Spread SpreadOf(std::vector<double> values);  // not empty

// One setting of one integrator. Seconds are thread-seconds unless they are called wall.
struct ParetoPoint {
  Integrator integrator = Integrator::kFpbgi;
  // What an integrator does not have is 0.
  uint32_t clusters = 0, microbuffer = 0, paths = 0;
  double epsilon = 0;

  Spread gather;                          // cluster + cut + raster + composite + convolve + trace
  std::array<Spread, kStageCount> stage;  // of the tile; preparation stages are 0
  Spread wall;                            // of the whole frame, primary rays included
  double us_per_receiver = 0;             // median gather time over receivers
  std::map<std::string, uint64_t> counts;
  std::string hash;  // of the irradiance; every repeat had the same

  // Of irradiance against the reference, over the compared pixels (core/image/compare.h).
  double rel_rmse = 0, rr = 0, bias = 0;
  // rel_rmse is below twice the reference's noise: rr says more about the reference than about the
  // point.
  bool reference_limited = false;
  // No other point of its integrator is as fast and as accurate and better in one of the two.
  bool on_front = false;
  // Thread-seconds that pt would need for this rr, interpolated between its points in logarithms;
  // none beyond their range, where the reference limits, and for pt itself.
  std::optional<double> pt_seconds_at_rr;
};

struct PreparationTimes {
  std::array<Spread, kStageCount> stage;  // import, sample, shade, tree
  Spread total;
};

struct ParetoReport {
  ParetoOptions options;  // as they were in force; points 0 is the scene's default, see surfels
  std::string date_utc;   // ISO 8601
  std::string cpu;        // model name; "unknown" if the system does not say
  // Of the last minute. Above the number of cores others were at work, and times are not to be
  // trusted.
  double load_average_start = 0, load_average_end = 0;

  std::vector<std::string> notes;  // of the scene
  uint64_t triangles = 0, surfels = 0, nodes = 0, receivers = 0, compared_pixels = 0;
  uint64_t scene_bytes = 0, tree_bytes = 0;
  std::string scene_hash, tree_hash;

  double reference_mean = 0;   // W/m²
  double reference_noise = 0;  // standard error over mean
  bool reference_noise_known = false;
  double reference_seconds = 0;  // thread-seconds; 0 for a file

  PreparationTimes point_based;  // what fpbgi, pbgi and dpbgi need before their first pixel
  PreparationTimes path_traced;  // what pt needs
  Spread load;                   // ray acceleration structure and light tables; everyone needs it

  std::vector<ParetoPoint> points;  // by integrator, in the order of the enumeration
};

// Bakes the scene, makes or reads the reference, renders every configuration `repeat` times (in
// rounds, so that a slow minute of the machine hits all alike) and compares. `progress` gets a line
// now and then. kInvalidArgument: settings, a reference or a mask that do not fit, a scene without
// indirect light, whose errors would have no scale. kInternal if two repeats differ in a bit.
//
// The reference's own noise comes from the stderr layer, which errs on the high side: rr, which has
// it taken out, errs on the low side, rel_rmse does not. The reference is made with another seed:
// with the same one pt's points would be a part of it, and their errors would look too small.
absl::StatusOr<ParetoReport> RunPareto(const ParetoOptions& options,
                                       const std::function<void(std::string_view)>& progress);

// "k=100 ε=0.1 24²", "64 paths"
std::string LabelOf(const ParetoPoint& point);

// Sets on_front and pt_seconds_at_rr of every point from times and errors.
void AnalysePoints(std::span<ParetoPoint> points);

}  // namespace farpoint

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

#include "bench/bench_scene.h"
#include "core/base/stats.h"
#include "core/base/status.h"
#include "core/render/settings.h"

namespace farpoint {

// What a line joins: the points of one integrator, of one kind of clusters.
enum class ParetoCurve { kAdaptive, kKMeans, kPbgi, kDpbgi, kPt, kIrrcache };
inline constexpr int kParetoCurveCount = 6;
// "fpbgi adaptive", "fpbgi k", "pbgi", …
std::string_view NameOf(ParetoCurve curve);
// From a name as of a flag: adaptive, k, pbgi, dpbgi, pt, irrcache. kInvalidArgument lists them.
absl::StatusOr<ParetoCurve> ParetoCurveFromName(std::string_view name);

// 0 and empty mean the default named at the field; after the comma, that of a quick run.
struct ParetoOptions {
  std::string scene = "cornell";  // see MakeBenchScene
  SceneChanges changes;
  int width = 0, height = 0;        // the reference file's; without one 256x256, 64x64
  std::string reference_path;       // an EXR; empty: a path-traced one is made
  std::string ref_layer;            // of the file: its "irradiance" or, without one, R, G and B
  std::string mask_path;            // see ReadMask; empty: the pixels whose primary ray hits
  std::optional<double> noise;      // the file's standard error over its mean; none: unknown, as 0
  uint32_t reference_paths = 0;     // of the reference made here, in two halves: 8192, 2048
  std::vector<ParetoCurve> curves;  // what to measure; empty: all
  uint64_t points = 0;              // surfels: the scene's default, 20,000
  uint32_t light_samples = 32;      // of the surfels, see RenderSettings
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
  // What an integrator does not have is 0 or none. paths: also the rays of irrcache's records.
  uint32_t clusters = 0, microbuffer = 0, paths = 0;
  double epsilon = 0;
  std::optional<Quality> quality;  // adaptive clusters
  double cache_error = 0;          // irrcache

  ParetoCurve curve() const;

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
  // rel_rmse is below the noise itself: rr is 0 and says nothing.
  bool noise_above_error = false;
  // No other point of its curve is as fast and as accurate and better in one of the two.
  bool on_front = false;
  // Thread-seconds that pt and irrcache would need for this rr, interpolated in logarithms between
  // the points of their fronts; none beyond their range, where the reference limits, and for the
  // two themselves.
  std::optional<double> pt_seconds_at_rr, irrcache_seconds_at_rr;
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
  PreparationTimes path_traced;  // what pt and irrcache need
  Spread load;                   // ray acceleration structure and light tables; everyone needs it
  Spread atlas;                  // which surfels lie about a hit; adaptive clusters need it

  std::vector<ParetoPoint> points;  // by curve
};

// Bakes the scene, makes or reads the reference, renders every configuration `repeat` times (in
// rounds, so that a slow minute of the machine hits all alike) and compares. `progress` gets a line
// now and then. kInvalidArgument: settings, a reference or a mask that do not fit, a scene without
// indirect light, whose errors would have no scale. kInternal if two repeats differ in a bit or in
// what was counted.
//
// The reference is the mean of two renders of half the paths and of different seeds; its noise is
// what they differ by, see NoiseOfHalves. The seeds are none of a point: with the same one pt's
// points would be a part of the reference, and their errors would look too small.
absl::StatusOr<ParetoReport> RunPareto(const ParetoOptions& options,
                                       const std::function<void(std::string_view)>& progress);

// "normal", "k=100 ε=0.1 24²", "64 paths", "a=0.2 1024 rays"
std::string LabelOf(const ParetoPoint& point);

// What a user should know of the errors, if anything: points whose error the noise exceeds.
std::optional<std::string> NoiseWarning(const ParetoReport& report);

// Sets on_front and the peers' seconds of every point from times and errors.
void AnalysePoints(std::span<ParetoPoint> points);

}  // namespace farpoint

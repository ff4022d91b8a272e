// The experiments of Wang et al. 2013 with our implementation: Table 1 (stage times and errors of
// pbgi and fpbgi), Figure 2 (fpbgi against pbgi made coarser until it takes as long), Figures 4 and
// 5 (influence of k and epsilon), and every one of them against a path tracer.
//
// pbgi for a whole frame takes hours on a few cores, so it runs on a sample: blocks of 8x8 pixels
// spread over the frame, from which times and mean squared errors are extrapolated (with their
// standard errors), and a crop of whole 32x32 blocks, on which what needs an image is made: the
// count of perceptibly different pixels, difference images, and the sweeps. `full` renders all.
#pragma once

#include <array>
#include <cstdint>
#include <functional>
#include <optional>
#include <span>
#include <string>
#include <string_view>
#include <vector>

#include "bench/accuracy.h"
#include "bench/paper_scenes.h"
#include "core/base/stats.h"
#include "core/base/status.h"
#include "core/image/tile_rect.h"
#include "core/render/settings.h"

namespace farpoint {

// 0 means the default named at the field; after the comma, that of a quick run.
struct PaperOptions {
  std::string scene;              // of PaperScenes(); empty: all that are there
  std::string scenes_dir;         // of the scenes that are files; empty: those are left out
  int width = 0, height = 0;      // the paper's, 96x96
  uint64_t points = 0;            // surfels: the paper's, 4,000
  unsigned blocks = 0;            // of 8x8 pixels on which pbgi runs: 256, 8
  double reference_budget_s = 0;  // thread-seconds of each path-traced reference: 120, 2
  // In place of the preset's: what would change if the paper had chosen otherwise.
  std::optional<Splat> splat;
  uint32_t microbuffer = 0;     // side of pbgi's and fpbgi's buffers: 64
  uint32_t light_samples = 32;  // as RenderSettings
  uint64_t seed = 0;
  unsigned threads = 0;  // all cores
  bool full = false;     // pbgi and dpbgi of the whole frame
  bool quick = false;    // small, all code paths: a check that all works
};

// Of the whole frame, in thread-seconds.
struct PaperTimes {
  std::array<double, kStageCount> seconds{};  // the stages of the gather; others are 0
  double gather = 0;        // cluster + cut + raster + composite + convolve + trace
  double gather_error = 0;  // standard error of the extrapolation; 0: the whole frame was rendered
};

// Against pbgi, of the indirect layer as a display shows it: over the white of the scene, clamped
// to [0, 1], three channels.
struct PaperDifference {
  double mse = 0;
  double mse_error = 0;  // standard error of the extrapolation, as of PaperTimes
  double crop_mse = 0;   // of PaperSceneReport::compared
  int64_t crop_pdp = 0;  // perceptibly different pixels (core/image/yee_metric.h) there
};

struct PaperIntegrator {
  Integrator integrator = Integrator::kFpbgi;
  uint32_t clusters = 0;  // 0 where there are none
  double epsilon = 0;
  uint32_t microbuffer = 0;
  PaperTimes times;
  double crop_gather = 0;  // thread-seconds of PaperSceneReport::compared; 0: not rendered alone
  std::optional<PaperDifference> difference;  // none for pbgi itself
  ErrorFigures truth;                         // of irradiance, at the reference's pixels
};

// Of the search for the buffer with which dpbgi takes as long as fpbgi.
struct DegradedTrial {
  uint32_t microbuffer = 0;
  double gather = 0;  // thread-seconds of the frame
};

// fpbgi with one k and epsilon, on PaperSceneReport::crop.
struct PaperSweepPoint {
  uint32_t clusters = 0;
  double epsilon = 0;
  double gather = 0;    // thread-seconds
  double speed_up = 0;  // pbgi's gather of the crop over this one
  double mse = 0;
  int64_t pdp = 0;
};

struct PaperPicture {
  std::string name;  // "fpbgi-frame"
  std::string caption;
  int width = 0, height = 0;
  std::vector<uint8_t> rgb;  // sRGB, rows top down
};

struct PaperSceneReport {
  PaperScene scene;
  std::vector<std::string> notes;
  int width = 0, height = 0;
  uint64_t triangles = 0, surfels = 0, nodes = 0, tree_bytes = 0;
  uint64_t receivers = 0;                         // of the frame
  std::array<double, kStageCount> preparation{};  // thread-seconds of import, sample, shade, tree
  double load_s = 0;                              // thread-seconds
  // Thread-seconds of the frame that all integrators share: primary rays and direct light.
  double primary_s = 0, direct_s = 0;
  double white =
      0;  // radiance of the indirect layer that is 1: 99th percentile of pbgi's luminance

  uint64_t blocks = 0, block_pixels = 0, block_receivers = 0;  // of the sample
  PixelRect crop;                                              // of the sweeps
  PixelRect compared;  // the crop, or the frame if all was rendered

  PaperIntegrator pbgi, fpbgi, dpbgi;
  std::vector<DegradedTrial> trials;   // by microbuffer
  double pbgi_crop_gather = 0;         // thread-seconds of `crop`
  std::vector<PaperSweepPoint> sweep;  // by k, then epsilon

  uint64_t reference_pixels = 0;
  uint64_t reference_paths = 0;  // per pixel
  double reference_seconds = 0;  // thread-seconds, the primary rays of whole blocks included
  double load_average_start = 0, load_average_end = 0;
  std::vector<PaperPicture> pictures;
};

struct PaperReport {
  PaperOptions options;  // as they were in force; sizes of 0 are the paper's
  std::string date_utc, cpu;
  unsigned threads = 0;
  uint64_t peak_rss_bytes = 0;
  std::vector<PaperSceneReport> scenes;
  std::vector<LeftOut> left_out;
};

// `progress` gets a line now and then. kInvalidArgument: an unknown scene, settings that do not
// fit, a scene without indirect light. kNotFound: the scene that was asked for by name is not
// there.
absl::StatusOr<PaperReport> RunPaper(const PaperOptions& options,
                                     const std::function<void(std::string_view)>& progress);

// What follows is RunPaper's arithmetic.

// `count` distinct squares of 8x8 pixels of the frame's grid (narrower at its right and bottom),
// at the points of a scrambled Sobol' sequence, or all of them if there are no more; row by row.
std::vector<PixelRect> SampleBlocks(int width, int height, unsigned count, uint64_t seed);

// A quarter of the frame's width and height in the middle, widened to whole blocks of 32x32.
PixelRect MiddleCrop(int width, int height);

struct TotalEstimate {
  double total = 0, error = 0;
};
// The sum over a frame of `frame_size` units of what has value[i] in the i-th sampled block of
// size[i] units: a ratio estimate and its standard error as of a simple random sample, which errs
// on the high side for a spread one. Not finite values: none. All 0 if the sizes are.
TotalEstimate EstimateTotal(std::span<const double> value, std::span<const double> size,
                            double frame_size);

// Searches 1..largest for the side whose time is nearest to `target`, in ratio; time grows with the
// side. Calls `time` at most about log2(largest) + 1 times. Errors are those of `time`.
absl::StatusOr<std::vector<DegradedTrial>> SearchMicrobuffer(
    uint32_t largest, double target, const std::function<absl::StatusOr<double>(uint32_t)>& time);
// The one of them that is nearest; `trials` is not empty.
const DegradedTrial& NearestTrial(std::span<const DegradedTrial> trials, double target);

}  // namespace farpoint

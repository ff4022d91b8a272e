// The error of the default image against ground truth: frames, pictures and bars in one run.
#pragma once

#include <cstddef>
#include <cstdint>
#include <functional>
#include <optional>
#include <span>
#include <string>
#include <string_view>
#include <vector>

#include "bench/accuracy_scenes.h"
#include "core/base/status.h"
#include "core/render/settings.h"

namespace farpoint {

struct AccuracyOptions {
  std::vector<std::string> cases;  // names, see AccuracyNames; empty: all
  AccuracyFolders folders;
  std::string reference_dir;        // keeps traced references; empty: they are made anew
  size_t reference_pixels = 5000;   // of a traced reference, about
  double reference_budget_s = 200;  // thread-seconds of each traced reference, about
  // Of the measured image, as of `farpoint render`.
  Quality quality = Quality::kNormal;
  uint32_t clusters = 0;
  Fill fill = Fill::kAuto;
  uint64_t points = 0;  // quick: 20,000
  uint32_t light_samples = 32;
  uint64_t seed = 0;
  unsigned threads = 0;
  bool quick = false;  // own scenes, tiny: that all works, not how well
  bool pictures = true;
};

// Over pixels and channels; all but n are relative to the truth's mean.
struct ErrorFigures {
  size_t pixels = 0;
  double mean = 0;        // of the truth, in its unit
  double rel_rmse = 0;    // root mean square difference
  double rr = 0;          // the same, the truth's own noise taken out in quadrature
  double rr_error = 0;    // standard error of rr from the choice of pixels
  double bias = 0;        // mean difference
  double bias_error = 0;  // its standard error
  double max = 0;         // largest absolute difference, the truth's noise included
  double noise = 0;       // of the truth: root mean square standard error
};
// `image` and `truth` are equally long; `noise` is that of the truth. All 0 without pixels or if
// the truth's mean is not positive.
ErrorFigures CompareSparse(std::span<const Rgb> image, std::span<const Rgb> truth, double noise);

struct AccuracyPicture {
  std::string title, caption;
  std::string file;  // name of the PNG beside the page
  int width = 0, height = 0;
  std::vector<uint8_t> rgb;  // sRGB, rows top down
};

enum class Verdict {
  kHolds,
  kFails,
  kNoisy
};  // kNoisy: the bar seems to be held, but the truth's
    // noise is above a third of it
std::string_view NameOf(Verdict verdict);
// Indirect irradiance against the case's bars.
Verdict VerdictOf(const AccuracyCase& c, const ErrorFigures& indirect);

struct AccuracyResult {
  AccuracyCase c;
  std::vector<std::string> notes;
  uint64_t triangles = 0, surfels = 0, receivers = 0, records = 0;
  ErrorFigures indirect;       // irradiance, W/m²
  ErrorFigures beauty;         // direct and indirect light reflected, without emission, W/(m² sr)
  double us_per_receiver = 0;  // thread time of the gather's stages
  double samples_per_pixel = 0;  // strata of all records over receivers; 0 for k-means clusters
  double bake_s = 0;             // thread-seconds of import, sample, shade, tree
  std::string truth;             // what it is, in words
  double truth_seconds = 0;      // thread-seconds, those of earlier runs included
  Verdict verdict = Verdict::kFails;
  std::vector<AccuracyPicture> pictures;
};

// A figure that has a bar of its own, or none (0) and is for information.
struct CheckValue {
  std::string what;
  double value = 0;
  double error = 0;  // standard error; 0: none stated
  double bar = 0;
};
struct AccuracyCheck {
  std::string name, setup;
  std::vector<CheckValue> values;
  std::vector<AccuracyPicture> pictures;

  // Fails if a value is above its bar.
  Verdict verdict() const;
};

struct LeftOut {
  std::string name, why;
};

struct AccuracyReport {
  AccuracyOptions options;
  std::string date_utc, cpu;
  unsigned threads = 0;
  double load_average_start = 0, load_average_end = 0;
  std::vector<AccuracyResult> results;
  std::vector<AccuracyCheck> checks;
  std::vector<LeftOut> left_out;
};

// The names that --case takes, in the order in which they run: cases, then checks.
std::vector<std::string> AccuracyNames(bool quick);

// Bakes each case, renders it once by fpbgi as tiles of 128 pixels, makes or reads its truth and
// compares. Pixels that hit nothing do not count. kInvalidArgument: an unknown case, settings that
// do not fit, a scene without indirect light.
absl::StatusOr<AccuracyReport> RunAccuracy(const AccuracyOptions& options,
                                           const std::function<void(std::string_view)>& progress);

}  // namespace farpoint

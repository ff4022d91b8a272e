// Numerical stability under stress: scenes that are moved, damaged or built to break a kernel, each
// rendered by fpbgi, pbgi and pt and held against what must come out. docs/numerics.md lists the
// cases.
#pragma once

#include <cstdint>
#include <functional>
#include <string>
#include <string_view>
#include <vector>

#include "bench/accuracy.h"
#include "core/base/status.h"

namespace farpoint {

struct StabilityOptions {
  std::vector<std::string> cases;  // names, see StabilityNames; empty: all
  std::string scenes_dir;          // of others; Sponza is left out without it
  uint64_t points = 0;             // surfels; 0: 20,000, quick: 2,500
  uint32_t light_samples = 16;
  uint64_t seed = 0;
  unsigned threads = 0;  // 0: all cores
  bool quick = false;    // the Cornell box only, small
};

// One figure and what it may be at most. Figures without a bar are not made: each can fail.
struct StabilityValue {
  std::string integrator;  // "fpbgi", "pbgi", "pt"; "scene": none of them
  std::string what;        // what was done and what the figure is
  double value = 0;
  double noise = 0;  // of the reference, where it has one
  double bar = 0;    // value <= bar holds; a value that is not a number does not

  bool holds() const { return value <= bar; }
};

struct StabilityResult {
  std::string name;   // of the case
  std::string group;  // "invariance", "geometry", "lights and cameras", "algorithm", "sums"
  std::string scene;  // that it was rendered on
  std::string check;  // what is held against what, in words
  std::vector<StabilityValue> values;
  double seconds = 0;  // by the clock

  size_t failures() const;
};

struct StabilityReport {
  StabilityOptions options;
  std::string date_utc, cpu;
  unsigned threads = 0;
  double load_average_start = 0, load_average_end = 0;
  std::vector<StabilityResult> results;
  std::vector<LeftOut> left_out;

  size_t failures() const;
};

// The names that --case takes, in the order in which they run.
std::vector<std::string> StabilityNames();

// Renders the cases and compares. What fails is a figure above its bar, not an error.
// kInvalidArgument: an unknown case, or settings that do not fit.
absl::StatusOr<StabilityReport> RunStability(const StabilityOptions& options,
                                             const std::function<void(std::string_view)>& progress);

}  // namespace farpoint

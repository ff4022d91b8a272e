// What each item that a frame leaves out saves where there is much of it, and what it costs to ask
// where there is nothing: docs/skipping.md.
#pragma once

#include <cstdint>
#include <functional>
#include <string>
#include <string_view>
#include <vector>

#include "bench/accuracy.h"
#include "core/base/status.h"

namespace farpoint {

struct SkipOptions {
  std::vector<std::string> cases;  // names, see SkipNames; empty: all
  std::string scenes_dir;          // of others; Sponza is left out without it
  uint64_t points = 0;             // surfels; 0: 100,000, quick: 3,000
  uint32_t light_samples = 16;
  uint64_t seed = 0;
  uint32_t repeat = 0;   // rounds; 0: 7, quick: 1
  unsigned threads = 1;  // 0: all cores; 1 disturbs the times least
  bool quick = false;    // small frames, one round: bits and counts
};

// One scene, with and without the item.
struct SkipSide {
  bool profits = false;  // false: there is nothing to leave out
  std::string scene;     // and what was rendered or baked of it
  uint64_t skipped = 0;  // the item's counter
  // Processor seconds, medians of the rounds.
  double with_s = 0, without_s = 0;
  // Time with the item over that without it, of each round: median, and the quartiles.
  double ratio = 1, ratio_low = 1, ratio_high = 1;
  // What became of the image, or of the bake's blobs.
  bool bits_equal = true;
  double rr = 0, bias = 0;  // of the image with the item against that without, relative
};

struct SkipRow {
  std::string name;     // as --case takes it
  std::string counter;  // of --json: skipped.*
  std::string what;
  bool exact = true;
  double rr_bar = 0;  // of an item that is not exact
  std::vector<SkipSide> sides;

  // What is not as promised: bits, an error above its bar, a counter that should count or should
  // not. Times are no failures.
  std::vector<std::string> failures() const;
};

struct SkipReport {
  SkipOptions options;
  std::string date_utc, cpu;
  unsigned threads = 0;
  double load_average_start = 0, load_average_end = 0;
  std::vector<SkipRow> rows;
  std::vector<LeftOut> left_out;

  size_t failures() const;
};

// The names that --case takes, in the order of the report.
std::vector<std::string> SkipNames();

// kInvalidArgument: an unknown case, or settings that do not fit.
absl::StatusOr<SkipReport> RunSkip(const SkipOptions& options,
                                   const std::function<void(std::string_view)>& progress);

}  // namespace farpoint

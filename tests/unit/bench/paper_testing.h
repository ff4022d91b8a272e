// A tiny run, made once for all tests of the process.
#pragma once

#include "bench/paper.h"

namespace farpoint {

inline PaperOptions TinyPaperOptions() {
  PaperOptions options;
  options.scene = "cornell";
  options.quick = true;
  options.light_samples = 8;
  options.threads = 2;
  options.reference_budget_s = 0.5;
  return options;
}

inline const absl::StatusOr<PaperReport>& TinyPaper() {
  static const absl::StatusOr<PaperReport> report =
      RunPaper(TinyPaperOptions(), [](std::string_view) {});
  return report;
}

// The same with pbgi and dpbgi of the whole frame.
inline const absl::StatusOr<PaperReport>& TinyFullPaper() {
  static const absl::StatusOr<PaperReport> report = [] {
    PaperOptions options = TinyPaperOptions();
    options.full = true;
    return RunPaper(options, [](std::string_view) {});
  }();
  return report;
}

}  // namespace farpoint

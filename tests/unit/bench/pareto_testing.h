// A tiny run, made once for all tests of the process.
#pragma once

#include "bench/pareto.h"

namespace farpoint {

inline ParetoOptions TinyOptions() {
  ParetoOptions options;
  options.width = options.height = 32;
  options.points = 4000;
  options.light_samples = 16;
  options.quick = true;
  options.threads = 2;
  return options;
}

inline const absl::StatusOr<ParetoReport>& TinyReport() {
  static const absl::StatusOr<ParetoReport> report = [] {
    ParetoOptions options = TinyOptions();
    options.repeat = 2;
    return RunPareto(options, [](std::string_view) {});
  }();
  return report;
}

}  // namespace farpoint

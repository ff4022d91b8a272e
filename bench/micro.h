// The kernels, one by one, on Google Benchmark: one scene, one seed, one thread.
#pragma once

#include <iosfwd>
#include <string>

#include "core/base/status.h"

namespace farpoint {

struct MicroOptions {
  std::string json_path;  // Google Benchmark's own JSON; written beside its place and renamed
  std::string filter;     // a regular expression on names; empty: all
  bool quick = false;     // few surfels, short runs: a check that all works, not a measurement
};

// Runs the benchmarks, prints to `out`. kInvalidArgument if no name matches the filter. Google
// Benchmark's registry is the process's: one call at a time, and the JSON's context (version,
// surfels, receivers, quick) is that of the first.
absl::Status RunMicro(const MicroOptions& options, std::ostream& out);

}  // namespace farpoint

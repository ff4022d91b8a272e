// The pictures of docs/how-it-works.md, docs/parameters.md and docs/more-light.md, made by the
// product's own parts, so that they can be made again: docs/benchmarks.md.
#pragma once

#include <cstdint>
#include <functional>
#include <string>
#include <string_view>
#include <vector>

#include "core/base/status.h"

namespace farpoint {

struct FiguresOptions {
  int side_px = 256;     // of a rendered frame, a multiple of 32, 64..512
  uint32_t paths = 512;  // of the reference that errors are measured against
  uint64_t seed = 0;
  unsigned threads = 0;  // 0: all cores
  bool quick = false;    // 64 pixels, 256 paths, fewer values: a check that all works
};

// One value of a parameter, rendered.
struct FigureRow {
  std::string parameter;  // "--clusters"; rows of one parameter stand together, one picture each
  std::string value;
  double gather_s = 0;      // thread-seconds of the indirect light
  double bake_s = 0;        // thread-seconds of surfels and tree
  double rr = 0, bias = 0;  // of the irradiance, against path tracing with its own noise taken out
};

struct FiguresReport {
  FiguresOptions options;
  std::vector<std::string> files;  // names, without folder
  std::vector<FigureRow> rows;
  double noise = 0;  // of the reference: root mean square standard error over mean
};

// Writes the pictures into `folder`, which exists. Errors name the file.
absl::StatusOr<FiguresReport> RunFigures(const FiguresOptions& options, const std::string& folder,
                                         const std::function<void(std::string_view)>& log);

// The rows as tables for docs/parameters.md, one per parameter.
std::string FiguresTables(const FiguresReport& report);
std::string FiguresJson(const FiguresReport& report);

}  // namespace farpoint

// The command line of farpoint-bench. CLI11 is included in the .cc only.
#pragma once

#include <optional>
#include <string>
#include <vector>

#include "bench/accuracy.h"
#include "bench/antialiasing.h"
#include "bench/figures.h"
#include "bench/lights.h"
#include "bench/micro.h"
#include "bench/paper.h"
#include "bench/pareto.h"
#include "bench/rebake.h"
#include "bench/scale.h"
#include "bench/service.h"
#include "bench/skip.h"
#include "bench/stability.h"
#include "core/base/status.h"

namespace farpoint {

enum class BenchVerb {
  kPareto,
  kMicro,
  kRebake,
  kLights,
  kAccuracy,
  kPaper,
  kStability,
  kScale,
  kSkip,
  kService,
  kFigures,
  kAntialiasing
};

struct BenchCommandLine {
  std::optional<std::string> print;  // help or version: print it and do nothing else
  BenchVerb verb = BenchVerb::kPareto;
  std::string output_dir;
  ParetoOptions pareto;
  RebakeOptions rebake;
  LightsOptions lights;
  AccuracyOptions accuracy;
  PaperOptions paper;
  StabilityOptions stability;
  ScaleOptions scale;
  SkipOptions skip;
  ServiceOptions service;
  FiguresOptions figures;
  AntialiasingOptions antialiasing;
  MicroOptions micro;  // json_path is left empty: it lies in output_dir
};

// `args` without the program's name. Errors are for a person, one line first: kInvalidArgument for
// a wrong command line.
absl::StatusOr<BenchCommandLine> ParseBenchCommandLine(std::vector<std::string> args);

}  // namespace farpoint

// The flags that `render` and `submit` share: what each means, and what it refuses. Knows nothing
// of how a command line is split (command_line.cc does that).
#pragma once

#include <optional>
#include <span>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

#include "core/base/status.h"
#include "proto/job.h"

namespace farpoint {

// The frame if neither job file nor flags name one.
inline constexpr int kDefaultWidth = 1280, kDefaultHeight = 720;

// A job while flags change it. What belongs together (a free camera's parts) is kept apart until
// all flags are known.
struct JobEdit {
  JobSpec spec;
  std::optional<std::string> camera_name;
  std::optional<Vec3d> eye, target, up;
  std::optional<double> yfov_deg;
  bool suns_replaced = false;  // the first --sun drops the job file's
};

struct RenderFlag {
  std::string_view name;     // with its dashes
  std::string_view metavar;  // "WxH"; empty for a flag without value
  std::string_view group;    // heading in --help
  std::string_view help;
  // Changes `edit`; kInvalidArgument says what is wrong with the value and what is allowed
  // (without the flag's name). Values that are out of a setting's range may be left to
  // ValidateSettings.
  absl::Status (*apply)(std::string_view value, JobEdit& edit);
  bool repeatable = false;  // else the last value counts
};

// In the order in which they are applied: --preset before what it presets, --resolution before
// --crop.
std::span<const RenderFlag> RenderFlags();

// A flag as it was given; the value is "" for a flag without one.
using GivenFlag = std::pair<std::string, std::string>;

// Applies the flags to `spec` (what came from a job file, or the defaults) in the order of
// RenderFlags(). kInvalidArgument names the flag, its value and what is allowed; `spec` is then
// unchanged. A film that neither had becomes kDefaultWidth x kDefaultHeight. --env leaves a path of
// this machine in overrides.environment->uri: PrepareRequest reads it.
absl::Status ApplyRenderFlags(std::span<const GivenFlag> given, JobSpec& spec);

// A line for each given flag that cannot matter under the settings that came of all flags: which,
// why, and where it counts. In the order of RenderFlags().
std::vector<std::string> IneffectiveFlags(std::span<const GivenFlag> given,
                                          const RenderSettings& settings);

// kInvalidArgument unless the name is that of a job file or of a scene format that is known.
absl::Status CheckScenePath(std::string_view path);
bool IsJobFile(std::string_view path);

}  // namespace farpoint

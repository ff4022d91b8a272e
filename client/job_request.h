// From the command line's SCENE and render flags to a job whose files are at hand.
#pragma once

#include <span>
#include <string>
#include <vector>

#include "client/render_flags.h"
#include "core/base/status.h"
#include "core/scene/asset.h"
#include "proto/job.h"

namespace farpoint {

struct PreparedRequest {
  JobSpec spec;       // complete and valid
  AssetBundle asset;  // the files that spec.asset_files names
  // What a user should know, one line each: --fps and frames that have no effect.
  std::vector<std::string> notes;
  // Flags of the method that have no effect, see IneffectiveFlags.
  std::vector<std::string> warnings;
};

// `scene` is a scene or a job file. A job file's paths (asset, environment map) are relative to it,
// those of flags to the working folder; flags override what the file says. The environment map is
// read and becomes one of the asset's files, "env/NAME". `usage_error` tells whose fault a failure
// is: the command line's (exit code 2) or a file's (see ExitCodeOf).
absl::StatusOr<PreparedRequest> PrepareRequest(const std::string& scene,
                                               std::span<const GivenFlag> flags, bool& usage_error);

// The job of one of its frames alone. `frame` is below spec.frame_count().
JobSpec SpecOfFrame(const JobSpec& spec, uint32_t frame);

// The job as JSON without what changes only its speed or when it runs, its limits and its
// title: equal for jobs whose pixels are equal by contract. Indented.
std::string ImageSettingsJson(const JobSpec& spec);
// SHA-256 of the same content.
Digest JobHash(const JobSpec& spec);

}  // namespace farpoint

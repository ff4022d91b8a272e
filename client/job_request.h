// From the command line's SCENE and render flags to a job whose files are at hand.
#pragma once

#include <span>
#include <string>

#include "client/render_flags.h"
#include "core/base/status.h"
#include "core/scene/asset.h"
#include "proto/job.h"

namespace farpoint {

struct PreparedRequest {
  JobSpec spec;       // complete and valid
  AssetBundle asset;  // the files that spec.asset_files names
};

// `scene` is .gltf, .glb or a job file. A job file's asset path is relative to the job file; flags
// override what the file says. `usage_error` tells whose fault a failure is: the command line's
// (exit code 2) or a file's (see ExitCodeOf).
absl::StatusOr<PreparedRequest> PrepareRequest(const std::string& scene,
                                               std::span<const GivenFlag> flags, bool& usage_error);

// The job as JSON without what changes only its speed, its limits and its title: equal for jobs
// whose pixels are equal by contract. Indented.
std::string ImageSettingsJson(const JobSpec& spec);
// SHA-256 of the same content.
Digest JobHash(const JobSpec& spec);

}  // namespace farpoint

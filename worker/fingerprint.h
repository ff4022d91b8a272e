// What this machine's arithmetic makes of a small fixed picture. Two workers with one fingerprint
// give one image the same bits (docs/decisions/0001-determinism.md); a processor whose reciprocals
// differ, or another version of farpoint, Embree or the compiler, has another fingerprint.
#pragma once

#include "core/base/executor.h"
#include "core/base/hash.h"
#include "core/base/status.h"

namespace farpoint {

// SHA-256 over those versions and the hashes of a 32x32 picture of the Cornell box by the
// factorized integrator and by the path tracer, few points and paths. Takes well under a second;
// independent of the executor.
absl::StatusOr<Digest> ComputeFingerprint(Executor& executor);

}  // namespace farpoint

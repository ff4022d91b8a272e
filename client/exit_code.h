// What the process tells its caller (docs/commands.md).
#pragma once

#include "core/base/status.h"

namespace farpoint {

enum ExitCode : int {
  kExitOk = 0,
  kExitUsage = 2,          // the command line is wrong
  kExitPermanent = 42,     // the scene, the job or the settings are wrong: trying again is useless
  kExitTryAgain = 75,      // a peer or a resource was missing: the same command may succeed later
  kExitInterrupted = 130,  // SIGINT
  kExitTerminated = 143,   // SIGTERM
};

// OK: 0. kUnavailable, kDeadlineExceeded, kAborted: 75. All others: 42, limits
// (kResourceExhausted) among them: trying again will not cure them.
int ExitCodeOf(const absl::Status& status);

}  // namespace farpoint

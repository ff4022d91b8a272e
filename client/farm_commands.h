// The commands that ask a coordinator about jobs and workers, or tell it what to do with them. None
// of them fetches an image.
#pragma once

#include <string>

#include "client/command_line.h"
#include "client/console.h"
#include "client/farm_link.h"
#include "client/retry.h"
#include "client/stop_flag.h"
#include "core/base/status.h"

namespace farpoint {

// What each of them needs. The references must outlive the call.
struct FarmSession {
  const CommandLine& line;
  FarmLink& farm;
  Retry& retry;
  const StopFlag& stop;
  Console& console;
};

absl::Status RunStatus(FarmSession session);
absl::Status RunWorkers(FarmSession session);
// pause, resume, cancel, requeue, priority: each job in turn. A job that cannot be found does not
// keep the others from their turn; the first error is returned, further ones are shown.
absl::Status RunControl(FarmSession session);
// What came of one of them: the job's state, and what to do if the command did nothing.
std::string ControlText(Verb verb, const JobStatus& status);
// Until the jobs have ended. OK if all are done; else the worst of their outcomes, a permanent
// failure before one that may heal; the others are shown.
absl::Status RunWatch(FarmSession session);
absl::Status RunLogs(FarmSession session);
absl::Status RunExplain(FarmSession session);

}  // namespace farpoint

// A job from the client's side: submit, watch, fetch and stitch. The same for a farm and for the
// embedded mode; only the link differs.
#pragma once

#include <string>

#include "client/console.h"
#include "client/farm_link.h"
#include "client/job_request.h"
#include "client/retry.h"
#include "client/stop_flag.h"
#include "core/base/status.h"
#include "core/image/film.h"

namespace farpoint {

struct FinishedJob {
  JobInfo info;
  Film film;  // of the crop, rounded to storage; every tile's hash was checked
};

// Not thread-safe. The references must outlive this.
class JobRun {
 public:
  JobRun(FarmLink& link, Retry& retry, const StopFlag& stop, Console& console)
      : link_(link), retry_(retry), stop_(stop), console_(console) {}

  // Sends the blobs that the coordinator lacks, then the job. Survives a coordinator that comes
  // back: the job is made once.
  absl::StatusOr<JobId> Submit(const PreparedRequest& request);

  // Until the job is done (OK). A failed job's own error; kCancelled if the job was cancelled or
  // `stop` raised. Shows notes and progress.
  absl::Status Wait(const JobId& job);

  // Every tile of a job that is done, checked and stitched. A damaged tile is fetched again, a few
  // times, then kUnavailable. kFailedPrecondition if the job is not done.
  absl::StatusOr<FinishedJob> Fetch(const JobId& job);

 private:
  FarmLink& link_;
  Retry& retry_;
  const StopFlag& stop_;
  Console& console_;
};

// The state of a job that has ended as a status: OK if it is done.
absl::Status OutcomeOf(const JobStatus& status);

}  // namespace farpoint

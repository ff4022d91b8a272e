// What the client needs of a coordinator, whether over a socket (grpc_farm_link.h) or within the
// process (embedded_farm.h). One call is one attempt; who calls decides about trying again.
//
// Errors: kUnavailable and kDeadlineExceeded mean that the coordinator was not reached (try again);
// all others are its answer. A link is made with a StopFlag; when that is raised, calls that would
// take long end with kCancelled. Not thread-safe.
#pragma once

#include <functional>
#include <span>
#include <string>
#include <vector>

#include "core/base/blob.h"
#include "core/base/hash.h"
#include "core/base/status.h"
#include "proto/job.h"

namespace farpoint {

struct FarmStatus {
  std::vector<JobStatus> jobs;
  std::vector<WorkerStatus> workers;
};

class FarmLink {
 public:
  virtual ~FarmLink() = default;

  // Those of `blobs` that the coordinator does not have.
  virtual absl::StatusOr<std::vector<Digest>> FindMissing(std::span<const Digest> blobs) = 0;
  virtual absl::Status Put(const Digest& digest, const Blob& blob) = 0;

  // A repeated `submission_id` answers the job that the first one made.
  virtual absl::StatusOr<JobId> Submit(const JobSpec& spec, const std::string& submission_id) = 0;

  // An empty id: all jobs and workers. kNotFound for an unknown one.
  virtual absl::StatusOr<FarmStatus> Status(const JobId& job) = 0;
  // What a repeated call does stands in server/coordinator.h: nothing more than the first one.
  virtual absl::Status Cancel(const JobId& job) = 0;
  virtual absl::Status Pause(const JobId& job) = 0;
  virtual absl::Status Resume(const JobId& job) = 0;
  virtual absl::Status SetPriority(const JobId& job, int32_t priority) = 0;
  virtual absl::Status Requeue(const JobId& job, bool all) = 0;
  virtual absl::StatusOr<Explanation> Explain(const JobId& job) = 0;

  // Calls `on_event` with every event after `after_sequence`, in order, until the job has ended. An
  // error of `on_event` ends the call and is returned.
  virtual absl::Status Watch(const JobId& job, uint64_t after_sequence,
                             const std::function<absl::Status(const JobEvent&)>& on_event) = 0;

  // kUnimplemented: a coordinator before this question, or one within the process.
  virtual absl::StatusOr<CoordinatorHealth> Diagnose() {
    return absl::UnimplementedError("this coordinator cannot be asked how it is");
  }

  virtual absl::StatusOr<JobInfo> Info(const JobId& job) = 0;

  // Calls `on_tile` with each of `tiles`, in any order. The bytes' hashes are not checked here. An
  // error of `on_tile` ends the call and is returned.
  virtual absl::Status FetchTiles(const JobId& job, std::span<const uint32_t> tiles,
                                  const std::function<absl::Status(TileData)>& on_tile) = 0;
};

}  // namespace farpoint

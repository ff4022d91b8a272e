// What a worker needs of a coordinator. Implemented over gRPC (worker/grpc_link.h) and within one
// process (worker/in_process_link.h); tests supply fakes. All methods are thread-safe.
#pragma once

#include <chrono>
#include <cstdint>
#include <functional>
#include <optional>
#include <span>

#include "core/base/blob.h"
#include "core/base/hash.h"
#include "core/base/status.h"
#include "proto/job.h"

namespace farpoint {

// Errors: kUnavailable or kDeadlineExceeded: the coordinator cannot be reached now, try again;
// kNotFound: it does not know this worker (it was restarted), register again; all others are
// refusals that trying again will not change.
class CoordinatorLink {
 public:
  virtual ~CoordinatorLink() = default;
  virtual absl::StatusOr<WorkerWelcome> Register(const WorkerHello& hello) = 0;
  // Waits up to `wait` for work.
  virtual absl::StatusOr<std::optional<TileWork>> Lease(const WorkerId& worker,
                                                        std::chrono::milliseconds wait) = 0;
  virtual absl::StatusOr<RenewAnswer> Renew(const WorkerId& worker, const LeaseId& lease,
                                            const LeaseProgress& progress) = 0;
  virtual absl::StatusOr<ReturnAnswer> Return(const WorkerId& worker, const TileResult& result) = 0;
  virtual absl::Status ReportFailure(const WorkerId& worker, const LeaseId& lease, bool given_back,
                                     const absl::Status& error) = 0;
  virtual absl::Status Leave(const WorkerId& worker) = 0;
  // From now on, until it leaves or the next one attends, the coordinator sees at once when this
  // process is gone. Returns at once; nothing is done where calls do not cross processes.
  virtual void Attend(const WorkerId& worker) { (void)worker; }
  // Ends a wait in Lease() soon, and those to come: kCancelled.
  virtual void CancelWaits() = 0;
};

// A blob's bytes from `offset` on, in order; `sink` gets the size of the whole blob and the next
// bytes, on the calling thread, and its error ends the stream. kNotFound if the coordinator does
// not have it. Thread-safe.
class BlobStreamer {
 public:
  using Sink = std::function<absl::Status(uint64_t size_bytes, std::span<const std::byte> data)>;
  virtual ~BlobStreamer() = default;
  virtual absl::Status Stream(const Digest& digest, uint64_t offset_bytes, const Sink& sink) = 0;
};

// Where blobs come from.
class BlobSource {
 public:
  virtual ~BlobSource() = default;
  // Verified by its hash. `progress` (may be empty) is called as bytes arrive, on this thread; if
  // it returns false, the result is kCancelled.
  virtual absl::StatusOr<Blob> Get(const Digest& digest, const std::function<bool()>& progress) = 0;
};

}  // namespace farpoint

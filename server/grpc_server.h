// The coordinator on a socket: BlobService, JobService and WorkerService, gRPC health v1 and
// reflection.
#pragma once

#include <chrono>
#include <memory>
#include <string>

#include "core/base/status.h"
#include "server/coordinator.h"

namespace farpoint {

class GrpcServer {
 public:
  // Listens on `address` (host:port, port 0: any free one). kUnavailable if it is taken.
  // `coordinator` must outlive this.
  static absl::StatusOr<std::unique_ptr<GrpcServer>> Start(CoordinatorApi& coordinator,
                                                           const std::string& address);
  virtual ~GrpcServer() = default;  // Shutdown(0)

  virtual int port() const = 0;
  // Health says NOT_SERVING from now on; calls still go through.
  virtual void StopServing() = 0;
  // Takes no more calls; those in progress have `grace` to end.
  virtual void Shutdown(std::chrono::milliseconds grace) = 0;
};

}  // namespace farpoint

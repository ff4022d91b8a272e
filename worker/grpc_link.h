// The worker's side of the wire: v1::WorkerService and v1::BlobService of a coordinator. Connects
// in the background and again after a loss; every call has a deadline.
#pragma once

#include <memory>
#include <string>

#include "worker/coordinator_link.h"

namespace farpoint {

class GrpcLink : public CoordinatorLink, public BlobStreamer {
 public:
  // `address`: host:port.
  static std::unique_ptr<GrpcLink> Connect(const std::string& address);
};

}  // namespace farpoint

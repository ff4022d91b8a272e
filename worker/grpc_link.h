// The worker's side of the wire: v1::WorkerService and v1::BlobService of a coordinator. Connects
// in the background and again after a loss; every call has a deadline. A chunk of a blob that does
// not have its hash is dropped: kUnavailable, since the bytes before it are good.
#pragma once

#include <memory>
#include <string>

#include "proto/connection_probe.h"
#include "worker/coordinator_link.h"

namespace farpoint {

class GrpcLink : public CoordinatorLink, public BlobStreamer {
 public:
  // `address`: host:port. Register says why a connection fails, where that can be found out
  // (proto/connection_probe.h).
  static std::unique_ptr<GrpcLink> Connect(const std::string& address,
                                           const ChannelSecurity& security = {});
  // Calls from now on go over a new connection, with this certificate: the old one expires.
  // Thread-safe.
  virtual void Reconnect(const ChannelSecurity& security) = 0;
};

}  // namespace farpoint

// A coordinator over gRPC. Every call has a deadline; keepalive pings find a cut link within
// seconds. Connecting happens at the first call.
#pragma once

#include <memory>
#include <string>

#include "client/farm_link.h"
#include "client/stop_flag.h"
#include "proto/connection_probe.h"

namespace farpoint {

// `address` is HOST:PORT. `stop` must outlive the link. Until the coordinator has answered once, a
// connection that fails is looked into (proto/connection_probe.h), so that the error says what is
// wrong.
std::unique_ptr<FarmLink> MakeGrpcFarmLink(const std::string& address, const StopFlag& stop,
                                           const ChannelSecurity& security = {});

}  // namespace farpoint

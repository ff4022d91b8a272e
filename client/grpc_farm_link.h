// A coordinator over gRPC. Every call has a deadline; keepalive pings find a cut link within
// seconds. Connecting happens at the first call.
#pragma once

#include <memory>
#include <string>

#include "client/farm_link.h"
#include "client/stop_flag.h"

namespace farpoint {

// `address` is HOST:PORT. `stop` must outlive the link.
std::unique_ptr<FarmLink> MakeGrpcFarmLink(const std::string& address, const StopFlag& stop);

}  // namespace farpoint

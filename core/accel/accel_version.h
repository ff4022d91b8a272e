// Which version of Embree traces the rays of this process.
#pragma once

#include <string>

#include "core/base/status.h"

namespace farpoint {

// "embree 3.13.5": of the library that was loaded, which may be newer than the headers. Two
// versions may answer a query by other bits, so whoever compares pixels compares this first.
// kUnavailable if Embree gives no device.
absl::StatusOr<std::string> AccelVersion();

}  // namespace farpoint

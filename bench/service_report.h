// What `farpoint-bench service` prints and leaves.
#pragma once

#include <string>

#include "bench/service.h"

namespace farpoint {

// A line for each check.
std::string ServiceTable(const ServiceReport& report);
std::string ServiceJson(const ServiceReport& report);
std::string ServiceHtml(const ServiceReport& report);

}  // namespace farpoint

// What `farpoint-bench stability` prints and leaves.
#pragma once

#include <string>

#include "bench/stability.h"

namespace farpoint {

// One line for each case and scene, then one for each figure above its bar.
std::string StabilityTable(const StabilityReport& report);
std::string StabilityJson(const StabilityReport& report);
std::string StabilityHtml(const StabilityReport& report);

}  // namespace farpoint

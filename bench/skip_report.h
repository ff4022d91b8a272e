// What `farpoint-bench skip` prints and leaves.
#pragma once

#include <string>

#include "bench/skip.h"

namespace farpoint {

// One line for each item and scene, then one for each failure.
std::string SkipTable(const SkipReport& report);
std::string SkipJson(const SkipReport& report);
std::string SkipHtml(const SkipReport& report);

}  // namespace farpoint

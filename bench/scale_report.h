// What `farpoint-bench scale` prints and leaves.
#pragma once

#include <string>

#include "bench/scale.h"

namespace farpoint {

std::string ScaleTable(const ScaleReport& report);
std::string ScaleJson(const ScaleReport& report);
std::string ScaleHtml(const ScaleReport& report);

}  // namespace farpoint

// What `farpoint-bench accuracy` prints and leaves.
#pragma once

#include <string>

#include "bench/accuracy.h"

namespace farpoint {

std::string AccuracyTable(const AccuracyReport& report);
std::string AccuracyJson(const AccuracyReport& report);
// Needs nothing beside it: pictures are inside.
absl::StatusOr<std::string> AccuracyHtml(const AccuracyReport& report);

}  // namespace farpoint

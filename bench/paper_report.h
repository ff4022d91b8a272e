// What `farpoint-bench paper` prints and leaves.
#pragma once

#include <string>

#include "bench/paper.h"
#include "core/base/status.h"

namespace farpoint {

// For a terminal: the paper's Table 1 with ours above, and errors against pbgi and the truth.
std::string PaperTable(const PaperReport& report);
// All figures; pictures are in the page only.
std::string PaperJson(const PaperReport& report);
// Needs nothing beside it. kInvalidArgument for a picture whose size does not match.
absl::StatusOr<std::string> PaperHtml(const PaperReport& report);

}  // namespace farpoint

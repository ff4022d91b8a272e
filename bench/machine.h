// What a report says of the machine and the moment that it was made on and at.
#pragma once

#include <string>

namespace farpoint {

// "model name" of /proc/cpuinfo; "unknown" where there is none.
std::string CpuModel();
// Over the last minute: processes that run or wait for a processor; 0 if it is not known.
double LoadAverage();
// Now, as 2013-07-15T12:00:00Z.
std::string DateUtc();

}  // namespace farpoint

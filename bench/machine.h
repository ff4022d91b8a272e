// What a report says of the machine and the moment that it was made on and at.
#pragma once

#include <string>
#include <string_view>

namespace farpoint {

// "model name" of /proc/cpuinfo; "unknown" where there is none.
std::string CpuModel();
// Over the last minute: processes that run or wait for a processor; 0 if it is not known.
double LoadAverage();
// "CPU, 2 threads, load 0.1 at the start and 2.0 at the end".
std::string MachineText(std::string_view cpu, unsigned threads, double load_start, double load_end);
// Now, as 2013-07-15T12:00:00Z.
std::string DateUtc();

}  // namespace farpoint

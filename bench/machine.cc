#include "bench/machine.h"

#include <cstdlib>
#include <ctime>
#include <fstream>

#include "absl/strings/str_format.h"

namespace farpoint {

std::string CpuModel() {
  std::ifstream info("/proc/cpuinfo");
  for (std::string line; std::getline(info, line);) {
    if (!line.starts_with("model name")) continue;
    const size_t colon = line.find(": ");
    if (colon != std::string::npos) return line.substr(colon + 2);
  }
  return "unknown";
}

double LoadAverage() {
  double load = 0;
  return getloadavg(&load, 1) == 1 ? load : 0.0;
}

std::string MachineText(std::string_view cpu, unsigned threads, double load_start,
                        double load_end) {
  return absl::StrFormat("%s, %d thread%s, load %.1f at the start and %.1f at the end", cpu,
                         threads, threads == 1 ? "" : "s", load_start, load_end);
}

std::string DateUtc() {
  const std::time_t now = std::time(nullptr);
  std::tm utc{};
  gmtime_r(&now, &utc);
  char text[32];
  std::strftime(text, sizeof(text), "%Y-%m-%dT%H:%M:%SZ", &utc);
  return text;
}

}  // namespace farpoint

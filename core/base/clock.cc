#include "core/base/clock.h"

#include <ctime>

namespace farpoint {

namespace {

double ReadSeconds(clockid_t clock) {
  timespec t{};
  ::clock_gettime(clock, &t);
  return static_cast<double>(t.tv_sec) + 1e-9 * static_cast<double>(t.tv_nsec);
}

}  // namespace

double ThreadCpuSeconds() { return ReadSeconds(CLOCK_THREAD_CPUTIME_ID); }

double ProcessCpuSeconds() { return ReadSeconds(CLOCK_PROCESS_CPUTIME_ID); }

}  // namespace farpoint

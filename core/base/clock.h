// Time that can be injected: services take a Clock, tests move a FakeClock by hand.
#pragma once

#include <atomic>
#include <chrono>

namespace farpoint {

using TimePoint = std::chrono::steady_clock::time_point;
using Duration = std::chrono::steady_clock::duration;

class Clock {
 public:
  virtual ~Clock() = default;
  // Monotonic. Thread-safe.
  virtual TimePoint Now() const = 0;
};

class SteadyClock final : public Clock {
 public:
  TimePoint Now() const override { return std::chrono::steady_clock::now(); }
};

class FakeClock final : public Clock {
 public:
  TimePoint Now() const override { return TimePoint(Duration(ticks_.load())); }
  void Advance(Duration d) { ticks_ += d.count(); }

 private:
  std::atomic<Duration::rep> ticks_{Duration(std::chrono::hours(1)).count()};
};

// Seconds of processor time that the calling thread has used.
double ThreadCpuSeconds();
// Seconds of processor time that all threads of the process have used.
double ProcessCpuSeconds();

}  // namespace farpoint

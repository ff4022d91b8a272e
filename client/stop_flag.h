// Ctrl-C and SIGTERM as a value that can be asked.
#pragma once

#include <atomic>
#include <chrono>

namespace farpoint {

class StopFlag {
 public:
  // Async-signal-safe.
  void Raise(int signal) { signal_.store(signal); }
  // 0, or the signal that was raised.
  int signal() const { return signal_.load(); }
  bool raised() const { return signal() != 0; }

  // Sleeps in small steps; false at once when the flag is raised.
  bool SleepFor(std::chrono::milliseconds time) const;

 private:
  std::atomic<int> signal_{0};
  static_assert(std::atomic<int>::is_always_lock_free);
};

// The flag that SIGINT and SIGTERM of this process raise. The first call installs the handlers; a
// second signal ends the process at once. SIGPIPE is ignored.
StopFlag& ProcessStopFlag();

}  // namespace farpoint

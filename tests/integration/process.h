// Child processes that never outlive their test.
#pragma once

#include <sys/types.h>

#include <chrono>
#include <map>
#include <optional>
#include <string>
#include <thread>
#include <vector>

namespace farpoint {

// Asks `condition` every few milliseconds; false if it did not hold within `time`.
template <typename Condition>
bool WaitUntil(std::chrono::milliseconds time, Condition&& condition) {
  const auto end = std::chrono::steady_clock::now() + time;
  while (true) {
    if (condition()) return true;
    if (std::chrono::steady_clock::now() >= end) return false;
    std::this_thread::sleep_for(std::chrono::milliseconds(10));
  }
}

class Process {
 public:
  // Starts `args[0]` with stdout and stderr in the files `out` and `err` (appended). Aborts the
  // test program if that fails.
  Process(const std::vector<std::string>& args, const std::string& out, const std::string& err,
          const std::map<std::string, std::string>& environment = {});
  // Kills it if it still runs, and waits for it.
  ~Process();
  Process(const Process&) = delete;
  Process& operator=(const Process&) = delete;

  pid_t pid() const { return pid_; }
  void Signal(int signal);
  bool Running();
  // Its exit code, 128 + n if signal n ended it, none if it still runs after `time`.
  std::optional<int> Wait(std::chrono::milliseconds time);

 private:
  void Reap(bool block);

  pid_t pid_ = -1;
  std::optional<int> exit_code_;
};

}  // namespace farpoint

// Child processes that never outlive this one, with what they cost.
#pragma once

#include <sys/types.h>

#include <chrono>
#include <cstdint>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "core/base/status.h"

namespace farpoint {

struct ProcessOptions {
  std::string log;              // stdout and stderr are appended here
  uint64_t max_file_bytes = 0;  // RLIMIT_FSIZE; 0: none
  std::string network;          // name of a network namespace; empty: this one's
};

// Not thread-safe.
class ChildProcess {
 public:
  // kUnavailable if it cannot be forked; a program that cannot be executed exits with 127.
  static absl::StatusOr<std::unique_ptr<ChildProcess>> Start(const std::vector<std::string>& args,
                                                             const ProcessOptions& options);
  ~ChildProcess();  // kills it and waits for it
  ChildProcess(const ChildProcess&) = delete;
  ChildProcess& operator=(const ChildProcess&) = delete;

  pid_t pid() const { return pid_; }
  void Signal(int signal);
  bool Running();
  // Its exit code, 128 + n if signal n ended it; none if it still runs after `time`.
  std::optional<int> Wait(std::chrono::milliseconds time);
  void Kill();  // SIGKILL, and waits
  // Processor seconds of all of its threads, once it has ended.
  double cpu_seconds() const { return cpu_seconds_; }
  // kB of /proc/PID/status, such as "RssAnon"; 0 if it is not there.
  uint64_t StatusKb(const std::string& name) const;
  // Lifts or sets RLIMIT_FSIZE while it runs; 0: none.
  void LimitFileBytes(uint64_t bytes);

 private:
  explicit ChildProcess(pid_t pid) : pid_(pid) {}
  void Reap(bool block);

  pid_t pid_;
  std::optional<int> exit_code_;
  double cpu_seconds_ = 0;
};

}  // namespace farpoint

// The last word of a process that crashes: a signal of a fault (SIGSEGV, SIGBUS, SIGFPE, SIGILL,
// SIGABRT) stops the thread that made it, another one tells, and then the process dies of the
// signal as it would have.
//
// Memory may be damaged by then: telling may fail or hang, so it gets a few seconds only. SIGKILL
// and a stack that is used up leave no word. In a build with a sanitizer nothing is installed,
// since the sanitizer's own report is worth more.
#pragma once

#include <functional>
#include <memory>
#include <string>

namespace farpoint {

class CrashReporter {
 public:
  // `tell` is called with "signal 11 (Segmentation fault)", once, on a thread of its own. At most
  // one reporter at a time in a process.
  explicit CrashReporter(std::function<void(const std::string& cause)> tell);
  ~CrashReporter();  // restores what was installed before
  CrashReporter(const CrashReporter&) = delete;
  CrashReporter& operator=(const CrashReporter&) = delete;

 private:
  struct Impl;
  std::unique_ptr<Impl> impl_;
};

}  // namespace farpoint

#include "worker/crash_reporter.h"

#include <signal.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

#include <array>
#include <atomic>
#include <thread>
#include <utility>

#include "core/base/check.h"

namespace farpoint {

namespace {

constexpr std::array kFaults = {SIGSEGV, SIGBUS, SIGFPE, SIGILL, SIGABRT};
constexpr int kTellMs = 4000;

// Only what a signal handler may touch.
std::atomic<int> g_pipe{-1};
std::atomic<bool> g_told{false};

void OnFault(int number) {
  const auto byte = static_cast<unsigned char>(number);
  const int pipe = g_pipe.exchange(-1);  // of several threads, the first one tells
  if (pipe >= 0 && ::write(pipe, &byte, 1) == 1) {
    const timespec step{0, 10'000'000};
    for (int waited = 0; waited < kTellMs && !g_told.load(); waited += 10) {
      ::nanosleep(&step, nullptr);
    }
  } else {
    const timespec rest{kTellMs / 1000, 0};
    ::nanosleep(&rest, nullptr);
  }
  ::signal(number, SIG_DFL);
  ::raise(number);
}

constexpr bool Sanitized() {
#if defined(__SANITIZE_ADDRESS__) || defined(__SANITIZE_THREAD__)
  return true;
#else
  return false;
#endif
}

}  // namespace

struct CrashReporter::Impl {
  int read_end = -1, write_end = -1;
  std::array<struct sigaction, kFaults.size()> before{};
  std::thread teller;
};

CrashReporter::CrashReporter(std::function<void(const std::string& cause)> tell)
    : impl_(std::make_unique<Impl>()) {
  if (Sanitized()) return;
  int ends[2];
  FP_CHECK(::pipe(ends) == 0);
  impl_->read_end = ends[0];
  impl_->write_end = ends[1];
  g_told = false;
  FP_CHECK(g_pipe.exchange(ends[1]) == -1);
  impl_->teller = std::thread([read_end = ends[0], tell = std::move(tell)] {
    unsigned char number = 0;
    if (::read(read_end, &number, 1) != 1 || number == 0) return;
    const char* const name = ::strsignal(number);
    tell("signal " + std::to_string(number) + " (" + (name == nullptr ? "unknown" : name) + ")");
    g_told = true;
  });
  struct sigaction action {};
  action.sa_handler = OnFault;
  for (size_t i = 0; i < kFaults.size(); ++i) {
    ::sigaction(kFaults[i], &action, &impl_->before[i]);
  }
}

CrashReporter::~CrashReporter() {
  if (!impl_->teller.joinable()) return;
  for (size_t i = 0; i < kFaults.size(); ++i) {
    ::sigaction(kFaults[i], &impl_->before[i], nullptr);
  }
  g_pipe = -1;
  const unsigned char end = 0;
  FP_CHECK(::write(impl_->write_end, &end, 1) == 1);
  impl_->teller.join();
  ::close(impl_->read_end);
  ::close(impl_->write_end);
}

}  // namespace farpoint

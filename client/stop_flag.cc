#include "client/stop_flag.h"

#include <csignal>
#include <thread>

namespace farpoint {
namespace {

StopFlag process_flag;

extern "C" void OnSignal(int signal) {
  if (process_flag.raised()) std::_Exit(128 + signal);
  process_flag.Raise(signal);
}

}  // namespace

bool StopFlag::SleepFor(std::chrono::milliseconds time) const {
  constexpr std::chrono::milliseconds kStep(20);
  const auto end = std::chrono::steady_clock::now() + time;
  while (!raised()) {
    const auto left = end - std::chrono::steady_clock::now();
    if (left <= left.zero()) return true;
    std::this_thread::sleep_for(std::min<std::chrono::steady_clock::duration>(left, kStep));
  }
  return false;
}

StopFlag& ProcessStopFlag() {
  static const bool installed = [] {
    struct sigaction action = {};
    action.sa_handler = OnSignal;
    sigemptyset(&action.sa_mask);
    sigaction(SIGINT, &action, nullptr);
    sigaction(SIGTERM, &action, nullptr);
    std::signal(SIGPIPE, SIG_IGN);
    return true;
  }();
  static_cast<void>(installed);
  return process_flag;
}

}  // namespace farpoint

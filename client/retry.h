// Trying again while a coordinator is away: it restarts, the network is cut, it is not up yet.
#pragma once

#include <chrono>
#include <functional>
#include <string>

#include "client/console.h"
#include "client/stop_flag.h"
#include "core/base/status.h"

namespace farpoint {

struct RetryPolicy {
  std::chrono::milliseconds first_wait{100};
  std::chrono::milliseconds longest_wait{2000};
  std::chrono::milliseconds patience{60'000};  // without any success, then the error is returned
};

// Not thread-safe.
class Retry {
 public:
  // `peer` is for messages: "coordinator farm:7447". The references must outlive this.
  Retry(RetryPolicy policy, std::string peer, const StopFlag& stop, Console& console)
      : policy_(policy), peer_(std::move(peer)), stop_(stop), console_(console) {}

  // Calls `attempt` until it returns something else than kUnavailable or kDeadlineExceeded, the
  // patience is over (that error, saying how long it was tried) or `stop` is raised (kCancelled).
  // Waits grow by half each time. An attempt that made headway before it failed calls Succeeded().
  absl::Status Run(const std::function<absl::Status()>& attempt);
  // The peer answered: patience and waits start afresh.
  void Succeeded();

  template <typename T>
  absl::StatusOr<T> Get(const std::function<absl::StatusOr<T>()>& attempt) {
    absl::StatusOr<T> result = absl::UnknownError("not tried");
    FP_RETURN_IF_ERROR(Run([&] {
      result = attempt();
      return result.status();
    }));
    return result;
  }

 private:
  RetryPolicy policy_;
  std::string peer_;
  const StopFlag& stop_;
  Console& console_;
  bool failing_ = false;
  std::chrono::steady_clock::time_point failing_since_;
  std::chrono::milliseconds wait_{0};
};

}  // namespace farpoint

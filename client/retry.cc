#include "client/retry.h"

#include <algorithm>

namespace farpoint {

void Retry::Succeeded() {
  if (failing_) console_.Info(peer_ + " answers again");
  failing_ = false;
}

absl::Status Retry::Run(const std::function<absl::Status()>& attempt) {
  while (true) {
    if (stop_.raised()) return absl::CancelledError("stopped by a signal");
    absl::Status status = attempt();
    if (!absl::IsUnavailable(status) && !absl::IsDeadlineExceeded(status)) {
      // Any other answer is an answer.
      if (!absl::IsCancelled(status)) Succeeded();
      return status;
    }
    const auto now = std::chrono::steady_clock::now();
    if (!failing_) {
      failing_ = true;
      failing_since_ = now;
      wait_ = policy_.first_wait;
      if (policy_.patience.count() > 0) {
        console_.Warn(peer_ + " does not answer (" + std::string(status.message()) +
                      "); trying again for " +
                      DurationText(std::chrono::duration<double>(policy_.patience).count()));
      }
    }
    if (now - failing_since_ + wait_ > policy_.patience) {
      return absl::Status(
          status.code(),
          peer_ + " does not answer (" + std::string(status.message()) + "), tried for " +
              DurationText(std::chrono::duration<double>(now - failing_since_).count()) +
              "; check that it runs and that the address is right");
    }
    if (!stop_.SleepFor(wait_)) return absl::CancelledError("stopped by a signal");
    wait_ = std::min(wait_ * 3 / 2, policy_.longest_wait);
  }
}

}  // namespace farpoint

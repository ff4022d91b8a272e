#include "client/exit_code.h"

namespace farpoint {

int ExitCodeOf(const absl::Status& status) {
  switch (status.code()) {
    case absl::StatusCode::kOk:
      return kExitOk;
    case absl::StatusCode::kUnavailable:
    case absl::StatusCode::kDeadlineExceeded:
    case absl::StatusCode::kAborted:
      return kExitTryAgain;
    default:
      return kExitPermanent;
  }
}

}  // namespace farpoint

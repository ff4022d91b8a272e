#include "client/exit_code.h"

#include <gtest/gtest.h>

namespace farpoint {
namespace {

TEST(ExitCode, IsZeroForSuccess) { EXPECT_EQ(ExitCodeOf(absl::OkStatus()), 0); }

TEST(ExitCode, IsTryAgainForWhatMayPass) {
  for (const absl::StatusCode code :
       {absl::StatusCode::kUnavailable, absl::StatusCode::kDeadlineExceeded,
        absl::StatusCode::kAborted}) {
    EXPECT_EQ(ExitCodeOf(absl::Status(code, "x")), 75) << absl::StatusCodeToString(code);
  }
}

TEST(ExitCode, IsPermanentForWhatTryingAgainWillNotCure) {
  for (const absl::StatusCode code :
       {absl::StatusCode::kInvalidArgument, absl::StatusCode::kNotFound,
        absl::StatusCode::kFailedPrecondition, absl::StatusCode::kOutOfRange,
        absl::StatusCode::kUnimplemented, absl::StatusCode::kDataLoss,
        absl::StatusCode::kPermissionDenied, absl::StatusCode::kResourceExhausted,
        absl::StatusCode::kCancelled, absl::StatusCode::kInternal, absl::StatusCode::kUnknown}) {
    EXPECT_EQ(ExitCodeOf(absl::Status(code, "x")), 42) << absl::StatusCodeToString(code);
  }
}

}  // namespace
}  // namespace farpoint

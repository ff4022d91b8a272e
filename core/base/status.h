// Errors of the world (file, peer, disk) travel as absl::Status; libraries never log and never
// exit. Each layer adds context with Annotate(), so that the text ends up as
// "what went wrong, where; what to do".
//
// Codes and what callers make of them:
//   kInvalidArgument, kNotFound, kFailedPrecondition, kOutOfRange, kUnimplemented, kDataLoss,
//   kResourceExhausted (a limit)
//       permanent: the scene, the blob or the settings are wrong (exit code 42)
//   kUnavailable, kDeadlineExceeded, kAborted
//       try again (exit code 75)
#pragma once

#include <string>
#include <string_view>

#include "absl/status/status.h"
#include "absl/status/statusor.h"

namespace farpoint {

// The same status with `context` put in front of its message. OK stays OK.
inline absl::Status Annotate(const absl::Status& status, std::string_view context) {
  if (status.ok()) return status;
  std::string text(context);
  text += ": ";
  text += std::string_view(status.message().data(), status.message().size());
  return absl::Status(status.code(), text);
}

}  // namespace farpoint

#define FP_CONCAT_INNER_(a, b) a##b
#define FP_CONCAT_(a, b) FP_CONCAT_INNER_(a, b)

// Returns the status of `expr` from the enclosing function unless it is OK.
#define FP_RETURN_IF_ERROR(expr)             \
  do {                                       \
    absl::Status fp_status_ = (expr);        \
    if (!fp_status_.ok()) return fp_status_; \
  } while (0)

// FP_ASSIGN_OR_RETURN(auto x, F()): x from an absl::StatusOr, or return its status.
#define FP_ASSIGN_OR_RETURN(lhs, expr) FP_ASSIGN_OR_RETURN_(FP_CONCAT_(fp_or_, __LINE__), lhs, expr)
#define FP_ASSIGN_OR_RETURN_(tmp, lhs, expr) \
  auto tmp = (expr);                         \
  if (!tmp.ok()) return tmp.status();        \
  lhs = std::move(tmp).value()

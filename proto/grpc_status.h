// The one place where absl::Status and grpc::Status meet. The codes are the same by definition.
#pragma once

#include <grpcpp/support/status.h>

#include "core/base/status.h"

namespace farpoint {

// Messages longer than 2 KiB are cut: a trailer holds 8 KiB, and a longer one would arrive as
// "RESOURCE_EXHAUSTED: received trailing metadata size exceeds limit" in place of the cause.
grpc::Status ToGrpc(const absl::Status& status);
absl::Status FromGrpc(const grpc::Status& status);

}  // namespace farpoint

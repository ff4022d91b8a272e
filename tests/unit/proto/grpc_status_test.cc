#include "proto/grpc_status.h"

#include <gtest/gtest.h>

namespace farpoint {
namespace {

TEST(GrpcStatus, EveryCodeSurvivesBothWays) {
  for (int code = 0; code <= 16; ++code) {
    const absl::Status status(static_cast<absl::StatusCode>(code), code == 0 ? "" : "why");
    EXPECT_EQ(static_cast<int>(ToGrpc(status).error_code()), code);
    EXPECT_EQ(FromGrpc(ToGrpc(status)), status) << code;
  }
}

TEST(GrpcStatus, LongMessagesAreCutSoThatTheTrailerHoldsThem) {
  const grpc::Status status = ToGrpc(absl::InvalidArgumentError(std::string(100000, 'x')));
  EXPECT_EQ(status.error_code(), grpc::StatusCode::INVALID_ARGUMENT);
  EXPECT_LT(status.error_message().size(), 4096u);
}

}  // namespace
}  // namespace farpoint

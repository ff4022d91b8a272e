#include "core/base/status.h"

#include <gtest/gtest.h>

namespace farpoint {
namespace {

absl::StatusOr<int> Half(int v) {
  if (v % 2 != 0) return absl::InvalidArgumentError(std::to_string(v) + " is odd");
  return v / 2;
}

absl::StatusOr<int> Quarter(int v) {
  FP_ASSIGN_OR_RETURN(const int half, Half(v));
  FP_ASSIGN_OR_RETURN(const int quarter, Half(half));
  return quarter;
}

absl::Status CheckEven(int v) {
  FP_RETURN_IF_ERROR(Annotate(Half(v).status(), "checking"));
  return absl::OkStatus();
}

TEST(Status, AnnotateKeepsTheCodeAndPutsTheContextFirst) {
  const absl::Status status = Annotate(absl::DataLossError("broken"), "file 'x'");
  EXPECT_EQ(status.code(), absl::StatusCode::kDataLoss);
  EXPECT_EQ(status.message(), "file 'x': broken");
  EXPECT_TRUE(Annotate(absl::OkStatus(), "anything").ok());
}

TEST(Status, MacrosReturnTheFirstError) {
  EXPECT_EQ(*Quarter(12), 3);
  EXPECT_EQ(Quarter(7).status().message(), "7 is odd");
  EXPECT_EQ(Quarter(6).status().message(), "3 is odd");
  EXPECT_TRUE(CheckEven(2).ok());
  EXPECT_EQ(CheckEven(3).message(), "checking: 3 is odd");
}

}  // namespace
}  // namespace farpoint

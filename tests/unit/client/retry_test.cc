#include "client/retry.h"

#include <gtest/gtest.h>

#include <cstdio>

namespace farpoint {
namespace {

using std::chrono::milliseconds;

class RetryTest : public testing::Test {
 protected:
  Retry Make(milliseconds patience) {
    return Retry(
        {.first_wait = milliseconds(1), .longest_wait = milliseconds(2), .patience = patience},
        "coordinator test:1", stop_, console_);
  }
  StopFlag stop_;
  Console console_{stderr, false, ConsoleLevel::kOff, true};
};

TEST_F(RetryTest, TriesAgainUntilTheCoordinatorIsBack) {
  Retry retry = Make(milliseconds(10'000));
  int attempts = 0;
  EXPECT_TRUE(retry
                  .Run([&] {
                    return ++attempts < 4 ? absl::UnavailableError("refused") : absl::OkStatus();
                  })
                  .ok());
  EXPECT_EQ(attempts, 4);
}

TEST_F(RetryTest, TriesAgainAfterADeadline) {
  Retry retry = Make(milliseconds(10'000));
  int attempts = 0;
  EXPECT_TRUE(retry
                  .Run([&] {
                    return ++attempts < 2 ? absl::DeadlineExceededError("late") : absl::OkStatus();
                  })
                  .ok());
  EXPECT_EQ(attempts, 2);
}

TEST_F(RetryTest, TakesARefusalForAnAnswer) {
  Retry retry = Make(milliseconds(10'000));
  int attempts = 0;
  const absl::Status status = retry.Run([&] {
    ++attempts;
    return absl::NotFoundError("no such job");
  });
  EXPECT_EQ(status, absl::NotFoundError("no such job"));
  EXPECT_EQ(attempts, 1);
}

TEST_F(RetryTest, LosesPatienceAndSaysSo) {
  Retry retry = Make(milliseconds(30));
  int attempts = 0;
  const absl::Status status = retry.Run([&] {
    ++attempts;
    return absl::UnavailableError("connection refused");
  });
  EXPECT_TRUE(absl::IsUnavailable(status));
  EXPECT_GT(attempts, 2);
  const std::string text(status.message());
  EXPECT_NE(text.find("coordinator test:1 does not answer (connection refused)"), std::string::npos)
      << text;
}

TEST_F(RetryTest, TriesOnceWithoutPatience) {
  Retry retry = Make(milliseconds(0));
  int attempts = 0;
  EXPECT_FALSE(retry
                   .Run([&] {
                     ++attempts;
                     return absl::UnavailableError("x");
                   })
                   .ok());
  EXPECT_EQ(attempts, 1);
}

TEST_F(RetryTest, HeadwayRenewsThePatience) {
  Retry retry = Make(milliseconds(25));
  int attempts = 0;
  const absl::Status status = retry.Run([&] {
    if (++attempts < 60) retry.Succeeded();
    return absl::UnavailableError("x");
  });
  EXPECT_FALSE(status.ok());
  EXPECT_GT(attempts, 60);
}

TEST_F(RetryTest, StopsWhenASignalCame) {
  Retry retry = Make(milliseconds(60'000));
  int attempts = 0;
  const absl::Status status = retry.Run([&] {
    if (++attempts == 3) stop_.Raise(2);
    return absl::UnavailableError("x");
  });
  EXPECT_TRUE(absl::IsCancelled(status));
  EXPECT_EQ(attempts, 3);
}

}  // namespace
}  // namespace farpoint

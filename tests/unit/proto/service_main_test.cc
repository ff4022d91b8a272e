#include "proto/service_main.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <csignal>

namespace farpoint {
namespace {

using ::testing::AllOf;
using ::testing::HasSubstr;

TEST(ServiceMain, TakesHostsWithPorts) {
  for (const char* address : {"localhost:7447", "farm.example:1", "10.0.0.1:65535", "[::1]:7447"}) {
    EXPECT_TRUE(CheckHostPort("--listen", address, false).ok()) << address;
  }
  EXPECT_TRUE(CheckHostPort("--listen", "127.0.0.1:0", true).ok());
}

TEST(ServiceMain, RefusesOtherAddressesByFlagAndReason) {
  for (const char* address : {"", "host", "host:", ":7447", "host:0", "host:65536", "host:-1",
                              "host:7447x", "::1:7447", "[]:7447", "ho st:1", "http://host:1"}) {
    const absl::Status bad = CheckHostPort("--coordinator", address, false);
    EXPECT_TRUE(absl::IsInvalidArgument(bad)) << address;
    EXPECT_THAT(
        std::string(bad.message()),
        AllOf(HasSubstr("--coordinator '" + std::string(address) + "'"), HasSubstr("HOST:PORT")));
  }
}

TEST(ServiceMain, ExitCodesTellWhetherToTryAgain) {
  EXPECT_EQ(ServiceExitCode(absl::OkStatus()), 0);
  EXPECT_EQ(ServiceExitCode(absl::UnavailableError("")), 75);
  EXPECT_EQ(ServiceExitCode(absl::ResourceExhaustedError("")), 42);
  EXPECT_EQ(ServiceExitCode(absl::FailedPreconditionError("")), 42);
  EXPECT_EQ(ReportFatal("test", absl::DataLossError("broken")), 42);
}

TEST(ServiceMain, LogLinesNameWhatIsKnown) {
  EXPECT_EQ(LogText({}, std::nullopt, 0, {}, "text"), "text");
  EXPECT_EQ(LogText({"j"}, 0, 2, {"w"}, "text"), "job=j tile=0 attempt=2 worker=w text");
}

TEST(ServiceMain, SignalsAreHeardByWhoWaits) {
  const StopSignals signals;
  EXPECT_FALSE(signals.Wait(std::chrono::milliseconds(1)));
  ::raise(SIGTERM);
  EXPECT_TRUE(signals.Wait(std::chrono::milliseconds(1000)));
}

}  // namespace
}  // namespace farpoint

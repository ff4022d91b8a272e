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
  EXPECT_EQ(LogText({}, "text"), "text");
  const LogSubject subject{.job = {"j"}, .tile = 0, .attempt = 2, .worker = {"w"}};
  EXPECT_EQ(LogText(subject, "text"), "job=j tile=0 attempt=2 worker=w text");
}

TEST(ServiceMain, LogObjectsHaveAFieldForEach) {
  const std::chrono::system_clock::time_point time{std::chrono::milliseconds(1'700'000'000'042)};
  EXPECT_EQ(LogJson("p", LogLevel::kInfo, {}, "text", time),
            R"({"time":"2023-11-14T22:13:20.042Z","level":"info","program":"p","text":"text"})");
  const LogSubject subject{.job = {"j"}, .tile = 0, .attempt = 2, .worker = {"w"}};
  EXPECT_EQ(LogJson("p", LogLevel::kWarning, subject, "a \"b\"\n\xff", time),
            R"({"time":"2023-11-14T22:13:20.042Z","level":"warning","program":"p","job":"j",)"
            R"("tile":0,"attempt":2,"worker":"w","text":"a \"b\"\n)"
            "\xef\xbf\xbd\"}");
}

TEST(ServiceMain, SignalsAreHeardByWhoWaits) {
  const StopSignals signals;
  EXPECT_FALSE(signals.Wait(std::chrono::milliseconds(1)));
  ::raise(SIGTERM);
  EXPECT_TRUE(signals.Wait(std::chrono::milliseconds(1000)));
}

}  // namespace
}  // namespace farpoint

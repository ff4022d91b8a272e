#include "bench/service.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <nlohmann/json.hpp>

#include "bench/service_report.h"

namespace farpoint {
namespace {

using ::testing::HasSubstr;
using ::testing::Not;

ServiceReport SampleReport() {
  ServiceReport report;
  report.cpu = "a processor";
  ServiceResult result;
  result.name = "kills";
  result.check = "what is done";
  result.checks.push_back({ServiceCheck::Kind::kCount, "tiles lost", 0, 0, false});
  result.checks.push_back({ServiceCheck::Kind::kTime, "s to do it again", 7, 5, false});
  result.checks.push_back({ServiceCheck::Kind::kFigure, "kills", 1000, 0, false});
  result.notes.emplace_back("a note");
  report.results.push_back(result);
  return report;
}

TEST(ServiceReport, ATimeOverItsBoundIsToldAndDoesNotFail) {
  const ServiceReport report = SampleReport();
  EXPECT_EQ(report.failures(), 0u);
  EXPECT_EQ(report.late(), 1u);
  EXPECT_THAT(ServiceTable(report), HasSubstr("late"));
  EXPECT_THAT(ServiceTable(report), Not(HasSubstr("FAILS")));
}

TEST(ServiceReport, ACountThatDoesNotHoldFails) {
  ServiceReport report = SampleReport();
  report.results[0].checks[0].value = 1;
  EXPECT_EQ(report.failures(), 1u);
  EXPECT_THAT(ServiceTable(report), HasSubstr("FAILS"));
  report.results[0].error = "it broke";
  EXPECT_EQ(report.failures(), 2u);
  EXPECT_THAT(ServiceHtml(report), HasSubstr("it broke"));
  ServiceCheck least{ServiceCheck::Kind::kCount, "found", 2, 3, true};
  EXPECT_FALSE(least.holds());
  least.value = 3;
  EXPECT_TRUE(least.holds());
}

TEST(ServiceReport, JsonHasEveryCheck) {
  const auto json = nlohmann::json::parse(ServiceJson(SampleReport()));
  EXPECT_EQ(json["benchmark"], "service");
  EXPECT_EQ(json["late"], 1);
  EXPECT_EQ(json["cases"][0]["checks"].size(), 3u);
  EXPECT_EQ(json["cases"][0]["checks"][0]["bound"], 0);
  EXPECT_TRUE(json["cases"][0]["checks"][2]["bound"].is_null());
  EXPECT_EQ(json["cases"][0]["notes"][0], "a note");
}

TEST(ServiceBench, NamesWhatIsMissing) {
  const auto report = RunService({.bin_dir = "/nowhere"}, [](std::string_view) {});
  EXPECT_TRUE(absl::IsNotFound(report.status()));
  EXPECT_THAT(std::string(report.status().message()), HasSubstr("/nowhere/farpoint-server"));
}

// The short form of each case, with real processes. What counts must hold on a busy machine, too;
// times are not looked at.
class ServiceBenchCases : public ::testing::TestWithParam<std::string> {};

TEST_P(ServiceBenchCases, HoldInTheirShortForm) {
  const auto report =
      RunService({.cases = {GetParam()}, .bin_dir = FARPOINT_BIN_FOLDER, .quick = true},
                 [](std::string_view) {});
  ASSERT_TRUE(report.ok()) << report.status();
  ASSERT_EQ(report->results.size(), 1u);
  EXPECT_GE(report->results[0].checks.size(), 3u);
  EXPECT_EQ(report->failures(), 0u) << ServiceTable(*report);
}

INSTANTIATE_TEST_SUITE_P(All, ServiceBenchCases, ::testing::ValuesIn(ServiceNames()),
                         [](const auto& info) { return info.param; });

}  // namespace
}  // namespace farpoint

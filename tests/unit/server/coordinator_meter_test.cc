#include "server/coordinator_meter.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

namespace farpoint {
namespace {

using ::testing::HasSubstr;

TEST(LossMeter, CountsByCause) {
  LossMeter losses;
  losses.Count(LossCause::kReported);  // the worker said so itself: no loss
  losses.Count(LossCause::kDisconnected);
  losses.Count(LossCause::kDisconnected);
  losses.Count(LossCause::kSilent);
  losses.Count(LossCause::kHung);
  MetricsText text;
  losses.AddTo(text);
  const std::string metrics = text.Take();
  for (const char* sample : {"farpoint_leases_lost_total{cause=\"disconnected\"} 2\n",
                             "farpoint_leases_lost_total{cause=\"silent\"} 1\n",
                             "farpoint_leases_lost_total{cause=\"no_progress\"} 0\n",
                             "farpoint_leases_lost_total{cause=\"hung\"} 1\n"}) {
    EXPECT_THAT(metrics, HasSubstr(sample));
  }
}

}  // namespace
}  // namespace farpoint

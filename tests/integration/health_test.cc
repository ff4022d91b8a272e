// farpoint-health as containers run it.
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <string>
#include <vector>

#include "tests/integration/certificates.h"
#include "tests/integration/farm.h"

namespace farpoint {
namespace {

using std::chrono::seconds;
using testing::HasSubstr;

RunResult Ask(Farm& farm, std::vector<std::string> args, int run) {
  args.insert(args.begin(), BinFolder() + "/farpoint-health");
  const std::string name = "health" + std::to_string(run);
  Process process(args, farm.File(name + ".out"), farm.File(name + ".err"));
  RunResult result;
  result.exit_code = process.Wait(seconds(60)).value_or(-1);
  result.out = farm.Read(name + ".out");
  result.err = farm.Read(name + ".err");
  return result;
}

TEST(Health, ACoordinatorIsAskedWithTheCertificatesThatItHasItself) {
  Farm farm;
  // By none of these names is it asked.
  const std::string all = farm.File("certs"), own = farm.File("own");
  ASSERT_EQ(farm.Client({"certs", "init", "--dir", all, "--server", "farm.example"}).exit_code, 0);
  ASSERT_EQ(::mkdir(own.c_str(), 0700), 0);
  for (const char* name : {"ca.pem", "server.pem", "server.key"}) {
    WriteSecret(own + "/" + name, ReadWhole(all + "/" + name));
  }
  farm.StartServer({"--certs", own});
  const std::vector<std::string> patient = {farm.address(), "--timeout", "30"};
  const auto with = [&](std::vector<std::string> more) {
    more.insert(more.begin(), patient.begin(), patient.end());
    return more;
  };
  const RunResult good = Ask(farm, with({"--certs", own}), 0);
  EXPECT_EQ(good.exit_code, 0) << good.err;
  EXPECT_THAT(good.out, HasSubstr("serves"));
  EXPECT_EQ(
      Ask(farm, with({"--tls-ca", own + "/ca.pem", "--server-name", "farm.example"}), 1).exit_code,
      0);
  const RunResult other_name = Ask(farm, with({"--tls-ca", own + "/ca.pem"}), 2);
  EXPECT_EQ(other_name.exit_code, 42);
  EXPECT_THAT(other_name.err, HasSubstr("names farm.example"));
  EXPECT_EQ(Ask(farm, patient, 3).exit_code, 42);  // in the clear
  EXPECT_EQ(Ask(farm, with({"--certs", farm.File("nothing")}), 4).exit_code, 42);
  farm.server().Signal(SIGTERM);
  ASSERT_EQ(farm.server().Wait(seconds(60)), 0);
  const RunResult gone = Ask(farm, with({"--certs", own}), 5);
  EXPECT_NE(gone.exit_code, 0);
  EXPECT_NE(gone.exit_code, 2);
}

TEST(Health, ACertificateForAWholeDomainWillDo) {
  Farm farm;
  const std::string own = farm.File("own");
  ASSERT_EQ(farm.Client({"certs", "init", "--dir", own, "--server", "*.farm.example"}).exit_code,
            0);
  farm.StartServer({"--certs", own});
  const RunResult good = Ask(farm, {farm.address(), "--timeout", "30", "--certs", own}, 0);
  EXPECT_EQ(good.exit_code, 0) << good.err;
}

TEST(Health, UsageErrorsAreTold) {
  Farm farm;
  int run = 0;
  for (const std::vector<std::string>& args : {std::vector<std::string>{},
                                               {"nowhere"},
                                               {"127.0.0.1:1", "--metrics", "--certs", "x"},
                                               {"127.0.0.1:1", "--certs", "x", "--tls-ca", "y"}}) {
    EXPECT_EQ(Ask(farm, args, run++).exit_code, 2);
  }
}

}  // namespace
}  // namespace farpoint

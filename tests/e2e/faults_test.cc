// Processes die at the worst moment; only the time may show it.
#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <signal.h>

#include <nlohmann/json.hpp>

#include "tests/integration/farm.h"

namespace farpoint {
namespace {

using std::chrono::seconds;
using Json = nlohmann::json;

// A dozen tiles of about half a second each.
std::vector<std::string> Job(const std::string& output) {
  return {SceneFile("cornell.gltf"),
          "--resolution",
          "128x96",
          "--integrator",
          "pt",
          "--paths",
          "2048",
          "--tile",
          "32",
          "--points",
          "100",
          "--light-samples",
          "4",
          "-o",
          output};
}

class Faults : public testing::Test {
 protected:
  void SetUp() override { farm_.StartServer(); }

  static std::vector<std::string> With(const std::string& verb, std::vector<std::string> job) {
    job.insert(job.begin(), verb);
    return job;
  }

  // What the job must become whatever happens.
  std::string ReferenceHash() {
    const RunResult result = farm_.Client(With("render", Job(farm_.File("reference.exr"))));
    EXPECT_EQ(result.exit_code, 0) << result.err;
    return ImageHashOf(farm_.File("reference.exr"));
  }
  void Submit() {
    client_ = farm_.StartClient(farm_.WithCoordinator(With("submit", Job(farm_.File("a.exr")))),
                                "client");
  }
  // The only job, or null.
  Json OnlyJob() {
    const std::string text = farm_.Status();
    if (text.empty()) return nullptr;
    const Json jobs = Json::parse(text)["jobs"];
    return jobs.size() == 1 ? jobs[0] : Json(nullptr);
  }
  bool WaitForCommitted(int tiles) {
    return WaitUntil(seconds(60), [&] {
      const Json job = OnlyJob();
      return !job.is_null() && job["tiles"]["committed"] >= tiles && job["tiles"]["leased"] >= 1;
    });
  }
  // Stops the worker so that it holds a tile, whose result is not on its way. It must be continued
  // or killed before its lease ends.
  bool StopInMidTile(size_t worker) {
    return WaitUntil(seconds(60), [&] {
      const Json before = OnlyJob();
      if (before.is_null() || before["tiles"]["committed"] < 1) return false;
      farm_.worker(worker).Signal(SIGSTOP);
      // What it sent just before is received by the time of the second look.
      for (int look = 0; look < 2; ++look) {
        const Json job = OnlyJob();
        if (job.is_null() || job["tiles"]["leased"] < 1) {
          farm_.worker(worker).Signal(SIGCONT);
          return false;
        }
      }
      return true;
    });
  }
  void ExpectDone(const std::string& reference) {
    EXPECT_EQ(client_->Wait(seconds(120)), 0) << farm_.Read("client.err") << farm_.Logs();
    EXPECT_EQ(ImageHashOf(farm_.File("a.exr")), reference);
    const Json job = OnlyJob();
    ASSERT_FALSE(job.is_null());
    EXPECT_EQ(job["state"], "done");
    EXPECT_EQ(job["tiles"]["committed"], job["tiles"]["total"]);
  }

  Farm farm_;
  std::unique_ptr<Process> client_;
};

TEST_F(Faults, AWorkerThatIsKilledInMidTileChangesNothingButTime) {
  const std::string reference = ReferenceHash();
  const size_t victim = farm_.StartWorker();
  Submit();
  ASSERT_TRUE(StopInMidTile(victim)) << farm_.Logs();
  farm_.worker(victim).Signal(SIGKILL);
  EXPECT_EQ(farm_.worker(victim).Wait(seconds(5)), 128 + SIGKILL);
  const Json at_death = OnlyJob();
  EXPECT_NE(at_death["state"], "done") << "the job must be longer for this test to say something";
  farm_.StartWorker();
  ExpectDone(reference);
  EXPECT_GE(OnlyJob()["reissued"], 1);
}

TEST_F(Faults, AWorkerThatIsStoppedLosesItsTile) {
  const std::string reference = ReferenceHash();
  const size_t victim = farm_.StartWorker();
  Submit();
  ASSERT_TRUE(StopInMidTile(victim)) << farm_.Logs();
  farm_.StartWorker();
  ExpectDone(reference);
  // It wakes with a result that nobody waits for, and is of use again.
  farm_.worker(victim).Signal(SIGCONT);
  farm_.worker(victim).Signal(SIGTERM);
  EXPECT_TRUE(farm_.worker(victim).Wait(seconds(30)).has_value());
  EXPECT_EQ(OnlyJob()["state"], "done");
}

TEST_F(Faults, ACoordinatorThatIsKilledInMidJobFinishesItAfterItsRestart) {
  const std::string reference = ReferenceHash();
  farm_.StartWorker();
  Submit();
  for (int kill = 0; kill < 2; ++kill) {
    ASSERT_TRUE(WaitForCommitted(2 + 2 * kill)) << farm_.Logs();
    const Json before = OnlyJob();
    farm_.server().Signal(SIGKILL);
    ASSERT_EQ(farm_.server().Wait(seconds(5)), 128 + SIGKILL);
    farm_.StartServer();
    if (HasFatalFailure()) return;
    Json after;
    ASSERT_TRUE(WaitUntil(seconds(10), [&] { return !(after = OnlyJob()).is_null(); }));
    EXPECT_EQ(after["id"], before["id"]);
    EXPECT_GE(after["tiles"]["committed"], before["tiles"]["committed"]) << "a tile was lost";
  }
  ExpectDone(reference);
  EXPECT_THAT(farm_.Read("client.err"), testing::HasSubstr("answers again"));
}

TEST_F(Faults, WorkersMayComeAndGo) {
  const std::string reference = ReferenceHash();
  Submit();
  for (int i = 0; i < 3; ++i) {
    farm_.StartWorker();
    ASSERT_TRUE(WaitForCommitted(i + 1)) << farm_.Logs();
    if (i < 2) farm_.StopWorkers();
  }
  ExpectDone(reference);
}

}  // namespace
}  // namespace farpoint

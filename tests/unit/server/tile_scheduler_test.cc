#include "server/tile_scheduler.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <map>
#include <random>
#include <set>

namespace farpoint {
namespace {

using std::chrono::milliseconds;
using std::chrono::seconds;
using ::testing::AllOf;
using ::testing::Contains;
using ::testing::Each;
using ::testing::ElementsAre;
using ::testing::Field;
using ::testing::HasSubstr;
using ::testing::IsEmpty;

Digest DigestOf(std::string_view text) { return Sha256().Update(text).Finish(); }

class TileSchedulerTest : public ::testing::Test {
 protected:
  TileSchedulerTest() : scheduler_(options_, clock_) {}

  void AddJob(const std::string& id, uint32_t tiles, int priority = 0) {
    ScheduledJob job;
    job.id = {id};
    job.priority = priority;
    job.number = ++number_;
    job.tiles = tiles;
    scheduler_.AddJob(job);
  }
  WorkerId AddWorker(const std::string& id, const std::string& fingerprint = "f") {
    WorkerHello hello;
    hello.fingerprint = DigestOf(fingerprint);
    scheduler_.AddWorker({id}, hello);
    return {id};
  }
  // Leases, commits; the tile's index.
  uint32_t Render(const WorkerId& worker, Duration time = seconds(1)) {
    const auto grant = scheduler_.Lease(worker);
    EXPECT_TRUE(grant.has_value());
    clock_.Advance(time);
    EXPECT_TRUE(scheduler_.BeginCommit(worker, grant->lease, grant->attempt).ok());
    EXPECT_TRUE(scheduler_.FinishCommit(grant->lease, true));
    return grant->tile;
  }
  // Time passes and the worker is heard of, with progress or without.
  void Beat(const LeaseGrant& grant, Duration time, bool progress) {
    if (progress) ++counter_;
    clock_.Advance(time);
    scheduler_.Renew(grant.worker, grant.lease, {counter_, 0.5f});
  }

  SchedulerOptions options_;
  FakeClock clock_;
  TileScheduler scheduler_;
  uint64_t number_ = 0;
  uint64_t counter_ = 0;
};

TEST_F(TileSchedulerTest, HandsOutEachTileOnce) {
  AddJob("a", 3);
  const WorkerId w = AddWorker("w");
  EXPECT_EQ(Render(w), 0u);
  EXPECT_EQ(Render(w), 1u);
  EXPECT_EQ(Render(w), 2u);
  EXPECT_FALSE(scheduler_.Lease(w).has_value());
  EXPECT_EQ(scheduler_.Counts({"a"}), (TileCounts{.committed = 3, .total = 3}));
}

TEST_F(TileSchedulerTest, PriorityThenAge) {
  AddJob("old", 1);
  AddJob("new", 1);
  AddJob("urgent", 1, 5);
  const WorkerId w1 = AddWorker("1"), w2 = AddWorker("2"), w3 = AddWorker("3");
  EXPECT_EQ(scheduler_.Lease(w1)->job, JobId{"urgent"});
  EXPECT_EQ(scheduler_.Lease(w2)->job, JobId{"old"});
  EXPECT_EQ(scheduler_.Lease(w3)->job, JobId{"new"});
}

TEST_F(TileSchedulerTest, CommittedTilesOfAnEarlierLifeAreNotRenderedAgain) {
  ScheduledJob job;
  job.id = {"a"};
  job.tiles = 4;
  job.committed = {0, 2};
  job.fingerprint = DigestOf("f");
  scheduler_.AddJob(job);
  const WorkerId w = AddWorker("w");
  EXPECT_EQ(Render(w), 1u);
  EXPECT_EQ(Render(w), 3u);
  EXPECT_FALSE(scheduler_.Lease(w).has_value());
}

TEST_F(TileSchedulerTest, SilentWorkerLosesItsLease) {
  AddJob("a", 1);
  const WorkerId w = AddWorker("w"), other = AddWorker("other");
  const auto grant = scheduler_.Lease(w);
  clock_.Advance(options_.silence_time - milliseconds(1));
  EXPECT_THAT(scheduler_.Tick().lost, IsEmpty());
  clock_.Advance(milliseconds(1));
  const SchedulerNews news = scheduler_.Tick();
  ASSERT_EQ(news.lost.size(), 1u);
  EXPECT_EQ(news.lost[0].grant.lease, grant->lease);
  EXPECT_THAT(news.lost[0].reason, HasSubstr("nothing was heard"));
  EXPECT_EQ(news.lost[0].cause, LossCause::kSilent);
  EXPECT_EQ(scheduler_.Reissued({"a"}), 1u);

  const auto again = scheduler_.Lease(other);
  ASSERT_TRUE(again.has_value());
  EXPECT_EQ(again->attempt, 2u);
  // The lost worker comes back: told to drop, its result refused and counted.
  EXPECT_TRUE(scheduler_.Renew(w, grant->lease, {1, 0}).drop);
  EXPECT_TRUE(
      absl::IsFailedPrecondition(scheduler_.BeginCommit(w, grant->lease, grant->attempt).status()));
  EXPECT_EQ(scheduler_.Refused({"a"}), 1u);
  EXPECT_TRUE(scheduler_.BeginCommit(other, again->lease, again->attempt).ok());
  EXPECT_TRUE(scheduler_.FinishCommit(again->lease, true));
}

TEST_F(TileSchedulerTest, TheCoordinatorsOwnSleepCountsAgainstNobody) {
  AddJob("a", 1);
  const WorkerId w = AddWorker("w");
  ASSERT_TRUE(scheduler_.Lease(w).has_value());
  clock_.Advance(std::chrono::hours(8));
  scheduler_.Forgive(std::chrono::hours(8));
  EXPECT_THAT(scheduler_.Tick().lost, IsEmpty());
  EXPECT_TRUE(scheduler_.HasWorker(w));
  clock_.Advance(options_.silence_time);
  EXPECT_EQ(scheduler_.Tick().lost.size(), 1u);
}

TEST_F(TileSchedulerTest, OnlyProgressKeepsALeaseAlive) {
  AddJob("a", 1);
  const WorkerId w = AddWorker("w");
  const auto grant = scheduler_.Lease(w);
  for (Duration t{}; t < options_.lease_time * 3; t += seconds(2)) {
    Beat(*grant, seconds(2), true);
    ASSERT_THAT(scheduler_.Tick().lost, IsEmpty());
  }
  for (Duration t{}; t < options_.lease_time - seconds(2); t += seconds(2)) {
    Beat(*grant, seconds(2), false);
    ASSERT_THAT(scheduler_.Tick().lost, IsEmpty());
  }
  Beat(*grant, seconds(2), false);
  const SchedulerNews news = scheduler_.Tick();
  ASSERT_EQ(news.lost.size(), 1u);
  EXPECT_THAT(news.lost[0].reason, HasSubstr("no progress"));
  EXPECT_EQ(news.lost[0].cause, LossCause::kNoProgress);
}

TEST_F(TileSchedulerTest, AJobMayHaveLongerLeases) {
  ScheduledJob job;
  job.id = {"slow"};
  job.tiles = 1;
  job.lease_time = options_.lease_time * 10;
  scheduler_.AddJob(job);
  const WorkerId w = AddWorker("w");
  const auto grant = scheduler_.Lease(w);
  for (Duration t{}; t < options_.lease_time * 9; t += seconds(4)) {
    Beat(*grant, seconds(4), false);
    ASSERT_THAT(scheduler_.Tick().lost, IsEmpty());
  }
}

TEST_F(TileSchedulerTest, GivenBackTilesBlameNobody) {
  AddJob("a", 1);
  const WorkerId w = AddWorker("w");
  for (int i = 0; i < 20; ++i) {
    const auto grant = scheduler_.Lease(w);
    ASSERT_TRUE(grant.has_value()) << i;
    EXPECT_THAT(scheduler_.ReportFailure(w, grant->lease, true, absl::OkStatus()).failed,
                IsEmpty());
  }
  EXPECT_EQ(scheduler_.Workers()[0].failures, 0u);
  EXPECT_EQ(scheduler_.Counts({"a"}), (TileCounts{.queued = 1, .total = 1}));
}

TEST_F(TileSchedulerTest, ATileThatKillsThreeWorkersIsSetAsideAndTheOthersGoOn) {
  AddJob("a", 2);
  for (int i = 0; i < 3; ++i) {
    const WorkerId w = AddWorker("w" + std::to_string(i));
    const auto grant = scheduler_.Lease(w);
    ASSERT_TRUE(grant.has_value());
    EXPECT_EQ(grant->tile, 0u);
    EXPECT_EQ(grant->careful, i > 0);
    scheduler_.Renew(w, grant->lease, {.counter = 1, .at = "block 3, 4"});
    clock_.Advance(options_.silence_time);
    const SchedulerNews news = scheduler_.Tick();
    ASSERT_EQ(news.lost.size(), 1u);
    EXPECT_THAT(news.lost[0].reason,
                AllOf(HasSubstr("nothing was heard"), HasSubstr("block 3, 4")));
    ASSERT_EQ(news.set_aside.size(), i == 2 ? 1u : 0u);
  }
  EXPECT_FALSE(scheduler_.MayGiveUp({"a"}));
  clock_.Advance(options_.comeback_time);
  EXPECT_TRUE(scheduler_.MayGiveUp({"a"}));
  EXPECT_EQ(scheduler_.Counts({"a"}), (TileCounts{.queued = 1, .failed = 1, .total = 2}));
  const JobReport report = scheduler_.Report({"a"});
  ASSERT_EQ(report.troubled.size(), 1u);
  EXPECT_TRUE(report.troubled[0].set_aside);
  EXPECT_EQ(report.troubled[0].workers, 3u);
  const WorkerId good = AddWorker("good");
  EXPECT_EQ(Render(good), 1u);
  EXPECT_FALSE(scheduler_.Lease(good).has_value());
  EXPECT_EQ(scheduler_.Counts({"a"}), (TileCounts{.committed = 1, .failed = 1, .total = 2}));
  // Whoever asks for it gets it tried again, by all.
  scheduler_.ForgetFailures({"a"});
  EXPECT_EQ(scheduler_.Counts({"a"}), (TileCounts{.queued = 1, .committed = 1, .total = 2}));
  EXPECT_EQ(Render(good), 0u);
}

// Where machines are taken away by the dozen, a tile may lose three workers by chance.
TEST_F(TileSchedulerTest, WhereWorkersVanishEverywhereNoTileIsBlamedSoon) {
  AddJob("a", 100);
  for (int i = 0; i < 20; ++i) {
    const WorkerId w = AddWorker("other" + std::to_string(i));
    Render(w);
    ASSERT_TRUE(scheduler_.Lease(w).has_value());
    scheduler_.Disconnected(w, scheduler_.Connected(w));
    clock_.Advance(options_.reconnect_time);
    ASSERT_EQ(scheduler_.Tick().lost.size(), 1u);
    Render(AddWorker("steady" + std::to_string(i)));
  }
  uint32_t tile = 0, deaths = 0;
  for (bool set_aside = false; !set_aside; ++deaths) {
    ASSERT_LT(deaths, options_.max_tile_failures);
    const WorkerId w = AddWorker("w" + std::to_string(deaths));
    const auto grant = scheduler_.Lease(w);
    ASSERT_TRUE(grant.has_value());
    if (deaths > 0) {
      ASSERT_EQ(grant->tile, tile);
    }
    tile = grant->tile;
    scheduler_.Disconnected(w, scheduler_.Connected(w));
    clock_.Advance(options_.reconnect_time);
    set_aside = !scheduler_.Tick().set_aside.empty();
  }
  EXPECT_EQ(deaths, options_.max_tile_failures);
}

TEST_F(TileSchedulerTest, WorkersThatReportTheTilesFaultAreBelievedEvenThen) {
  AddJob("a", 100);
  for (int i = 0; i < 20; ++i) {
    const WorkerId w = AddWorker("other" + std::to_string(i));
    scheduler_.Lease(w);
    scheduler_.Disconnected(w, scheduler_.Connected(w));
    clock_.Advance(options_.reconnect_time);
    scheduler_.Tick();
    Render(AddWorker("steady" + std::to_string(i)));
  }
  for (int i = 0; i < 3; ++i) {
    const WorkerId w = AddWorker("w" + std::to_string(i));
    const auto grant = scheduler_.Lease(w);
    const SchedulerNews news =
        scheduler_.ReportFailure(w, grant->lease, false, absl::AbortedError("signal 11"));
    EXPECT_EQ(news.set_aside.size(), i == 2 ? 1u : 0u) << i;
  }
}

TEST_F(TileSchedulerTest, ABrokenConnectionCostsTheLeaseAtOnce) {
  AddJob("a", 2);
  const WorkerId w = AddWorker("w"), other = AddWorker("other");
  const auto grant = scheduler_.Lease(w);
  const uint64_t first = scheduler_.Connected(w);
  scheduler_.Disconnected(w, first);
  clock_.Advance(options_.reconnect_time - milliseconds(1));
  EXPECT_THAT(scheduler_.Tick().lost, IsEmpty());
  // Back in time: the tile stays. The end of the old connection, told late, changes nothing.
  const uint64_t second = scheduler_.Connected(w);
  scheduler_.Disconnected(w, first);
  clock_.Advance(options_.reconnect_time);
  EXPECT_THAT(scheduler_.Tick().lost, IsEmpty());
  // Heard of after the break, though by other ways: it lives.
  scheduler_.Disconnected(w, second);
  Beat(*grant, milliseconds(1), true);
  clock_.Advance(options_.reconnect_time);
  EXPECT_THAT(scheduler_.Tick().lost, IsEmpty());

  const uint64_t third = scheduler_.Connected(w);
  EXPECT_THAT(scheduler_.Workers(), Each(Field(&WorkerStatus::gone, false)));
  clock_.Advance(milliseconds(1));
  scheduler_.Disconnected(w, third);
  // Whoever looks is told at once that it is not there, until it is heard of again.
  EXPECT_THAT(scheduler_.Workers(),
              Contains(AllOf(Field(&WorkerStatus::id, w), Field(&WorkerStatus::gone, true))));
  clock_.Advance(options_.reconnect_time);
  const SchedulerNews news = scheduler_.Tick();
  ASSERT_EQ(news.lost.size(), 1u);
  EXPECT_THAT(news.lost[0].reason, HasSubstr("connection"));
  EXPECT_EQ(news.lost[0].cause, LossCause::kDisconnected);
  EXPECT_EQ(scheduler_.Lease(other)->tile, grant->tile);
}

// A thousand random deaths hit some tile six times.
TEST_F(TileSchedulerTest, WhereWorkersDieByTheHundredATileMayLoseMany) {
  int number = 0;
  const auto vanish = [&](int count) -> SchedulerNews {
    std::vector<WorkerId> gone;
    for (int i = 0; i < count; ++i) {
      gone.push_back(AddWorker("w" + std::to_string(number++)));
      EXPECT_TRUE(scheduler_.Lease(gone.back()).has_value());
    }
    clock_.Advance(options_.silence_time);
    return scheduler_.Tick();
  };
  AddJob("elsewhere", 400);
  vanish(300);
  AddJob("a", 1, 10);
  const uint32_t most = 4 * options_.max_tile_failures;
  for (uint32_t i = 1; i <= most; ++i) {
    EXPECT_EQ(vanish(1).set_aside.size(), i == most ? 1u : 0u) << i;
  }
  // What a worker says itself is no matter of the farm.
  AddJob("b", 1, 20);
  for (uint32_t i = 1; i <= options_.max_dead_workers; ++i) {
    const WorkerId w = AddWorker("says so " + std::to_string(i));
    const auto grant = scheduler_.Lease(w);
    ASSERT_EQ(grant->job.value, "b");
    const SchedulerNews news =
        scheduler_.ReportFailure(w, grant->lease, false, absl::AbortedError("signal 11"));
    EXPECT_EQ(news.set_aside.size(), i == options_.max_dead_workers ? 1u : 0u) << i;
  }
}

TEST_F(TileSchedulerTest, WhoComesBackDidNotDieOfItsTile) {
  AddJob("a", 1);
  const WorkerId keeper = AddWorker("keeper", "another arithmetic");
  for (int round = 0; round < 3; ++round) {
    std::vector<WorkerId> stopped;
    for (int i = 0; i < 2; ++i) {
      stopped.push_back(AddWorker("w" + std::to_string(2 * round + i)));
      ASSERT_TRUE(scheduler_.Lease(stopped.back()).has_value());
      clock_.Advance(options_.silence_time);
      EXPECT_THAT(scheduler_.Tick().set_aside, IsEmpty());
    }
    EXPECT_EQ(scheduler_.Report({"a"}).troubled[0].failures, 2u);
    for (const WorkerId& w : stopped) EXPECT_TRUE(scheduler_.Touch(w));
    EXPECT_THAT(scheduler_.Report({"a"}).troubled, IsEmpty());
  }
  // Even three of them: the tile that was set aside is tried again.
  std::vector<WorkerId> stopped;
  for (int i = 0; i < 3; ++i) {
    stopped.push_back(AddWorker("late" + std::to_string(i)));
    ASSERT_TRUE(scheduler_.Lease(stopped.back()).has_value());
    clock_.Advance(options_.silence_time);
    scheduler_.Tick();
  }
  EXPECT_EQ(scheduler_.Counts({"a"}).failed, 1u);
  EXPECT_FALSE(scheduler_.MayGiveUp({"a"})) << "somebody may come back";
  EXPECT_TRUE(scheduler_.Touch(stopped[0]));
  EXPECT_EQ(scheduler_.Counts({"a"}).queued, 1u);
}

// Computes without a step: lost soon. With steps, starved, or with steps that are known to be long:
// not.
TEST_F(TileSchedulerTest, AThreadThatGoesInCirclesLosesItsTile) {
  ScheduledJob job;
  job.id = {"a"};
  job.tiles = 3;
  scheduler_.AddJob(job);
  job.id = {"long steps"};
  job.tiles = 1;
  job.step_time = seconds(60);
  scheduler_.AddJob(job);
  const WorkerId circles = AddWorker("circles"), steps = AddWorker("steps"),
                 starved = AddWorker("starved"), patient = AddWorker("patient");
  std::vector<LeaseGrant> grants;
  for (const WorkerId& worker : {circles, steps, starved, patient}) {
    grants.push_back(*scheduler_.Lease(worker));
  }
  ASSERT_EQ(grants[3].job.value, "long steps");
  std::vector<LeaseProgress> progress(4, {.counter = 1, .rendering = true, .pulse = 7});
  SchedulerNews news;
  Duration waited{};
  const auto heartbeats = [&] {
    clock_.Advance(milliseconds(500));
    waited += milliseconds(500);
    ++progress[1].pulse;
    for (size_t i = 0; i < 4; ++i) {
      progress[i].cpu += milliseconds(i == 2 ? 50 : 500);
      scheduler_.Renew(grants[i].worker, grants[i].lease, progress[i]);
    }
    news = scheduler_.Tick();
  };
  while (news.lost.empty() && waited < seconds(30)) heartbeats();
  ASSERT_EQ(news.lost.size(), 1u);
  EXPECT_EQ(news.lost[0].grant.worker, circles);
  EXPECT_THAT(news.lost[0].reason, HasSubstr("has not got on"));
  EXPECT_EQ(news.lost[0].cause, LossCause::kHung);
  EXPECT_LE(waited, options_.stall_time + seconds(1));
  for (int i = 0; i < 20; ++i) {
    heartbeats();
    EXPECT_THAT(news.lost, IsEmpty());
  }
  // The tile's next worker has twice the time.
  grants[0] = *scheduler_.Lease(AddWorker("next"));
  ASSERT_TRUE(grants[0].careful);
  waited = {};
  news = {};
  while (news.lost.empty() && waited < seconds(30)) heartbeats();
  ASSERT_EQ(news.lost.size(), 1u);
  EXPECT_GT(waited, 2 * options_.stall_time - seconds(1));
  EXPECT_LE(waited, 2 * options_.stall_time + seconds(1));
}

TEST_F(TileSchedulerTest, AThreadThatHangsLosesItsTileLongBeforeASlowOne) {
  AddJob("a", 2);
  const WorkerId hung = AddWorker("hung"), slow = AddWorker("slow");
  const auto a = scheduler_.Lease(hung), b = scheduler_.Lease(slow);
  LeaseProgress idle{.counter = 1, .rendering = true, .cpu = milliseconds(100)};
  LeaseProgress busy = idle;
  SchedulerNews news;
  Duration waited{};
  while (news.lost.empty() && waited < seconds(60)) {
    clock_.Advance(milliseconds(500));
    waited += milliseconds(500);
    idle.cpu += milliseconds(1);    // heartbeats cost a little
    busy.cpu += milliseconds(100);  // a fifth of a core
    scheduler_.Renew(hung, a->lease, idle);
    scheduler_.Renew(slow, b->lease, busy);
    news = scheduler_.Tick();
  }
  ASSERT_EQ(news.lost.size(), 1u);
  EXPECT_EQ(news.lost[0].grant.worker, hung);
  EXPECT_THAT(news.lost[0].reason, HasSubstr("hangs"));
  EXPECT_EQ(news.lost[0].cause, LossCause::kHung);
  EXPECT_LE(waited, options_.stall_time + seconds(1));
  // Before it renders it may wait for the network or the disk.
  const auto again = scheduler_.Lease(AddWorker("loads"));
  for (int i = 0; i < 20; ++i) {
    clock_.Advance(seconds(1));
    scheduler_.Renew(again->worker, again->lease, {.counter = 1, .cpu = milliseconds(5)});
    busy.cpu += milliseconds(100);
    scheduler_.Renew(slow, b->lease, busy);
    EXPECT_THAT(scheduler_.Tick().lost, IsEmpty());
  }
}

TEST_F(TileSchedulerTest, ATileOfAWorkerKnownToBeSlowIsCopiedAtOnce) {
  AddJob("a", 13);
  const WorkerId slow = AddWorker("slow"), fast = AddWorker("fast");
  for (int i = 0; i < 10; ++i) Render(fast, seconds(2));
  Render(slow, seconds(20));
  const auto held = scheduler_.Lease(slow);
  Render(fast, seconds(2));
  const auto copy = scheduler_.Lease(fast);
  ASSERT_TRUE(copy.has_value());
  EXPECT_TRUE(copy->speculative);
  EXPECT_EQ(copy->tile, held->tile);
}

TEST_F(TileSchedulerTest, WorkersKeepToNeighboursFarFromEachOther) {
  AddJob("a", 64);
  std::vector<WorkerId> workers;
  std::map<WorkerId, std::vector<uint32_t>> tiles;
  for (int i = 0; i < 4; ++i) workers.push_back(AddWorker("w" + std::to_string(i)));
  for (int round = 0; round < 16; ++round) {
    for (const WorkerId& w : workers) tiles[w].push_back(Render(w));
  }
  std::set<uint32_t> starts;
  for (const auto& [worker, mine] : tiles) {
    for (size_t i = 1; i < mine.size(); ++i) EXPECT_EQ(mine[i], mine[i - 1] + 1);
    starts.insert(mine.front());
  }
  EXPECT_THAT(starts, ElementsAre(0, 16, 32, 48));
}

TEST_F(TileSchedulerTest, ATileThatWasTriedGoesFirst) {
  AddJob("a", 10);
  const WorkerId dies = AddWorker("dies"), other = AddWorker("other");
  Render(other);
  const auto lost = scheduler_.Lease(dies);
  scheduler_.RemoveWorker(dies);
  EXPECT_EQ(scheduler_.Lease(other)->tile, lost->tile);
}

// --- Audits ---

class Audits : public TileSchedulerTest {
 protected:
  Audits() {
    options_.audit_fraction = 1;
    options_.audit_seed = 7;
    audited_ = std::make_unique<TileScheduler>(options_, clock_);
  }
  WorkerId Join(const std::string& id) {
    audited_->AddWorker({id}, {.fingerprint = DigestOf("f"), .name = "name of " + id});
    return {id};
  }
  void Add(const std::string& id, uint32_t tiles) {
    audited_->AddJob({.id = {id}, .number = ++number_, .tiles = tiles});
  }
  // Leases and returns `pixels`.
  LeaseGrant Return(const WorkerId& worker, const std::string& pixels) {
    const auto grant = audited_->Lease(worker);
    EXPECT_TRUE(grant.has_value());
    if (!grant) return {};
    clock_.Advance(milliseconds(10));
    EXPECT_TRUE(audited_->BeginCommit(worker, grant->lease, grant->attempt).ok());
    if (grant->audit) {
      verdict_ = audited_->FinishAudit(grant->lease, DigestOf(pixels));
    } else {
      EXPECT_TRUE(audited_->FinishCommit(grant->lease, true, DigestOf(pixels)));
    }
    return *grant;
  }

  std::unique_ptr<TileScheduler> audited_;
  AuditVerdict verdict_;
};

TEST_F(Audits, AnotherWorkerRendersATileAgain) {
  Add("a", 2);
  const WorkerId w1 = Join("1");
  EXPECT_FALSE(Return(w1, "x").audit);
  EXPECT_FALSE(Return(w1, "y").audit);
  EXPECT_FALSE(audited_->Lease(w1).has_value()) << "not by the one who made it";
  EXPECT_EQ(audited_->Audits({"a"}), AuditState::kNone) << "nobody else is there";
  const WorkerId w2 = Join("2");
  EXPECT_EQ(audited_->Audits({"a"}), AuditState::kOpen);
  EXPECT_EQ(audited_->Counts({"a"}), (TileCounts{.committed = 2, .total = 2}));
  const LeaseGrant first = Return(w2, "x");
  EXPECT_TRUE(first.audit);
  EXPECT_EQ(first.tile, 0u);
  EXPECT_TRUE(verdict_.counted);
  EXPECT_FALSE(verdict_.disputed);
  EXPECT_EQ(Return(w2, "y").tile, 1u);
  EXPECT_FALSE(audited_->Lease(w2).has_value());
  EXPECT_EQ(audited_->Audits({"a"}), AuditState::kNone);
  EXPECT_EQ(audited_->Report({"a"}).audits_done, 2u);
  EXPECT_EQ(audited_->Report({"a"}).audits_differ, 0u);
}

TEST_F(Audits, TwoAgainstOneSetTheLiarAsideAndOpenItsTiles) {
  Add("a", 3);
  Add("b", 1);
  const WorkerId liar = Join("liar"), good = Join("good"), third = Join("third");
  for (const char* pixels : {"x'", "y", "z"}) Return(liar, pixels);
  Return(liar, "w");
  EXPECT_EQ(Return(good, "x").tile, 0u);
  EXPECT_TRUE(verdict_.disputed);
  EXPECT_TRUE(verdict_.convicted.empty());
  EXPECT_EQ(audited_->DisputedTiles({"a"}), std::vector<uint32_t>{0});
  EXPECT_EQ(Return(third, "x").tile, 0u);
  ASSERT_EQ(verdict_.convicted.size(), 1u);
  EXPECT_EQ(verdict_.convicted[0].id, liar);
  EXPECT_EQ(verdict_.convicted[0].name, "name of liar");
  EXPECT_THAT(verdict_.reopened.at({"a"}), ElementsAre(0, 1, 2));
  EXPECT_THAT(verdict_.reopened.at({"b"}), ElementsAre(0));
  EXPECT_EQ(audited_->Counts({"a"}), (TileCounts{.queued = 3, .total = 3}));
  EXPECT_FALSE(audited_->Lease(liar).has_value());
  clock_.Advance(std::chrono::hours(1));
  EXPECT_FALSE(audited_->Lease(liar).has_value()) << "for good";
  for (int i = 0; i < 4; ++i) EXPECT_FALSE(Return(good, "right").audit);
  EXPECT_EQ(audited_->Counts({"a"}), (TileCounts{.committed = 3, .total = 3}));
}

TEST_F(Audits, TheAuditorMayBeTheLiar) {
  Add("a", 2);
  const WorkerId good = Join("good");
  Return(good, "x");
  const WorkerId liar = Join("liar"), third = Join("third");
  EXPECT_EQ(Return(liar, "x'").tile, 0u);
  EXPECT_EQ(Return(third, "x").tile, 0u);
  ASSERT_EQ(verdict_.convicted.size(), 1u);
  EXPECT_EQ(verdict_.convicted[0].id, liar);
  EXPECT_TRUE(verdict_.reopened.empty());
  EXPECT_EQ(audited_->Counts({"a"}).committed, 1u);
}

TEST_F(Audits, AConvictStaysOneUnderAnotherId) {
  Add("a", 4);
  const WorkerId liar = Join("liar");
  Return(liar, "x'");
  Return(Join("good"), "x");
  Return(Join("third"), "x");
  ASSERT_EQ(verdict_.convicted.size(), 1u);
  EXPECT_TRUE(audited_->IsConvicted({.name = "name of liar"}));
  EXPECT_FALSE(audited_->IsConvicted({.name = "name of good"}));
  audited_->RemoveWorker(liar);
  audited_->AddWorker({"again"}, {.fingerprint = DigestOf("f"), .name = "name of liar"});
  EXPECT_FALSE(audited_->Lease({"again"}).has_value());
  ASSERT_EQ(audited_->Workers().size(), 3u);
  for (const WorkerStatus& worker : audited_->Workers()) {
    EXPECT_EQ(worker.set_aside, worker.name == "name of liar");
  }
}

// Whoever restarts between its result and the audit would otherwise confirm itself.
TEST_F(Audits, AWorkerHasOneVoiceUnderHoweverManyIds) {
  Add("a", 1);
  const WorkerId first = Join("1");
  Return(first, "x'");
  audited_->RemoveWorker(first);
  audited_->AddWorker({"2"}, {.fingerprint = DigestOf("f"), .name = "name of 1"});
  EXPECT_FALSE(audited_->Lease({"2"}).has_value());
  EXPECT_EQ(audited_->Audits({"a"}), AuditState::kNone) << "nobody else is there";
  EXPECT_TRUE(Return(Join("3"), "x").audit);
}

TEST_F(Audits, AllWorkersOfACertificateAreOne) {
  const auto join = [&](const std::string& id, const std::string& certificate) {
    audited_->AddWorker({id}, {.fingerprint = DigestOf("f"),
                               .name = certificate + "/" + id,
                               .certified_as = certificate});
    return WorkerId{id};
  };
  Add("a", 3);
  const WorkerId one = join("one", "liar"), two = join("two", "liar"), good = join("good", "good");
  Return(one, "x'");
  const LeaseGrant of_two = Return(two, "y");
  EXPECT_FALSE(of_two.audit) << "it may not confirm what the other one returned";
  EXPECT_EQ(Return(good, "x").tile, 0u);
  EXPECT_EQ(Return(good, "y").tile, of_two.tile);
  EXPECT_EQ(Return(join("third", "third"), "x").tile, 0u);
  ASSERT_EQ(verdict_.convicted.size(), 1u);
  EXPECT_EQ(verdict_.convicted[0].certified_as, "liar");
  EXPECT_FALSE(audited_->Lease(two).has_value());
  EXPECT_TRUE(audited_->IsConvicted({.name = "another", .certified_as = "liar"}));
  EXPECT_EQ(audited_->Counts({"a"}), (TileCounts{.queued = 3, .total = 3}));
}

TEST_F(Audits, WithoutAThirdWorkerADisagreementIsNotDecided) {
  Add("a", 1);
  Return(Join("1"), "x");
  Return(Join("2"), "x'");
  EXPECT_EQ(audited_->Audits({"a"}), AuditState::kOpen) << "a third one may come";
  clock_.Advance(options_.decide_time);
  EXPECT_EQ(audited_->Audits({"a"}), AuditState::kUndecided);
  EXPECT_EQ(audited_->DisputedTiles({"a"}), std::vector<uint32_t>{0});
}

TEST_F(Audits, AResultThatIsBeingStoredWhenItsWorkerIsConvictedDoesNotCount) {
  Add("a", 2);
  const WorkerId liar = Join("liar");
  Return(liar, "x'");
  const auto second = audited_->Lease(liar);
  ASSERT_TRUE(audited_->BeginCommit(liar, second->lease, second->attempt).ok());
  Return(Join("good"), "x");
  Return(Join("third"), "x");
  ASSERT_EQ(verdict_.convicted.size(), 1u);
  EXPECT_FALSE(audited_->FinishCommit(second->lease, true, DigestOf("y'")));
  EXPECT_EQ(audited_->Counts({"a"}), (TileCounts{.queued = 2, .total = 2}));
}

TEST_F(Audits, ALostAuditIsGivenToAnother) {
  Add("a", 1);
  Return(Join("1"), "x");
  const WorkerId dies = Join("dies");
  const auto grant = audited_->Lease(dies);
  ASSERT_TRUE(grant && grant->audit);
  clock_.Advance(options_.silence_time);
  EXPECT_EQ(audited_->Tick().lost.size(), 1u);
  EXPECT_EQ(audited_->Counts({"a"}), (TileCounts{.committed = 1, .total = 1}));
  EXPECT_THAT(audited_->Report({"a"}).troubled, IsEmpty()) << "the tile has been rendered once";
  EXPECT_TRUE(Return(Join("2"), "x").audit);
}

// A worker that returns wrong pixels for a fifth of its tiles, and audits of 2 %.
TEST_F(Audits, FindAWorkerThatLiesNowAndThenWithin400Tiles) {
  int found = 0;
  constexpr int kTrials = 400;
  for (int trial = 0; trial < kTrials; ++trial) {
    options_.audit_fraction = 0.02;
    options_.audit_seed = 1 + static_cast<uint64_t>(trial);
    audited_ = std::make_unique<TileScheduler>(options_, clock_);
    std::mt19937 random(1000 + static_cast<uint32_t>(trial));
    Add("a", 2000);
    const WorkerId liar = Join("liar"), good = Join("good"), third = Join("third");
    verdict_ = {};
    for (int tile = 0; tile < 400 && verdict_.convicted.empty(); ++tile) {
      Return(liar, random() % 5 == 0 ? "wrong" : "right");
      for (const WorkerId& w : {good, third}) {
        if (verdict_.convicted.empty()) Return(w, "right");
      }
    }
    found += !verdict_.convicted.empty();
    for (const auto& convict : verdict_.convicted) ASSERT_EQ(convict.id, liar);
  }
  // 1 - (1 - 0.02 / 5)^400 = 0.80; 0.75 is 2.5 standard errors below.
  EXPECT_GE(found, kTrials * 3 / 4);
}

TEST_F(TileSchedulerTest, AFailedTileGoesToAnotherWorkerIfThereIsOne) {
  AddJob("a", 2);
  const WorkerId w1 = AddWorker("1");
  const auto first = scheduler_.Lease(w1);
  scheduler_.ReportFailure(w1, first->lease, false, absl::InternalError("boom"));
  const WorkerId w2 = AddWorker("2");
  EXPECT_EQ(scheduler_.Lease(w1)->tile, 1u);
  EXPECT_EQ(scheduler_.Lease(w2)->tile, 0u);
}

TEST_F(TileSchedulerTest, OneWorkerAloneTriesAgainUntilTheTileFails) {
  options_.max_worker_failures = 1000;
  TileScheduler scheduler(options_, clock_);
  scheduler.AddJob({.id = {"a"}, .tiles = 1});
  scheduler.AddWorker({"w"}, {});
  for (uint32_t i = 1; i <= options_.max_tile_failures; ++i) {
    const auto grant = scheduler.Lease({"w"});
    ASSERT_TRUE(grant.has_value()) << i;
    const SchedulerNews news =
        scheduler.ReportFailure({"w"}, grant->lease, false, absl::InternalError("boom"));
    EXPECT_EQ(news.set_aside.size(), i == options_.max_tile_failures ? 1u : 0u) << i;
  }
}

TEST_F(TileSchedulerTest, PermanentErrorsFailTheJobAtOnce) {
  AddJob("a", 2);
  const WorkerId w = AddWorker("w");
  const auto grant = scheduler_.Lease(w);
  const SchedulerNews news =
      scheduler_.ReportFailure(w, grant->lease, false, absl::InvalidArgumentError("bad scene"));
  ASSERT_EQ(news.failed.size(), 1u);
  EXPECT_TRUE(absl::IsInvalidArgument(news.failed[0].error));
  EXPECT_THAT(std::string(news.failed[0].error.message()), HasSubstr("bad scene"));
}

// One broken worker would fail every job of the farm.
TEST_F(TileSchedulerTest, PermanentErrorsAreBelievedOfTwoWorkersWhereThereAreTwo) {
  AddJob("a", 2);
  const WorkerId broken = AddWorker("broken"), good = AddWorker("good");
  const auto grant = scheduler_.Lease(broken);
  EXPECT_TRUE(
      scheduler_.ReportFailure(broken, grant->lease, false, absl::InvalidArgumentError("bad"))
          .failed.empty());
  // A second time it is no other worker that says so.
  const auto next = scheduler_.Lease(broken);
  ASSERT_TRUE(next && next->tile != grant->tile);
  EXPECT_TRUE(
      scheduler_.ReportFailure(broken, next->lease, false, absl::InvalidArgumentError("bad"))
          .failed.empty());
  const auto again = scheduler_.Lease(good);
  ASSERT_TRUE(again.has_value());
  const SchedulerNews news =
      scheduler_.ReportFailure(good, again->lease, false, absl::InvalidArgumentError("bad"));
  ASSERT_EQ(news.failed.size(), 1u);
  EXPECT_TRUE(absl::IsInvalidArgument(news.failed[0].error));
}

TEST_F(TileSchedulerTest, NamesTellWorkersApartThatAreThere) {
  for (const char* id : {"1", "2", "3"}) scheduler_.AddWorker({id}, {.name = "render"});
  EXPECT_EQ(scheduler_.FindWorker({"1"})->name, "render");
  EXPECT_EQ(scheduler_.FindWorker({"2"})->name, "render#2");
  EXPECT_EQ(scheduler_.FindWorker({"3"})->name, "render#3");
  scheduler_.RemoveWorker({"2"});
  scheduler_.AddWorker({"4"}, {.name = "render"});
  EXPECT_EQ(scheduler_.FindWorker({"4"})->name, "render#2");
}

TEST_F(TileSchedulerTest, AWorkerThatFailsRepeatedlyIsSetAsideForAWhile) {
  AddJob("a", 10);
  const WorkerId w = AddWorker("w");
  AddWorker("other");
  for (uint32_t i = 0; i < options_.max_worker_failures; ++i) {
    const auto grant = scheduler_.Lease(w);
    ASSERT_TRUE(grant.has_value()) << i;
    scheduler_.ReportFailure(w, grant->lease, false, absl::InternalError("boom"));
  }
  EXPECT_FALSE(scheduler_.Lease(w).has_value());
  EXPECT_TRUE(scheduler_.Lease({"other"}).has_value());
  clock_.Advance(options_.set_aside_time);
  EXPECT_TRUE(scheduler_.Lease(w).has_value());
}

TEST_F(TileSchedulerTest, SuccessClearsAWorkersFailures) {
  AddJob("a", 100);
  const WorkerId w = AddWorker("w");
  for (uint32_t i = 0; i < 5 * options_.max_worker_failures; ++i) {
    for (uint32_t k = 1; k < options_.max_worker_failures; ++k) {
      // A tile fails at most max_tile_failures times, so other tiles' turn must come.
      AddJob("b" + std::to_string(i) + "-" + std::to_string(k), 1, 1);
      const auto grant = scheduler_.Lease(w);
      scheduler_.ReportFailure(w, grant->lease, false, absl::InternalError("boom"));
      scheduler_.RemoveJob(grant->job);
    }
    Render(w);
    ASSERT_FALSE(scheduler_.Workers()[0].set_aside);
  }
}

TEST_F(TileSchedulerTest, ASlowTileIsCopiedAndTheFirstResultWins) {
  AddJob("a", 3);
  const WorkerId slow = AddWorker("slow"), fast = AddWorker("fast");
  const auto original = scheduler_.Lease(slow);
  for (int i = 0; i < 2; ++i) {
    Render(fast, seconds(1));
    scheduler_.Renew(slow, original->lease, {++counter_, 0.1f});
  }
  EXPECT_FALSE(scheduler_.Lease(fast).has_value());  // not slow enough yet
  for (int i = 0; i < 3; ++i) Beat(*original, seconds(2), true);
  const auto copy = scheduler_.Lease(fast);
  ASSERT_TRUE(copy.has_value());
  EXPECT_TRUE(copy->speculative);
  EXPECT_EQ(copy->tile, original->tile);
  EXPECT_EQ(scheduler_.Counts({"a"}), (TileCounts{.leased = 1, .committed = 2, .total = 3}));
  EXPECT_FALSE(scheduler_.Lease(AddWorker("third")).has_value());  // one copy is enough

  ASSERT_TRUE(scheduler_.BeginCommit(fast, copy->lease, copy->attempt).ok());
  // The original arrives while the copy is being stored.
  EXPECT_FALSE(scheduler_.BeginCommit(slow, original->lease, original->attempt).ok());
  EXPECT_TRUE(scheduler_.FinishCommit(copy->lease, true));
  EXPECT_TRUE(scheduler_.Renew(slow, original->lease, {++counter_, 0.5f}).drop);
  EXPECT_EQ(scheduler_.Counts({"a"}), (TileCounts{.committed = 3, .total = 3}));
  EXPECT_EQ(scheduler_.Refused({"a"}), 1u);
}

TEST_F(TileSchedulerTest, ACopySurvivesTheLossOfTheOriginal) {
  AddJob("a", 2);
  const WorkerId slow = AddWorker("slow"), fast = AddWorker("fast");
  const auto original = scheduler_.Lease(slow);
  Render(fast, seconds(1));
  for (int i = 0; i < 5; ++i) Beat(*original, seconds(2), true);
  const auto copy = scheduler_.Lease(fast);
  ASSERT_TRUE(copy.has_value());
  scheduler_.ReportFailure(slow, original->lease, false, absl::InternalError("boom"));
  EXPECT_EQ(scheduler_.Counts({"a"}), (TileCounts{.leased = 1, .committed = 1, .total = 2}));
  EXPECT_TRUE(scheduler_.BeginCommit(fast, copy->lease, copy->attempt).ok());
  EXPECT_TRUE(scheduler_.FinishCommit(copy->lease, true));
}

TEST_F(TileSchedulerTest, TheFirstCommittedTileDecidesTheFingerprint) {
  AddJob("a", 3);
  const WorkerId x = AddWorker("x", "fx"), y = AddWorker("y", "fy");
  const auto of_x = scheduler_.Lease(x);
  const auto of_y = scheduler_.Lease(y);
  ASSERT_TRUE(of_x && of_y);
  ASSERT_TRUE(scheduler_.BeginCommit(y, of_y->lease, 1).ok());
  // Both stored at a time would be two fingerprints in one image.
  EXPECT_FALSE(scheduler_.BeginCommit(x, of_x->lease, 1).ok());
  ASSERT_TRUE(scheduler_.FinishCommit(of_y->lease, true));
  EXPECT_TRUE(scheduler_.Renew(x, of_x->lease, {1, 0}).drop);
  EXPECT_FALSE(scheduler_.Lease(x).has_value());
  EXPECT_TRUE(scheduler_.Lease(y).has_value());
}

TEST_F(TileSchedulerTest, AFirstResultThatWasNotStoredDecidesNothing) {
  AddJob("a", 2);
  const WorkerId x = AddWorker("x", "fx"), y = AddWorker("y", "fy");
  auto grant = scheduler_.Lease(x);
  ASSERT_TRUE(scheduler_.BeginCommit(x, grant->lease, 1).ok());
  ASSERT_TRUE(scheduler_.FinishCommit(grant->lease, false));
  grant = scheduler_.Lease(x);
  ASSERT_TRUE(scheduler_.BeginCommit(x, grant->lease, 2).ok());
  EXPECT_EQ(scheduler_.RefuseResult(grant->lease, "wrong hash").lost.size(), 1u);
  EXPECT_EQ(scheduler_.Refused({"a"}), 1u);
  EXPECT_TRUE(scheduler_.Lease(y).has_value());
}

TEST_F(TileSchedulerTest, ResultsOfTheWrongAttemptOrWorkerAreRefused) {
  AddJob("a", 1);
  const WorkerId w = AddWorker("w"), thief = AddWorker("thief");
  const auto grant = scheduler_.Lease(w);
  EXPECT_FALSE(scheduler_.BeginCommit(w, grant->lease, 2).ok());
  EXPECT_FALSE(scheduler_.BeginCommit(thief, grant->lease, 1).ok());
  EXPECT_FALSE(scheduler_.BeginCommit(w, {"invented"}, 1).ok());
  EXPECT_EQ(scheduler_.Refused({"a"}), 2u);
  EXPECT_TRUE(scheduler_.BeginCommit(w, grant->lease, 1).ok());
}

TEST_F(TileSchedulerTest, AskingAgainMeansThatTheLastAnswerWasLost) {
  AddJob("a", 1);
  const WorkerId w = AddWorker("w");
  const auto lost = scheduler_.Lease(w);
  const auto again = scheduler_.Lease(w);
  ASSERT_TRUE(again.has_value());
  EXPECT_NE(lost->lease, again->lease);
  EXPECT_EQ(scheduler_.ActiveLeases(), 1u);
  EXPECT_EQ(scheduler_.Workers()[0].failures, 0u);
}

TEST_F(TileSchedulerTest, AWorkerThatLeavesWhileItsResultIsStoredStillCounts) {
  AddJob("a", 1);
  const WorkerId w = AddWorker("w");
  const auto grant = scheduler_.Lease(w);
  ASSERT_TRUE(scheduler_.BeginCommit(w, grant->lease, 1).ok());
  scheduler_.RemoveWorker(w);
  EXPECT_TRUE(scheduler_.FinishCommit(grant->lease, true));
  EXPECT_EQ(scheduler_.Counts({"a"}), (TileCounts{.committed = 1, .total = 1}));
}

TEST_F(TileSchedulerTest, AnEndedJobTakesItsLeasesWithIt) {
  AddJob("a", 2);
  const WorkerId w = AddWorker("w");
  const auto grant = scheduler_.Lease(w);
  ASSERT_TRUE(scheduler_.BeginCommit(w, grant->lease, 1).ok());
  scheduler_.RemoveJob({"a"});
  EXPECT_FALSE(scheduler_.FinishCommit(grant->lease, true));
  EXPECT_EQ(scheduler_.ActiveLeases(), 0u);
  EXPECT_TRUE(scheduler_.Renew(w, grant->lease, {1, 0}).drop);
}

TEST_F(TileSchedulerTest, AJobThatRunsTooLongFails) {
  ScheduledJob job;
  job.id = {"a"};
  job.tiles = 2;
  job.max_time = seconds(10);
  scheduler_.AddJob(job);
  clock_.Advance(seconds(60));  // waiting does not count
  EXPECT_THAT(scheduler_.Tick().failed, IsEmpty());
  const WorkerId w = AddWorker("w");
  Render(w, seconds(9));
  EXPECT_THAT(scheduler_.Tick().failed, IsEmpty());
  clock_.Advance(seconds(2));
  const SchedulerNews news = scheduler_.Tick();
  ASSERT_EQ(news.failed.size(), 1u);
  EXPECT_TRUE(absl::IsResourceExhausted(news.failed[0].error));
}

TEST_F(TileSchedulerTest, SilentIdleWorkersAreForgotten) {
  AddWorker("w");
  clock_.Advance(options_.forget_worker_after);
  EXPECT_EQ(scheduler_.Tick().forgotten.size(), 1u);
  EXPECT_FALSE(scheduler_.HasWorker({"w"}));
}

TEST_F(TileSchedulerTest, ProgressAndEtaFollowTheTiles) {
  AddJob("a", 4);
  const WorkerId w = AddWorker("w");
  EXPECT_EQ(scheduler_.EtaSeconds({"a"}), std::nullopt);
  Render(w, seconds(10));
  EXPECT_DOUBLE_EQ(scheduler_.Progress({"a"}), 0.25);
  EXPECT_DOUBLE_EQ(*scheduler_.EtaSeconds({"a"}), 30);
  const auto grant = scheduler_.Lease(w);
  scheduler_.Renew(w, grant->lease, {1, 0.5f});
  EXPECT_DOUBLE_EQ(scheduler_.Progress({"a"}), 0.375);
}

TEST_F(TileSchedulerTest, OnlyOpenTilesAreLeased) {
  ScheduledJob job;
  job.id = {"a"};
  job.tiles = 4;
  job.committed = {3};
  job.fingerprint = DigestOf("f");
  job.open = false;
  scheduler_.AddJob(job);
  const WorkerId w = AddWorker("w");
  EXPECT_FALSE(scheduler_.Lease(w).has_value());
  EXPECT_EQ(scheduler_.Counts({"a"}), (TileCounts{.queued = 3, .committed = 1, .total = 4}));
  EXPECT_EQ(scheduler_.Leasable({"a"}), 0u);
  scheduler_.OpenTiles({"a"}, 2, 2);
  EXPECT_EQ(scheduler_.Leasable({"a"}), 1u);
  EXPECT_EQ(Render(w), 2u);
  EXPECT_FALSE(scheduler_.Lease(w).has_value());
  scheduler_.OpenTiles({"a"}, 0, 2);
  EXPECT_EQ(Render(w), 0u);
  EXPECT_EQ(Render(w), 1u);
  EXPECT_EQ(scheduler_.Counts({"a"}), (TileCounts{.committed = 4, .total = 4}));
}

TEST_F(TileSchedulerTest, AFailedJobsClosedTilesFailToo) {
  ScheduledJob job;
  job.id = {"a"};
  job.tiles = 4;
  job.open = false;
  scheduler_.AddJob(job);
  scheduler_.OpenTiles({"a"}, 0, 1);
  const WorkerId w = AddWorker("w");
  const auto grant = scheduler_.Lease(w);
  const SchedulerNews news =
      scheduler_.ReportFailure(w, grant->lease, false, absl::InvalidArgumentError("bad"));
  ASSERT_EQ(news.failed.size(), 1u);
  EXPECT_EQ(news.failed[0].tile, 0u);
  EXPECT_EQ(scheduler_.Counts({"a"}), (TileCounts{.failed = 4, .total = 4}));
}

TEST_F(TileSchedulerTest, APausedJobGivesNoTilesButTakesResults) {
  AddJob("a", 3);
  AddJob("b", 1);
  const WorkerId w1 = AddWorker("1"), w2 = AddWorker("2");
  const auto in_work = scheduler_.Lease(w1);
  scheduler_.SetPaused({"a"}, true);
  EXPECT_EQ(scheduler_.Lease(w2)->job, JobId{"b"});
  EXPECT_FALSE(scheduler_.Renew(w1, in_work->lease, {1, 0.5f}).drop);
  ASSERT_TRUE(scheduler_.BeginCommit(w1, in_work->lease, in_work->attempt).ok());
  EXPECT_TRUE(scheduler_.FinishCommit(in_work->lease, true));
  EXPECT_FALSE(scheduler_.Lease(w1).has_value());
  scheduler_.SetPaused({"a"}, false);
  scheduler_.SetPaused({"a"}, false);
  EXPECT_EQ(scheduler_.Lease(w1)->job, JobId{"a"});
}

TEST_F(TileSchedulerTest, ASlowTileOfAPausedJobIsNotCopied) {
  AddJob("a", 2);
  const WorkerId w1 = AddWorker("1"), w2 = AddWorker("2");
  Render(w1);
  const auto slow = scheduler_.Lease(w1);
  for (int i = 0; i < 10; ++i) Beat(*slow, seconds(2), true);
  scheduler_.SetPaused({"a"}, true);
  EXPECT_FALSE(scheduler_.Lease(w2).has_value());
  scheduler_.SetPaused({"a"}, false);
  EXPECT_TRUE(scheduler_.Lease(w2)->speculative);
}

TEST_F(TileSchedulerTest, APauseCountsNotAsTimeOfTheJob) {
  ScheduledJob job;
  job.id = {"a"};
  job.tiles = 2;
  job.max_time = seconds(100);
  scheduler_.AddJob(job);
  const WorkerId w = AddWorker("w");
  Render(w, seconds(60));
  scheduler_.SetPaused({"a"}, true);
  EXPECT_FALSE(scheduler_.EtaSeconds({"a"}).has_value());
  clock_.Advance(seconds(1000));
  EXPECT_THAT(scheduler_.Tick().failed, IsEmpty());
  scheduler_.SetPaused({"a"}, false);
  EXPECT_NEAR(*scheduler_.EtaSeconds({"a"}), 60, 1e-6);
  clock_.Advance(seconds(39));
  EXPECT_THAT(scheduler_.Tick().failed, IsEmpty());
  clock_.Advance(seconds(2));
  EXPECT_EQ(scheduler_.Tick().failed.size(), 1u);
}

TEST_F(TileSchedulerTest, AnotherPriorityHoldsFromTheNextLeaseOn) {
  AddJob("a", 2);
  AddJob("b", 2);
  const WorkerId w = AddWorker("w");
  const auto grant_of = [&] { return scheduler_.Lease(w)->job; };
  EXPECT_EQ(grant_of(), JobId{"a"});
  scheduler_.SetPriority({"b"}, 1);
  EXPECT_EQ(grant_of(), JobId{"b"});
  scheduler_.SetPriority({"b"}, -1);
  EXPECT_EQ(grant_of(), JobId{"a"});
}

TEST_F(TileSchedulerTest, ForgottenFailuresCountNoMore) {
  AddJob("a", 1);
  for (int i = 0; i < 2; ++i) {
    const WorkerId w = AddWorker("bad" + std::to_string(i));
    const auto grant = scheduler_.Lease(w);
    scheduler_.ReportFailure(w, grant->lease, false, absl::InternalError("boom"));
  }
  const JobReport before = scheduler_.Report({"a"});
  ASSERT_EQ(before.troubled.size(), 1u);
  EXPECT_EQ(before.troubled[0].failures, 2u);
  EXPECT_EQ(before.troubled[0].workers, 2u);
  EXPECT_EQ(before.troubled[0].cause, "boom");
  scheduler_.ForgetFailures({"a"});
  EXPECT_THAT(scheduler_.Report({"a"}).troubled, IsEmpty());
  const WorkerId w = AddWorker("third");
  const auto grant = scheduler_.Lease(w);
  EXPECT_THAT(scheduler_.ReportFailure(w, grant->lease, false, absl::InternalError("boom")).failed,
              IsEmpty());
}

TEST_F(TileSchedulerTest, ReportsTilesInWorkTheLongestFirst) {
  AddJob("a", 3);
  const WorkerId w1 = AddWorker("1"), w2 = AddWorker("2");
  const auto first = scheduler_.Lease(w1);
  clock_.Advance(seconds(2));
  const auto second = scheduler_.Lease(w2);
  Beat(*second, seconds(1), true);
  const JobReport report = scheduler_.Report({"a"});
  EXPECT_EQ(report.leasable, 1u);
  ASSERT_EQ(report.in_work.size(), 2u);
  EXPECT_EQ(report.in_work[0].grant.tile, first->tile);
  EXPECT_NEAR(report.in_work[0].seconds, 3, 1e-6);
  EXPECT_EQ(report.in_work[1].fraction, 0.5f);
  EXPECT_EQ(scheduler_.JobOf(first->lease), JobId{"a"});
  scheduler_.RemoveWorker(w1);
  EXPECT_EQ(scheduler_.JobOf(first->lease), JobId{"a"});  // ended, but remembered
  EXPECT_EQ(scheduler_.JobOf({"unknown"}), JobId{});
}

// Whatever happens in whatever order: the tiles add up, a tile is committed once, and in the end
// all are.
class RandomEvents : public ::testing::TestWithParam<uint32_t> {};

TEST_P(RandomEvents, KeepTheInvariants) {
  std::mt19937 random(GetParam());
  SchedulerOptions options;
  options.audit_fraction = 0.3;
  options.audit_seed = GetParam();
  FakeClock clock;
  TileScheduler scheduler(options, clock);
  struct Held {
    LeaseGrant grant;
    bool committing = false;
  };
  std::map<JobId, uint32_t> totals;
  std::map<JobId, std::map<uint32_t, int>> commits;
  std::vector<Held> held;  // live or stale: workers do not know
  std::vector<WorkerId> workers;
  uint32_t next_worker = 0, next_job = 0;
  uint64_t counter = 0;
  const auto add_worker = [&] {
    workers.push_back({"w" + std::to_string(next_worker++)});
    WorkerHello hello;
    hello.fingerprint = DigestOf(next_worker % 5 == 0 ? "odd" : "usual");
    scheduler.AddWorker(workers.back(), hello);
  };
  const auto add_job = [&] {
    ScheduledJob job;
    job.id = {"j" + std::to_string(next_job++)};
    job.number = next_job;
    job.priority = static_cast<int>(random() % 3);
    job.tiles = 1 + random() % 12;
    totals[job.id] = job.tiles;
    scheduler.AddJob(job);
  };
  const auto check = [&] {
    uint32_t leased = 0, open_audits = 0;
    for (const auto& [id, total] : totals) {
      const TileCounts c = scheduler.Counts(id);
      ASSERT_EQ(c.total, total);
      ASSERT_EQ(c.queued + c.leased + c.committed + c.failed, total);
      ASSERT_EQ(c.committed, commits[id].size());
      uint32_t set_aside = 0;
      for (const TroubledTile& t : scheduler.Report(id).troubled) set_aside += t.set_aside;
      ASSERT_EQ(c.failed, set_aside);
      leased += c.leased;
      open_audits += scheduler.Report(id).audits_open;
    }
    ASSERT_GE(scheduler.ActiveLeases(), leased);
    ASSERT_LE(scheduler.ActiveLeases(), 2 * leased + open_audits);
  };
  add_worker();
  add_job();
  const auto finish = [&](Held& h, bool durable) {
    // Few workers return something else, and are found.
    const bool lies = h.grant.worker.value.ends_with("3") && random() % 2 == 0;
    const Digest result = DigestOf(lies ? "wrong" : "right");
    if (h.grant.audit) {
      const AuditVerdict verdict = scheduler.FinishAudit(h.grant.lease, result);
      for (const auto& [job, tiles] : verdict.reopened) {
        for (const uint32_t tile : tiles) ASSERT_EQ(commits[job].erase(tile), 1u);
      }
    } else if (scheduler.FinishCommit(h.grant.lease, durable, result) && durable) {
      ASSERT_EQ(++commits[h.grant.job][h.grant.tile], 1) << "committed twice";
    }
  };
  std::map<WorkerId, uint64_t> connections;
  for (int step = 0; step < 4000; ++step) {
    switch (random() % 12) {
      case 0:
        if (workers.size() < 8) add_worker();
        break;
      case 1:
        if (totals.size() < 5) add_job();
        break;
      case 2:
        clock.Advance(milliseconds(random() % 4000));
        if (!totals.empty()) {
          const JobId id = std::next(totals.begin(), random() % totals.size())->first;
          scheduler.SetPaused(id, random() % 3 == 0);
          scheduler.SetPriority(id, static_cast<int32_t>(random() % 3));
          if (random() % 4 == 0) scheduler.ForgetFailures(id);
        }
        break;
      case 3: {
        const SchedulerNews news = scheduler.Tick();
        ASSERT_TRUE(news.failed.empty());
        for (const WorkerId& w : news.forgotten) std::erase(workers, w);
        if (!workers.empty()) {
          const WorkerId w = workers[random() % workers.size()];
          if (random() % 2 == 0) {
            connections[w] = scheduler.Connected(w);
          } else {
            scheduler.Disconnected(w, connections[w]);
          }
        }
        break;
      }
      case 4:
        if (!workers.empty() && random() % 8 == 0) {
          const size_t i = random() % workers.size();
          scheduler.RemoveWorker(workers[i]);
          workers.erase(workers.begin() + static_cast<ptrdiff_t>(i));
        }
        break;
      case 5:
      case 6:
        if (!workers.empty()) {
          if (const auto grant = scheduler.Lease(workers[random() % workers.size()])) {
            held.push_back({*grant});
          }
        }
        break;
      case 7:
        if (!totals.empty() && random() % 40 == 0) {
          const JobId id = std::next(totals.begin(), random() % totals.size())->first;
          scheduler.RemoveJob(id);
          totals.erase(id);
          commits.erase(id);
        }
        break;
      default:
        if (!held.empty()) {
          const size_t i = random() % held.size();
          Held& h = held[i];
          const auto drop = [&] { held.erase(held.begin() + static_cast<ptrdiff_t>(i)); };
          if (h.committing) {
            finish(h, random() % 5 != 0);
            drop();
            break;
          }
          switch (random() % 6) {
            case 0:
              scheduler.ReportFailure(h.grant.worker, h.grant.lease, random() % 2 == 0,
                                      absl::InternalError("boom"));
              if (random() % 2 == 0) drop();  // else it will come again, stale
              break;
            case 1:
            case 2:
              scheduler.Renew(h.grant.worker, h.grant.lease,
                              {.counter = ++counter,
                               .fraction = 0.5f,
                               .rendering = random() % 2 == 0,
                               .cpu = milliseconds(random() % 100)});
              break;
            default:
              h.committing =
                  scheduler.BeginCommit(h.grant.worker, h.grant.lease, h.grant.attempt).ok();
              if (!h.committing && random() % 2 == 0) drop();
          }
        }
    }
    ASSERT_NO_FATAL_FAILURE(check()) << "step " << step;
  }
  // Everything comes to an end: what hangs is finished, then good workers do the rest.
  for (Held& h : held) {
    if (h.committing) finish(h, true);
  }
  clock.Advance(std::chrono::hours(1));
  scheduler.Tick();
  for (const auto& [id, total] : totals) {
    scheduler.SetPaused(id, false);
    scheduler.ForgetFailures(id);
  }
  scheduler.AddWorker({"good-usual"}, {.fingerprint = DigestOf("usual")});
  scheduler.AddWorker({"good-odd"}, {.fingerprint = DigestOf("odd")});
  scheduler.AddWorker({"best-usual"}, {.fingerprint = DigestOf("usual")});
  scheduler.AddWorker({"best-odd"}, {.fingerprint = DigestOf("odd")});
  // An audit may open tiles of somebody who has had its turn: until nobody finds anything.
  for (bool found = true; found;) {
    found = false;
    for (const char* name : {"good-usual", "good-odd", "best-usual", "best-odd"}) {
      const WorkerId w{name};
      while (const auto grant = scheduler.Lease(w)) {
        found = true;
        ASSERT_TRUE(scheduler.BeginCommit(w, grant->lease, grant->attempt).ok());
        Held h{*grant};
        ASSERT_NO_FATAL_FAILURE(finish(h, true));
        ASSERT_NO_FATAL_FAILURE(check());
      }
    }
  }
  for (const auto& [id, total] : totals) EXPECT_EQ(scheduler.Counts(id).committed, total);
  EXPECT_EQ(scheduler.ActiveLeases(), 0u);
}

INSTANTIATE_TEST_SUITE_P(Seeds, RandomEvents, ::testing::Range(1u, 33u));

}  // namespace
}  // namespace farpoint

#include "server/explanation.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

namespace farpoint {
namespace {

using ::testing::AllOf;
using ::testing::Contains;
using ::testing::HasSubstr;
using ::testing::Not;

Digest DigestOf(std::string_view text) { return Sha256().Update(text).Finish(); }

ExplanationFacts Facts() {
  ExplanationFacts facts;
  facts.status.id = {"0123abcd"};
  facts.status.state = JobState::kRendering;
  facts.status.tiles = {.queued = 5, .leased = 2, .committed = 3, .total = 10};
  facts.status.priority = 4;
  facts.status.frames = {.total = 1, .baked = 1};
  facts.frame_tiles = 10;
  WorkerStatus worker;
  worker.name = "w";
  worker.fingerprint = DigestOf("f");
  facts.workers = {worker};
  return facts;
}

TEST(Explanation, BeginsWithTheState) {
  const Explanation still = Explain(Facts());
  EXPECT_EQ(still.lines.front(),
            "rendering: 3 of 10 tiles committed, 2 in work, 5 queued; priority 4");
  ExplanationFacts facts = Facts();
  facts.spec.frames = {1, 2};
  facts.status.frames = {.total = 2, .baked = 2, .done = 1};
  EXPECT_THAT(Explain(facts).lines.front(), HasSubstr("1 of 2 frames done, 2 baked"));
}

TEST(Explanation, OfAnEndedJobSaysHowToGoOn) {
  ExplanationFacts facts = Facts();
  facts.status.state = JobState::kFailed;
  facts.status.error = absl::AbortedError("tile 3 failed 3 times");
  facts.workers.clear();
  const Explanation explanation = Explain(facts);
  EXPECT_THAT(explanation.lines, Contains("it failed: tile 3 failed 3 times"));
  EXPECT_THAT(explanation.lines, Contains(HasSubstr("farpoint requeue 0123abcd")));
  // It wants no worker any more.
  EXPECT_THAT(explanation.lines, Not(Contains(HasSubstr("no worker"))));
  facts.status.state = JobState::kDone;
  facts.status.error = absl::OkStatus();
  EXPECT_THAT(Explain(facts).lines, Not(Contains(HasSubstr("requeue"))));
}

TEST(Explanation, NamesWhatAJobWaitsFor) {
  ExplanationFacts facts = Facts();
  facts.paused = true;
  facts.draining = true;
  JobStatus other;
  other.id = {"11111111"};
  other.state = JobState::kBaking;
  other.tiles = {.queued = 7, .total = 7};
  facts.waits_for = {{.id = other.id, .status = other}, {.id = {"22222222"}}};
  const Explanation explanation = Explain(facts);
  EXPECT_THAT(explanation.lines, Contains(HasSubstr("farpoint resume 0123abcd")));
  EXPECT_THAT(explanation.lines, Contains(HasSubstr("shutting down")));
  EXPECT_THAT(explanation.lines,
              Contains("waits for job 11111111 (baking, 0 of 7 tiles, priority 0)"));
  EXPECT_THAT(explanation.lines, Contains(AllOf(HasSubstr("22222222"), HasSubstr("not known"))));
}

TEST(Explanation, CountsNoWorkerThatIsGone) {
  ExplanationFacts facts = Facts();
  facts.workers[0].gone = true;
  EXPECT_THAT(Explain(facts).lines,
              Contains(AllOf(HasSubstr("1 worker is gone"), HasSubstr("start farpoint-worker"))));
  facts.workers.push_back(Facts().workers[0]);
  EXPECT_THAT(Explain(facts).lines, Not(Contains(HasSubstr("gone"))));
}

TEST(Explanation, TellsThePlaceInTheBakeQueue) {
  ExplanationFacts facts = Facts();
  facts.bake_place = 2;
  facts.baked_first = JobId{"11111111"};
  EXPECT_THAT(Explain(facts).lines, Contains("2nd in the bake queue, job 11111111 goes before"));
  facts.bake_place = 11;
  facts.baked_first = facts.status.id;
  EXPECT_THAT(Explain(facts).lines, Contains("11th in the bake queue"));
  facts.bake_place = 0;
  facts.spec.frames = {7, 8};
  facts.baking = ExplanationFacts::BakeInWork{.frame_index = 1, .seconds = 2.5};
  facts.enough_baked = true;
  const Explanation explanation = Explain(facts);
  EXPECT_THAT(explanation.lines, Contains("frame 8 is being baked, for 2.5 s"));
  EXPECT_THAT(explanation.lines, Contains(HasSubstr("when fewer tiles are queued")));
}

TEST(Explanation, SaysWhyNoWorkerTakesIt) {
  ExplanationFacts facts = Facts();
  EXPECT_THAT(Explain(facts).lines, Not(Contains(HasSubstr("worker"))));
  facts.report.fingerprint = DigestOf("other");
  EXPECT_THAT(Explain(facts).lines,
              Contains(AllOf(HasSubstr("none of 1 worker"), HasSubstr("fingerprint"))));
  facts.report.fingerprint = DigestOf("f");
  facts.workers[0].set_aside = true;
  EXPECT_THAT(Explain(facts).lines, Contains(HasSubstr("1 worker is set aside")));
  facts.workers.push_back(facts.workers[0]);
  facts.workers[1].fingerprint = DigestOf("other");
  EXPECT_THAT(Explain(facts).lines, Contains(HasSubstr("the others have another fingerprint")));
  facts.workers[0].set_aside = false;
  EXPECT_THAT(Explain(facts).lines, Contains(HasSubstr("1 worker has another fingerprint")));
  facts.workers.clear();
  EXPECT_THAT(Explain(facts).lines, Contains(HasSubstr("no worker is connected")));
}

TEST(Explanation, NamesTheJobThatIsServedFirst) {
  ExplanationFacts facts = Facts();
  facts.served_first = facts.status;
  facts.served_first->id = {"11111111"};
  facts.served_first->priority = 9;
  facts.served_first_tiles = 40;
  EXPECT_THAT(Explain(facts).lines,
              Contains("job 11111111 (rendering, 3 of 10 tiles, priority 9) is served first: 40 "
                       "tiles of it wait"));
}

TEST(Explanation, ShowsSlowAndTroubledTiles) {
  ExplanationFacts facts = Facts();
  facts.spec.frames = {5, 6};
  facts.status.tiles.total = 20;
  facts.report.in_work = {{.grant = {.tile = 12, .attempt = 2, .speculative = true},
                           .worker_name = "w1",
                           .seconds = 12,
                           .fraction = 0.4f}};
  facts.report.troubled = {{.tile = 7, .failures = 2, .workers = 1, .cause = "out of memory"}};
  facts.slowest = {{.tile = 1, .seconds = 99.5}};
  StoredEvent event;
  event.unix_ms = 1'700'000'000'123;
  event.body =
      LogLine{.level = LogLevel::kWarning, .text = "lease lost", .tile = 13, .worker = "w2"};
  facts.problems = {event};
  const Explanation explanation = Explain(facts);
  EXPECT_THAT(explanation.lines,
              Contains("tile 12 of frame 6 is in work for 12 s, 40 %, on worker 'w1', attempt 2, a "
                       "copy of a slow tile"));
  EXPECT_THAT(explanation.lines,
              Contains("tile 7 of frame 5 failed 2 times on 1 worker, lately: out of memory"));
  EXPECT_THAT(explanation.lines,
              Contains("tile 1 of frame 5 took 99.5 s of thread time, one of the slowest"));
  EXPECT_THAT(explanation.lines,
              Contains("2023-11-14 22:13:20 UTC: tile 13 of frame 6: lease lost (worker 'w2')"));
}

TEST(Explanation, TellsWhatWasComputedReusedAndSkipped) {
  ExplanationFacts facts = Facts();
  facts.status.frames = {.total = 3, .baked = 3};
  facts.bake_stats.wall_seconds[static_cast<size_t>(Stage::kTree)] = 2;
  facts.bake_stats.seconds[static_cast<size_t>(Stage::kShade)] = 0.25;
  facts.bake_stats.skipped = {{"bake", 2}, {"textures", 4}, {"nothing", 0}};
  facts.tile_stats.skipped = {{"nodes_hidden", 6}, {"of_a_newer_worker", 7}};
  const Explanation explanation = Explain(facts);
  EXPECT_THAT(explanation.lines,
              Contains("bake: 2 of 3 frames taken from an earlier bake of the same scene"));
  EXPECT_THAT(explanation.lines, Contains("bake: computed shade 0.25 s, tree 2 s"));
  EXPECT_THAT(explanation.lines, Contains("bake: skipped textures 4: no surface shows them, or "
                                          "another is the same"));
  EXPECT_THAT(explanation.lines, Contains("tiles: skipped nodes_hidden 6: behind full pixels"));
  EXPECT_THAT(explanation.lines, Contains("tiles: skipped of_a_newer_worker 7"));
  EXPECT_THAT(explanation.lines, Not(Contains(HasSubstr("nothing 0"))));
}

}  // namespace
}  // namespace farpoint

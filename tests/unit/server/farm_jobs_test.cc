// Several jobs of one coordinator: frames, pauses, priorities, requeues, chains, logs.
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <algorithm>
#include <filesystem>
#include <map>
#include <random>
#include <set>

#include "tests/unit/server/coordinator_fixture.h"
#include "tests/unit/server/temp_folder.h"

namespace farpoint {
namespace {

using ::testing::Contains;
using ::testing::ElementsAre;
using ::testing::HasSubstr;
using ::testing::IsEmpty;
using ::testing::Not;

class FarmJobs : public CoordinatorTest {
 protected:
  JobSpec Animation(std::vector<int32_t> frames, const std::string& content = "scene") {
    JobSpec spec = Spec(content);
    spec.frames = std::move(frames);
    spec.fps = 10;
    return spec;
  }
  // Leases and commits one tile.
  TileWork RenderOne(const WorkerId& worker) {
    const TileWork work = LeaseOrDie(worker);
    const auto answer = coordinator_->Return(worker, Render(work));
    EXPECT_TRUE(answer.ok() && answer->accepted) << answer.status();
    return work;
  }
  // Until nothing more can be leased.
  void RenderAll() {
    const WorkerId worker = RegisterOrDie();
    for (;;) {
      const auto work = coordinator_->Lease(worker, milliseconds(100));
      ASSERT_TRUE(work.ok()) << work.status();
      if (!work->has_value()) return;
      ASSERT_TRUE(coordinator_->Return(worker, Render(**work))->accepted);
    }
  }
  bool NothingToLease() {
    const auto work = coordinator_->Lease(RegisterOrDie(), milliseconds(50));
    EXPECT_TRUE(work.ok()) << work.status();
    return work.ok() && !work->has_value();
  }
  JobStatus StatusOf(const JobId& job) { return *coordinator_->Status(job); }
  JobState StateOf(const JobId& job) { return StatusOf(job).state; }
  std::string ErrorOf(const JobId& job) { return std::string(StatusOf(job).error.message()); }
  std::vector<std::string> Explained(const JobId& job) {
    const auto explanation = coordinator_->Explain(job);
    EXPECT_TRUE(explanation.ok()) << explanation.status();
    return explanation.ok() ? explanation->lines : std::vector<std::string>();
  }
  void WaitForBaked(const JobId& job, uint32_t frames) {
    for (int i = 0; i < 5000 && StatusOf(job).frames.baked < frames; ++i) {
      std::this_thread::sleep_for(milliseconds(1));
    }
    EXPECT_GE(StatusOf(job).frames.baked, frames);
  }
  std::vector<JobEvent> AllEvents(const JobId& job) {
    std::vector<JobEvent> all;
    for (;;) {
      const auto events =
          coordinator_->NextEvents(job, all.empty() ? 0 : all.back().sequence, milliseconds(0));
      EXPECT_TRUE(events.ok());
      if (events->empty() || events->front().sequence == 0) return all;
      all.insert(all.end(), events->begin(), events->end());
    }
  }
  std::vector<LogLine> LogOf(const JobId& job) {
    std::vector<LogLine> lines;
    for (const JobEvent& event : AllEvents(job)) {
      if (const auto* line = std::get_if<LogLine>(&event.body)) lines.push_back(*line);
    }
    return lines;
  }
};

// --- Frames ----------------------------------------------------------------------------------

TEST_F(FarmJobs, FramesAreRenderedWhileLaterOnesAreBaked) {
  baker_->animated = true;
  baker_->hold_from_s = 0.15;  // frame 2 and later
  Open();
  const JobId job = SubmitOrDie(Animation({1, 2, 0}));
  const WorkerId worker = RegisterOrDie();
  const TileWork first = RenderOne(worker);
  EXPECT_EQ(first.tile, 0u);
  EXPECT_EQ(first.frame_index, 0u);
  EXPECT_EQ(first.frame.camera.eye.x, 0.1);
  EXPECT_EQ(StatusOf(job).state, JobState::kRendering);
  RenderOne(worker);
  EXPECT_EQ(StatusOf(job).frames, (FrameCounts{.total = 3, .baked = 1, .done = 1}));
  EXPECT_EQ(StatusOf(job).tiles, (TileCounts{.queued = 4, .committed = 2, .total = 6}));
  EXPECT_TRUE(NothingToLease());
  EXPECT_THAT(Explained(job), Contains(HasSubstr("frame 2 is being baked")));

  baker_->hold_from_s = 1e9;
  std::vector<TileWork> rest;
  for (int i = 0; i < 4; ++i) rest.push_back(LeaseOrDie(RegisterOrDie()));
  // The frames in their order, the tiles of each in any.
  EXPECT_EQ(rest[0].frame_index, 1u);
  EXPECT_EQ(rest[1].frame_index, 1u);
  std::sort(rest.begin(), rest.end(),
            [](const TileWork& a, const TileWork& b) { return a.tile < b.tile; });
  EXPECT_EQ(rest[0].tile, 2u);
  EXPECT_EQ(rest[0].rect, first.rect);
  EXPECT_EQ(rest[0].frame.camera.eye.x, 0.2);
  EXPECT_EQ(rest[3].tile, 5u);
  EXPECT_EQ(rest[3].frame_index, 2u);
  EXPECT_EQ(rest[3].frame.camera.eye.x, 0.0);
  EXPECT_NE(rest[0].blobs, rest[3].blobs);  // two frames in flight together
  EXPECT_THAT(baker_->times, ElementsAre(0.1, 0.2, 0.0));
}

TEST_F(FarmJobs, ADoneAnimationTellsFramesAndTiles) {
  baker_->animated = true;
  Open();
  const JobId job = SubmitOrDie(Animation({7, 3}));
  const auto before = coordinator_->FetchInfo(job);
  ASSERT_TRUE(before.ok());
  EXPECT_EQ(before->frames.size(), 2u);
  WaitForBaked(job, 2);
  RenderAll();
  EXPECT_EQ(WaitForEnd(job), JobState::kDone);
  const auto info = coordinator_->FetchInfo(job);
  ASSERT_TRUE(info.ok());
  ASSERT_EQ(info->frames.size(), 2u);
  EXPECT_EQ(info->frames[0].number, 7);
  EXPECT_EQ(info->frames[1].number, 3);
  EXPECT_TRUE(info->frames[1].baked);
  EXPECT_NE(info->frames[0].blobs, info->frames[1].blobs);
  EXPECT_NE(info->frames[0].camera.world_to_camera, info->frames[1].camera.world_to_camera);
  ASSERT_EQ(info->tiles.size(), 4u);
  EXPECT_EQ(info->tiles[1].frame, 0u);
  EXPECT_EQ(info->tiles[2].frame, 1u);
  EXPECT_EQ(info->tiles[2].rect, info->tiles[0].rect);
  EXPECT_EQ(info->status.frames, (FrameCounts{.total = 2, .baked = 2, .done = 2}));
  EXPECT_EQ(info->notes.size(), 2u);  // each once
  EXPECT_EQ(info->stats.counts.at("triangles"), 24u);
  EXPECT_TRUE(coordinator_->FetchTile(job, 3).ok());
}

TEST_F(FarmJobs, FramesOfASceneThatStandsStillShareOneBake) {
  Open();
  const JobId job = SubmitOrDie(Animation({0, 1, 2}));
  WaitForBaked(job, 3);
  EXPECT_EQ(baker_->bakes.load(), 1);
  const auto info = coordinator_->FetchInfo(job);
  EXPECT_EQ(info->frames[0].blobs, info->frames[2].blobs);
  EXPECT_EQ(info->stats.skipped.at("bake"), 2u);
  // And with a still of the same scene.
  WaitForBaked(SubmitOrDie(Spec()), 1);
  EXPECT_EQ(baker_->bakes.load(), 1);
  EXPECT_THAT(Explained(job), Contains(HasSubstr("2 of 3 frames taken from an earlier bake")));
}

TEST_F(FarmJobs, AnAnimatedScenesFramesAreFoundAgainByTheirTime) {
  baker_->animated = true;
  Open();
  WaitForBaked(SubmitOrDie(Animation({0, 1})), 2);
  EXPECT_EQ(baker_->bakes.load(), 2);
  const JobId again = SubmitOrDie(Animation({1, 2}));
  WaitForBaked(again, 2);
  EXPECT_EQ(baker_->bakes.load(), 3);
  WaitForBaked(SubmitOrDie(Spec()), 1);  // at rest
  EXPECT_EQ(baker_->bakes.load(), 4);
}

TEST_F(FarmJobs, AFailingBakeNamesTheFrame) {
  baker_->animated = true;
  baker_->error = absl::InvalidArgumentError("a.gltf: bad keyframe");
  baker_->error_from_s = 0.25;
  Open();
  const JobId job = SubmitOrDie(Animation({1, 2, 3}));
  EXPECT_EQ(WaitForEnd(job), JobState::kFailed);
  EXPECT_EQ(ErrorOf(job), "frame 3: a.gltf: bad keyframe");
  EXPECT_TRUE(absl::IsInvalidArgument(StatusOf(job).error));
}

TEST_F(FarmJobs, AFailingTileNamesTheFrame) {
  Open();
  const JobId job = SubmitOrDie(Animation({4, 8}));
  WaitForBaked(job, 2);
  const WorkerId worker = RegisterOrDie();
  for (int i = 0; i < 2; ++i) RenderOne(worker);
  const TileWork work = LeaseOrDie(worker);
  ASSERT_TRUE(
      coordinator_->ReportFailure(worker, work.lease, false, absl::InvalidArgumentError("NaN"))
          .ok());
  EXPECT_EQ(WaitForEnd(job), JobState::kFailed);
  EXPECT_EQ(ErrorOf(job), "frame 8: tile 2: NaN");
  EXPECT_EQ(StatusOf(job).tiles, (TileCounts{.committed = 2, .failed = 2, .total = 4}));
}

TEST_F(FarmJobs, BakesGoNoFurtherAheadThanTheTilesNeed) {
  Open();
  std::vector<int32_t> frames(40);
  for (int32_t i = 0; i < 40; ++i) frames[i] = i;
  const JobId job = SubmitOrDie(Animation(frames));
  WaitForBaked(job, 8);
  std::this_thread::sleep_for(milliseconds(100));
  EXPECT_EQ(StatusOf(job).frames.baked, 8u);
  EXPECT_THAT(Explained(job), Contains(HasSubstr("when fewer tiles are queued")));
  RenderAll();
  EXPECT_EQ(WaitForEnd(job), JobState::kDone);
}

TEST_F(FarmJobs, InMemoryTheBlobsOfRenderedFramesGo) {
  baker_->animated = true;
  Open();
  const JobId job = SubmitOrDie(Animation({0, 1}));
  WaitForBaked(job, 2);
  const WorkerId worker = RegisterOrDie();
  const SceneBlobs first = RenderOne(worker).blobs;
  EXPECT_TRUE(coordinator_->GetBlob(first.prepared_scene).ok());
  RenderOne(worker);
  EXPECT_TRUE(absl::IsNotFound(coordinator_->GetBlob(first.prepared_scene).status()));
  // What the next frame needs, too, stays; and so does the scene's file.
  EXPECT_TRUE(coordinator_->GetBlob(first.tree_topology).ok());
  EXPECT_THAT(*coordinator_->FindMissing(std::vector<Digest>{Blob::FromString("scene").Hash()}),
              IsEmpty());
  RenderAll();
  EXPECT_EQ(WaitForEnd(job), JobState::kDone);
}

TEST_F(FarmJobs, AnotherLifeFindsFramesAndTiles) {
  TempFolder folder;
  baker_->animated = true;
  baker_->hold_from_s = 0.25;
  Open(folder.path());
  const JobId job = SubmitOrDie(Animation({1, 2, 3}));
  WorkerId worker = RegisterOrDie();
  const TileWork done = RenderOne(worker);
  RenderOne(worker);
  WaitForBaked(job, 2);
  const TileWork lost = LeaseOrDie(worker);
  coordinator_.reset();
  baker_->hold_from_s = 1e9;
  // Of a frame that is done the blobs are not needed any more, of the others they are made again.
  std::filesystem::remove(folder / ("blobs/" + done.blobs.prepared_scene.Hex()));
  std::filesystem::remove(folder / ("blobs/" + lost.blobs.prepared_scene.Hex()));
  const int bakes = baker_->bakes.load();
  Open(folder.path());
  WaitForBaked(job, 3);
  EXPECT_EQ(baker_->bakes.load(), bakes + 2);  // frames 2 and 3
  EXPECT_EQ(StatusOf(job).frames, (FrameCounts{.total = 3, .baked = 3, .done = 1}));
  EXPECT_EQ(StatusOf(job).tiles, (TileCounts{.queued = 4, .committed = 2, .total = 6}));
  worker = RegisterOrDie();
  const TileWork again = RenderOne(worker);
  EXPECT_EQ(again.tile, lost.tile);
  EXPECT_EQ(again.blobs, lost.blobs);
  EXPECT_EQ(again.frame.camera.eye, lost.frame.camera.eye);
  RenderAll();
  EXPECT_EQ(WaitForEnd(job), JobState::kDone);
}

TEST_F(FarmJobs, TooManyTilesOfAllFramesAreRefused) {
  Open();
  std::vector<int32_t> frames(100'000);
  for (int32_t i = 0; i < 100'000; ++i) frames[i] = i;
  JobSpec spec = Animation(frames);
  spec.film = {.width = 128, .height = 32, .crop = {0, 0, 128, 32}};
  const auto refused = coordinator_->Submit(spec, "");
  EXPECT_TRUE(absl::IsInvalidArgument(refused.status()));
  EXPECT_THAT(std::string(refused.status().message()), HasSubstr("100000 frames"));
}

// --- The same scene again --------------------------------------------------------------------

TEST_F(FarmJobs, ASecondJobOfASceneFindsAllBlobs) {
  Open();
  const JobSpec spec = Spec();
  const JobId first = SubmitOrDie(spec);
  const WorkerId worker = RegisterOrDie();
  const SceneBlobs blobs = LeaseOrDie(worker).blobs;
  std::vector<Digest> asked;
  for (const auto& [uri, digest] : spec.asset_files) asked.push_back(digest);
  EXPECT_THAT(*coordinator_->FindMissing(asked), IsEmpty());  // a client sends nothing
  ASSERT_TRUE(coordinator_->Cancel(first).ok());
  const JobId second = SubmitOrDie(spec);
  const TileWork work = LeaseOrDie(worker);
  EXPECT_EQ(work.job, second);
  EXPECT_EQ(work.blobs, blobs);  // a worker fetches nothing
  EXPECT_EQ(baker_->bakes.load(), 1);
}

// --- Pauses and priorities -------------------------------------------------------------------

TEST_F(FarmJobs, APausedJobFinishesWhatIsInWorkAndNoMore) {
  TempFolder folder;
  Open(folder.path());
  const JobId job = SubmitOrDie(Spec());
  const WorkerId worker = RegisterOrDie();
  const TileWork in_work = LeaseOrDie(worker);
  ASSERT_TRUE(coordinator_->Pause(job).ok());
  ASSERT_TRUE(coordinator_->Pause(job).ok());
  EXPECT_EQ(StateOf(job), JobState::kPaused);
  EXPECT_THAT(Explained(job), Contains(HasSubstr("farpoint resume " + job.value)));
  EXPECT_FALSE(coordinator_->Renew(worker, in_work.lease, {1, 0.5f})->drop);
  EXPECT_TRUE(coordinator_->Return(worker, Render(in_work))->accepted);
  EXPECT_TRUE(NothingToLease());

  Open(folder.path());
  EXPECT_EQ(StateOf(job), JobState::kPaused);
  EXPECT_EQ(StatusOf(job).tiles, (TileCounts{.queued = 1, .committed = 1, .total = 2}));
  EXPECT_TRUE(NothingToLease());
  ASSERT_TRUE(coordinator_->Resume(job).ok());
  EXPECT_EQ(StateOf(job), JobState::kRendering);
  RenderAll();
  EXPECT_EQ(WaitForEnd(job), JobState::kDone);
  EXPECT_TRUE(coordinator_->Pause(job).ok());
  EXPECT_EQ(StateOf(job), JobState::kDone);
}

TEST_F(FarmJobs, APausedJobStartsNoBake) {
  TempFolder folder;
  Open(folder.path());
  JobSpec spec = Spec();
  spec.start_paused = true;
  const JobId job = SubmitOrDie(spec);
  EXPECT_EQ(StateOf(job), JobState::kPaused);
  EXPECT_TRUE(NothingToLease());
  Open(folder.path());
  EXPECT_TRUE(NothingToLease());
  EXPECT_EQ(StateOf(job), JobState::kPaused);
  EXPECT_EQ(baker_->bakes.load(), 0);
  ASSERT_TRUE(coordinator_->Resume(job).ok());
  WaitForBaked(job, 1);
  // Paused between two frames of an animation.
  baker_->animated = true;
  baker_->hold_from_s = 0;
  const JobId frames = SubmitOrDie(Animation({0, 1}, "another scene"));
  const int bakes = baker_->bakes.load();
  while (baker_->bakes.load() == bakes) std::this_thread::sleep_for(milliseconds(1));
  ASSERT_TRUE(coordinator_->Pause(frames).ok());
  baker_->hold_from_s = 1e9;
  WaitForBaked(frames, 1);  // the bake in work counts
  std::this_thread::sleep_for(milliseconds(50));
  EXPECT_EQ(baker_->bakes.load(), bakes + 1);
  EXPECT_EQ(StateOf(frames), JobState::kPaused);
}

TEST_F(FarmJobs, HigherPriorityIsBakedAndLeasedFirst) {
  TempFolder folder;
  baker_->hold = true;
  Open(folder.path());
  JobSpec spec = Spec("a");
  const JobId a = SubmitOrDie(spec);
  while (baker_->bakes.load() == 0) std::this_thread::sleep_for(milliseconds(1));
  const JobId b = SubmitOrDie(Spec("b"));
  spec = Spec("c");
  spec.priority = 3;
  const JobId c = SubmitOrDie(spec);
  EXPECT_THAT(Explained(a), Contains(HasSubstr("the scene is being baked")));
  EXPECT_THAT(Explained(c),
              Contains(HasSubstr("1st in the bake queue, job " + a.value + " goes before")));
  EXPECT_THAT(Explained(b),
              Contains(HasSubstr("2nd in the bake queue, job " + c.value + " goes before")));
  baker_->hold = false;
  for (const JobId& job : {a, b, c}) WaitForBaked(job, 1);
  const WorkerId worker = RegisterOrDie();
  EXPECT_THAT(Explained(a), Contains(HasSubstr("job " + c.value +
                                               " (rendering, 0 of 2 tiles, "
                                               "priority 3) is served first")));
  EXPECT_EQ(LeaseOrDie(worker).job, c);
  ASSERT_TRUE(coordinator_->SetPriority(b, 5).ok());
  EXPECT_EQ(LeaseOrDie(worker).job, b);
  EXPECT_TRUE(absl::IsInvalidArgument(coordinator_->SetPriority(b, 1001)));
  EXPECT_THAT(LogOf(b), Contains(::testing::Field(&LogLine::text, "the priority is 5 now")));

  Open(folder.path());
  EXPECT_EQ(StatusOf(b).priority, 5);
  EXPECT_EQ(LeaseOrDie(RegisterOrDie()).job, b);
}

// --- Requeue ---------------------------------------------------------------------------------

TEST_F(FarmJobs, ACancelledJobGoesOnWhereItWas) {
  TempFolder folder;
  Open(folder.path());
  const JobId job = SubmitOrDie(Spec());
  const WorkerId worker = RegisterOrDie();
  const TileWork first = RenderOne(worker);
  const TileWork in_work = LeaseOrDie(worker);
  ASSERT_TRUE(coordinator_->Cancel(job).ok());
  EXPECT_EQ(StatusOf(job).tiles, (TileCounts{.queued = 1, .committed = 1, .total = 2}));
  ASSERT_TRUE(coordinator_->Requeue(job, false).ok());
  ASSERT_TRUE(coordinator_->Requeue(job, false).ok());  // once more is harmless
  EXPECT_EQ(StateOf(job), JobState::kRendering);
  EXPECT_FALSE(coordinator_->Return(worker, Render(in_work))->accepted);

  Open(folder.path());
  EXPECT_EQ(StateOf(job), JobState::kRendering);
  EXPECT_EQ(StatusOf(job).tiles, (TileCounts{.queued = 1, .committed = 1, .total = 2}));
  const TileWork second = RenderOne(RegisterOrDie());
  EXPECT_NE(second.tile, first.tile);
  EXPECT_EQ(StateOf(job), JobState::kDone);
  EXPECT_EQ(std::get<JobState>(AllEvents(job).back().body), JobState::kDone);
  EXPECT_EQ(baker_->bakes.load(), 1);
  EXPECT_TRUE(coordinator_->Requeue(job, false).ok());
  EXPECT_EQ(StateOf(job), JobState::kDone);
}

TEST_F(FarmJobs, AFailedJobStartsWithoutItsFailures) {
  Open();
  const JobId job = SubmitOrDie(Spec("scene", 32, 32));
  for (int life = 0; life < 2; ++life) {
    for (int i = 0; i < 3; ++i) {
      const WorkerId worker = RegisterOrDie();
      const TileWork work = LeaseOrDie(worker);
      EXPECT_EQ(StateOf(job), JobState::kRendering) << "life " << life << " failure " << i;
      ASSERT_TRUE(
          coordinator_->ReportFailure(worker, work.lease, false, absl::InternalError("broken"))
              .ok());
    }
    EXPECT_EQ(StateOf(job), JobState::kFailed);
    EXPECT_THAT(Explained(job), Contains(HasSubstr("broken (worker 'w")));
    ASSERT_TRUE(coordinator_->Requeue(job, false).ok());
    EXPECT_TRUE(StatusOf(job).error.ok());
  }
  EXPECT_EQ(StatusOf(job).reissued, 6u);
  RenderOne(RegisterOrDie());
  EXPECT_EQ(StateOf(job), JobState::kDone);
}

TEST_F(FarmJobs, RequeueWithAllRendersEverythingAgain) {
  TempFolder folder;
  Open(folder.path());
  const JobId job = SubmitOrDie(Spec());
  const WorkerId worker = RegisterOrDie();
  RenderOne(worker);
  const TileWork in_work = LeaseOrDie(worker);
  ASSERT_TRUE(coordinator_->Requeue(job, true).ok());  // while it renders
  EXPECT_EQ(StatusOf(job).tiles, (TileCounts{.queued = 2, .total = 2}));
  EXPECT_TRUE(coordinator_->Renew(worker, in_work.lease, {1, 0})->drop);
  EXPECT_FALSE(coordinator_->Return(worker, Render(in_work))->accepted);
  RenderAll();
  EXPECT_EQ(StateOf(job), JobState::kDone);
  ASSERT_TRUE(coordinator_->Requeue(job, true).ok());  // when it is done
  EXPECT_EQ(StateOf(job), JobState::kRendering);
  EXPECT_EQ(StatusOf(job).tiles, (TileCounts{.queued = 2, .total = 2}));
  Open(folder.path());
  EXPECT_EQ(StatusOf(job).tiles, (TileCounts{.queued = 2, .total = 2}));
  RenderAll();
  EXPECT_EQ(StateOf(job), JobState::kDone);
  EXPECT_TRUE(coordinator_->FetchTile(job, 1).ok());
  EXPECT_EQ(baker_->bakes.load(), 1);
}

TEST_F(FarmJobs, AJobWhoseFilesAreGoneIsNotRequeued) {
  TempFolder folder;
  Open(folder.path());
  const JobSpec spec = Spec();
  const JobId job = SubmitOrDie(spec);
  ASSERT_TRUE(coordinator_->Cancel(job).ok());
  std::filesystem::remove(folder / ("blobs/" + spec.asset_files.at("a.gltf").Hex()));
  const absl::Status refused = coordinator_->Requeue(job, false);
  EXPECT_TRUE(absl::IsFailedPrecondition(refused)) << refused;
  EXPECT_THAT(std::string(refused.message()), HasSubstr("'a.gltf'"));
  EXPECT_EQ(StateOf(job), JobState::kCancelled);
}

TEST_F(FarmJobs, BlobsOfACancelledJobStayUntilItIsPurged) {
  TempFolder folder;
  Open(folder.path());
  const JobSpec spec = Spec();
  const JobId job = SubmitOrDie(spec);
  const SceneBlobs blobs = LeaseOrDie(RegisterOrDie()).blobs;
  ASSERT_TRUE(coordinator_->Cancel(job).ok());
  const Blob stray = Blob::FromString("stray");
  ASSERT_TRUE(coordinator_->PutBlob(stray.Hash(), stray).ok());
  coordinator_.reset();
  const auto age_all = [&] {
    for (const auto& file : std::filesystem::directory_iterator(folder / "blobs")) {
      std::filesystem::last_write_time(
          file.path(), std::filesystem::file_time_type::clock::now() - std::chrono::hours(100));
    }
  };
  age_all();
  Open(folder.path());
  EXPECT_THAT(*coordinator_->FindMissing(std::vector<Digest>{stray.Hash()}),
              ElementsAre(stray.Hash()));
  ASSERT_TRUE(coordinator_->Requeue(job, false).ok());
  EXPECT_EQ(LeaseOrDie(RegisterOrDie()).blobs, blobs);
  EXPECT_EQ(baker_->bakes.load(), 1);

  ASSERT_TRUE(coordinator_->Cancel(job).ok());
  coordinator_.reset();
  age_all();
  retention_ = std::chrono::hours(0);
  std::this_thread::sleep_for(milliseconds(5));
  Open(folder.path());
  EXPECT_TRUE(absl::IsNotFound(coordinator_->Status(job).status()));
  EXPECT_TRUE(absl::IsNotFound(coordinator_->GetBlob(blobs.prepared_scene).status()));
}

// --- Jobs that wait for others ---------------------------------------------------------------

TEST_F(FarmJobs, AJobWaitsUntilTheOthersAreDone) {
  TempFolder folder;
  Open(folder.path());
  const JobId a = SubmitOrDie(Spec("a")), b = SubmitOrDie(Spec("b"));
  JobSpec spec = Spec("c");
  spec.after = {a, b};
  spec.priority = 100;
  const JobId c = SubmitOrDie(spec);
  EXPECT_THAT(StatusOf(c).after, ElementsAre(a, b));
  WaitForBaked(b, 1);
  EXPECT_THAT(Explained(c), Contains(HasSubstr("waits for job " + a.value + " (rendering")));
  RenderOne(RegisterOrDie());
  Open(folder.path());
  EXPECT_EQ(StateOf(c), JobState::kQueued);
  for (int i = 0; i < 3; ++i) EXPECT_NE(RenderOne(RegisterOrDie()).job, c);
  EXPECT_EQ(StateOf(b), JobState::kDone);
  EXPECT_EQ(RenderOne(RegisterOrDie()).job, c);
  // What it waited for counts no more once it has begun.
  ASSERT_TRUE(coordinator_->Requeue(a, true).ok());
  EXPECT_EQ(RenderOne(RegisterOrDie()).job, c);
  EXPECT_EQ(StateOf(c), JobState::kDone);
}

TEST_F(FarmJobs, AChainFallsWithItsFirstLinkAndCanBeTakenUp) {
  Open();
  const JobId a = SubmitOrDie(Spec("a"));
  JobSpec spec = Spec("b");
  spec.after = {a};
  const JobId b = SubmitOrDie(spec);
  spec = Spec("c");
  spec.after = {b};
  spec.start_paused = true;
  const JobId c = SubmitOrDie(spec);
  ASSERT_TRUE(coordinator_->Cancel(a).ok());
  EXPECT_EQ(StateOf(b), JobState::kFailed);
  EXPECT_THAT(ErrorOf(b), HasSubstr("waits for job " + a.value + ", which was cancelled"));
  EXPECT_EQ(StateOf(c), JobState::kFailed);
  EXPECT_THAT(ErrorOf(c), HasSubstr("waits for job " + b.value + ", which failed"));
  // One that is submitted too late falls at once.
  const JobId d = SubmitOrDie(spec);
  EXPECT_EQ(StateOf(d), JobState::kFailed);

  const absl::Status refused = coordinator_->Requeue(c, false);
  EXPECT_TRUE(absl::IsFailedPrecondition(refused)) << refused;
  EXPECT_THAT(std::string(refused.message()), HasSubstr(b.value));
  for (const JobId& job : {a, b, c}) ASSERT_TRUE(coordinator_->Requeue(job, false).ok());
  RenderAll();
  for (const JobId& job : {a, b, c}) EXPECT_EQ(StateOf(job), JobState::kDone);
}

TEST_F(FarmJobs, UnknownJobsCannotBeWaitedFor) {
  Open();
  JobSpec spec = Spec();
  spec.after = {{"01234567"}};
  const auto refused = coordinator_->Submit(spec, "");
  EXPECT_TRUE(absl::IsNotFound(refused.status()));
  EXPECT_THAT(std::string(refused.status().message()), HasSubstr("01234567"));
  EXPECT_THAT(coordinator_->Jobs(), IsEmpty());
}

TEST_F(FarmJobs, AJobThatIsWaitedForIsNotPurged) {
  TempFolder folder;
  Open(folder.path());
  const JobId a = SubmitOrDie(Spec("a"));
  RenderAll();
  ASSERT_EQ(StateOf(a), JobState::kDone);
  JobSpec spec = Spec("b");
  spec.after = {a};
  spec.start_paused = true;
  const JobId b = SubmitOrDie(spec);
  retention_ = std::chrono::hours(0);
  std::this_thread::sleep_for(milliseconds(5));
  Open(folder.path());
  EXPECT_EQ(StateOf(a), JobState::kDone);
  EXPECT_EQ(StateOf(b), JobState::kPaused);
  ASSERT_TRUE(coordinator_->Resume(b).ok());
  RenderAll();
  EXPECT_EQ(StateOf(b), JobState::kDone);
  std::this_thread::sleep_for(milliseconds(5));
  Open(folder.path());
  EXPECT_THAT(coordinator_->Jobs(), IsEmpty());
}

// --- Logs and explanations -------------------------------------------------------------------

TEST_F(FarmJobs, WhatHappensIsLoggedWithTimeTileAndWorker) {
  Open();
  const JobId job = SubmitOrDie(Animation({12}));
  const WorkerId worker = RegisterOrDie();
  TileWork work = LeaseOrDie(worker);
  TileResult result = Render(work);
  result.sha256 = Sha256().Update("another").Finish();
  EXPECT_FALSE(coordinator_->Return(worker, result)->accepted);
  EXPECT_FALSE(coordinator_->Return(worker, result)->accepted);  // its lease has ended
  work = LeaseOrDie(worker);
  ASSERT_TRUE(coordinator_->ReportFailure(worker, work.lease, true, absl::OkStatus()).ok());
  ASSERT_TRUE(coordinator_->Pause(job).ok());

  const std::vector<LogLine> log = LogOf(job);
  ASSERT_EQ(log.size(), 4u);
  EXPECT_THAT(log[0].text, HasSubstr("frame 12: baked in"));
  EXPECT_EQ(log[0].level, LogLevel::kInfo);
  EXPECT_THAT(log[1].text, HasSubstr("frame 12: lease lost: the bytes do not have the hash"));
  EXPECT_EQ(log[1].level, LogLevel::kWarning);
  EXPECT_EQ(log[1].tile, 0u);
  EXPECT_EQ(log[1].attempt, 1u);
  EXPECT_EQ(log[1].worker, "w");
  EXPECT_THAT(log[2].text, HasSubstr("a result was refused: the lease has ended"));
  EXPECT_THAT(log[3].text, HasSubstr("given back"));
  EXPECT_EQ(log[3].worker, "w");
  const std::vector<JobEvent> events = AllEvents(job);
  EXPECT_EQ(std::get<JobState>(events.back().body), JobState::kPaused);
  for (size_t i = 0; i < events.size(); ++i) {
    EXPECT_GT(events[i].unix_ms, 1'600'000'000'000);
    if (i > 0) {
      EXPECT_GE(events[i].unix_ms, events[i - 1].unix_ms);
    }
  }
}

TEST_F(FarmJobs, ExplainsWorkersAndTiles) {
  Open();
  const JobId job = SubmitOrDie(Spec());
  WaitForBaked(job, 1);
  EXPECT_THAT(Explained(job), Contains(HasSubstr("no worker is connected")));
  const WorkerId worker = RegisterOrDie();
  EXPECT_THAT(Explained(job), Not(Contains(HasSubstr("no worker"))));
  RenderOne(worker);
  const TileWork work = LeaseOrDie(worker);
  EXPECT_THAT(Explained(job), Contains(HasSubstr("tile 1 is in work for")));
  EXPECT_THAT(Explained(job), Contains(HasSubstr("tile 0 took")));
  EXPECT_THAT(Explained(job), Contains(HasSubstr("bake: computed tree 2 s")));
  ASSERT_TRUE(
      coordinator_->ReportFailure(worker, work.lease, false, absl::InternalError("no memory"))
          .ok());
  EXPECT_THAT(Explained(job), Contains(HasSubstr("tile 1 failed 1 time on 1 worker, lately: no "
                                                 "memory")));
  ASSERT_TRUE(coordinator_->Leave(worker).ok());
  ASSERT_TRUE(coordinator_
                  ->Register({.version = FARPOINT_VERSION,
                              .fingerprint = Sha256().Update("other").Finish(),
                              .threads = 1,
                              .name = "odd"})
                  .ok());
  EXPECT_THAT(Explained(job), Contains(HasSubstr("none of 1 worker computes as those")));
  EXPECT_TRUE(absl::IsNotFound(coordinator_->Explain({"x"}).status()));
  EXPECT_TRUE(absl::IsNotFound(coordinator_->Pause({"x"})));
  EXPECT_TRUE(absl::IsNotFound(coordinator_->Resume({"x"})));
  EXPECT_TRUE(absl::IsNotFound(coordinator_->SetPriority({"x"}, 1)));
  EXPECT_TRUE(absl::IsNotFound(coordinator_->Requeue({"x"}, true)));
}

// --- Whatever happens ------------------------------------------------------------------------

// Any sequence of what people and workers do: the tiles of each job add up, no tile is committed
// twice unless all were asked for again, and in the end every job can be brought to its image.
class RandomFarm : public FarmJobs, public ::testing::WithParamInterface<uint32_t> {};

TEST_P(RandomFarm, KeepsTheInvariants) {
  std::mt19937 random(GetParam());
  TempFolder folder;
  const bool on_disk = GetParam() % 8 == 0;
  baker_->animated = random() % 2 == 0;
  Open(on_disk ? folder.path() : "");
  std::vector<JobId> jobs;
  std::map<JobId, uint32_t> totals;
  std::map<JobId, std::set<uint32_t>> committed;  // since all were asked for last
  struct Held {
    WorkerId worker;
    TileWork work;
  };
  std::vector<Held> held;  // live or stale: workers do not know
  std::vector<WorkerId> workers;
  const auto any = [&](auto& of) -> auto& { return of[random() % of.size()]; };
  const auto check = [&] {
    for (const JobId& id : jobs) {
      const JobStatus status = StatusOf(id);
      const TileCounts& t = status.tiles;
      ASSERT_EQ(t.total, totals[id]);
      ASSERT_EQ(t.queued + t.leased + t.committed + t.failed, t.total);
      ASSERT_EQ(t.committed, committed[id].size());
      ASSERT_LE(status.frames.done, status.frames.baked);
      ASSERT_EQ(status.state == JobState::kDone, t.committed == t.total);
      if (IsFinal(status.state)) {
        ASSERT_EQ(t.leased, 0u);
      }
      if (status.state == JobState::kCancelled) {
        ASSERT_EQ(t.failed, 0u);
      }
    }
  };
  const auto give = [&](const Held& h) {
    const auto answer = coordinator_->Return(h.worker, Render(h.work));
    if (answer.ok() && answer->accepted) {
      ASSERT_TRUE(committed[h.work.job].insert(h.work.tile).second) << "committed twice";
    }
  };
  for (int step = 0; step < (on_disk ? 150 : 600); ++step) {
    switch (random() % 14) {
      case 0:
        if (jobs.size() < 5) {
          JobSpec spec = random() % 2 == 0 ? Animation({0, 3, 1}, "s" + std::to_string(jobs.size()))
                                           : Spec("s" + std::to_string(jobs.size()));
          if (!jobs.empty() && random() % 3 == 0) spec.after = {any(jobs)};
          spec.start_paused = random() % 4 == 0;
          spec.priority = static_cast<int32_t>(random() % 3);
          jobs.push_back(SubmitOrDie(spec));
          totals[jobs.back()] = 2 * spec.frame_count();
        }
        break;
      case 1:
        if (workers.size() < 4) workers.push_back(RegisterOrDie());
        break;
      case 2:
        if (!jobs.empty()) {
          ASSERT_TRUE(coordinator_->Pause(any(jobs)).ok());
        }
        break;
      case 3:
      case 4:
        if (!jobs.empty()) {
          ASSERT_TRUE(coordinator_->Resume(any(jobs)).ok());
        }
        break;
      case 5:
        if (!jobs.empty() && random() % 4 == 0) {
          ASSERT_TRUE(coordinator_->Cancel(any(jobs)).ok());
        }
        break;
      case 6:
        if (!jobs.empty()) {
          const JobId& id = any(jobs);
          const bool all = random() % 6 == 0;
          // A job whose forerunner has fallen is refused.
          if (coordinator_->Requeue(id, all).ok() && all) committed[id].clear();
        }
        break;
      case 7:
        if (!jobs.empty()) {
          ASSERT_TRUE(
              coordinator_->SetPriority(any(jobs), static_cast<int32_t>(random() % 5)).ok());
        }
        break;
      case 8:
        if (!held.empty()) {
          const Held& h = any(held);
          const bool permanent = random() % 8 == 0;
          (void)coordinator_->ReportFailure(
              h.worker, h.work.lease, random() % 2 == 0,
              permanent ? absl::InvalidArgumentError("wrong") : absl::InternalError("broken"));
        }
        break;
      case 9:
        if (on_disk && random() % 3 == 0) {
          Open(folder.path());
          workers.clear();
        }
        break;
      case 10:
      case 11:
        if (!workers.empty()) {
          const WorkerId& worker = any(workers);
          const auto work = coordinator_->Lease(worker, milliseconds(0));
          if (work.ok() && work->has_value()) held.push_back({worker, **work});
        }
        break;
      default:
        if (!held.empty()) {
          const size_t i = random() % held.size();
          ASSERT_NO_FATAL_FAILURE(give(held[i]));
          if (random() % 3 != 0) held.erase(held.begin() + static_cast<ptrdiff_t>(i));
        }
    }
    ASSERT_NO_FATAL_FAILURE(check()) << "step " << step;
  }
  // Set-aside workers are gone: others finish what can be taken up again, the first jobs first.
  for (const WorkerId& worker : workers) ASSERT_TRUE(coordinator_->Leave(worker).ok());
  for (const JobId& id : jobs) {
    ASSERT_TRUE(coordinator_->Requeue(id, false).ok());
    ASSERT_TRUE(coordinator_->Resume(id).ok());
  }
  const auto all_done = [&] {
    for (const JobId& id : jobs) {
      if (StateOf(id) != JobState::kDone) return false;
    }
    return true;
  };
  const WorkerId worker = RegisterOrDie();
  for (int i = 0; i < 300 && !all_done(); ++i) {
    const auto work = coordinator_->Lease(worker, milliseconds(100));
    ASSERT_TRUE(work.ok());
    if (work->has_value()) {
      ASSERT_NO_FATAL_FAILURE(give({worker, **work}));
    }
    ASSERT_NO_FATAL_FAILURE(check());
  }
  EXPECT_TRUE(all_done());
}

INSTANTIATE_TEST_SUITE_P(Seeds, RandomFarm, ::testing::Range(1u, 25u));

}  // namespace
}  // namespace farpoint

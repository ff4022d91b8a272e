#include "server/coordinator.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <filesystem>
#include <fstream>
#include <thread>

#include "tests/unit/server/coordinator_fixture.h"
#include "tests/unit/server/temp_folder.h"

namespace farpoint {
namespace {

using ::testing::HasSubstr;
using ::testing::IsEmpty;

TEST_F(CoordinatorTest, AJobGoesFromSubmissionToImage) {
  Open();
  const JobId job = SubmitOrDie(Spec());
  const WorkerId worker = RegisterOrDie();
  for (int i = 0; i < 2; ++i) {
    const TileWork work = LeaseOrDie(worker);
    EXPECT_TRUE(coordinator_->GetBlob(work.blobs.prepared_scene).ok());
    EXPECT_TRUE(work.blobs.tree_radiance.empty());
    EXPECT_FALSE(coordinator_->Renew(worker, work.lease, {1, 0.5f})->drop);
    EXPECT_TRUE(coordinator_->Return(worker, Render(work))->accepted);
  }
  EXPECT_EQ(WaitForEnd(job), JobState::kDone);
  const auto info = coordinator_->FetchInfo(job);
  ASSERT_TRUE(info.ok()) << info.status();
  EXPECT_EQ(info->status.tiles, (TileCounts{.committed = 2, .total = 2}));
  EXPECT_EQ(info->stats.counts.at("receivers"), 64u * 32u);
  EXPECT_EQ(info->stats.counts.at("triangles"), 12u);
  EXPECT_EQ(info->notes.size(), 2u);
  ASSERT_EQ(info->frames.size(), 1u);
  EXPECT_NE(info->frames[0].camera.world_to_ndc[0], 0);
  for (uint32_t i = 0; i < 2; ++i) {
    const auto tile = coordinator_->FetchTile(job, i);
    ASSERT_TRUE(tile.ok()) << tile.status();
    EXPECT_EQ(tile->sha256, info->tiles[i].sha256);
    const auto film = DecodeFilm(tile->bytes.bytes());
    ASSERT_TRUE(film.ok());
    EXPECT_EQ(film->rect(), info->tiles[i].rect);
  }
  EXPECT_TRUE(absl::IsInvalidArgument(coordinator_->FetchTile(job, 2).status()));
}

TEST_F(CoordinatorTest, WhatIsWrongWithAJobIsSaidAtSubmission) {
  limits_.max_pixels = 1 << 20;
  Open();
  JobSpec spec = Spec();
  spec.settings.spp = 0;
  EXPECT_TRUE(absl::IsInvalidArgument(coordinator_->Submit(spec, "").status()));
  spec = Spec();
  spec.asset_files["b.png"] = Sha256().Update("never sent").Finish();
  const auto missing = coordinator_->Submit(spec, "");
  EXPECT_TRUE(absl::IsFailedPrecondition(missing.status()));
  EXPECT_THAT(std::string(missing.status().message()), HasSubstr("'b.png'"));
  EXPECT_TRUE(
      absl::IsResourceExhausted(coordinator_->Submit(Spec("scene", 2000, 2000), "").status()));
  limits_ = {};
  Open();
  const auto tiles = coordinator_->Submit(Spec("scene", 32768, 32768), "");
  EXPECT_TRUE(absl::IsInvalidArgument(tiles.status()));
  EXPECT_THAT(std::string(tiles.status().message()), HasSubstr("tile_px"));
  EXPECT_THAT(coordinator_->Jobs(), IsEmpty());
}

TEST_F(CoordinatorTest, ARepeatedSubmissionIsOneJob) {
  Open();
  const JobSpec spec = Spec();
  const JobId first = SubmitOrDie(spec, "token");
  EXPECT_EQ(SubmitOrDie(spec, "token"), first);
  EXPECT_NE(SubmitOrDie(spec, ""), first);
  EXPECT_EQ(coordinator_->Jobs().size(), 2u);
}

TEST_F(CoordinatorTest, AFailedBakeFailsTheJobWithItsMessage) {
  baker_->error = absl::InvalidArgumentError("a.gltf: /meshes/0: no positions");
  Open();
  const JobId job = SubmitOrDie(Spec());
  EXPECT_EQ(WaitForEnd(job), JobState::kFailed);
  EXPECT_EQ(coordinator_->Status(job)->error, baker_->error);
}

TEST_F(CoordinatorTest, LimitsHoldForWhatTheBakeFound) {
  limits_.max_surfels = 999;
  Open();
  const JobId job = SubmitOrDie(Spec());
  EXPECT_EQ(WaitForEnd(job), JobState::kFailed);
  EXPECT_TRUE(absl::IsResourceExhausted(coordinator_->Status(job)->error));
}

TEST_F(CoordinatorTest, TheSameSceneIsBakedOnce) {
  Open();
  JobSpec spec = Spec();
  const JobId first = SubmitOrDie(spec);
  const WorkerId worker = RegisterOrDie();
  const TileWork work = LeaseOrDie(worker);
  spec.camera = LookAt{.eye = {0, 0, 5}, .target = {0, 0, 0}};
  spec.priority = 1;
  const JobId second = SubmitOrDie(spec);
  TileWork other;
  while (other.job != second) other = LeaseOrDie(RegisterOrDie());
  EXPECT_EQ(other.blobs, work.blobs);
  EXPECT_EQ(other.frame.camera.eye, Vec3d(0, 0, 5));
  EXPECT_EQ(baker_->bakes.load(), 1);
  const auto info = coordinator_->FetchInfo(second);
  EXPECT_EQ(info->stats.skipped.at("bake"), 1u);
  EXPECT_EQ(info->stats.seconds[static_cast<size_t>(Stage::kTree)], 0);
  EXPECT_EQ(info->notes, std::vector<std::string>{"another note"});  // it names its own camera
  EXPECT_NE(first, second);
}

TEST_F(CoordinatorTest, AnUnknownCameraFailsTheJob) {
  Open();
  JobSpec spec = Spec();
  spec.camera = CameraName{"nowhere"};
  const JobId job = SubmitOrDie(spec);
  EXPECT_EQ(WaitForEnd(job), JobState::kFailed);
  EXPECT_THAT(std::string(coordinator_->Status(job)->error.message()), HasSubstr("'main'"));
}

TEST_F(CoordinatorTest, DamagedResultsAreRefusedAndTheTileIsRenderedAgain) {
  Open();
  const JobId job = SubmitOrDie(Spec("scene", 32, 32));
  const WorkerId w1 = RegisterOrDie();
  TileWork work = LeaseOrDie(w1);
  TileResult result = Render(work);
  result.sha256 = Sha256().Update("another").Finish();
  EXPECT_FALSE(coordinator_->Return(w1, result)->accepted);

  const WorkerId w2 = RegisterOrDie();
  work = LeaseOrDie(w2);
  result = Render(work);
  result.bytes = Blob::FromVector(EncodeFilm(FakeTile({0, 0, 32, 16}, {Layer::kBeauty})));
  result.sha256 = result.bytes.Hash();
  EXPECT_THAT(coordinator_->Return(w2, result)->reason, HasSubstr("rectangle"));
  EXPECT_EQ(coordinator_->Status(job)->refused_results, 2u);

  work = LeaseOrDie(w1);
  EXPECT_EQ(work.attempt, 3u);
  EXPECT_TRUE(coordinator_->Return(w1, Render(work))->accepted);
  EXPECT_EQ(WaitForEnd(job), JobState::kDone);
}

// Two workers, one of which lies: a third one decides, and the image is right all the same.
TEST_F(CoordinatorTest, AuditsFindWrongPixelsAndOpenThemAgain) {
  audit_fraction_ = 1;
  TempFolder folder;
  Open(folder.path());
  const JobId job = SubmitOrDie(Spec("scene", 64, 32));
  const WorkerId liar = RegisterOrDie("liar");
  const auto wrong = [](const TileWork& work) {
    TileResult result;
    result.lease = work.lease;
    result.attempt = work.attempt;
    Film film = FakeTile(work.rect, work.frame.settings.layers);
    film.Plane(Layer::kBeauty, 0)[0] = 0.125f;
    result.bytes = Blob::FromVector(EncodeFilm(film));
    result.sha256 = result.bytes.Hash();
    return result;
  };
  for (int i = 0; i < 2; ++i) {
    EXPECT_TRUE(coordinator_->Return(liar, wrong(LeaseOrDie(liar)))->accepted);
  }
  // All are committed, and nobody is there who could look: it would be done.
  EXPECT_EQ(WaitForEnd(job), JobState::kDone);

  const JobId second = SubmitOrDie(Spec("scene", 64, 32));
  const WorkerId good = RegisterOrDie("good"), third = RegisterOrDie("third");
  for (int i = 0; i < 2; ++i) {
    EXPECT_TRUE(coordinator_->Return(liar, wrong(LeaseOrDie(liar)))->accepted);
  }
  EXPECT_EQ(coordinator_->Status(second)->state, JobState::kRendering) << "audits are open";
  EXPECT_EQ(coordinator_->Status(second)->tiles, (TileCounts{.committed = 2, .total = 2}));
  const TileWork audit = LeaseOrDie(good);
  EXPECT_EQ(audit.job, second);
  EXPECT_FALSE(audit.careful);
  EXPECT_TRUE(coordinator_->Return(good, Render(audit))->accepted);
  const TileWork decision = LeaseOrDie(third);
  EXPECT_EQ(decision.tile, audit.tile);
  EXPECT_TRUE(coordinator_->Return(third, Render(decision))->accepted);
  EXPECT_EQ(coordinator_->Status(second)->tiles, (TileCounts{.queued = 2, .total = 2}));
  EXPECT_FALSE(coordinator_->FetchTile(second, 0).ok()) << "the wrong bytes are gone";
  // The good one renders them again, the third one looks.
  for (int i = 0; i < 2; ++i) {
    EXPECT_TRUE(coordinator_->Return(good, Render(LeaseOrDie(good)))->accepted);
  }
  for (int i = 0; i < 2; ++i) {
    EXPECT_TRUE(coordinator_->Return(third, Render(LeaseOrDie(third)))->accepted);
  }
  EXPECT_EQ(WaitForEnd(second), JobState::kDone);
  for (uint32_t tile = 0; tile < 2; ++tile) {
    const auto data = coordinator_->FetchTile(second, tile);
    ASSERT_TRUE(data.ok()) << data.status();
    const auto film = DecodeFilm(data->bytes.bytes());
    EXPECT_EQ(ImageHash(*film), ImageHash(FakeTile(film->rect(), {Layer::kBeauty, Layer::kDepth})));
  }
  const auto explained = coordinator_->Explain(second);
  ASSERT_TRUE(explained.ok());
  EXPECT_THAT(explained->lines, Contains(HasSubstr("'liar' returned pixels that two others did")));
  for (const WorkerStatus& worker : coordinator_->Workers()) {
    EXPECT_EQ(worker.set_aside, worker.name == "liar");
  }

  // The job that was done before says what is wrong with it, also after a restart, until it is
  // requeued.
  EXPECT_EQ(coordinator_->Status(second)->suspect_tiles, 0u);
  EXPECT_EQ(coordinator_->Status(job)->state, JobState::kDone);
  EXPECT_EQ(coordinator_->Status(job)->suspect_tiles, 2u);
  EXPECT_THAT(coordinator_->Explain(job)->lines, Contains(HasSubstr("2 tiles are of a worker")));
  const auto back = coordinator_->Register({.version = FARPOINT_VERSION,
                                            .fingerprint = TestFingerprint(),
                                            .threads = 1,
                                            .name = "liar"});
  EXPECT_TRUE(absl::IsFailedPrecondition(back.status())) << back.status();
  Open(folder.path());
  EXPECT_EQ(coordinator_->Status(job)->suspect_tiles, 2u);
  EXPECT_EQ(coordinator_->Status(job)->tiles, (TileCounts{.committed = 2, .total = 2}));
  ASSERT_TRUE(coordinator_->Requeue(job, false).ok());
  EXPECT_EQ(coordinator_->Status(job)->suspect_tiles, 0u);
  EXPECT_EQ(coordinator_->Status(job)->tiles.queued, 2u);
  audit_fraction_ = 0;
  Open(folder.path());
  const WorkerId one = RegisterOrDie("good");
  for (int i = 0; i < 2; ++i) {
    EXPECT_TRUE(coordinator_->Return(one, Render(LeaseOrDie(one)))->accepted);
  }
  while (coordinator_->Status(job)->state != JobState::kDone) {
    std::this_thread::sleep_for(milliseconds(5));
  }
  for (uint32_t tile = 0; tile < 2; ++tile) {
    const auto film = DecodeFilm(coordinator_->FetchTile(job, tile)->bytes.bytes());
    EXPECT_EQ(ImageHash(*film), ImageHash(FakeTile(film->rect(), {Layer::kBeauty, Layer::kDepth})));
  }
  ASSERT_TRUE(coordinator_->Requeue(job, false).ok());
  EXPECT_EQ(coordinator_->Status(job)->state, JobState::kDone) << "nothing is wrong with it now";
}

// Who is right is not known yet when the coordinator dies; the tile must not pass for a good one.
TEST_F(CoordinatorTest, ADisputedTileIsRenderedAgainAfterARestart) {
  audit_fraction_ = 1;
  TempFolder folder;
  Open(folder.path());
  const JobId job = SubmitOrDie(Spec("scene", 64, 32));
  const WorkerId first = RegisterOrDie("first"), second = RegisterOrDie("second");
  const TileWork tile = LeaseOrDie(first);
  EXPECT_TRUE(coordinator_->Return(first, Render(tile))->accepted);
  const TileWork audit = LeaseOrDie(second);
  ASSERT_EQ(audit.tile, tile.tile);
  TileResult other = Render(audit);
  Film film = FakeTile(audit.rect, audit.frame.settings.layers);
  film.Plane(Layer::kBeauty, 0)[0] = 0.125f;
  other.bytes = Blob::FromVector(EncodeFilm(film));
  other.sha256 = other.bytes.Hash();
  EXPECT_TRUE(coordinator_->Return(second, other)->accepted);
  EXPECT_EQ(coordinator_->Status(job)->tiles,
            (TileCounts{.queued = 1, .committed = 1, .total = 2}));
  Open(folder.path());
  EXPECT_EQ(coordinator_->Status(job)->tiles, (TileCounts{.queued = 2, .total = 2}));
  EXPECT_FALSE(coordinator_->FetchTile(job, tile.tile).ok());
}

TEST_F(CoordinatorTest, APoisonousTileIsNamedWhenAllOthersAreDone) {
  Open();
  const JobId job = SubmitOrDie(Spec("scene", 64, 32));
  for (int i = 0; i < 3; ++i) {
    const WorkerId worker = RegisterOrDie();
    const TileWork work = LeaseOrDie(worker);
    EXPECT_EQ(work.tile, 0u);
    EXPECT_EQ(work.careful, i > 0);
    EXPECT_TRUE(coordinator_
                    ->ReportFailure(worker, work.lease, false,
                                    absl::AbortedError("the worker crashed in block 0, 0"))
                    .ok());
  }
  EXPECT_EQ(coordinator_->Status(job)->state, JobState::kRendering);
  EXPECT_EQ(coordinator_->Status(job)->tiles, (TileCounts{.queued = 1, .failed = 1, .total = 2}));
  const WorkerId good = RegisterOrDie();
  EXPECT_TRUE(coordinator_->Return(good, Render(LeaseOrDie(good)))->accepted);
  EXPECT_EQ(WaitForEnd(job), JobState::kFailed);
  const std::string error(coordinator_->Status(job)->error.message());
  EXPECT_THAT(error, HasSubstr("tile 0 (pixels 0 to 31 across, 0 to 31 down)"));
  EXPECT_THAT(error, HasSubstr("3 workers"));
  EXPECT_THAT(error, HasSubstr("crashed in block 0, 0"));
  EXPECT_TRUE(coordinator_->Requeue(job, false).ok());
  const TileWork again = LeaseOrDie(good);
  EXPECT_EQ(again.tile, 0u);
  EXPECT_TRUE(coordinator_->Return(good, Render(again))->accepted);
  EXPECT_EQ(coordinator_->Status(job)->state, JobState::kDone);
}

TEST_F(CoordinatorTest, GarbageThreeTimesFailsTheJob) {
  Open();
  const JobId job = SubmitOrDie(Spec("scene", 32, 32));
  for (int i = 0; i < 3; ++i) {
    const WorkerId worker = RegisterOrDie();
    TileResult result = Render(LeaseOrDie(worker));
    result.bytes = Blob::FromString("garbage");
    result.sha256 = result.bytes.Hash();
    EXPECT_FALSE(coordinator_->Return(worker, result)->accepted);
  }
  EXPECT_EQ(WaitForEnd(job), JobState::kFailed);
  EXPECT_THAT(std::string(coordinator_->Status(job)->error.message()), HasSubstr("tile 0"));
}

TEST_F(CoordinatorTest, CancelEndsBakesAndLeases) {
  baker_->hold = true;
  Open();
  const JobId baking = SubmitOrDie(Spec());
  while (baker_->bakes.load() == 0) std::this_thread::sleep_for(milliseconds(1));
  ASSERT_TRUE(coordinator_->Cancel(baking).ok());
  EXPECT_EQ(WaitForEnd(baking), JobState::kCancelled);
  baker_->hold = false;
  const JobId rendering = SubmitOrDie(Spec());
  const WorkerId worker = RegisterOrDie();
  const TileWork work = LeaseOrDie(worker);
  ASSERT_TRUE(coordinator_->Cancel(rendering).ok());
  EXPECT_TRUE(coordinator_->Renew(worker, work.lease, {1, 0})->drop);
  EXPECT_FALSE(coordinator_->Return(worker, Render(work))->accepted);
  EXPECT_EQ(WaitForEnd(rendering), JobState::kCancelled);
  EXPECT_TRUE(coordinator_->Cancel(rendering).ok());  // once more is harmless
  EXPECT_EQ(coordinator_->Status(rendering)->tiles, (TileCounts{.queued = 2, .total = 2}));
}

TEST_F(CoordinatorTest, ALostWorkersTileIsLeasedAgain) {
  Open();
  const JobId job = SubmitOrDie(Spec("scene", 32, 32));
  const WorkerId lost = RegisterOrDie();
  const TileWork stale = LeaseOrDie(lost);
  const TileWork again = LeaseOrDie(RegisterOrDie());  // waits for the silence to be noticed
  EXPECT_EQ(again.tile, stale.tile);
  EXPECT_EQ(again.attempt, 2u);
  EXPECT_FALSE(coordinator_->Return(lost, Render(stale))->accepted);
  EXPECT_EQ(coordinator_->Status(job)->reissued, 1u);
}

TEST_F(CoordinatorTest, UnknownIdsAreNotFound) {
  Open();
  EXPECT_TRUE(absl::IsNotFound(coordinator_->Status({"x"}).status()));
  EXPECT_TRUE(absl::IsNotFound(coordinator_->Cancel({"x"})));
  EXPECT_TRUE(absl::IsNotFound(coordinator_->FetchInfo({"x"}).status()));
  EXPECT_TRUE(absl::IsNotFound(coordinator_->NextEvents({"x"}, 0, milliseconds(0)).status()));
  EXPECT_TRUE(absl::IsNotFound(coordinator_->Lease({"x"}, milliseconds(0)).status()));
  EXPECT_TRUE(absl::IsNotFound(coordinator_->Renew({"x"}, {"l"}, {}).status()));
  EXPECT_TRUE(absl::IsNotFound(coordinator_->Return({"x"}, {}).status()));
}

TEST_F(CoordinatorTest, AnotherVersionIsRefused) {
  Open();
  const auto welcome = coordinator_->Register(
      {.version = "0.0.1", .fingerprint = TestFingerprint(), .threads = 1, .name = "w"});
  EXPECT_TRUE(absl::IsFailedPrecondition(welcome.status()));
  EXPECT_THAT(std::string(welcome.status().message()), HasSubstr("0.0.1"));
}

TEST_F(CoordinatorTest, DrainingRefusesNewWorkButTakesResults) {
  Open();
  const JobId job = SubmitOrDie(Spec());
  const WorkerId worker = RegisterOrDie();
  const TileWork work = LeaseOrDie(worker);
  coordinator_->Drain();
  EXPECT_EQ(coordinator_->ActiveLeases(), 1u);
  EXPECT_TRUE(absl::IsUnavailable(coordinator_->Lease(worker, milliseconds(0)).status()));
  EXPECT_TRUE(absl::IsUnavailable(coordinator_->Submit(Spec(), "").status()));
  EXPECT_TRUE(coordinator_->Return(worker, Render(work))->accepted);
  EXPECT_EQ(coordinator_->ActiveLeases(), 0u);
  EXPECT_EQ(coordinator_->Status(job)->tiles.committed, 1u);
}

TEST_F(CoordinatorTest, AnotherLifeTakesUpWhereThisOneEnds) {
  TempFolder folder;
  Open(folder.path());
  const JobId job = SubmitOrDie(Spec(), "token");
  WorkerId worker = RegisterOrDie();
  const TileWork first = LeaseOrDie(worker);
  ASSERT_TRUE(coordinator_->Return(worker, Render(first))->accepted);
  const TileWork lost = LeaseOrDie(worker);

  Open(folder.path());
  EXPECT_EQ(coordinator_->Status(job)->tiles,
            (TileCounts{.queued = 1, .committed = 1, .total = 2}));
  EXPECT_EQ(SubmitOrDie(Spec(), "token"), job);
  EXPECT_TRUE(absl::IsNotFound(coordinator_->Return(worker, Render(lost)).status()));
  worker = RegisterOrDie();
  const TileWork second = LeaseOrDie(worker);
  EXPECT_EQ(second.tile, lost.tile);
  ASSERT_TRUE(coordinator_->Return(worker, Render(second))->accepted);
  EXPECT_EQ(WaitForEnd(job), JobState::kDone);
  EXPECT_EQ(baker_->bakes.load(), 1);

  Open(folder.path());
  EXPECT_EQ(coordinator_->Status(job)->state, JobState::kDone);
  EXPECT_EQ(coordinator_->Status(job)->tiles, (TileCounts{.committed = 2, .total = 2}));
  EXPECT_TRUE(coordinator_->FetchTile(job, 1).ok());
}

TEST_F(CoordinatorTest, LostBlobsOfAJobInWorkAreBakedAgain) {
  TempFolder folder;
  Open(folder.path());
  const JobId job = SubmitOrDie(Spec());
  WorkerId worker = RegisterOrDie();
  const TileWork work = LeaseOrDie(worker);
  ASSERT_TRUE(coordinator_->Return(worker, Render(work))->accepted);
  coordinator_.reset();
  std::filesystem::remove(folder / ("blobs/" + work.blobs.tree_topology.Hex()));
  Open(folder.path());
  worker = RegisterOrDie();
  const TileWork second = LeaseOrDie(worker);
  EXPECT_NE(second.tile, work.tile);
  EXPECT_EQ(second.blobs, work.blobs);
  EXPECT_EQ(baker_->bakes.load(), 2);
  ASSERT_TRUE(coordinator_->Return(worker, Render(second))->accepted);
  EXPECT_EQ(WaitForEnd(job), JobState::kDone);
}

TEST_F(CoordinatorTest, AJobThatWaitsForItsBakeSurvivesToo) {
  TempFolder folder;
  baker_->hold = true;
  Open(folder.path());
  const JobId job = SubmitOrDie(Spec("scene", 32, 32));
  while (baker_->bakes.load() == 0) std::this_thread::sleep_for(milliseconds(1));
  coordinator_.reset();  // stops the bake
  baker_->hold = false;
  Open(folder.path());
  const WorkerId worker = RegisterOrDie();
  ASSERT_TRUE(coordinator_->Return(worker, Render(LeaseOrDie(worker)))->accepted);
  EXPECT_EQ(WaitForEnd(job), JobState::kDone);
}

TEST_F(CoordinatorTest, UnsubmittedFilesAreFoundMissing) {
  Open();
  const Digest here = Spec().asset_files.at("a.gltf");
  const Digest not_here = Sha256().Update("not here").Finish();
  const std::vector<Digest> asked = {here, not_here};
  EXPECT_EQ(*coordinator_->FindMissing(asked), std::vector<Digest>{not_here});
}

}  // namespace
}  // namespace farpoint

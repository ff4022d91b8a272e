#include "server/job_store.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <signal.h>
#include <sqlite3.h>
#include <sys/wait.h>
#include <unistd.h>

#include <filesystem>
#include <fstream>

#include "core/image/film.h"
#include "tests/unit/server/temp_folder.h"

namespace farpoint {
namespace {

namespace fs = std::filesystem;
using ::testing::HasSubstr;
using ::testing::IsEmpty;

Digest DigestOf(std::string_view text) { return Sha256().Update(text).Finish(); }

StoredJob NewJob(const std::string& id) {
  StoredJob job;
  job.id = {id};
  job.spec.asset_root = "a.gltf";
  job.spec.asset_files["a.gltf"] = DigestOf("a");
  job.spec.film = {.width = 64, .height = 64, .crop = {0, 0, 64, 64}};
  job.spec.title = "title of " + id;
  job.submitted_unix_ms = 12345;
  return job;
}

TileResult ResultOf(const std::string& bytes) {
  TileResult result;
  result.bytes = Blob::FromString(bytes);
  result.sha256 = result.bytes.Hash();
  result.stats.counts["receivers"] = bytes.size();
  return result;
}

std::unique_ptr<JobStore> OpenOrDie(const std::string& folder) {
  absl::StatusOr<std::unique_ptr<JobStore>> store = JobStore::Open(folder);
  EXPECT_TRUE(store.ok()) << store.status();
  return store.ok() ? *std::move(store) : nullptr;
}

// Both homes of a store keep the same promises.
class JobStoreTest : public ::testing::TestWithParam<bool> {
 protected:
  JobStoreTest() : store_(OpenOrDie(GetParam() ? "" : folder_.path())) {}
  TempFolder folder_;
  std::unique_ptr<JobStore> store_;
};
INSTANTIATE_TEST_SUITE_P(Homes, JobStoreTest, ::testing::Values(false, true),
                         [](const auto& info) { return info.param ? "Memory" : "Folder"; });

TEST_P(JobStoreTest, KeepsJobs) {
  StoredJob a = NewJob("aaaaaaaa"), b = NewJob("bbbbbbbb");
  ASSERT_TRUE(store_->InsertJob(a, "submission").ok());
  ASSERT_TRUE(store_->InsertJob(b, "").ok());
  EXPECT_LT(a.number, b.number);
  Camera camera;
  camera.eye = {1.25, 1e-300, 3};
  ASSERT_TRUE(store_->SetState(a.id, JobState::kBaking, absl::OkStatus()).ok());
  Stats stats;
  stats.counts["surfels"] = 5;
  ASSERT_TRUE(
      store_->SetBaked(a.id, camera, {DigestOf("s"), DigestOf("t"), {}}, {"n1", "n2"}, stats).ok());
  ASSERT_TRUE(store_->SaveCounters(a.id, 7, 8).ok());
  ASSERT_TRUE(store_->SetState(b.id, JobState::kFailed, absl::NotFoundError("gone")).ok());

  const auto jobs = store_->LoadJobs();
  ASSERT_TRUE(jobs.ok()) << jobs.status();
  ASSERT_EQ(jobs->size(), 2u);
  const StoredJob& x = (*jobs)[0];
  EXPECT_EQ(x.id, a.id);
  EXPECT_EQ(x.state, JobState::kRendering);
  EXPECT_EQ(x.spec.title, "title of aaaaaaaa");
  EXPECT_EQ(x.camera->eye, camera.eye);
  EXPECT_EQ(x.blobs.tree_topology, DigestOf("t"));
  EXPECT_TRUE(x.blobs.tree_radiance.empty());
  EXPECT_EQ(x.notes, (std::vector<std::string>{"n1", "n2"}));
  EXPECT_EQ(x.bake_stats.counts.at("surfels"), 5u);
  EXPECT_EQ(x.reissued, 7u);
  EXPECT_EQ(x.refused_results, 8u);
  EXPECT_EQ((*jobs)[1].state, JobState::kFailed);
  EXPECT_EQ((*jobs)[1].error, absl::NotFoundError("gone"));
  EXPECT_EQ(**store_->FindSubmission("submission"), a.id);
  EXPECT_FALSE(store_->FindSubmission("other")->has_value());
}

TEST_P(JobStoreTest, OneSubmissionOneJob) {
  StoredJob a = NewJob("aaaaaaaa"), b = NewJob("bbbbbbbb");
  ASSERT_TRUE(store_->InsertJob(a, "s").ok());
  EXPECT_TRUE(absl::IsAlreadyExists(store_->InsertJob(b, "s")));
  EXPECT_EQ(store_->LoadJobs()->size(), 1u);
}

TEST_P(JobStoreTest, AFinalStateIsNeverLeft) {
  StoredJob a = NewJob("aaaaaaaa");
  ASSERT_TRUE(store_->InsertJob(a, "").ok());
  ASSERT_TRUE(store_->SetState(a.id, JobState::kCancelled, absl::OkStatus()).ok());
  EXPECT_TRUE(
      absl::IsFailedPrecondition(store_->SetState(a.id, JobState::kRendering, absl::OkStatus())));
  EXPECT_TRUE(
      absl::IsFailedPrecondition(store_->CommitTile(a.id, 0, ResultOf("x"), DigestOf("f"))));
  EXPECT_TRUE(absl::IsNotFound(store_->SetState({"unknown"}, JobState::kDone, absl::OkStatus())));
}

TEST_P(JobStoreTest, ATileIsCommittedOnceAndReadBack) {
  StoredJob a = NewJob("aaaaaaaa");
  ASSERT_TRUE(store_->InsertJob(a, "").ok());
  ASSERT_TRUE(store_->CommitTile(a.id, 3, ResultOf("pixels"), DigestOf("f")).ok());
  EXPECT_TRUE(
      absl::IsAlreadyExists(store_->CommitTile(a.id, 3, ResultOf("others"), DigestOf("g"))));
  ASSERT_TRUE(store_->CommitTile(a.id, 1, ResultOf("more"), DigestOf("g")).ok());
  const auto tiles = store_->Tiles(a.id);
  ASSERT_EQ(tiles->size(), 2u);
  EXPECT_EQ((*tiles)[0].tile, 1u);
  EXPECT_EQ((*tiles)[1].sha256, ResultOf("pixels").sha256);
  EXPECT_EQ(store_->ReadTile(a.id, 3)->bytes.Hash(), ResultOf("pixels").sha256);
  EXPECT_TRUE(absl::IsNotFound(store_->ReadTile(a.id, 2).status()));
  EXPECT_TRUE(absl::IsNotFound(store_->ReadTile({"../aaaaaaaa"}, 3).status()));
  EXPECT_EQ(store_->TileStats(a.id)->counts.at("receivers"), 10u);
  EXPECT_EQ((*store_->LoadJobs())[0].fingerprint, DigestOf("f"));  // the first one's
}

TEST_P(JobStoreTest, EventsAreNumberedWithoutGaps) {
  StoredJob a = NewJob("aaaaaaaa"), b = NewJob("bbbbbbbb");
  ASSERT_TRUE(store_->InsertJob(a, "").ok());
  ASSERT_TRUE(store_->InsertJob(b, "").ok());
  ASSERT_TRUE(store_->SetBaked(a.id, {}, {DigestOf("s"), {}, {}}, {"note"}, {}).ok());
  ASSERT_TRUE(store_->CommitTile(a.id, 9, ResultOf("x"), DigestOf("f")).ok());
  ASSERT_TRUE(store_->SetState(a.id, JobState::kDone, absl::OkStatus()).ok());
  const auto events = store_->Events(a.id, 0, 100);
  ASSERT_EQ(events->size(), 5u);
  for (size_t i = 0; i < 5; ++i) EXPECT_EQ((*events)[i].sequence, i + 1);
  EXPECT_EQ(std::get<JobState>((*events)[0].body), JobState::kQueued);
  EXPECT_EQ(std::get<std::string>((*events)[1].body), "note");
  EXPECT_EQ(std::get<JobState>((*events)[2].body), JobState::kRendering);
  EXPECT_EQ(std::get<TileCommitted>((*events)[3].body).tile, 9u);
  EXPECT_EQ(std::get<TileCommitted>((*events)[3].body).sha256, ResultOf("x").sha256);
  EXPECT_EQ(std::get<JobState>((*events)[4].body), JobState::kDone);
  EXPECT_EQ(store_->Events(a.id, 3, 1)->size(), 1u);
  EXPECT_THAT(*store_->Events(a.id, 5, 100), IsEmpty());
  EXPECT_THAT(*store_->Events(a.id, UINT64_MAX, 100), IsEmpty());
}

TEST_P(JobStoreTest, KeepsBakes) {
  EXPECT_FALSE(store_->FindBake(DigestOf("k"))->has_value());
  StoredBake bake;
  bake.blobs = {DigestOf("s"), {}, {}};
  bake.cameras.resize(2);
  bake.cameras[1].name = "second";
  bake.cameras[1].yfov_rad = 0.1;
  bake.made_up_camera = true;
  bake.notes = {"n"};
  bake.stats.counts["triangles"] = 3;
  ASSERT_TRUE(store_->PutBake(DigestOf("k"), bake).ok());
  const auto found = store_->FindBake(DigestOf("k"));
  ASSERT_TRUE(found.ok() && found->has_value());
  EXPECT_EQ((*found)->blobs, bake.blobs);
  EXPECT_EQ((*found)->cameras[1].name, "second");
  EXPECT_EQ((*found)->cameras[1].yfov_rad, 0.1);
  EXPECT_TRUE((*found)->made_up_camera);
  EXPECT_EQ((*found)->stats.counts, bake.stats.counts);
  ASSERT_TRUE(store_->RemoveBake(DigestOf("k")).ok());
  EXPECT_FALSE(store_->FindBake(DigestOf("k"))->has_value());
}

TEST_P(JobStoreTest, PurgeTakesEndedJobsOnly) {
  StoredJob a = NewJob("aaaaaaaa"), b = NewJob("bbbbbbbb");
  ASSERT_TRUE(store_->InsertJob(a, "").ok());
  ASSERT_TRUE(store_->InsertJob(b, "").ok());
  ASSERT_TRUE(store_->CommitTile(a.id, 0, ResultOf("x"), DigestOf("f")).ok());
  ASSERT_TRUE(store_->SetState(a.id, JobState::kDone, absl::OkStatus()).ok());
  EXPECT_THAT(*store_->Purge(1000), IsEmpty());
  EXPECT_EQ(store_->Purge(INT64_MAX)->size(), 1u);
  EXPECT_EQ(store_->LoadJobs()->size(), 1u);
  EXPECT_TRUE(absl::IsNotFound(store_->ReadTile(a.id, 0).status()));
  EXPECT_THAT(*store_->Events(a.id, 0, 10), IsEmpty());
  EXPECT_FALSE(fs::exists(folder_ / "tiles/aaaaaaaa"));
}

TEST(JobStore, IsLockedAgainstOtherProcesses) {
  TempFolder folder;
  const auto first = OpenOrDie(folder.path());
  const auto second = JobStore::Open(folder.path());
  EXPECT_TRUE(absl::IsFailedPrecondition(second.status())) << second.status();
  EXPECT_THAT(std::string(second.status().message()), HasSubstr("in use"));
}

TEST(JobStore, RefusesANewerSchema) {
  TempFolder folder;
  OpenOrDie(folder.path()).reset();
  sqlite3* db = nullptr;
  ASSERT_EQ(sqlite3_open((folder / "jobs.sqlite").c_str(), &db), SQLITE_OK);
  ASSERT_EQ(sqlite3_exec(db, "PRAGMA user_version=99", nullptr, nullptr, nullptr), SQLITE_OK);
  sqlite3_close(db);
  const auto store = JobStore::Open(folder.path());
  EXPECT_TRUE(absl::IsFailedPrecondition(store.status())) << store.status();
  EXPECT_THAT(std::string(store.status().message()), HasSubstr("schema 99"));
}

TEST(JobStore, RefusesADamagedFile) {
  TempFolder folder;
  std::ofstream(folder / "jobs.sqlite") << std::string(100000, 'x');
  const auto store = JobStore::Open(folder.path());
  EXPECT_TRUE(absl::IsDataLoss(store.status())) << store.status();
  EXPECT_THAT(std::string(store.status().message()), HasSubstr("jobs.sqlite"));
}

TEST(JobStore, DamagedAndMissingTilesAreDropped) {
  TempFolder folder;
  StoredJob a = NewJob("aaaaaaaa");
  {
    const auto store = OpenOrDie(folder.path());
    ASSERT_TRUE(store->InsertJob(a, "").ok());
    for (uint32_t i = 0; i < 4; ++i) {
      ASSERT_TRUE(
          store->CommitTile(a.id, i, ResultOf("tile " + std::to_string(i)), DigestOf("f")).ok());
    }
  }
  fs::remove(folder / "tiles/aaaaaaaa/1");
  std::ofstream(folder / "tiles/aaaaaaaa/2") << "tile X";
  fs::resize_file(folder / "tiles/aaaaaaaa/3", 3);
  const auto store = OpenOrDie(folder.path());
  EXPECT_TRUE(absl::IsDataLoss(store->ReadTile(a.id, 2).status()));
  EXPECT_EQ(*store->DropDamagedTiles(a.id), (std::vector<uint32_t>{1, 2, 3}));
  EXPECT_EQ(store->Tiles(a.id)->size(), 1u);
  EXPECT_TRUE(store->CommitTile(a.id, 2, ResultOf("tile 2"), DigestOf("f")).ok());
  EXPECT_TRUE(store->ReadTile(a.id, 2).ok());
}

// kill -9 at any instant: every tile that was acknowledged is there, whole.
TEST(JobStore, AcknowledgedTilesSurviveAKill) {
  for (const int after : {1, 2, 5, 17}) {
    TempFolder folder;
    int acknowledged[2];
    ASSERT_EQ(::pipe(acknowledged), 0);
    const pid_t child = ::fork();
    if (child == 0) {
      ::close(acknowledged[0]);
      auto store = JobStore::Open(folder.path());
      StoredJob job = NewJob("aaaaaaaa");
      if (!store.ok() || !(*store)->InsertJob(job, "s").ok()) ::_exit(1);
      for (uint8_t i = 0; i < 250; ++i) {
        const TileResult result = ResultOf(std::string(10000, static_cast<char>('a' + i % 26)));
        if (!(*store)->CommitTile(job.id, i, result, DigestOf("f")).ok()) ::_exit(2);
        if (::write(acknowledged[1], &i, 1) != 1) ::_exit(3);
      }
      ::_exit(0);
    }
    ::close(acknowledged[1]);
    uint8_t last = 0;
    for (int i = 0; i < after; ++i) ASSERT_EQ(::read(acknowledged[0], &last, 1), 1);
    ::kill(child, SIGKILL);
    int status = 0;
    ::waitpid(child, &status, 0);
    while (::read(acknowledged[0], &last, 1) == 1) {
    }
    ::close(acknowledged[0]);

    const auto store = OpenOrDie(folder.path());
    ASSERT_NE(store, nullptr);
    const auto jobs = store->LoadJobs();
    ASSERT_EQ(jobs->size(), 1u);
    const auto tiles = store->Tiles((*jobs)[0].id);
    ASSERT_GE(tiles->size(), last + 1u);
    EXPECT_THAT(*store->DropDamagedTiles((*jobs)[0].id), IsEmpty());
    // As many events as tiles: both or neither.
    EXPECT_EQ(store->Events((*jobs)[0].id, 0, 1000)->size(), tiles->size() + 1);
  }
}

}  // namespace
}  // namespace farpoint

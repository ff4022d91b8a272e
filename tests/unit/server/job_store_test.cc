#include "server/job_store.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <signal.h>
#include <sqlite3.h>
#include <sys/resource.h>
#include <sys/wait.h>
#include <unistd.h>

#include <algorithm>
#include <atomic>
#include <filesystem>
#include <fstream>
#include <thread>

#include "core/image/film.h"
#include "proto/convert.h"
#include "proto/records.pb.h"
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

StoredFrame SomeFrame(const std::string& scene = "s") {
  return {.camera = {}, .blobs = {DigestOf(scene), {}, {}}};
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
  const StoredFrame frame{.camera = camera, .blobs = {DigestOf("s"), DigestOf("t"), {}}};
  ASSERT_TRUE(store_->SetBaked(a.id, 0, frame, {"n1", "n2"}, stats).ok());
  ASSERT_TRUE(store_->SaveCounters({{a.id, 7, 8}}).ok());
  ASSERT_TRUE(store_->SetState(b.id, JobState::kFailed, absl::NotFoundError("gone")).ok());

  const auto jobs = store_->LoadJobs();
  ASSERT_TRUE(jobs.ok()) << jobs.status();
  ASSERT_EQ(jobs->size(), 2u);
  const StoredJob& x = (*jobs)[0];
  EXPECT_EQ(x.id, a.id);
  EXPECT_EQ(x.state, JobState::kRendering);
  EXPECT_EQ(x.spec.title, "title of aaaaaaaa");
  ASSERT_EQ(x.frames.size(), 1u);
  EXPECT_EQ(x.frames.at(0).camera.eye, camera.eye);
  EXPECT_EQ(x.frames.at(0).blobs.tree_topology, DigestOf("t"));
  EXPECT_TRUE(x.frames.at(0).blobs.tree_radiance.empty());
  EXPECT_EQ(x.notes, (std::vector<std::string>{"n1", "n2"}));
  EXPECT_EQ(store_->BakeStats(a.id)->counts.at("surfels"), 5u);
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
  ASSERT_TRUE(store_->SetBaked(a.id, 0, SomeFrame(), {"note"}, {}).ok());
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
  EXPECT_THAT(*store_->Purge(1000, {}), IsEmpty());
  EXPECT_THAT(*store_->Purge(INT64_MAX, {a.id}), IsEmpty());
  EXPECT_EQ(store_->Purge(INT64_MAX, {})->size(), 1u);
  EXPECT_EQ(store_->LoadJobs()->size(), 1u);
  EXPECT_TRUE(absl::IsNotFound(store_->ReadTile(a.id, 0).status()));
  EXPECT_THAT(*store_->Events(a.id, 0, 10), IsEmpty());
  EXPECT_FALSE(fs::exists(folder_ / "tiles/aaaaaaaa"));
}

TEST_P(JobStoreTest, KeepsTheFramesOfAnAnimation) {
  StoredJob a = NewJob("aaaaaaaa");
  a.spec.frames = {5, 3, 9};
  ASSERT_TRUE(store_->InsertJob(a, "").ok());
  Stats stats;
  stats.counts["surfels"] = 5;
  ASSERT_TRUE(store_->SetBaked(a.id, 2, SomeFrame("two"), {"n1"}, stats).ok());
  ASSERT_TRUE(store_->SetBaked(a.id, 0, SomeFrame("zero"), {"n1", "n2"}, stats).ok());
  ASSERT_TRUE(store_->SetBaked(a.id, 2, SomeFrame("again"), {"n2"}, stats).ok());
  const StoredJob x = (*store_->LoadJobs())[0];
  ASSERT_EQ(x.frames.size(), 2u);
  EXPECT_EQ(x.frames.at(0).blobs.prepared_scene, DigestOf("zero"));
  EXPECT_EQ(x.frames.at(2).blobs.prepared_scene, DigestOf("again"));
  EXPECT_EQ(x.notes, (std::vector<std::string>{"n1", "n2"}));
  EXPECT_EQ(store_->BakeStats(a.id)->counts.at("surfels"), 10u);
  // Queued, n1, rendering, n2: neither a note nor the state is told twice.
  EXPECT_EQ(store_->Events(a.id, 0, 100)->size(), 4u);
  ASSERT_TRUE(store_->SetState(a.id, JobState::kCancelled, absl::OkStatus()).ok());
  EXPECT_TRUE(absl::IsFailedPrecondition(store_->SetBaked(a.id, 1, SomeFrame(), {}, {})));
}

TEST_P(JobStoreTest, PausesAndPrioritiesAreKeptBesideTheState) {
  StoredJob a = NewJob("aaaaaaaa"), b = NewJob("bbbbbbbb");
  b.spec.start_paused = true;
  ASSERT_TRUE(store_->InsertJob(a, "").ok());
  ASSERT_TRUE(store_->InsertJob(b, "").ok());
  EXPECT_TRUE(b.paused);
  ASSERT_TRUE(store_->SetState(a.id, JobState::kBaking, absl::OkStatus()).ok());
  ASSERT_TRUE(store_->SetPaused(a.id, true).ok());
  ASSERT_TRUE(store_->SetPriority(a.id, -7).ok());
  const auto jobs = store_->LoadJobs();
  EXPECT_EQ((*jobs)[0].state, JobState::kBaking);
  EXPECT_TRUE((*jobs)[0].paused);
  EXPECT_EQ((*jobs)[0].spec.priority, -7);
  EXPECT_EQ((*jobs)[0].spec.title, a.spec.title);
  EXPECT_TRUE((*jobs)[1].paused);
  ASSERT_TRUE(store_->SetPaused(a.id, false).ok());
  EXPECT_FALSE((*store_->LoadJobs())[0].paused);
  const auto events = store_->Events(a.id, 0, 100);
  ASSERT_EQ(events->size(), 4u);
  EXPECT_EQ(std::get<JobState>((*events)[2].body), JobState::kPaused);
  EXPECT_EQ(std::get<JobState>((*events)[3].body), JobState::kBaking);
  EXPECT_GT((*events)[3].unix_ms, 1'600'000'000'000);
  EXPECT_GE((*events)[3].unix_ms, (*events)[0].unix_ms);
  EXPECT_TRUE(absl::IsNotFound(store_->SetPaused({"unknown"}, true)));
  EXPECT_TRUE(absl::IsNotFound(store_->SetPriority({"unknown"}, 1)));
  ASSERT_TRUE(store_->SetState(a.id, JobState::kFailed, absl::AbortedError("x")).ok());
  EXPECT_TRUE(absl::IsFailedPrecondition(store_->SetPaused(a.id, true)));
}

TEST_P(JobStoreTest, RequeueGoesOnOrStartsAnew) {
  StoredJob a = NewJob("aaaaaaaa"), b = NewJob("bbbbbbbb");
  ASSERT_TRUE(store_->InsertJob(a, "").ok());
  ASSERT_TRUE(store_->InsertJob(b, "").ok());
  ASSERT_TRUE(store_->SetBaked(a.id, 0, SomeFrame(), {}, {}).ok());
  ASSERT_TRUE(store_->CommitTile(a.id, 1, ResultOf("x"), DigestOf("f")).ok());
  ASSERT_TRUE(store_->SetPaused(a.id, true).ok());
  ASSERT_TRUE(store_->SetState(a.id, JobState::kFailed, absl::AbortedError("tile 0")).ok());
  ASSERT_TRUE(store_->SetState(b.id, JobState::kCancelled, absl::OkStatus()).ok());

  ASSERT_TRUE(store_->Requeue(a.id, false).ok());
  ASSERT_TRUE(store_->Requeue(b.id, false).ok());
  auto jobs = store_->LoadJobs();
  EXPECT_EQ((*jobs)[0].state, JobState::kRendering);
  EXPECT_TRUE((*jobs)[0].error.ok());
  EXPECT_FALSE((*jobs)[0].paused);
  EXPECT_EQ((*jobs)[0].fingerprint, DigestOf("f"));
  EXPECT_EQ((*jobs)[1].state, JobState::kQueued);
  EXPECT_EQ(store_->Tiles(a.id)->size(), 1u);
  EXPECT_THAT(*store_->Purge(INT64_MAX, {}), IsEmpty());  // it has not ended any more
  const auto last = store_->Events(a.id, 0, 100)->back();
  EXPECT_EQ(std::get<JobState>(last.body), JobState::kRendering);

  ASSERT_TRUE(store_->Requeue(a.id, true).ok());
  EXPECT_THAT(*store_->Tiles(a.id), IsEmpty());
  EXPECT_TRUE((*store_->LoadJobs())[0].fingerprint.empty());
  EXPECT_EQ(store_->Events(a.id, 0, 100)->back().sequence, last.sequence);  // still rendering
  EXPECT_TRUE(store_->CommitTile(a.id, 1, ResultOf("y"), DigestOf("g")).ok());
  EXPECT_TRUE(store_->ReadTile(a.id, 1).ok());
  EXPECT_TRUE(absl::IsNotFound(store_->Requeue({"unknown"}, true)));
}

TEST_P(JobStoreTest, LinesOfSeveralJobsAreAddedTogether) {
  StoredJob a = NewJob("aaaaaaaa"), b = NewJob("bbbbbbbb");
  ASSERT_TRUE(store_->InsertJob(a, "").ok());
  ASSERT_TRUE(store_->InsertJob(b, "").ok());
  const auto added = store_->AppendLogs(
      {{a.id, {.text = "one"}}, {b.id, {.text = "two"}}, {a.id, {.text = "three"}}});
  ASSERT_TRUE(added.ok()) << added.status();
  EXPECT_EQ(*added, std::vector<bool>(3, true));
  const auto lines = store_->LastLogLines(a.id, LogLevel::kInfo, 10);
  ASSERT_EQ(lines->size(), 2u);
  EXPECT_EQ(std::get<LogLine>((*lines)[0].body).text, "one");
  EXPECT_EQ(std::get<LogLine>((*lines)[1].body).text, "three");
  EXPECT_EQ((*lines)[1].sequence, (*lines)[0].sequence + 1);
}

TEST_P(JobStoreTest, TilesOfAWorkerInJobsThatAreDoneBecomeSuspectUntilTheyAreRequeued) {
  StoredJob done = NewJob("aaaaaaaa"), open = NewJob("bbbbbbbb");
  for (StoredJob* job : {&done, &open}) {
    ASSERT_TRUE(store_->InsertJob(*job, "").ok());
    ASSERT_TRUE(store_->SetBaked(job->id, 0, SomeFrame(), {}, {}).ok());
    ASSERT_TRUE(store_->CommitTile(job->id, 0, ResultOf("0"), DigestOf("f"), "liar").ok());
    ASSERT_TRUE(store_->CommitTile(job->id, 1, ResultOf("1"), DigestOf("f"), "good").ok());
    ASSERT_TRUE(store_->CommitTile(job->id, 2, ResultOf("2"), DigestOf("f"), "liar/2").ok());
    ASSERT_TRUE(store_->CommitTile(job->id, 3, ResultOf("3"), DigestOf("f"), "liars").ok());
  }
  ASSERT_TRUE(store_->SetState(done.id, JobState::kDone, absl::OkStatus()).ok());
  const auto by_name = store_->MarkSuspects("liar", false);
  ASSERT_TRUE(by_name.ok()) << by_name.status();
  EXPECT_EQ(*by_name, (std::map<JobId, uint32_t>{{done.id, 1}}));
  EXPECT_EQ(*store_->MarkSuspects("liar", true), (std::map<JobId, uint32_t>{{done.id, 1}}))
      << "those that are new";
  EXPECT_EQ((*store_->LoadJobs())[0].suspect_tiles, 2u);
  EXPECT_EQ((*store_->LoadJobs())[1].suspect_tiles, 0u);
  EXPECT_TRUE((*store_->Tiles(done.id))[0].suspect);
  EXPECT_FALSE((*store_->Tiles(done.id))[1].suspect);
  ASSERT_TRUE(store_->MarkSuspect(done.id, 0, false).ok());
  EXPECT_EQ((*store_->LoadJobs())[0].suspect_tiles, 1u);
  ASSERT_TRUE(store_->Requeue(done.id, false).ok());
  ASSERT_EQ(store_->Tiles(done.id)->size(), 3u);
  EXPECT_EQ((*store_->Tiles(done.id))[2].tile, 3u);
  EXPECT_EQ((*store_->LoadJobs())[0].suspect_tiles, 0u);
}

// Tiles of one job have one fingerprint, also if all that a first worker returned was dropped.
TEST_P(JobStoreTest, AJobWithoutTilesTakesTheFingerprintOfTheNextOne) {
  StoredJob a = NewJob("aaaaaaaa");
  ASSERT_TRUE(store_->InsertJob(a, "").ok());
  ASSERT_TRUE(store_->CommitTile(a.id, 0, ResultOf("0"), DigestOf("f")).ok());
  EXPECT_TRUE(store_->HasTile(a.id, 0, ResultOf("0").sha256));
  EXPECT_FALSE(store_->HasTile(a.id, 0, ResultOf("1").sha256));
  ASSERT_TRUE(store_->DropTiles(a.id, {0}).ok());
  EXPECT_FALSE(store_->HasTile(a.id, 0, ResultOf("0").sha256));
  ASSERT_TRUE(store_->CommitTile(a.id, 0, ResultOf("0"), DigestOf("g")).ok());
  EXPECT_EQ((*store_->LoadJobs())[0].fingerprint, DigestOf("g"));
  ASSERT_TRUE(store_->CommitTile(a.id, 1, ResultOf("1"), DigestOf("h")).ok());
  EXPECT_EQ((*store_->LoadJobs())[0].fingerprint, DigestOf("g"));
}

TEST_P(JobStoreTest, KeepsSoManyLinesOfLogAndSaysSo) {
  StoredJob a = NewJob("aaaaaaaa");
  ASSERT_TRUE(store_->InsertJob(a, "").ok());
  const LogLine line{
      .level = LogLevel::kWarning, .text = "lease lost", .tile = 3, .attempt = 2, .worker = "w"};
  ASSERT_TRUE(*store_->AppendLog(a.id, line));
  ASSERT_TRUE(*store_->AppendLog(a.id, {.text = "fine"}));
  EXPECT_EQ(std::get<LogLine>(store_->Events(a.id, 1, 1)->front().body), line);
  EXPECT_EQ(store_->LastLogLines(a.id, LogLevel::kInfo, 10)->size(), 2u);
  const auto warnings = store_->LastLogLines(a.id, LogLevel::kWarning, 10);
  ASSERT_EQ(warnings->size(), 1u);
  EXPECT_EQ(std::get<LogLine>((*warnings)[0].body), line);
  if (!GetParam()) return;  // each line is flushed: on a disk the rest takes long
  for (uint32_t i = 2; i < kMaxLogLines; ++i) ASSERT_TRUE(*store_->AppendLog(a.id, line));
  EXPECT_TRUE(*store_->AppendLog(a.id, line));
  EXPECT_FALSE(*store_->AppendLog(a.id, line));
  const auto lines = store_->LastLogLines(a.id, LogLevel::kInfo, 2 * kMaxLogLines);
  ASSERT_EQ(lines->size(), kMaxLogLines + 1);
  EXPECT_THAT(std::get<LogLine>(lines->back().body).text, HasSubstr("more than 10000 lines"));
}

TEST_P(JobStoreTest, FindsTheSlowestTiles) {
  StoredJob a = NewJob("aaaaaaaa");
  ASSERT_TRUE(store_->InsertJob(a, "").ok());
  for (uint32_t i = 0; i < 4; ++i) {
    TileResult result = ResultOf("x");
    result.stats.seconds[static_cast<size_t>(Stage::kCut)] = i == 1 ? 9 : i;
    result.stats.seconds[static_cast<size_t>(Stage::kPrimary)] = 1;
    ASSERT_TRUE(store_->CommitTile(a.id, i, result, DigestOf("f")).ok());
  }
  const auto slowest = store_->SlowestTiles(a.id, 2);
  ASSERT_EQ(slowest->size(), 2u);
  EXPECT_EQ((*slowest)[0].tile, 1u);
  EXPECT_EQ((*slowest)[0].seconds, 10);
  EXPECT_EQ((*slowest)[1].tile, 3u);
  ASSERT_TRUE(store_->DropTiles(a.id, {1}).ok());
  EXPECT_EQ(store_->SlowestTiles(a.id, 1)->front().tile, 3u);
  EXPECT_TRUE(absl::IsNotFound(store_->ReadTile(a.id, 1).status()));
}

// What version 1 wrote: a job was one frame, and its bake stood in its row.
TEST(JobStore, AStoreOfVersionOneIsBroughtUpToDate) {
  TempFolder folder;
  v1::Notes notes;
  notes.add_lines("a note");
  Stats stats;
  stats.counts["surfels"] = 5;
  const StoredFrame frame = SomeFrame();
  {
    StoredJob job = NewJob("aaaaaaaa");
    sqlite3* db = nullptr;
    ASSERT_EQ(sqlite3_open((folder / "jobs.sqlite").c_str(), &db), SQLITE_OK);
    const char* schema = R"sql(
      CREATE TABLE jobs (
        number INTEGER PRIMARY KEY AUTOINCREMENT, id TEXT NOT NULL UNIQUE, submission TEXT UNIQUE,
        spec BLOB NOT NULL, state INTEGER NOT NULL, error_code INTEGER NOT NULL DEFAULT 0,
        error TEXT NOT NULL DEFAULT '', submitted_ms INTEGER NOT NULL, ended_ms INTEGER,
        camera BLOB, blobs BLOB, notes BLOB, bake_stats BLOB, fingerprint BLOB,
        reissued INTEGER NOT NULL DEFAULT 0, refused INTEGER NOT NULL DEFAULT 0);
      CREATE TABLE tiles (
        job INTEGER NOT NULL REFERENCES jobs(number) ON DELETE CASCADE, tile INTEGER NOT NULL,
        sha256 BLOB NOT NULL, size INTEGER NOT NULL, stats BLOB NOT NULL,
        PRIMARY KEY (job, tile)) WITHOUT ROWID;
      CREATE TABLE events (
        job INTEGER NOT NULL REFERENCES jobs(number) ON DELETE CASCADE, sequence INTEGER NOT NULL,
        kind INTEGER NOT NULL, number INTEGER, data BLOB,
        PRIMARY KEY (job, sequence)) WITHOUT ROWID;
      CREATE TABLE bakes (key BLOB PRIMARY KEY, record BLOB NOT NULL) WITHOUT ROWID;
      INSERT INTO events VALUES (1, 1, 1, 0, '');
      PRAGMA user_version=1;
    )sql";
    ASSERT_EQ(sqlite3_exec(db, schema, nullptr, nullptr, nullptr), SQLITE_OK);
    sqlite3_stmt* insert = nullptr;
    ASSERT_EQ(sqlite3_prepare_v2(db,
                                 "INSERT INTO jobs (id, submission, spec, state, submitted_ms, "
                                 "camera, blobs, notes, bake_stats, reissued) "
                                 "VALUES (?1, ?2, ?3, ?4, 77, ?5, ?6, ?7, ?8, 4)",
                                 -1, &insert, nullptr),
              SQLITE_OK);
    const auto add = [&](const std::string& id, JobState state, bool baked) {
      sqlite3_reset(insert);
      sqlite3_clear_bindings(insert);
      sqlite3_bind_text(insert, 1, id.c_str(), -1, SQLITE_TRANSIENT);
      sqlite3_bind_text(insert, 2, ("submission of " + id).c_str(), -1, SQLITE_TRANSIENT);
      const auto bind = [&](int at, const std::string& bytes) {
        sqlite3_bind_blob(insert, at, bytes.data(), static_cast<int>(bytes.size()),
                          SQLITE_TRANSIENT);
      };
      bind(3, ToWire(job.spec).SerializeAsString());
      sqlite3_bind_int(insert, 4, static_cast<int>(state));
      if (baked) {
        bind(5, ToWire(frame.camera).SerializeAsString());
        bind(6, ToWire(frame.blobs).SerializeAsString());
        bind(7, notes.SerializeAsString());
        bind(8, ToWire(stats).SerializeAsString());
      }
      EXPECT_EQ(sqlite3_step(insert), SQLITE_DONE);
    };
    add("aaaaaaaa", JobState::kRendering, true);
    add("bbbbbbbb", JobState::kQueued, false);
    sqlite3_finalize(insert);
    sqlite3_close(db);
  }
  for (int opening = 0; opening < 2; ++opening) {
    const auto store = OpenOrDie(folder.path());
    ASSERT_NE(store, nullptr);
    const auto jobs = store->LoadJobs();
    ASSERT_TRUE(jobs.ok()) << jobs.status();
    ASSERT_EQ(jobs->size(), 2u);
    const StoredJob& a = (*jobs)[0];
    EXPECT_EQ(a.state, JobState::kRendering);
    EXPECT_FALSE(a.paused);
    EXPECT_EQ(a.submitted_unix_ms, 77);
    EXPECT_EQ(a.reissued, 4u);
    ASSERT_EQ(a.frames.size(), 1u);
    EXPECT_EQ(a.frames.at(0).blobs, frame.blobs);
    EXPECT_EQ(a.notes, std::vector<std::string>{"a note"});
    EXPECT_EQ(store->BakeStats(a.id)->counts.at("surfels"), 5u);
    EXPECT_TRUE((*jobs)[1].frames.empty());
    EXPECT_EQ(**store->FindSubmission("submission of bbbbbbbb"), (*jobs)[1].id);
    EXPECT_EQ(store->Events(a.id, 0, 10)->front().unix_ms, 0);
    if (opening == 0) {
      EXPECT_TRUE(store->CommitTile(a.id, 0, ResultOf("x"), DigestOf("f")).ok());
      EXPECT_TRUE(store->SetPaused((*jobs)[1].id, true).ok());
      EXPECT_TRUE(store->SetPaused((*jobs)[1].id, false).ok());
    } else {
      EXPECT_TRUE(store->ReadTile(a.id, 0).ok());
    }
  }
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
  // Tiles of six bytes, one after the other.
  const std::string segment = folder / "tiles/aaaaaaaa/segment.1";
  ASSERT_EQ(fs::file_size(segment), 24u);
  {
    std::fstream file(segment, std::ios::in | std::ios::out | std::ios::binary);
    file.seekp(6 + 5);
    file << "X";
  }
  fs::resize_file(segment, 16);
  const auto store = OpenOrDie(folder.path());
  EXPECT_TRUE(absl::IsDataLoss(store->ReadTile(a.id, 1).status()));
  EXPECT_TRUE(absl::IsDataLoss(store->ReadTile(a.id, 2).status()));
  // Without reading, what is missing is found; reading finds what was changed, too.
  EXPECT_EQ(*store->DropDamagedTiles(a.id, 0), (std::vector<uint32_t>{2, 3}));
  EXPECT_EQ(*store->DropDamagedTiles(a.id), (std::vector<uint32_t>{1}));
  EXPECT_EQ(store->Tiles(a.id)->size(), 1u);
  EXPECT_TRUE(store->CommitTile(a.id, 2, ResultOf("tile 2"), DigestOf("f")).ok());
  EXPECT_TRUE(store->ReadTile(a.id, 2).ok());
}

// Up to schema 2 a tile was a file of its own.
TEST(JobStore, TilesThatAreFilesOfTheirOwnAreRead) {
  TempFolder folder;
  StoredJob a = NewJob("aaaaaaaa");
  {
    const auto store = OpenOrDie(folder.path());
    ASSERT_TRUE(store->InsertJob(a, "").ok());
    ASSERT_TRUE(store->CommitTile(a.id, 0, ResultOf("zero"), DigestOf("f")).ok());
    ASSERT_TRUE(store->CommitTile(a.id, 1, ResultOf("one"), DigestOf("f")).ok());
  }
  sqlite3* db = nullptr;
  ASSERT_EQ(sqlite3_open((folder / "jobs.sqlite").c_str(), &db), SQLITE_OK);
  ASSERT_EQ(
      sqlite3_exec(db, "UPDATE tiles SET segment = NULL, offset = NULL", nullptr, nullptr, nullptr),
      SQLITE_OK);
  sqlite3_close(db);
  std::ofstream(folder / "tiles/aaaaaaaa/0") << "zero";
  const auto store = OpenOrDie(folder.path());
  EXPECT_EQ(store->ReadTile(a.id, 0)->bytes.size(), 4u);
  EXPECT_EQ(*store->DropDamagedTiles(a.id, 0), (std::vector<uint32_t>{1}));
}

TEST_P(JobStoreTest, TilesOfManyThreadsAreCommittedTogether) {
  StoredJob a = NewJob("aaaaaaaa"), b = NewJob("bbbbbbbb");
  ASSERT_TRUE(store_->InsertJob(a, "").ok());
  ASSERT_TRUE(store_->InsertJob(b, "").ok());
  std::vector<std::thread> threads;
  std::atomic<int> committed = 0, twice = 0;
  for (uint32_t t = 0; t < 16; ++t) {
    threads.emplace_back([&, t] {
      for (uint32_t i = 0; i < 20; ++i) {
        const JobId& job = (t + i) % 2 == 0 ? a.id : b.id;
        // Each tile is tried by two threads.
        const uint32_t tile = (t / 2) * 20 + i;
        const absl::Status status = store_->CommitTile(
            job, tile, ResultOf(job.value + std::to_string(tile)), DigestOf("f"), "worker");
        committed += status.ok();
        twice += absl::IsAlreadyExists(status);
      }
    });
  }
  for (std::thread& thread : threads) thread.join();
  EXPECT_EQ(committed + twice, 320);
  size_t tiles = 0;
  for (const JobId& job : {a.id, b.id}) {
    uint64_t sequence = 0;
    const auto events = store_->Events(job, 0, 1000);
    for (const StoredEvent& event : *events) EXPECT_EQ(event.sequence, ++sequence);
    const auto stored = store_->Tiles(job);
    for (const StoredTile& tile : *stored) {
      ++tiles;
      EXPECT_EQ(tile.worker, "worker");
      const auto data = store_->ReadTile(job, tile.tile);
      ASSERT_TRUE(data.ok()) << data.status();
      EXPECT_EQ(data->sha256, DigestOf(job.value + std::to_string(tile.tile)));
    }
  }
  EXPECT_EQ(tiles, static_cast<size_t>(committed));
}

// The process dies at every single place where something reaches the disk: whatever was
// acknowledged before is there afterwards, and the store goes on.
TEST(JobStore, SurvivesDeathAtEveryWritePoint) {
  constexpr uint32_t kTiles = 3;
  int points = 0;
  for (int deadly = 1;; ++deadly) {
    TempFolder folder;
    int acknowledged[2];
    ASSERT_EQ(::pipe(acknowledged), 0);
    const pid_t child = ::fork();
    if (child == 0) {
      ::close(acknowledged[0]);
      int passed = 0;
      auto store = JobStore::Open(folder.path(), [&](std::string_view) {
        if (++passed == deadly) ::kill(::getpid(), SIGKILL);
      });
      if (!store.ok()) ::_exit(1);
      const auto tell = [&](char what) {
        if (::write(acknowledged[1], &what, 1) != 1) ::_exit(2);
      };
      StoredJob job = NewJob("aaaaaaaa");
      if (!(*store)->InsertJob(job, "s").ok()) ::_exit(3);
      tell('j');
      if (!(*store)->SetState(job.id, JobState::kBaking, absl::OkStatus()).ok()) ::_exit(4);
      StoredFrame frame;
      frame.blobs.prepared_scene = DigestOf("scene");
      if (!(*store)->SetBaked(job.id, 0, frame, {"a note"}, {}).ok()) ::_exit(5);
      tell('b');
      for (uint32_t i = 0; i < kTiles; ++i) {
        const TileResult result = ResultOf(std::string(1000, static_cast<char>('a' + i)));
        if (!(*store)->CommitTile(job.id, i, result, DigestOf("f"), "w").ok()) ::_exit(6);
        tell('t');
      }
      if (!(*store)->AppendLog(job.id, {.text = "a line"}).ok()) ::_exit(7);
      if (!(*store)->SaveCounters({{job.id, 1, 2}}).ok()) ::_exit(8);
      if (!(*store)->SetState(job.id, JobState::kDone, absl::OkStatus()).ok()) ::_exit(9);
      tell('d');
      ::_exit(0);
    }
    ::close(acknowledged[1]);
    std::string told;
    char one = 0;
    while (::read(acknowledged[0], &one, 1) == 1) told += one;
    ::close(acknowledged[0]);
    int status = 0;
    ::waitpid(child, &status, 0);
    const bool ended = WIFEXITED(status);
    ASSERT_TRUE(!ended || WEXITSTATUS(status) == 0) << WEXITSTATUS(status);
    if (!ended) ++points;

    const auto store = OpenOrDie(folder.path());
    ASSERT_NE(store, nullptr) << deadly;
    const auto jobs = store->LoadJobs();
    ASSERT_TRUE(jobs.ok()) << jobs.status();
    const auto count = [&](char what) {
      return static_cast<size_t>(std::count(told.begin(), told.end(), what));
    };
    ASSERT_GE(jobs->size(), count('j')) << deadly;
    if (!jobs->empty()) {
      const StoredJob& job = jobs->front();
      EXPECT_GE(job.frames.size(), count('b')) << deadly;
      EXPECT_THAT(*store->DropDamagedTiles(job.id), IsEmpty()) << deadly;
      const size_t tiles = store->Tiles(job.id)->size();
      EXPECT_GE(tiles, count('t')) << deadly;
      EXPECT_LE(tiles, count('t') + 1) << deadly;
      if (count('d') > 0) {
        EXPECT_EQ(job.state, JobState::kDone);
      }
      if (!IsFinal(job.state)) {
        for (auto i = static_cast<uint32_t>(tiles); i < kTiles; ++i) {
          EXPECT_TRUE(store->CommitTile(job.id, i, ResultOf("again"), DigestOf("f")).ok());
          EXPECT_TRUE(store->ReadTile(job.id, i).ok());
        }
      }
    }
    if (ended) break;
  }
  // Six transactions, three tiles' bytes, a line, a statement.
  EXPECT_GE(points, 2 * 6 + 4 * 3 + 2 + 2);
}

TEST(JobStore, AFullDiskIsAClearErrorAndLosesNothing) {
  TempFolder folder;
  const pid_t child = ::fork();
  if (child == 0) {
    ::signal(SIGXFSZ, SIG_IGN);
    auto store = JobStore::Open(folder.path());
    StoredJob job = NewJob("aaaaaaaa");
    if (!store.ok() || !(*store)->InsertJob(job, "s").ok()) ::_exit(1);
    const TileResult small = ResultOf("pixels");
    if (!(*store)->CommitTile(job.id, 0, small, DigestOf("f")).ok()) ::_exit(2);
    rlimit limit{};
    ::getrlimit(RLIMIT_FSIZE, &limit);
    const rlim_t before = limit.rlim_cur;
    limit.rlim_cur = 300000;
    ::setrlimit(RLIMIT_FSIZE, &limit);
    const absl::Status full =
        (*store)->CommitTile(job.id, 1, ResultOf(std::string(1000000, 'x')), DigestOf("f"));
    if (!absl::IsUnavailable(full)) ::_exit(3);
    if (full.message().find(folder.path() + "/tiles/aaaaaaaa/segment.") == std::string::npos) {
      ::_exit(4);
    }
    if (!(*store)->ReadTile(job.id, 0).ok()) ::_exit(5);
    // The database itself cannot grow either: still an error, and the next commit works again.
    bool refused = false;
    for (uint32_t i = 10; i < 5000 && !refused; ++i) {
      refused = !(*store)->CommitTile(job.id, i, small, DigestOf("f")).ok();
    }
    if (!refused) ::_exit(6);
    limit.rlim_cur = before;
    ::setrlimit(RLIMIT_FSIZE, &limit);
    if (!(*store)->CommitTile(job.id, 2, small, DigestOf("f")).ok()) ::_exit(7);
    ::_exit(0);
  }
  int status = 0;
  ::waitpid(child, &status, 0);
  ASSERT_TRUE(WIFEXITED(status));
  ASSERT_EQ(WEXITSTATUS(status), 0);
  const auto store = OpenOrDie(folder.path());
  EXPECT_THAT(*store->DropDamagedTiles({"aaaaaaaa"}), IsEmpty());
  EXPECT_TRUE(store->ReadTile({"aaaaaaaa"}, 0).ok());
  EXPECT_TRUE(store->ReadTile({"aaaaaaaa"}, 2).ok());
  EXPECT_TRUE(absl::IsNotFound(store->ReadTile({"aaaaaaaa"}, 1).status()));
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

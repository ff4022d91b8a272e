#include "server/job_store.h"

#include <fcntl.h>
#include <sqlite3.h>
#include <sys/file.h>
#include <sys/stat.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <chrono>
#include <condition_variable>
#include <cstring>
#include <deque>
#include <filesystem>
#include <iterator>
#include <mutex>
#include <set>
#include <span>

#include "core/base/check.h"
#include "core/base/posix_file.h"
#include "proto/convert.h"
#include "proto/records.pb.h"

namespace farpoint {

namespace fs = std::filesystem;

namespace {

constexpr int kSchemaVersion = 4;
constexpr const char* kSchema = R"sql(
CREATE TABLE jobs (
  number INTEGER PRIMARY KEY AUTOINCREMENT,
  id TEXT NOT NULL UNIQUE,
  submission TEXT UNIQUE,
  spec BLOB NOT NULL,
  state INTEGER NOT NULL,
  error_code INTEGER NOT NULL DEFAULT 0,
  error TEXT NOT NULL DEFAULT '',
  submitted_ms INTEGER NOT NULL,
  ended_ms INTEGER,
  notes BLOB,
  fingerprint BLOB,
  reissued INTEGER NOT NULL DEFAULT 0,
  refused INTEGER NOT NULL DEFAULT 0,
  paused INTEGER NOT NULL DEFAULT 0);
CREATE TABLE frames (
  job INTEGER NOT NULL REFERENCES jobs(number) ON DELETE CASCADE,
  frame INTEGER NOT NULL,
  camera BLOB NOT NULL,
  blobs BLOB NOT NULL,
  stats BLOB NOT NULL,
  PRIMARY KEY (job, frame)) WITHOUT ROWID;
CREATE TABLE tiles (
  job INTEGER NOT NULL REFERENCES jobs(number) ON DELETE CASCADE,
  tile INTEGER NOT NULL,
  sha256 BLOB NOT NULL,
  size INTEGER NOT NULL,
  stats BLOB NOT NULL,
  segment INTEGER,
  offset INTEGER,
  worker TEXT NOT NULL DEFAULT '',
  suspect INTEGER NOT NULL DEFAULT 0,
  PRIMARY KEY (job, tile)) WITHOUT ROWID;
CREATE INDEX suspects ON tiles(job) WHERE suspect != 0;
CREATE TABLE events (
  job INTEGER NOT NULL REFERENCES jobs(number) ON DELETE CASCADE,
  sequence INTEGER NOT NULL,
  kind INTEGER NOT NULL,
  number INTEGER,
  data BLOB,
  unix_ms INTEGER NOT NULL DEFAULT 0,
  PRIMARY KEY (job, sequence)) WITHOUT ROWID;
CREATE TABLE bakes (key BLOB PRIMARY KEY, record BLOB NOT NULL) WITHOUT ROWID;
)sql";
// From one version to the next. In version 1 a job was one frame, and its bake stood in its row; up
// to version 2 each tile was a file of its own, which a tile without a segment still is.
constexpr const char* kMigrations[] = {R"sql(
CREATE TABLE frames (
  job INTEGER NOT NULL REFERENCES jobs(number) ON DELETE CASCADE,
  frame INTEGER NOT NULL,
  camera BLOB NOT NULL,
  blobs BLOB NOT NULL,
  stats BLOB NOT NULL,
  PRIMARY KEY (job, frame)) WITHOUT ROWID;
INSERT INTO frames (job, frame, camera, blobs, stats)
  SELECT number, 0, camera, blobs, bake_stats FROM jobs
  WHERE camera IS NOT NULL AND blobs IS NOT NULL AND bake_stats IS NOT NULL;
ALTER TABLE jobs DROP COLUMN camera;
ALTER TABLE jobs DROP COLUMN blobs;
ALTER TABLE jobs DROP COLUMN bake_stats;
ALTER TABLE jobs ADD COLUMN paused INTEGER NOT NULL DEFAULT 0;
ALTER TABLE events ADD COLUMN unix_ms INTEGER NOT NULL DEFAULT 0;
)sql",
                                       R"sql(
ALTER TABLE tiles ADD COLUMN segment INTEGER;
ALTER TABLE tiles ADD COLUMN offset INTEGER;
ALTER TABLE tiles ADD COLUMN worker TEXT NOT NULL DEFAULT '';
)sql",
                                       R"sql(
ALTER TABLE tiles ADD COLUMN suspect INTEGER NOT NULL DEFAULT 0;
CREATE INDEX suspects ON tiles(job) WHERE suspect != 0;
)sql"};
static_assert(std::size(kMigrations) == kSchemaVersion - 1);

// A tile larger than that begins a segment of its own; a batch of commits is no longer than that.
constexpr uint64_t kSegmentBytes = uint64_t{1} << 30;
constexpr size_t kMaxBatch = 1024;

// events.kind
constexpr int kStateEvent = 1;  // number: JobState
constexpr int kTileEvent = 2;   // number: tile, data: sha256
constexpr int kNoteEvent = 3;   // data: text
constexpr int kLogEvent = 4;    // number: LogLevel, data: v1::LogLine

JobState StateFromInt(int64_t value, JobState last) {
  return static_cast<JobState>(std::clamp<int64_t>(value, 0, static_cast<int64_t>(last)));
}

int64_t UnixMs() {
  return std::chrono::duration_cast<std::chrono::milliseconds>(
             std::chrono::system_clock::now().time_since_epoch())
      .count();
}

absl::Status SqlError(sqlite3* db, const std::string& path) {
  const int code = sqlite3_errcode(db);
  const std::string text = "'" + path + "': " + sqlite3_errmsg(db);
  switch (code & 0xff) {
    case SQLITE_CORRUPT:
    case SQLITE_NOTADB:
      return absl::DataLossError(text + "; move the file away to start with an empty store");
    case SQLITE_BUSY:
    case SQLITE_LOCKED:
      return absl::FailedPreconditionError(text + "; another process uses the store");
    case SQLITE_CONSTRAINT:
      return absl::AlreadyExistsError(text);
    case SQLITE_FULL:
      return absl::UnavailableError(text + "; free some space");
    default:
      return absl::UnavailableError(text);
  }
}

// One prepared statement, bound and stepped in order. Errors are kept until asked for.
class Statement {
 public:
  Statement(sqlite3* db, const std::string& path, const char* sql) : db_(db), path_(path) {
    result_ = sqlite3_prepare_v2(db, sql, -1, &statement_, nullptr);
  }
  ~Statement() { sqlite3_finalize(statement_); }
  Statement(const Statement&) = delete;
  Statement& operator=(const Statement&) = delete;

  Statement& Int(int64_t value) {
    if (result_ == SQLITE_OK) result_ = sqlite3_bind_int64(statement_, next_++, value);
    return *this;
  }
  Statement& Text(const std::string& value) {
    if (result_ == SQLITE_OK) {
      result_ = sqlite3_bind_text64(statement_, next_++, value.data(), value.size(),
                                    SQLITE_TRANSIENT, SQLITE_UTF8);
    }
    return *this;
  }
  Statement& Bytes(std::string_view value) {
    if (result_ == SQLITE_OK) {
      // A null pointer would bind NULL.
      result_ = sqlite3_bind_blob64(statement_, next_++, value.empty() ? "" : value.data(),
                                    value.size(), SQLITE_TRANSIENT);
    }
    return *this;
  }
  Statement& Hash(const Digest& d) {
    if (d.empty()) return Null();
    return Bytes({reinterpret_cast<const char*>(d.bytes.data()), d.bytes.size()});
  }
  Statement& Null() {
    if (result_ == SQLITE_OK) result_ = sqlite3_bind_null(statement_, next_++);
    return *this;
  }

  // True: a row is there; false: the end.
  absl::StatusOr<bool> Step() {
    if (result_ != SQLITE_OK && result_ != SQLITE_ROW) return SqlError(db_, path_);
    result_ = sqlite3_step(statement_);
    if (result_ == SQLITE_ROW) return true;
    if (result_ == SQLITE_DONE) return false;
    return SqlError(db_, path_);
  }
  absl::Status Run() { return Step().status(); }
  // Ready to be bound and run again.
  Statement& Reset() {
    sqlite3_reset(statement_);
    if (result_ == SQLITE_DONE || result_ == SQLITE_ROW) result_ = SQLITE_OK;
    next_ = 1;
    return *this;
  }

  int64_t GetInt(int column) const { return sqlite3_column_int64(statement_, column); }
  bool IsNull(int column) const { return sqlite3_column_type(statement_, column) == SQLITE_NULL; }
  std::string GetBytes(int column) const {
    const void* data = sqlite3_column_blob(statement_, column);
    const int size = sqlite3_column_bytes(statement_, column);
    return data == nullptr ? std::string() : std::string(static_cast<const char*>(data), size);
  }
  absl::StatusOr<Digest> GetHash(int column) const {
    const std::string bytes = GetBytes(column);
    Digest digest;
    if (bytes.empty()) return digest;
    if (bytes.size() != digest.bytes.size()) {
      return absl::DataLossError("'" + path_ + "': a hash has " + std::to_string(bytes.size()) +
                                 " bytes");
    }
    std::memcpy(digest.bytes.data(), bytes.data(), bytes.size());
    return digest;
  }

 private:
  sqlite3* db_;
  const std::string& path_;
  sqlite3_stmt* statement_ = nullptr;
  int result_ = SQLITE_OK;
  int next_ = 1;
};

class SqliteJobStore final : public JobStore {
 public:
  ~SqliteJobStore() override {
    sqlite3_close(read_db_);
    sqlite3_close(db_);
    if (lock_fd_ >= 0) ::close(lock_fd_);
  }

  absl::Status Init(const std::string& directory, StoreHook hook) {
    FP_RETURN_IF_ERROR(InitWriter(directory, std::move(hook)));
    if (in_memory()) return absl::OkStatus();
    if (sqlite3_open_v2(path_.c_str(), &read_db_, SQLITE_OPEN_READONLY | SQLITE_OPEN_FULLMUTEX,
                        nullptr) != SQLITE_OK) {
      return SqlError(read_db_, path_);
    }
    return absl::OkStatus();
  }

  absl::Status InitWriter(const std::string& directory, StoreHook hook) {
    directory_ = directory;
    hook_ = std::move(hook);
    path_ = in_memory() ? ":memory:" : directory + "/jobs.sqlite";
    if (!in_memory()) {
      std::error_code error;
      fs::create_directories(directory + "/tiles", error);
      if (error) {
        return absl::UnavailableError("cannot create '" + directory +
                                      "/tiles': " + error.message());
      }
      const std::string lock = directory + "/lock";
      lock_fd_ = ::open(lock.c_str(), O_RDWR | O_CREAT | O_CLOEXEC, 0644);
      if (lock_fd_ < 0) {
        return absl::UnavailableError("cannot open '" + lock + "': " + std::strerror(errno));
      }
      if (::flock(lock_fd_, LOCK_EX | LOCK_NB) != 0) {
        return absl::FailedPreconditionError("'" + directory +
                                             "' is in use by another coordinator; stop it or "
                                             "choose another --store");
      }
    }
    if (sqlite3_open_v2(path_.c_str(), &db_,
                        SQLITE_OPEN_READWRITE | SQLITE_OPEN_CREATE | SQLITE_OPEN_FULLMUTEX,
                        nullptr) != SQLITE_OK) {
      return SqlError(db_, path_);
    }
    FP_RETURN_IF_ERROR(Execute("PRAGMA journal_mode=WAL"));
    FP_RETURN_IF_ERROR(Execute("PRAGMA synchronous=FULL"));
    FP_RETURN_IF_ERROR(Execute("PRAGMA foreign_keys=ON"));
    int64_t version = 0;
    {
      Statement query(db_, path_, "PRAGMA user_version");
      FP_ASSIGN_OR_RETURN(const bool row, query.Step());
      if (row) version = query.GetInt(0);
    }
    if (version > kSchemaVersion) {
      return absl::FailedPreconditionError(
          "'" + path_ + "' has schema " + std::to_string(version) + ", this version knows " +
          std::to_string(kSchemaVersion) + "; use the newer farpoint-server or another --store");
    }
    if (version == 0) {
      Transaction transaction(*this);
      FP_RETURN_IF_ERROR(transaction.Begin());
      FP_RETURN_IF_ERROR(Execute(kSchema));
      FP_RETURN_IF_ERROR(Execute(SetVersion(kSchemaVersion).c_str()));
      return transaction.Commit();
    }
    for (; version < kSchemaVersion; ++version) {
      Transaction transaction(*this);
      FP_RETURN_IF_ERROR(transaction.Begin());
      FP_RETURN_IF_ERROR(Annotate(Execute(kMigrations[version - 1]),
                                  "cannot be brought from schema " + std::to_string(version) +
                                      " to " + std::to_string(version + 1)));
      FP_RETURN_IF_ERROR(Execute(SetVersion(version + 1).c_str()));
      FP_RETURN_IF_ERROR(transaction.Commit());
    }
    return absl::OkStatus();
  }

  absl::StatusOr<std::vector<StoredJob>> LoadJobs() override {
    std::lock_guard lock(mutex_);
    std::map<int64_t, uint32_t> suspects;  // by job
    {
      Statement query(db_, path_,
                      "SELECT job, COUNT(*) FROM tiles WHERE suspect != 0 GROUP BY job");
      for (;;) {
        FP_ASSIGN_OR_RETURN(const bool row, query.Step());
        if (!row) break;
        suspects[query.GetInt(0)] = static_cast<uint32_t>(query.GetInt(1));
      }
    }
    std::vector<StoredJob> jobs;
    Statement query(db_, path_,
                    "SELECT number, id, spec, state, error_code, error, submitted_ms, paused, "
                    "notes, fingerprint, reissued, refused FROM jobs ORDER BY number");
    for (;;) {
      FP_ASSIGN_OR_RETURN(const bool row, query.Step());
      if (!row) return jobs;
      StoredJob job;
      job.number = static_cast<uint64_t>(query.GetInt(0));
      if (const auto at = suspects.find(query.GetInt(0)); at != suspects.end()) {
        job.suspect_tiles = at->second;
      }
      job.id.value = query.GetBytes(1);
      job.state = StateFromInt(query.GetInt(3), JobState::kCancelled);
      job.error = absl::Status(static_cast<absl::StatusCode>(query.GetInt(4)), query.GetBytes(5));
      job.submitted_unix_ms = query.GetInt(6);
      job.paused = query.GetInt(7) != 0;
      job.reissued = static_cast<uint64_t>(query.GetInt(10));
      job.refused_results = static_cast<uint64_t>(query.GetInt(11));
      if (const absl::Status status = ReadDescription(query, job); !status.ok()) {
        job.state = JobState::kFailed;
        job.error = Annotate(status, "this version cannot take up the job; submit it again");
      }
      jobs.push_back(std::move(job));
    }
  }

  absl::Status InsertJob(StoredJob& job, const std::string& submission_id) override {
    std::lock_guard lock(mutex_);
    Transaction transaction(*this);
    FP_RETURN_IF_ERROR(transaction.Begin());
    Statement insert(db_, path_,
                     "INSERT INTO jobs (id, submission, spec, state, submitted_ms, paused) "
                     "VALUES (?, ?, ?, ?, ?, ?)");
    insert.Text(job.id.value);
    if (submission_id.empty()) {
      insert.Null();
    } else {
      insert.Text(submission_id);
    }
    insert.Bytes(ToWire(job.spec).SerializeAsString());
    insert.Int(static_cast<int64_t>(JobState::kQueued))
        .Int(job.submitted_unix_ms)
        .Int(job.spec.start_paused ? 1 : 0);
    FP_RETURN_IF_ERROR(insert.Run());
    job.number = static_cast<uint64_t>(sqlite3_last_insert_rowid(db_));
    job.state = JobState::kQueued;
    job.paused = job.spec.start_paused;
    FP_RETURN_IF_ERROR(AddStateEvent(job.id, JobState::kQueued));
    if (job.paused) FP_RETURN_IF_ERROR(AddStateEvent(job.id, JobState::kPaused));
    return transaction.Commit();
  }

  absl::StatusOr<std::optional<JobId>> FindSubmission(const std::string& id) override {
    std::lock_guard lock(mutex_);
    if (id.empty()) return std::nullopt;
    Statement query(db_, path_, "SELECT id FROM jobs WHERE submission = ?");
    FP_ASSIGN_OR_RETURN(const bool row, query.Text(id).Step());
    if (!row) return std::nullopt;
    return JobId{query.GetBytes(0)};
  }

  absl::Status SetState(const JobId& job, JobState state, const absl::Status& error) override {
    std::lock_guard lock(mutex_);
    Transaction transaction(*this);
    FP_RETURN_IF_ERROR(transaction.Begin());
    FP_RETURN_IF_ERROR(UpdateState(job, state, error));
    return transaction.Commit();
  }

  absl::Status SetBaked(const JobId& job, uint32_t index, const StoredFrame& frame,
                        const std::vector<std::string>& notes, const Stats& stats) override {
    std::lock_guard lock(mutex_);
    Transaction transaction(*this);
    FP_RETURN_IF_ERROR(transaction.Begin());
    FP_ASSIGN_OR_RETURN(const JobState state, LiveStateOf(job));
    Statement insert(db_, path_,
                     "INSERT OR REPLACE INTO frames (job, frame, camera, blobs, stats) "
                     "VALUES ((SELECT number FROM jobs WHERE id = ?), ?, ?, ?, ?)");
    insert.Text(job.value)
        .Int(index)
        .Bytes(ToWire(frame.camera).SerializeAsString())
        .Bytes(ToWire(frame.blobs).SerializeAsString())
        .Bytes(ToWire(stats).SerializeAsString());
    FP_RETURN_IF_ERROR(insert.Run());
    FP_RETURN_IF_ERROR(AddNotes(job, notes));
    if (state != JobState::kRendering) {
      FP_RETURN_IF_ERROR(UpdateState(job, JobState::kRendering, absl::OkStatus()));
    }
    return transaction.Commit();
  }

  absl::StatusOr<Stats> BakeStats(const JobId& job) override {
    const Reading reading = Read();
    return SumStats(reading.db,
                    "SELECT stats FROM frames WHERE job = (SELECT number FROM jobs WHERE id = ?) "
                    "ORDER BY frame",
                    job);
  }

  absl::Status SetPaused(const JobId& job, bool paused) override {
    std::lock_guard lock(mutex_);
    Transaction transaction(*this);
    FP_RETURN_IF_ERROR(transaction.Begin());
    FP_ASSIGN_OR_RETURN(const JobState state, LiveStateOf(job));
    Statement update(db_, path_, "UPDATE jobs SET paused = ? WHERE id = ?");
    FP_RETURN_IF_ERROR(update.Int(paused ? 1 : 0).Text(job.value).Run());
    FP_RETURN_IF_ERROR(AddStateEvent(job, paused ? JobState::kPaused : state));
    return transaction.Commit();
  }

  absl::Status SetPriority(const JobId& job, int32_t priority) override {
    std::lock_guard lock(mutex_);
    Statement query(db_, path_, "SELECT spec FROM jobs WHERE id = ?");
    FP_ASSIGN_OR_RETURN(const bool row, query.Text(job.value).Step());
    if (!row) return Unknown(job);
    v1::RenderJob spec;
    if (!spec.ParseFromString(query.GetBytes(0))) return Damaged("a job's description");
    spec.set_priority(priority);
    Statement update(db_, path_, "UPDATE jobs SET spec = ? WHERE id = ?");
    return RunAlone(update.Bytes(spec.SerializeAsString()).Text(job.value));
  }

  absl::Status Requeue(const JobId& job, bool all) override {
    std::lock_guard segments(segments_mutex_);
    std::lock_guard lock(mutex_);
    Transaction transaction(*this);
    FP_RETURN_IF_ERROR(transaction.Begin());
    FP_ASSIGN_OR_RETURN(const JobState now, StateOf(job));
    if (!all) {
      Statement remove(db_, path_,
                       "DELETE FROM tiles WHERE suspect != 0 AND "
                       "job = (SELECT number FROM jobs WHERE id = ?)");
      FP_RETURN_IF_ERROR(remove.Text(job.value).Run());
    } else {
      Statement remove(db_, path_,
                       "DELETE FROM tiles WHERE job = (SELECT number FROM jobs WHERE id = ?)");
      FP_RETURN_IF_ERROR(remove.Text(job.value).Run());
      Statement forget(db_, path_, "UPDATE jobs SET fingerprint = NULL WHERE id = ?");
      FP_RETURN_IF_ERROR(forget.Text(job.value).Run());
    }
    if (IsFinal(now)) {
      Statement frames(db_, path_,
                       "SELECT 1 FROM frames WHERE job = (SELECT number FROM jobs WHERE id = ?)");
      FP_ASSIGN_OR_RETURN(const bool baked, frames.Text(job.value).Step());
      const JobState state = baked ? JobState::kRendering : JobState::kQueued;
      Statement update(db_, path_,
                       "UPDATE jobs SET state = ?, error_code = 0, error = '', ended_ms = NULL, "
                       "paused = 0 WHERE id = ?");
      FP_RETURN_IF_ERROR(update.Int(static_cast<int64_t>(state)).Text(job.value).Run());
      FP_RETURN_IF_ERROR(AddStateEvent(job, state));
    }
    FP_RETURN_IF_ERROR(transaction.Commit());
    if (all) RemoveTileBytes(job);
    return absl::OkStatus();
  }

  absl::Status SaveCounters(const std::vector<JobCounters>& counters) override {
    if (counters.empty()) return absl::OkStatus();
    std::lock_guard lock(mutex_);
    Transaction transaction(*this);
    FP_RETURN_IF_ERROR(transaction.Begin());
    Statement update(db_, path_, "UPDATE jobs SET reissued = ?, refused = ? WHERE id = ?");
    for (const JobCounters& one : counters) {
      FP_RETURN_IF_ERROR(update.Reset()
                             .Int(static_cast<int64_t>(one.reissued))
                             .Int(static_cast<int64_t>(one.refused))
                             .Text(one.job.value)
                             .Run());
    }
    return transaction.Commit();
  }

  absl::Status CommitTile(const JobId& job, uint32_t tile, const TileResult& result,
                          const Digest& fingerprint, const std::string& worker) override {
    PendingTile mine{
        .job = job, .tile = tile, .result = result, .fingerprint = fingerprint, .worker = worker};
    std::unique_lock lock(queue_mutex_);
    queue_.push_back(&mine);
    // Whoever finds nobody at work commits all that have come so far, for itself and the others.
    while (!mine.done) {
      if (leading_) {
        mine.wake.wait(lock);
        continue;
      }
      leading_ = true;
      const size_t count = std::min(queue_.size(), kMaxBatch);
      const std::vector<PendingTile*> batch(queue_.begin(),
                                            queue_.begin() + static_cast<ptrdiff_t>(count));
      queue_.erase(queue_.begin(), queue_.begin() + static_cast<ptrdiff_t>(count));
      lock.unlock();
      CommitBatch(batch);
      lock.lock();
      for (PendingTile* one : batch) {
        one->done = true;
        one->wake.notify_one();
      }
      leading_ = false;
      // The others are not woken for nothing: of hundreds one is enough to go on.
      if (!queue_.empty()) queue_.front()->wake.notify_one();
    }
    return mine.status;
  }

  absl::StatusOr<std::vector<StoredTile>> Tiles(const JobId& job) override {
    const Reading reading = Read();
    return TilesOf(reading.db, job);
  }

  bool HasTile(const JobId& job, uint32_t tile, const Digest& sha256) override {
    const Reading reading = Read();
    Statement query(reading.db, path_,
                    "SELECT 1 FROM tiles WHERE tile = ? AND sha256 = ? AND job = "
                    "(SELECT number FROM jobs WHERE id = ?)");
    const absl::StatusOr<bool> row = query.Int(tile).Hash(sha256).Text(job.value).Step();
    return row.ok() && *row;
  }

  absl::StatusOr<Stats> TileStats(const JobId& job) override {
    const Reading reading = Read();
    return SumStats(reading.db,
                    "SELECT stats FROM tiles WHERE job = (SELECT number FROM jobs WHERE id = ?) "
                    "ORDER BY tile",
                    job);
  }

  absl::StatusOr<std::vector<StoredTileStats>> TileStatsOf(const JobId& job, uint32_t first,
                                                           uint32_t count) override {
    const Reading reading = Read();
    std::vector<StoredTileStats> tiles;
    Statement query(reading.db, path_,
                    "SELECT tile, worker, stats FROM tiles WHERE job = "
                    "(SELECT number FROM jobs WHERE id = ?) AND tile >= ? AND tile < ? "
                    "ORDER BY tile");
    query.Text(job.value).Int(first).Int(int64_t{first} + count);
    for (;;) {
      FP_ASSIGN_OR_RETURN(const bool row, query.Step());
      if (!row) return tiles;
      StoredTileStats& tile = tiles.emplace_back();
      tile.tile = static_cast<uint32_t>(query.GetInt(0));
      tile.worker = query.GetBytes(1);
      FP_ASSIGN_OR_RETURN(tile.stats, ReadStats(query.GetBytes(2)));
    }
  }

  absl::StatusOr<std::vector<TileSeconds>> SlowestTiles(const JobId& job, size_t count) override {
    const Reading reading = Read();
    std::vector<TileSeconds> slowest;
    Statement query(reading.db, path_,
                    "SELECT tile, stats FROM tiles WHERE job = "
                    "(SELECT number FROM jobs WHERE id = ?) ORDER BY tile");
    query.Text(job.value);
    const auto slower = [](const TileSeconds& a, const TileSeconds& b) {
      return a.seconds > b.seconds;
    };
    for (;;) {
      FP_ASSIGN_OR_RETURN(const bool row, query.Step());
      if (!row) return slowest;
      FP_ASSIGN_OR_RETURN(const Stats stats, ReadStats(query.GetBytes(1)));
      TileSeconds one{.tile = static_cast<uint32_t>(query.GetInt(0))};
      for (const double seconds : stats.seconds) one.seconds += seconds;
      slowest.insert(std::upper_bound(slowest.begin(), slowest.end(), one, slower), one);
      if (slowest.size() > count) slowest.pop_back();
    }
  }

  absl::StatusOr<TileData> ReadTile(const JobId& job, uint32_t tile) override {
    TileData data;
    data.tile = tile;
    uint64_t size = 0, offset = 0;
    std::string path = TilePath(job, tile);
    bool own_file = true;
    {
      const Reading reading = Read();
      Statement query(reading.db, path_,
                      "SELECT sha256, size, segment, offset FROM tiles WHERE tile = ? AND job = "
                      "(SELECT number FROM jobs WHERE id = ?)");
      FP_ASSIGN_OR_RETURN(const bool row, query.Int(tile).Text(job.value).Step());
      if (!row) {
        return absl::NotFoundError("tile " + std::to_string(tile) + " of job " + job.value +
                                   " is not committed");
      }
      FP_ASSIGN_OR_RETURN(data.sha256, query.GetHash(0));
      size = static_cast<uint64_t>(query.GetInt(1));
      if (in_memory()) {
        data.bytes = tiles_.at({job, tile});
        return data;
      }
      own_file = query.IsNull(2);
      if (!own_file) {
        path = SegmentPath(job, query.GetInt(2));
        offset = static_cast<uint64_t>(query.GetInt(3));
      }
    }
    const absl::StatusOr<Blob> bytes =
        own_file ? ReadFile(path, size) : ReadPart(path, offset, size);
    if (bytes.ok() && bytes->size() == size && bytes->Hash() == data.sha256) {
      data.bytes = *bytes;
      return data;
    }
    if (!bytes.ok() && absl::IsUnavailable(bytes.status())) return bytes.status();
    return absl::DataLossError("'" + path + "' is missing or damaged; submit the job again");
  }

  absl::StatusOr<std::vector<uint32_t>> DropDamagedTiles(const JobId& job,
                                                         uint64_t read_bytes) override {
    std::vector<uint32_t> dropped;
    FP_ASSIGN_OR_RETURN(const std::vector<StoredTile> tiles, Tiles(job));
    uint64_t read = 0;
    for (const StoredTile& tile : tiles) {
      if (read >= read_bytes) break;
      read += tile.size_bytes;
      const absl::Status status = ReadTile(job, tile.tile).status();
      if (absl::IsDataLoss(status)) {
        dropped.push_back(tile.tile);
      } else if (!status.ok()) {
        return status;
      }
    }
    if (read >= read_bytes) {
      FP_ASSIGN_OR_RETURN(const std::vector<uint32_t> missing, TilesWithoutBytes(job));
      dropped.insert(dropped.end(), missing.begin(), missing.end());
      std::sort(dropped.begin(), dropped.end());
      dropped.erase(std::unique(dropped.begin(), dropped.end()), dropped.end());
    }
    FP_RETURN_IF_ERROR(DropTiles(job, dropped));
    return dropped;
  }

  absl::Status DropTiles(const JobId& job, const std::vector<uint32_t>& tiles) override {
    if (tiles.empty()) return absl::OkStatus();
    std::lock_guard lock(mutex_);
    Transaction transaction(*this);
    FP_RETURN_IF_ERROR(transaction.Begin());
    for (const uint32_t tile : tiles) {
      Statement remove(db_, path_,
                       "DELETE FROM tiles WHERE tile = ? AND job = "
                       "(SELECT number FROM jobs WHERE id = ?)");
      FP_RETURN_IF_ERROR(remove.Int(tile).Text(job.value).Run());
    }
    FP_RETURN_IF_ERROR(transaction.Commit());
    if (in_memory()) {
      for (const uint32_t tile : tiles) tiles_.erase({job, tile});
    }
    return absl::OkStatus();
  }

  absl::StatusOr<std::vector<StoredEvent>> Events(const JobId& job, uint64_t after,
                                                  uint32_t max) override {
    const Reading reading = Read();
    std::vector<StoredEvent> events;
    Statement query(reading.db, path_,
                    "SELECT sequence, kind, number, data, unix_ms FROM events "
                    "WHERE sequence > ? AND job = "
                    "(SELECT number FROM jobs WHERE id = ?) ORDER BY sequence LIMIT ?");
    // SQLite's integers are signed: an `after` beyond them is beyond every event.
    query.Int(static_cast<int64_t>(std::min<uint64_t>(after, INT64_MAX))).Text(job.value).Int(max);
    for (;;) {
      FP_ASSIGN_OR_RETURN(const bool row, query.Step());
      if (!row) return events;
      FP_ASSIGN_OR_RETURN(events.emplace_back(), ReadEvent(query));
    }
  }

  absl::StatusOr<std::vector<bool>> AppendLogs(const std::vector<JobLogLine>& lines) override {
    std::vector<bool> added;
    if (lines.empty()) return added;
    std::lock_guard lock(mutex_);
    const std::map<JobId, int64_t> before = log_lines_;
    const absl::Status status = [&]() -> absl::Status {
      Transaction transaction(*this);
      FP_RETURN_IF_ERROR(transaction.Begin());
      for (const JobLogLine& one : lines) {
        FP_ASSIGN_OR_RETURN(const bool taken, AddLogLine(one.job, one.line));
        added.push_back(taken);
      }
      return transaction.Commit();
    }();
    if (status.ok()) return added;
    log_lines_ = before;
    return status;
  }

  absl::Status MarkSuspect(const JobId& job, uint32_t tile, bool suspect) override {
    std::lock_guard lock(mutex_);
    Statement update(db_, path_,
                     "UPDATE tiles SET suspect = ? WHERE tile = ? AND job = "
                     "(SELECT number FROM jobs WHERE id = ?)");
    return RunAlone(update.Int(suspect ? 1 : 0).Int(tile).Text(job.value));
  }

  absl::StatusOr<std::map<JobId, uint32_t>> MarkSuspects(const std::string& worker,
                                                         bool certificate) override {
    std::lock_guard lock(mutex_);
    std::map<JobId, uint32_t> marked;
    Transaction transaction(*this);
    FP_RETURN_IF_ERROR(transaction.Begin());
    // By the job, of which there are few that have ended, not by a scan of all tiles.
    std::vector<std::pair<int64_t, JobId>> jobs;
    {
      Statement query(db_, path_, "SELECT number, id FROM jobs WHERE state = ?");
      query.Int(static_cast<int64_t>(JobState::kDone));
      for (;;) {
        FP_ASSIGN_OR_RETURN(const bool row, query.Step());
        if (!row) break;
        jobs.emplace_back(query.GetInt(0), JobId{query.GetBytes(1)});
      }
    }
    // Names of certified workers begin with the certificate's.
    Statement update(
        db_, path_,
        "UPDATE tiles SET suspect = 1 WHERE job = ? AND suspect = 0 AND (worker = ? OR "
        "(? AND substr(worker, 1, length(?) + 1) = ? || '/'))");
    for (const auto& [number, id] : jobs) {
      update.Reset().Int(number).Text(worker).Int(certificate ? 1 : 0).Text(worker).Text(worker);
      FP_RETURN_IF_ERROR(update.Run());
      if (const int count = sqlite3_changes(db_); count > 0) {
        marked[id] = static_cast<uint32_t>(count);
      }
    }
    FP_RETURN_IF_ERROR(transaction.Commit());
    return marked;
  }

  absl::StatusOr<std::vector<StoredEvent>> LastLogLines(const JobId& job, LogLevel level,
                                                        uint32_t max) override {
    const Reading reading = Read();
    std::vector<StoredEvent> events;
    Statement query(reading.db, path_,
                    "SELECT sequence, kind, number, data, unix_ms FROM events "
                    "WHERE kind = ? AND number >= ? AND job = "
                    "(SELECT number FROM jobs WHERE id = ?) ORDER BY sequence DESC LIMIT ?");
    query.Int(kLogEvent).Int(static_cast<int64_t>(level)).Text(job.value).Int(max);
    for (;;) {
      FP_ASSIGN_OR_RETURN(const bool row, query.Step());
      if (!row) break;
      FP_ASSIGN_OR_RETURN(events.emplace_back(), ReadEvent(query));
    }
    std::reverse(events.begin(), events.end());
    return events;
  }

  absl::StatusOr<std::optional<StoredBake>> FindBake(const Digest& key) override {
    std::lock_guard lock(mutex_);
    Statement query(db_, path_, "SELECT record FROM bakes WHERE key = ?");
    FP_ASSIGN_OR_RETURN(const bool row, query.Hash(key).Step());
    if (!row) return std::nullopt;
    v1::BakeRecord record;
    if (!record.ParseFromString(query.GetBytes(0)) || record.cameras().empty()) {
      return Damaged("the record of a bake");
    }
    StoredBake bake;
    FP_ASSIGN_OR_RETURN(bake.blobs, SceneBlobsFromWire(record.blobs()));
    for (const v1::Camera& wire : record.cameras()) {
      FP_ASSIGN_OR_RETURN(bake.cameras.emplace_back(), CameraFromWire(wire, "cameras"));
    }
    bake.made_up_camera = record.made_up_camera();
    bake.animated = record.animated();
    bake.notes.assign(record.notes().begin(), record.notes().end());
    FP_ASSIGN_OR_RETURN(bake.stats, StatsFromWire(record.stats()));
    return bake;
  }

  absl::Status PutBake(const Digest& key, const StoredBake& bake) override {
    v1::BakeRecord record;
    *record.mutable_blobs() = ToWire(bake.blobs);
    for (const Camera& camera : bake.cameras) *record.add_cameras() = ToWire(camera);
    record.set_made_up_camera(bake.made_up_camera);
    record.set_animated(bake.animated);
    for (const std::string& note : bake.notes) record.add_notes(note);
    *record.mutable_stats() = ToWire(bake.stats);
    std::lock_guard lock(mutex_);
    Statement put(db_, path_, "INSERT OR REPLACE INTO bakes (key, record) VALUES (?, ?)");
    return RunAlone(put.Hash(key).Bytes(record.SerializeAsString()));
  }

  absl::Status RemoveBake(const Digest& key) override {
    std::lock_guard lock(mutex_);
    Statement remove(db_, path_, "DELETE FROM bakes WHERE key = ?");
    return RunAlone(remove.Hash(key));
  }

  absl::StatusOr<std::vector<JobId>> Purge(int64_t unix_ms, const std::set<JobId>& keep) override {
    std::lock_guard segments(segments_mutex_);
    std::lock_guard lock(mutex_);
    std::vector<JobId> ids;
    {
      Statement query(db_, path_, "SELECT id FROM jobs WHERE ended_ms < ?");
      query.Int(unix_ms);
      for (;;) {
        FP_ASSIGN_OR_RETURN(const bool row, query.Step());
        if (!row) break;
        if (JobId id{query.GetBytes(0)}; !keep.contains(id)) ids.push_back(std::move(id));
      }
    }
    for (const JobId& id : ids) {
      Statement remove(db_, path_, "DELETE FROM jobs WHERE id = ?");
      FP_RETURN_IF_ERROR(RunAlone(remove.Text(id.value)));
      RemoveTileBytes(id);
      log_lines_.erase(id);
    }
    return ids;
  }

 private:
  class Transaction {
   public:
    explicit Transaction(SqliteJobStore& store) : store_(store) {}
    ~Transaction() {
      if (open_) (void)store_.Execute("ROLLBACK");
    }
    absl::Status Begin() {
      FP_RETURN_IF_ERROR(store_.Execute("BEGIN IMMEDIATE"));
      open_ = true;
      return absl::OkStatus();
    }
    absl::Status Commit() {
      store_.At("before a commit");
      FP_RETURN_IF_ERROR(store_.Execute("COMMIT"));
      open_ = false;
      store_.At("after a commit");
      return absl::OkStatus();
    }

   private:
    SqliteJobStore& store_;
    bool open_ = false;
  };

  // A tile on its way into the store; lives on the stack of its CommitTile.
  struct PendingTile {
    const JobId& job;
    uint32_t tile;
    const TileResult& result;
    const Digest& fingerprint;
    const std::string& worker;
    int64_t segment = 0;
    uint64_t offset = 0;
    absl::Status status;
    bool done = false;  // guarded by queue_mutex_
    std::condition_variable wake;
  };
  // The file that the tiles of a job are appended to now.
  struct Segment {
    int64_t number = 0;
    Descriptor file;
    uint64_t size = 0;
  };

  void At(std::string_view point) const {
    if (hook_) hook_(point);
  }
  // Within a transaction.
  absl::StatusOr<bool> AddLogLine(const JobId& job, const LogLine& line) {
    auto at = log_lines_.find(job);
    if (at == log_lines_.end()) {
      Statement query(db_, path_,
                      "SELECT COUNT(*) FROM events WHERE kind = ? AND job = "
                      "(SELECT number FROM jobs WHERE id = ?)");
      FP_RETURN_IF_ERROR(query.Int(kLogEvent).Text(job.value).Step().status());
      at = log_lines_.emplace(job, query.GetInt(0)).first;
    }
    if (at->second > kMaxLogLines) return false;
    LogLine last;
    last.level = LogLevel::kWarning;
    last.text = "more than " + std::to_string(kMaxLogLines) +
                " lines: what happens from here on stands in the coordinator's log only";
    const bool full = at->second == kMaxLogLines;
    const LogLine& written = full ? last : line;
    At("before a line of the log");
    FP_RETURN_IF_ERROR(AddEvent(job, kLogEvent, static_cast<int64_t>(written.level),
                                ToWire(written).SerializeAsString()));
    At("after a line of the log");
    ++at->second;
    return true;
  }
  // A change that is a transaction of its own.
  absl::Status RunAlone(Statement& statement) {
    At("before a statement");
    FP_RETURN_IF_ERROR(statement.Run());
    At("after a statement");
    return absl::OkStatus();
  }

  bool in_memory() const { return directory_.empty(); }

  // For those who only read: they neither wait for the disk of those who write nor hold them up.
  struct Reading {
    std::unique_lock<std::mutex> lock;
    sqlite3* db;
  };
  Reading Read() {
    if (in_memory()) return {std::unique_lock(mutex_), db_};
    return {std::unique_lock(read_mutex_), read_db_};
  }
  std::string SegmentPath(const JobId& job, int64_t number) const {
    return TileFolder(job) + "/segment." + std::to_string(number);
  }
  std::string TileFolder(const JobId& job) const { return directory_ + "/tiles/" + job.value; }
  std::string TilePath(const JobId& job, uint32_t tile) const {
    return TileFolder(job) + "/" + std::to_string(tile);
  }
  absl::Status Damaged(const std::string& what) const {
    return absl::DataLossError("'" + path_ + "': " + what +
                               " is damaged; move the store away to start with an empty one");
  }

  static std::string SetVersion(int64_t version) {
    return "PRAGMA user_version=" + std::to_string(version);
  }
  static absl::Status Unknown(const JobId& job) {
    return absl::NotFoundError("job " + job.value + " is not known");
  }

  absl::Status Execute(const char* sql) {
    if (sqlite3_exec(db_, sql, nullptr, nullptr, nullptr) == SQLITE_OK) return absl::OkStatus();
    return SqlError(db_, path_);
  }

  absl::Status ReadDescription(const Statement& query, StoredJob& job) {
    v1::RenderJob spec;
    if (!spec.ParseFromString(query.GetBytes(2))) return Damaged("a job's description");
    FP_ASSIGN_OR_RETURN(job.spec, JobFromWire(spec));
    FP_RETURN_IF_ERROR(ValidateJob(job.spec));
    FP_ASSIGN_OR_RETURN(job.fingerprint, query.GetHash(9));
    v1::Notes notes;
    if (!notes.ParseFromString(query.GetBytes(8))) return Damaged("a job's notes");
    job.notes.assign(notes.lines().begin(), notes.lines().end());
    Statement frames(db_, path_, "SELECT frame, camera, blobs FROM frames WHERE job = ?");
    frames.Int(static_cast<int64_t>(job.number));
    for (;;) {
      FP_ASSIGN_OR_RETURN(const bool row, frames.Step());
      if (!row) return absl::OkStatus();
      v1::Camera camera;
      v1::SceneBlobs blobs;
      const int64_t index = frames.GetInt(0);
      if (index < 0 || index >= job.spec.frame_count() ||
          !camera.ParseFromString(frames.GetBytes(1)) ||
          !blobs.ParseFromString(frames.GetBytes(2))) {
        return Damaged("a job's frame");
      }
      StoredFrame frame;
      FP_ASSIGN_OR_RETURN(frame.camera, CameraFromWire(camera, "camera"));
      FP_ASSIGN_OR_RETURN(frame.blobs, SceneBlobsFromWire(blobs));
      job.frames.emplace(static_cast<uint32_t>(index), std::move(frame));
    }
  }

  absl::StatusOr<Stats> ReadStats(const std::string& bytes) const {
    v1::Stats wire;
    if (!wire.ParseFromString(bytes)) return Damaged("the statistics of a bake or tile");
    return StatsFromWire(wire);
  }
  // `sql` selects the statistics of the job whose id is its one parameter.
  absl::StatusOr<Stats> SumStats(sqlite3* db, const char* sql, const JobId& job) const {
    Stats sum;
    Statement query(db, path_, sql);
    query.Text(job.value);
    for (;;) {
      FP_ASSIGN_OR_RETURN(const bool row, query.Step());
      if (!row) return sum;
      FP_ASSIGN_OR_RETURN(const Stats stats, ReadStats(query.GetBytes(0)));
      sum += stats;
    }
  }

  // Of columns sequence, kind, number, data, unix_ms.
  absl::StatusOr<StoredEvent> ReadEvent(const Statement& query) const {
    StoredEvent event;
    event.sequence = static_cast<uint64_t>(query.GetInt(0));
    event.unix_ms = query.GetInt(4);
    switch (query.GetInt(1)) {
      case kStateEvent:
        event.body = StateFromInt(query.GetInt(2), JobState::kPaused);
        return event;
      case kTileEvent: {
        TileCommitted tile;
        tile.tile = static_cast<uint32_t>(query.GetInt(2));
        FP_ASSIGN_OR_RETURN(tile.sha256, query.GetHash(3));
        event.body = tile;
        return event;
      }
      case kNoteEvent:
        event.body = query.GetBytes(3);
        return event;
      case kLogEvent: {
        v1::LogLine line;
        if (!line.ParseFromString(query.GetBytes(3))) return Damaged("a line of a job's log");
        FP_ASSIGN_OR_RETURN(event.body, LogLineFromWire(line));
        return event;
      }
      default:
        return Damaged("an event");
    }
  }

  // Those that the job does not have yet.
  absl::Status AddNotes(const JobId& job, const std::vector<std::string>& notes) {
    if (notes.empty()) return absl::OkStatus();
    Statement query(db_, path_, "SELECT notes FROM jobs WHERE id = ?");
    FP_ASSIGN_OR_RETURN(const bool row, query.Text(job.value).Step());
    if (!row) return Unknown(job);
    v1::Notes lines;
    if (!lines.ParseFromString(query.GetBytes(0))) return Damaged("a job's notes");
    std::set<std::string> known(lines.lines().begin(), lines.lines().end());
    bool added = false;
    for (const std::string& note : notes) {
      if (known.size() >= kMaxStoredNotes || !known.insert(note).second) continue;
      lines.add_lines(note);
      FP_RETURN_IF_ERROR(AddEvent(job, kNoteEvent, 0, note));
      added = true;
    }
    if (!added) return absl::OkStatus();
    Statement update(db_, path_, "UPDATE jobs SET notes = ? WHERE id = ?");
    return update.Bytes(lines.SerializeAsString()).Text(job.value).Run();
  }

  // --- Commits in batches ---

  // One batch at a time. Sets the status of each.
  void CommitBatch(const std::vector<PendingTile*>& batch) {
    std::lock_guard segments(segments_mutex_);
    std::vector<PendingTile*> good;
    {
      std::lock_guard lock(mutex_);
      std::set<std::pair<JobId, uint32_t>> seen;
      for (PendingTile* one : batch) {
        one->status = MayCommit(one->job, one->tile);
        if (one->status.ok() && !seen.emplace(one->job, one->tile).second) {
          one->status = CommittedAlready(one->job, one->tile);
        }
        if (one->status.ok()) good.push_back(one);
      }
    }
    if (!in_memory()) {
      WriteBytes(good);
      std::erase_if(good, [](const PendingTile* one) { return !one->status.ok(); });
    }
    if (good.empty()) return;
    if (InsertRows(good).ok()) return;
    // One may have spoilt it for all.
    for (PendingTile* one : good) one->status = InsertRows({one});
  }

  // The bytes before the rows: bytes without a row are never read, a row without bytes must not be.
  void WriteBytes(const std::vector<PendingTile*>& batch) {
    std::map<JobId, std::vector<PendingTile*>> by_job;
    for (PendingTile* one : batch) by_job[one->job].push_back(one);
    for (const auto& [job, tiles] : by_job) {
      const absl::Status written = WriteSegment(job, tiles);
      if (written.ok()) continue;
      // Nobody knows what of it is on the disk: the next tiles begin another file.
      segments_.erase(job);
      for (PendingTile* one : tiles) one->status = written;
    }
  }

  absl::Status WriteSegment(const JobId& job, const std::vector<PendingTile*>& tiles) {
    uint64_t bytes = 0;
    for (const PendingTile* one : tiles) bytes += one->result.bytes.size();
    auto at = segments_.find(job);
    if (at != segments_.end() && at->second.size + bytes > kSegmentBytes) {
      segments_.erase(at);
      at = segments_.end();
    }
    if (at == segments_.end()) {
      FP_ASSIGN_OR_RETURN(Segment fresh, NewSegment(job));
      at = segments_.emplace(job, std::move(fresh)).first;
    }
    Segment& segment = at->second;
    const std::string path = SegmentPath(job, segment.number);
    std::vector<std::byte> buffer;
    buffer.reserve(bytes);
    for (PendingTile* one : tiles) {
      one->segment = segment.number;
      one->offset = segment.size + buffer.size();
      const std::span<const std::byte> more = one->result.bytes.bytes();
      buffer.insert(buffer.end(), more.begin(), more.end());
    }
    At("before a tile's bytes");
    std::span<const std::byte> rest(buffer);
    if (hook_) {
      // In two halves, so that a kill may come between them.
      FP_RETURN_IF_ERROR(
          WriteAllAt(segment.file.get(), segment.size, rest.first(rest.size() / 2), path));
      At("amid a tile's bytes");
      FP_RETURN_IF_ERROR(WriteAllAt(segment.file.get(), segment.size + rest.size() / 2,
                                    rest.subspan(rest.size() / 2), path));
    } else {
      FP_RETURN_IF_ERROR(WriteAllAt(segment.file.get(), segment.size, rest, path));
    }
    At("before a tile's bytes are flushed");
    if (::fdatasync(segment.file.get()) != 0) return DiskError("cannot flush", path, errno);
    At("after a tile's bytes are flushed");
    segment.size += buffer.size();
    return absl::OkStatus();
  }

  // A file that nobody has written to.
  absl::StatusOr<Segment> NewSegment(const JobId& job) {
    std::error_code error;
    const std::string folder = TileFolder(job);
    fs::create_directories(folder, error);
    if (error) return DiskError("cannot create", folder, error.value());
    Segment segment;
    for (segment.number = 1;; ++segment.number) {
      const std::string path = SegmentPath(job, segment.number);
      segment.file.Reset(::open(path.c_str(), O_RDWR | O_CREAT | O_EXCL | O_CLOEXEC, 0644));
      if (segment.file.valid()) break;
      if (errno != EEXIST) return DiskError("cannot create", path, errno);
    }
    SyncFolder(folder);
    SyncFolder(directory_ + "/tiles");
    return segment;
  }

  absl::Status InsertRows(const std::vector<PendingTile*>& batch) {
    std::lock_guard lock(mutex_);
    Transaction transaction(*this);
    FP_RETURN_IF_ERROR(transaction.Begin());
    Statement insert(db_, path_,
                     "INSERT INTO tiles (job, tile, sha256, size, stats, segment, offset, worker) "
                     "VALUES (?, ?, ?, ?, ?, ?, ?, ?)");
    Statement event(db_, path_,
                    "INSERT INTO events (job, sequence, kind, number, data, unix_ms) "
                    "VALUES (?, ?, ?, ?, ?, ?)");
    struct Numbers {
      int64_t job = 0, last_event = 0;
    };
    std::map<JobId, Numbers> numbers;
    const int64_t now = UnixMs();
    for (const PendingTile* one : batch) {
      auto at = numbers.find(one->job);
      if (at == numbers.end()) {
        Statement query(db_, path_,
                        "SELECT j.number, IFNULL((SELECT MAX(sequence) FROM events "
                        "WHERE job = j.number), 0) FROM jobs j WHERE j.id = ?");
        FP_ASSIGN_OR_RETURN(const bool row, query.Text(one->job.value).Step());
        if (!row) return Unknown(one->job);
        at = numbers.emplace(one->job, Numbers{query.GetInt(0), query.GetInt(1)}).first;
        Statement first(db_, path_,
                        "UPDATE jobs SET fingerprint = ?1 WHERE number = ?2 AND (fingerprint IS "
                        "NULL OR NOT EXISTS (SELECT 1 FROM tiles WHERE job = ?2))");
        FP_RETURN_IF_ERROR(first.Hash(one->fingerprint).Int(at->second.job).Run());
      }
      const Digest& sha256 = one->result.sha256;
      insert.Reset()
          .Int(at->second.job)
          .Int(one->tile)
          .Hash(sha256)
          .Int(static_cast<int64_t>(one->result.bytes.size()))
          .Bytes(ToWire(one->result.stats).SerializeAsString());
      if (in_memory()) {
        insert.Null().Null();
      } else {
        insert.Int(one->segment).Int(static_cast<int64_t>(one->offset));
      }
      FP_RETURN_IF_ERROR(insert.Text(one->worker).Run());
      FP_RETURN_IF_ERROR(
          event.Reset()
              .Int(at->second.job)
              .Int(++at->second.last_event)
              .Int(kTileEvent)
              .Int(one->tile)
              .Bytes({reinterpret_cast<const char*>(sha256.bytes.data()), sha256.bytes.size()})
              .Int(now)
              .Run());
    }
    FP_RETURN_IF_ERROR(transaction.Commit());
    if (in_memory()) {
      for (const PendingTile* one : batch) tiles_[{one->job, one->tile}] = one->result.bytes;
    }
    return absl::OkStatus();
  }

  // `size` bytes of a file from `offset` on; kNotFound if it is shorter.
  static absl::StatusOr<Blob> ReadPart(const std::string& path, uint64_t offset, uint64_t size) {
    Descriptor file(::open(path.c_str(), O_RDONLY | O_CLOEXEC));
    if (!file.valid()) return FileError("cannot open", path, errno);
    struct stat info {};
    if (::fstat(file.get(), &info) != 0) return FileError("cannot examine", path, errno);
    const auto length = static_cast<uint64_t>(info.st_size);
    if (offset > length || size > length - offset) {
      return absl::NotFoundError("'" + path + "' is too short");
    }
    std::vector<std::byte> bytes(size);
    uint64_t at = 0;
    while (at < size) {
      const ssize_t n =
          ::pread(file.get(), bytes.data() + at, size - at, static_cast<off_t>(offset + at));
      if (n < 0 && errno == EINTR) continue;
      if (n <= 0) return FileError("cannot read", path, n == 0 ? EIO : errno);
      at += static_cast<uint64_t>(n);
    }
    return Blob::FromVector(bytes);
  }

  // By the sizes of files alone.
  absl::StatusOr<std::vector<uint32_t>> TilesWithoutBytes(const JobId& job) {
    std::vector<uint32_t> missing;
    if (in_memory()) return missing;
    const Reading reading = Read();
    Statement query(reading.db, path_,
                    "SELECT tile, size, segment, offset FROM tiles WHERE job = "
                    "(SELECT number FROM jobs WHERE id = ?) ORDER BY tile");
    query.Text(job.value);
    std::map<int64_t, uint64_t> lengths;  // of segments
    for (;;) {
      FP_ASSIGN_OR_RETURN(const bool row, query.Step());
      if (!row) return missing;
      const auto tile = static_cast<uint32_t>(query.GetInt(0));
      const auto size = static_cast<uint64_t>(query.GetInt(1));
      std::error_code error;
      if (query.IsNull(2)) {
        const uint64_t length = fs::file_size(TilePath(job, tile), error);
        if (error || length != size) missing.push_back(tile);
        continue;
      }
      const auto [at, added] = lengths.emplace(query.GetInt(2), 0);
      if (added) {
        const uint64_t length = fs::file_size(SegmentPath(job, at->first), error);
        if (!error) at->second = length;
      }
      const auto offset = static_cast<uint64_t>(query.GetInt(3));
      if (offset > at->second || size > at->second - offset) missing.push_back(tile);
    }
  }

  // Needs segments_mutex_ and mutex_.
  void RemoveTileBytes(const JobId& job) {
    segments_.erase(job);
    if (in_memory()) {
      std::erase_if(tiles_, [&](const auto& entry) { return entry.first.first == job; });
    } else {
      std::error_code ignored;  // what stays behind is only space
      fs::remove_all(TileFolder(job), ignored);
    }
  }

  absl::StatusOr<JobState> StateOf(const JobId& job) {
    Statement query(db_, path_, "SELECT state FROM jobs WHERE id = ?");
    FP_ASSIGN_OR_RETURN(const bool row, query.Text(job.value).Step());
    if (!row) return Unknown(job);
    return StateFromInt(query.GetInt(0), JobState::kCancelled);
  }
  // kFailedPrecondition if it has ended.
  absl::StatusOr<JobState> LiveStateOf(const JobId& job) {
    FP_ASSIGN_OR_RETURN(const JobState now, StateOf(job));
    if (!IsFinal(now)) return now;
    return absl::FailedPreconditionError("job " + job.value + " is " + std::string(NameOf(now)) +
                                         " already");
  }

  absl::Status UpdateState(const JobId& job, JobState state, const absl::Status& error) {
    FP_RETURN_IF_ERROR(LiveStateOf(job).status());
    Statement update(db_, path_,
                     "UPDATE jobs SET state = ?, error_code = ?, error = ?, ended_ms = ? "
                     "WHERE id = ?");
    update.Int(static_cast<int64_t>(state))
        .Int(error.raw_code())
        .Text(std::string(error.message()));
    if (IsFinal(state)) {
      update.Int(UnixMs());
    } else {
      update.Null();
    }
    FP_RETURN_IF_ERROR(update.Text(job.value).Run());
    return AddStateEvent(job, state);
  }

  absl::Status AddStateEvent(const JobId& job, JobState state) {
    return AddEvent(job, kStateEvent, static_cast<int64_t>(state), "");
  }

  absl::Status AddEvent(const JobId& job, int kind, int64_t number, std::string_view data) {
    Statement insert(db_, path_,
                     "INSERT INTO events (job, sequence, kind, number, data, unix_ms) "
                     "SELECT j.number, 1 + IFNULL((SELECT MAX(sequence) FROM events "
                     "WHERE job = j.number), 0), ?, ?, ?, ? FROM jobs j WHERE j.id = ?");
    return insert.Int(kind).Int(number).Bytes(data).Int(UnixMs()).Text(job.value).Run();
  }

  absl::Status MayCommit(const JobId& job, uint32_t tile) {
    FP_RETURN_IF_ERROR(LiveStateOf(job).status());
    Statement query(db_, path_,
                    "SELECT 1 FROM tiles WHERE tile = ? AND job = "
                    "(SELECT number FROM jobs WHERE id = ?)");
    FP_ASSIGN_OR_RETURN(const bool row, query.Int(tile).Text(job.value).Step());
    return row ? CommittedAlready(job, tile) : absl::OkStatus();
  }
  static absl::Status CommittedAlready(const JobId& job, uint32_t tile) {
    return absl::AlreadyExistsError("tile " + std::to_string(tile) + " of job " + job.value +
                                    " is committed already");
  }

  absl::StatusOr<std::vector<StoredTile>> TilesOf(sqlite3* db, const JobId& job) const {
    std::vector<StoredTile> tiles;
    Statement query(db, path_,
                    "SELECT tile, sha256, size, worker, suspect FROM tiles WHERE job = "
                    "(SELECT number FROM jobs WHERE id = ?) ORDER BY tile");
    query.Text(job.value);
    for (;;) {
      FP_ASSIGN_OR_RETURN(const bool row, query.Step());
      if (!row) return tiles;
      StoredTile tile;
      tile.tile = static_cast<uint32_t>(query.GetInt(0));
      FP_ASSIGN_OR_RETURN(tile.sha256, query.GetHash(1));
      tile.size_bytes = static_cast<uint64_t>(query.GetInt(2));
      tile.worker = query.GetBytes(3);
      tile.suspect = query.GetInt(4) != 0;
      tiles.push_back(std::move(tile));
    }
  }

  std::string directory_, path_;
  StoreHook hook_;
  int lock_fd_ = -1;
  sqlite3* db_ = nullptr;
  std::mutex read_mutex_;
  sqlite3* read_db_ = nullptr;  // guarded by read_mutex_; null: in memory

  std::mutex queue_mutex_;
  std::deque<PendingTile*> queue_;     // guarded by queue_mutex_
  bool leading_ = false;               // somebody commits a batch; guarded by queue_mutex_
  std::mutex segments_mutex_;          // before mutex_
  std::map<JobId, Segment> segments_;  // guarded by segments_mutex_

  std::mutex mutex_;                                  // guards all below and db_
  std::map<std::pair<JobId, uint32_t>, Blob> tiles_;  // in memory only
  std::map<JobId, int64_t> log_lines_;                // how many a job has, once it is known
};

}  // namespace

absl::StatusOr<std::unique_ptr<JobStore>> JobStore::Open(const std::string& directory,
                                                         StoreHook hook) {
  auto store = std::make_unique<SqliteJobStore>();
  FP_RETURN_IF_ERROR(Annotate(store->Init(directory, std::move(hook)), "job store"));
  return store;
}

}  // namespace farpoint

#include "server/job_store.h"

#include <fcntl.h>
#include <sqlite3.h>
#include <sys/file.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <chrono>
#include <cstring>
#include <filesystem>
#include <iterator>
#include <mutex>
#include <set>

#include "core/base/check.h"
#include "proto/convert.h"
#include "proto/records.pb.h"

namespace farpoint {

namespace fs = std::filesystem;

namespace {

constexpr int kSchemaVersion = 2;
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
  PRIMARY KEY (job, tile)) WITHOUT ROWID;
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
// From one version to the next. In version 1 a job was one frame, and its bake stood in its row.
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
)sql"};
static_assert(std::size(kMigrations) == kSchemaVersion - 1);

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
    sqlite3_close(db_);
    if (lock_fd_ >= 0) ::close(lock_fd_);
  }

  absl::Status Init(const std::string& directory) {
    directory_ = directory;
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
    std::vector<StoredJob> jobs;
    Statement query(db_, path_,
                    "SELECT number, id, spec, state, error_code, error, submitted_ms, paused, "
                    "notes, fingerprint, reissued, refused FROM jobs ORDER BY number");
    for (;;) {
      FP_ASSIGN_OR_RETURN(const bool row, query.Step());
      if (!row) return jobs;
      StoredJob job;
      job.number = static_cast<uint64_t>(query.GetInt(0));
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
    std::lock_guard lock(mutex_);
    return SumStats(
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
    return update.Bytes(spec.SerializeAsString()).Text(job.value).Run();
  }

  absl::Status Requeue(const JobId& job, bool all) override {
    std::lock_guard lock(mutex_);
    Transaction transaction(*this);
    FP_RETURN_IF_ERROR(transaction.Begin());
    FP_ASSIGN_OR_RETURN(const JobState now, StateOf(job));
    if (all) {
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

  absl::Status SaveCounters(const JobId& job, uint64_t reissued, uint64_t refused) override {
    std::lock_guard lock(mutex_);
    Statement update(db_, path_, "UPDATE jobs SET reissued = ?, refused = ? WHERE id = ?");
    return update.Int(static_cast<int64_t>(reissued))
        .Int(static_cast<int64_t>(refused))
        .Text(job.value)
        .Run();
  }

  absl::Status CommitTile(const JobId& job, uint32_t tile, const TileResult& result,
                          const Digest& fingerprint) override {
    // The bytes first: a file without a row is overwritten, a row without a file must not be.
    {
      std::lock_guard lock(mutex_);
      FP_RETURN_IF_ERROR(MayCommit(job, tile));
    }
    if (!in_memory()) {
      std::error_code error;
      fs::create_directory(TileFolder(job), error);
      if (error) {
        return absl::UnavailableError("cannot create '" + TileFolder(job) +
                                      "': " + error.message());
      }
      FP_RETURN_IF_ERROR(WriteFileAtomically(TilePath(job, tile), result.bytes.bytes()));
    }
    std::lock_guard lock(mutex_);
    FP_RETURN_IF_ERROR(MayCommit(job, tile));
    Transaction transaction(*this);
    FP_RETURN_IF_ERROR(transaction.Begin());
    Statement insert(db_, path_,
                     "INSERT INTO tiles (job, tile, sha256, size, stats) "
                     "VALUES ((SELECT number FROM jobs WHERE id = ?), ?, ?, ?, ?)");
    FP_RETURN_IF_ERROR(insert.Text(job.value)
                           .Int(tile)
                           .Hash(result.sha256)
                           .Int(static_cast<int64_t>(result.bytes.size()))
                           .Bytes(ToWire(result.stats).SerializeAsString())
                           .Run());
    Statement first(db_, path_,
                    "UPDATE jobs SET fingerprint = ? WHERE id = ? AND fingerprint IS NULL");
    FP_RETURN_IF_ERROR(first.Hash(fingerprint).Text(job.value).Run());
    FP_RETURN_IF_ERROR(AddEvent(
        job, kTileEvent, tile,
        {reinterpret_cast<const char*>(result.sha256.bytes.data()), result.sha256.bytes.size()}));
    FP_RETURN_IF_ERROR(transaction.Commit());
    if (in_memory()) tiles_[{job, tile}] = result.bytes;
    return absl::OkStatus();
  }

  absl::StatusOr<std::vector<StoredTile>> Tiles(const JobId& job) override {
    std::lock_guard lock(mutex_);
    return TilesLocked(job);
  }

  absl::StatusOr<Stats> TileStats(const JobId& job) override {
    std::lock_guard lock(mutex_);
    return SumStats(
        "SELECT stats FROM tiles WHERE job = (SELECT number FROM jobs WHERE id = ?) "
        "ORDER BY tile",
        job);
  }

  absl::StatusOr<std::vector<TileSeconds>> SlowestTiles(const JobId& job, size_t count) override {
    std::lock_guard lock(mutex_);
    std::vector<TileSeconds> slowest;
    Statement query(db_, path_,
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
    uint64_t size = 0;
    {
      std::lock_guard lock(mutex_);
      Statement query(db_, path_,
                      "SELECT sha256, size FROM tiles WHERE tile = ? AND job = "
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
    }
    const std::string path = TilePath(job, tile);
    const absl::StatusOr<Blob> bytes = ReadFile(path, size);
    if (bytes.ok() && bytes->size() == size && bytes->Hash() == data.sha256) {
      data.bytes = *bytes;
      return data;
    }
    if (!bytes.ok() && absl::IsUnavailable(bytes.status())) return bytes.status();
    return absl::DataLossError("'" + path + "' is missing or damaged; submit the job again");
  }

  absl::StatusOr<std::vector<uint32_t>> DropDamagedTiles(const JobId& job) override {
    std::vector<uint32_t> dropped;
    FP_ASSIGN_OR_RETURN(const std::vector<StoredTile> tiles, Tiles(job));
    for (const StoredTile& tile : tiles) {
      const absl::Status status = ReadTile(job, tile.tile).status();
      if (absl::IsDataLoss(status)) {
        dropped.push_back(tile.tile);
      } else if (!status.ok()) {
        return status;
      }
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
    std::lock_guard lock(mutex_);
    std::vector<StoredEvent> events;
    Statement query(db_, path_,
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

  absl::StatusOr<bool> AppendLog(const JobId& job, const LogLine& line) override {
    std::lock_guard lock(mutex_);
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
    FP_RETURN_IF_ERROR(AddEvent(job, kLogEvent, static_cast<int64_t>(written.level),
                                ToWire(written).SerializeAsString()));
    ++at->second;
    return true;
  }

  absl::StatusOr<std::vector<StoredEvent>> LastLogLines(const JobId& job, LogLevel level,
                                                        uint32_t max) override {
    std::lock_guard lock(mutex_);
    std::vector<StoredEvent> events;
    Statement query(db_, path_,
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
    return put.Hash(key).Bytes(record.SerializeAsString()).Run();
  }

  absl::Status RemoveBake(const Digest& key) override {
    std::lock_guard lock(mutex_);
    Statement remove(db_, path_, "DELETE FROM bakes WHERE key = ?");
    return remove.Hash(key).Run();
  }

  absl::StatusOr<std::vector<JobId>> Purge(int64_t unix_ms, const std::set<JobId>& keep) override {
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
      FP_RETURN_IF_ERROR(remove.Text(id.value).Run());
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
      FP_RETURN_IF_ERROR(store_.Execute("COMMIT"));
      open_ = false;
      return absl::OkStatus();
    }

   private:
    SqliteJobStore& store_;
    bool open_ = false;
  };

  bool in_memory() const { return directory_.empty(); }
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
  absl::StatusOr<Stats> SumStats(const char* sql, const JobId& job) {
    Stats sum;
    Statement query(db_, path_, sql);
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

  void RemoveTileBytes(const JobId& job) {
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
    if (!row) return absl::OkStatus();
    return absl::AlreadyExistsError("tile " + std::to_string(tile) + " of job " + job.value +
                                    " is committed already");
  }

  absl::StatusOr<std::vector<StoredTile>> TilesLocked(const JobId& job) {
    std::vector<StoredTile> tiles;
    Statement query(db_, path_,
                    "SELECT tile, sha256, size FROM tiles WHERE job = "
                    "(SELECT number FROM jobs WHERE id = ?) ORDER BY tile");
    query.Text(job.value);
    for (;;) {
      FP_ASSIGN_OR_RETURN(const bool row, query.Step());
      if (!row) return tiles;
      StoredTile tile;
      tile.tile = static_cast<uint32_t>(query.GetInt(0));
      FP_ASSIGN_OR_RETURN(tile.sha256, query.GetHash(1));
      tile.size_bytes = static_cast<uint64_t>(query.GetInt(2));
      tiles.push_back(tile);
    }
  }

  std::string directory_, path_;
  int lock_fd_ = -1;
  sqlite3* db_ = nullptr;
  std::mutex mutex_;                                  // guards all below and db_
  std::map<std::pair<JobId, uint32_t>, Blob> tiles_;  // in memory only
  std::map<JobId, int64_t> log_lines_;                // how many a job has, once it is known
};

}  // namespace

absl::StatusOr<std::unique_ptr<JobStore>> JobStore::Open(const std::string& directory) {
  auto store = std::make_unique<SqliteJobStore>();
  FP_RETURN_IF_ERROR(Annotate(store->Init(directory), "job store"));
  return store;
}

}  // namespace farpoint

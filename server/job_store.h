// What the coordinator must not forget: jobs, committed tiles, events, bakes. SQLite in WAL mode
// with synchronous=FULL, tile bytes in files beside it, or everything in memory. Each method that
// changes something returns when it is durable, and changes all or nothing, so that the process may
// be killed at any instant.
//
// Tiles that are committed at the same time by several threads share one flush of their bytes and
// one transaction: the more arrive, the more go into each. Their bytes are appended to segments,
// files of one job, and a segment is written by one process only: what a killed process left
// behind its last row is never read.
//
// Leases are not stored: a tile without a row is queued when the store is opened again. A store of
// an older version is brought up to date when it is opened.
// Errors: kUnavailable (disk full, I/O), kDataLoss (damaged), kFailedPrecondition (in use by
// another process, written by a newer version); all name the file. Thread-safe.
#pragma once

#include <cstdint>
#include <functional>
#include <map>
#include <memory>
#include <optional>
#include <set>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

#include "core/base/blob.h"
#include "core/base/hash.h"
#include "core/base/stats.h"
#include "core/base/status.h"
#include "proto/job.h"

namespace farpoint {

// What a bake left behind, to be found by the next job with the same key.
struct StoredBake {
  SceneBlobs blobs;
  std::vector<Camera> cameras;
  bool made_up_camera = false;
  bool animated = false;  // it holds at one time only
  std::vector<std::string> notes;
  Stats stats;
};

// A frame whose bake has ended.
struct StoredFrame {
  Camera camera;
  SceneBlobs blobs;
};

struct StoredJob {
  JobId id;
  uint64_t number = 0;  // order of submission
  JobSpec spec;
  JobState state = JobState::kQueued;  // never kPaused: that is a flag beside it
  bool paused = false;
  absl::Status error;
  int64_t submitted_unix_ms = 0;
  std::map<uint32_t, StoredFrame> frames;  // by index, those that are baked
  std::vector<std::string> notes;          // of all bakes, each once
  // From the first committed tile on.
  Digest fingerprint;
  uint64_t reissued = 0, refused_results = 0;
  uint32_t suspect_tiles = 0;
};

struct JobCounters {
  JobId job;
  uint64_t reissued = 0, refused = 0;
};
struct JobLogLine {
  JobId job;
  LogLine line;
};

struct StoredTile {
  uint32_t tile = 0;
  Digest sha256;
  uint64_t size_bytes = 0;
  std::string worker;  // name of who rendered it; may be empty
  bool suspect = false;
};

// Thread-seconds that a committed tile took, all stages together.
struct TileSeconds {
  uint32_t tile = 0;
  double seconds = 0;
};

struct StoredTileStats {
  uint32_t tile = 0;
  std::string worker;  // name of who rendered it; may be empty
  Stats stats;
};

struct StoredEvent {
  uint64_t sequence = 0;
  JobEventBody body;
  int64_t unix_ms = 0;  // 0: written before events had a time
};

// For tests that kill the process or fail its disk there: called before and after everything that
// reaches the disk, with the name of the place.
using StoreHook = std::function<void(std::string_view point)>;

class JobStore {
 public:
  // Files below `directory` (created if absent), which is locked against other processes. Empty: in
  // memory.
  static absl::StatusOr<std::unique_ptr<JobStore>> Open(const std::string& directory,
                                                        StoreHook hook = {});
  virtual ~JobStore() = default;

  // --- Jobs ---
  // All, in the order of submission. A job whose description this version refuses comes as failed.
  virtual absl::StatusOr<std::vector<StoredJob>> LoadJobs() = 0;
  // Inserts a queued job and its first event, or two if it starts paused; sets job.number, state
  // and paused. kAlreadyExists: id or submission.
  virtual absl::Status InsertJob(StoredJob& job, const std::string& submission_id) = 0;
  virtual absl::StatusOr<std::optional<JobId>> FindSubmission(const std::string& id) = 0;
  // With its event. A final state is never left: kFailedPrecondition.
  virtual absl::Status SetState(const JobId& job, JobState state, const absl::Status& error) = 0;
  // Frame `index` is baked, or baked again. The job goes on to kRendering if it was not there yet;
  // notes that it did not have yet become events, up to kMaxStoredNotes.
  virtual absl::Status SetBaked(const JobId& job, uint32_t index, const StoredFrame& frame,
                                const std::vector<std::string>& notes, const Stats& stats) = 0;
  // Of the bakes of all frames, added in their order.
  virtual absl::StatusOr<Stats> BakeStats(const JobId& job) = 0;
  // With its event: kPaused, or the real state. kFailedPrecondition if the job has ended.
  virtual absl::Status SetPaused(const JobId& job, bool paused) = 0;
  virtual absl::Status SetPriority(const JobId& job, int32_t priority) = 0;
  // A job that has ended is kRendering again if a frame was baked, else kQueued, not paused and
  // without error; with its event. Suspect tiles are dropped; `all`: all committed tiles, also
  // those of a job that has not ended, whose state stays.
  virtual absl::Status Requeue(const JobId& job, bool all) = 0;
  virtual absl::Status SaveCounters(const std::vector<JobCounters>& counters) = 0;

  // --- Tiles ---
  // The bytes, the row, the event, and the job's fingerprint if it had none. kAlreadyExists if the
  // tile is committed, kFailedPrecondition if the job has ended. `worker`: its name.
  virtual absl::Status CommitTile(const JobId& job, uint32_t tile, const TileResult& result,
                                  const Digest& fingerprint, const std::string& worker = "") = 0;
  virtual absl::StatusOr<std::vector<StoredTile>> Tiles(const JobId& job) = 0;  // ascending
  // Whether the tile is committed with these bytes; false, too, if the store cannot be read.
  virtual bool HasTile(const JobId& job, uint32_t tile, const Digest& sha256) = 0;
  // Added in tile order.
  virtual absl::StatusOr<Stats> TileStats(const JobId& job) = 0;
  // Of the committed tiles of [first, first + count), ascending.
  virtual absl::StatusOr<std::vector<StoredTileStats>> TileStatsOf(const JobId& job, uint32_t first,
                                                                   uint32_t count) = 0;
  // kNotFound if it is not committed; kDataLoss if its bytes are damaged.
  virtual absl::StatusOr<TileData> ReadTile(const JobId& job, uint32_t tile) = 0;
  // Drops the tiles of an unfinished job whose bytes are missing or damaged; returns which. Reads
  // at most about `read_bytes`; beyond them only sizes are checked.
  virtual absl::StatusOr<std::vector<uint32_t>> DropDamagedTiles(
      const JobId& job, uint64_t read_bytes = UINT64_MAX) = 0;
  // It is as if they had never been committed.
  virtual absl::Status DropTiles(const JobId& job, const std::vector<uint32_t>& tiles) = 0;
  // Suspect tiles are those about which workers disagree, and those of a worker that was found to
  // return wrong pixels after their job was done. A mark on a tile that is not committed is none.
  virtual absl::Status MarkSuspect(const JobId& job, uint32_t tile, bool suspect) = 0;
  // All tiles of jobs that are done which `worker` committed, by its name; `certificate`: `worker`
  // and whoever's name begins with it and a slash. Returns how many of which job are new.
  virtual absl::StatusOr<std::map<JobId, uint32_t>> MarkSuspects(const std::string& worker,
                                                                 bool certificate) = 0;
  // The `count` committed tiles that took the longest, the longest first.
  virtual absl::StatusOr<std::vector<TileSeconds>> SlowestTiles(const JobId& job, size_t count) = 0;

  // --- Events ---
  virtual absl::StatusOr<std::vector<StoredEvent>> Events(const JobId& job, uint64_t after,
                                                          uint32_t max) = 0;

  // Adds an event for each, in order, with one flush for all. False if the job has its kMaxLogLines
  // already: then it is dropped; the first one that is dropped leaves a line that says so.
  virtual absl::StatusOr<std::vector<bool>> AppendLogs(const std::vector<JobLogLine>& lines) = 0;
  absl::StatusOr<bool> AppendLog(const JobId& job, const LogLine& line) {
    FP_ASSIGN_OR_RETURN(const std::vector<bool> added, AppendLogs({{job, line}}));
    return added.front();
  }
  // The last lines of at least `level`, at most `max`, in order.
  virtual absl::StatusOr<std::vector<StoredEvent>> LastLogLines(const JobId& job, LogLevel level,
                                                                uint32_t max) = 0;

  // --- Bakes ---
  virtual absl::StatusOr<std::optional<StoredBake>> FindBake(const Digest& key) = 0;
  virtual absl::Status PutBake(const Digest& key, const StoredBake& bake) = 0;
  virtual absl::Status RemoveBake(const Digest& key) = 0;

  // Removes the jobs that ended before `unix_ms`, except `keep`, with their tiles and events.
  // Returns which.
  virtual absl::StatusOr<std::vector<JobId>> Purge(int64_t unix_ms,
                                                   const std::set<JobId>& keep) = 0;
};

inline constexpr size_t kMaxStoredNotes = 1000;

}  // namespace farpoint

// Who renders which tile when. A plain class: values in, values out, time from an injected clock;
// no threads, no store, no sockets. Not thread-safe: the caller holds a lock.
//
// A tile is queued, leased, committed or failed. A lease is one worker's attempt at a tile; a tile
// has one, or two while a slow tile is copied to an idle worker. A lease lives until
//   - its result is committed (then a second lease of the tile is told to drop it),
//   - its worker reports failure, gives it back or leaves,
//   - nothing was heard of its worker for silence_time, or progress stood still for lease_time,
//   - its job ends, or its job commits a tile of another fingerprint.
// A queued tile is leased only when it is open (its frame is baked) and its job is not paused.
// Committing takes two steps, since a result counts when it is durable: BeginCommit pins the lease,
// FinishCommit ends it. In between the tile counts as leased and no other result is taken.
#pragma once

#include <chrono>
#include <cstdint>
#include <map>
#include <optional>
#include <set>
#include <string>
#include <vector>

#include "core/base/clock.h"
#include "core/base/hash.h"
#include "core/base/status.h"
#include "proto/job.h"

namespace farpoint {

struct SchedulerOptions {
  Duration silence_time = std::chrono::seconds(5);
  Duration lease_time = std::chrono::seconds(120);
  double speculate_factor = 3;
  Duration speculate_after = std::chrono::seconds(5);
  uint32_t max_dead_workers = 3;
  uint32_t max_tile_failures = 6;
  uint32_t max_worker_failures = 3;
  Duration set_aside_time = std::chrono::seconds(60);
  Duration forget_worker_after = std::chrono::seconds(60);  // without leases and silent
};

// The tiles of one job, as they are when rendering starts or is taken up again.
struct ScheduledJob {
  JobId id;
  int32_t priority = 0;
  uint64_t number = 0;  // order of submission: age decides between equal priorities
  uint32_t tiles = 0;
  std::vector<uint32_t> committed;      // tiles that are done already
  Digest fingerprint;                   // of the committed tiles; empty if there are none
  Duration max_time = Duration::max();  // from the first lease on
  Duration lease_time{};                // if longer than the options' one
  bool open = true;                     // false: no tile may be leased until OpenTiles names it
  bool paused = false;
};

struct LeaseGrant {
  LeaseId lease;
  WorkerId worker;
  JobId job;
  uint32_t tile = 0;
  uint32_t attempt = 0;  // of the tile, from 1
  bool speculative = false;
};

// What happened without anybody asking for it; for the log and for ending jobs.
struct LostLease {
  LeaseGrant grant;
  std::string reason;
  std::string worker_name;
  bool worker_set_aside = false;  // by this
};
struct FailedJob {
  JobId job;
  absl::Status error;            // names tile and cause
  std::optional<uint32_t> tile;  // that the job failed by
};
struct SchedulerNews {
  std::vector<LostLease> lost;
  std::vector<FailedJob> failed;    // their tiles are failed, their leases gone
  std::vector<WorkerId> forgotten;  // were silent too long
};

// How the tiles of a job get on, for people.
struct TileInWork {
  LeaseGrant grant;
  std::string worker_name;
  double seconds = 0;  // since it was leased
  float fraction = 0;  // [0, 1]
};
struct TroubledTile {
  uint32_t tile = 0;
  uint32_t failures = 0;
  uint32_t workers = 0;  // different ones that it failed on
  std::string cause;     // the last one
};
struct JobReport {
  uint32_t leasable = 0;               // queued and open tiles
  Digest fingerprint;                  // empty: any worker may take it
  std::vector<TileInWork> in_work;     // the longest first
  std::vector<TroubledTile> troubled;  // not committed, failed at least once; by tile
};

class TileScheduler {
 public:
  TileScheduler(const SchedulerOptions& options, const Clock& clock);

  // --- Jobs ---
  // `job.id` must be new; job.committed are different and below job.tiles.
  void AddJob(const ScheduledJob& job);
  // Its leases are gone; their workers hear it at the next Renew. Unknown ids are ignored.
  void RemoveJob(const JobId& job);
  bool HasJob(const JobId& job) const { return jobs_.contains(job); }
  // Tiles [first, first + count) of a job may be leased from now on; those that are open stay so.
  void OpenTiles(const JobId& job, uint32_t first, uint32_t count);
  // The time of a pause counts neither for max_time nor for the estimated rest.
  void SetPaused(const JobId& job, bool paused);
  void SetPriority(const JobId& job, int32_t priority);
  // Its tiles count as if they had never failed, on any worker.
  void ForgetFailures(const JobId& job);
  // Zeros for an unknown job, as the next ones.
  TileCounts Counts(const JobId& job) const;
  double Progress(const JobId& job) const;
  std::optional<double> EtaSeconds(const JobId& job) const;
  uint64_t Reissued(const JobId& job) const;
  uint64_t Refused(const JobId& job) const;
  uint32_t Leasable(const JobId& job) const;  // queued and open tiles
  JobReport Report(const JobId& job) const;

  // --- Workers ---
  void AddWorker(const WorkerId& id, const WorkerHello& hello);
  bool HasWorker(const WorkerId& id) const { return workers_.contains(id); }
  // Heard of it: it waits for work. False for an unknown one.
  bool Touch(const WorkerId& id);
  // Its leases are queued again, without blame.
  void RemoveWorker(const WorkerId& id);
  std::vector<WorkerStatus> Workers() const;
  size_t worker_count() const { return workers_.size(); }
  // What it said of itself; null for an unknown one. Valid until workers are added or removed.
  const WorkerHello* FindWorker(const WorkerId& id) const;
  uint32_t ActiveLeases() const { return static_cast<uint32_t>(leases_.size()); }

  // --- Leases ---
  // The next tile for this worker: the job of highest priority, then the oldest, that takes its
  // fingerprint; a tile that it has not failed on before one that it has; else a copy of a slow
  // tile. Nothing for unknown workers and those set aside. A worker has one lease at a time: one
  // that it still has is taken for an answer that never reached it, and its tile is queued again.
  std::optional<LeaseGrant> Lease(const WorkerId& worker);
  RenewAnswer Renew(const WorkerId& worker, const LeaseId& lease, const LeaseProgress& progress);
  // The grant if the result may be taken; else kFailedPrecondition with the reason, and the
  // refusal is counted if the lease's job is known.
  absl::StatusOr<LeaseGrant> BeginCommit(const WorkerId& worker, const LeaseId& lease,
                                         uint32_t attempt);
  // Ends what BeginCommit began. `durable`: the tile is committed, and all its leases end.
  // Otherwise it is queued again. False if the lease vanished in between (its job was removed).
  bool FinishCommit(const LeaseId& lease, bool durable);
  // A worker's result was damaged: its lease ends, counted as its failure and as a refusal.
  SchedulerNews RefuseResult(const LeaseId& lease, const std::string& reason);
  SchedulerNews ReportFailure(const WorkerId& worker, const LeaseId& lease, bool given_back,
                              const absl::Status& error);
  std::optional<LeaseGrant> FindLease(const LeaseId& lease) const;
  // Also of leases that ended lately; empty if it is not known.
  JobId JobOf(const LeaseId& lease) const;

  // The caller itself stood still for `gap` (its machine slept, its process was stopped) and could
  // not hear anybody: that time counts against no lease and no worker.
  void Forgive(Duration gap);
  // Finds what has run out by now. Call it every fraction of silence_time.
  SchedulerNews Tick();

 private:
  enum class TileState : uint8_t { kQueued, kLeased, kCommitted, kFailed };
  struct Tile {
    TileState state = TileState::kQueued;
    bool open = true;
    uint32_t attempts = 0;
    uint32_t failures = 0;
    std::set<WorkerId> dead;      // workers that it took down or that failed on it
    std::vector<LeaseId> leases;  // at most two
  };
  struct Job {
    ScheduledJob spec;
    std::vector<Tile> tiles;
    std::set<uint32_t> queued;  // open tiles in state kQueued, in order
    TileCounts counts;
    Digest fingerprint;
    std::optional<TimePoint> started;  // first lease
    uint32_t committed_here = 0;       // since it was added
    std::vector<Duration> durations;   // of the last committed tiles
    std::optional<TimePoint> paused_at;
    std::map<uint32_t, std::string> causes;  // of the last failure of tiles
    uint64_t reissued = 0, refused = 0;
  };
  struct Worker {
    WorkerHello hello;
    TimePoint heard;
    std::set<LeaseId> leases;
    uint64_t committed = 0, failures = 0;
    uint32_t failures_in_a_row = 0;
    std::optional<TimePoint> set_aside_until;
  };
  struct LiveLease {
    LeaseGrant grant;
    TimePoint started, heard, progressed;
    LeaseProgress progress;
    bool committing = false;
  };

  bool IsSetAside(const Worker& worker) const;
  bool AnotherWorkerCouldTake(const Job& job, const Tile& tile, const WorkerId& but) const;
  LeaseGrant Grant(const WorkerId& worker, Job& job, uint32_t tile, bool speculative);
  // Takes the lease away from worker and tile; a tile without leases is queued again.
  void EndLease(const LeaseId& lease);
  std::string NameOfWorker(const WorkerId& id) const;
  // Blames worker and tile for the loss of a lease, and tells of it; the job may fail by it.
  void Blame(const LeaseGrant& grant, const std::string& cause, SchedulerNews& news);
  // After a first result that did not become durable.
  void ForgetUnusedFingerprint(Job& job);
  void FailJob(Job& job, absl::Status error, std::optional<uint32_t> tile, SchedulerNews& news);
  void SetState(Job& job, uint32_t tile, TileState state);

  const SchedulerOptions options_;
  const Clock& clock_;
  std::map<JobId, Job> jobs_;
  std::map<WorkerId, Worker> workers_;
  std::map<LeaseId, LiveLease> leases_;
  // Jobs of leases that ended, so that late results are counted: the most recent ones.
  std::map<LeaseId, JobId> ended_;
  std::vector<LeaseId> ended_order_;
  size_t ended_next_ = 0;
  uint64_t next_lease_ = 1;
  uint64_t epoch_;  // makes lease ids of different processes different
};

}  // namespace farpoint

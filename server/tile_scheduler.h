// Who renders which tile when. A plain class: values in, values out, time from an injected clock;
// no threads, no store, no sockets. Not thread-safe: the caller holds a lock.
//
// A tile is queued, leased, committed or failed. A lease is one worker's attempt at a tile; a tile
// has one, or two while a slow tile is copied to an idle worker. A lease lives until
//   - its result is committed (then a second lease of the tile is told to drop it),
//   - its worker reports failure, gives it back or leaves,
//   - nothing was heard of its worker for silence_time, or its connection broke and did not come
//     back within reconnect_time,
//   - progress stood still for lease_time, or, while it renders, neither progress was made nor a
//     processor used for stall_time: a thread hangs; or a processor was used, but no step was done
//     (LeaseProgress::pulse) for as long, or for step_time if that is longer: a thread goes in
//     circles. The latter is doubled with each failure of the tile, as a step may just be long,
//   - its job ends, or its job commits a tile of another fingerprint.
// A queued tile is leased only when it is open (its frame is baked) and its job is not paused.
//
// Neighbours share work within a process: a worker goes on with the tile after its last one, and
// begins, or begins anew where others have been, as far from them as it can. One that is alone
// finds all that there is in its own process, whatever the order: its tiles are spread over the
// frame, so that those that are done tell of those that are not. What was tried before goes first.
//
// Committing takes two steps, since a result counts when it is durable: BeginCommit pins the lease,
// FinishCommit ends it. In between the tile counts as leased and no other result is taken.
//
// Poison. A tile that took down max_dead_workers different workers, or failed max_tile_failures
// times, is set aside: it counts as failed, the job's other tiles go on, and the caller ends the
// job when nothing else is left. Workers that just vanish may be a matter of the farm and not of
// the tile: where more than three times as many vanished from other tiles lately, only
// max_tile_failures counts, and where more than nine times as many did, four times that. A worker
// that is heard of again did not die: what it was blamed for is forgiven, and a tile that was set
// aside by that is queued again. A tile that failed before is leased as `careful`.
//
// Errors that no other worker would fare better with (an invalid argument) fail the job at once,
// but only when two workers say so, where there are two: one broken worker must not fail every job.
//
// Audits. A share audit_fraction of the committed tiles, drawn at random, is rendered again by
// another worker, which cannot tell such a lease from others; the tile counts as committed all the
// time. If the results differ, further workers are asked until two agree. Who returned something
// else is set aside for good, and every tile that it committed, under any id of its name, is
// queued again. For good means under any id, too: whoever comes back as the same owner gets no
// tile for as long as this lives, and has one voice in an audit. The owner is the certificate where
// there is one, else the name.
#pragma once

#include <chrono>
#include <cstdint>
#include <map>
#include <optional>
#include <random>
#include <set>
#include <string>
#include <utility>
#include <vector>

#include "core/base/clock.h"
#include "core/base/hash.h"
#include "core/base/status.h"
#include "proto/job.h"
#include "server/loss_cause.h"
#include "server/time_left.h"

namespace farpoint {

struct SchedulerOptions {
  Duration silence_time = std::chrono::seconds(4);
  Duration lease_time = std::chrono::seconds(120);
  Duration stall_time = std::chrono::seconds(3);
  Duration reconnect_time = std::chrono::milliseconds(500);
  double speculate_factor = 3;
  Duration speculate_after = std::chrono::seconds(1);
  uint32_t max_dead_workers = 3;
  uint32_t max_tile_failures = 6;
  uint32_t max_worker_failures = 3;
  Duration set_aside_time = std::chrono::seconds(60);
  Duration forget_worker_after = std::chrono::seconds(60);  // without leases and silent
  // How long workers that vanished may come back before their tile is given up.
  Duration comeback_time = std::chrono::seconds(3);
  double audit_fraction = 0;  // [0, 1]
  // How long a disagreement waits for a worker that may decide it.
  Duration decide_time = std::chrono::seconds(60);
  uint64_t audit_seed = 0;  // 0: random, so that nobody can tell which tiles
};

// The tiles of one job, as they are when rendering starts or is taken up again.
struct ScheduledJob {
  JobId id;
  int32_t priority = 0;
  uint64_t number = 0;  // order of submission: age decides between equal priorities
  uint32_t tiles = 0;
  uint32_t frame_tiles = 0;  // of each frame, one after the other; 0: all are one frame's
  // For the time left (TimeLeft): the tiles of a frame, or none; the part of a tile's cost that
  // neighbours share.
  std::vector<PixelRect> frame_rects;
  double usual_share = 0;
  std::vector<uint32_t> committed;        // tiles that are done already
  std::vector<std::string> committed_by;  // their workers' names; as many, or none: not known
  Digest fingerprint;                     // of the committed tiles; empty if there are none
  Duration max_time = Duration::max();    // from the first lease on
  Duration lease_time{};                  // if longer than the options' one
  Duration step_time{};                   // how long a step may take, generously
  bool open = true;                       // false: no tile may be leased until OpenTiles names it
  bool paused = false;
};

struct LeaseGrant {
  LeaseId lease;
  WorkerId worker;
  JobId job;
  uint32_t tile = 0;
  uint32_t attempt = 0;  // of the tile, from 1
  bool speculative = false;
  bool careful = false;
  bool audit = false;  // of a committed tile; the worker is not told
};

// What happened without anybody asking for it; for the log and for ending jobs.
struct LostLease {
  LeaseGrant grant;
  std::string reason;
  LossCause cause = LossCause::kReported;
  std::string worker_name;
  bool worker_set_aside = false;  // by this
};
struct FailedJob {
  JobId job;
  absl::Status error;            // names tile and cause
  std::optional<uint32_t> tile;  // that the job failed by
};
struct SetAsideTile {
  JobId job;
  uint32_t tile = 0;
};
struct SchedulerNews {
  std::vector<LostLease> lost;
  std::vector<FailedJob> failed;        // their tiles are failed, their leases gone
  std::vector<SetAsideTile> set_aside;  // poison; Report tells why
  std::vector<WorkerId> forgotten;      // were silent too long
};

// What an audit's result has shown.
struct AuditVerdict {
  bool counted = false;   // false: the lease has vanished meanwhile
  bool disputed = false;  // results differ and no two agree: another worker is asked
  struct Convict {
    WorkerId id;
    std::string name;
    std::string certified_as;  // all workers of this certificate are meant; empty: this one's name
  };
  std::vector<Convict> convicted;  // they returned what two others did not
  // Tiles that they had committed: queued again, to be dropped from the store before the caller
  // lets go of its lock.
  std::map<JobId, std::vector<uint32_t>> reopened;
  bool agreed = false;  // the committed result was right: the tile is disputed no more
};
enum class AuditState {
  kNone,       // nothing to wait for
  kOpen,       // a tile is rendered again, or will be
  kUndecided,  // results differ, and nobody is there who could decide
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
  bool set_aside = false;
};
struct JobReport {
  uint32_t leasable = 0;               // queued and open tiles
  Digest fingerprint;                  // empty: any worker may take it
  std::vector<TileInWork> in_work;     // the longest first
  std::vector<TroubledTile> troubled;  // not committed, failed at least once; by tile
  uint32_t audits_open = 0;
  uint64_t audits_done = 0;    // two workers agreed
  uint64_t audits_differ = 0;  // two workers disagreed
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
  // The time of a pause counts neither for max_time nor for the time left.
  void SetPaused(const JobId& job, bool paused);
  void SetPriority(const JobId& job, int32_t priority);
  // Its tiles count as if they had never failed, on any worker; those set aside are queued again.
  void ForgetFailures(const JobId& job);
  // Zeros for an unknown job, as the next ones.
  TileCounts Counts(const JobId& job) const;
  double Progress(const JobId& job) const;
  // Seconds to the last commit, as things go now; none before the first one and during a pause.
  std::optional<double> EtaSeconds(const JobId& job) const;
  uint64_t Reissued(const JobId& job) const;
  uint64_t Refused(const JobId& job) const;
  uint32_t Leasable(const JobId& job) const;  // queued and open tiles
  JobReport Report(const JobId& job) const;
  AuditState Audits(const JobId& job) const;
  // Whether the tiles that are set aside stay so: false while a worker that vanished from one may
  // still come back.
  bool MayGiveUp(const JobId& job) const;
  bool IsCommitted(const JobId& job, uint32_t tile) const;
  // Committed tiles about which workers disagree.
  std::vector<uint32_t> DisputedTiles(const JobId& job) const;

  // --- Workers ---
  // A name that a worker has which is there gets a number behind it, so that names tell workers
  // apart.
  void AddWorker(const WorkerId& id, const WorkerHello& hello);
  // Whether it was found to return wrong pixels, under this id or another one of its owner.
  bool IsConvicted(const WorkerHello& hello) const { return convicts_.contains(OwnerOf(hello)); }
  bool HasWorker(const WorkerId& id) const { return workers_.contains(id); }
  // Heard of it: it waits for work. False for an unknown one.
  bool Touch(const WorkerId& id);
  // Its leases are queued again, without blame.
  void RemoveWorker(const WorkerId& id);
  // A connection that it keeps open for as long as it lives. A worker that never opened one is
  // judged by its silence alone. Returns what Disconnected takes: only the end of the last
  // connection counts. Unknown ids are ignored.
  uint64_t Connected(const WorkerId& id);
  void Disconnected(const WorkerId& id, uint64_t connection);
  std::vector<WorkerStatus> Workers() const;
  size_t worker_count() const { return workers_.size(); }
  // What it said of itself; null for an unknown one. Valid until workers are added or removed.
  const WorkerHello* FindWorker(const WorkerId& id) const;
  uint32_t ActiveLeases() const { return static_cast<uint32_t>(leases_.size()); }

  // --- Leases ---
  // The next tile for this worker: the job of highest priority, then the oldest, that takes its
  // fingerprint; a tile that it has not failed on before one that it has; else a copy of a slow
  // tile, or of one whose worker is known to be slow. Audits go before all. Nothing for unknown
  // workers and those set aside. A worker has one lease at a time: one that it still has is taken
  // for an answer that never reached it, and its tile is queued again.
  std::optional<LeaseGrant> Lease(const WorkerId& worker);
  RenewAnswer Renew(const WorkerId& worker, const LeaseId& lease, const LeaseProgress& progress);
  // The grant if the result may be taken; else kFailedPrecondition with the reason, and the
  // refusal is counted if the lease's job is known.
  absl::StatusOr<LeaseGrant> BeginCommit(const WorkerId& worker, const LeaseId& lease,
                                         uint32_t attempt);
  // Ends what BeginCommit began. `durable`: the tile is committed, and all its leases end.
  // Otherwise it is queued again. False if the lease vanished in between (its job was removed) or
  // its worker was convicted: then the tile is queued, and what was stored must be dropped.
  // `result`: the hash of its bytes, which audits compare.
  bool FinishCommit(const LeaseId& lease, bool durable, const Digest& result = {});
  // The same for the lease of an audit, of which nothing is stored.
  AuditVerdict FinishAudit(const LeaseId& lease, const Digest& result);
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
  enum class Fault : uint8_t { kReported, kVanished };
  struct Tile {
    TileState state = TileState::kQueued;
    bool open = true;
    uint32_t attempts = 0;
    uint32_t failures = 0;
    uint32_t committed_by = 0;    // index into Job::names
    std::set<WorkerId> dead;      // workers that it took down or that failed on it
    std::vector<LeaseId> leases;  // at most two; no audits
  };
  struct Audit {
    // Who returned what; the committed result is among them.
    std::map<Digest, std::map<WorkerId, WorkerHello>> opinions;
    Digest committed;
    std::optional<LeaseId> lease;
    std::optional<TimePoint> disputed_at;
    bool HasOpinionOf(const std::string& owner) const;
  };
  struct Job {
    ScheduledJob spec;
    std::vector<Tile> tiles;
    std::set<uint32_t> queued;  // open tiles in state kQueued, in order
    std::set<uint32_t> again;   // of these, the ones that were leased before
    std::map<WorkerId, uint32_t> last_tiles;
    std::set<std::string> permanent;  // owners of the workers that said that the job is wrong
    TimePoint copies_after{};         // no slow tile is looked for before
    uint32_t begun = 0;               // how often a worker began somewhere
    TimePoint comeback_until{};       // of workers that vanished from tiles which are set aside
    std::set<LeaseId> leases;
    TileCounts counts;
    Digest fingerprint;
    std::optional<TimePoint> started;  // first lease
    uint32_t committed_here = 0;       // since it was added
    TimeLeft time_left;
    double time_left_from_s = 0;      // of the job's time, when time_left began
    std::vector<Duration> durations;  // of the last committed tiles
    Duration median{};                // of durations
    std::optional<TimePoint> paused_at;
    std::map<uint32_t, std::string> causes;  // of the last failure of tiles
    std::vector<std::string> names;          // of workers that committed tiles; [0] is ""
    std::map<uint32_t, Audit> audits;        // by tile, those that are not settled
    uint64_t reissued = 0, refused = 0, audits_done = 0, audits_differ = 0;
  };
  struct Worker {
    WorkerHello hello;
    TimePoint heard;
    std::set<LeaseId> leases;
    uint64_t committed = 0, failures = 0;
    uint32_t failures_in_a_row = 0;
    double slowness = 1;  // of its tiles, as multiples of their jobs' medians
    std::optional<TimePoint> set_aside_until;
    bool convicted = false;
    uint64_t connection = 0;  // the last one
    std::optional<TimePoint> disconnected_at;
    std::vector<std::pair<JobId, uint32_t>> vanished_from;  // to be forgiven if it comes back
  };
  struct LiveLease {
    LeaseGrant grant;
    TimePoint started, heard, progressed, busy, stepped;
    LeaseProgress progress;
    std::chrono::milliseconds busy_cpu{0}, stepped_cpu{0};  // at `busy`, at `stepped`
    bool committing = false;
    bool doomed = false;  // its worker was convicted while it was committing
  };
  // Jobs in the order in which they are served.
  struct Rank {
    int32_t priority;
    uint64_t number;
    JobId id;
    bool operator<(const Rank& other) const;
  };
  struct Vanishing {
    TimePoint when;
    WorkerId worker;
    JobId job;
    uint32_t tile;
  };

  static Rank RankOf(const Job& job) { return {job.spec.priority, job.spec.number, job.spec.id}; }
  // Enters the job among those that can be served, or takes it out. Call it after each change of
  // queued, leases, audits and pause.
  void Rerank(const Job& job);
  void Unrank(const Job& job);
  // Who answers for what a worker returns.
  static std::string OwnerOf(const WorkerHello& hello) {
    return hello.certified_as.empty() ? "name " + hello.name : "certificate " + hello.certified_as;
  }
  static bool IsOf(const std::string& name, const WorkerHello& owner);
  bool IsSetAside(const Worker& worker) const;
  bool IsThere(const Worker& worker) const;
  bool GoesInCircles(const LiveLease& live) const;
  bool TakesFingerprint(const Job& job, const Worker& worker) const;
  bool AnotherWorkerCouldTake(const Job& job, const Tile& tile, const WorkerId& but) const;
  bool SomeWorkerCouldAudit(const Job& job, const Audit& audit) const;
  LeaseGrant Grant(const WorkerId& worker, Job& job, uint32_t tile, bool speculative, bool audit);
  // A queued tile for the worker; none if all have failed on it and others could take them.
  std::optional<uint32_t> PickTile(Job& job, const WorkerId& worker);
  std::optional<LeaseGrant> LeaseAudit(const WorkerId& id, const Worker& worker);
  std::optional<LeaseGrant> LeaseCopy(const WorkerId& id, const Worker& worker);
  // Takes the lease away from worker and tile; a tile without leases is queued again.
  void EndLease(const LeaseId& lease);
  std::string NameOfWorker(const WorkerId& id) const;
  void Heard(const WorkerId& id, Worker& worker);
  void EraseWorker(const WorkerId& id);
  // Blames worker and tile for the loss of a lease, and tells of it; the tile may be set aside.
  void Blame(const LeaseGrant& grant, const std::string& cause, Fault fault, SchedulerNews& news,
             LossCause loss = LossCause::kReported);
  bool IsPoison(const Job& job, uint32_t tile);
  void Convict(const WorkerId& id, const WorkerHello& hello, AuditVerdict& verdict);
  // After a first result that did not become durable.
  void ForgetUnusedFingerprint(Job& job);
  void FailJob(Job& job, absl::Status error, std::optional<uint32_t> tile, SchedulerNews& news);
  void SetState(Job& job, uint32_t tile, TileState state);
  void RememberDuration(Job& job, Duration took);
  // Seconds since the first lease, without pauses.
  double ElapsedSeconds(const Job& job) const;
  void RestartTimeLeft(Job& job) const;
  // No other worker is there that could take its tiles.
  bool IsAlone(const Job& job, const WorkerId& id) const;

  const SchedulerOptions options_;
  const Clock& clock_;
  std::map<JobId, Job> jobs_;
  std::map<WorkerId, Worker> workers_;
  std::map<LeaseId, LiveLease> leases_;
  // Not paused, with leasable tiles; with leases; with unsettled audits.
  std::set<Rank> ready_, working_, auditing_;
  std::set<JobId> started_;          // whose time runs
  std::vector<Vanishing> vanished_;  // lately, in order of time
  std::set<std::string> convicts_;   // owners
  std::mt19937_64 random_;           // which tiles are audited
  // Jobs of leases that ended, so that late results are counted: the most recent ones.
  std::map<LeaseId, JobId> ended_;
  std::vector<LeaseId> ended_order_;
  size_t ended_next_ = 0;
  uint64_t next_lease_ = 1, next_connection_ = 1;
  uint64_t epoch_;  // makes lease ids of different processes different
};

}  // namespace farpoint

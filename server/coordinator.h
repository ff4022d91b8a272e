// The coordinator: takes jobs, bakes their scenes, hands out tiles, keeps results. No sockets: the
// gRPC services (server/*_service.cc) and the embedded mode call the same methods.
//
// Embedded use (`farpoint render`), everything in one process and nothing on disk:
//
//   CoordinatorOptions options;                       // no store directory: all in memory
//   options.baker = MakeCoreBaker(threads);           // server/scene_baker.h
//   FP_ASSIGN_OR_RETURN(auto coordinator, Coordinator::Open(std::move(options)));
//   InProcessLink<CoordinatorApi> link(*coordinator); // worker/in_process_link.h
//   WorkerOptions worker_options;                     // threads, name; see worker/worker.h
//   worker_options.fingerprint = …                    // any fixed digest will do in one process
//   auto renderer = MakeCoreRenderer();               // worker/tile_renderer.h
//   Worker worker(worker_options, link, link, *renderer);
//   std::thread thread([&] { worker.Run(); });        // until worker.Stop()
//   for (auto& [uri, blob] : asset.files) coordinator->PutBlob(blob.Hash(), blob);
//   FP_ASSIGN_OR_RETURN(JobId job, coordinator->Submit(spec, /*submission_id=*/""));
//   for (uint64_t after = 0;;) {                      // until a final JobState event
//     FP_ASSIGN_OR_RETURN(auto events, coordinator->NextEvents(job, after, 200ms));
//     for (const JobEvent& e : events) {
//       if (e.sequence != 0) after = e.sequence;
//       …                                             // TileCommitted: FetchTile, DecodeFilm
//     }
//   }
//   worker.Stop(); thread.join();                     // before the coordinator is destroyed
//
// A gRPC client uses the same order of calls on v1::BlobService and v1::JobService.
//
// Errors: kNotFound for an id that is not known (also: after a purge), kInvalidArgument for
// arguments that the header of proto/job.h or proto/convert.h forbids, kUnavailable while the store
// cannot be written or the coordinator drains. All methods are thread-safe; those that wait say so.
#pragma once

#include <chrono>
#include <cstdint>
#include <functional>
#include <memory>
#include <optional>
#include <span>
#include <string>
#include <string_view>
#include <vector>

#include "core/base/blob.h"
#include "core/base/clock.h"
#include "core/base/hash.h"
#include "core/base/status.h"
#include "proto/job.h"
#include "server/blob_writer.h"
#include "server/loss_cause.h"

namespace farpoint {

class SceneBaker;  // server/scene_baker.h

// One frame of a job, for people who watch.
struct TileView {
  enum class State : uint8_t { kQueued, kLeased, kCommitted, kFailed };
  PixelRect rect;
  State state = State::kQueued;
  // Of a committed tile, of all attempts the one that counted:
  double seconds = 0;                                   // thread-seconds of all stages
  uint64_t receivers = 0, clusters = 0, cut_nodes = 0;  // 0: none, or not counted
  std::string worker;     // who rendered it, or is at it; may be empty
  float fraction = 0;     // [0, 1] of a leased one
  uint32_t failures = 0;  // of one that is not committed
};
struct JobLogEntry {
  LogLine line;
  int64_t unix_ms = 0;  // 0: not known
};
struct JobView {
  JobStatus status;
  FilmSpec film;
  uint32_t frame_index = 0, first_tile = 0;  // of tiles, in the job
  int32_t frame_number = 0;
  std::vector<TileView> tiles;
  std::vector<JobLogEntry> log;  // the last kMaxViewedLogLines
};
inline constexpr uint32_t kMaxViewedLogLines = 100;

class CoordinatorApi {
 public:
  virtual ~CoordinatorApi() = default;

  // --- Blobs ---
  virtual absl::StatusOr<std::vector<Digest>> FindMissing(std::span<const Digest> digests) = 0;
  // Keeps `blob` under `digest`, which must be its hash (kDataLoss). Harmless if it is there.
  virtual absl::Status PutBlob(const Digest& digest, const Blob& blob) = 0;
  // The same in pieces. kResourceExhausted if `size_bytes` is over the limit.
  virtual absl::StatusOr<std::unique_ptr<BlobWriter>> StartPut(const Digest& digest,
                                                               uint64_t size_bytes) = 0;
  // Its hash was verified. kNotFound; kDataLoss if the store was damaged (the blob is dropped, so
  // that it is found missing and sent again).
  virtual absl::StatusOr<Blob> GetBlob(const Digest& digest) = 0;

  // --- Jobs ---
  // `submission_id`: a repeated one (not empty) answers with the same job, so that a client may
  // submit again after a lost answer. kFailedPrecondition lists blobs of the asset that are
  // missing, kNotFound names a job of spec.after that is not known. The job is durable when this
  // returns.
  virtual absl::StatusOr<JobId> Submit(const JobSpec& spec, const std::string& submission_id) = 0;
  virtual absl::StatusOr<JobStatus> Status(const JobId& job) = 0;
  virtual std::vector<JobStatus> Jobs() = 0;  // in the order of submission
  virtual std::vector<WorkerStatus> Workers() = 0;
  // Harmless if the job has ended.
  virtual absl::Status Cancel(const JobId& job) = 0;
  // A paused job leases no tile and starts no bake; what is in work is finished and kept. Durable
  // when it returns. Harmless if the job is paused already, or has ended.
  virtual absl::Status Pause(const JobId& job) = 0;
  virtual absl::Status Resume(const JobId& job) = 0;
  // kInvalidArgument beyond kMinPriority..kMaxPriority. Decides about the next lease and bake.
  virtual absl::Status SetPriority(const JobId& job, int32_t priority) = 0;
  // A failed or cancelled job goes on where it was: committed tiles stay, failures are forgotten, a
  // pause too. `all`: committed tiles are rendered again, also those of a job that is done or in
  // work. A job in work only forgets its failures. kFailedPrecondition if a job that this one waits
  // for has not ended well: requeue that one first.
  virtual absl::Status Requeue(const JobId& job, bool all) = 0;
  virtual absl::StatusOr<Explanation> Explain(const JobId& job) = 0;
  // Events with sequence > `after_sequence`, in order, at most 256. Waits up to `wait` for one; if
  // none comes, a single passing report of progress (sequence 0). The last event of a job that has
  // ended is its final JobState; asking for what follows it answers with an empty list at once. A
  // job that is requeued goes on with the next number.
  virtual absl::StatusOr<std::vector<JobEvent>> NextEvents(const JobId& job,
                                                           uint64_t after_sequence,
                                                           std::chrono::milliseconds wait) = 0;
  virtual absl::StatusOr<JobInfo> FetchInfo(const JobId& job) = 0;
  // kInvalidArgument beyond the job's frames. Reads as many rows of the store as the frame has
  // tiles.
  virtual absl::StatusOr<JobView> View(const JobId& job, uint32_t frame_index) = 0;
  // kFailedPrecondition if the tile is not committed.
  virtual absl::StatusOr<TileData> FetchTile(const JobId& job, uint32_t tile) = 0;

  // --- Workers ---
  // kFailedPrecondition if the versions differ.
  virtual absl::StatusOr<WorkerWelcome> Register(const WorkerHello& hello) = 0;
  // Waits up to `wait` for a tile. kNotFound: register again.
  virtual absl::StatusOr<std::optional<TileWork>> Lease(const WorkerId& worker,
                                                        std::chrono::milliseconds wait) = 0;
  // For one thread that asks for many workers, by Lease without a wait: returns when something has
  // changed since it returned `seen` (0: at first), after `wait`, or when the coordinator ends.
  virtual uint64_t AwaitWork(uint64_t seen, std::chrono::milliseconds wait) = 0;
  virtual absl::StatusOr<RenewAnswer> Renew(const WorkerId& worker, const LeaseId& lease,
                                            const LeaseProgress& progress) = 0;
  // When it answers `accepted`, the tile is durable. A refusal (lease lost, another copy was
  // faster, hash or contents wrong) is an answer, not an error.
  virtual absl::StatusOr<ReturnAnswer> Return(const WorkerId& worker, const TileResult& result) = 0;
  // `given_back`: nothing is wrong, the worker leaves; else `error` says what went wrong.
  virtual absl::Status ReportFailure(const WorkerId& worker, const LeaseId& lease, bool given_back,
                                     const absl::Status& error) = 0;
  virtual absl::Status Leave(const WorkerId& worker) = 0;
  // The worker has opened, and lost, the connection that tells that it lives. Detached takes what
  // Attached returned; a worker that does not come back within reconnect_time is taken for lost.
  // Attached: kNotFound as Lease.
  virtual absl::StatusOr<uint64_t> Attached(const WorkerId& worker) = 0;
  virtual void Detached(const WorkerId& worker, uint64_t connection) = 0;
};

// What a caller may want to log. From any thread; the callee must not call the coordinator.
struct CoordinatorLogEntry {
  using Level = LogLevel;
  Level level = Level::kInfo;
  std::string text;
  JobId job;  // may be empty
  std::optional<uint32_t> tile;
  uint32_t attempt = 0;                   // 0: none
  WorkerId worker;                        // may be empty
  bool detail = false;                    // of each lease: for whoever wants to see all
  LossCause lost = LossCause::kReported;  // else: a lease was lost by this
};

struct CoordinatorOptions {
  // Everything that must survive lies below it; created if absent. Empty: all in memory.
  std::string store_directory;
  // Where blobs lie, if not in the folder `blobs` of the store: a site's shared file system, from
  // which workers take them (worker/blob_cache.h). Ignored without a store.
  std::string blob_directory;
  std::shared_ptr<SceneBaker> baker;  // required
  JobLimits limits;                   // of every job
  uint64_t max_blob_bytes = uint64_t{1} << 36;

  // A lease is lost when nothing was heard of its worker for silence_time, when the connection to
  // it broke and did not come back within reconnect_time, when its progress stood still for
  // lease_time, or when a thread that renders uses no processor for stall_time.
  std::chrono::milliseconds silence_time{4000};
  std::chrono::milliseconds reconnect_time{500};
  std::chrono::milliseconds lease_time{120000};
  std::chrono::milliseconds stall_time{3000};
  std::chrono::milliseconds heartbeat{1000};  // how often workers shall renew
  // A tile is copied to an idle worker when it takes this many times the job's median, and at
  // least speculate_after; at once where its worker is known to be slow.
  double speculate_factor = 3;
  std::chrono::milliseconds speculate_after{1000};
  uint32_t max_dead_workers = 3;     // different workers that a tile may take down
  uint32_t max_tile_failures = 6;    // by whomever
  uint32_t max_worker_failures = 3;  // in a row, then the worker is set aside for …
  std::chrono::milliseconds set_aside_time{60000};
  // The share of committed tiles that another worker renders again in secret, 0 to 1. A job is not
  // done before its audits are; where there is no other worker, there are none.
  double audit_fraction = 0;
  std::chrono::milliseconds decide_time{60000};  // how long a disagreement waits for a third worker
  uint64_t audit_seed = 0;                       // 0: random
  // Jobs that ended so long ago are purged with their tiles, and blobs that no job needs any more.
  std::chrono::hours retention{24 * 7};

  std::function<void(const CoordinatorLogEntry&)> log;  // may be empty
  std::shared_ptr<const Clock> clock;                   // none: SteadyClock
  // For tests: see StoreHook (server/job_store.h).
  std::function<void(std::string_view point)> store_hook;
};

class Coordinator : public CoordinatorApi {
 public:
  // Opens the store and takes up where the last process left off: what was committed stays, all
  // other tiles of unfinished jobs are queued again. kFailedPrecondition if another process has the
  // store or a newer version wrote it; kDataLoss, kUnavailable name the file.
  static absl::StatusOr<std::unique_ptr<Coordinator>> Open(CoordinatorOptions options);

  // Refuses new leases and submissions (kUnavailable), lets renewals and returns through. Wakes all
  // who wait.
  virtual void Drain() = 0;
  // Leases that workers hold now.
  virtual uint32_t ActiveLeases() = 0;
};

}  // namespace farpoint

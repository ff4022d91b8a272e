#include "server/coordinator.h"

#include <algorithm>
#include <atomic>
#include <cmath>
#include <condition_variable>
#include <map>
#include <mutex>
#include <random>
#include <set>
#include <thread>
#include <utility>

#include "core/base/check.h"
#include "core/image/film.h"
#include "server/blob_store.h"
#include "server/explanation.h"
#include "server/frame_bakery.h"
#include "server/job_store.h"
#include "server/scene_baker.h"
#include "server/tile_scheduler.h"

namespace farpoint {

namespace {

// More would make the lists of tiles that travel with each job's description large.
constexpr size_t kMaxTilesPerJob = size_t{1} << 18;
constexpr size_t kMaxMissingNamed = 5;
constexpr uint32_t kMaxEventsPerCall = 256;
constexpr std::chrono::milliseconds kMaxWait{30000};
// The frames of a job are baked ahead of its tiles, but no further than this while there are tiles
// enough for every worker: what is baked takes room.
constexpr uint32_t kFramesAhead = 8;
constexpr uint32_t kTilesAheadPerWorker = 4;
constexpr size_t kSlowestTiles = 3;
// So much of a job's tiles is hashed when the coordinator starts, so that it starts soon.
constexpr uint64_t kReadAtRestart = uint64_t{128} << 20;
constexpr uint32_t kProblems = 5;
// The usual part of a tile's cost that its neighbours share, with the records of adaptive clusters
// and without; from recorded commits of seven scenes (docs/decisions/0030).
constexpr double kSharedByNeighbours = 0.25, kSharedElsewhere = 0.04;

int64_t UnixMs() {
  return std::chrono::duration_cast<std::chrono::milliseconds>(
             std::chrono::system_clock::now().time_since_epoch())
      .count();
}

std::string RandomHex(int digits) {
  static constexpr char kDigits[] = "0123456789abcdef";
  std::random_device random;
  std::string text;
  for (int i = 0; i < digits; ++i) text += kDigits[random() % 16];
  return text;
}

// Progress is reported by the block: no lease may be shorter than what one may take, estimated
// generously on one slow thread (20 µs a path, 2 ms a receiver). irrcache's first tile makes the
// cache of the frame, in steps of a block's share. At most a day.
std::chrono::milliseconds BlockTime(const RenderSettings& settings, const FilmSpec& film) {
  const double receivers = 1.0 * kBlockSize * kBlockSize * settings.spp;
  double seconds =
      receivers * (settings.integrator == Integrator::kPt ? 2e-5 * settings.paths : 2e-3);
  if (settings.integrator == Integrator::kIrrcache) {
    const double blocks = std::pow(static_cast<double>(settings.tile_px) / kBlockSize, 2);
    seconds += 2e-3 * film.width * film.height / blocks;
  }
  return std::chrono::milliseconds(static_cast<int64_t>(1000 * std::min(seconds, 86400.0)));
}

// A step (core/base/pulse.h) is one receiver or record: its paths and shadow rays, each generously
// 20 µs, and twenty times of all that.
std::chrono::milliseconds StepTime(const RenderSettings& settings) {
  const double rays = 1.0 * settings.paths + settings.light_samples;
  return std::chrono::milliseconds(
      static_cast<int64_t>(1000 * std::min(20 * (20e-6 * rays + 0.01), 86400.0)));
}

SchedulerOptions SchedulerOptionsOf(const CoordinatorOptions& options) {
  SchedulerOptions s;
  s.silence_time = options.silence_time;
  s.reconnect_time = options.reconnect_time;
  s.stall_time = options.stall_time;
  s.lease_time = options.lease_time;
  s.speculate_factor = options.speculate_factor;
  s.speculate_after = options.speculate_after;
  s.max_dead_workers = options.max_dead_workers;
  s.max_tile_failures = options.max_tile_failures;
  s.max_worker_failures = options.max_worker_failures;
  s.set_aside_time = options.set_aside_time;
  s.audit_fraction = options.audit_fraction;
  s.decide_time = options.decide_time;
  s.audit_seed = options.audit_seed;
  return s;
}

class CoordinatorImpl final : public Coordinator {
 public:
  CoordinatorImpl(CoordinatorOptions options, std::unique_ptr<BlobStore> blobs,
                  std::unique_ptr<JobStore> store)
      : options_(std::move(options)),
        clock_(options_.clock ? options_.clock : std::make_shared<SteadyClock>()),
        blobs_(std::move(blobs)),
        store_(std::move(store)),
        frame_bakery_(options_.baker, *blobs_, *store_),
        scheduler_(SchedulerOptionsOf(options_), *clock_) {}

  ~CoordinatorImpl() override {
    {
      std::lock_guard lock(mutex_);
      stopping_ = true;
      draining_ = true;
      if (bake_in_work_) *bake_in_work_->stop = true;
    }
    NotifyAll();
    if (ticker_.joinable()) ticker_.join();
    if (bakery_.joinable()) bakery_.join();
  }

  absl::Status Recover() {
    FP_ASSIGN_OR_RETURN(std::vector<StoredJob> stored, store_->LoadJobs());
    for (StoredJob& one : stored) FP_RETURN_IF_ERROR(RecoverJob(std::move(one)));
    FailOrphans();
    PurgeOld();
    ticker_ = std::thread([this] { TickLoop(); });
    bakery_ = std::thread([this] { BakeLoop(); });
    return absl::OkStatus();
  }

  // --- Blobs ---

  absl::StatusOr<std::vector<Digest>> FindMissing(std::span<const Digest> digests) override {
    std::vector<Digest> missing;
    for (const Digest& digest : digests) {
      if (!blobs_->Contains(digest)) missing.push_back(digest);
    }
    return missing;
  }
  absl::Status PutBlob(const Digest& digest, const Blob& blob) override {
    return blobs_->Put(digest, blob);
  }
  absl::StatusOr<std::unique_ptr<BlobWriter>> StartPut(const Digest& digest,
                                                       uint64_t size_bytes) override {
    return blobs_->StartPut(digest, size_bytes);
  }
  absl::StatusOr<Blob> GetBlob(const Digest& digest) override { return blobs_->Get(digest); }

  // --- Jobs ---

  absl::StatusOr<JobId> Submit(const JobSpec& given, const std::string& submission_id) override {
    JobSpec spec = given;
    spec.limits = Smaller(spec.limits, options_.limits);
    FP_RETURN_IF_ERROR(ValidateJob(spec));
    std::vector<PixelRect> tiles = TilesOf(spec.film, static_cast<int>(spec.settings.tile_px));
    if (tiles.size() * spec.frame_count() > kMaxTilesPerJob) {
      return absl::InvalidArgumentError(
          "settings.tile_px is " + std::to_string(spec.settings.tile_px) + ", which makes " +
          std::to_string(tiles.size()) + " tiles" +
          (spec.frames.empty() ? std::string()
                               : " in each of " + std::to_string(spec.frame_count()) + " frames") +
          "; a job has at most " + std::to_string(kMaxTilesPerJob) +
          ", ask for larger ones or for fewer frames");
    }
    if (submission_id.size() > 200) {
      return absl::InvalidArgumentError("submission_id is longer than 200 bytes");
    }
    std::string missing;
    size_t missing_count = 0;
    for (const auto& [uri, digest] : spec.asset_files) {
      if (blobs_->Contains(digest)) continue;
      if (++missing_count <= kMaxMissingNamed) missing += " '" + uri + "'";
    }
    if (missing_count > 0) {
      return absl::FailedPreconditionError("blobs of " + std::to_string(missing_count) +
                                           " files of the asset are missing:" + missing +
                                           "; send them first");
    }

    std::unique_lock lock(mutex_);
    if (draining_) return Draining();
    FP_ASSIGN_OR_RETURN(const std::optional<JobId> known, store_->FindSubmission(submission_id));
    if (known) return *known;
    for (const JobId& id : spec.after) {
      if (!jobs_.contains(id)) {
        return absl::NotFoundError("after: job '" + id.value +
                                   "' is not known; `farpoint status` lists the jobs");
      }
    }
    auto job = std::make_shared<Job>();
    do {
      job->stored.id.value = RandomHex(8);
    } while (jobs_.contains(job->stored.id));
    job->stored.spec = std::move(spec);
    job->stored.submitted_unix_ms = UnixMs();
    job->tiles = std::move(tiles);
    FP_RETURN_IF_ERROR(store_->InsertJob(job->stored, submission_id));
    const JobId id = job->stored.id;
    jobs_.emplace(id, job);
    TakeUp(*job, {});
    Log(LogLevel::kInfo, "submitted", id);
    if (!job->stored.spec.after.empty()) FailOrphans();
    lock.unlock();
    NotifyAll();
    return id;
  }

  absl::StatusOr<JobStatus> Status(const JobId& id) override {
    std::lock_guard lock(mutex_);
    FP_ASSIGN_OR_RETURN(const std::shared_ptr<Job> job, Find(id));
    return StatusOf(*job);
  }

  std::vector<JobStatus> Jobs() override {
    std::lock_guard lock(mutex_);
    std::vector<const Job*> ordered;
    for (const auto& [id, job] : jobs_) ordered.push_back(job.get());
    std::sort(ordered.begin(), ordered.end(),
              [](const Job* a, const Job* b) { return a->stored.number < b->stored.number; });
    std::vector<JobStatus> all;
    for (const Job* job : ordered) all.push_back(StatusOf(*job));
    return all;
  }

  std::vector<WorkerStatus> Workers() override {
    std::lock_guard lock(mutex_);
    return scheduler_.Workers();
  }

  absl::Status Cancel(const JobId& id) override {
    std::unique_lock lock(mutex_);
    FP_ASSIGN_OR_RETURN(const std::shared_ptr<Job> job, Find(id));
    if (IsFinal(job->stored.state)) return absl::OkStatus();
    FP_RETURN_IF_ERROR(store_->SetState(id, JobState::kCancelled, absl::OkStatus()));
    Log(LogLevel::kInfo, "cancelled", id);
    EndJob(*job, JobState::kCancelled, absl::OkStatus());
    lock.unlock();
    NotifyAll();
    return absl::OkStatus();
  }

  absl::Status Pause(const JobId& id) override { return SetPaused(id, true); }
  absl::Status Resume(const JobId& id) override { return SetPaused(id, false); }

  absl::Status SetPriority(const JobId& id, int32_t priority) override {
    if (priority < kMinPriority || priority > kMaxPriority) {
      return absl::InvalidArgumentError("priority is " + std::to_string(priority) +
                                        "; allowed: " + std::to_string(kMinPriority) + " to " +
                                        std::to_string(kMaxPriority));
    }
    std::unique_lock lock(mutex_);
    FP_ASSIGN_OR_RETURN(const std::shared_ptr<Job> job, Find(id));
    if (job->stored.spec.priority == priority) return absl::OkStatus();
    FP_RETURN_IF_ERROR(store_->SetPriority(id, priority));
    job->stored.spec.priority = priority;
    scheduler_.SetPriority(id, priority);
    if (!IsFinal(job->stored.state)) {
      JobLog(*job, {.text = "the priority is " + std::to_string(priority) + " now"});
    }
    lock.unlock();
    NotifyAll();
    return absl::OkStatus();
  }

  absl::Status Requeue(const JobId& id, bool all) override {
    // One at a time: a job that has ended stays so until this one takes it up.
    std::lock_guard requeue(requeue_mutex_);
    bool had_ended = false;
    {
      std::lock_guard lock(mutex_);
      FP_ASSIGN_OR_RETURN(const std::shared_ptr<Job> job, Find(id));
      if (IsDoneWell(*job) && !all) return absl::OkStatus();
      had_ended = IsFinal(job->stored.state);
    }
    // Reads every tile of the job: without the lock.
    if (had_ended && !all) FP_RETURN_IF_ERROR(store_->DropDamagedTiles(id).status());
    std::unique_lock lock(mutex_);
    if (draining_) return Draining();
    FP_ASSIGN_OR_RETURN(const std::shared_ptr<Job> job, Find(id));
    StoredJob& stored = job->stored;
    const bool ended = IsFinal(stored.state);
    if (!all && (IsDoneWell(*job) || ended != had_ended)) return absl::OkStatus();
    if (!ended && !all) {
      scheduler_.ForgetFailures(id);
      JobLog(*job, {.text = "requeued: earlier failures are forgotten"});
    } else {
      if (ended) FP_RETURN_IF_ERROR(MayStartAgain(*job));
      FP_RETURN_IF_ERROR(store_->Requeue(id, all));
      if (ended) {
        stored.error = absl::OkStatus();
        stored.paused = false;
        stored.state = JobState::kQueued;
      } else {
        RememberCounters(*job);
        scheduler_.RemoveJob(id);
      }
      if (all) stored.fingerprint = {};
      stored.suspect_tiles = 0;
      FP_ASSIGN_OR_RETURN(const std::vector<StoredTile> committed, store_->Tiles(id));
      ++job->changes;
      TakeUp(*job, committed);
      JobLog(*job, {.text = all ? "requeued with all tiles" : "requeued"});
      FinishIfDone(*job);
    }
    lock.unlock();
    NotifyAll();
    return absl::OkStatus();
  }

  absl::StatusOr<Explanation> Explain(const JobId& id) override {
    ExplanationFacts facts;
    {
      std::lock_guard lock(mutex_);
      FP_ASSIGN_OR_RETURN(const std::shared_ptr<Job> job, Find(id));
      facts = FactsOf(*job);
    }
    FP_ASSIGN_OR_RETURN(facts.slowest, store_->SlowestTiles(id, kSlowestTiles));
    FP_ASSIGN_OR_RETURN(facts.problems, store_->LastLogLines(id, LogLevel::kWarning, kProblems));
    FP_ASSIGN_OR_RETURN(facts.bake_stats, store_->BakeStats(id));
    FP_ASSIGN_OR_RETURN(facts.tile_stats, store_->TileStats(id));
    return farpoint::Explain(facts);
  }

  absl::StatusOr<std::vector<JobEvent>> NextEvents(const JobId& id, uint64_t after_sequence,
                                                   std::chrono::milliseconds wait) override {
    const auto deadline = std::chrono::steady_clock::now() + std::min(wait, kMaxWait);
    for (;;) {
      std::shared_ptr<Job> job;
      uint64_t seen = 0;
      bool ended = false;
      {
        std::lock_guard lock(mutex_);
        FP_ASSIGN_OR_RETURN(job, Find(id));
        seen = job->changes;
        ended = IsFinal(job->stored.state);
      }
      FP_ASSIGN_OR_RETURN(const std::vector<StoredEvent> stored,
                          store_->Events(id, after_sequence, kMaxEventsPerCall));
      std::unique_lock lock(mutex_);
      if (!stored.empty()) {
        std::vector<JobEvent> events;
        const JobStatus status = StatusOf(*job);
        for (const StoredEvent& event : stored) {
          events.push_back({.sequence = event.sequence,
                            .body = event.body,
                            .status = status,
                            .unix_ms = event.unix_ms});
        }
        return events;
      }
      if (ended) return std::vector<JobEvent>{};
      const bool woken = events_.wait_until(
          lock, deadline, [&] { return stopping_ || draining_ || job->changes != seen; });
      if (woken && job->changes != seen) continue;
      if (woken) return Draining();
      return std::vector<JobEvent>{
          {.sequence = 0, .body = {}, .status = StatusOf(*job), .unix_ms = UnixMs()}};
    }
  }

  absl::StatusOr<JobInfo> FetchInfo(const JobId& id) override {
    JobInfo info;
    {
      std::lock_guard lock(mutex_);
      FP_ASSIGN_OR_RETURN(const std::shared_ptr<Job> job, Find(id));
      info.status = StatusOf(*job);
      info.spec = job->stored.spec;
      info.notes = job->stored.notes;
      info.frames.resize(info.spec.frame_count());
      for (uint32_t i = 0; i < info.frames.size(); ++i) {
        info.frames[i].number = info.spec.frame_number(i);
      }
      for (const auto& [index, baked] : job->stored.frames) {
        FrameInfo& frame = info.frames[index];
        frame.baked = true;
        frame.camera = MatricesOf(baked.camera, info.spec.film);
        frame.blobs = baked.blobs;
      }
      if (!job->stored.frames.empty()) {
        info.tiles.reserve(job->total_tiles());
        for (uint32_t i = 0; i < info.frames.size(); ++i) {
          for (const PixelRect& rect : job->tiles) info.tiles.push_back({.rect = rect, .frame = i});
        }
      }
    }
    info.version = FARPOINT_VERSION;
    if (info.tiles.empty()) return info;
    FP_ASSIGN_OR_RETURN(const std::vector<StoredTile> committed, store_->Tiles(id));
    for (const StoredTile& tile : committed) {
      if (tile.tile < info.tiles.size()) info.tiles[tile.tile].sha256 = tile.sha256;
    }
    FP_ASSIGN_OR_RETURN(info.stats, store_->BakeStats(id));
    FP_ASSIGN_OR_RETURN(const Stats stats, store_->TileStats(id));
    info.stats += stats;
    return info;
  }

  absl::StatusOr<JobView> View(const JobId& id, uint32_t frame_index) override {
    JobView view{.frame_index = frame_index};
    JobReport report;
    {
      std::lock_guard lock(mutex_);
      FP_ASSIGN_OR_RETURN(const std::shared_ptr<Job> job, Find(id));
      const JobSpec& spec = job->stored.spec;
      if (frame_index >= spec.frame_count()) {
        return absl::InvalidArgumentError(
            "frame index " + std::to_string(frame_index) + " is not among the " +
            std::to_string(spec.frame_count()) + " of job " + id.value);
      }
      view.status = StatusOf(*job);
      view.film = spec.film;
      view.frame_number = spec.frame_number(frame_index);
      view.first_tile = frame_index * static_cast<uint32_t>(job->tiles.size());
      view.tiles.resize(job->tiles.size());
      for (size_t i = 0; i < view.tiles.size(); ++i) view.tiles[i].rect = job->tiles[i];
      report = scheduler_.Report(id);
    }
    const auto tile_of = [&view](uint32_t tile) -> TileView* {
      const uint32_t index = tile - view.first_tile;  // beyond all where tile is before the first
      return index < view.tiles.size() ? &view.tiles[index] : nullptr;
    };
    for (const TroubledTile& troubled : report.troubled) {
      if (TileView* const tile = tile_of(troubled.tile)) {
        tile->failures = troubled.failures;
        if (troubled.set_aside) tile->state = TileView::State::kFailed;
      }
    }
    for (const TileInWork& work : report.in_work) {
      if (TileView* const tile = tile_of(work.grant.tile)) {
        tile->state = TileView::State::kLeased;
        tile->worker = work.worker_name;
        tile->fraction = std::max(tile->fraction, work.fraction);
      }
    }
    FP_ASSIGN_OR_RETURN(
        const std::vector<StoredTileStats> committed,
        store_->TileStatsOf(id, view.first_tile, static_cast<uint32_t>(view.tiles.size())));
    for (const StoredTileStats& stored : committed) {
      TileView* const tile = tile_of(stored.tile);
      if (tile == nullptr) continue;
      const auto count = [&](const char* name) {
        const auto at = stored.stats.counts.find(name);
        return at == stored.stats.counts.end() ? uint64_t{0} : at->second;
      };
      tile->state = TileView::State::kCommitted;
      tile->worker = stored.worker;
      for (const double seconds : stored.stats.seconds) tile->seconds += seconds;
      tile->receivers = count("receivers");
      tile->clusters = count("clusters");
      tile->cut_nodes = count("cut_nodes");
    }
    FP_ASSIGN_OR_RETURN(const std::vector<StoredEvent> lines,
                        store_->LastLogLines(id, LogLevel::kInfo, kMaxViewedLogLines));
    for (const StoredEvent& event : lines) {
      if (const auto* line = std::get_if<LogLine>(&event.body)) {
        view.log.push_back({.line = *line, .unix_ms = event.unix_ms});
      }
    }
    return view;
  }

  absl::StatusOr<TileData> FetchTile(const JobId& id, uint32_t tile) override {
    {
      std::lock_guard lock(mutex_);
      FP_ASSIGN_OR_RETURN(const std::shared_ptr<Job> job, Find(id));
      if (tile >= job->total_tiles()) {
        return absl::InvalidArgumentError("tile " + std::to_string(tile) + " is not among the " +
                                          std::to_string(job->total_tiles()) + " of job " +
                                          id.value);
      }
    }
    absl::StatusOr<TileData> data = store_->ReadTile(id, tile);
    if (absl::IsNotFound(data.status())) {
      return absl::FailedPreconditionError(data.status().message());
    }
    return data;
  }

  // --- Workers ---

  absl::StatusOr<WorkerWelcome> Register(const WorkerHello& hello) override {
    if (hello.version != FARPOINT_VERSION) {
      return absl::FailedPreconditionError("the worker is farpoint " + hello.version +
                                           ", this coordinator " FARPOINT_VERSION
                                           "; their pixels may differ, use one version");
    }
    std::lock_guard lock(mutex_);
    if (draining_) return Draining();
    if (scheduler_.IsConvicted(hello)) {
      return absl::FailedPreconditionError(
          "worker '" + (hello.certified_as.empty() ? hello.name : hello.certified_as) +
          "' returned wrong pixels and gets no tiles any more; test its memory and processor, then "
          "restart the coordinator, which forgets it, or give the machine another " +
          (hello.certified_as.empty() ? "--name" : "certificate"));
    }
    WorkerWelcome welcome;
    welcome.id.value = RandomHex(16);
    welcome.heartbeat = options_.heartbeat;
    welcome.max_wait = std::chrono::milliseconds(10000);
    scheduler_.AddWorker(welcome.id, hello);
    LogWorker(LogLevel::kInfo,
              "registered '" + hello.name + "', " + std::to_string(hello.threads) +
                  (hello.threads == 1 ? " thread" : " threads"),
              welcome.id);
    return welcome;
  }

  absl::StatusOr<std::optional<TileWork>> Lease(const WorkerId& worker,
                                                std::chrono::milliseconds wait) override {
    const auto deadline = std::chrono::steady_clock::now() + std::min(wait, kMaxWait);
    std::unique_lock lock(mutex_);
    for (;;) {
      if (draining_) return Draining();
      if (!scheduler_.HasWorker(worker)) return UnknownWorker(worker);
      if (const std::optional<LeaseGrant> grant = scheduler_.Lease(worker)) {
        const Job& job = *jobs_.at(grant->job);
        LogLease(LogLevel::kInfo, grant->speculative ? "copied" : "leased", *grant,
                 /*detail=*/true);
        TileWork work;
        work.lease = grant->lease;
        work.attempt = grant->attempt;
        work.job = grant->job;
        work.tile = grant->tile;
        work.rect = job.tiles[grant->tile % job.tiles.size()];
        work.frame_index = job.frame_of(grant->tile);
        const StoredFrame& frame = job.stored.frames.at(work.frame_index);
        work.frame = {.camera = frame.camera,
                      .film = job.stored.spec.film,
                      .settings = job.stored.spec.settings};
        work.blobs = frame.blobs;
        work.careful = grant->careful;
        work.lease_time = std::max(options_.lease_time,
                                   BlockTime(job.stored.spec.settings, job.stored.spec.film));
        return work;
      }
      const auto now = std::chrono::steady_clock::now();
      if (now >= deadline) return std::nullopt;
      // Tiles become slow and workers come back from being set aside without a notification.
      work_.wait_until(lock, std::min(deadline, now + std::chrono::milliseconds(500)));
    }
  }

  uint64_t AwaitWork(uint64_t seen, std::chrono::milliseconds wait) override {
    std::unique_lock lock(wakes_mutex_);
    woken_.wait_for(lock, wait, [&] { return wakes_ != seen; });
    return wakes_;
  }

  absl::StatusOr<RenewAnswer> Renew(const WorkerId& worker, const LeaseId& lease,
                                    const LeaseProgress& progress) override {
    std::lock_guard lock(mutex_);
    if (!scheduler_.HasWorker(worker)) return UnknownWorker(worker);
    return scheduler_.Renew(worker, lease, progress);
  }

  absl::StatusOr<ReturnAnswer> Return(const WorkerId& worker, const TileResult& result) override {
    LeaseGrant grant;
    Digest fingerprint;
    std::string worker_name;
    PixelRect rect;
    std::vector<Layer> layers;
    {
      std::lock_guard lock(mutex_);
      if (!scheduler_.HasWorker(worker)) return UnknownWorker(worker);
      const absl::StatusOr<LeaseGrant> begun =
          scheduler_.BeginCommit(worker, result.lease, result.attempt);
      if (!begun.ok()) {
        const std::string reason(begun.status().message());
        LogWorker(LogLevel::kWarning,
                  "refused a result of lease " + result.lease.value + ": " + reason, worker);
        const auto at = jobs_.find(scheduler_.JobOf(result.lease));
        if (at != jobs_.end() && !IsFinal(at->second->stored.state)) {
          JobLog(*at->second, {.level = LogLevel::kWarning,
                               .text = "a result was refused: " + reason,
                               .worker = WorkerName(worker)});
        }
        return ReturnAnswer{.accepted = false, .reason = reason};
      }
      grant = *begun;
      const Job& job = *jobs_.at(grant.job);
      rect = job.tiles[grant.tile % job.tiles.size()];
      layers = job.stored.spec.settings.layers;
      fingerprint = scheduler_.FindWorker(worker)->fingerprint;
      worker_name = WorkerName(worker);
    }

    // Reading and storing take their time: without the lock. The lease is pinned meanwhile.
    if (const absl::Status wrong = CheckResult(result, rect, layers); !wrong.ok()) {
      std::unique_lock lock(mutex_);
      HandleNews(scheduler_.RefuseResult(result.lease, std::string(wrong.message())));
      lock.unlock();
      NotifyAll();
      return ReturnAnswer{
          .accepted = false, .reason = std::string(wrong.message()), .damaged = true};
    }
    if (grant.audit) return ReturnAudit(grant, result);
    absl::Status stored =
        store_->CommitTile(grant.job, grant.tile, result, fingerprint, worker_name);

    std::unique_lock lock(mutex_);
    // A commit that failed may have reached the disk all the same. But a row of a result that no
    // longer counts is dropped, under this lock: whoever relies on one has to see it here.
    if (absl::IsAlreadyExists(stored) && store_->HasTile(grant.job, grant.tile, result.sha256)) {
      stored = absl::OkStatus();
    }
    const bool counted = scheduler_.FinishCommit(result.lease, stored.ok(), result.sha256);
    bool more_work = !stored.ok();
    const auto at = jobs_.find(grant.job);
    if (stored.ok() && at != jobs_.end()) {
      Job& job = *at->second;
      ++job.changes;
      if (counted) {
        if (job.stored.fingerprint.empty()) job.stored.fingerprint = fingerprint;
        more_work = CountCommitted(job, grant.tile);
        FinishIfDone(job);
      } else if (!IsFinal(job.stored.state)) {
        // The job was taken up anew while this was stored, or the worker was found to return wrong
        // pixels: the tile is queued, or was committed by another one since.
        if (!scheduler_.IsCommitted(grant.job, grant.tile)) {
          stored = store_->DropTiles(grant.job, {grant.tile});
        }
        if (stored.ok()) stored = absl::FailedPreconditionError("the lease has ended meanwhile");
        more_work = true;
      }
    }
    if (stored.ok()) {
      LogLease(LogLevel::kInfo, "committed", grant);
    } else {
      LogLease(LogLevel::kError, "not committed: " + stored.ToString(), grant);
    }
    lock.unlock();
    // Workers that wait have nothing from a tile that is done: with hundreds of them this matters.
    events_.notify_all();
    if (more_work) NotifyAll();
    if (stored.ok()) return ReturnAnswer{.accepted = true};
    if (absl::IsFailedPrecondition(stored) || absl::IsNotFound(stored)) {
      return ReturnAnswer{.accepted = false, .reason = std::string(stored.message())};
    }
    return absl::UnavailableError(stored.message());
  }

  absl::Status ReportFailure(const WorkerId& worker, const LeaseId& lease, bool given_back,
                             const absl::Status& error) override {
    std::unique_lock lock(mutex_);
    if (!scheduler_.HasWorker(worker)) return UnknownWorker(worker);
    if (!given_back && error.ok()) {
      return absl::InvalidArgumentError("a failure was reported without an error");
    }
    if (given_back) {
      const std::optional<LeaseGrant> grant = scheduler_.FindLease(lease);
      if (grant && grant->worker == worker) {
        JobLog(*jobs_.at(grant->job), {.text = "given back",
                                       .tile = grant->tile,
                                       .attempt = grant->attempt,
                                       .worker = WorkerName(worker)});
      }
    }
    HandleNews(scheduler_.ReportFailure(worker, lease, given_back, error));
    lock.unlock();
    NotifyAll();
    return absl::OkStatus();
  }

  absl::Status Leave(const WorkerId& worker) override {
    std::unique_lock lock(mutex_);
    if (!scheduler_.HasWorker(worker)) return absl::OkStatus();
    scheduler_.RemoveWorker(worker);
    LogWorker(LogLevel::kInfo, "left", worker);
    lock.unlock();
    NotifyAll();
    return absl::OkStatus();
  }

  absl::StatusOr<uint64_t> Attached(const WorkerId& worker) override {
    std::lock_guard lock(mutex_);
    if (!scheduler_.HasWorker(worker)) return UnknownWorker(worker);
    return scheduler_.Connected(worker);
  }
  void Detached(const WorkerId& worker, uint64_t connection) override {
    std::lock_guard lock(mutex_);
    scheduler_.Disconnected(worker, connection);
  }

  void Drain() override {
    {
      std::lock_guard lock(mutex_);
      draining_ = true;
    }
    NotifyAll();
  }
  uint32_t ActiveLeases() override {
    std::lock_guard lock(mutex_);
    return scheduler_.ActiveLeases();
  }

 private:
  struct Job {
    StoredJob stored;
    std::vector<PixelRect> tiles;  // of one frame
    uint64_t changes = 1;          // grows with each event
    uint64_t life = 0;             // grows when it ends and when it is taken up again
    TileCounts final_counts;       // once the state is final
    // By frame:
    std::vector<uint32_t> committed;  // tiles
    std::vector<bool> ready;          // its tiles may be leased, or are all committed
    uint32_t frames_done = 0;
    uint32_t next_bake = 0;  // frames before it are ready
    bool begun = false;      // a frame was baked: it waits for no other job any more
    bool animated = false;   // its frames have blobs of their own

    uint32_t total_tiles() const {
      return static_cast<uint32_t>(tiles.size()) * stored.spec.frame_count();
    }
    uint32_t frame_of(uint32_t tile) const { return tile / static_cast<uint32_t>(tiles.size()); }
    bool has_frames_to_bake() const { return next_bake < ready.size(); }
  };
  // Held by the baking thread, looked at and stopped by others.
  struct BakeInWork {
    JobId job;
    uint32_t frame = 0;
    uint64_t life = 0;
    TimePoint since;
    std::shared_ptr<std::atomic<bool>> stop = std::make_shared<std::atomic<bool>>(false);
  };

  static absl::Status Draining() {
    return absl::UnavailableError("the coordinator is shutting down; try again later");
  }
  static absl::Status UnknownWorker(const WorkerId& worker) {
    return absl::NotFoundError("worker " + worker.value + " is not registered; register again");
  }

  void NotifyAll() {
    {
      std::lock_guard lock(wakes_mutex_);
      ++wakes_;
    }
    woken_.notify_all();
    work_.notify_all();
    events_.notify_all();
    bakes_.notify_all();
    stop_ticker_.notify_all();
  }

  // The result of an audit: compared, never stored. Without the lock.
  ReturnAnswer ReturnAudit(const LeaseGrant& grant, const TileResult& result) {
    std::unique_lock lock(mutex_);
    const AuditVerdict verdict = scheduler_.FinishAudit(grant.lease, result.sha256);
    if (!verdict.counted) return {.accepted = false, .reason = "the lease has ended"};
    LogLease(LogLevel::kInfo, "audited", grant);
    const auto at = jobs_.find(grant.job);
    if (at != jobs_.end() && verdict.disputed) {
      // Whoever takes the job up after a restart must not take the tile for a good one.
      MarkSuspect(grant.job, grant.tile, true);
      JobLog(*at->second,
             {.level = LogLevel::kWarning,
              .text = "an audit gave other pixels than the tile has: another worker is asked",
              .tile = grant.tile,
              .worker = WorkerName(grant.worker)});
    }
    if (at != jobs_.end() && verdict.agreed && !verdict.convicted.empty()) {
      MarkSuspect(grant.job, grant.tile, false);
    }
    for (const AuditVerdict::Convict& convict : verdict.convicted) {
      const std::string text =
          "worker '" + convict.name +
          "' returned pixels that two others did not: it is set aside for good, and its tiles are "
          "rendered again; test its memory and processor";
      LogWorker(LogLevel::kError, text, convict.id);
      for (const auto& [id, tiles] : verdict.reopened) {
        if (const auto job = jobs_.find(id); job != jobs_.end()) {
          JobLog(*job->second, {.level = LogLevel::kError, .text = text, .worker = convict.name});
        }
      }
    }
    for (const auto& [id, tiles] : verdict.reopened) {
      if (const auto job = jobs_.find(id); job != jobs_.end()) Reopen(*job->second, tiles);
    }
    for (const AuditVerdict::Convict& convict : verdict.convicted) SuspectDoneJobs(convict);
    if (at != jobs_.end()) FinishIfDone(*at->second);
    lock.unlock();
    NotifyAll();
    return {.accepted = true};
  }

  // --- All below need mutex_ unless they say otherwise ---

  // Nothing is left to be done for it, unless somebody asks for all tiles again.
  static bool IsDoneWell(const Job& job) {
    return job.stored.state == JobState::kDone && job.stored.suspect_tiles == 0;
  }

  void MarkSuspect(const JobId& job, uint32_t tile, bool suspect) {
    const absl::Status marked = store_->MarkSuspect(job, tile, suspect);
    if (!marked.ok()) Log(LogLevel::kError, "mark not stored: " + marked.ToString(), job);
  }

  // Jobs that are done keep what a worker returned that is convicted now: somebody has fetched the
  // image. They are told apart, and a requeue renders those tiles again.
  void SuspectDoneJobs(const AuditVerdict::Convict& convict) {
    const bool certificate = !convict.certified_as.empty();
    const absl::StatusOr<std::map<JobId, uint32_t>> marked =
        store_->MarkSuspects(certificate ? convict.certified_as : convict.name, certificate);
    if (!marked.ok()) {
      Log(LogLevel::kError, "marks not stored: " + marked.status().ToString(), {});
      return;
    }
    std::vector<JobLogLine> lines;
    for (const auto& [id, count] : *marked) {
      const auto at = jobs_.find(id);
      if (at == jobs_.end()) continue;
      at->second->stored.suspect_tiles += count;
      lines.push_back(
          {id,
           {.level = LogLevel::kError,
            .text = std::to_string(count) + " tiles of this job are of worker '" + convict.name +
                    "', which was found to return wrong pixels since; `farpoint "
                    "requeue` renders them again",
            .worker = convict.name}});
      Log(LogLevel::kError, lines.back().line.text, id);
    }
    AppendLogs(lines);
  }

  // Committed tiles that are queued again: the scheduler knows already.
  void Reopen(Job& job, const std::vector<uint32_t>& tiles) {
    const JobId& id = job.stored.id;
    if (const absl::Status dropped = store_->DropTiles(id, tiles); !dropped.ok()) {
      FailJob(job, Annotate(dropped, "wrong tiles cannot be dropped"));
      return;
    }
    for (const uint32_t tile : tiles) {
      const uint32_t frame = job.frame_of(tile);
      if (job.committed[frame]-- == job.tiles.size()) --job.frames_done;
    }
    ++job.changes;
    for (const uint32_t tile : tiles) {
      const auto baked = job.stored.frames.find(job.frame_of(tile));
      if (baked != job.stored.frames.end() && HaveBlobs(baked->second.blobs)) continue;
      FailJob(job,
              absl::DataLossError("a worker returned wrong pixels, and the blobs to render its "
                                  "tiles again are gone; requeue the job"));
      return;
    }
  }

  absl::StatusOr<std::shared_ptr<Job>> Find(const JobId& id) const {
    const auto at = jobs_.find(id);
    if (at != jobs_.end()) return at->second;
    return absl::NotFoundError("job '" + id.value.substr(0, 64) +
                               "' is not known; `farpoint status` lists the jobs");
  }

  JobStatus StatusOf(const Job& job) const {
    JobStatus status;
    const StoredJob& stored = job.stored;
    status.id = stored.id;
    status.title = stored.spec.title;
    status.state = stored.state;
    status.error = stored.error;
    status.priority = stored.spec.priority;
    status.submitted_unix_ms = stored.submitted_unix_ms;
    status.reissued = stored.reissued + scheduler_.Reissued(stored.id);
    status.refused_results = stored.refused_results + scheduler_.Refused(stored.id);
    status.after = stored.spec.after;
    status.suspect_tiles = stored.suspect_tiles;
    status.frames = {.total = stored.spec.frame_count(),
                     .baked = static_cast<uint32_t>(stored.frames.size()),
                     .done = job.frames_done};
    if (IsFinal(stored.state)) {
      status.tiles = job.final_counts;
      status.progress = status.tiles.total == 0
                            ? 0
                            : static_cast<double>(status.tiles.committed) / status.tiles.total;
      if (stored.state == JobState::kDone) status.eta_s = 0;
      return status;
    }
    if (stored.paused) status.state = JobState::kPaused;
    status.tiles = scheduler_.Counts(stored.id);
    status.progress = scheduler_.Progress(stored.id);
    status.eta_s = scheduler_.EtaSeconds(stored.id);
    return status;
  }

  // Counts of a job that has ended: what is not committed never failed if the job was cancelled.
  static TileCounts FinalCounts(JobState state, uint32_t committed, uint32_t total) {
    TileCounts counts{.committed = committed, .total = total};
    (state == JobState::kCancelled ? counts.queued : counts.failed) = total - committed;
    return counts;
  }

  // What the scheduler has counted stays with the job when it is removed there.
  void RememberCounters(Job& job) {
    job.stored.reissued += scheduler_.Reissued(job.stored.id);
    job.stored.refused_results += scheduler_.Refused(job.stored.id);
    SaveCounters({{job.stored.id, job.stored.reissued, job.stored.refused_results}});
  }

  // The store knows already.
  void EndOne(Job& job, JobState state, const absl::Status& error) {
    const JobId& id = job.stored.id;
    job.final_counts = FinalCounts(state, scheduler_.Counts(id).committed, job.total_tiles());
    job.stored.state = state;
    job.stored.error = error;
    job.stored.paused = false;
    ++job.life;
    ++job.changes;
    RememberCounters(job);
    saved_counters_.erase(id);
    scheduler_.RemoveJob(id);
    if (bake_in_work_ && bake_in_work_->job == id) *bake_in_work_->stop = true;
  }

  // And with it those that wait for it, unless it is done.
  void EndJob(Job& job, JobState state, const absl::Status& error) {
    EndOne(job, state, error);
    if (state != JobState::kDone) FailOrphans();
  }

  void FailOne(Job& job, const absl::Status& error) {
    // Not this program's error: whoever watches the job gets it in full.
    Log(LogLevel::kInfo, "failed: " + std::string(error.message()), job.stored.id);
    const absl::Status stored = store_->SetState(job.stored.id, JobState::kFailed, error);
    if (!stored.ok()) {
      Log(LogLevel::kError, "failure not stored: " + stored.ToString(), job.stored.id);
    }
    EndOne(job, JobState::kFailed, error);
  }
  void FailJob(Job& job, const absl::Status& error) {
    FailOne(job, error);
    FailOrphans();
  }

  // Jobs that wait for one that will not be done.
  void FailOrphans() {
    // A chain of jobs falls from its first to its last: again until nothing falls.
    for (bool failed = true; failed;) {
      failed = false;
      for (auto& [id, job] : jobs_) {
        if (IsFinal(job->stored.state) || job->begun) continue;
        const absl::Status lost = LostDependency(*job);
        if (lost.ok()) continue;
        FailOne(*job, lost);
        failed = true;
      }
    }
  }

  // OK unless a job that this one waits for has ended badly or is not known.
  absl::Status LostDependency(const Job& job) const {
    for (const JobId& id : job.stored.spec.after) {
      const auto at = jobs_.find(id);
      if (at == jobs_.end()) {
        return absl::NotFoundError("it waits for job " + id.value +
                                   ", which is not known any more; submit both again");
      }
      const StoredJob& other = at->second->stored;
      if (other.state == JobState::kFailed || other.state == JobState::kCancelled) {
        return absl::FailedPreconditionError(
            "it waits for job " + id.value + ", which " +
            (other.state == JobState::kFailed ? "failed" : "was cancelled") +
            "; requeue that one, then this one");
      }
    }
    return absl::OkStatus();
  }
  bool WaitsForOthers(const Job& job) const {
    if (job.begun) return false;
    for (const JobId& id : job.stored.spec.after) {
      const auto at = jobs_.find(id);
      if (at == jobs_.end() || at->second->stored.state != JobState::kDone) return true;
    }
    return false;
  }

  absl::Status MayStartAgain(const Job& job) const {
    if (!job.begun) FP_RETURN_IF_ERROR(LostDependency(job));
    for (const auto& [uri, digest] : job.stored.spec.asset_files) {
      if (!blobs_->Contains(digest)) {
        return absl::FailedPreconditionError("the scene's file '" + uri +
                                             "' is gone; submit the job again");
      }
    }
    return absl::OkStatus();
  }

  absl::Status SetPaused(const JobId& id, bool paused) {
    std::unique_lock lock(mutex_);
    FP_ASSIGN_OR_RETURN(const std::shared_ptr<Job> job, Find(id));
    if (IsFinal(job->stored.state) || job->stored.paused == paused) return absl::OkStatus();
    FP_RETURN_IF_ERROR(store_->SetPaused(id, paused));
    job->stored.paused = paused;
    ++job->changes;
    scheduler_.SetPaused(id, paused);
    Log(LogLevel::kInfo, paused ? "paused" : "resumed", id);
    lock.unlock();
    NotifyAll();
    return absl::OkStatus();
  }

  void SaveCounters(const std::vector<JobCounters>& counters) {
    const absl::Status saved = store_->SaveCounters(counters);
    if (!saved.ok()) Log(LogLevel::kError, "counters not saved: " + saved.ToString(), {});
  }

  void HandleNews(const SchedulerNews& news) {
    // A switch that is restarted loses hundreds of leases at a time: one flush for all lines.
    std::vector<JobLogLine> lines;
    for (const LostLease& lost : news.lost) {
      std::string text = "lease lost: " + lost.reason;
      if (lost.worker_set_aside) text += "; the worker is set aside for a while";
      LogLease(LogLevel::kWarning, text, lost.grant, /*detail=*/false, lost.cause);
      if (const auto at = jobs_.find(lost.grant.job); at != jobs_.end()) {
        lines.push_back({lost.grant.job, Placed(*at->second, {.level = LogLevel::kWarning,
                                                              .text = text,
                                                              .tile = lost.grant.tile,
                                                              .attempt = lost.grant.attempt,
                                                              .worker = lost.worker_name})});
      }
    }
    AppendLogs(lines);
    for (const SetAsideTile& poison : news.set_aside) {
      const auto at = jobs_.find(poison.job);
      if (at == jobs_.end() || IsFinal(at->second->stored.state)) continue;
      JobLog(*at->second, {.level = LogLevel::kError,
                           .text = "the tile is set aside; the others go on",
                           .tile = poison.tile});
      FinishIfDone(*at->second);
    }
    for (const FailedJob& failed : news.failed) {
      const auto at = jobs_.find(failed.job);
      if (at == jobs_.end() || IsFinal(at->second->stored.state)) continue;
      Job& job = *at->second;
      absl::Status error = failed.error;
      if (failed.tile && !job.stored.spec.frames.empty()) {
        error = Annotate(error, FrameName(job, job.frame_of(*failed.tile)));
      }
      FailJob(job, error);
    }
    for (const WorkerId& worker : news.forgotten) {
      LogWorker(LogLevel::kInfo, "forgotten: silent for too long", worker);
    }
  }

  static std::string FrameName(const Job& job, uint32_t index) {
    return "frame " + std::to_string(job.stored.spec.frame_number(index));
  }

  bool HaveBlobs(const SceneBlobs& blobs) const {
    for (const Digest& d : {blobs.prepared_scene, blobs.tree_topology, blobs.tree_radiance}) {
      if (!d.empty() && !blobs_->Contains(d)) return false;
    }
    return true;
  }

  // A job that is not final begins, or goes on where `committed` and its baked frames are. It is
  // not with the scheduler yet.
  void TakeUp(Job& job, const std::vector<StoredTile>& committed) {
    StoredJob& stored = job.stored;
    const uint32_t frames = stored.spec.frame_count();
    const auto frame_tiles = static_cast<uint32_t>(job.tiles.size());
    ++job.life;
    job.frames_done = 0;
    job.next_bake = 0;
    job.committed.assign(frames, 0);
    job.ready.assign(frames, false);
    if (!stored.frames.empty()) job.begun = true;

    ScheduledJob scheduled;
    scheduled.id = stored.id;
    scheduled.priority = stored.spec.priority;
    scheduled.number = stored.number;
    scheduled.tiles = job.total_tiles();
    scheduled.frame_tiles = frame_tiles;
    scheduled.frame_rects = job.tiles;
    scheduled.usual_share =
        stored.spec.settings.adaptive() ? kSharedByNeighbours : kSharedElsewhere;
    for (const StoredTile& tile : committed) {
      if (tile.tile >= scheduled.tiles) continue;
      scheduled.committed.push_back(tile.tile);
      scheduled.committed_by.push_back(tile.worker);
      ++job.committed[job.frame_of(tile.tile)];
    }
    if (!committed.empty()) scheduled.fingerprint = stored.fingerprint;
    scheduled.max_time = std::chrono::seconds(stored.spec.limits.max_seconds);
    scheduled.lease_time = BlockTime(stored.spec.settings, stored.spec.film);
    scheduled.step_time = StepTime(stored.spec.settings);
    scheduled.open = false;
    scheduled.paused = stored.paused;
    scheduler_.AddJob(scheduled);

    for (uint32_t i = 0; i < frames; ++i) {
      const bool done = job.committed[i] == frame_tiles;
      if (done) ++job.frames_done;
      const auto baked = stored.frames.find(i);
      if (baked == stored.frames.end()) continue;
      if (done) {
        job.ready[i] = true;
      } else if (HaveBlobs(baked->second.blobs)) {
        job.ready[i] = true;
        scheduler_.OpenTiles(stored.id, i * frame_tiles, frame_tiles);
      } else {
        stored.frames.erase(baked);  // baked again
      }
    }
    AdvanceNextBake(job);
    stored.state = stored.frames.empty() ? JobState::kQueued : JobState::kRendering;
  }

  static void AdvanceNextBake(Job& job) {
    while (job.has_frames_to_bake() && job.ready[job.next_bake]) ++job.next_bake;
  }

  // True if that may let a bake begin or a worker find something to do.
  bool CountCommitted(Job& job, uint32_t tile) {
    const uint32_t frame = job.frame_of(tile);
    if (++job.committed[frame] < job.tiles.size()) {
      return job.has_frames_to_bake() &&
             scheduler_.Leasable(job.stored.id) < kTilesAheadPerWorker * scheduler_.worker_count();
    }
    ++job.frames_done;
    if (!job.stored.spec.frames.empty()) {
      Log(LogLevel::kInfo, FrameName(job, frame) + " is done", job.stored.id);
    }
    ReleaseBlobs(job, frame);
    return true;
  }

  // "tile 7 of frame 3 (pixels 32 to 63 across, 0 to 31 down)".
  std::string TileName(const Job& job, uint32_t tile) const {
    const PixelRect& r = job.tiles[tile % job.tiles.size()];
    std::string text = "tile " + std::to_string(tile);
    if (!job.stored.spec.frames.empty()) text += " of " + FrameName(job, job.frame_of(tile));
    return text + " (pixels " + std::to_string(r.x0) + " to " + std::to_string(r.x1 - 1) +
           " across, " + std::to_string(r.y0) + " to " + std::to_string(r.y1 - 1) + " down)";
  }

  // Of a job of which only tiles that were set aside are left.
  absl::Status PoisonError(const Job& job) const {
    std::string text;
    uint32_t count = 0;
    for (const TroubledTile& tile : scheduler_.Report(job.stored.id).troubled) {
      if (!tile.set_aside || ++count > kProblems) continue;
      text += (text.empty() ? "" : "; ") + TileName(job, tile.tile) + " failed " +
              std::to_string(tile.failures) + " times on " + std::to_string(tile.workers) +
              " workers, the last cause: " + tile.cause;
    }
    if (count > kProblems) text += "; and " + std::to_string(count - kProblems) + " more";
    return absl::AbortedError(text +
                              "; all other tiles are done: see the workers' logs, then `farpoint "
                              "requeue` tries the rest again");
  }

  absl::Status UndecidedError(const Job& job, const std::vector<uint32_t>& disputed) const {
    return absl::AbortedError(
        TileName(job, disputed.front()) +
        (disputed.size() > 1 ? " and " + std::to_string(disputed.size() - 1) + " more" : "") +
        ": two workers returned different pixels, and no third one was there to tell who is "
        "right; connect another worker, then `farpoint requeue`");
  }

  void FinishIfDone(Job& job) {
    const JobId& id = job.stored.id;
    const TileCounts counts = scheduler_.Counts(id);
    if (IsFinal(job.stored.state) || counts.committed + counts.failed != counts.total) return;
    if (counts.failed > 0 && !scheduler_.MayGiveUp(id)) {
      unfinished_.insert(id);
      return;
    }
    switch (scheduler_.Audits(id)) {
      case AuditState::kOpen:
        unfinished_.insert(id);  // the ticker looks again
        return;
      case AuditState::kUndecided: {
        const std::vector<uint32_t> disputed = scheduler_.DisputedTiles(id);
        // First: a job that is failed with them would count them as good when it is requeued.
        if (const absl::Status s = store_->DropTiles(id, disputed); !s.ok()) {
          Log(LogLevel::kError, "disputed tiles not dropped: " + s.ToString(), id);
          unfinished_.insert(id);
          return;
        }
        unfinished_.erase(id);
        FailJob(job, UndecidedError(job, disputed));
        job.final_counts.committed -= static_cast<uint32_t>(disputed.size());
        job.final_counts.failed += static_cast<uint32_t>(disputed.size());
        return;
      }
      case AuditState::kNone:
        break;
    }
    unfinished_.erase(id);
    if (counts.failed > 0) {
      FailJob(job, PoisonError(job));
      return;
    }
    // If this fails or the process dies first, the store is opened again with all tiles committed,
    // and the job is found done.
    const absl::Status done = store_->SetState(id, JobState::kDone, absl::OkStatus());
    if (!done.ok()) Log(LogLevel::kError, done.ToString(), id);
    EndJob(job, JobState::kDone, absl::OkStatus());
    Log(LogLevel::kInfo, "done", id);
  }

  // Blobs that unfinished frames need, and those that a job needs to be requeued.
  std::set<Digest> NeededBlobs() const {
    std::set<Digest> needed;
    for (const auto& [id, job] : jobs_) {
      for (const auto& [uri, digest] : job->stored.spec.asset_files) needed.insert(digest);
      if (job->stored.state == JobState::kDone) continue;
      for (const auto& [index, frame] : job->stored.frames) {
        if (index < job->committed.size() && job->committed[index] == job->tiles.size()) continue;
        needed.insert(frame.blobs.prepared_scene);
        needed.insert(frame.blobs.tree_topology);
        needed.insert(frame.blobs.tree_radiance);
      }
    }
    return needed;
  }

  // In memory the blobs of an animated scene's frames go when they are rendered: hundreds of frames
  // would not fit. On a disk they stay until the retention time is over.
  void ReleaseBlobs(const Job& job, uint32_t frame) {
    const auto at = job.stored.frames.find(frame);
    if (!options_.store_directory.empty() || options_.audit_fraction > 0 || !job.animated ||
        at == job.stored.frames.end()) {
      return;
    }
    const SceneBlobs& blobs = at->second.blobs;
    released_.insert({blobs.prepared_scene, blobs.tree_topology, blobs.tree_radiance});
    DropReleased();
  }
  // What is being baked may turn out to be one of them: later.
  void DropReleased() {
    if (bake_in_work_ || released_.empty()) return;
    const std::set<Digest> needed = NeededBlobs();
    for (const Digest& d : released_) {
      if (!needed.contains(d)) blobs_->Drop(d);
    }
    released_.clear();
  }

  // Before the threads start: needs no lock.
  absl::Status RecoverJob(StoredJob stored) {
    auto job = std::make_shared<Job>();
    const JobId id = stored.id;
    job->stored = std::move(stored);
    StoredJob& s = job->stored;
    if (s.spec.film.width > 0) {
      job->tiles = TilesOf(s.spec.film, static_cast<int>(s.spec.settings.tile_px));
    }
    jobs_.emplace(id, job);
    const uint32_t total = job->total_tiles();
    if (s.state == JobState::kDone) {
      // All of its tiles are committed: weeks of done jobs are not read.
      s.paused = false;
      job->final_counts = FinalCounts(s.state, total, total);
      job->committed.assign(s.spec.frame_count(), static_cast<uint32_t>(job->tiles.size()));
      job->frames_done = s.spec.frame_count();
      return absl::OkStatus();
    }
    FP_ASSIGN_OR_RETURN(std::vector<StoredTile> committed, store_->Tiles(id));
    if (IsFinal(s.state)) {
      s.paused = false;
      const uint32_t done = std::min(total, static_cast<uint32_t>(committed.size()));
      job->final_counts = FinalCounts(s.state, done, total);
      job->committed.assign(s.spec.frame_count(), 0);
      for (const StoredTile& tile : committed) {
        if (tile.tile < total) ++job->committed[job->frame_of(tile.tile)];
      }
      for (const uint32_t count : job->committed) {
        if (total > 0 && count == job->tiles.size()) ++job->frames_done;
      }
      // Refused by this version: the store may not know it yet.
      if (s.state == JobState::kFailed) (void)store_->SetState(id, s.state, s.error);
      return absl::OkStatus();
    }
    FP_ASSIGN_OR_RETURN(const std::vector<uint32_t> damaged,
                        store_->DropDamagedTiles(id, kReadAtRestart));
    if (!damaged.empty()) {
      Log(LogLevel::kWarning,
          std::to_string(damaged.size()) + " tiles were damaged and are rendered again", id);
    }
    // The audits that were open died with the process.
    std::vector<uint32_t> disputed;
    for (const StoredTile& tile : committed) {
      if (tile.suspect) disputed.push_back(tile.tile);
    }
    FP_RETURN_IF_ERROR(store_->DropTiles(id, disputed));
    s.suspect_tiles = 0;
    if (!disputed.empty()) {
      Log(LogLevel::kWarning,
          std::to_string(disputed.size()) +
              " tiles about which workers disagreed are rendered again",
          id);
    }
    if (!damaged.empty() || !disputed.empty()) {
      FP_ASSIGN_OR_RETURN(committed, store_->Tiles(id));
    }
    TakeUp(*job, committed);
    if (s.state == JobState::kRendering) {
      Log(LogLevel::kInfo,
          "taken up again, " + std::to_string(committed.size()) + " of " + std::to_string(total) +
              " tiles are done",
          id);
    }
    FinishIfDone(*job);
    return absl::OkStatus();
  }

  // Without the lock.
  static absl::Status CheckResult(const TileResult& result, const PixelRect& rect,
                                  const std::vector<Layer>& layers) {
    if (result.bytes.Hash() != result.sha256) {
      return absl::DataLossError("the bytes do not have the hash that was announced");
    }
    const absl::StatusOr<Film> film = DecodeFilm(result.bytes.bytes());
    if (!film.ok()) return Annotate(film.status(), "the bytes are no tile");
    if (!(film->rect() == rect)) {
      return absl::DataLossError("the tile has another rectangle than the lease");
    }
    const Film expected({}, layers);
    if (!std::equal(film->layers().begin(), film->layers().end(), expected.layers().begin(),
                    expected.layers().end())) {
      return absl::DataLossError("the tile has other layers than the job");
    }
    return absl::OkStatus();
  }

  // --- Threads ---

  void TickLoop() {
    const auto period = std::clamp<std::chrono::milliseconds>(
        options_.silence_time / 40, std::chrono::milliseconds(5), std::chrono::milliseconds(100));
    auto next_save = std::chrono::steady_clock::now() + std::chrono::seconds(5);
    auto next_purge = std::chrono::steady_clock::now() + std::chrono::hours(1);
    std::unique_lock lock(mutex_);
    TimePoint last = clock_->Now();
    while (!stopping_) {
      const Duration gap = clock_->Now() - last;
      last += gap;
      if (gap > options_.silence_time / 2) scheduler_.Forgive(gap);
      const SchedulerNews news = scheduler_.Tick();
      HandleNews(news);
      const std::set<JobId> waited = std::exchange(unfinished_, {});
      for (const JobId& id : waited) {
        if (const auto at = jobs_.find(id); at != jobs_.end()) FinishIfDone(*at->second);
      }
      const auto now = std::chrono::steady_clock::now();
      if (now >= next_save) {
        next_save = now + std::chrono::seconds(5);
        std::vector<JobCounters> counters;
        for (auto& [id, job] : jobs_) {
          if (!scheduler_.HasJob(id)) continue;
          const uint64_t reissued = job->stored.reissued + scheduler_.Reissued(id);
          const uint64_t refused = job->stored.refused_results + scheduler_.Refused(id);
          if (std::exchange(saved_counters_[id], reissued + refused) != reissued + refused) {
            counters.push_back({id, reissued, refused});
          }
        }
        SaveCounters(counters);
      }
      if (now >= next_purge) {
        next_purge = now + std::chrono::hours(1);
        PurgeOld();
      }
      if (!news.lost.empty() || !news.failed.empty() || !waited.empty()) NotifyAll();
      stop_ticker_.wait_for(lock, period, [this] { return stopping_; });
    }
  }

  void PurgeOld() {
    const int64_t before =
        UnixMs() -
        std::chrono::duration_cast<std::chrono::milliseconds>(options_.retention).count();
    std::set<JobId> waited_for;
    for (const auto& [id, job] : jobs_) {
      if (IsFinal(job->stored.state) || job->begun) continue;
      waited_for.insert(job->stored.spec.after.begin(), job->stored.spec.after.end());
    }
    const absl::StatusOr<std::vector<JobId>> purged = store_->Purge(before, waited_for);
    if (!purged.ok()) {
      Log(LogLevel::kError, "purge: " + purged.status().ToString(), {});
      return;
    }
    for (const JobId& id : *purged) {
      jobs_.erase(id);
      saved_counters_.erase(id);
      Log(LogLevel::kInfo, "purged", id);
    }
    blobs_->RemoveUnused(NeededBlobs(), options_.retention);
  }

  // Whether enough of the job is baked for now.
  bool EnoughBaked(const Job& job) const {
    const auto ahead = static_cast<uint32_t>(job.stored.frames.size()) - job.frames_done;
    return ahead >= kFramesAhead &&
           scheduler_.Leasable(job.stored.id) >= kTilesAheadPerWorker * scheduler_.worker_count();
  }

  // The jobs whose next frame waits to be baked, in the order in which they will be.
  std::vector<std::shared_ptr<Job>> BakeQueue() const {
    std::vector<std::shared_ptr<Job>> queue;
    for (const auto& [id, job] : jobs_) {
      if (IsFinal(job->stored.state) || job->stored.paused || !job->has_frames_to_bake() ||
          WaitsForOthers(*job) || EnoughBaked(*job)) {
        continue;
      }
      if (bake_in_work_ && bake_in_work_->job == id && bake_in_work_->life == job->life) continue;
      queue.push_back(job);
    }
    std::sort(queue.begin(), queue.end(),
              [](const auto& a, const auto& b) { return GoesBefore(a->stored, b->stored); });
    return queue;
  }
  static bool GoesBefore(const StoredJob& a, const StoredJob& b) {
    if (a.spec.priority != b.spec.priority) return a.spec.priority > b.spec.priority;
    return a.number < b.number;
  }

  void BakeLoop() {
    std::unique_lock lock(mutex_);
    while (!stopping_) {
      const std::vector<std::shared_ptr<Job>> queue =
          draining_ ? std::vector<std::shared_ptr<Job>>() : BakeQueue();
      if (queue.empty()) {
        bakes_.wait(lock);
        continue;
      }
      const std::shared_ptr<Job> job = queue.front();
      const JobId id = job->stored.id;
      if (job->stored.state == JobState::kQueued) {
        if (const absl::Status s = store_->SetState(id, JobState::kBaking, absl::OkStatus());
            !s.ok()) {
          FailJob(*job, s);
          NotifyAll();
          continue;
        }
        job->stored.state = JobState::kBaking;
        ++job->changes;
        NotifyAll();
      }
      BakeInWork work{
          .job = id, .frame = job->next_bake, .life = job->life, .since = clock_->Now()};
      bake_in_work_ = work;
      const JobSpec spec = job->stored.spec;
      lock.unlock();
      absl::StatusOr<FrameBake> baked = frame_bakery_.Bake(spec, work.frame, *work.stop);
      lock.lock();
      bake_in_work_.reset();
      // Ended or taken up anew meanwhile, or the process ends: then it is baked another time.
      if (stopping_ || job->life != work.life) continue;
      FinishBake(*job, work, spec, std::move(baked));
      DropReleased();
      NotifyAll();
    }
  }

  void FinishBake(Job& job, const BakeInWork& work, const JobSpec& spec,
                  absl::StatusOr<FrameBake> baked) {
    const JobId& id = job.stored.id;
    absl::Status status = baked.status();
    if (status.ok()) {
      status = store_->SetBaked(id, work.frame, baked->frame, baked->notes, baked->stats);
    }
    if (!status.ok()) {
      FailJob(job, spec.frames.empty() ? status : Annotate(status, FrameName(job, work.frame)));
      return;
    }
    StoredJob& stored = job.stored;
    stored.frames[work.frame] = baked->frame;
    for (std::string& note : baked->notes) {
      if (stored.notes.size() < kMaxStoredNotes &&
          std::find(stored.notes.begin(), stored.notes.end(), note) == stored.notes.end()) {
        stored.notes.push_back(std::move(note));
      }
    }
    stored.state = JobState::kRendering;
    job.begun = true;
    job.animated = job.animated || baked->animated;
    ++job.changes;
    job.ready[work.frame] = true;
    AdvanceNextBake(job);
    const auto frame_tiles = static_cast<uint32_t>(job.tiles.size());
    scheduler_.OpenTiles(id, work.frame * frame_tiles, frame_tiles);
    const double seconds = std::chrono::duration<double>(clock_->Now() - work.since).count();
    char took[32];
    std::snprintf(took, sizeof(took), "%.2f s", seconds);
    std::string text = spec.frames.empty() ? "" : FrameName(job, work.frame) + ": ";
    text +=
        baked->reused ? std::string("an earlier bake is reused") : "baked in " + std::string(took);
    Log(LogLevel::kInfo, text + ", " + std::to_string(frame_tiles) + " tiles are queued", id);
    JobLog(job, {.text = text});
  }

  ExplanationFacts FactsOf(const Job& job) const {
    ExplanationFacts facts;
    const JobId& id = job.stored.id;
    facts.status = StatusOf(job);
    facts.spec = job.stored.spec;
    facts.frame_tiles = static_cast<uint32_t>(job.tiles.size());
    facts.draining = draining_;
    facts.workers = scheduler_.Workers();
    facts.report = scheduler_.Report(id);
    if (IsFinal(job.stored.state)) return facts;
    facts.paused = job.stored.paused;
    if (WaitsForOthers(job)) {
      for (const JobId& other : job.stored.spec.after) {
        const auto at = jobs_.find(other);
        if (at == jobs_.end()) {
          facts.waits_for.push_back({.id = other, .status = std::nullopt});
        } else if (at->second->stored.state != JobState::kDone) {
          facts.waits_for.push_back({.id = other, .status = StatusOf(*at->second)});
        }
      }
    }
    if (bake_in_work_) {
      facts.baked_first = bake_in_work_->job;
      if (bake_in_work_->job == id && bake_in_work_->life == job.life) {
        facts.baking = ExplanationFacts::BakeInWork{
            .frame_index = bake_in_work_->frame,
            .seconds = std::chrono::duration<double>(clock_->Now() - bake_in_work_->since).count()};
      }
    }
    const std::vector<std::shared_ptr<Job>> queue = BakeQueue();
    for (size_t i = 0; i < queue.size(); ++i) {
      if (queue[i]->stored.id == id) facts.bake_place = i + 1;
    }
    if (facts.bake_place > 1) facts.baked_first = queue[facts.bake_place - 2]->stored.id;
    facts.enough_baked = !job.stored.paused && job.has_frames_to_bake() && EnoughBaked(job);
    const Job* first = nullptr;
    for (const auto& [other_id, other] : jobs_) {
      if (other.get() == &job || other->stored.paused || scheduler_.Leasable(other_id) == 0 ||
          !GoesBefore(other->stored, job.stored)) {
        continue;
      }
      if (first == nullptr || GoesBefore(other->stored, first->stored)) first = other.get();
    }
    if (first != nullptr) {
      facts.served_first = StatusOf(*first);
      facts.served_first_tiles = scheduler_.Leasable(first->stored.id);
    }
    return facts;
  }

  // --- Log ---

  std::string WorkerName(const WorkerId& worker) const {
    const WorkerHello* const hello = scheduler_.FindWorker(worker);
    return hello == nullptr || hello->name.empty() ? worker.value : hello->name;
  }

  // Into the log that belongs to the job.
  void JobLog(Job& job, const LogLine& line) { AppendLogs({{job.stored.id, Placed(job, line)}}); }
  // With the frame of its tile.
  static LogLine Placed(const Job& job, LogLine line) {
    if (line.tile && !job.stored.spec.frames.empty()) {
      line.text = FrameName(job, job.frame_of(*line.tile)) + ": " + line.text;
    }
    return line;
  }
  void AppendLogs(const std::vector<JobLogLine>& lines) {
    const absl::StatusOr<std::vector<bool>> written = store_->AppendLogs(lines);
    if (!written.ok()) {
      Log(LogLevel::kError, "log not stored: " + written.status().ToString(), lines.front().job);
      return;
    }
    for (size_t i = 0; i < lines.size(); ++i) {
      if (!(*written)[i]) continue;
      if (const auto at = jobs_.find(lines[i].job); at != jobs_.end()) ++at->second->changes;
    }
  }

  void Log(LogLevel level, std::string text, const JobId& job) const {
    if (options_.log) options_.log({.level = level, .text = std::move(text), .job = job});
  }
  void LogWorker(LogLevel level, std::string text, const WorkerId& worker) const {
    if (options_.log) options_.log({.level = level, .text = std::move(text), .worker = worker});
  }
  void LogLease(LogLevel level, std::string text, const LeaseGrant& grant, bool detail = false,
                LossCause lost = LossCause::kReported) const {
    if (!options_.log) return;
    options_.log({.level = level,
                  .text = std::move(text),
                  .job = grant.job,
                  .tile = grant.tile,
                  .attempt = grant.attempt,
                  .worker = grant.worker,
                  .detail = detail,
                  .lost = lost});
  }

  const CoordinatorOptions options_;
  const std::shared_ptr<const Clock> clock_;
  const std::unique_ptr<BlobStore> blobs_;
  const std::unique_ptr<JobStore> store_;
  FrameBakery frame_bakery_;

  std::mutex requeue_mutex_;  // before mutex_
  std::mutex mutex_;
  // What each kind of waiter waits for, and the end.
  std::condition_variable work_;    // workers: a tile may be leased
  std::condition_variable events_;  // watchers: a job has changed
  std::condition_variable bakes_;   // the thread that bakes: a frame may be baked
  std::condition_variable stop_ticker_;
  TileScheduler scheduler_;                     // guarded by mutex_
  std::map<JobId, std::shared_ptr<Job>> jobs_;  // guarded by mutex_
  std::optional<BakeInWork> bake_in_work_;      // guarded by mutex_
  std::set<Digest> released_;                   // guarded by mutex_
  std::map<JobId, uint64_t> saved_counters_;    // guarded by mutex_
  // No tile is left, but audits or workers that may come back; guarded by mutex_.
  std::set<JobId> unfinished_;
  bool draining_ = false, stopping_ = false;  // guarded by mutex_
  std::mutex wakes_mutex_;                    // after mutex_
  std::condition_variable woken_;
  uint64_t wakes_ = 1;  // guarded by wakes_mutex_
  std::thread ticker_, bakery_;
};

}  // namespace

absl::StatusOr<std::unique_ptr<Coordinator>> Coordinator::Open(CoordinatorOptions options) {
  FP_CHECK(options.baker != nullptr);
  std::string blob_folder;
  if (!options.store_directory.empty()) {
    blob_folder = options.blob_directory.empty() ? options.store_directory + "/blobs"
                                                 : options.blob_directory;
  }
  // The job store first: it holds the lock of the folder.
  FP_ASSIGN_OR_RETURN(std::unique_ptr<JobStore> store,
                      JobStore::Open(options.store_directory, options.store_hook));
  FP_ASSIGN_OR_RETURN(std::unique_ptr<BlobStore> blobs,
                      BlobStore::Open(blob_folder, options.max_blob_bytes));
  auto coordinator =
      std::make_unique<CoordinatorImpl>(std::move(options), std::move(blobs), std::move(store));
  FP_RETURN_IF_ERROR(coordinator->Recover());
  return coordinator;
}

}  // namespace farpoint

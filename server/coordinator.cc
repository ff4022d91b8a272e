#include "server/coordinator.h"

#include <algorithm>
#include <atomic>
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
// generously on one slow thread (20 µs a path, 2 ms a receiver). At most a day.
std::chrono::milliseconds BlockTime(const RenderSettings& settings) {
  const double receivers = 1.0 * kBlockSize * kBlockSize * settings.spp;
  const double seconds =
      receivers * (settings.integrator == Integrator::kPt ? 2e-5 * settings.paths : 2e-3);
  return std::chrono::milliseconds(static_cast<int64_t>(1000 * std::min(seconds, 86400.0)));
}

SchedulerOptions SchedulerOptionsOf(const CoordinatorOptions& options) {
  SchedulerOptions s;
  s.silence_time = options.silence_time;
  s.lease_time = options.lease_time;
  s.speculate_factor = options.speculate_factor;
  s.speculate_after = options.speculate_after;
  s.max_dead_workers = options.max_dead_workers;
  s.max_tile_failures = options.max_tile_failures;
  s.max_worker_failures = options.max_worker_failures;
  s.set_aside_time = options.set_aside_time;
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
        scheduler_(SchedulerOptionsOf(options_), *clock_) {}

  ~CoordinatorImpl() override {
    {
      std::lock_guard lock(mutex_);
      stopping_ = true;
      draining_ = true;
      for (auto& [id, job] : jobs_) job->stop_bake = true;
    }
    changed_.notify_all();
    stop_ticker_.notify_all();
    if (ticker_.joinable()) ticker_.join();
    if (bakery_.joinable()) bakery_.join();
  }

  absl::Status Recover() {
    FP_ASSIGN_OR_RETURN(std::vector<StoredJob> stored, store_->LoadJobs());
    for (StoredJob& one : stored) FP_RETURN_IF_ERROR(RecoverJob(std::move(one)));
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
    if (spec.frame_count() > 1 || !spec.after.empty() || spec.start_paused) return NotYet();
    std::vector<PixelRect> tiles = TilesOf(spec.film, static_cast<int>(spec.settings.tile_px));
    if (tiles.size() > kMaxTilesPerJob) {
      return absl::InvalidArgumentError(
          "settings.tile_px is " + std::to_string(spec.settings.tile_px) + ", which makes " +
          std::to_string(tiles.size()) + " tiles; at most " + std::to_string(kMaxTilesPerJob) +
          " are allowed, ask for larger ones");
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
    auto job = std::make_shared<Job>();
    do {
      job->stored.id.value = RandomHex(8);
    } while (jobs_.contains(job->stored.id));
    job->stored.spec = std::move(spec);
    job->stored.submitted_unix_ms = UnixMs();
    job->tiles = std::move(tiles);
    FP_RETURN_IF_ERROR(store_->InsertJob(job->stored, submission_id));
    const JobId id = job->stored.id;
    jobs_.emplace(id, std::move(job));
    Log(CoordinatorLogEntry::Level::kInfo, "submitted", id);
    lock.unlock();
    changed_.notify_all();
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
    EndJob(*job, JobState::kCancelled, absl::OkStatus());
    Log(CoordinatorLogEntry::Level::kInfo, "cancelled", id);
    lock.unlock();
    changed_.notify_all();
    return absl::OkStatus();
  }

  absl::Status Pause(const JobId&) override { return NotYet(); }
  absl::Status Resume(const JobId&) override { return NotYet(); }
  absl::Status SetPriority(const JobId&, int32_t) override { return NotYet(); }
  absl::Status Requeue(const JobId&, bool) override { return NotYet(); }
  absl::StatusOr<Explanation> Explain(const JobId&) override { return NotYet(); }
  static absl::Status NotYet() { return absl::UnimplementedError("this call is not built yet"); }

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
          events.push_back({.sequence = event.sequence, .body = event.body, .status = status});
        }
        return events;
      }
      if (ended) return std::vector<JobEvent>{};
      const bool woken = changed_.wait_until(
          lock, deadline, [&] { return stopping_ || draining_ || job->changes != seen; });
      if (woken && job->changes != seen) continue;
      if (woken) return Draining();
      return std::vector<JobEvent>{{.sequence = 0, .body = {}, .status = StatusOf(*job)}};
    }
  }

  absl::StatusOr<JobInfo> FetchInfo(const JobId& id) override {
    JobInfo info;
    std::optional<Camera> camera;
    {
      std::lock_guard lock(mutex_);
      FP_ASSIGN_OR_RETURN(const std::shared_ptr<Job> job, Find(id));
      info.status = StatusOf(*job);
      info.spec = job->stored.spec;
      info.notes = job->stored.notes;
      info.frames.resize(1);
      info.frames[0].number = info.spec.frame_number(0);
      info.frames[0].blobs = job->stored.blobs;
      info.stats = job->stored.bake_stats;
      camera = job->stored.camera;
      if (camera) {
        for (const PixelRect& rect : job->tiles) info.tiles.push_back({.rect = rect});
      }
    }
    info.version = FARPOINT_VERSION;
    if (!camera) return info;
    info.frames[0].baked = true;
    info.frames[0].camera = MatricesOf(*camera, info.spec.film);
    FP_ASSIGN_OR_RETURN(const std::vector<StoredTile> committed, store_->Tiles(id));
    for (const StoredTile& tile : committed) {
      if (tile.tile < info.tiles.size()) info.tiles[tile.tile].sha256 = tile.sha256;
    }
    FP_ASSIGN_OR_RETURN(const Stats stats, store_->TileStats(id));
    info.stats += stats;
    return info;
  }

  absl::StatusOr<TileData> FetchTile(const JobId& id, uint32_t tile) override {
    {
      std::lock_guard lock(mutex_);
      FP_ASSIGN_OR_RETURN(const std::shared_ptr<Job> job, Find(id));
      if (tile >= job->tiles.size()) {
        return absl::InvalidArgumentError("tile " + std::to_string(tile) + " is not among the " +
                                          std::to_string(job->tiles.size()) + " of job " +
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
    WorkerWelcome welcome;
    welcome.id.value = RandomHex(16);
    welcome.heartbeat = options_.heartbeat;
    welcome.max_wait = std::chrono::milliseconds(10000);
    scheduler_.AddWorker(welcome.id, hello);
    LogWorker(CoordinatorLogEntry::Level::kInfo,
              "registered '" + hello.name + "', " + std::to_string(hello.threads) + " threads",
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
        LogLease(CoordinatorLogEntry::Level::kInfo, grant->speculative ? "copied" : "leased",
                 *grant);
        TileWork work;
        work.lease = grant->lease;
        work.attempt = grant->attempt;
        work.job = grant->job;
        work.tile = grant->tile;
        work.rect = job.tiles[grant->tile];
        work.frame = {.camera = *job.stored.camera,
                      .film = job.stored.spec.film,
                      .settings = job.stored.spec.settings};
        work.blobs = job.stored.blobs;
        work.lease_time = std::max(options_.lease_time, BlockTime(job.stored.spec.settings));
        return work;
      }
      const auto now = std::chrono::steady_clock::now();
      if (now >= deadline) return std::nullopt;
      // Tiles become slow and workers come back from being set aside without a notification.
      changed_.wait_until(lock, std::min(deadline, now + std::chrono::milliseconds(500)));
    }
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
    PixelRect rect;
    std::vector<Layer> layers;
    {
      std::lock_guard lock(mutex_);
      if (!scheduler_.HasWorker(worker)) return UnknownWorker(worker);
      const absl::StatusOr<LeaseGrant> begun =
          scheduler_.BeginCommit(worker, result.lease, result.attempt);
      if (!begun.ok()) {
        const std::string reason(begun.status().message());
        LogWorker(CoordinatorLogEntry::Level::kWarning,
                  "refused a result of lease " + result.lease.value + ": " + reason, worker);
        return ReturnAnswer{.accepted = false, .reason = reason};
      }
      grant = *begun;
      const Job& job = *jobs_.at(grant.job);
      rect = job.tiles[grant.tile];
      layers = job.stored.spec.settings.layers;
      for (const WorkerStatus& status : scheduler_.Workers()) {
        if (status.id == worker) fingerprint = status.fingerprint;
      }
    }

    // Reading and storing take their time: without the lock. The lease is pinned meanwhile.
    if (const absl::Status wrong = CheckResult(result, rect, layers); !wrong.ok()) {
      std::unique_lock lock(mutex_);
      HandleNews(scheduler_.RefuseResult(result.lease, std::string(wrong.message())));
      lock.unlock();
      changed_.notify_all();
      return ReturnAnswer{.accepted = false, .reason = std::string(wrong.message())};
    }
    absl::Status stored = store_->CommitTile(grant.job, grant.tile, result, fingerprint);
    if (absl::IsAlreadyExists(stored)) stored = absl::OkStatus();

    std::unique_lock lock(mutex_);
    const bool counted = scheduler_.FinishCommit(result.lease, stored.ok());
    if (const auto at = jobs_.find(grant.job); at != jobs_.end()) {
      Job& job = *at->second;
      if (stored.ok()) {
        ++job.changes;
        if (job.stored.fingerprint.empty()) job.stored.fingerprint = fingerprint;
      }
      const TileCounts counts = scheduler_.Counts(grant.job);
      if (stored.ok() && counted && counts.committed == counts.total &&
          job.stored.state == JobState::kRendering) {
        // If this fails or the process dies first, the store is opened again with all tiles
        // committed, and the job is found done.
        const absl::Status done = store_->SetState(grant.job, JobState::kDone, absl::OkStatus());
        if (!done.ok()) LogLease(CoordinatorLogEntry::Level::kError, done.ToString(), grant);
        EndJob(job, JobState::kDone, absl::OkStatus());
        Log(CoordinatorLogEntry::Level::kInfo, "done", grant.job);
      }
    }
    if (stored.ok()) {
      LogLease(CoordinatorLogEntry::Level::kInfo, "committed", grant);
    } else {
      LogLease(CoordinatorLogEntry::Level::kError, "not committed: " + stored.ToString(), grant);
    }
    lock.unlock();
    changed_.notify_all();
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
    HandleNews(scheduler_.ReportFailure(worker, lease, given_back, error));
    lock.unlock();
    changed_.notify_all();
    return absl::OkStatus();
  }

  absl::Status Leave(const WorkerId& worker) override {
    std::unique_lock lock(mutex_);
    if (!scheduler_.HasWorker(worker)) return absl::OkStatus();
    scheduler_.RemoveWorker(worker);
    LogWorker(CoordinatorLogEntry::Level::kInfo, "left", worker);
    lock.unlock();
    changed_.notify_all();
    return absl::OkStatus();
  }

  void Drain() override {
    {
      std::lock_guard lock(mutex_);
      draining_ = true;
    }
    changed_.notify_all();
  }
  uint32_t ActiveLeases() override {
    std::lock_guard lock(mutex_);
    return scheduler_.ActiveLeases();
  }

 private:
  struct Job {
    StoredJob stored;
    std::vector<PixelRect> tiles;
    uint64_t changes = 1;     // grows with each event
    TileCounts final_counts;  // once the state is final
    std::atomic<bool> stop_bake = false;
  };

  static absl::Status Draining() {
    return absl::UnavailableError("the coordinator is shutting down; try again later");
  }
  static absl::Status UnknownWorker(const WorkerId& worker) {
    return absl::NotFoundError("worker " + worker.value + " is not registered; register again");
  }

  // --- All below need mutex_ unless they say otherwise ---

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
    if (IsFinal(stored.state)) {
      status.tiles = job.final_counts;
      status.progress = status.tiles.total == 0
                            ? 0
                            : static_cast<double>(status.tiles.committed) / status.tiles.total;
      if (stored.state == JobState::kDone) status.eta_s = 0;
    } else if (scheduler_.HasJob(stored.id)) {
      status.tiles = scheduler_.Counts(stored.id);
      status.progress = scheduler_.Progress(stored.id);
      status.eta_s = scheduler_.EtaSeconds(stored.id);
    } else {
      status.tiles.total = status.tiles.queued = static_cast<uint32_t>(job.tiles.size());
    }
    return status;
  }

  // The store knows already. What is not committed will never be: it counts as failed.
  void EndJob(Job& job, JobState state, const absl::Status& error) {
    const JobId& id = job.stored.id;
    const uint32_t total = static_cast<uint32_t>(job.tiles.size());
    const uint32_t committed = scheduler_.Counts(id).committed;
    job.final_counts = {.committed = committed, .failed = total - committed, .total = total};
    job.stored.state = state;
    job.stored.error = error;
    job.stored.reissued += scheduler_.Reissued(id);
    job.stored.refused_results += scheduler_.Refused(id);
    job.stop_bake = true;
    ++job.changes;
    scheduler_.RemoveJob(id);
    SaveCounters(job, job.stored.reissued, job.stored.refused_results);
  }

  void SaveCounters(const Job& job, uint64_t reissued, uint64_t refused) {
    const absl::Status saved = store_->SaveCounters(job.stored.id, reissued, refused);
    if (!saved.ok()) {
      Log(CoordinatorLogEntry::Level::kError, "counters not saved: " + saved.ToString(),
          job.stored.id);
    }
  }

  void FailJob(Job& job, const absl::Status& error) {
    const absl::Status stored = store_->SetState(job.stored.id, JobState::kFailed, error);
    if (!stored.ok()) {
      Log(CoordinatorLogEntry::Level::kError, "failure not stored: " + stored.ToString(),
          job.stored.id);
    }
    EndJob(job, JobState::kFailed, error);
    // Not this program's error: whoever watches the job gets it in full.
    Log(CoordinatorLogEntry::Level::kInfo, "failed: " + std::string(error.message()),
        job.stored.id);
  }

  void HandleNews(const SchedulerNews& news) {
    for (const LostLease& lost : news.lost) {
      LogLease(CoordinatorLogEntry::Level::kWarning, "lease lost: " + lost.reason, lost.grant);
    }
    for (const FailedJob& failed : news.failed) {
      if (const auto at = jobs_.find(failed.job); at != jobs_.end()) {
        FailJob(*at->second, failed.error);
      }
    }
    for (const WorkerId& worker : news.forgotten) {
      LogWorker(CoordinatorLogEntry::Level::kInfo, "forgotten: silent for too long", worker);
    }
  }

  void StartRendering(Job& job, const std::vector<StoredTile>& committed) {
    ScheduledJob scheduled;
    scheduled.id = job.stored.id;
    scheduled.priority = job.stored.spec.priority;
    scheduled.number = job.stored.number;
    scheduled.tiles = static_cast<uint32_t>(job.tiles.size());
    for (const StoredTile& tile : committed) scheduled.committed.push_back(tile.tile);
    if (!committed.empty()) scheduled.fingerprint = job.stored.fingerprint;
    scheduled.max_time = std::chrono::seconds(job.stored.spec.limits.max_seconds);
    scheduled.lease_time = BlockTime(job.stored.spec.settings);
    job.stored.state = JobState::kRendering;
    scheduler_.AddJob(scheduled);
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
    FP_ASSIGN_OR_RETURN(std::vector<StoredTile> committed, store_->Tiles(id));
    const uint32_t total = static_cast<uint32_t>(job->tiles.size());
    if (IsFinal(s.state)) {
      const uint32_t done = std::min(total, static_cast<uint32_t>(committed.size()));
      job->final_counts = {.committed = done, .failed = total - done, .total = total};
      // Refused by this version: the store may not know it yet.
      if (s.state == JobState::kFailed) (void)store_->SetState(id, s.state, s.error);
      return absl::OkStatus();
    }
    FP_ASSIGN_OR_RETURN(const std::vector<uint32_t> damaged, store_->DropDamagedTiles(id));
    if (!damaged.empty()) {
      Log(CoordinatorLogEntry::Level::kWarning,
          std::to_string(damaged.size()) + " tiles were damaged and are rendered again", id);
      FP_ASSIGN_OR_RETURN(committed, store_->Tiles(id));
    }
    if (s.state == JobState::kRendering && committed.size() == total) {
      FP_RETURN_IF_ERROR(store_->SetState(id, JobState::kDone, absl::OkStatus()));
      s.state = JobState::kDone;
      job->final_counts = {.committed = total, .total = total};
      return absl::OkStatus();
    }
    const auto have = [this](const Digest& d) { return d.empty() || blobs_->Contains(d); };
    if (s.state == JobState::kRendering && s.camera && have(s.blobs.prepared_scene) &&
        have(s.blobs.tree_topology) && have(s.blobs.tree_radiance)) {
      StartRendering(*job, committed);
      Log(CoordinatorLogEntry::Level::kInfo,
          "taken up again, " + std::to_string(committed.size()) + " of " + std::to_string(total) +
              " tiles are done",
          id);
    } else {
      s.state = JobState::kQueued;  // baked again
    }
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
        options_.silence_time / 10, std::chrono::milliseconds(5), std::chrono::milliseconds(500));
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
      const auto now = std::chrono::steady_clock::now();
      if (now >= next_save) {
        next_save = now + std::chrono::seconds(5);
        for (auto& [id, job] : jobs_) {
          if (!scheduler_.HasJob(id)) continue;
          const uint64_t reissued = job->stored.reissued + scheduler_.Reissued(id);
          const uint64_t refused = job->stored.refused_results + scheduler_.Refused(id);
          if (std::exchange(saved_counters_[id], reissued + refused) != reissued + refused) {
            SaveCounters(*job, reissued, refused);
          }
        }
      }
      if (now >= next_purge) {
        next_purge = now + std::chrono::hours(1);
        PurgeOld();
      }
      if (!news.lost.empty() || !news.failed.empty()) changed_.notify_all();
      stop_ticker_.wait_for(lock, period, [this] { return stopping_; });
    }
  }

  void PurgeOld() {
    const int64_t before =
        UnixMs() -
        std::chrono::duration_cast<std::chrono::milliseconds>(options_.retention).count();
    const absl::StatusOr<std::vector<JobId>> purged = store_->Purge(before);
    if (!purged.ok()) {
      Log(CoordinatorLogEntry::Level::kError, "purge: " + purged.status().ToString(), {});
      return;
    }
    for (const JobId& id : *purged) {
      jobs_.erase(id);
      saved_counters_.erase(id);
      Log(CoordinatorLogEntry::Level::kInfo, "purged", id);
    }
    std::set<Digest> needed;
    for (const auto& [id, job] : jobs_) {
      if (IsFinal(job->stored.state)) continue;
      for (const auto& [uri, digest] : job->stored.spec.asset_files) needed.insert(digest);
      needed.insert(job->stored.blobs.prepared_scene);
      needed.insert(job->stored.blobs.tree_topology);
      needed.insert(job->stored.blobs.tree_radiance);
    }
    blobs_->RemoveUnused(needed, options_.retention);
  }

  void BakeLoop() {
    std::unique_lock lock(mutex_);
    while (!stopping_) {
      std::shared_ptr<Job> next;
      for (const auto& [id, job] : jobs_) {
        if (draining_ || job->stored.state != JobState::kQueued) continue;
        if (next == nullptr || job->stored.spec.priority > next->stored.spec.priority ||
            (job->stored.spec.priority == next->stored.spec.priority &&
             job->stored.number < next->stored.number)) {
          next = job;
        }
      }
      if (next == nullptr) {
        changed_.wait(lock);
        continue;
      }
      const JobId id = next->stored.id;
      if (const absl::Status s = store_->SetState(id, JobState::kBaking, absl::OkStatus());
          !s.ok()) {
        FailJob(*next, s);
        changed_.notify_all();
        continue;
      }
      next->stored.state = JobState::kBaking;
      ++next->changes;
      changed_.notify_all();
      const JobSpec spec = next->stored.spec;
      lock.unlock();
      absl::StatusOr<Baked> baked = BakeOrReuse(spec, next->stop_bake);
      lock.lock();
      // Cancelled meanwhile, or the process ends: then the job is baked by the next process.
      if (stopping_ || next->stored.state != JobState::kBaking) continue;
      absl::Status status = baked.status();
      std::vector<StoredTile> committed;
      if (status.ok()) {
        status = store_->SetBaked(id, baked->camera, baked->bake.blobs, baked->bake.notes,
                                  baked->bake.stats);
      }
      if (status.ok()) {
        // There are some if the blobs of a job in work were lost.
        absl::StatusOr<std::vector<StoredTile>> tiles = store_->Tiles(id);
        status = tiles.status();
        if (tiles.ok()) committed = *std::move(tiles);
      }
      if (!status.ok()) {
        FailJob(*next, status);
      } else {
        next->stored.camera = baked->camera;
        next->stored.blobs = baked->bake.blobs;
        next->stored.notes = baked->bake.notes;
        next->stored.bake_stats = baked->bake.stats;
        ++next->changes;
        StartRendering(*next, committed);
        Log(CoordinatorLogEntry::Level::kInfo,
            std::string(baked->reused ? "bake reused, " : "baked, ") +
                std::to_string(next->tiles.size()) + " tiles are queued",
            id);
      }
      changed_.notify_all();
    }
  }

  struct Baked {
    StoredBake bake;
    Camera camera;
    bool reused = false;
  };

  // Without the lock.
  absl::StatusOr<Baked> BakeOrReuse(const JobSpec& spec, const std::atomic<bool>& stop) {
    Baked baked;
    const Digest key = BakeKey(spec);
    absl::StatusOr<std::optional<StoredBake>> known = store_->FindBake(key);
    if (!known.ok() && !absl::IsDataLoss(known.status()) &&
        !absl::IsInvalidArgument(known.status())) {
      return known.status();
    }
    if (known.ok() && known->has_value() && AllReadable((*known)->blobs)) {
      baked.bake = **std::move(known);
      baked.reused = true;
      // The time was spent by the job that baked.
      baked.bake.stats.seconds = {};
      baked.bake.stats.wall_seconds = {};
      baked.bake.stats.skipped["bake"] = 1;
    } else {
      AssetBundle asset;
      asset.root = spec.asset_root;
      uint64_t total = 0;
      for (const auto& [uri, digest] : spec.asset_files) {
        absl::StatusOr<Blob> blob = blobs_->Get(digest);
        if (!blob.ok()) return Annotate(blob.status(), "asset file '" + uri + "'");
        total += blob->size();
        asset.files.emplace(uri, *std::move(blob));
      }
      if (total > spec.limits.max_asset_bytes) {
        return absl::ResourceExhaustedError("the asset has " + std::to_string(total) +
                                            " bytes, the limit is " +
                                            std::to_string(spec.limits.max_asset_bytes));
      }
      FP_ASSIGN_OR_RETURN(BakeResult result, options_.baker->Bake(asset, spec, stop));
      FP_ASSIGN_OR_RETURN(baked.bake.blobs.prepared_scene, Keep(result.blobs.prepared_scene));
      FP_ASSIGN_OR_RETURN(baked.bake.blobs.tree_topology, Keep(result.blobs.tree_topology));
      FP_ASSIGN_OR_RETURN(baked.bake.blobs.tree_radiance, Keep(result.blobs.tree_radiance));
      baked.bake.cameras = std::move(result.cameras);
      baked.bake.made_up_camera = result.made_up_camera;
      baked.bake.notes = std::move(result.notes);
      baked.bake.stats = std::move(result.stats);
      FP_RETURN_IF_ERROR(store_->PutBake(key, baked.bake));
    }
    FP_RETURN_IF_ERROR(CheckLimit(baked.bake.stats, "triangles", spec.limits.max_triangles));
    FP_RETURN_IF_ERROR(CheckLimit(baked.bake.stats, "surfels", spec.limits.max_surfels));
    Scene cameras;
    cameras.cameras = baked.bake.cameras;
    FP_ASSIGN_OR_RETURN(baked.camera, ResolveCamera(spec.camera, cameras));
    if (baked.bake.made_up_camera && std::holds_alternative<LookAt>(spec.camera)) {
      std::erase_if(baked.bake.notes,
                    [](const std::string& note) { return note.starts_with("no camera"); });
    }
    return baked;
  }

  static absl::Status CheckLimit(const Stats& stats, const std::string& what, uint64_t limit) {
    const auto at = stats.counts.find(what);
    if (at == stats.counts.end() || at->second <= limit) return absl::OkStatus();
    return absl::ResourceExhaustedError("the scene has " + std::to_string(at->second) + " " + what +
                                        ", the limit is " + std::to_string(limit));
  }

  bool AllReadable(const SceneBlobs& blobs) {
    for (const Digest& d : {blobs.prepared_scene, blobs.tree_topology, blobs.tree_radiance}) {
      if (!d.empty() && !blobs_->Get(d).ok()) return false;
    }
    return true;
  }

  absl::StatusOr<Digest> Keep(const Blob& blob) {
    if (blob.size() == 0) return Digest{};
    const Digest digest = blob.Hash();
    FP_RETURN_IF_ERROR(blobs_->Put(digest, blob));
    return digest;
  }

  // --- Log ---

  void Log(CoordinatorLogEntry::Level level, std::string text, const JobId& job) const {
    if (options_.log) options_.log({.level = level, .text = std::move(text), .job = job});
  }
  void LogWorker(CoordinatorLogEntry::Level level, std::string text, const WorkerId& worker) const {
    if (options_.log) options_.log({.level = level, .text = std::move(text), .worker = worker});
  }
  void LogLease(CoordinatorLogEntry::Level level, std::string text, const LeaseGrant& grant) const {
    if (!options_.log) return;
    options_.log({.level = level,
                  .text = std::move(text),
                  .job = grant.job,
                  .tile = grant.tile,
                  .attempt = grant.attempt,
                  .worker = grant.worker});
  }

  const CoordinatorOptions options_;
  const std::shared_ptr<const Clock> clock_;
  const std::unique_ptr<BlobStore> blobs_;
  const std::unique_ptr<JobStore> store_;

  std::mutex mutex_;
  // Something that somebody waits for has happened: work, events, jobs to bake, the end.
  std::condition_variable changed_;
  std::condition_variable stop_ticker_;
  TileScheduler scheduler_;                     // guarded by mutex_
  std::map<JobId, std::shared_ptr<Job>> jobs_;  // guarded by mutex_, but for stop_bake
  std::map<JobId, uint64_t> saved_counters_;    // guarded by mutex_
  bool draining_ = false, stopping_ = false;    // guarded by mutex_
  std::thread ticker_, bakery_;
};

}  // namespace

absl::StatusOr<std::unique_ptr<Coordinator>> Coordinator::Open(CoordinatorOptions options) {
  FP_CHECK(options.baker != nullptr);
  std::string blob_folder;
  if (!options.store_directory.empty()) blob_folder = options.store_directory + "/blobs";
  // The job store first: it holds the lock of the folder.
  FP_ASSIGN_OR_RETURN(std::unique_ptr<JobStore> store, JobStore::Open(options.store_directory));
  FP_ASSIGN_OR_RETURN(std::unique_ptr<BlobStore> blobs,
                      BlobStore::Open(blob_folder, options.max_blob_bytes));
  auto coordinator =
      std::make_unique<CoordinatorImpl>(std::move(options), std::move(blobs), std::move(store));
  FP_RETURN_IF_ERROR(coordinator->Recover());
  return coordinator;
}

}  // namespace farpoint

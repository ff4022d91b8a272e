#include "server/coordinator_meter.h"

#include <algorithm>
#include <utility>

namespace farpoint {

namespace {

class MeteredBaker final : public SceneBaker {
 public:
  MeteredBaker(std::shared_ptr<SceneBaker> baker, std::shared_ptr<StageMeter> stages)
      : baker_(std::move(baker)), stages_(std::move(stages)) {}
  absl::StatusOr<BakeResult> Bake(const AssetBundle& asset, const JobSpec& spec,
                                  std::optional<double> time_s,
                                  const std::atomic<bool>& cancel) override {
    absl::StatusOr<BakeResult> result = baker_->Bake(asset, spec, time_s, cancel);
    if (result.ok()) stages_->Add(result->stats);
    return result;
  }

 private:
  const std::shared_ptr<SceneBaker> baker_;
  const std::shared_ptr<StageMeter> stages_;
};

double Value(const std::atomic<uint64_t>& counter) { return static_cast<double>(counter.load()); }

}  // namespace

void StageMeter::Add(const Stats& stats) {
  std::lock_guard lock(mutex_);
  for (int i = 0; i < kStageCount; ++i) seconds_[i] += stats.seconds[i];
}
std::array<double, kStageCount> StageMeter::Seconds() const {
  std::lock_guard lock(mutex_);
  return seconds_;
}
void StageMeter::AddTo(MetricsText& text) const {
  const std::array<double, kStageCount> seconds = Seconds();
  text.Family("farpoint_stage_seconds_total", "counter",
              "Thread-seconds of the stages of bakes and of accepted tiles.");
  for (int i = 0; i < kStageCount; ++i) text.Sample(seconds[i], {{"stage", kStageNames[i]}});
}

std::shared_ptr<SceneBaker> MakeMeteredBaker(std::shared_ptr<SceneBaker> baker,
                                             std::shared_ptr<StageMeter> stages) {
  return std::make_shared<MeteredBaker>(std::move(baker), std::move(stages));
}

void LossMeter::Count(LossCause cause) {
  if (cause != LossCause::kReported) ++lost_[static_cast<size_t>(cause)];
}
void LossMeter::AddTo(MetricsText& text) const {
  text.Family("farpoint_leases_lost_total", "counter",
              "Leases that were lost, by cause: the worker's connection broke, it was silent, its "
              "tile made no progress, or a render thread hung.");
  constexpr std::pair<LossCause, const char*> kNames[] = {
      {LossCause::kDisconnected, "disconnected"},
      {LossCause::kSilent, "silent"},
      {LossCause::kNoProgress, "no_progress"},
      {LossCause::kHung, "hung"}};
  for (const auto& [cause, name] : kNames) {
    text.Sample(Value(lost_[static_cast<size_t>(cause)]), {{"cause", name}});
  }
}

CoordinatorMeter::CoordinatorMeter(CoordinatorApi& coordinator, std::shared_ptr<StageMeter> stages,
                                   std::shared_ptr<LossMeter> losses)
    : coordinator_(coordinator), stages_(std::move(stages)), losses_(std::move(losses)) {}
CoordinatorMeter::~CoordinatorMeter() = default;

void CoordinatorMeter::Begin(const WorkerId& worker) {
  std::lock_guard lock(mutex_);
  begun_[worker] = Clock::now();
}
std::optional<double> CoordinatorMeter::End(const WorkerId& worker) {
  std::lock_guard lock(mutex_);
  const auto at = begun_.find(worker);
  if (at == begun_.end()) return std::nullopt;
  const double seconds = std::chrono::duration<double>(Clock::now() - at->second).count();
  begun_.erase(at);
  return seconds;
}

std::string CoordinatorMeter::Metrics(const Surroundings& surroundings) {
  const std::vector<JobStatus> jobs = coordinator_.Jobs();
  const std::vector<WorkerStatus> workers = coordinator_.Workers();
  {
    // Workers that were forgotten do not come back under their ids.
    std::lock_guard lock(mutex_);
    std::erase_if(begun_, [&](const auto& one) {
      return std::none_of(workers.begin(), workers.end(),
                          [&](const WorkerStatus& w) { return w.id == one.first; });
    });
  }
  TileCounts tiles;
  uint64_t reissued = 0, refused = 0, queue = 0;
  std::map<std::string_view, double> states;
  for (JobState state :
       {JobState::kQueued, JobState::kBaking, JobState::kRendering, JobState::kDone,
        JobState::kFailed, JobState::kCancelled, JobState::kPaused}) {
    states[NameOf(state)] = 0;
  }
  for (const JobStatus& job : jobs) {
    states[NameOf(job.state)] += 1;
    tiles.queued += job.tiles.queued;
    tiles.leased += job.tiles.leased;
    tiles.committed += job.tiles.committed;
    tiles.failed += job.tiles.failed;
    reissued += job.reissued;
    refused += job.refused_results;
    if (!IsFinal(job.state) && job.state != JobState::kPaused) queue += job.tiles.queued;
  }
  double busy = 0, set_aside = 0, gone = 0, threads = 0;
  for (const WorkerStatus& worker : workers) {
    if (worker.gone) {
      gone += 1;
      continue;
    }
    threads += worker.threads;
    if (worker.set_aside) {
      set_aside += 1;
    } else if (worker.leases > 0) {
      busy += 1;
    }
  }

  MetricsText text;
  text.Family("farpoint_jobs", "gauge", "Jobs that the coordinator knows, by state.");
  for (const auto& [state, count] : states) text.Sample(count, {{"state", state}});
  text.Family("farpoint_tiles", "gauge", "Tiles of all jobs that the coordinator knows, by state.");
  text.Sample(tiles.queued, {{"state", "queued"}});
  text.Sample(tiles.leased, {{"state", "leased"}});
  text.Sample(tiles.committed, {{"state", "committed"}});
  text.Sample(tiles.failed, {{"state", "failed"}});
  text.Single("farpoint_queue_tiles", "gauge",
              "Tiles that wait for a worker or a bake, of jobs that are neither paused nor ended.",
              static_cast<double>(queue));
  text.Family("farpoint_workers", "gauge", "Workers that are registered, by state.");
  text.Sample(busy, {{"state", "busy"}});
  text.Sample(static_cast<double>(workers.size()) - busy - set_aside - gone, {{"state", "idle"}});
  text.Sample(set_aside, {{"state", "set_aside"}});
  text.Sample(gone, {{"state", "gone"}});
  text.Single("farpoint_worker_threads", "gauge", "Threads of all workers that are there.",
              threads);
  text.Single("farpoint_worker_registrations_total", "counter", "Registrations of workers.",
              Value(registered_));
  text.Single("farpoint_submissions_total", "counter",
              "Jobs that were submitted; a repeated submission counts again.", Value(submitted_));

  text.Single("farpoint_leases_total", "counter", "Tiles that were leased, copies and audits too.",
              Value(leases_));
  text.Family("farpoint_lease_ends_total", "counter",
              "What workers said at the end of leases; those that were lost say nothing.");
  text.Sample(Value(accepted_), {{"outcome", "accepted"}});
  text.Sample(Value(refused_lease_) + Value(refused_damaged_), {{"outcome", "refused"}});
  text.Sample(Value(failed_), {{"outcome", "failed"}});
  text.Sample(Value(given_back_), {{"outcome", "given_back"}});
  if (losses_ != nullptr) losses_->AddTo(text);
  text.Family("farpoint_lease_seconds", "histogram", "From lease to accepted result.");
  text.Histogram(lease_times_.Read());
  text.Family(
      "farpoint_results_refused_total", "counter",
      "Results that were refused, by cause: the lease had ended, or the bytes were damaged.");
  text.Sample(Value(refused_lease_), {{"cause", "lease"}});
  text.Sample(Value(refused_damaged_), {{"cause", "damaged"}});
  text.Single("farpoint_tiles_reissued", "gauge",
              "Leases that were lost, of the jobs that the coordinator knows.",
              static_cast<double>(reissued));
  text.Single("farpoint_tiles_refused", "gauge",
              "Refused results of the jobs that the coordinator knows, restarts included.",
              static_cast<double>(refused));
  text.Family("farpoint_calls_refused_total", "counter",
              "Calls that were not admitted, by cause; with TLS only.");
  const AccessGuard::Refusals& calls = surroundings.refused;
  text.Sample(static_cast<double>(calls.unauthenticated), {{"cause", "unauthenticated"}});
  text.Sample(static_cast<double>(calls.permission_denied), {{"cause", "permission_denied"}});
  text.Sample(static_cast<double>(calls.too_many_calls), {{"cause", "too_many_calls"}});

  stages_->AddTo(text);
  text.Single("farpoint_tile_received_bytes_total", "counter",
              "Pixels that workers returned, refused ones too.", Value(tile_bytes_));
  if (const Traffic* traffic = surroundings.traffic) {
    text.Single("farpoint_broadcast_bytes_total", "counter",
                "Scenes and trees that were sent to workers.", Value(traffic->blobs_sent));
    text.Single("farpoint_scene_received_bytes_total", "counter", "Scene files that clients sent.",
                Value(traffic->blobs_received));
    text.Single("farpoint_tile_sent_bytes_total", "counter", "Pixels that clients fetched.",
                Value(traffic->tiles_sent));
  }
  text.Single("farpoint_connections", "gauge", "Connections of clients and workers.",
              static_cast<double>(surroundings.connections));
  text.Single("farpoint_draining", "gauge", "1 while the coordinator shuts down.",
              surroundings.draining ? 1 : 0);
  AddProcessMetrics(text);
  return text.Take();
}

absl::StatusOr<std::vector<Digest>> CoordinatorMeter::FindMissing(std::span<const Digest> digests) {
  return coordinator_.FindMissing(digests);
}
absl::Status CoordinatorMeter::PutBlob(const Digest& digest, const Blob& blob) {
  return coordinator_.PutBlob(digest, blob);
}
absl::StatusOr<std::unique_ptr<BlobWriter>> CoordinatorMeter::StartPut(const Digest& digest,
                                                                       uint64_t size_bytes) {
  return coordinator_.StartPut(digest, size_bytes);
}
absl::StatusOr<Blob> CoordinatorMeter::GetBlob(const Digest& digest) {
  return coordinator_.GetBlob(digest);
}
absl::StatusOr<JobId> CoordinatorMeter::Submit(const JobSpec& spec,
                                               const std::string& submission_id) {
  absl::StatusOr<JobId> job = coordinator_.Submit(spec, submission_id);
  if (job.ok()) ++submitted_;
  return job;
}
absl::StatusOr<JobStatus> CoordinatorMeter::Status(const JobId& job) {
  return coordinator_.Status(job);
}
std::vector<JobStatus> CoordinatorMeter::Jobs() { return coordinator_.Jobs(); }
std::vector<WorkerStatus> CoordinatorMeter::Workers() { return coordinator_.Workers(); }
absl::Status CoordinatorMeter::Cancel(const JobId& job) { return coordinator_.Cancel(job); }
absl::Status CoordinatorMeter::Pause(const JobId& job) { return coordinator_.Pause(job); }
absl::Status CoordinatorMeter::Resume(const JobId& job) { return coordinator_.Resume(job); }
absl::Status CoordinatorMeter::SetPriority(const JobId& job, int32_t priority) {
  return coordinator_.SetPriority(job, priority);
}
absl::Status CoordinatorMeter::Requeue(const JobId& job, bool all) {
  return coordinator_.Requeue(job, all);
}
absl::StatusOr<Explanation> CoordinatorMeter::Explain(const JobId& job) {
  return coordinator_.Explain(job);
}
absl::StatusOr<std::vector<JobEvent>> CoordinatorMeter::NextEvents(const JobId& job,
                                                                   uint64_t after_sequence,
                                                                   std::chrono::milliseconds wait) {
  return coordinator_.NextEvents(job, after_sequence, wait);
}
absl::StatusOr<JobInfo> CoordinatorMeter::FetchInfo(const JobId& job) {
  return coordinator_.FetchInfo(job);
}
absl::StatusOr<TileData> CoordinatorMeter::FetchTile(const JobId& job, uint32_t tile) {
  return coordinator_.FetchTile(job, tile);
}
absl::StatusOr<JobView> CoordinatorMeter::View(const JobId& job, uint32_t frame_index) {
  return coordinator_.View(job, frame_index);
}
absl::StatusOr<WorkerWelcome> CoordinatorMeter::Register(const WorkerHello& hello) {
  absl::StatusOr<WorkerWelcome> welcome = coordinator_.Register(hello);
  if (welcome.ok()) ++registered_;
  return welcome;
}
absl::StatusOr<std::optional<TileWork>> CoordinatorMeter::Lease(const WorkerId& worker,
                                                                std::chrono::milliseconds wait) {
  absl::StatusOr<std::optional<TileWork>> work = coordinator_.Lease(worker, wait);
  if (work.ok() && work->has_value()) {
    ++leases_;
    Begin(worker);
  }
  return work;
}
uint64_t CoordinatorMeter::AwaitWork(uint64_t seen, std::chrono::milliseconds wait) {
  return coordinator_.AwaitWork(seen, wait);
}

absl::StatusOr<RenewAnswer> CoordinatorMeter::Renew(const WorkerId& worker, const LeaseId& lease,
                                                    const LeaseProgress& progress) {
  return coordinator_.Renew(worker, lease, progress);
}
absl::StatusOr<ReturnAnswer> CoordinatorMeter::Return(const WorkerId& worker,
                                                      const TileResult& result) {
  tile_bytes_ += result.bytes.size();
  absl::StatusOr<ReturnAnswer> answer = coordinator_.Return(worker, result);
  if (!answer.ok()) return answer;
  if (answer->accepted) {
    ++accepted_;
    if (const std::optional<double> seconds = End(worker)) lease_times_.Observe(*seconds);
    stages_->Add(result.stats);
  } else {
    ++(answer->damaged ? refused_damaged_ : refused_lease_);
  }
  return answer;
}
absl::Status CoordinatorMeter::ReportFailure(const WorkerId& worker, const LeaseId& lease,
                                             bool given_back, const absl::Status& error) {
  const absl::Status status = coordinator_.ReportFailure(worker, lease, given_back, error);
  if (status.ok()) {
    ++(given_back ? given_back_ : failed_);
    (void)End(worker);
  }
  return status;
}
absl::Status CoordinatorMeter::Leave(const WorkerId& worker) {
  (void)End(worker);
  return coordinator_.Leave(worker);
}
absl::StatusOr<uint64_t> CoordinatorMeter::Attached(const WorkerId& worker) {
  return coordinator_.Attached(worker);
}
void CoordinatorMeter::Detached(const WorkerId& worker, uint64_t connection) {
  coordinator_.Detached(worker, connection);
}

}  // namespace farpoint

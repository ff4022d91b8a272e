// Counts what a coordinator is asked and answers, for Prometheus: a CoordinatorApi in front of
// another one. Thread-safe. Counters begin at 0 with the process.
#pragma once

#include <array>
#include <atomic>
#include <cstdint>
#include <map>
#include <memory>
#include <mutex>
#include <string>

#include "core/base/stats.h"
#include "proto/metrics_text.h"
#include "server/access_guard.h"
#include "server/coordinator.h"
#include "server/scene_baker.h"
#include "server/server_facts.h"

namespace farpoint {

// Seconds of stages, together: those of bakes and of tiles that were accepted.
class StageMeter {
 public:
  void Add(const Stats& stats);
  // Thread-seconds.
  std::array<double, kStageCount> Seconds() const;
  void AddTo(MetricsText& text) const;

 private:
  mutable std::mutex mutex_;
  std::array<double, kStageCount> seconds_{};  // guarded by mutex_
};

// A baker whose bakes are counted; `stages` is shared with the meter below.
std::shared_ptr<SceneBaker> MakeMeteredBaker(std::shared_ptr<SceneBaker> baker,
                                             std::shared_ptr<StageMeter> stages);

// Leases that were lost, by cause. Thread-safe.
class LossMeter {
 public:
  void Count(LossCause cause);  // nothing for kReported
  void AddTo(MetricsText& text) const;

 private:
  static constexpr size_t kCauses = static_cast<size_t>(LossCause::kHung) + 1;
  std::array<std::atomic<uint64_t>, kCauses> lost_{};
};

class CoordinatorMeter : public CoordinatorApi {
 public:
  // `coordinator` must outlive this. `losses` is counted by whoever hears of them
  // (CoordinatorOptions::log); null: none.
  CoordinatorMeter(CoordinatorApi& coordinator, std::shared_ptr<StageMeter> stages,
                   std::shared_ptr<LossMeter> losses = nullptr);
  ~CoordinatorMeter() override;

  // What lies beyond the coordinator; none of it is needed.
  struct Surroundings {
    const Traffic* traffic = nullptr;
    uint64_t connections = 0;
    AccessGuard::Refusals refused;
    bool draining = false;
  };
  // All families, in the text format. Takes the coordinator's lock twice, for microseconds.
  std::string Metrics(const Surroundings& surroundings);

  absl::StatusOr<std::vector<Digest>> FindMissing(std::span<const Digest> digests) override;
  absl::Status PutBlob(const Digest& digest, const Blob& blob) override;
  absl::StatusOr<std::unique_ptr<BlobWriter>> StartPut(const Digest& digest,
                                                       uint64_t size_bytes) override;
  absl::StatusOr<Blob> GetBlob(const Digest& digest) override;
  absl::StatusOr<JobId> Submit(const JobSpec& spec, const std::string& submission_id) override;
  absl::StatusOr<JobStatus> Status(const JobId& job) override;
  std::vector<JobStatus> Jobs() override;
  std::vector<WorkerStatus> Workers() override;
  absl::Status Cancel(const JobId& job) override;
  absl::Status Pause(const JobId& job) override;
  absl::Status Resume(const JobId& job) override;
  absl::Status SetPriority(const JobId& job, int32_t priority) override;
  absl::Status Requeue(const JobId& job, bool all) override;
  absl::StatusOr<Explanation> Explain(const JobId& job) override;
  absl::StatusOr<std::vector<JobEvent>> NextEvents(const JobId& job, uint64_t after_sequence,
                                                   std::chrono::milliseconds wait) override;
  absl::StatusOr<JobInfo> FetchInfo(const JobId& job) override;
  absl::StatusOr<TileData> FetchTile(const JobId& job, uint32_t tile) override;
  absl::StatusOr<JobView> View(const JobId& job, uint32_t frame_index) override;
  absl::StatusOr<WorkerWelcome> Register(const WorkerHello& hello) override;
  absl::StatusOr<std::optional<TileWork>> Lease(const WorkerId& worker,
                                                std::chrono::milliseconds wait) override;
  uint64_t AwaitWork(uint64_t seen, std::chrono::milliseconds wait) override;
  absl::StatusOr<RenewAnswer> Renew(const WorkerId& worker, const LeaseId& lease,
                                    const LeaseProgress& progress) override;
  absl::StatusOr<ReturnAnswer> Return(const WorkerId& worker, const TileResult& result) override;
  absl::Status ReportFailure(const WorkerId& worker, const LeaseId& lease, bool given_back,
                             const absl::Status& error) override;
  absl::Status Leave(const WorkerId& worker) override;
  absl::StatusOr<uint64_t> Attached(const WorkerId& worker) override;
  void Detached(const WorkerId& worker, uint64_t connection) override;

 private:
  using Clock = std::chrono::steady_clock;
  // When a worker's lease began; a worker has one at a time.
  void Begin(const WorkerId& worker);
  std::optional<double> End(const WorkerId& worker);

  CoordinatorApi& coordinator_;
  const std::shared_ptr<StageMeter> stages_;
  const std::shared_ptr<LossMeter> losses_;
  std::atomic<uint64_t> leases_{0}, given_back_{0}, failed_{0};
  std::atomic<uint64_t> accepted_{0}, refused_lease_{0}, refused_damaged_{0};
  std::atomic<uint64_t> registered_{0}, submitted_{0}, tile_bytes_{0};
  DurationHistogram lease_times_;
  std::mutex mutex_;
  std::map<WorkerId, Clock::time_point> begun_;  // guarded by mutex_
};

}  // namespace farpoint

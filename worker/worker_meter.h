// Counts what a worker asks its coordinator for and what it returns, for Prometheus: a link in
// front of another one. Thread-safe. Counters begin at 0 with the process.
#pragma once

#include <array>
#include <atomic>
#include <cstdint>
#include <mutex>
#include <string>

#include "core/base/stats.h"
#include "proto/metrics_text.h"
#include "worker/blob_cache.h"
#include "worker/coordinator_link.h"

namespace farpoint {

class WorkerMeter final : public CoordinatorLink, public BlobStreamer {
 public:
  // Both must outlive this; they may be one object.
  WorkerMeter(CoordinatorLink& link, BlobStreamer& streamer) : link_(link), streamer_(streamer) {}

  // All families, in the text format.
  std::string Metrics(const BlobCache::Finds& finds, unsigned threads) const;

  absl::StatusOr<WorkerWelcome> Register(const WorkerHello& hello) override;
  absl::StatusOr<std::optional<TileWork>> Lease(const WorkerId& worker,
                                                std::chrono::milliseconds wait) override;
  absl::StatusOr<RenewAnswer> Renew(const WorkerId& worker, const LeaseId& lease,
                                    const LeaseProgress& progress) override;
  absl::StatusOr<ReturnAnswer> Return(const WorkerId& worker, const TileResult& result) override;
  absl::Status ReportFailure(const WorkerId& worker, const LeaseId& lease, bool given_back,
                             const absl::Status& error) override;
  absl::Status Leave(const WorkerId& worker) override { return link_.Leave(worker); }
  void Attend(const WorkerId& worker) override { link_.Attend(worker); }
  void CancelWaits() override { link_.CancelWaits(); }
  absl::Status Stream(const Digest& digest, uint64_t offset_bytes, const Sink& sink) override;

 private:
  using Clock = std::chrono::steady_clock;

  CoordinatorLink& link_;
  BlobStreamer& streamer_;
  std::atomic<uint64_t> registered_{0}, leases_{0}, failed_calls_{0};
  std::atomic<uint64_t> accepted_{0}, refused_{0}, failed_{0}, given_back_{0};
  std::atomic<uint64_t> tile_bytes_{0}, blob_bytes_{0};
  DurationHistogram tile_times_;
  mutable std::mutex mutex_;
  Clock::time_point leased_at_;                 // guarded by mutex_, as all below
  bool leased_ = false;                         // a tile is in work
  double idle_s_ = 0;                           // in calls of Lease
  std::array<double, kStageCount> stages_s_{};  // of accepted tiles
};

}  // namespace farpoint

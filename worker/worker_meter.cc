#include "worker/worker_meter.h"

namespace farpoint {

namespace {

double Value(const std::atomic<uint64_t>& counter) { return static_cast<double>(counter.load()); }

}  // namespace

absl::StatusOr<WorkerWelcome> WorkerMeter::Register(const WorkerHello& hello) {
  absl::StatusOr<WorkerWelcome> welcome = link_.Register(hello);
  ++(welcome.ok() ? registered_ : failed_calls_);
  return welcome;
}

absl::StatusOr<std::optional<TileWork>> WorkerMeter::Lease(const WorkerId& worker,
                                                           std::chrono::milliseconds wait) {
  const Clock::time_point start = Clock::now();
  absl::StatusOr<std::optional<TileWork>> work = link_.Lease(worker, wait);
  if (!work.ok() && !absl::IsCancelled(work.status())) ++failed_calls_;
  const bool leased = work.ok() && work->has_value();
  if (leased) ++leases_;
  const Clock::time_point end = Clock::now();
  std::lock_guard lock(mutex_);
  idle_s_ += std::chrono::duration<double>(end - start).count();
  leased_ = leased;
  leased_at_ = end;
  return work;
}

absl::StatusOr<RenewAnswer> WorkerMeter::Renew(const WorkerId& worker, const LeaseId& lease,
                                               const LeaseProgress& progress) {
  absl::StatusOr<RenewAnswer> answer = link_.Renew(worker, lease, progress);
  if (!answer.ok()) ++failed_calls_;
  return answer;
}

absl::StatusOr<ReturnAnswer> WorkerMeter::Return(const WorkerId& worker, const TileResult& result) {
  absl::StatusOr<ReturnAnswer> answer = link_.Return(worker, result);
  if (!answer.ok()) {
    ++failed_calls_;
    return answer;
  }
  tile_bytes_ += result.bytes.size();
  ++(answer->accepted ? accepted_ : refused_);
  std::lock_guard lock(mutex_);
  leased_ = false;
  if (!answer->accepted) return answer;
  tile_times_.Observe(std::chrono::duration<double>(Clock::now() - leased_at_).count());
  for (int i = 0; i < kStageCount; ++i) stages_s_[i] += result.stats.seconds[i];
  return answer;
}

absl::Status WorkerMeter::ReportFailure(const WorkerId& worker, const LeaseId& lease,
                                        bool given_back, const absl::Status& error) {
  const absl::Status status = link_.ReportFailure(worker, lease, given_back, error);
  if (!status.ok()) ++failed_calls_;
  ++(given_back ? given_back_ : failed_);
  std::lock_guard lock(mutex_);
  leased_ = false;
  return status;
}

absl::Status WorkerMeter::Stream(const Digest& digest, uint64_t offset_bytes, const Sink& sink) {
  return streamer_.Stream(digest, offset_bytes,
                          [&](uint64_t size_bytes, std::span<const std::byte> data) {
                            blob_bytes_ += data.size();
                            return sink(size_bytes, data);
                          });
}

std::string WorkerMeter::Metrics(const BlobCache::Finds& finds, unsigned threads) const {
  MetricsText text;
  double idle_s = 0;
  std::array<double, kStageCount> stages_s{};
  bool leased = false;
  {
    std::lock_guard lock(mutex_);
    idle_s = idle_s_;
    stages_s = stages_s_;
    leased = leased_;
  }
  text.Single("farpoint_worker_busy", "gauge", "1 while a tile is in work.", leased ? 1 : 0);
  text.Single("farpoint_worker_threads", "gauge", "Threads that render.", threads);
  text.Single("farpoint_worker_registrations_total", "counter",
              "Registrations at the coordinator; more than one: it was restarted or lost sight.",
              Value(registered_));
  text.Single("farpoint_worker_leases_total", "counter", "Tiles that were leased.", Value(leases_));
  text.Family("farpoint_worker_tiles_total", "counter", "Tiles by what became of them.");
  text.Sample(Value(accepted_), {{"outcome", "accepted"}});
  text.Sample(Value(refused_), {{"outcome", "refused"}});
  text.Sample(Value(failed_), {{"outcome", "failed"}});
  text.Sample(Value(given_back_), {{"outcome", "given_back"}});
  text.Family("farpoint_worker_tile_seconds", "histogram", "From lease to accepted result.");
  text.Histogram(tile_times_.Read());
  text.Single("farpoint_worker_waiting_seconds_total", "counter", "Time without a tile.", idle_s);
  text.Single("farpoint_worker_failed_calls_total", "counter",
              "Calls to the coordinator that failed, to be tried again.", Value(failed_calls_));
  text.Family("farpoint_stage_seconds_total", "counter",
              "Thread-seconds of the stages of accepted tiles.");
  for (int i = 0; i < kStageCount; ++i) text.Sample(stages_s[i], {{"stage", kStageNames[i]}});
  text.Family("farpoint_worker_blobs_total", "counter",
              "Scenes and trees that were needed, by where they were.");
  text.Sample(static_cast<double>(finds.cache), {{"source", "cache"}});
  text.Sample(static_cast<double>(finds.shared_folder), {{"source", "shared_folder"}});
  text.Sample(static_cast<double>(finds.coordinator), {{"source", "coordinator"}});
  text.Single("farpoint_worker_blob_received_bytes_total", "counter",
              "Scenes and trees that the coordinator sent.", Value(blob_bytes_));
  text.Single("farpoint_worker_tile_sent_bytes_total", "counter", "Pixels that were returned.",
              Value(tile_bytes_));
  AddProcessMetrics(text);
  return text.Take();
}

}  // namespace farpoint

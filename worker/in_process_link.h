// A worker and a coordinator in one process: calls instead of messages, blobs shared instead of
// copied. `Api` is CoordinatorApi (server/coordinator.h) or anything with its methods; being a
// template keeps the worker free of the server's headers.
#pragma once

#include <algorithm>
#include <atomic>

#include "worker/coordinator_link.h"

namespace farpoint {

template <typename Api>
class InProcessLink final : public CoordinatorLink, public BlobSource {
 public:
  // `api` must outlive this.
  explicit InProcessLink(Api& api) : api_(api) {}

  absl::StatusOr<WorkerWelcome> Register(const WorkerHello& hello) override {
    return api_.Register(hello);
  }
  absl::StatusOr<std::optional<TileWork>> Lease(const WorkerId& worker,
                                                std::chrono::milliseconds wait) override {
    // In slices, so that CancelWaits is heard.
    constexpr std::chrono::milliseconds kSlice{100};
    for (;;) {
      if (cancelled_.load()) return absl::CancelledError("the worker stops");
      auto work = api_.Lease(worker, std::min(wait, kSlice));
      if (!work.ok() || work->has_value() || wait <= kSlice) return work;
      wait -= kSlice;
    }
  }
  absl::StatusOr<RenewAnswer> Renew(const WorkerId& worker, const LeaseId& lease,
                                    const LeaseProgress& progress) override {
    return api_.Renew(worker, lease, progress);
  }
  absl::StatusOr<ReturnAnswer> Return(const WorkerId& worker, const TileResult& result) override {
    return api_.Return(worker, result);
  }
  absl::Status ReportFailure(const WorkerId& worker, const LeaseId& lease, bool given_back,
                             const absl::Status& error) override {
    return api_.ReportFailure(worker, lease, given_back, error);
  }
  absl::Status Leave(const WorkerId& worker) override { return api_.Leave(worker); }
  void CancelWaits() override { cancelled_ = true; }

  absl::StatusOr<Blob> Get(const Digest& digest, const std::function<bool()>& progress) override {
    if (progress && !progress()) return absl::CancelledError("the tile was dropped");
    return api_.GetBlob(digest);
  }

 private:
  Api& api_;
  std::atomic<bool> cancelled_ = false;
};

}  // namespace farpoint

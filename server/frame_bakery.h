// The bake of one frame of a job: found again by its key, or made, and its blobs kept. The step
// between the coordinator, which decides when, and SceneBaker, which does it.
#pragma once

#include <atomic>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "core/base/stats.h"
#include "core/base/status.h"
#include "proto/job.h"
#include "server/blob_store.h"
#include "server/job_store.h"
#include "server/scene_baker.h"

namespace farpoint {

struct FrameBake {
  StoredFrame frame;
  std::vector<std::string> notes;
  Stats stats;  // of a reused bake: no seconds, and skipped["bake"] is 1
  bool reused = false;
  bool animated = false;  // another frame may have other blobs
};

// Thread-safe.
class FrameBakery {
 public:
  // `blobs` and `store` must outlive this.
  FrameBakery(std::shared_ptr<SceneBaker> baker, BlobStore& blobs, JobStore& store)
      : baker_(std::move(baker)), blobs_(blobs), store_(store) {}

  // Frame `index` of `spec`. kCancelled soon after `stop` is set; errors of SceneBaker::Bake, those
  // of the stores, kNotFound for a camera that the scene does not have at that time, and
  // kResourceExhausted for a limit of the job.
  absl::StatusOr<FrameBake> Bake(const JobSpec& spec, uint32_t index,
                                 const std::atomic<bool>& stop);

 private:
  absl::StatusOr<std::optional<StoredBake>> Find(const Digest& key);
  absl::StatusOr<StoredBake> Make(const JobSpec& spec, std::optional<double> time_s,
                                  const std::atomic<bool>& stop);
  absl::StatusOr<Digest> Keep(const Blob& blob);

  const std::shared_ptr<SceneBaker> baker_;
  BlobStore& blobs_;
  JobStore& store_;
};

}  // namespace farpoint

// A worker's blobs on disk: files named by their SHA-256, mapped into memory. A blob is fetched
// once, in <name>.part, and renamed when its hash is right; an interrupted download goes on where
// it stopped, in the next process too. Several workers may share the folder. Thread-safe.
#pragma once

#include <atomic>
#include <cstdint>
#include <functional>
#include <memory>
#include <mutex>
#include <set>
#include <string>

#include "core/base/blob.h"
#include "core/base/hash.h"
#include "core/base/status.h"
#include "worker/coordinator_link.h"

namespace farpoint {

struct BlobCacheOptions {
  std::string directory;                        // created if absent
  uint64_t max_bytes = uint64_t{64} << 30;      // the least recently used go first
  uint64_t max_blob_bytes = uint64_t{1} << 36;  // larger ones are refused before they are fetched
  // Told what the owner of the disk should know; may be empty. From any thread.
  std::function<void(const std::string&)> warn;
  // A folder of blobs by their names that others fill, on a site's shared file system; blobs are
  // copied from there, and asked of the coordinator only if they are not there or damaged. May be
  // empty.
  std::string shared_directory;
};

class BlobCache final : public BlobSource {
 public:
  // `streamer` must outlive this.
  static absl::StatusOr<std::unique_ptr<BlobCache>> Open(const BlobCacheOptions& options,
                                                         BlobStreamer& streamer);

  // From the folder if it is there and undamaged (its hash is checked when this process first uses
  // it), else from the shared folder, else from the coordinator. Waits while another worker fetches
  // the same blob; an interrupted transfer is taken up again for some seconds after its last byte.
  // kDataLoss if what arrives has the wrong hash twice, kUnavailable if the disk is full.
  absl::StatusOr<Blob> Get(const Digest& digest, const std::function<bool()>& progress) override;

  // Where the blobs that Get returned were, since the start.
  struct Finds {
    uint64_t cache = 0, shared_folder = 0, coordinator = 0;
  };
  Finds finds() const { return {in_cache_, in_shared_folder_, at_coordinator_}; }

 private:
  BlobCache(BlobCacheOptions options, BlobStreamer& streamer)
      : options_(std::move(options)), streamer_(streamer) {}
  std::string PathOf(const Digest& digest) const { return options_.directory + "/" + digest.Hex(); }
  absl::StatusOr<Blob> FromFolder(const Digest& digest);
  absl::Status FetchFromAnywhere(const Digest& digest, const std::function<bool()>& progress);
  absl::Status FetchPatiently(const Digest& digest, const std::function<bool()>& progress);
  // Once; `received` grows by the bytes that came.
  absl::Status Fetch(const Digest& digest, const std::function<bool()>& progress,
                     BlobStreamer& from, uint64_t& received);
  void Evict(const Digest& but);

  const BlobCacheOptions options_;
  BlobStreamer& streamer_;
  std::atomic<uint64_t> in_cache_{0}, in_shared_folder_{0}, at_coordinator_{0};
  std::mutex mutex_;
  std::set<Digest> verified_;  // guarded by mutex_
};

}  // namespace farpoint

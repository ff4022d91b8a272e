// The coordinator's blobs: scene files, prepared scenes, point trees. A folder of files named by
// their SHA-256, or memory. A file is written as .part, flushed and renamed, so that a name means a
// whole file; its hash is verified when it arrives and again when this process first reads it.
// Thread-safe.
#pragma once

#include <chrono>
#include <cstdint>
#include <map>
#include <memory>
#include <mutex>
#include <set>
#include <span>
#include <string>
#include <vector>

#include "core/base/blob.h"
#include "core/base/hash.h"
#include "core/base/status.h"
#include "server/blob_writer.h"

namespace farpoint {

class BlobStore {
 public:
  // Creates the folder if it is absent and drops unfinished files. An empty path: in memory.
  static absl::StatusOr<std::unique_ptr<BlobStore>> Open(const std::string& directory,
                                                         uint64_t max_blob_bytes);

  bool Contains(const Digest& digest) const;
  // kNotFound; kDataLoss if the file was damaged, which is then removed.
  absl::StatusOr<Blob> Get(const Digest& digest);
  // kDataLoss unless `digest` is the blob's hash. Durable when it returns.
  absl::Status Put(const Digest& digest, const Blob& blob);
  // kResourceExhausted if `size_bytes` is over the limit. The writer must not outlive the store.
  absl::StatusOr<std::unique_ptr<BlobWriter>> StartPut(const Digest& digest, uint64_t size_bytes);

  // Forgets a blob; Blobs already handed out stay valid.
  void Drop(const Digest& digest);

  // Removes the files that nobody put, got or asked for during the last `age`, except those in
  // `needed`; Blobs already handed out stay valid. Returns how many. In memory nothing is removed.
  size_t RemoveUnused(const std::set<Digest>& needed, std::chrono::seconds age);

 private:
  BlobStore(std::string directory, uint64_t max_blob_bytes)
      : directory_(std::move(directory)), max_blob_bytes_(max_blob_bytes) {}
  friend class FileBlobWriter;
  friend class MemoryBlobWriter;

  bool in_memory() const { return directory_.empty(); }
  std::string PathOf(const Digest& digest) const { return directory_ + "/" + digest.Hex(); }

  const std::string directory_;
  const uint64_t max_blob_bytes_;
  mutable std::mutex mutex_;
  std::map<Digest, Blob> memory_;  // guarded by mutex_
  std::set<Digest> verified_;      // files whose hash this process has checked; by mutex_
  uint64_t next_part_ = 0;         // by mutex_
};

}  // namespace farpoint

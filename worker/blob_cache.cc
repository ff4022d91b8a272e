#include "worker/blob_cache.h"

#include <fcntl.h>
#include <sys/file.h>
#include <sys/stat.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <chrono>
#include <filesystem>
#include <thread>
#include <vector>

#include "core/base/posix_file.h"

namespace farpoint {

namespace fs = std::filesystem;

namespace {

// Tries without a byte in between before a transfer is given up, and the waits between them.
constexpr int kIdleTries = 10;
constexpr std::chrono::milliseconds kFirstWait{100};
constexpr std::chrono::milliseconds kLastWait{1000};

absl::Status Cancelled() { return absl::CancelledError("the tile was dropped"); }

// Blobs that lie in a folder as files of their names.
class FolderStreamer final : public BlobStreamer {
 public:
  explicit FolderStreamer(const std::string& directory) : directory_(directory) {}
  absl::Status Stream(const Digest& digest, uint64_t offset_bytes, const Sink& sink) override {
    const std::string path = directory_ + "/" + digest.Hex();
    const Descriptor file(::open(path.c_str(), O_RDONLY | O_CLOEXEC));
    if (!file.valid()) return FileError("cannot open", path, errno);
    struct stat info {};
    if (::fstat(file.get(), &info) != 0) return FileError("cannot examine", path, errno);
    const auto size = static_cast<uint64_t>(info.st_size);
    if (offset_bytes > size) return absl::OutOfRangeError("'" + path + "' is shorter");
    std::vector<std::byte> buffer(kChunkBytes);
    uint64_t at = offset_bytes;
    do {
      const size_t want = static_cast<size_t>(std::min<uint64_t>(buffer.size(), size - at));
      const ssize_t n = ::pread(file.get(), buffer.data(), want, static_cast<off_t>(at));
      if (n < 0 && errno == EINTR) continue;
      if (n < 0 || (n == 0 && want > 0)) {
        return FileError("cannot read", path, n == 0 ? EIO : errno);
      }
      FP_RETURN_IF_ERROR(sink(size, std::span(buffer.data(), static_cast<size_t>(n))));
      at += static_cast<uint64_t>(n);
    } while (at < size);
    return absl::OkStatus();
  }

 private:
  const std::string& directory_;
};

// Adds the file's first `size` bytes to `hash`.
absl::Status HashStart(int fd, uint64_t size, const std::string& path, Sha256& hash) {
  std::vector<std::byte> buffer(kChunkBytes);
  uint64_t at = 0;
  while (at < size) {
    const size_t want = static_cast<size_t>(std::min<uint64_t>(buffer.size(), size - at));
    const ssize_t n = ::pread(fd, buffer.data(), want, static_cast<off_t>(at));
    if (n < 0 && errno == EINTR) continue;
    if (n <= 0) return DiskError("cannot read", path, n == 0 ? EIO : errno);
    hash.Update(std::span(buffer.data(), static_cast<size_t>(n)));
    at += static_cast<uint64_t>(n);
  }
  return absl::OkStatus();
}

}  // namespace

absl::StatusOr<std::unique_ptr<BlobCache>> BlobCache::Open(const BlobCacheOptions& options,
                                                           BlobStreamer& streamer) {
  std::error_code error;
  fs::create_directories(options.directory, error);
  if (error) return DiskError("cannot create", options.directory, error.value());
  return std::unique_ptr<BlobCache>(new BlobCache(options, streamer));
}

absl::StatusOr<Blob> BlobCache::FromFolder(const Digest& digest) {
  const std::string path = PathOf(digest);
  FP_ASSIGN_OR_RETURN(Blob blob, Blob::MapFile(path));
  ::utimensat(AT_FDCWD, path.c_str(), nullptr, 0);  // last use, for Evict
  {
    std::lock_guard lock(mutex_);
    if (verified_.contains(digest)) return blob;
  }
  if (blob.Hash() != digest) {
    ::unlink(path.c_str());
    const std::string text = "'" + path + "' was damaged and is removed; it is fetched again";
    if (options_.warn) options_.warn(text);
    return absl::NotFoundError(text);
  }
  std::lock_guard lock(mutex_);
  verified_.insert(digest);
  return blob;
}

absl::StatusOr<Blob> BlobCache::Get(const Digest& digest, const std::function<bool()>& progress) {
  absl::StatusOr<Blob> blob = FromFolder(digest);
  if (blob.ok()) ++in_cache_;
  if (blob.ok() || !absl::IsNotFound(blob.status())) return blob;
  FP_RETURN_IF_ERROR(FetchFromAnywhere(digest, progress));
  blob = FromFolder(digest);
  Evict(digest);
  return blob;
}

absl::Status BlobCache::FetchFromAnywhere(const Digest& digest,
                                          const std::function<bool()>& progress) {
  if (!options_.shared_directory.empty()) {
    FolderStreamer folder(options_.shared_directory);
    uint64_t received = 0;
    const absl::Status fetched = Fetch(digest, progress, folder, received);
    if (fetched.ok()) ++in_shared_folder_;
    if (fetched.ok() || absl::IsCancelled(fetched) || absl::IsResourceExhausted(fetched)) {
      return fetched;
    }
    if (!absl::IsNotFound(fetched) && options_.warn) {
      options_.warn(std::string(fetched.message()) + "; the coordinator is asked instead");
    }
  }
  absl::Status fetched = FetchPatiently(digest, progress);
  // A part that an earlier process left may be damaged: once more, from the start.
  if (absl::IsDataLoss(fetched)) fetched = FetchPatiently(digest, progress);
  if (fetched.ok()) ++at_coordinator_;
  return fetched;
}

absl::Status BlobCache::FetchPatiently(const Digest& digest,
                                       const std::function<bool()>& progress) {
  auto wait = kFirstWait;
  for (int idle = 0;;) {
    uint64_t received = 0;
    const absl::Status fetched = Fetch(digest, progress, streamer_, received);
    if (!absl::IsUnavailable(fetched) && !absl::IsDeadlineExceeded(fetched)) return fetched;
    if (received > 0) {
      idle = 0;
      wait = kFirstWait;
    } else if (++idle == kIdleTries) {
      return fetched;
    }
    if (progress && !progress()) return Cancelled();
    std::this_thread::sleep_for(wait);
    wait = std::min(wait * 2, kLastWait);
  }
}

absl::Status BlobCache::Fetch(const Digest& digest, const std::function<bool()>& progress,
                              BlobStreamer& from, uint64_t& received) {
  const std::string path = PathOf(digest);
  const std::string part = path + ".part";
  Descriptor file;
  for (;;) {
    file.Reset(::open(part.c_str(), O_RDWR | O_CREAT | O_CLOEXEC, 0644));
    if (!file.valid()) return DiskError("cannot create", part, errno);
    while (::flock(file.get(), LOCK_EX | LOCK_NB) != 0) {
      if (errno != EWOULDBLOCK && errno != EINTR) return DiskError("cannot lock", part, errno);
      if (progress && !progress()) return Cancelled();
      std::this_thread::sleep_for(std::chrono::milliseconds(50));
    }
    // Whoever had the lock may have finished the file or thrown it away.
    struct stat now {
    }, opened{};
    if (::fstat(file.get(), &opened) == 0 && ::stat(part.c_str(), &now) == 0 &&
        now.st_ino == opened.st_ino) {
      break;
    }
    file.Reset();
    if (::access(path.c_str(), F_OK) == 0) return absl::OkStatus();
  }
  struct stat info {};
  if (::fstat(file.get(), &info) != 0) return DiskError("cannot examine", part, errno);
  uint64_t have = static_cast<uint64_t>(info.st_size);
  Sha256 hash;
  FP_RETURN_IF_ERROR(HashStart(file.get(), have, part, hash));

  uint64_t total = have;
  const auto throw_away = [&](const absl::Status& status) {
    ::unlink(part.c_str());
    return status;
  };
  const absl::Status streamed = from.Stream(
      digest, have, [&](uint64_t size, std::span<const std::byte> data) -> absl::Status {
        if (progress && !progress()) return Cancelled();
        if (size > options_.max_blob_bytes) {
          return absl::ResourceExhaustedError("blob " + digest.Hex() + " has " +
                                              std::to_string(size) + " bytes, the cache takes " +
                                              std::to_string(options_.max_blob_bytes));
        }
        total = size;
        if (have > size || data.size() > size - have) {
          return absl::DataLossError("blob " + digest.Hex() + " is longer than announced");
        }
        FP_RETURN_IF_ERROR(WriteAllAt(file.get(), have, data, part));
        hash.Update(data);
        have += data.size();
        received += data.size();
        return absl::OkStatus();
      });
  if (!streamed.ok()) {
    const absl::Status told = Annotate(streamed, "blob " + digest.Hex());
    // An offset beyond the end: the part is not of this blob.
    if (absl::IsOutOfRange(streamed)) return throw_away(absl::DataLossError(told.message()));
    return absl::IsDataLoss(streamed) ? throw_away(told) : told;
  }
  if (have != total) {
    return absl::UnavailableError("blob " + digest.Hex() + " ended after " + std::to_string(have) +
                                  " of " + std::to_string(total) + " bytes");
  }
  if (hash.Finish() != digest) {
    return throw_away(absl::DataLossError("blob " + digest.Hex() + " arrived with other contents"));
  }
  if (::fsync(file.get()) != 0) return DiskError("cannot flush", part, errno);
  if (::rename(part.c_str(), path.c_str()) != 0) return DiskError("cannot rename to", path, errno);
  std::lock_guard lock(mutex_);
  verified_.insert(digest);
  return absl::OkStatus();
}

void BlobCache::Evict(const Digest& but) {
  struct Entry {
    fs::file_time_type used;
    uint64_t size;
    Digest digest;
  };
  std::vector<Entry> entries;
  uint64_t total = 0;
  std::error_code error;
  for (fs::directory_iterator at(options_.directory, error), end; !error && at != end;
       at.increment(error)) {
    const absl::StatusOr<Digest> digest = Digest::FromHex(at->path().filename().string());
    if (!digest.ok()) continue;
    std::error_code ignored;
    const Entry entry{at->last_write_time(ignored), at->file_size(ignored), *digest};
    if (ignored) continue;  // another worker removed it
    entries.push_back(entry);
    total += entry.size;
  }
  std::sort(entries.begin(), entries.end(),
            [](const Entry& a, const Entry& b) { return a.used < b.used; });
  for (const Entry& entry : entries) {
    if (total <= options_.max_bytes) return;
    if (entry.digest == but) continue;
    // Whoever has it mapped keeps it until it is done.
    ::unlink(PathOf(entry.digest).c_str());
    std::lock_guard lock(mutex_);
    verified_.erase(entry.digest);
    total -= entry.size;
  }
}

}  // namespace farpoint

#include "server/blob_store.h"

#include <fcntl.h>
#include <sys/stat.h>
#include <unistd.h>

#include <cerrno>
#include <filesystem>

#include "core/base/posix_file.h"

namespace farpoint {

namespace fs = std::filesystem;

namespace {

absl::Status WrongHash(const Digest& digest, const Digest& found) {
  return absl::DataLossError("blob " + digest.Hex() + " arrived with the contents of " +
                             found.Hex() + "; send it again");
}

}  // namespace

class FileBlobWriter final : public BlobWriter {
 public:
  FileBlobWriter(BlobStore& store, const Digest& digest, uint64_t size, std::string part,
                 Descriptor file)
      : store_(store),
        digest_(digest),
        size_(size),
        part_(std::move(part)),
        file_(std::move(file)) {}
  ~FileBlobWriter() override {
    if (file_.valid()) ::unlink(part_.c_str());
  }

  absl::Status Append(std::span<const std::byte> data) override {
    if (data.size() > size_ - written_) {
      return absl::InvalidArgumentError("blob " + digest_.Hex() + " was announced with " +
                                        std::to_string(size_) + " bytes, more arrive");
    }
    hash_.Update(data);
    FP_RETURN_IF_ERROR(WriteAll(file_.get(), data, part_));
    written_ += data.size();
    return absl::OkStatus();
  }

  absl::Status Commit() override {
    if (written_ != size_) {
      return absl::DataLossError("blob " + digest_.Hex() + " ended after " +
                                 std::to_string(written_) + " of " + std::to_string(size_) +
                                 " bytes; send it again");
    }
    const Digest found = hash_.Finish();
    if (found != digest_) return WrongHash(digest_, found);
    if (::fsync(file_.get()) != 0) return DiskError("cannot flush", part_, errno);
    const std::string path = store_.PathOf(digest_);
    if (::rename(part_.c_str(), path.c_str()) != 0) {
      return DiskError("cannot rename to", path, errno);
    }
    file_.Reset();
    SyncFolder(store_.directory_);
    std::lock_guard lock(store_.mutex_);
    store_.verified_.insert(digest_);
    return absl::OkStatus();
  }

 private:
  BlobStore& store_;
  const Digest digest_;
  const uint64_t size_;
  const std::string part_;
  Descriptor file_;
  uint64_t written_ = 0;
  Sha256 hash_;
};

class MemoryBlobWriter final : public BlobWriter {
 public:
  MemoryBlobWriter(BlobStore& store, const Digest& digest, uint64_t size)
      : store_(store), digest_(digest), size_(size) {}

  absl::Status Append(std::span<const std::byte> data) override {
    if (data.size() > size_ - bytes_.size()) {
      return absl::InvalidArgumentError("blob " + digest_.Hex() + " was announced with " +
                                        std::to_string(size_) + " bytes, more arrive");
    }
    bytes_.insert(bytes_.end(), data.begin(), data.end());
    return absl::OkStatus();
  }
  absl::Status Commit() override {
    if (bytes_.size() != size_) {
      return absl::DataLossError("blob " + digest_.Hex() + " ended after " +
                                 std::to_string(bytes_.size()) + " of " + std::to_string(size_) +
                                 " bytes; send it again");
    }
    return store_.Put(digest_, Blob::FromVector(std::move(bytes_)));
  }

 private:
  BlobStore& store_;
  const Digest digest_;
  const uint64_t size_;
  std::vector<std::byte> bytes_;
};

absl::StatusOr<std::unique_ptr<BlobStore>> BlobStore::Open(const std::string& directory,
                                                           uint64_t max_blob_bytes) {
  if (!directory.empty()) {
    std::error_code error;
    fs::create_directories(directory, error);
    if (error) return DiskError("cannot create", directory, error.value());
    for (fs::directory_iterator at(directory, error), end; !error && at != end;
         at.increment(error)) {
      std::error_code ignored;
      if (at->path().extension() == ".part") fs::remove(at->path(), ignored);
    }
    if (error) return DiskError("cannot list", directory, error.value());
  }
  return std::unique_ptr<BlobStore>(new BlobStore(directory, max_blob_bytes));
}

bool BlobStore::Contains(const Digest& digest) const {
  if (in_memory()) {
    std::lock_guard lock(mutex_);
    return memory_.contains(digest);
  }
  // Succeeds if the file is there, and keeps it from RemoveUnused for a while.
  return ::utimensat(AT_FDCWD, PathOf(digest).c_str(), nullptr, 0) == 0;
}

absl::StatusOr<Blob> BlobStore::Get(const Digest& digest) {
  if (in_memory()) {
    std::lock_guard lock(mutex_);
    const auto at = memory_.find(digest);
    if (at != memory_.end()) return at->second;
    return absl::NotFoundError("blob " + digest.Hex() + " is not in the store; send it first");
  }
  const std::string path = PathOf(digest);
  absl::StatusOr<Blob> blob = Blob::MapFile(path);
  if (!blob.ok()) {
    if (!absl::IsNotFound(blob.status())) return blob.status();
    return absl::NotFoundError("blob " + digest.Hex() + " is not in the store; send it first");
  }
  {
    std::lock_guard lock(mutex_);
    if (verified_.contains(digest)) {
      ::utimensat(AT_FDCWD, path.c_str(), nullptr, 0);  // last use, for RemoveUnused
      return *blob;
    }
  }
  if (blob->Hash() != digest) {
    ::unlink(path.c_str());
    return absl::DataLossError("'" + path + "' was damaged and is removed; send the blob again");
  }
  ::utimensat(AT_FDCWD, path.c_str(), nullptr, 0);
  std::lock_guard lock(mutex_);
  verified_.insert(digest);
  return *blob;
}

absl::Status BlobStore::Put(const Digest& digest, const Blob& blob) {
  if (blob.size() > max_blob_bytes_) {
    return absl::ResourceExhaustedError("blob " + digest.Hex() + " has " +
                                        std::to_string(blob.size()) + " bytes, the limit is " +
                                        std::to_string(max_blob_bytes_));
  }
  if (in_memory()) {
    if (const Digest found = blob.Hash(); found != digest) return WrongHash(digest, found);
    std::lock_guard lock(mutex_);
    memory_.emplace(digest, blob);
    return absl::OkStatus();
  }
  if (Contains(digest)) return absl::OkStatus();
  FP_ASSIGN_OR_RETURN(const auto writer, StartPut(digest, blob.size()));
  FP_RETURN_IF_ERROR(writer->Append(blob.bytes()));
  return writer->Commit();
}

absl::StatusOr<std::unique_ptr<BlobWriter>> BlobStore::StartPut(const Digest& digest,
                                                                uint64_t size_bytes) {
  if (size_bytes > max_blob_bytes_) {
    return absl::ResourceExhaustedError("blob " + digest.Hex() + " has " +
                                        std::to_string(size_bytes) + " bytes, the limit is " +
                                        std::to_string(max_blob_bytes_));
  }
  if (in_memory()) return std::make_unique<MemoryBlobWriter>(*this, digest, size_bytes);
  std::string part = PathOf(digest);
  {
    // Several may send the same blob at a time.
    std::lock_guard lock(mutex_);
    part += "." + std::to_string(next_part_++) + ".part";
  }
  Descriptor file(::open(part.c_str(), O_WRONLY | O_CREAT | O_TRUNC | O_CLOEXEC, 0644));
  if (!file.valid()) return DiskError("cannot create", part, errno);
  return std::make_unique<FileBlobWriter>(*this, digest, size_bytes, std::move(part),
                                          std::move(file));
}

void BlobStore::Drop(const Digest& digest) {
  std::lock_guard lock(mutex_);
  memory_.erase(digest);
  verified_.erase(digest);
  if (!in_memory()) ::unlink(PathOf(digest).c_str());
}

size_t BlobStore::RemoveUnused(const std::set<Digest>& needed, std::chrono::seconds age) {
  if (in_memory()) return 0;
  size_t removed = 0;
  std::lock_guard lock(mutex_);
  std::error_code error;
  const auto limit = fs::file_time_type::clock::now() - age;
  for (fs::directory_iterator at(directory_, error), end; !error && at != end;
       at.increment(error)) {
    const absl::StatusOr<Digest> digest = Digest::FromHex(at->path().filename().string());
    std::error_code ignored;
    if (!digest.ok() || needed.contains(*digest)) continue;
    if (fs::last_write_time(at->path(), ignored) > limit || ignored) continue;
    if (fs::remove(at->path(), ignored)) ++removed;
    verified_.erase(*digest);
  }
  return removed;
}

}  // namespace farpoint

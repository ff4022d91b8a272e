#include "core/base/blob.h"

#include <fcntl.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <unistd.h>

#include <cerrno>

#include "core/base/posix_file.h"

namespace farpoint {

namespace {

absl::StatusOr<size_t> OpenForReading(const std::string& path, Descriptor& file) {
  // Without O_NONBLOCK the open of a FIFO waits for a writer; regular files know no difference.
  file.Reset(::open(path.c_str(), O_RDONLY | O_CLOEXEC | O_NONBLOCK));
  if (!file.valid()) return FileError("cannot open", path, errno);
  struct stat info {};
  if (::fstat(file.get(), &info) != 0) return FileError("cannot examine", path, errno);
  if (!S_ISREG(info.st_mode)) {
    return absl::InvalidArgumentError("'" + path + "' is not a regular file");
  }
  return static_cast<size_t>(info.st_size);
}

}  // namespace

Blob Blob::FromAligned(AlignedVector<std::byte> bytes) {
  auto owner = std::make_shared<const AlignedVector<std::byte>>(std::move(bytes));
  Blob blob;
  blob.bytes_ = *owner;
  blob.owner_ = std::move(owner);
  return blob;
}

Blob Blob::FromBulk(BulkVector<std::byte> bytes) {
  auto owner = std::make_shared<const BulkVector<std::byte>>(std::move(bytes));
  Blob blob;
  blob.bytes_ = *owner;
  blob.owner_ = std::move(owner);
  return blob;
}

Blob Blob::FromString(std::string_view bytes) {
  const auto view = std::as_bytes(std::span(bytes.data(), bytes.size()));
  return FromAligned(AlignedVector<std::byte>(view.begin(), view.end()));
}

absl::StatusOr<Blob> Blob::MapFile(const std::string& path) {
  Descriptor file;
  FP_ASSIGN_OR_RETURN(const size_t size, OpenForReading(path, file));
  Blob blob;
  if (size == 0) return blob;
  void* address = ::mmap(nullptr, size, PROT_READ, MAP_PRIVATE, file.get(), 0);
  if (address == MAP_FAILED) return FileError("cannot map", path, errno);
  blob.owner_ = std::shared_ptr<const void>(
      address, [size](const void* p) { ::munmap(const_cast<void*>(p), size); });
  blob.bytes_ = {static_cast<const std::byte*>(address), size};
  return blob;
}

absl::Status WriteFileAtomically(const std::string& path, std::span<const std::byte> bytes) {
  const std::string part = path + ".part";
  {
    const Descriptor file(::open(part.c_str(), O_WRONLY | O_CREAT | O_TRUNC | O_CLOEXEC, 0644));
    if (!file.valid()) return FileError("cannot create", part, errno);
    absl::Status written = WriteAll(file.get(), bytes, part);
    if (written.ok() && ::fsync(file.get()) != 0) written = DiskError("cannot flush", part, errno);
    if (!written.ok()) {
      ::unlink(part.c_str());
      return written;
    }
  }
  if (::rename(part.c_str(), path.c_str()) != 0) {
    const int error = errno;
    ::unlink(part.c_str());
    return FileError("cannot rename to", path, error);
  }
  // The rename itself is durable only once the folder is.
  const size_t slash = path.rfind('/');
  SyncFolder(slash == std::string::npos ? "." : path.substr(0, slash + 1));
  return absl::OkStatus();
}

absl::StatusOr<Blob> ReadFile(const std::string& path, size_t max_bytes) {
  Descriptor file;
  FP_ASSIGN_OR_RETURN(const size_t size, OpenForReading(path, file));
  if (size > max_bytes) {
    return absl::ResourceExhaustedError("'" + path + "' has " + std::to_string(size) +
                                        " bytes, more than the " + std::to_string(max_bytes) +
                                        " that are accepted");
  }
  AlignedVector<std::byte> bytes(size);
  size_t done = 0;
  while (done < size) {
    const ssize_t n = ::read(file.get(), bytes.data() + done, size - done);
    if (n < 0 && errno == EINTR) continue;
    if (n < 0) return FileError("cannot read", path, errno);
    if (n == 0) return absl::UnavailableError("'" + path + "' became shorter while it was read");
    done += static_cast<size_t>(n);
  }
  return Blob::FromAligned(std::move(bytes));
}

}  // namespace farpoint

#include "core/base/blob.h"

#include <fcntl.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <unistd.h>

#include <cerrno>
#include <cstring>

namespace farpoint {

namespace {

absl::Status FileError(const std::string& what, const std::string& path, int error) {
  const std::string text = what + " '" + path + "': " + std::strerror(error);
  if (error == ENOENT || error == ENOTDIR) return absl::NotFoundError(text);
  if (error == EACCES || error == EPERM) return absl::PermissionDeniedError(text);
  if (error == ENOSPC || error == EDQUOT) {
    return absl::ResourceExhaustedError(text + "; free some space and try again");
  }
  return absl::UnavailableError(text);
}

struct Descriptor {
  int fd = -1;
  ~Descriptor() {
    if (fd >= 0) ::close(fd);
  }
};

absl::StatusOr<size_t> OpenForReading(const std::string& path, Descriptor& file) {
  file.fd = ::open(path.c_str(), O_RDONLY | O_CLOEXEC);
  if (file.fd < 0) return FileError("cannot open", path, errno);
  struct stat info {};
  if (::fstat(file.fd, &info) != 0) return FileError("cannot examine", path, errno);
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

Blob Blob::FromString(std::string_view bytes) {
  const auto view = std::as_bytes(std::span(bytes.data(), bytes.size()));
  return FromAligned(AlignedVector<std::byte>(view.begin(), view.end()));
}

absl::StatusOr<Blob> Blob::MapFile(const std::string& path) {
  Descriptor file;
  FP_ASSIGN_OR_RETURN(const size_t size, OpenForReading(path, file));
  Blob blob;
  if (size == 0) return blob;
  void* address = ::mmap(nullptr, size, PROT_READ, MAP_PRIVATE, file.fd, 0);
  if (address == MAP_FAILED) return FileError("cannot map", path, errno);
  blob.owner_ = std::shared_ptr<const void>(
      address, [size](const void* p) { ::munmap(const_cast<void*>(p), size); });
  blob.bytes_ = {static_cast<const std::byte*>(address), size};
  return blob;
}

absl::Status WriteFileAtomically(const std::string& path, std::span<const std::byte> bytes) {
  const std::string part = path + ".part";
  {
    Descriptor file;
    file.fd = ::open(part.c_str(), O_WRONLY | O_CREAT | O_TRUNC | O_CLOEXEC, 0644);
    if (file.fd < 0) return FileError("cannot create", part, errno);
    size_t done = 0;
    while (done < bytes.size()) {
      const ssize_t n = ::write(file.fd, bytes.data() + done, bytes.size() - done);
      if (n < 0 && errno == EINTR) continue;
      if (n <= 0) {
        const int error = n == 0 ? ENOSPC : errno;
        ::unlink(part.c_str());
        return FileError("cannot write", part, error);
      }
      done += static_cast<size_t>(n);
    }
    if (::fsync(file.fd) != 0) {
      const int error = errno;
      ::unlink(part.c_str());
      return FileError("cannot flush", part, error);
    }
  }
  if (::rename(part.c_str(), path.c_str()) != 0) {
    const int error = errno;
    ::unlink(part.c_str());
    return FileError("cannot rename to", path, error);
  }
  // The rename itself is durable only once the folder is.
  const size_t slash = path.rfind('/');
  const std::string folder = slash == std::string::npos ? "." : path.substr(0, slash + 1);
  Descriptor dir;
  dir.fd = ::open(folder.c_str(), O_RDONLY | O_DIRECTORY | O_CLOEXEC);
  if (dir.fd >= 0) ::fsync(dir.fd);
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
    const ssize_t n = ::read(file.fd, bytes.data() + done, size - done);
    if (n < 0 && errno == EINTR) continue;
    if (n < 0) return FileError("cannot read", path, errno);
    if (n == 0) return absl::UnavailableError("'" + path + "' became shorter while it was read");
    done += static_cast<size_t>(n);
  }
  return Blob::FromAligned(std::move(bytes));
}

}  // namespace farpoint

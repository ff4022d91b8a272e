#include "core/base/posix_file.h"

#include <fcntl.h>
#include <unistd.h>

#include <cerrno>
#include <cstring>

namespace farpoint {

namespace {

std::string ErrorText(const std::string& what, const std::string& path, int error) {
  return what + " '" + path + "': " + std::strerror(error);
}

bool IsFull(int error) { return error == ENOSPC || error == EDQUOT; }

// `write` returns how many bytes it took, as write(2).
template <typename Write>
absl::Status WriteWhole(std::span<const std::byte> bytes, const std::string& path, Write write) {
  size_t done = 0;
  while (done < bytes.size()) {
    const ssize_t n = write(done);
    if (n < 0 && errno == EINTR) continue;
    if (n <= 0) return DiskError("cannot write", path, n == 0 ? ENOSPC : errno);
    done += static_cast<size_t>(n);
  }
  return absl::OkStatus();
}

}  // namespace

absl::Status FileError(const std::string& what, const std::string& path, int error) {
  const std::string text = ErrorText(what, path, error);
  if (error == ENOENT || error == ENOTDIR) return absl::NotFoundError(text);
  if (error == EACCES || error == EPERM) return absl::PermissionDeniedError(text);
  return DiskError(what, path, error);
}

absl::Status DiskError(const std::string& what, const std::string& path, int error) {
  const std::string text = ErrorText(what, path, error);
  if (IsFull(error)) return absl::UnavailableError(text + "; free some space and try again");
  return absl::UnavailableError(text);
}

void Descriptor::Reset(int fd) {
  if (fd_ >= 0) ::close(fd_);
  fd_ = fd;
}

absl::Status WriteAll(int fd, std::span<const std::byte> bytes, const std::string& path) {
  return WriteWhole(bytes, path, [&](size_t done) {
    return ::write(fd, bytes.data() + done, bytes.size() - done);
  });
}

absl::Status WriteAllAt(int fd, uint64_t offset, std::span<const std::byte> bytes,
                        const std::string& path) {
  return WriteWhole(bytes, path, [&](size_t done) {
    return ::pwrite(fd, bytes.data() + done, bytes.size() - done,
                    static_cast<off_t>(offset + done));
  });
}

void SyncFolder(const std::string& folder) {
  const Descriptor dir(::open(folder.c_str(), O_RDONLY | O_DIRECTORY | O_CLOEXEC));
  if (dir.valid()) ::fsync(dir.get());
}

}  // namespace farpoint

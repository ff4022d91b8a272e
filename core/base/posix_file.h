// What everybody needs who writes files by descriptor: errors that name the path, whole writes.
// Thread-safe; retries what a signal interrupted.
#pragma once

#include <cstddef>
#include <cstdint>
#include <span>
#include <string>
#include <utility>

#include "core/base/status.h"

namespace farpoint {

// "`what` 'path': <the system's text>". kNotFound, kPermissionDenied, else kUnavailable.
// `error` is an errno.
absl::Status FileError(const std::string& what, const std::string& path, int error);
// The same for a disk that should take something: kUnavailable, whatever the cause; of a full disk
// it says so.
absl::Status DiskError(const std::string& what, const std::string& path, int error);

// Closes on destruction.
class Descriptor {
 public:
  Descriptor() = default;
  explicit Descriptor(int fd) : fd_(fd) {}
  ~Descriptor() { Reset(); }
  Descriptor(Descriptor&& other) noexcept : fd_(std::exchange(other.fd_, -1)) {}
  Descriptor& operator=(Descriptor&& other) noexcept {
    Reset(std::exchange(other.fd_, -1));
    return *this;
  }
  int get() const { return fd_; }
  bool valid() const { return fd_ >= 0; }
  // Somebody else closes it.
  int Release() { return std::exchange(fd_, -1); }
  void Reset(int fd = -1);

 private:
  int fd_ = -1;
};

// At the end of what was written, or from `offset` on. `path` is for the message: DiskError.
absl::Status WriteAll(int fd, std::span<const std::byte> bytes, const std::string& path);
absl::Status WriteAllAt(int fd, uint64_t offset, std::span<const std::byte> bytes,
                        const std::string& path);

// Makes what was created or renamed in the folder durable, as far as its file system can.
void SyncFolder(const std::string& folder);

}  // namespace farpoint

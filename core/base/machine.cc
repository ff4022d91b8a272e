#include "core/base/machine.h"

#include <dirent.h>
#include <fcntl.h>
#include <sys/resource.h>
#include <sys/statvfs.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <cerrno>
#include <cstdio>
#include <cstring>
#include <limits>
#include <memory>
#include <optional>

#include "core/base/posix_file.h"

namespace farpoint {

namespace {

std::optional<std::string> ReadSmall(const char* path) {
  const Descriptor fd(::open(path, O_RDONLY | O_CLOEXEC));
  if (!fd.valid()) return std::nullopt;
  std::string text(8192, '\0');
  const ssize_t size = ::read(fd.get(), text.data(), text.size());
  if (size < 0) return std::nullopt;
  text.resize(static_cast<size_t>(size));
  return text;
}

// "Name:   123 kB" of /proc files; 0 if it is not there.
uint64_t KilobytesOf(const std::string& text, const char* name) {
  const size_t at = text.find(name);
  if (at == std::string::npos) return 0;
  unsigned long long kilobytes = 0;
  return std::sscanf(text.c_str() + at + std::strlen(name), " %llu", &kilobytes) == 1
             ? uint64_t{kilobytes} << 10
             : 0;
}

std::optional<uint64_t> NumberIn(const char* path) {
  const std::optional<std::string> text = ReadSmall(path);
  unsigned long long number = 0;
  // "max" is no number.
  if (!text || std::sscanf(text->c_str(), "%llu", &number) != 1) return std::nullopt;
  return number;
}

}  // namespace

MemoryFacts ReadMemoryFacts() {
  MemoryFacts facts;
  if (const auto text = ReadSmall("/proc/meminfo")) {
    facts.total_bytes = KilobytesOf(*text, "MemTotal:");
    facts.available_bytes = KilobytesOf(*text, "MemAvailable:");
  }
  const auto limited = [&](uint64_t limit, uint64_t used) {
    facts.total_bytes = std::min(facts.total_bytes, limit);
    facts.available_bytes = std::min(facts.available_bytes, limit - std::min(limit, used));
  };
  // Control groups, version 2 and 1, as a container sees its own.
  for (const auto& [limit_path, used_path] :
       {std::pair{"/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory.current"},
        std::pair{"/sys/fs/cgroup/memory/memory.limit_in_bytes",
                  "/sys/fs/cgroup/memory/memory.usage_in_bytes"}}) {
    const auto limit = NumberIn(limit_path);
    const auto used = NumberIn(used_path);
    if (limit && used) limited(*limit, *used);
  }
  rlimit own{};
  if (::getrlimit(RLIMIT_AS, &own) == 0 && own.rlim_cur != RLIM_INFINITY) {
    uint64_t used = 0;
    if (const auto text = ReadSmall("/proc/self/status")) used = KilobytesOf(*text, "VmSize:");
    limited(own.rlim_cur, used);
  }
  return facts;
}

OpenFileFacts ReadOpenFileFacts() {
  OpenFileFacts facts;
  rlimit own{};
  if (::getrlimit(RLIMIT_NOFILE, &own) == 0) facts.limit = own.rlim_cur;
  if (DIR* folder = ::opendir("/proc/self/fd"); folder != nullptr) {
    while (const dirent* entry = ::readdir(folder)) facts.open += entry->d_name[0] != '.' ? 1 : 0;
    ::closedir(folder);
    facts.open -= std::min<uint64_t>(facts.open, 1);  // the one that looked
  }
  return facts;
}

uint64_t RaiseOpenFileLimit() {
  rlimit own{};
  if (::getrlimit(RLIMIT_NOFILE, &own) != 0) return 0;
  own.rlim_cur = own.rlim_max;
  (void)::setrlimit(RLIMIT_NOFILE, &own);
  return ReadOpenFileFacts().limit;
}

absl::StatusOr<DiskFacts> ReadDiskFacts(const std::string& folder) {
  struct statvfs facts {};
  if (::statvfs(folder.c_str(), &facts) != 0) return FileError("cannot look at", folder, errno);
  return DiskFacts{.total_bytes = uint64_t{facts.f_blocks} * facts.f_frsize,
                   .free_bytes = uint64_t{facts.f_bavail} * facts.f_frsize};
}

absl::Status CheckWritable(const std::string& folder) {
  std::string path = folder + "/.farpoint-XXXXXX";
  const Descriptor fd(::mkostemp(path.data(), O_CLOEXEC));
  if (!fd.valid()) {
    const int error = errno;
    // A file system like /proc says "no such file" of what cannot be made in it.
    if (error == ENOENT && ::access(folder.c_str(), F_OK) != 0) {
      return FileError("there is no folder", folder, error);
    }
    return DiskError("cannot write into", folder, error);
  }
  static constexpr std::array<std::byte, 4096> kBytes{};
  const absl::Status written = WriteAll(fd.get(), kBytes, path);
  ::unlink(path.c_str());
  return written;
}

}  // namespace farpoint

#include "server/server_facts.h"

#include <fcntl.h>
#include <unistd.h>

#include <mutex>

#include "core/base/posix_file.h"
#include "proto/certificate.h"

namespace farpoint {

void LookAround(const std::string& store, ServerFacts& facts) {
  facts.memory = ReadMemoryFacts();
  facts.files = ReadOpenFileFacts();
  if (store.empty()) return;
  if (const absl::Status status = CheckWritable(store); !status.ok()) {
    facts.store_error = std::string(status.message());
  }
  if (const auto disk = ReadDiskFacts(store); disk.ok()) facts.disk = *disk;
}

std::string LeaveMark(const std::string& folder) {
  static std::mutex mutex;
  static std::string last;  // guarded by mutex
  const absl::StatusOr<std::string> digits = RandomHexDigits(16);
  if (!digits.ok()) return "";
  const std::string name = ".farpoint-mark-" + *digits;
  std::lock_guard lock(mutex);
  const Descriptor fd(::open((folder + "/" + name).c_str(),
                             O_WRONLY | O_CREAT | O_EXCL | O_CLOEXEC | O_NOFOLLOW, 0644));
  if (!fd.valid()) return "";
  if (!last.empty()) ::unlink(last.c_str());
  last = folder + "/" + name;
  return name;
}

}  // namespace farpoint

// What a machine and its folders have to offer, for those who look before they start and for those
// who ask what is wrong. Linux. Thread-safe.
#pragma once

#include <cstdint>
#include <string>

#include "core/base/status.h"

namespace farpoint {

struct MemoryFacts {
  uint64_t total_bytes = 0;
  // That a process may still take: of the machine, its control group and its own limits the least.
  uint64_t available_bytes = 0;
};
MemoryFacts ReadMemoryFacts();

struct OpenFileFacts {
  uint64_t open = 0, limit = 0;  // of this process
};
OpenFileFacts ReadOpenFileFacts();
// As many open files as the system lets this process have. Returns that number.
uint64_t RaiseOpenFileLimit();

struct DiskFacts {
  uint64_t total_bytes = 0, free_bytes = 0;  // free for this user
};
absl::StatusOr<DiskFacts> ReadDiskFacts(const std::string& folder);
// Writes a small file into the folder and removes it. kNotFound: there is no such folder;
// kUnavailable says why it cannot be written.
absl::Status CheckWritable(const std::string& folder);

}  // namespace farpoint

// How a coordinator's process and its folders are, for `farpoint doctor`. Thread-safe.
#pragma once

#include <atomic>
#include <cstdint>
#include <string>

#include "core/base/machine.h"
#include "proto/job.h"

namespace farpoint {

struct ServerFacts {
  bool draining = false;
  std::string store_error;  // why the store cannot be written now
  DiskFacts disk;           // of the store; 0: in memory
  MemoryFacts memory;
  OpenFileFacts files;
  uint64_t connections = 0, max_connections = 0;
  uint64_t max_blob_bytes = 0;
  JobLimits limits;
  uint64_t max_jobs = 0, max_bytes = 0;  // of a client; 0: no limit
  // A shared folder of blobs, and the name of a file that was put there just now.
  std::string blob_directory, blob_mark;
  int64_t certificate_not_after_s = 0;  // 0: no TLS
};

// Bytes of scenes and tiles that went over the network, headers left out. Thread-safe.
struct Traffic {
  std::atomic<uint64_t> blobs_sent{0}, blobs_received{0};  // to workers; from clients
  std::atomic<uint64_t> tiles_sent{0};                     // to clients
};

// Fills store_error and disk by looking at `store` (empty: in memory), memory and files.
void LookAround(const std::string& store, ServerFacts& facts);
// Leaves an empty file of a random name in the folder, in place of the last one, and returns its
// name; empty if it cannot be written.
std::string LeaveMark(const std::string& folder);

}  // namespace farpoint

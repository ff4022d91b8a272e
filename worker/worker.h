// The worker's life: register, lease a tile, render it, return it, again. One tile at a time, with
// all threads. No sockets, no signals, no log of its own.
#pragma once

#include <chrono>
#include <functional>
#include <memory>
#include <optional>
#include <string>

#include "core/base/status.h"
#include "worker/coordinator_link.h"
#include "worker/tile_renderer.h"

namespace farpoint {

struct WorkerLogEntry {
  using Level = LogLevel;
  Level level = Level::kInfo;
  std::string text;
  JobId job;  // may be empty
  std::optional<uint32_t> tile;
  uint32_t attempt = 0;
};

struct WorkerOptions {
  unsigned threads = 0;      // 0: all cores
  std::string name;          // for people
  Digest fingerprint;        // worker/fingerprint.h; in one process any fixed digest
  size_t cached_scenes = 2;  // kept in memory, the one in use included; at least 1
  // Wait after a failed call: doubles from the first to the last, with jitter.
  std::chrono::milliseconds first_backoff{100};
  std::chrono::milliseconds last_backoff{1000};
  // How long Stop() lets the tile in work go on before it is given back.
  std::chrono::milliseconds drain_time{0};
  std::function<void(const WorkerLogEntry&)> log;  // may be empty; from any thread
};

class Worker {
 public:
  // The references must outlive this.
  Worker(WorkerOptions options, CoordinatorLink& link, BlobSource& blobs,
         const TileRenderer& renderer);
  ~Worker();
  Worker(const Worker&) = delete;
  Worker& operator=(const Worker&) = delete;

  // Works until Stop(): OK. A coordinator that cannot be reached is tried again for ever; a refusal
  // to register (another version) is returned. Call once.
  absl::Status Run();
  // The tile in work is finished within drain_time or given back; then Run() returns. From any
  // thread, more than once, before Run() too.
  void Stop();
  // The process is about to die: tells the coordinator that the tile in work, if there is one,
  // failed by `cause`. From a thread of its own (worker/crash_reporter.h).
  void ReportCrash(const std::string& cause);

 private:
  struct Impl;
  std::unique_ptr<Impl> impl_;
};

}  // namespace farpoint

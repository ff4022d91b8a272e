// Why a job is in the state that it is in, put into words. A pure function of what the coordinator
// knows, so that every reason can be tested without it.
#pragma once

#include <cstddef>
#include <cstdint>
#include <optional>
#include <vector>

#include "core/base/stats.h"
#include "proto/job.h"
#include "server/job_store.h"
#include "server/tile_scheduler.h"

namespace farpoint {

struct ExplanationFacts {
  JobStatus status;
  JobSpec spec;
  uint32_t frame_tiles = 0;  // tiles of one frame
  bool paused = false;
  bool draining = false;  // the coordinator is shutting down

  // Jobs of spec.after that are not done; no status: not known (any more).
  struct Dependency {
    JobId id;
    std::optional<JobStatus> status;
  };
  std::vector<Dependency> waits_for;

  // Its frame that is being baked now.
  struct BakeInWork {
    uint32_t frame_index = 0;
    double seconds = 0;
  };
  std::optional<BakeInWork> baking;
  size_t bake_place = 0;  // of its next frame among those that wait, from 1; 0: none does
  std::optional<JobId> baked_first;  // the job whose bake is in work or goes before
  bool enough_baked = false;         // frames remain, but enough tiles are queued already

  std::vector<WorkerStatus> workers;
  JobReport report;
  // A job with leasable tiles that goes before this one, and how many.
  std::optional<JobStatus> served_first;
  uint32_t served_first_tiles = 0;

  std::vector<TileSeconds> slowest;   // committed tiles, the longest first
  std::vector<StoredEvent> problems;  // the last warnings and errors of its log
  Stats bake_stats, tile_stats;
};

Explanation Explain(const ExplanationFacts& facts);

}  // namespace farpoint

// Renders one lease after the other: fetches blobs, keeps the scenes and the frame of the jobs in
// work. One call at a time.
#pragma once

#include <atomic>
#include <cstdint>
#include <list>
#include <memory>

#include "core/base/executor.h"
#include "core/base/status.h"
#include "proto/job.h"
#include "worker/coordinator_link.h"
#include "worker/tile_renderer.h"

namespace farpoint {

// Written by the thread that renders, read by the one that sends heartbeats.
struct TileProgress {
  std::atomic<uint64_t> counter{0};
  std::atomic<float> fraction{0};
  void Advance() { counter.fetch_add(1, std::memory_order_relaxed); }
};

class TileRunner {
 public:
  // The references must outlive this. `cached_scenes` >= 1.
  TileRunner(const TileRenderer& renderer, BlobSource& blobs, Executor& executor,
             size_t cached_scenes);

  // kCancelled soon after `cancel` is set. Advances `progress` with every piece of work.
  absl::StatusOr<TileResult> Run(const TileWork& work, TileProgress& progress,
                                 const std::atomic<bool>& cancel);

 private:
  struct CachedScene {
    SceneBlobs blobs;
    std::shared_ptr<const RenderedScene> scene;
  };
  absl::StatusOr<std::shared_ptr<const RenderedScene>> SceneOf(const SceneBlobs& blobs,
                                                               TileProgress& progress,
                                                               const std::atomic<bool>& cancel,
                                                               Stats& stats);

  const TileRenderer& renderer_;
  BlobSource& blobs_;
  Executor& executor_;
  const size_t cached_scenes_;
  std::list<CachedScene> scenes_;  // most recently used first
  // The frame of the last tile; its scene stays alive with it.
  JobId frame_job_;
  uint32_t frame_index_ = 0;
  SceneBlobs frame_blobs_;
  std::shared_ptr<const RenderedScene> frame_scene_;
  std::unique_ptr<RenderedFrame> frame_;
};

}  // namespace farpoint

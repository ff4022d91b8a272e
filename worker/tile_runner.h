// Renders one lease after the other: fetches blobs, keeps the scenes and the frame of the jobs in
// work. One call at a time.
#pragma once

#include <atomic>
#include <cstdint>
#include <functional>
#include <list>
#include <memory>
#include <mutex>
#include <string>
#include <utility>

#include "core/base/executor.h"
#include "core/base/status.h"
#include "proto/job.h"
#include "worker/coordinator_link.h"
#include "worker/tile_renderer.h"

namespace farpoint {

// Written by the thread that renders, read by the one that sends heartbeats.
class TileProgress {
 public:
  std::atomic<uint64_t> counter{0};
  std::atomic<float> fraction{0};
  std::atomic<bool> rendering{false};  // blobs and scene are there
  // Tells the coordinator where the work is before it goes on there; set before Run, may be empty.
  std::function<void()> tell;

  void Advance() { counter.fetch_add(1, std::memory_order_relaxed); }
  void MoveTo(std::string place) {
    {
      std::lock_guard lock(mutex_);
      place_ = std::move(place);
    }
    if (tell) tell();
  }
  std::string place() const {
    std::lock_guard lock(mutex_);
    return place_;
  }

 private:
  mutable std::mutex mutex_;
  std::string place_;  // guarded by mutex_
};

class TileRunner {
 public:
  // The references must outlive this. `cached_scenes` >= 1.
  TileRunner(const TileRenderer& renderer, BlobSource& blobs, Executor& executor,
             size_t cached_scenes);

  // kCancelled soon after `cancel` is set. Advances `progress` with every piece of work. A careful
  // tile is rendered block by block, with MoveTo before each: the same pixels.
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

  absl::StatusOr<TileOutput> RenderCarefully(const TileWork& work, TileProgress& progress,
                                             const std::atomic<bool>& cancel);

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

// Renders tiles of one frame. What a worker does, end to end.
#pragma once

#include <atomic>
#include <functional>
#include <memory>

#include "core/base/executor.h"
#include "core/base/stats.h"
#include "core/base/status.h"
#include "core/image/film.h"
#include "core/render/bake.h"
#include "core/render/settings.h"
#include "core/scene/scene.h"

namespace farpoint {

struct FrameSpec {
  Camera camera;
  FilmSpec film;
  RenderSettings settings;
};

struct TileOutput {
  Film film;  // rounded to storage; covers exactly the tile
  Stats stats;
};

// The immutable data of a scene in memory: prepared scene, ray acceleration structure, light
// tables, point tree. Shared by all frames of a scene. Thread-safe.
class LoadedScene {
 public:
  // Checks and views the blobs, builds the acceleration structure. kDataLoss for damaged blobs.
  static absl::StatusOr<std::shared_ptr<const LoadedScene>> Load(const BakedScene& blobs,
                                                                 Executor& executor);
  virtual ~LoadedScene() = default;
};

class FrameRenderer {
 public:
  static absl::StatusOr<std::unique_ptr<FrameRenderer>> Create(
      std::shared_ptr<const LoadedScene> scene, const FrameSpec& frame);
  virtual ~FrameRenderer() = default;

  // `tile` lies inside the crop. Its pixels depend on the scene, camera, film and settings only:
  // not on the tile's extent, the executor or earlier calls. Thread-safe.
  // `progress` (may be empty) is called with the number of finished and of all blocks, from any
  // thread, one call at a time. `cancel` (may be null) is looked at between blocks: kCancelled.
  virtual absl::StatusOr<TileOutput> RenderTile(
      const PixelRect& tile, Executor& executor,
      const std::function<void(int done, int total)>& progress,
      const std::atomic<bool>* cancel) const = 0;
};

}  // namespace farpoint

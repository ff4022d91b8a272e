// How a worker renders: an interface over the core's LoadedScene and FrameRenderer, so that tests
// render without it.
#pragma once

#include <atomic>
#include <functional>
#include <memory>

#include "core/base/executor.h"
#include "core/base/status.h"
#include "core/image/tile_rect.h"
#include "core/render/bake.h"
#include "core/render/frame_renderer.h"

namespace farpoint {

// One frame, ready to render tiles. Thread-safe.
class RenderedFrame {
 public:
  virtual ~RenderedFrame() = default;
  // As FrameRenderer::RenderTile.
  virtual absl::StatusOr<TileOutput> RenderTile(
      const PixelRect& tile, Executor& executor,
      const std::function<void(int done, int total)>& progress,
      const std::atomic<bool>* cancel) const = 0;
};

// A scene in memory, from which frames are made. Thread-safe.
class RenderedScene {
 public:
  virtual ~RenderedScene() = default;
  virtual absl::StatusOr<std::unique_ptr<RenderedFrame>> StartFrame(
      const FrameSpec& frame) const = 0;
};

class TileRenderer {
 public:
  virtual ~TileRenderer() = default;
  virtual absl::StatusOr<std::shared_ptr<const RenderedScene>> LoadScene(
      const BakedScene& blobs, Executor& executor) const = 0;
};

// The real one.
std::unique_ptr<TileRenderer> MakeCoreRenderer();

}  // namespace farpoint

#include "worker/tile_renderer.h"

#include <utility>

namespace farpoint {

namespace {

class CoreFrame final : public RenderedFrame {
 public:
  explicit CoreFrame(std::unique_ptr<FrameRenderer> frame) : frame_(std::move(frame)) {}
  absl::StatusOr<TileOutput> RenderTile(const PixelRect& tile, Executor& executor,
                                        const std::function<void(int, int)>& progress,
                                        const std::atomic<bool>* cancel) const override {
    return frame_->RenderTile(tile, executor, progress, cancel);
  }

 private:
  std::unique_ptr<FrameRenderer> frame_;
};

class CoreScene final : public RenderedScene {
 public:
  explicit CoreScene(std::shared_ptr<const LoadedScene> scene) : scene_(std::move(scene)) {}
  absl::StatusOr<std::unique_ptr<RenderedFrame>> StartFrame(const FrameSpec& frame) const override {
    FP_ASSIGN_OR_RETURN(auto renderer, FrameRenderer::Create(scene_, frame));
    return std::make_unique<CoreFrame>(std::move(renderer));
  }

 private:
  std::shared_ptr<const LoadedScene> scene_;
};

class CoreRenderer final : public TileRenderer {
 public:
  absl::StatusOr<std::shared_ptr<const RenderedScene>> LoadScene(
      const BakedScene& blobs, Executor& executor) const override {
    FP_ASSIGN_OR_RETURN(auto scene, LoadedScene::Load(blobs, executor));
    return std::make_shared<const CoreScene>(std::move(scene));
  }
};

}  // namespace

std::unique_ptr<TileRenderer> MakeCoreRenderer() { return std::make_unique<CoreRenderer>(); }

}  // namespace farpoint

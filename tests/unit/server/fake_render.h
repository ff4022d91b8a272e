// A bake and a renderer that take no time: every pixel's value tells its place. For tests of who
// does what when.
#pragma once

#include <atomic>
#include <chrono>
#include <functional>
#include <limits>
#include <memory>
#include <mutex>
#include <string>
#include <thread>
#include <utility>
#include <vector>

#include "core/image/film.h"
#include "server/scene_baker.h"
#include "worker/tile_renderer.h"

namespace farpoint {

class FakeBaker final : public SceneBaker {
 public:
  absl::StatusOr<BakeResult> Bake(const AssetBundle& asset, const JobSpec& spec,
                                  std::optional<double> time_s,
                                  const std::atomic<bool>& cancel) override {
    ++bakes;
    if (time_s && animated) {
      std::lock_guard lock(mutex);
      times.push_back(*time_s);
    }
    while (hold.load() || (time_s && *time_s >= hold_from_s.load())) {
      if (cancel.load()) return absl::CancelledError("stopped");
      std::this_thread::sleep_for(std::chrono::milliseconds(1));
    }
    if (!error.ok() && (!time_s || *time_s >= error_from_s)) return error;
    FP_ASSIGN_OR_RETURN(const Blob root, asset.Find(asset.root));
    BakeResult result;
    result.blobs.prepared_scene = root;
    result.animated = animated;
    if (animated && time_s) {
      result.blobs.prepared_scene = Blob::FromString("at " + std::to_string(*time_s));
    }
    result.blobs.tree_topology = Blob::FromString("topology");
    result.cameras.resize(1);
    result.cameras[0].name = "main";
    if (animated && time_s) result.cameras[0].eye = {*time_s, 0, 0};
    result.notes = {"no camera: one was made up", "another note"};
    result.made_up_camera = true;
    result.stats.counts["triangles"] = 12;
    result.stats.counts["surfels"] = 1000;
    result.stats.seconds[static_cast<size_t>(Stage::kTree)] = 2;
    return result;
  }
  std::atomic<int> bakes = 0;
  std::atomic<bool> hold = false;  // bakes wait
  // Set before the first job:
  absl::Status error;
  double error_from_s = 0;  // frames before it are baked all the same
  bool animated = false;    // each time has a scene and a camera of its own
  std::atomic<double> hold_from_s = std::numeric_limits<double>::infinity();
  std::mutex mutex;
  std::vector<double> times;  // of an animated scene, as they were asked for; guarded by mutex
};

// The value of a pixel: unlike anything else's.
inline float FakePixel(int x, int y, int channel) {
  return static_cast<float>(x * 4 + y * 1000 + channel);
}

inline Film FakeTile(const PixelRect& rect, const std::vector<Layer>& layers) {
  Film film(rect, layers);
  for (const Layer layer : film.layers()) {
    const int channels = static_cast<int>(InfoOf(layer).channels.size());
    for (int c = 0; c < channels; ++c) {
      const std::span<float> plane = film.Plane(layer, c);
      size_t at = 0;
      for (int y = rect.y0; y < rect.y1; ++y) {
        for (int x = rect.x0; x < rect.x1; ++x) plane[at++] = FakePixel(x, y, c);
      }
    }
  }
  film.RoundToStorage();
  return film;
}

class FakeFrame final : public RenderedFrame {
 public:
  using Hook = std::function<absl::Status(const PixelRect&, const std::atomic<bool>*)>;
  FakeFrame(FrameSpec frame, Hook hook) : frame_(std::move(frame)), hook_(std::move(hook)) {}
  absl::StatusOr<TileOutput> RenderTile(const PixelRect& tile, Executor&,
                                        const std::function<void(int, int)>& progress,
                                        const std::atomic<bool>* cancel) const override {
    if (hook_) FP_RETURN_IF_ERROR(hook_(tile, cancel));
    if (progress) progress(1, 1);
    TileOutput output;
    output.film = FakeTile(tile, frame_.settings.layers);
    output.stats.counts["receivers"] = static_cast<uint64_t>(tile.area());
    return output;
  }

 private:
  FrameSpec frame_;
  Hook hook_;
};

class FakeScene final : public RenderedScene {
 public:
  FakeScene(FakeFrame::Hook hook, std::atomic<int>& frames)
      : hook_(std::move(hook)), frames_(frames) {}
  absl::StatusOr<std::unique_ptr<RenderedFrame>> StartFrame(const FrameSpec& frame) const override {
    ++frames_;
    return std::make_unique<FakeFrame>(frame, hook_);
  }

 private:
  FakeFrame::Hook hook_;
  std::atomic<int>& frames_;
};

class FakeRenderer final : public TileRenderer {
 public:
  // `hook` is called at the start of each tile, from the worker's thread.
  explicit FakeRenderer(FakeFrame::Hook hook = {}) : hook_(std::move(hook)) {}
  absl::StatusOr<std::shared_ptr<const RenderedScene>> LoadScene(const BakedScene&,
                                                                 Executor&) const override {
    ++loads;
    return std::make_shared<const FakeScene>(hook_, frames);
  }
  mutable std::atomic<int> loads = 0;
  mutable std::atomic<int> frames = 0;

 private:
  FakeFrame::Hook hook_;
};

}  // namespace farpoint

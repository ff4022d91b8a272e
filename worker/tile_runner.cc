#include "worker/tile_runner.h"

#include <algorithm>
#include <string>
#include <utility>
#include <vector>

#include "core/base/clock.h"

namespace farpoint {

namespace {

absl::StatusOr<TileOutput> Annotated(absl::StatusOr<TileOutput> output, const std::string& place) {
  if (output.ok() || absl::IsCancelled(output.status())) return output;
  return Annotate(output.status(), place);
}

}  // namespace

TileRunner::TileRunner(const TileRenderer& renderer, BlobSource& blobs, Executor& executor,
                       size_t cached_scenes)
    : renderer_(renderer),
      blobs_(blobs),
      executor_(executor),
      cached_scenes_(std::max<size_t>(1, cached_scenes)) {}

absl::StatusOr<std::shared_ptr<const RenderedScene>> TileRunner::SceneOf(
    const SceneBlobs& blobs, TileProgress& progress, const std::atomic<bool>& cancel,
    Stats& stats) {
  const auto known = std::find_if(scenes_.begin(), scenes_.end(),
                                  [&](const CachedScene& c) { return c.blobs == blobs; });
  if (known != scenes_.end()) {
    scenes_.splice(scenes_.begin(), scenes_, known);
    ++stats.skipped["scene_broadcasts"];
    return scenes_.front().scene;
  }
  // Room first: two large scenes at a time may be more than the memory holds.
  while (scenes_.size() >= cached_scenes_) scenes_.pop_back();

  const SteadyClock clock;
  const TimePoint start = clock.Now();
  const double cpu_start = ThreadCpuSeconds();
  const auto go_on = [&] {
    progress.Advance();
    return !cancel.load();
  };
  BakedScene baked;
  FP_ASSIGN_OR_RETURN(baked.prepared_scene, blobs_.Get(blobs.prepared_scene, go_on));
  if (!blobs.tree_topology.empty()) {
    FP_ASSIGN_OR_RETURN(baked.tree_topology, blobs_.Get(blobs.tree_topology, go_on));
  }
  if (!blobs.tree_radiance.empty()) {
    FP_ASSIGN_OR_RETURN(baked.tree_radiance, blobs_.Get(blobs.tree_radiance, go_on));
  }
  constexpr auto kBroadcast = static_cast<size_t>(Stage::kBroadcast);
  stats.seconds[kBroadcast] += ThreadCpuSeconds() - cpu_start;
  stats.wall_seconds[kBroadcast] += std::chrono::duration<double>(clock.Now() - start).count();

  progress.Advance();
  FP_ASSIGN_OR_RETURN(auto scene, renderer_.LoadScene(baked, executor_));
  progress.Advance();
  scenes_.push_front({blobs, scene});
  return scene;
}

absl::StatusOr<TileOutput> TileRunner::RenderCarefully(const TileWork& work, TileProgress& progress,
                                                       const std::atomic<bool>& cancel) {
  TileOutput output;
  output.film = Film(work.rect, work.frame.settings.layers);
  const std::vector<PixelRect> blocks = BlocksOf(work.rect, work.frame.film.frame());
  for (size_t i = 0; i < blocks.size(); ++i) {
    const PixelRect block = blocks[i].Intersect(work.rect);
    const std::string place = "block " + std::to_string(block.x0 / kBlockSize) + ", " +
                              std::to_string(block.y0 / kBlockSize) + " (from pixel " +
                              std::to_string(block.x0) + ", " + std::to_string(block.y0) + ")";
    progress.MoveTo(place);
    FP_ASSIGN_OR_RETURN(
        const TileOutput part,
        Annotated(frame_->RenderTile(
                      block, executor_, [&](int, int) { progress.Advance(); }, &cancel),
                  place));
    output.film.Paste(part.film);
    output.stats += part.stats;
    progress.fraction = static_cast<float>(i + 1) / static_cast<float>(blocks.size());
  }
  return output;
}

absl::StatusOr<TileResult> TileRunner::Run(const TileWork& work, TileProgress& progress,
                                           const std::atomic<bool>& cancel) {
  Stats stats;
  if (frame_ == nullptr || frame_job_ != work.job || frame_index_ != work.frame_index ||
      !(frame_blobs_ == work.blobs)) {
    frame_.reset();
    frame_scene_.reset();
    FP_ASSIGN_OR_RETURN(frame_scene_, SceneOf(work.blobs, progress, cancel, stats));
    FP_ASSIGN_OR_RETURN(frame_, frame_scene_->StartFrame(work.frame));
    frame_job_ = work.job;
    frame_index_ = work.frame_index;
    frame_blobs_ = work.blobs;
  }
  if (cancel.load()) return absl::CancelledError("the tile was dropped");
  progress.rendering = true;
  const auto on_block = [&](int done, int total) {
    progress.fraction = total > 0 ? static_cast<float>(done) / total : 0.f;
    progress.Advance();
  };
  FP_ASSIGN_OR_RETURN(TileOutput output,
                      work.careful ? RenderCarefully(work, progress, cancel)
                                   : frame_->RenderTile(work.rect, executor_, on_block, &cancel));
  if (!(output.film.rect() == work.rect)) {
    return absl::InternalError("the renderer answered with another rectangle");
  }
  stats += output.stats;
  TileResult result;
  result.lease = work.lease;
  result.attempt = work.attempt;
  result.bytes = Blob::FromVector(EncodeFilm(output.film));
  result.sha256 = result.bytes.Hash();
  result.stats = std::move(stats);
  // A network that is slow to take it is no thread that hangs.
  progress.rendering = false;
  return result;
}

}  // namespace farpoint

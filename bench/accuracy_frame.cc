#include "bench/accuracy_frame.h"

#include <array>
#include <utility>

namespace farpoint {

double SumOf(const StageSeconds& seconds, std::span<const Stage> stages) {
  double sum = 0;
  for (const Stage s : stages) sum += seconds[static_cast<size_t>(s)];
  return sum;
}

double GatherSeconds(const Stats& stats) { return SumOf(stats.seconds, kGatherStages); }

double BakeSeconds(const Stats& stats) { return SumOf(stats.seconds, kBakeStages); }

RenderSettings MeasuredSettings(const AccuracyOptions& options) {
  RenderSettings settings;
  settings.quality = options.quality;
  settings.clusters = options.clusters;
  settings.fill = options.fill;
  settings.points = options.points;
  settings.light_samples = options.light_samples;
  settings.seed = options.seed;
  return settings;
}

absl::StatusOr<LoadedFrame> LoadFrame(const Scene& scene, const Camera& camera, int width,
                                      int height, const RenderSettings& settings, BakeCache* cache,
                                      Executor& executor) {
  LoadedFrame loaded;
  BakeOptions options;
  options.cache = cache;
  FP_ASSIGN_OR_RETURN(const BakedScene baked,
                      Bake(scene, settings, executor, loaded.bake, options));
  loaded.frame.prepared_scene = baked.prepared_scene.Hash();
  FP_ASSIGN_OR_RETURN(loaded.frame.scene, LoadedScene::Load(baked, executor));
  loaded.frame.camera = camera;
  loaded.frame.film = {width, height, {0, 0, width, height}};
  FP_RETURN_IF_ERROR(ValidateFilm(loaded.frame.film));
  return loaded;
}

absl::StatusOr<RenderedFrame> RenderByTiles(const SparseFrame& frame,
                                            const RenderSettings& settings, Executor& executor) {
  FP_ASSIGN_OR_RETURN(
      const auto renderer,
      FrameRenderer::Create(frame.scene, FrameSpec{frame.camera, frame.film, settings}));
  RenderedFrame rendered{Film(frame.film.crop, settings.layers), {}};
  for (const PixelRect& tile : TilesOf(frame.film, static_cast<int>(settings.tile_px))) {
    FP_ASSIGN_OR_RETURN(const TileOutput out, renderer->RenderTile(tile, executor, {}, nullptr));
    rendered.film.Paste(out.film);
    rendered.stats += out.stats;
  }
  return rendered;
}

std::vector<Rgb> ValuesAt(const Film& film, Layer layer, std::span<const PixelPosition> pixels) {
  std::vector<Rgb> values;
  values.reserve(pixels.size());
  for (const PixelPosition& p : pixels) {
    values.push_back(
        {film.Get(layer, 0, p.x, p.y), film.Get(layer, 1, p.x, p.y), film.Get(layer, 2, p.x, p.y)});
  }
  return values;
}

}  // namespace farpoint

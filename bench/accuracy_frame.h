// One frame of the accuracy report: baked, loaded, rendered.
#pragma once

#include <array>
#include <memory>
#include <span>

#include "bench/accuracy.h"
#include "bench/sparse_reference.h"
#include "core/base/executor.h"
#include "core/base/stats.h"
#include "core/image/film.h"
#include "core/render/bake.h"

namespace farpoint {

// Of what an integrator does for indirect light.
inline constexpr std::array kGatherStages = {Stage::kCluster,   Stage::kCut,      Stage::kRaster,
                                             Stage::kComposite, Stage::kConvolve, Stage::kTrace};
// Of a bake.
inline constexpr std::array kBakeStages = {Stage::kImport, Stage::kSample, Stage::kShade,
                                           Stage::kTree};
using StageSeconds = std::array<double, kStageCount>;
double SumOf(const StageSeconds& seconds, std::span<const Stage> stages);

// cluster + cut + raster + composite + convolve + trace, thread-seconds.
double GatherSeconds(const Stats& stats);
// import + sample + shade + tree, thread-seconds.
double BakeSeconds(const Stats& stats);

// The measured image's settings, without layers.
RenderSettings MeasuredSettings(const AccuracyOptions& options);

struct LoadedFrame {
  SparseFrame frame;  // the whole film is the crop
  Stats bake;
};
// `cache` may be null.
absl::StatusOr<LoadedFrame> LoadFrame(const Scene& scene, const Camera& camera, int width,
                                      int height, const RenderSettings& settings, BakeCache* cache,
                                      Executor& executor);

struct RenderedFrame {
  Film film;
  Stats stats;
};
// Tile by tile, as workers do it: one renderer, tiles of settings.tile_px in raster order.
absl::StatusOr<RenderedFrame> RenderByTiles(const SparseFrame& frame,
                                            const RenderSettings& settings, Executor& executor);

// The values of a layer of three channels at pixels.
std::vector<Rgb> ValuesAt(const Film& film, Layer layer, std::span<const PixelPosition> pixels);

}  // namespace farpoint

// The truth at some of a frame's pixels: what a converged path tracer says there. A whole frame is
// too dear; a few thousand pixels, one in each cell of a grid, tell an error as well.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <functional>
#include <memory>
#include <span>
#include <string>
#include <string_view>
#include <vector>

#include "core/base/executor.h"
#include "core/base/hash.h"
#include "core/base/status.h"
#include "core/render/frame_renderer.h"

namespace farpoint {

struct PixelPosition {
  int x = 0, y = 0;  // in the frame
  bool operator==(const PixelPosition&) const = default;
};

// One pixel of each cell of a grid of squares over `rect`, jittered within its cell by the seed and
// the cell's coordinates; row by row. The side of the cells is such that there are about `count`,
// at least that many if `rect` has them; cells at the right and bottom may be narrower.
std::vector<PixelPosition> StratifiedPixels(const PixelRect& rect, size_t count, uint64_t seed);

// Of one frame. `prepared_scene` names what `scene` was made of: light and materials included.
struct SparseFrame {
  std::shared_ptr<const LoadedScene> scene;
  Digest prepared_scene;
  Camera camera;
  FilmSpec film;  // the crop holds all pixels that are asked for
};

struct SparseReferenceOptions {
  double noise = 0.01;      // aim: root mean square error over mean
  double budget_s = 200;    // thread-seconds that a call may trace for indirect light, about
  uint32_t min_paths = 64;  // per pixel, half and round; 8..2^20
  uint32_t direct_samples =
      1024;           // as RenderSettings::light_samples, of a half; 0: no direct light
  uint64_t seed = 0;  // of the paths; no seed of a render to be measured
  // Where references are kept; empty: nowhere. A file is named by `label` and its key and is
  // replaced as a whole.
  std::string cache_dir;
  std::string label = "reference";
};

// By pixel, in the order in which pixels were asked for. 0 where the primary ray hits nothing.
struct SparseReference {
  std::vector<uint8_t> hit;
  // Irradiance, W/m²: two independent estimates of each. direct is empty if it was not asked for.
  std::array<std::vector<Rgb>, 2> indirect_half, direct_half;
  std::vector<Rgb> albedo;
  uint32_t paths = 0;       // per pixel, half and round
  uint32_t rounds = 0;      // independent renders of so many paths for each half; their means count
  double seconds = 0;       // thread-seconds that all rounds took
  bool from_cache = false;  // nothing was traced

  // The mean of the halves.
  Rgb Indirect(size_t i) const { return (indirect_half[0][i] + indirect_half[1][i]) * 0.5f; }
  Rgb Direct(size_t i) const { return (direct_half[0][i] + direct_half[1][i]) * 0.5f; }
  // |A - B| / 2: its mean square is that of the mean's error, whatever the distribution. So
  // (x - mean)² - error² = (x - A)(x - B) has no bias as the square of x's error.
  Rgb IndirectError(size_t i) const;
  Rgb DirectError(size_t i) const;

  // Root mean square of the errors over the mean, of pixels that hit; 0 if the mean is 0.
  double IndirectNoise() const;
  double DirectNoise() const;
};

// Renders `pixels` by `pt` as tiles of one pixel, so that camera, film and receivers are those of
// every other integrator. A pilot at up to 256 of the pixels says how many paths the aim takes;
// rounds are added until it is reached or the budget would be passed, but always one. What the
// cache holds counts: a call with a lower aim or another budget goes on from there.
//
// The cache's key is the hash of the scene, camera, film, pixels, direct samples, seed and of a
// version that changes when pt's estimate does. kDataLoss names a damaged file of the cache;
// kInvalidArgument: no pixels, or one outside of the crop.
absl::StatusOr<SparseReference> TraceSparseReference(
    const SparseFrame& frame, std::span<const PixelPosition> pixels,
    const SparseReferenceOptions& options, Executor& executor,
    const std::function<void(std::string_view)>& progress);

// Of the mean of two independent estimates: sqrt(mean(((a - b) / 2)^2)) over mean((a + b) / 2),
// where `on` is not 0, of the channels together. 0 if the mean is not positive. All equally long.
double NoiseOfHalves(std::span<const uint8_t> on, std::span<const Rgb> a, std::span<const Rgb> b);

// The bytes of a file of the cache and back. kDataLoss for anything that EncodeSparseReference did
// not write for this key and number of pixels. Sizes are checked before anything is allocated.
std::vector<std::byte> EncodeSparseReference(const SparseReference& reference, const Digest& key);
absl::StatusOr<SparseReference> DecodeSparseReference(std::span<const std::byte> bytes,
                                                      const Digest& key, size_t pixels);

}  // namespace farpoint

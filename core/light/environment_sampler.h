// Importance sampling of the environment map, with the sky added to it, for one surface normal.
//
// The environment is bilinear between texels, so it is a sum of tents, one per texel, each over the
// texel and the halves of its neighbours. A tent is chosen by luminance, solid angle and cosine,
// then a direction within it by the tent itself: what is drawn is what is looked up, exactly.
// The cosine enters by 256 cells, rectangles of the map that halve what is bright and what is wide:
// each knows the mean direction of its light and how far it spreads about that, so the choice among
// the cells follows the normal, and a sun is a cell of its own. Within a cell the choice does not
// depend on the normal.
// A sun takes most of the light and needs the fewest samples: its cells all see or miss it alike.
// So cells far brighter than the mean, if together they are small, are a group apart, which gets as
// many eighths of the samples as it has of the light, but at least one and at most four: a whole
// number, so that the sun's share has no noise, and its shadow is not left to a few samples.
// Sums run in a fixed order; probabilities are counts of 2^-31, so that what
// is divided by is what was used.
#pragma once

#include <array>
#include <cstdint>
#include <optional>
#include <vector>

#include "core/math/vec.h"
#include "core/scene/prepared_scene.h"

namespace farpoint {

// Immutable; thread-safe.
class EnvironmentSampler {
 public:
  // `scene` must have an environment map and outlive this. Takes 4 bytes per texel. Maps of less
  // than 96 x 48 texels are refined by odd factors, which leaves the bilinear function as it is.
  explicit EnvironmentSampler(const PreparedScene& scene);

  static constexpr uint32_t kCells = 256;

  // The cells as a surface of one unit normal sees them. Cost: about the time of a ray.
  struct View {
    Vec3d n_map;  // the normal in the map's frame
    // Binary heaps from index 1: sums over the cells, which stand in the second half. The first is
    // of the sun's cells, the second of all others.
    alignas(32) std::array<std::array<float, 2 * kCells>, 2> weight;
    double sun_share;  // of the samples
  };
  void LookAlong(const Vec3f& normal, View& view) const;

  struct Draw {
    Vec3f direction;   // unit, world
    Rgb contribution;  // radiance cosθ / density: the estimate of the unshadowed irradiance, > 0
  };
  // (u, v) in [0, 1)² -> a direction above the view's horizon; none if the draw fell below it, or
  // if there is no light above it. The map from (u, v) keeps neighbours together.
  std::optional<Draw> Sample(const View& view, double u, double v) const;

 private:
  // Half-open, in texels of the refined map.
  struct Rect {
    uint32_t x0, y0, x1, y1;
  };
  Rgb Radiance(uint32_t x, uint32_t y) const;  // of a texel, with the sky
  void BuildCells(const std::vector<float>& power);
  void FindSun(const std::vector<float>& power);
  void BuildDistribution(uint32_t cell, std::vector<float>& power);

  const PreparedScene& scene_;
  uint32_t refine_x_ = 1, refine_y_ = 1;    // odd
  uint32_t width_ = 0, height_ = 0;         // refined
  std::array<bool, kCells> splits_rows_{};  // by inner node of the heap
  std::array<Rect, kCells> rect_{};
  // By cell: Σ power direction, in the map's frame; the length of that times the sine of the angle
  // about its direction within which the cell lies.
  alignas(32) std::array<float, kCells> x_{}, y_{}, z_{}, spread_{};
  // By cell: all bits set for the sun's.
  alignas(32) std::array<uint32_t, kCells> is_sun_{};
  bool has_sun_ = false;
  std::array<uint32_t, kCells> first_row_{};  // into row_begin_
  // Where each row of a cell and each texel of such a row begins, in counts of 2^-31.
  std::vector<uint32_t> row_begin_;
  std::vector<uint32_t> texel_begin_;  // by texel
};

}  // namespace farpoint

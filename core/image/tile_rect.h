// Pixel rectangles: half-open, in full-frame pixel coordinates, origin at the top left.
#pragma once

#include <algorithm>
#include <cstdint>
#include <vector>

#include "core/base/status.h"

namespace farpoint {

// The fixed grid within which receivers are clustered and images are hashed. An image parameter.
inline constexpr int kBlockSize = 32;

struct PixelRect {
  int x0 = 0, y0 = 0, x1 = 0, y1 = 0;

  bool operator==(const PixelRect&) const = default;
  int width() const { return x1 - x0; }
  int height() const { return y1 - y0; }
  bool empty() const { return x1 <= x0 || y1 <= y0; }
  int64_t area() const { return empty() ? 0 : int64_t{width()} * height(); }
  bool Contains(int x, int y) const { return x >= x0 && x < x1 && y >= y0 && y < y1; }
  bool Contains(const PixelRect& r) const {
    return r.x0 >= x0 && r.x1 <= x1 && r.y0 >= y0 && r.y1 <= y1;
  }
  PixelRect Intersect(const PixelRect& r) const {
    return {std::max(x0, r.x0), std::max(y0, r.y0), std::min(x1, r.x1), std::min(y1, r.y1)};
  }
};

// What is rendered of a frame of width x height: the pixels of `crop` (the whole frame: no crop).
struct FilmSpec {
  int width = 0, height = 0;
  PixelRect crop;

  PixelRect frame() const { return {0, 0, width, height}; }
};

// 1 <= width, height <= 65536, at most 2^30 pixels, crop not empty and inside the frame; else
// kInvalidArgument.
absl::Status ValidateFilm(const FilmSpec& film);

// The blocks that touch `rect`, in raster order, each whole but clipped to the frame (not to rect).
std::vector<PixelRect> BlocksOf(const PixelRect& rect, const PixelRect& frame);

// Cuts the crop into tiles of `tile` x `tile` pixels on a grid anchored at the frame's origin, in
// raster order, each clipped to the crop. `tile` must be a positive multiple of kBlockSize.
std::vector<PixelRect> TilesOf(const FilmSpec& film, int tile);

}  // namespace farpoint

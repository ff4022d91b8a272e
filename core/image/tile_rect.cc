#include "core/image/tile_rect.h"

#include <string>

#include "core/base/check.h"

namespace farpoint {

namespace {

constexpr int kMaxSide = 65536;
constexpr int64_t kMaxPixels = int64_t{1} << 30;

std::string RectText(const PixelRect& r) {
  return std::to_string(r.x0) + "," + std::to_string(r.y0) + "," + std::to_string(r.x1) + "," +
         std::to_string(r.y1);
}

}  // namespace

absl::Status ValidateFilm(const FilmSpec& film) {
  const std::string size = std::to_string(film.width) + "x" + std::to_string(film.height);
  if (film.width < 1 || film.height < 1 || film.width > kMaxSide || film.height > kMaxSide) {
    return absl::InvalidArgumentError(
        "resolution " + size + ": width and height must be from 1 to " + std::to_string(kMaxSide));
  }
  if (film.frame().area() > kMaxPixels) {
    return absl::InvalidArgumentError("resolution " + size + " has more than the " +
                                      std::to_string(kMaxPixels) +
                                      " pixels that are accepted; render it in several frames");
  }
  if (film.crop.empty()) {
    return absl::InvalidArgumentError("crop " + RectText(film.crop) +
                                      " is empty; it is x0,y0,x1,y1 with x0 < x1 and y0 < y1");
  }
  if (!film.frame().Contains(film.crop)) {
    return absl::InvalidArgumentError("crop " + RectText(film.crop) + " leaves the frame of " +
                                      size + " pixels");
  }
  return absl::OkStatus();
}

std::vector<PixelRect> BlocksOf(const PixelRect& rect, const PixelRect& frame) {
  std::vector<PixelRect> blocks;
  const PixelRect r = rect.Intersect(frame);
  if (r.empty()) return blocks;
  // The grid is anchored at the frame's origin, (0, 0) in all our frames.
  const int bx0 = (r.x0 - frame.x0) / kBlockSize, bx1 = (r.x1 - 1 - frame.x0) / kBlockSize + 1;
  const int by0 = (r.y0 - frame.y0) / kBlockSize, by1 = (r.y1 - 1 - frame.y0) / kBlockSize + 1;
  blocks.reserve(static_cast<size_t>(bx1 - bx0) * static_cast<size_t>(by1 - by0));
  for (int by = by0; by < by1; ++by) {
    for (int bx = bx0; bx < bx1; ++bx) {
      const int x = frame.x0 + bx * kBlockSize;
      const int y = frame.y0 + by * kBlockSize;
      blocks.push_back(PixelRect{x, y, x + kBlockSize, y + kBlockSize}.Intersect(frame));
    }
  }
  return blocks;
}

std::vector<PixelRect> TilesOf(const FilmSpec& film, int tile) {
  FP_CHECK(tile > 0 && tile % kBlockSize == 0);
  std::vector<PixelRect> tiles;
  const PixelRect& crop = film.crop;
  if (crop.empty()) return tiles;
  for (int64_t y = crop.y0 / tile * int64_t{tile}; y < crop.y1; y += tile) {
    for (int64_t x = crop.x0 / tile * int64_t{tile}; x < crop.x1; x += tile) {
      tiles.push_back({static_cast<int>(std::max<int64_t>(x, crop.x0)),
                       static_cast<int>(std::max<int64_t>(y, crop.y0)),
                       static_cast<int>(std::min<int64_t>(x + tile, crop.x1)),
                       static_cast<int>(std::min<int64_t>(y + tile, crop.y1))});
    }
  }
  return tiles;
}

}  // namespace farpoint

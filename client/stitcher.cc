#include "client/stitcher.h"

#include <algorithm>
#include <span>
#include <string>
#include <utility>

namespace farpoint {
namespace {

std::string RectText(const PixelRect& r) {
  return std::to_string(r.x0) + "," + std::to_string(r.y0) + "," + std::to_string(r.x1) + "," +
         std::to_string(r.y1);
}

// The tiles of a frame; none for an index that does not exist. Coordinators of our version send the
// same number of tiles for each frame.
std::span<const TileInfo> SpanOfFrame(const JobInfo& info, uint32_t frame) {
  const size_t frames = info.frames.size();
  if (frame >= frames) return {};
  const size_t count = info.tiles.size() / frames;
  return std::span(info.tiles).subspan(frame * count, count);
}

}  // namespace

Stitcher::Stitcher(uint32_t first_tile, std::vector<TileInfo> tiles, Film film)
    : first_tile_(first_tile),
      tiles_(std::move(tiles)),
      have_(tiles_.size(), false),
      film_(std::move(film)) {}

FrameTiles TilesOfFrame(const JobInfo& info, uint32_t frame) {
  FrameTiles tiles;
  for (const TileInfo& tile : SpanOfFrame(info, frame)) {
    ++tiles.total;
    if (!tile.sha256.empty()) ++tiles.committed;
  }
  return tiles;
}

absl::StatusOr<Stitcher> Stitcher::Create(const JobInfo& info, uint32_t frame, bool partial) {
  FP_RETURN_IF_ERROR(Annotate(ValidateFilm(info.spec.film), "job " + info.status.id.value));
  const PixelRect& crop = info.spec.film.crop;
  const std::span<const TileInfo> tiles = SpanOfFrame(info, frame);
  const auto first = static_cast<uint32_t>(frame * tiles.size());
  int64_t covered = 0;
  for (size_t i = 0; i < tiles.size(); ++i) {
    const TileInfo& tile = tiles[i];
    const std::string name = "tile " + std::to_string(first + i);
    if (tile.frame != frame) {
      return absl::InvalidArgumentError(name + " is not one of frame " + std::to_string(frame) +
                                        "; coordinator and client do not match");
    }
    if (tile.rect.empty() || !crop.Contains(tile.rect)) {
      return absl::InvalidArgumentError(name + " has the pixels " + RectText(tile.rect) +
                                        " outside the crop " + RectText(crop) +
                                        "; coordinator and client do not match");
    }
    if (tile.sha256.empty() && !partial) {
      return absl::FailedPreconditionError(name + " of job " + info.status.id.value +
                                           " is not committed yet; wait until the job is done");
    }
    covered += tile.rect.area();
  }
  // Inside the crop, not overlapping, and as large together: then each pixel is there once. Tiles
  // lie on a grid, so that two overlap only if they share a corner row and column.
  std::vector<PixelRect> sorted;
  for (const TileInfo& tile : tiles) sorted.push_back(tile.rect);
  std::sort(sorted.begin(), sorted.end(), [](const PixelRect& a, const PixelRect& b) {
    return std::pair(a.y0, a.x0) < std::pair(b.y0, b.x0);
  });
  for (size_t i = 1; i < sorted.size(); ++i) {
    const PixelRect& a = sorted[i - 1];
    const PixelRect& b = sorted[i];
    const bool next_in_row = a.y0 == b.y0 && a.y1 == b.y1 && a.x1 <= b.x0;
    const bool next_row = a.y1 <= b.y0;
    if (!next_in_row && !next_row) {
      return absl::InvalidArgumentError("the tiles " + RectText(a) + " and " + RectText(b) +
                                        " do not lie on one grid; coordinator and client do not "
                                        "match");
    }
  }
  if (covered != crop.area()) {
    return absl::InvalidArgumentError("the tiles have " + std::to_string(covered) +
                                      " pixels, the crop has " + std::to_string(crop.area()) +
                                      "; coordinator and client do not match");
  }
  return Stitcher(first, {tiles.begin(), tiles.end()}, Film(crop, info.spec.settings.layers));
}

absl::StatusOr<Film> OpenTile(const TileData& tile, const TileInfo& expected,
                              std::span<const Layer> layers) {
  const std::string name = "tile " + std::to_string(tile.tile);
  const Digest actual = tile.bytes.Hash();
  if (actual != expected.sha256) {
    return absl::DataLossError(name + " arrived damaged: its SHA-256 is " + actual.Hex() +
                               ", announced was " + expected.sha256.Hex());
  }
  auto film = DecodeFilm(tile.bytes.bytes());
  FP_RETURN_IF_ERROR(Annotate(film.status(), name));
  if (film->rect() != expected.rect) {
    return absl::DataLossError(name + " has the pixels " + RectText(film->rect()) +
                               ", announced were " + RectText(expected.rect));
  }
  if (!std::equal(film->layers().begin(), film->layers().end(), layers.begin(), layers.end())) {
    return absl::DataLossError(name + " has other layers than the job");
  }
  return film;
}

absl::Status Stitcher::Add(const TileData& tile) {
  const std::string name = "tile " + std::to_string(tile.tile);
  // Wraps around for a smaller number.
  const uint32_t index = tile.tile - first_tile_;
  if (index >= tiles_.size()) {
    return absl::DataLossError(name + " is not one of the frame's " +
                               std::to_string(tiles_.size()) + " tiles");
  }
  if (have_[index]) return absl::OkStatus();
  FP_ASSIGN_OR_RETURN(const Film film, OpenTile(tile, tiles_[index], film_.layers()));
  film_.Paste(film);
  have_[index] = true;
  return absl::OkStatus();
}

std::vector<uint32_t> Stitcher::Missing() const {
  std::vector<uint32_t> missing;
  for (size_t i = 0; i < have_.size(); ++i) {
    if (!have_[i] && !tiles_[i].sha256.empty()) {
      missing.push_back(first_tile_ + static_cast<uint32_t>(i));
    }
  }
  return missing;
}

}  // namespace farpoint

// Puts the tiles of one frame together. Nothing of a tile is believed: its hash, its rectangle and
// its layers are checked against what the coordinator announced. Not thread-safe.
#pragma once

#include <cstdint>
#include <span>
#include <utility>
#include <vector>

#include "core/base/status.h"
#include "core/image/film.h"
#include "proto/job.h"

namespace farpoint {

// How much of a frame can be fetched.
struct FrameTiles {
  uint32_t committed = 0, total = 0;  // total is 0 before the coordinator knows the tiles
  bool complete() const { return total > 0 && committed == total; }
};
// `frame` is an index into info.frames.
FrameTiles TilesOfFrame(const JobInfo& info, uint32_t frame);

// The pixels of `tile`, if hash, rectangle and layers are what `expected` and `layers` (sorted, as
// a film's) announce; else kDataLoss names the tile and what is wrong with it.
absl::StatusOr<Film> OpenTile(const TileData& tile, const TileInfo& expected,
                              std::span<const Layer> layers);

class Stitcher {
 public:
  // Of info.frames[frame]. kInvalidArgument unless the frame's tiles cover the crop exactly: each
  // pixel once. kFailedPrecondition if a tile is not committed yet, unless `partial`: then its
  // pixels stay zero and it is not missing.
  static absl::StatusOr<Stitcher> Create(const JobInfo& info, uint32_t frame, bool partial = false);

  // `tile.tile` counts over the whole job. kDataLoss names the tile and what is wrong with it; the
  // film is then unchanged. A tile that is there already is ignored.
  absl::Status Add(const TileData& tile);

  // Ascending, counted over the whole job.
  std::vector<uint32_t> Missing() const;
  const Film& film() const { return film_; }
  Film TakeFilm() && { return std::move(film_); }

 private:
  Stitcher(uint32_t first_tile, std::vector<TileInfo> tiles, Film film);

  uint32_t first_tile_;
  std::vector<TileInfo> tiles_;  // of the frame
  std::vector<bool> have_;
  Film film_;
};

}  // namespace farpoint

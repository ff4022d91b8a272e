// Puts a job's tiles together. Nothing of a tile is believed: its hash, its rectangle and its
// layers are checked against what the coordinator announced. Not thread-safe.
#pragma once

#include <cstdint>
#include <utility>
#include <vector>

#include "core/base/status.h"
#include "core/image/film.h"
#include "proto/job.h"

namespace farpoint {

class Stitcher {
 public:
  // kFailedPrecondition if a tile is not committed yet, kInvalidArgument unless the tiles cover the
  // crop exactly: each pixel once.
  static absl::StatusOr<Stitcher> Create(const JobInfo& info);

  // kDataLoss names the tile and what is wrong with it; the film is then unchanged. A tile that is
  // there already is ignored.
  absl::Status Add(const TileData& tile);

  // Ascending.
  std::vector<uint32_t> Missing() const;
  const Film& film() const { return film_; }
  Film TakeFilm() && { return std::move(film_); }

 private:
  Stitcher(const JobInfo& info, Film film);

  std::vector<TileInfo> tiles_;
  std::vector<bool> have_;
  Film film_;
};

}  // namespace farpoint

// How long a job's tiles will take, from when which of them were committed. A plain class without a
// clock: times are seconds since the first lease, pauses left out; they never fall.
//
// Of the first frame: what a tile costs is taken to go partly with its own pixels, partly with what
// lies within kReachPx of it and no earlier tile has been near: what neighbours share is made by
// the first of them. How large the second part is, is fitted to the commits, drawn towards
// `usual_share` where there are few. So the tiles that were done are a part of the whole that
// is known whatever their order; what the picture holds where nobody has looked is not. A part of
// the first tile's time may have gone into loading the scene; that is fitted, too.
//
// Of a sequence, once a frame is complete: its frames take as long as the last ones, bakes
// included, and the frame in work spends its time as the one before it did.
#pragma once

#include <cstddef>
#include <cstdint>
#include <optional>
#include <span>
#include <vector>

#include "core/image/tile_rect.h"

namespace farpoint {

class TimeLeft {
 public:
  static constexpr int kReachPx = 24;

  // `rects`: the tiles of each frame, as many as `tiles` has frames of them; empty, or another
  // number: tiles of a frame count as equal squares far from each other. `done`: tiles that were
  // there before. `usual_share` of the cost is shared between neighbours, [0, 1).
  TimeLeft() = default;
  TimeLeft(uint32_t tiles, uint32_t frame_tiles, std::span<const PixelRect> rects,
           std::span<const uint32_t> done, double usual_share);

  // `tile` < tiles, none twice.
  void Commit(uint32_t tile, double elapsed_s);
  // None before the first commit. O(1); after a commit some 7000 logarithms, 0.1 ms.
  std::optional<double> SecondsLeft(double elapsed_s) const;

 private:
  // Shares of a frame, [0, 1].
  struct Part {
    double own = 0, near = 0;
    double Of(double share) const { return (1 - share) * own + share * near; }
  };
  struct Fit {
    size_t commits = 0;  // by which it was made
    double whole_s = 0, next_s = 0;
  };

  // Counts a tile of the first frame in `part_`.
  void Cover(uint32_t tile);
  Fit FitFirstFrame() const;
  double LeftOfSequence(double elapsed_s) const;

  uint32_t tiles_ = 0, frame_tiles_ = 1, before_ = 0;
  std::vector<PixelRect> rects_;  // cleared when the first frame is known
  double usual_share_ = 0;
  int cell_px_ = 8, columns_ = 0, rows_ = 0, left_ = 0, top_ = 0;
  std::vector<bool> near_;  // cells that some tile has been near
  size_t near_count_ = 0;
  double own_px_ = 0, all_px_ = 0;
  Part begin_;                     // what was there before
  std::vector<Part> parts_;        // after each commit
  std::vector<double> commits_s_;  // not falling
  mutable Fit fit_;
};

}  // namespace farpoint

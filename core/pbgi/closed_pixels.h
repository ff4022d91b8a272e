// Which squares of a microbuffer nothing that is still to be drawn can change: the saturation test
// by which nodes and whole subtrees of the point tree are found to be hidden (docs/skipping.md).
//
// A pixel is closed from a distance D on if it lies below the horizon of every receiver of the
// view, where it weighs nothing, or if the rules of its splats (core/pbgi/microbuffer.h) refuse
// whatever is drawn at D or beyond: coverage splats, if it is full, or covered for the most part by
// what lies well before D; opaque ones, if it shows something before D. Closed pixels stay closed
// as long as nodes are drawn front to back, so leaving out what falls on closed pixels alone
// changes no bit of an irradiance.
//
// For the octahedral map only.
#pragma once

#include <cstdint>
#include <vector>

#include "core/base/aligned.h"
#include "core/math/vec8.h"
#include "core/pbgi/gather_params.h"
#include "core/pbgi/microbuffer.h"
#include "core/pbgi/tree_cut.h"

namespace farpoint {

class ClosedPixels {
 public:
  // Squares are known up to this side.
  static constexpr int kLargest = 16;

  // `map` must outlive this; at least kLargest pixels wide. Nothing is closed.
  explicit ClosedPixels(const MicrobufferMap& map);

  // Finds what is closed in `buffer` for nodes at `distance_m` or beyond. `leaf_radius_m`: of the
  // largest surfel, discs of which may be drawn nearer than their centres.
  void Find(const Microbuffer& buffer, const CutView& view, Splat splat, float distance_m,
            float leaf_radius_m);

  // Pixels that are closed because they are full; those below the horizon aside.
  uint32_t full() const { return full_; }
  // The side of the largest square of closed pixels whose first column and row these are, in
  // [-kLargest, side): squares go on across the borders of the map (MicrobufferMap::Wrap).
  int closed_square(int column, int row) const {
    return squares_[static_cast<size_t>((row + kLargest) * stride_ + column + kLargest)];
  }

  // Where unit directions fall, to the bits of MicrobufferMap::Project.
  struct Places {
    F8 u, v;         // pixels
    F8 solid_angle;  // of the pixel
  };
  Places At(const V8& w) const;
  // Bit k: all pixels within `half` columns and rows of the place in lane k are closed. Lanes where
  // that is not known for being too large are 0, and those where `half` is no number.
  unsigned AllClosed(const Places& at, F8 half) const;

  // A bound of how far, in columns or rows, the image of a cap reaches from that of its middle `w`:
  // of the pixels that are touched by directions up to `angle_rad` away. `least_pixel_sr`: a bound
  // below the solid angles of those pixels.
  struct Reach {
    F8 px_per_rad;
    F8 least_pixel_sr;
  };
  Reach ReachAbout(const V8& w, F8 angle_rad) const;

  // The least solid angle of a pixel.
  float least_pixel_sr() const { return least_pixel_sr_; }
  const MicrobufferMap& map() const { return map_; }

 private:
  const MicrobufferMap& map_;
  int side_, stride_;
  float pixel_radius_;  // at least the largest angle from a pixel's centre to a direction in it
  float least_pixel_sr_;
  uint32_t full_ = 0;
  AlignedVector<uint8_t> closed_;          // by pixel: 0 or 255
  AlignedVector<uint8_t> squares_;         // with kLargest more pixels on each side
  AlignedVector<uint8_t> mask_, next_;     // the same: where squares of some side begin
  std::vector<uint32_t> border_, source_;  // places in mask_ beyond the map, and their pixels
};

}  // namespace farpoint

// How a microbuffer's pixels tile the directions (paper §1.1, §3.2; [REG*09] for the warped
// hemisphere). A map is a table, computed once per buffer size and shared.
//
//   kOctahedral  the whole sphere, world-aligned: one map for every receiver of a cluster,
//                whatever its normal (a hemisphere about the active receiver's normal
//                would miss what others see).
//   kCosine      the hemisphere about a receiver's normal (local frame, z up), each pixel with the
//                same cosine-weighted solid angle pi / N².
//
// For each pixel the table holds its solid angle Ω = ∫ dω and the vector V = ∫ ω dω over the
// pixel (irradiance vector; Lambert's formula over the pixel's edges, which are great-circle arcs
// in the octahedral map), so that a pixel that lies before a receiver of normal n contributes
// exactly L n·V to its irradiance.
#pragma once

#include <array>
#include <cstdint>
#include <memory>
#include <vector>

#include "core/base/aligned.h"
#include "core/math/vec.h"
#include "core/pbgi/gather_params.h"

namespace farpoint {

class MicrobufferMap {
 public:
  // 1 <= side <= 256.
  MicrobufferMap(BufferMap kind, uint32_t side);

  BufferMap kind() const { return kind_; }
  uint32_t side() const { return side_; }
  uint32_t pixels() const { return side_ * side_; }
  // Length of the arrays below: pixels() rounded up to a multiple of 8; the rest is zero.
  uint32_t padded() const { return padded_; }

  // Unit directions of the pixels' centres (in the map's frame).
  const float* dir(int axis) const { return dir_[axis].data(); }
  const float* solid_angle() const { return solid_angle_.data(); }      // sr
  const float* weight(int axis) const { return weight_[axis].data(); }  // V

  // Where a unit direction falls, in pixels: u, v in [0, side]. For kCosine the direction must
  // have z >= 0.
  Vec2f Project(const Vec3f& w) const;
  // The unit direction of the point (u, v).
  Vec3f Unproject(float u, float v) const;
  // The pixel at column i, row j, each in [-side, 2 side): beyond a border the octahedral map is
  // its own copy, turned by 180° about the border's middle, so that neighbours are those on the
  // sphere; -1 outside the cosine map (below the horizon).
  int32_t Wrap(int i, int j) const {
    const int n = static_cast<int>(side_);
    if (static_cast<unsigned>(i) < side_ && static_cast<unsigned>(j) < side_) return j * n + i;
    if (kind_ == BufferMap::kCosine) return -1;
    if (i < 0 || i >= n) {
      i = i < 0 ? -1 - i : 2 * n - 1 - i;
      j = n - 1 - j;
    }
    if (j < 0 || j >= n) {
      j = j < 0 ? -1 - j : 2 * n - 1 - j;
      i = n - 1 - i;
    }
    return j * n + i;
  }
  // Mean solid angle of a pixel (kOctahedral: 4 pi / N²); of one seen at the zenith for kCosine
  // (pi / N²; at an angle theta it is that over cos theta).
  float reference_solid_angle() const { return reference_solid_angle_; }

 private:
  BufferMap kind_;
  uint32_t side_, padded_;
  float reference_solid_angle_;
  std::array<AlignedVector<float>, 3> dir_, weight_;
  AlignedVector<float> solid_angle_;
};

}  // namespace farpoint

// Microbuffers: small images of the directions about a receiver, filled by splatting a cut
// (paper §1.1, §3.2, §3.3), composited and convolved.
//
// Coverage splats (the default): nodes are taken front to back; a node covers of each pixel that it
// touches the fraction alpha = Ω_node,pixel / Ω_pixel, Ω_node = A |n·w| / d², as long as the pixel
// is not full; a pixel covered for the most part is closed to surfaces behind (a jump in depth).
// Opaque splats (the paper's): a node fills the pixels whose centres it covers, at least the one of
// its own centre; the nearest wins.
#pragma once

#include <array>
#include <cstdint>
#include <memory>
#include <span>
#include <vector>

#include "core/base/aligned.h"
#include "core/math/vec.h"
#include "core/pbgi/gather_params.h"
#include "core/pbgi/microbuffer_map.h"
#include "core/pbgi/point_tree.h"
#include "core/pbgi/tree_cut.h"

namespace farpoint {

// Splats of one surface leave gaps in some pixels and overlap in others, where the pixel is full
// and the rest is lost: coverage comes out too low by a few per cent. A pixel covered beyond this
// is read as full, at the price of outlines against nothing, which grow by 3 % of a pixel. Cornell,
// 88,880 surfels, k = 100: rr 0.052 to 0.038, bias -2.9 % to -1.2 %; from 0.6 on rr 0.035, bias
// -0.6 %, but a free disc of 115 pixels comes out 5 % too bright.
inline constexpr float kFullFrom = 0.75f;
// A pixel beyond kFullFrom takes nothing more that lies this much farther than what it took last:
// that is another surface, behind the gaps of the one in front, and usually a darker one. Cornell,
// k = 64: bias -1.6 % to -0.7 %; Sponza, pbgi, 1 M surfels, 128x100, against 2048 paths: rr 0.304
// to 0.289, bias -8.9 % to -7.7 %.
inline constexpr float kDepthJump = 1.05f;
// Opaque discs are drawn this much larger, so that they leave no holes.
inline constexpr float kOpaqueDiscScale = 1.4f;
// Support of a coverage splat's kernel over the radius of the disc of its area. At 2.5 the kernels
// of blue-noise neighbours add up to 1 within a few per cent all over a surface.
inline constexpr float kKernelSupport = 2.5f;
// A node's coverage is spread over a square this much wider than one of its solid angle. The true
// outlines of neighbours fit together, their squares do not: a little overlap evens out gaps, in
// which energy is lost (Cornell: rr 0.069 to 0.061, bias -4.3 % to -3.7 % at the coarsest cut).
inline constexpr float kCoverageBoxScale = 1.4f;
// A surfel wider than this many pixels is drawn pixel by pixel.
inline constexpr float kExactDiscPixels = 1.5f;

// Radiance already weighted by coverage, coverage in [0, 1], a depth. Arrays
// have map.padded() elements.
class Microbuffer {
 public:
  explicit Microbuffer(const MicrobufferMap& map);

  // Empty again. Takes O(pixels).
  void Clear();
  // No pixel has any coverage.
  bool empty() const { return touched_ == 0; }

  const MicrobufferMap& map() const { return *map_; }
  float* radiance(int channel) { return values_[channel]; }
  const float* radiance(int channel) const { return values_[channel]; }
  float* coverage() { return values_[3]; }
  const float* coverage() const { return values_[3]; }
  float* depth() { return values_[4]; }  // metres; +inf where nothing is.
  // Opaque splats: of the nearest; coverage splats: of the last that found room.
  const float* depth() const { return values_[4]; }
  // Coverage by fronts that has not yet been set against dark backs behind them; see the .cc.
  // Coverage splats only.
  float* front_credit() { return values_[5]; }
  void MarkTouched() { ++touched_; }
  uint64_t touched() const { return touched_; }

 private:
  const MicrobufferMap* map_;
  AlignedVector<float> storage_;
  float* values_[6];
  uint64_t touched_ = 0;
};

struct RasterCounters {
  uint64_t splats = 0;         // nodes drawn
  uint64_t exact_discs = 0;    // of them, drawn pixel by pixel as discs
  uint64_t hidden_pixels = 0;  // pixel contributions that found the pixel full
};

// Draws `cut` (sorted front to back) as seen from `view` into `buffer`. For the cosine map the
// hemisphere is the one about view.normal. Nodes below the horizon of the cosine map are left out.
void RasterizeCut(const PointTree& tree, const CutView& view, std::span<const CutNode> cut,
                  Splat splat, Microbuffer& buffer, RasterCounters& counters);

// Irradiance [W/m²] at a receiver of normal `n` (world; ignored for the cosine map, whose frame is
// the receiver's) from `far` seen through `near` (may be null):
//   E = pi Σ w L / Σ w,   w = max(0, n·V_pixel),   L = L_near + min(1, (1 - C_near) / C_far) L_far
// with coverage C = C_near + C_far, L divided by C where C > 0.75 (a pixel covered for the most
// part is full: splats leave gaps), and the far part cut to the room that is left, to nothing where
// C_near > 0.75: what is near hides there what lies behind, as it does within one buffer. Opaque
// splats are composed by depth instead: the nearer of the two wins. A sum over all pixels in a
// fixed order. The quotient makes a buffer of constant radiance exact for every normal. A buffer of
// one pixel gives pi times its radiance.
Rgb ConvolveCosine(const Microbuffer& far, const Microbuffer* near, const Vec3f& n, Splat splat);

// The same for any lobe: integral Σ w L / Σ w by channel, with the pixels' weights `weight`, arrays
// of map.padded() finite elements >= 0, the lobe times the cosine over each pixel; 0 where they sum
// to 0. `integral`: of the whole lobe.
Rgb ConvolveLobe(const Microbuffer& far, const Microbuffer* near,
                 const std::array<const float*, 3>& weight, const Rgb& integral, Splat splat);

// The literal, slow versions: oracles of the tests.
Rgb ConvolveCosineLiteral(const Microbuffer& far, const Microbuffer* near, const Vec3f& n,
                          Splat splat);

}  // namespace farpoint

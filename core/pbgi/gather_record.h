// Gather records: what a cluster of receivers shares when clusters form a hierarchy over the image
// (the paper's §5 names a hierarchy of receivers as future work). A record is the irradiance at the
// cluster's active receiver with what is needed to carry it to its neighbours: the translational
// gradient, the irradiance for other normals, and how far it reaches.
//
//   E(x, n) = E + clamp(∇E · (x - c)) + clamp(V · (n - n_c))
//
// ∇E: the derivative of the stratified sum when each border between two strata moves with the
// nearer of the two surfaces (Ward and Heckbert 1992, "Irradiance Gradients", for strata of equal
// cosine-weighted solid angle), so that occlusion by what is near counts:
//   ∇E = Σ_borders (L_outer - L_inner) cosθ · length · t / min(d_inner, d_outer),
// t the unit tangent across the border, projected to the receiver's tangent plane.
// V = ∫ L ω dω over the hemisphere, the irradiance vector: E(n) = V · n as long as the horizon
// hides nothing else; what a turn by δ hides and reveals is of order δ².
#pragma once

#include <array>
#include <cstdint>
#include <vector>

#include "core/base/aligned.h"
#include "core/math/vec.h"

namespace farpoint {

// Strata of the hemisphere about +z: rings of equal sin²θ, each cut into sectors of equal angle,
// so that every stratum has the cosine-weighted solid angle pi / (rings sectors). Immutable.
class HemisphereGrid {
 public:
  // About `samples` >= 1 strata; sectors ≈ pi rings, so that strata are nearly square.
  explicit HemisphereGrid(uint32_t samples);

  uint32_t rings() const { return rings_; }
  uint32_t sectors() const { return sectors_; }
  uint32_t size() const { return rings_ * sectors_; }
  // Arrays over strata are ring by ring from the zenith, `stride()` >= sectors() a multiple of 8.
  uint32_t stride() const { return stride_; }
  uint32_t padded() const { return rings_ * stride_; }

  // One direction in each stratum, jittered by `key`, as three arrays of padded() elements;
  // what lies beyond sectors() is zero. pdf_sr over all strata: cos θ / pi.
  void Directions(uint64_t key, float* x, float* y, float* z) const;
  // More of one stratum: directions `first` to `first + count - 1` of the sequence whose 0th is the
  // one of Directions(key), an additive recurrence in two dimensions (Roberts 2018, R2), so that
  // any number of them covers the stratum evenly and each alone is uniform. Writes up to the next
  // multiple of eight.
  void DirectionsIn(uint32_t ring, uint32_t sector, uint64_t key, uint32_t first, uint32_t count,
                    float* x, float* y, float* z) const;
  // The middles of the strata instead.
  void Centres(float* x, float* y, float* z) const;

 private:
  friend struct RecordMaker;
  uint32_t rings_, sectors_, stride_;
  // Cosine and sine of the sectors' middles and first borders.
  AlignedVector<float> cos_middle_, sin_middle_, cos_border_, sin_border_;
};

// What was seen in each stratum. Arrays of grid.padded() elements.
class HemisphereSamples {
 public:
  // `tells_near`: whether unhidden() is to be there.
  explicit HemisphereSamples(const HemisphereGrid& grid, bool tells_near = false);

  float* direction(int axis) { return values_[axis]; }  // unit, local frame (z: the normal)
  const float* direction(int axis) const { return values_[axis]; }
  // W/(m² sr); channel 3: the part through which nothing is hit, [0, 1], or 0 if nobody asked.
  float* radiance(int channel) { return values_[3 + channel]; }
  const float* radiance(int channel) const { return values_[3 + channel]; }
  // 1/m, the mean where a stratum has several; 0: nothing there; negative: not seen, since it lies
  // below the surface (radiance 0).
  float* inverse_distance() { return values_[7]; }
  const float* inverse_distance() const { return values_[7]; }
  // The part through which nothing is hit within some distance, [0, 1]; null if nobody asked.
  float* unhidden() { return values_[8]; }
  const float* unhidden() const { return values_[8]; }

 private:
  AlignedVector<float> storage_;
  float* values_[9];
};

struct GatherRecord {
  Vec3f position;                 // of the active receiver, relative to the scene's origin
  Vec3f normal;                   // unit, shading
  Rgb irradiance;                 // W/m²
  std::array<Vec3f, 3> gradient;  // of each channel, W/m³, in the tangent plane, world
  std::array<Vec3f, 3> vector;    // V of each channel, W/m², world
  // ∫ V cosθ dω, V: nothing is hit, in [0, π]: what a sky of radiance 1 gives; with its gradient
  // and vector. Carried like the irradiance, and what a turn reveals is taken to be as open as the
  // rest: + openness (1 - n · n_c).
  float openness = 0;
  Vec3f open_gradient, open_vector;
  // The same with V: nothing is hit within some distance. 0 if nobody asked. What else a record
  // says does not depend on it.
  float unhidden = 0;
  Vec3f unhidden_gradient, unhidden_vector;
  float harmonic_distance_m = 0;  // harmonic mean of the distances; +inf: nothing seen
  float reach_m = 0;              // world radius of influence; set by the caller
};

// E(x, n), the carried irradiance: each of the two corrections is clamped to [-E/2, E] and the sum
// to at least 0, by channel.
Rgb IrradianceAt(const GatherRecord& record, const Vec3f& x, const Vec3f& n);
// The same of `unhidden`, with what a turn reveals, in [0, π].
float UnhiddenAt(const GatherRecord& record, const Vec3f& x, const Vec3f& n);

// From samples of the strata of `grid` about `frame.n`. Sets all but reach_m. Sums run in eight
// lanes in a fixed order. No NaN can arise from finite samples: nothing is divided by but cosines
// of at least kLeastCosine and the harmonic sum where it is positive.
GatherRecord MakeGatherRecord(const HemisphereGrid& grid, const HemisphereSamples& samples,
                              const Vec3f& position, const Frame& frame);
// The literal version, in double, straight from the equations: the oracle of the tests.
GatherRecord MakeGatherRecordLiteral(const HemisphereGrid& grid, const HemisphereSamples& samples,
                                     const Vec3f& position, const Frame& frame);

}  // namespace farpoint

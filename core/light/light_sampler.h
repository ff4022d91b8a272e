// Direct light: what arrives at a point straight from emitters and from the sky. One estimator
// for surfels, receivers and path hits, so that the integrators differ in the gather only.
//
//   E(p, n) = Σ_punctual V I f cosθ / d²  +  ∫_emitters V L_e cosθ cosθ_l / d² dA
//             + ∫_sky V L_sky cosθ dω
#pragma once

#include <cstdint>
#include <memory>
#include <optional>
#include <vector>

#include "core/accel/ray_accel.h"
#include "core/math/vec.h"

namespace farpoint {

// Which shadow rays an estimate took and saved.
struct LightCounters {
  uint64_t rays = 0;
  uint64_t samples = 0;              // points drawn on emitters
  uint64_t skipped_facing_away = 0;  // light behind the surface or out of its range or cone
};

// Immutable; thread-safe.
class LightSampler {
 public:
  explicit LightSampler(std::shared_ptr<const RayAccel> accel);

  // False if nothing in the scene sends light: no irradiance anywhere, no gather needed.
  bool any_light() const { return any_light_; }
  bool has_emitters() const { return !emitters_.empty(); }
  bool has_sky() const { return has_sky_; }

  // An unbiased estimate of the irradiance [W/m²] at surface point `p` (relative to the scene's
  // origin) on the side of unit geometric normal `ng`, against shading normal `n`
  // (Dot(n, ng) >= 0): `samples` >= 1 shadow rays to the emitters, chosen by power, then by solid
  // angle, and stratified (Owen-scrambled Sobol' in two dimensions), `samples` to the sky by the
  // cosine, one to each punctual light. Holes of alpha masks emit nothing. What lies within two
  // surface offsets of an emitter's plane does not shadow it. `first_index` is the index of the
  // first sample within its sequence and `key` names the sequence: the same key with disjoint
  // aligned index ranges gives one stratified set. `dimension` (0 or 2) is the first of the two
  // Sobol' dimensions used: a caller whose own choices for the same index take dimensions 0 and 1
  // passes 2, or the two would be correlated.
  Rgb Irradiance(const Vec3f& p, const Vec3f& ng, const Vec3f& n, uint32_t samples, uint64_t key,
                 uint32_t first_index, unsigned dimension, LightCounters& counters) const;

 private:
  struct Emitter {
    Vec3f v0, e1, e2;  // a vertex and the two edges from it
    Vec3f normal;      // unit
    uint32_t triangle;
    float area_m2;
    float probability;  // of being chosen
    float cdf_below;    // sum of the probabilities before it
    bool varies;        // its radiance is textured or it has holes
  };

  // A direction to a point of an emitter, as drawn.
  struct EmitterPoint {
    Vec3f direction;  // unit, world
    float distance_m;
    float height_m;        // of p over the emitter's plane, > 0
    float b1, b2;          // where on the triangle
    float inverse_pdf_sr;  // 1 / density per solid angle, given the emitter
  };
  // (u, v) in [0, 1)² -> a direction from p; none where the emitter is seen edge-on.
  std::optional<EmitterPoint> SamplePoint(const Emitter& e, const Vec3f& p, float u, float v) const;

  std::shared_ptr<const RayAccel> accel_;
  std::vector<Emitter> emitters_;
  bool has_sky_ = false;
  bool any_light_ = false;
};

}  // namespace farpoint

// Direct light: what arrives at a point straight from emitters and from the environment. One
// estimator for surfels, receivers and path hits, so that the integrators differ in the gather
// only (docs/lights.md).
//
//   E(p, n) = Σ_punctual V I f cosθ / d²  +  ∫_emitters V L_e cosθ cosθ_l / d² dA
//             + ∫_environment V L cosθ dω
#pragma once

#include <algorithm>
#include <array>
#include <cstdint>
#include <memory>
#include <optional>
#include <span>
#include <utility>
#include <vector>

#include "core/accel/ray_accel.h"
#include "core/light/environment_sampler.h"
#include "core/light/light_tree.h"
#include "core/math/vec.h"
#include "core/math/vec8.h"

namespace farpoint {

// Which shadow rays an estimate took and saved.
struct LightCounters {
  uint64_t rays = 0;
  uint64_t blocked = 0;              // of the rays
  uint64_t samples = 0;              // lights, points on emitters, directions of the map drawn
  uint64_t skipped_facing_away = 0;  // nothing arrives unshadowed: behind the surface, out of range
                                     // or cone, seen edge-on, or a hole
  uint64_t skipped_environments = 0;  // estimates of a scene without an environment
  uint64_t skipped_black = 0;         // paths that ended on what reflects nothing
  uint64_t needless = 0;              // rays that could not matter, traced all the same
};

// Eight surface points side by side, such as the hits of eight paths. Lanes that are not active
// hold anything.
struct SurfacePoints8 {
  V8 p, ng, n;  // as in SurfacePoint
  F8 offset_m;
  U8 index;         // of the sample within its sequence
  unsigned active;  // bit k: lane k

  SurfacePoint Lane(size_t k) const { return {p.Lane(k), ng.Lane(k), n.Lane(k), offset_m[k]}; }
};

// What an estimate computes although it cannot matter; values of a mask.
enum NeedlessLight : unsigned {
  kNeedlessRays = 1u << 0,         // shadow rays of lights that cannot reach
  kNeedlessEnvironment = 1u << 1,  // rays to an environment that is not there
};

// What light from a direction counts for, in place of the 1 of irradiance: a BRDF, times the weight
// that this way of sampling has among others (Veach and Guibas 1995).
class Reflector {
 public:
  virtual ~Reflector() = default;
  // `w`: unit, world, above the horizons of both normals. `density_sr`: by which a sample of the
  // estimate takes about this direction, infinite for lights without extent; it is the one that
  // LightSampler::EmissionSeen and EnvironmentSeen tell.
  virtual Rgb Toward(const Vec3f& w, float density_sr) const = 0;
};

// How many times as many shadow rays an estimate takes where some are blocked and others are not.
struct Refinement {
  uint32_t emitters = 1, environment = 1;  // 1: none
};

// Immutable; thread-safe.
class LightSampler {
 public:
  explicit LightSampler(std::shared_ptr<const RayAccel> accel);

  // Up to so many punctual lights all have a ray, however few samples are asked for.
  static constexpr uint32_t kFewLights = 8;

  // False if nothing in the scene sends light: no irradiance anywhere, no gather needed.
  bool any_light() const { return any_light_; }
  bool has_emitters() const { return !emitters_.empty(); }
  bool has_sky() const { return has_sky_; }  // a constant one or a map

  // An unbiased estimate of the irradiance [W/m²] at a point, on the side of its geometric normal,
  // against its shading normal.
  // - Emitters: `samples` >= 1 shadow rays to points drawn by a light tree, then by solid angle and
  //   nearly by the cosine.
  // - Point and spot lights: one ray each if there are up to max(samples, kFewLights) of them, else
  //   `samples` rays to lights drawn by another tree. Directional lights: the same with their own
  //   number, drawn by their unshadowed irradiance, at a cost (without rays) of their number.
  // - Environment: `samples` rays, by the cosine if it is a constant sky, else by
  //   EnvironmentSampler.
  // Each of these is stratified (Owen-scrambled Sobol' in two dimensions). Holes of alpha masks
  // emit nothing. What lies within two offsets (SurfaceOffset) of an emitter's plane does not
  // shadow it. `first_index` is the index of the first sample within its sequence and `key` names
  // the sequence: the same key with disjoint aligned index ranges gives one stratified set.
  // `dimension` (0 or 2) is the first of the two Sobol' dimensions used: a caller whose own choices
  // for the same index take dimensions 0 and 1 passes 2, or the two would be correlated.
  // `refine`: for emitters and for the environment, the samples are two independent halves, and
  // each takes so many times as many where some rays of the *other* half are blocked and others
  // are not. What decides is independent of what it decides about, so this too is unbiased. Not
  // below kFewestRefined samples. Index ranges of one key are then sets of their own.
  // `environment`: false: without what comes from there.
  // `needless`: NeedlessLight; the estimate is the same, bit by bit.
  Rgb Irradiance(const SurfacePoint& at, uint32_t samples, uint64_t key, uint32_t first_index,
                 unsigned dimension, LightCounters& counters, Refinement refine = {},
                 bool environment = true, unsigned needless = 0) const;

  // The same estimate of ∫ L reflector cosθ dω: the reflected radiance where the reflector is a
  // BRDF [W/(m² sr)].
  Rgb Reflected(const SurfacePoint& at, const Reflector& reflector, uint32_t samples, uint64_t key,
                uint32_t first_index, unsigned dimension, LightCounters& counters,
                Refinement refine = {}, bool environment = true, unsigned needless = 0) const;

  // What a ray finds that somebody else drew, for estimates that combine their rays with these.
  struct Seen {
    Rgb radiance;          // W/(m² sr)
    float density_sr = 0;  // what a Reflector at the ray's start would be told; 0: no such sample
  };
  // The emission of what the ray along `w` from `from.Leave()` hits.
  Seen EmissionSeen(const SurfacePoint& from, const RayHit& hit) const;
  // The environment along the unit direction `w`, where nothing is hit.
  Seen EnvironmentSeen(const SurfacePoint& from, const Vec3f& w) const;

  static constexpr uint32_t kFewestRefined = 4;
  // Of what is seen itself; of surfels, which a gather averages, and whose rays to a sky are cheap
  // only as long as there are few.
  static constexpr Refinement kOfReceivers = {16, 16}, kOfSurfels = {4, 1};

  // Irradiance(at, 1, key, index, dimension, counters) of each active lane, to the same bits,
  // in less than half the time without rays; 0 in the others. `irradiance` is as long as `points`.
  void IrradianceEach(std::span<const SurfacePoints8> points, uint64_t key, unsigned dimension,
                      std::span<V8> irradiance, LightCounters& counters,
                      unsigned needless = 0) const;

 private:
  // What an estimate is made for.
  struct Query {
    Vec3f p, ng, n;
    Vec3f origin;    // of its shadow rays
    float offset_m;  // of the origin from p
    uint32_t samples;
    uint64_t key;
    uint32_t first_index;
    unsigned dimension;
    unsigned needless = 0;
    const Reflector* reflector = nullptr;
  };
  Rgb Estimate(const Query& q, const Refinement& refine, bool environment,
               LightCounters& counters) const;
  // A ray that cannot matter: counted, or traced for nothing.
  void Skip(const Query& q, const Vec3f& direction, float reach_m, LightCounters& counters) const;
  // Of one of the From… below: its estimate, and in a penumbra a finer one.
  Rgb Refined(Rgb (LightSampler::*from)(const Query&, LightCounters&) const, const Query& q,
              uint32_t times, LightCounters& counters) const;
  struct Emitter {
    Vec3f v0, e1, e2;  // a vertex and the two edges from it
    Vec3f normal;      // unit
    uint32_t triangle;
    float area_m2;
    bool varies;   // its radiance is textured or it has holes
    Rgb radiance;  // unless it varies

    Rgb RadianceAt(const PreparedScene& scene, const Vec3f& q) const;
  };
  // Eight emitters side by side: their corners, and what their weight is made of. Empty places
  // have power 0.
  struct alignas(32) EmitterBlock {
    LightTree::Weights a[3], b[3], c[3], normal[3];
    LightTree::Weights twice_area, luminance;
  };
  // The same in registers: of the same emitter or of others in each lane.
  struct EmitterLanes {
    V8 a, b, c, normal;
    F8 twice_area, luminance;
  };
  // Eight point or spot lights.
  struct alignas(32) PunctualBlock {
    LightTree::Weights position[3], direction[3], luminance, range, cos_inner, cos_outer;
  };

  static constexpr float kBelowOne = 0.99999994f;
  // Samples of emitters in lanes: for one point or for eight.
  struct EmitterSamples {
    V8 origin, n, ng;
    F8 u{}, v;                    // where on the emitter, in [0, 1)
    U8 place{};                   // in emitters_
    F8 probability = Set8(1.0f);  // of the emitter
    unsigned active = 0;

    void Set(const LightTree::Choices8& choices, unsigned lanes) {
      u = Min8(choices.u, Set8(kBelowOne));
      place = choices.place;
      probability = choices.probability;
      active = lanes & Bits8(choices.any);
    }
    void Set(uint32_t lane, double u_left, const std::optional<LightTree::Choice>& choice) {
      if (!choice) return;
      u[lane] = std::min(static_cast<float>(u_left), kBelowOne);
      place[lane] = choice->place;
      probability[lane] = static_cast<float>(choice->probability);
      active |= 1u << lane;
    }
  };
  // Directions to points of emitters, as drawn; where the emitter is seen edge-on, none.
  struct EmitterDirections {
    V8 direction;  // unit, world
    F8 distance_m;
    F8 height_m;        // of the origin over the emitter's plane, > 0
    F8 offset_m;        // SurfaceOffset of the emitter, seen from the origin
    F8 inverse_pdf_sr;  // 1 / density per solid angle, given the emitter
    F8 solid_angle;     // of the emitter; of small ones to a part in a thousand
    M8 any;
  };
  EmitterLanes LoadEmitters(const U8& place) const;
  // By solid angle and nearly by the cosine to n.
  EmitterDirections Directions(const EmitterSamples& samples) const;
  // What arrives if nothing is in the way, 0 in lanes that are not active, and what may be.
  struct ShadowRays8 {
    std::array<Vec3f, LightTree::kWidth> origin, direction;
    F8 reach_m;
    V8 arriving;
    unsigned active;
  };
  ShadowRays8 RaysTo(const EmitterSamples& samples, const Reflector* reflector = nullptr) const;
  // Traces the rays: nothing arrives where they are blocked. `from_one_point`: all have one origin.
  void Trace(ShadowRays8& rays, bool from_one_point, LightCounters& counters) const;
  // One sample for each point.
  EmitterSamples SampleEach(const SurfacePoints8& points, uint64_t key, unsigned dimension) const;

  void AddEmitters();
  void AddPunctualLights();
  static F8 WeightOf(const EmitterLanes& e, const V8& p, const V8& n);
  static void Weigh(const EmitterBlock& block, const Vec3f& p, const Vec3f& n,
                    LightTree::Weights& weights);
  static void Weigh(const PunctualBlock& block, const Vec3f& p, const Vec3f& n,
                    LightTree::Weights& weights);
  // Point, spot and directional lights.
  Rgb FromAllPunctual(const Query& q, LightCounters& counters) const;
  // What one light adds; counts its ray.
  Rgb FromPunctual(const PreparedLight& light, const Query& q, LightCounters& counters) const;
  Rgb FromPunctualLights(const Query& q, LightCounters& counters) const;
  Rgb FromManyDirectional(const Query& q, LightCounters& counters) const;
  Rgb FromEmitters(const Query& q, LightCounters& counters) const;
  Rgb FromSky(const Query& q, LightCounters& counters) const;
  Rgb FromMap(const Query& q, LightCounters& counters) const;
  float MapDensity(const Vec3f& n, const Vec3f& w) const;

  std::shared_ptr<const RayAccel> accel_;
  std::vector<Emitter> emitters_;  // by place in the tree's order; empty places have area 0
  std::vector<EmitterBlock> emitter_blocks_;
  LightTree emitter_tree_;
  uint32_t emitter_count_ = 0;
  std::vector<std::pair<uint32_t, uint32_t>> place_of_emitter_;  // by triangle, ascending
  // Those with power; the positioned ones by place in the tree's order, empty places black.
  std::vector<PreparedLight> directional_lights_, positioned_lights_;
  uint32_t positioned_count_ = 0;
  std::vector<PunctualBlock> punctual_blocks_;
  LightTree punctual_tree_;
  std::unique_ptr<const EnvironmentSampler> environment_;
  bool has_sky_ = false;
  float mean_sky_ = 0;  // luminance, over the sphere; of an environment map with the sky
  bool any_light_ = false;
};

}  // namespace farpoint

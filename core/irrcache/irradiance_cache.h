// The irradiance cache: the peer that factorized gathers are compared with. After Ward, Rubinstein
// and Clear 1988 ("A Ray Tracing Solution for Diffuse Interreflection", WRC88), Ward and Heckbert
// 1992 ("Irradiance Gradients", WH92), Křivánek et al. 2006 ("Making Radiance and Irradiance
// Caching Practical", KBPZ06) and Tabellion and Lamorlette 2004 ("An Approximate Global
// Illumination System for Computer Generated Films", TL04).
//
// A record holds the irradiance at a point of a surface with its translational gradient and the
// irradiance vector, which turns it to other normals (gather_record.h). It serves a receiver at x
// with normal n by the weight
//   w = max(0, 1 - max(|x - c| / r, sqrt((1 - n·n_c) / kCacheNormalTolerance)))²,
// zero where (x - c)·(n + n_c)/2 < -kBehind r: the receiver then lies behind the record (WRC88), as
// the smooth weight of TL04, squared so that its slope ends at zero too. E(x) = Σ w E_c(x, n) / Σ
// w.
//
// r = a R: a the accuracy, R the harmonic mean distance of what the record saw (WRC88), at most
// E / |∇E| (KBPZ06), at most R_j + |c - c_j| of its neighbours j (neighbour clamping, KBPZ06), and
// r between `least_px` and `most_px` sides of a pixel projected onto the surface (TL04). Where the
// least is in force the gradient is reduced in proportion. Receivers see r times `spread`.
//
// Records are placed by an overture over the pixels' centres from coarse to fine: pixels of a grid
// of 64 pixels, then those that halve it down to 16, then the other pixels by their place in a cell
// of 16x16 in Bayer's order. Each of these 262 phases tests its pixels against the records of
// earlier phases and gathers where they weigh less than `enough`; records are inserted in raster
// order. So the cache is a function of scene, frame and parameters: not of threads, tiles or time.
// But it covers a whole frame: what renders one tile needs all of it.
#pragma once

#include <cstdint>
#include <functional>
#include <memory>
#include <span>
#include <vector>

#include "core/base/executor.h"
#include "core/image/tile_rect.h"
#include "core/irrcache/cache_octree.h"
#include "core/math/vec.h"
#include "core/pbgi/gather_record.h"
#include "core/pbgi/receiver_hierarchy.h"

namespace farpoint {

inline constexpr float kCacheNormalTolerance = 0.1f;  // 1 - cos of the angle where w ends (26°)
inline constexpr float kBehind = 0.05f;

struct IrradianceCacheParams {
  float error = 0.2f;       // a > 0: smaller, more records
  uint32_t samples = 1024;  // strata of a record's hemisphere, >= 1
  float least_px = 2.4f;    // least and greatest r, in sides of a projected pixel
  float most_px = 64.0f;
  float enough = 0.2f;  // summed weight that spares a pixel a record
  // Times which r receivers see the records: more records smooth each other's noise, and the edges
  // of what was thinly covered.
  float spread = 1.5f;
  uint64_t seed = 0;
};

// The weight of a record at x, n; see above. Never NaN for records with reach_m > 0.
float CacheWeight(const GatherRecord& record, const Vec3f& x, const Vec3f& n);

struct CachedIrradiance {
  Rgb irradiance;      // W/m²; 0 where nothing weighs
  float unhidden = 0;  // Σ w UnhiddenAt(x, n) / Σ w; 0 if the records do not tell
  float weight = 0;    // Σ w
};
// Σ w E(x, n) / Σ w over all of `records`.
CachedIrradiance InterpolateAll(std::span<const GatherRecord> records, const Vec3f& x,
                                const Vec3f& n);

// Immutable after Build; thread-safe.
class IrradianceCache {
 public:
  struct Counts {
    uint64_t candidates = 0;  // pixels looked at
    uint64_t records = 0;     // gathers made
    uint64_t samples = 0;     // their strata
  };

  // `bounds` hold the scene; `eye` is the camera's place: both relative to the scene's origin, as
  // `source` counts. `go_on` (may be empty) is called now and then, by one thread at a time, with
  // the part of the phases that is done, [0, 1]; when it says false the result is null.
  static std::unique_ptr<const IrradianceCache> Build(const IrradianceCacheParams& params,
                                                      const PixelRect& frame, const Box3f& bounds,
                                                      const Vec3f& eye, const RecordSource& source,
                                                      Executor& executor,
                                                      const std::function<bool(double)>& go_on,
                                                      Counts& counts);

  CachedIrradiance Interpolate(const Vec3f& x, const Vec3f& n) const;

  // A record for a receiver that the cache serves badly: a sample beside the pixel's centre, on
  // another surface. `key` tells it from others.
  GatherRecord MakeOwnRecord(const Receiver& receiver, float footprint_m, uint64_t key) const;

  std::span<const GatherRecord> records() const { return records_; }  // reach_m is r
  const IrradianceCacheParams& params() const { return params_; }

 private:
  struct Radius {
    float full_m;   // R, clamped by gradient and neighbours
    float least_m;  // bounds of r
    float most_m;
  };

  IrradianceCache(const IrradianceCacheParams& params, const Box3f& bounds, const Vec3f& eye,
                  const RecordSource& source);
  Radius RadiusOf(const GatherRecord& record, float footprint_m) const;
  // r from R; reduces the gradient where the least r is in force.
  void SetReach(const Radius& radius, GatherRecord& record) const;
  void Insert(GatherRecord record, const Radius& radius);

  const IrradianceCacheParams params_;
  const Box3f bounds_;
  const Vec3f eye_;
  const RecordSource& source_;
  const HemisphereGrid grid_;
  std::vector<GatherRecord> records_;
  std::vector<Radius> radii_;                    // of each record
  std::vector<std::array<Vec3f, 3>> gradients_;  // of each, not reduced
  CacheOctree octree_;
};

}  // namespace farpoint

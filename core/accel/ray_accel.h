// Ray queries against the triangles of a prepared scene. The only user of Embree.
//
// Determinism: Embree runs with isa=avx2, and there is one kind of call for each purpose (one ray
// at a time, or eight of one caller), so the same query gives the same bits whatever the machine
// and the number of threads.
//
// Watertight but for IntersectBundle: no ray passes between two triangles that share an edge (equal
// end points). Of rays aimed exactly at a vertex of many triangles, fewer than one in a hundred
// slips through.
#pragma once

#include <cstdint>
#include <limits>
#include <memory>
#include <mutex>
#include <optional>
#include <span>
#include <vector>

#include "core/accel/surface_offset.h"
#include "core/base/status.h"
#include "core/scene/prepared_scene.h"

namespace farpoint {

struct RayHit {
  float t;            // distance in units of the direction's length
  uint32_t triangle;  // index into PreparedScene::triangles()
  float b1, b2;       // barycentric weights of vertices 1 and 2
  bool front;         // the ray meets the side that the triangle's winding shows
};
inline constexpr uint32_t kNoTriangle = ~uint32_t{0};

// A query as it was made.
struct TracedRay {
  Vec3f origin, direction;
  float t_max;
  bool any_hit;  // Occluded, not Intersect
};

// Immutable after Build; thread-safe. Coordinates are relative to the scene's origin. Alpha masks
// are holes. For performance the queries check nothing: inputs must be finite.
class RayAccel {
 public:
  // kUnavailable if Embree reports an error (out of memory, no AVX2), with Embree's words.
  // For measurements: with `record` every query is appended to it, and only one thread may query.
  static absl::StatusOr<std::shared_ptr<const RayAccel>> Build(
      std::shared_ptr<const PreparedScene> scene, std::vector<TracedRay>* record = nullptr);
  ~RayAccel();
  RayAccel(const RayAccel&) = delete;
  RayAccel& operator=(const RayAccel&) = delete;

  const PreparedScene& scene() const { return *scene_; }

  // The nearest hit with 0 <= t <= t_max.
  std::optional<RayHit> Intersect(const Vec3f& origin, const Vec3f& direction,
                                  float t_max = std::numeric_limits<float>::infinity()) const;
  // Whether anything lies at 0 <= t <= t_max.
  bool Occluded(const Vec3f& origin, const Vec3f& direction,
                float t_max = std::numeric_limits<float>::infinity()) const;
  // The same of the rays of a mask's bits, as bits. `from_one_point`: all origins are the same, and
  // directions lie near each other: then a ray takes 0.6 of Occluded's time (shadow rays to the
  // light of the Cornell box).
  unsigned Occluded8(std::span<const Vec3f, 8> origins, std::span<const Vec3f, 8> directions,
                     std::span<const float, 8> t_max, unsigned mask, bool from_one_point) const;

  // What a gather needs, many rays from one point: the nearest hit of each direction, `triangle`
  // kNoTriangle where there is none. Takes two thirds of Intersect's time (Sponza) and is not
  // watertight: of random rays within a closed mesh 0.1 to 2.5 in a million slipped between two of
  // its triangles. Who cannot bear that asks Intersect again about what looks odd.
  // PrepareBundles must have succeeded.
  void IntersectBundle(const Vec3f& origin, std::span<const Vec3f> directions,
                       std::span<RayHit> hits) const;
  // Builds what IntersectBundle needs, once; kUnavailable as Build.
  absl::Status PrepareBundles() const;

  // For measurements: the same queries by nothing but Embree's own calls, one ray after the other.
  // Returns how many hit.
  size_t TraceBare(std::span<const TracedRay> rays) const;

  // How far off a triangle rays start at its point `p`, of which `ng` is the unit geometric normal,
  // either way (surface_offset.h).
  float SurfaceOffsetM(uint32_t triangle, const Vec3f& p, const Vec3f& ng) const {
    const auto& v = scene_->triangles()[triangle].vertex;
    const std::span<const Vec3f> at = scene_->vertices();
    return SurfaceOffset(at[v[0]], at[v[1]], at[v[2]], ng, p);
  }
  // Where a ray leaves the triangle at `p` on the side of `ng`.
  Vec3f LeaveSurface(uint32_t triangle, const Vec3f& p, const Vec3f& ng) const {
    return p + ng * SurfaceOffsetM(triangle, p, ng);
  }

 private:
  explicit RayAccel(std::shared_ptr<const PreparedScene> scene);

  struct Impl;
  std::shared_ptr<const PreparedScene> scene_;
  std::vector<TracedRay>* record_ = nullptr;
  std::unique_ptr<Impl> impl_;
};

}  // namespace farpoint

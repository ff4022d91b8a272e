// Hits of rays side by side: what follows each other does the same work, and eight lanes are full.
#pragma once

#include <array>
#include <cstdint>

#include "core/light/light_sampler.h"
#include "core/math/vec8.h"
#include "core/scene/prepared_scene.h"

namespace farpoint {

inline constexpr uint32_t kRaysTogether = 64;  // a multiple of kHitLanes
inline constexpr uint32_t kHitLanes = 8;

struct RayHits {
  using Row = std::array<float, kRaysTogether>;
  struct Rows {
    alignas(32) Row x, y, z;
    void Set(size_t i, const Vec3f& v) {
      x[i] = v.x;
      y[i] = v.y;
      z[i] = v.z;
    }
    void Copy(size_t from, size_t to) {
      x[to] = x[from];
      y[to] = y[from];
      z[to] = z[from];
    }
    V8 Load(size_t i) const { return {Load8(&x[i]), Load8(&y[i]), Load8(&z[i])}; }
  };
  uint32_t count = 0;
  // To be set by who traces: the ray among those traced together, the index of its sample, what it
  // hit, and its direction.
  std::array<uint32_t, kRaysTogether> ray, index, triangle;
  alignas(32) Row b1, b2;
  Rows direction;
  // Set by KeepWhatReflects.
  Rows vertex[3], normal[3];
  alignas(32) Row flat;  // 1 where the mesh has no normals
};

// Fetches corners and normals of the hits. Those on what is black without a look at its texture are
// taken out unless `keep_black`; the lanes of the last eight that are left over repeat the last.
void KeepWhatReflects(const PreparedScene& scene, RayHits& hits, bool keep_black = false);

// Where hits `first` (a multiple of eight) to `first + 7` lie, with normals on the side that the
// rays came from, to the bits of PreparedScene's functions (of normal maps to their rounding).
// `active` is left to the caller.
SurfacePoints8 SurfaceAt(const RayHits& hits, size_t first);

// SurfaceAt of all hits, their lanes active; returns how many groups of kHitLanes that are.
size_t SurfacesOf(const RayHits& hits,
                  std::array<SurfacePoints8, kRaysTogether / kHitLanes>& points);

}  // namespace farpoint

#include "core/render/ray_hits.h"

#include <algorithm>
#include <array>
#include <cstring>

#include "core/accel/surface_offset.h"
#include "core/base/fp_trap.h"
#include "core/math/simd4d.h"

namespace farpoint {

namespace {

// As PreparedScene::GeometricNormal: in double, rounded at the end. Triangles of a prepared scene
// are not so small or large that a square of their area would leave the range of a double.
V8 GeometricNormals(const V8& a, const V8& b, const V8& c) {
  std::array<D4, 2> x, y, z;
  for (int h = 0; h < 2; ++h) {
    const D4 ax = Half4(a.x, h), ay = Half4(a.y, h), az = Half4(a.z, h);
    const D4 ux = Half4(b.x, h) - ax, uy = Half4(b.y, h) - ay, uz = Half4(b.z, h) - az;
    const D4 vx = Half4(c.x, h) - ax, vy = Half4(c.y, h) - ay, vz = Half4(c.z, h) - az;
    x[h] = uy * vz - uz * vy;
    y[h] = uz * vx - ux * vz;
    z[h] = ux * vy - uy * vx;
    const D4 scale = Set4(1.0) / Sqrt4(x[h] * x[h] + y[h] * y[h] + z[h] * z[h]);
    x[h] *= scale;
    y[h] *= scale;
    z[h] *= scale;
  }
  return {Join8(x[0], x[1]), Join8(y[0], y[1]), Join8(z[0], z[1])};
}

}  // namespace

void KeepWhatReflects(const PreparedScene& scene, RayHits& hits, bool keep_black) {
  uint32_t kept = 0;
  for (uint32_t i = 0; i < hits.count; ++i) {
    const uint32_t t = hits.triangle[i];
    const PreparedTriangle& triangle = scene.triangles()[t];
    const PreparedObject& object = scene.objects()[triangle.object];
    const PreparedMaterial& material = scene.materials()[object.material];
    if (!keep_black && material.glossy == 0 && !(MaxComponent(material.base_color) > 0.0f)) {
      continue;
    }
    // What a normal map turns has one normal for all that is made of its corners.
    const bool bumped = material.normal_texture >= 0;
    const bool flat = object.has_normals == 0 && !bumped;
    const uint32_t k = kept++;
    hits.ray[k] = hits.ray[i];
    hits.index[k] = hits.index[i];
    hits.triangle[k] = t;
    hits.b1[k] = hits.b1[i];
    hits.b2[k] = hits.b2[i];
    hits.direction.Copy(i, k);
    hits.flat[k] = flat ? 1.0f : 0.0f;
    for (size_t c = 0; c < 3; ++c) {
      hits.vertex[c].Set(k, scene.vertices()[triangle.vertex[c]]);
      if (!bumped) hits.normal[c].Set(k, flat ? Vec3f() : scene.normals()[triangle.vertex[c]]);
    }
    if (bumped) {
      const Vec3f n = scene.ShadingNormal(t, hits.b1[i], hits.b2[i]);
      for (RayHits::Rows& normal : hits.normal) normal.Set(k, n);
    }
  }
  hits.count = kept;
  // The lanes of the last eight that are left over.
  for (uint32_t k = kept; k % kHitLanes != 0; ++k) {
    hits.ray[k] = hits.ray[kept - 1];
    hits.index[k] = hits.index[kept - 1];
    hits.b1[k] = hits.b1[kept - 1];
    hits.b2[k] = hits.b2[kept - 1];
    hits.flat[k] = hits.flat[kept - 1];
    hits.direction.Copy(kept - 1, k);
    for (size_t c = 0; c < 3; ++c) {
      hits.vertex[c].Copy(kept - 1, k);
      hits.normal[c].Copy(kept - 1, k);
    }
  }
}

SurfacePoints8 SurfaceAt(const RayHits& hits, size_t first) {
  const FpTrapPause pause;  // lanes that are left out
  const F8 zero = Set8(0.0f), one = Set8(1.0f);
  const F8 b1 = Load8(&hits.b1[first]), b2 = Load8(&hits.b2[first]);
  const V8 a = hits.vertex[0].Load(first), b = hits.vertex[1].Load(first),
           c = hits.vertex[2].Load(first);
  SurfacePoints8 points;
  points.p = a + (b - a) * b1 + (c - a) * b2;
  points.ng = GeometricNormals(a, b, c);
  points.n = points.ng;
  const M8 flat = Load8(&hits.flat[first]) > zero;
  if (Bits8(flat) != 0xffu) {
    const V8 n = NormalizeOr(hits.normal[0].Load(first) * (one - b1 - b2) +
                                 hits.normal[1].Load(first) * b1 + hits.normal[2].Load(first) * b2,
                             points.ng);
    points.n = Select8(flat, points.ng, Select8(Dot(n, points.ng) < zero, -n, n));
  }
  const M8 behind = Dot(points.ng, hits.direction.Load(first)) > zero;
  points.ng = Select8(behind, -points.ng, points.ng);
  points.n = Select8(behind, -points.n, points.n);
  points.offset_m = SurfaceOffset(a, b, c, points.ng, points.p);
  std::memcpy(&points.index, &hits.index[first], sizeof(points.index));
  return points;
}

size_t SurfacesOf(const RayHits& hits,
                  std::array<SurfacePoints8, kRaysTogether / kHitLanes>& points) {
  const size_t groups = (hits.count + kHitLanes - 1) / kHitLanes;
  for (uint32_t g = 0; g < groups; ++g) {
    points[g] = SurfaceAt(hits, g * kHitLanes);
    points[g].active = (1u << std::min(kHitLanes, hits.count - g * kHitLanes)) - 1u;
  }
  return groups;
}

}  // namespace farpoint

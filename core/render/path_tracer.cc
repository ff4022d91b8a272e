#include "core/render/path_tracer.h"

#include <algorithm>
#include <array>
#include <bit>
#include <cmath>
#include <cstring>
#include <optional>
#include <span>

#include "core/base/fp_trap.h"
#include "core/math/sampling.h"
#include "core/math/simd4d.h"
#include "core/math/vec8.h"

namespace farpoint {

namespace {

constexpr uint32_t kBatches = 8;
// Directions, rays and light by turns of so many paths: what follows each other does the same work,
// and eight lanes are full.
constexpr uint32_t kTurn = 64;
constexpr uint32_t kWidth = 8;

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

// Paths of a turn that have hit what may reflect, side by side.
struct Hits {
  using Row = std::array<float, kTurn>;
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
  Rows direction, vertex[3], normal[3];
  alignas(32) Row b1, b2, flat;  // flat: 1 where the mesh has no normals
  std::array<uint32_t, kTurn> path, triangle;
  uint32_t count = 0;
};

// Corners and normals of the hits; those on what is black without a look at its texture are taken
// out.
void KeepWhatReflects(const PreparedScene& scene, Hits& hits) {
  uint32_t kept = 0;
  for (uint32_t i = 0; i < hits.count; ++i) {
    const uint32_t t = hits.triangle[i];
    const PreparedTriangle& triangle = scene.triangles()[t];
    const PreparedObject& object = scene.objects()[triangle.object];
    if (!(MaxComponent(scene.materials()[object.material].base_color) > 0.0f)) continue;
    const bool flat = object.has_normals == 0;
    const uint32_t k = kept++;
    hits.path[k] = hits.path[i];
    hits.triangle[k] = t;
    hits.b1[k] = hits.b1[i];
    hits.b2[k] = hits.b2[i];
    hits.direction.Copy(i, k);
    hits.flat[k] = flat ? 1.0f : 0.0f;
    for (size_t c = 0; c < 3; ++c) {
      hits.vertex[c].Set(k, scene.vertices()[triangle.vertex[c]]);
      hits.normal[c].Set(k, flat ? Vec3f() : scene.normals()[triangle.vertex[c]]);
    }
  }
  hits.count = kept;
  // The lanes of the last eight that are left over.
  for (uint32_t k = kept; k % kWidth != 0; ++k) {
    hits.path[k] = hits.path[kept - 1];
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

// Where eight paths have hit, with normals on the side that they came from, as PreparedScene gives
// them.
SurfacePoints8 SurfaceAt(const Hits& hits, size_t i) {
  const FpTrapPause pause;  // lanes that are left out
  const F8 zero = Set8(0.0f), one = Set8(1.0f);
  const F8 b1 = Load8(&hits.b1[i]), b2 = Load8(&hits.b2[i]);
  const V8 a = hits.vertex[0].Load(i), b = hits.vertex[1].Load(i), c = hits.vertex[2].Load(i);
  SurfacePoints8 points;
  points.p = a + (b - a) * b1 + (c - a) * b2;
  points.ng = GeometricNormals(a, b, c);
  points.n = points.ng;
  const M8 flat = Load8(&hits.flat[i]) > zero;
  if (Bits8(flat) != 0xffu) {
    const V8 n = NormalizeOr(hits.normal[0].Load(i) * (one - b1 - b2) +
                                 hits.normal[1].Load(i) * b1 + hits.normal[2].Load(i) * b2,
                             points.ng);
    points.n = Select8(flat, points.ng, Select8(Dot(n, points.ng) < zero, -n, n));
  }
  const M8 behind = Dot(points.ng, hits.direction.Load(i)) > zero;
  points.ng = Select8(behind, -points.ng, points.ng);
  points.n = Select8(behind, -points.n, points.n);
  std::memcpy(&points.index, &hits.path[i], sizeof(points.index));
  return points;
}

// The paths of batch b are FirstOf(b) up to FirstOf(b + 1).
uint32_t FirstOf(uint32_t batch, uint32_t paths) {
  return static_cast<uint32_t>((uint64_t{batch} * paths + kBatches - 1) / kBatches);
}

}  // namespace

TracedIrradiance TraceIndirect(const RayAccel& accel, const LightSampler& lights,
                               const Receiver& receiver, uint32_t paths, uint64_t key,
                               LightCounters& counters, uint64_t& rays) {
  const PreparedScene& scene = accel.scene();
  const Frame8 frame{V8(receiver.normal)};
  const V8 ng(receiver.geometric_normal);
  const Vec3f origin = accel.LeaveSurface(receiver.position, receiver.geometric_normal);
  const auto seed = static_cast<uint32_t>(HashKey(key, 11));
  const OwenSobolAxis axis_u(0, seed), axis_v(1, seed);
  const uint64_t light_key = HashKey(key, 12);
  Vec3d batch[kBatches];
  uint32_t b = 0, next_batch = FirstOf(1, paths);
  Hits hits;
  const U8 lanes = {0, 1, 2, 3, 4, 5, 6, 7};
  for (uint32_t first = 0; first < paths; first += kTurn) {
    const uint32_t count = std::min(kTurn, paths - first);
    std::array<Vec3f, kTurn> directions;
    uint64_t leaving = 0;  // bit k: path k
    for (uint32_t k = 0; k < count; k += kWidth) {
      const U8 index = lanes + (first + k);
      const V8 w = frame.ToWorld(CosineHemisphere8(axis_u.PointsOf(index), axis_v.PointsOf(index)));
      // Directions that the shading normal allows and the surface does not carry nothing.
      leaving |= uint64_t{Bits8(Dot(w, ng) > Set8(0.0f))} << k;
      for (uint32_t l = 0; l < kWidth; ++l) directions[k + l] = w.Lane(l);
    }
    if (count < kTurn) leaving &= (uint64_t{1} << count) - 1;
    rays += static_cast<uint64_t>(std::popcount(leaving));
    hits.count = 0;
    for (; leaving != 0; leaving &= leaving - 1) {
      const auto k = static_cast<uint32_t>(std::countr_zero(leaving));
      const std::optional<RayHit> hit = accel.Intersect(origin, directions[k]);
      if (!hit) continue;
      const uint32_t i = hits.count++;
      hits.path[i] = first + k;
      hits.triangle[i] = hit->triangle;
      hits.b1[i] = hit->b1;
      hits.b2[i] = hit->b2;
    }
    for (uint32_t i = 0; i < hits.count; ++i)
      hits.direction.Set(i, directions[hits.path[i] - first]);
    KeepWhatReflects(scene, hits);
    std::array<SurfacePoints8, kTurn / kWidth> points;
    std::array<V8, kTurn / kWidth> irradiance;
    const size_t groups = (hits.count + kWidth - 1) / kWidth;
    for (uint32_t g = 0; g < groups; ++g) {
      points[g] = SurfaceAt(hits, g * kWidth);
      points[g].active = (1u << std::min(kWidth, hits.count - g * kWidth)) - 1u;
    }
    lights.IrradianceEach(std::span(points).first(groups), light_key, 2,
                          std::span(irradiance).first(groups), counters);
    for (uint32_t i = 0; i < hits.count; ++i) {
      const Rgb arriving = irradiance[i / kWidth].Lane(i % kWidth);
      // Textures are looked up where light arrives only.
      if (!(MaxComponent(arriving) > 0.0f)) continue;
      while (hits.path[i] >= next_batch) next_batch = FirstOf(++b + 1, paths);
      batch[b] += Vec3d(scene.Surface(hits.triangle[i], hits.b1[i], hits.b2[i]).albedo * arriving);
    }
  }
  TracedIrradiance out;
  Vec3d sum;
  for (const Vec3d& b : batch) sum += b;
  // Of albedo E: its mean is pi times that of the radiance.
  const Vec3d mean = sum / static_cast<double>(paths);
  out.irradiance = Rgb(mean);
  if (paths >= kBatches) {
    Vec3d variance;
    for (uint32_t b = 0; b < kBatches; ++b) {
      const uint32_t size = FirstOf(b + 1, paths) - FirstOf(b, paths);
      const Vec3d d = batch[b] / static_cast<double>(size) - mean;
      variance += d * d;
    }
    variance = variance / (kBatches * (kBatches - 1.0));
    out.standard_error =
        Rgb(Vec3d(std::sqrt(variance.x), std::sqrt(variance.y), std::sqrt(variance.z)));
  }
  return out;
}

}  // namespace farpoint

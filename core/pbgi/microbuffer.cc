#include "core/pbgi/microbuffer.h"

#include <algorithm>
#include <cmath>
#include <limits>

#include "core/math/elementary.h"
#include "core/math/simd8.h"

namespace farpoint {

namespace {

// A surfel wider than this many pixels is drawn pixel by pixel.
constexpr float kExactDiscPixels = 1.5f;
// Support of a surfel's kernel over the radius of the disc of its area. At 2.5 the kernels of
// blue-noise neighbours add up to 1 within a few per cent all over a surface.
constexpr float kKernelSupport = 2.5f;
// Opaque discs are drawn this much larger, so that they leave no holes.
constexpr float kOpaqueDiscScale = 1.4f;

// One node as seen by a view.
struct Footprint {
  Vec3f to_node;      // world, from the view
  float distance_m;
  Vec3f normal;       // mean normal, unit or shorter
  float radius_m;
  float solid_angle;  // Ω = A_visible |n·w| / d²
  Rgb radiance;
  bool leaf;
};

class Rasterizer {
 public:
  Rasterizer(const CutView& view, Splat splat, Microbuffer& buffer, RasterCounters& counters)
      : map_(buffer.map()), buffer_(buffer), counters_(counters), frame_(view.normal),
        splat_(splat), local_(map_.kind() == BufferMap::kCosine), side_(map_.side()) {}

  void Draw(const Footprint& f) {
    if (!(f.solid_angle > 0.0f)) return;
    const Vec3f w_world = f.to_node / f.distance_m;
    const Vec3f w = local_ ? ToLocal(w_world) : w_world;
    // Compared with the pixel under the centre; a node on the cosine map's horizon uses the lowest.
    const Vec3f seen = local_ && w.z < 0.0f ? NormalizeOr(Vec3f(w.x, w.y, 0), Vec3f(1, 0, 0)) : w;
    const Vec2f at = map_.Project(seen);
    const int i = std::min(static_cast<int>(at.x), static_cast<int>(side_) - 1);
    const int j = std::min(static_cast<int>(at.y), static_cast<int>(side_) - 1);
    const float pixel_sr = map_.solid_angle()[j * static_cast<int>(side_) + i];
    const float size = std::sqrt(f.solid_angle / pixel_sr);
    const float disc_sr = kPif * f.radius_m * f.radius_m / (f.distance_m * f.distance_m);
    ++counters_.splats;
    if (f.leaf && disc_sr > kExactDiscPixels * kExactDiscPixels * pixel_sr) {
      ++counters_.exact_discs;
      DrawDisc(f);
      return;
    }
    if (local_ && w.z < 0.0f) return;
    if (splat_ == Splat::kOpaque) {
      DrawOpaqueBox(f, at, size);
    } else {
      DrawCoverageBox(f, at, size);
    }
  }

 private:
  Vec3f ToLocal(const Vec3f& w) const {
    return {Dot(w, frame_.t), Dot(w, frame_.b), Dot(w, frame_.n)};
  }

  void AddCoverage(int32_t pixel, float alpha, const Rgb& radiance) {
    float* coverage = buffer_.coverage();
    const float open = 1.0f - coverage[pixel];
    if (!(open > 0.0f)) {
      ++counters_.hidden_pixels;
      return;
    }
    const float a = std::min(alpha, open);
    coverage[pixel] += a;
    buffer_.radiance(0)[pixel] += a * radiance.x;
    buffer_.radiance(1)[pixel] += a * radiance.y;
    buffer_.radiance(2)[pixel] += a * radiance.z;
    buffer_.MarkTouched();
  }

  void SetOpaque(int32_t pixel, float distance_m, const Rgb& radiance) {
    float* depth = buffer_.depth();
    if (!(distance_m < depth[pixel])) {
      ++counters_.hidden_pixels;
      return;
    }
    depth[pixel] = distance_m;
    buffer_.coverage()[pixel] = 1.0f;
    buffer_.radiance(0)[pixel] = radiance.x;
    buffer_.radiance(1)[pixel] = radiance.y;
    buffer_.radiance(2)[pixel] = radiance.z;
    buffer_.MarkTouched();
  }

  // The node's solid angle as a square of the same area about its centre; each pixel gets the part
  // that overlaps it.
  void DrawCoverageBox(const Footprint& f, const Vec2f& at, float size) {
    const float half = 0.5f * size;
    const float inverse_area = 1.0f / (size * size);
    const int i0 = static_cast<int>(std::floor(at.x - half));
    const int i1 = static_cast<int>(std::floor(at.x + half));
    const int j0 = static_cast<int>(std::floor(at.y - half));
    const int j1 = static_cast<int>(std::floor(at.y + half));
    for (int j = std::max(j0, -1); j <= std::min(j1, static_cast<int>(side_)); ++j) {
      const float oy = std::min(at.y + half, static_cast<float>(j + 1)) -
                       std::max(at.y - half, static_cast<float>(j));
      if (!(oy > 0.0f)) continue;
      for (int i = std::max(i0, -1); i <= std::min(i1, static_cast<int>(side_)); ++i) {
        const float ox = std::min(at.x + half, static_cast<float>(i + 1)) -
                         std::max(at.x - half, static_cast<float>(i));
        if (!(ox > 0.0f)) continue;
        const int32_t pixel = map_.Wrap(i, j);
        if (pixel < 0) continue;
        const float part_sr = f.solid_angle * (ox * oy * inverse_area);
        AddCoverage(pixel, part_sr / map_.solid_angle()[pixel], f.radiance);
      }
    }
  }

  void DrawOpaqueBox(const Footprint& f, const Vec2f& at, float size) {
    const float half = 0.5f * size;
    bool drawn = false;
    const int i0 = std::max(-1, static_cast<int>(std::ceil(at.x - half - 0.5f)));
    const int j0 = std::max(-1, static_cast<int>(std::ceil(at.y - half - 0.5f)));
    for (int j = j0; static_cast<float>(j) + 0.5f <= at.y + half && j <= static_cast<int>(side_);
         ++j) {
      for (int i = i0; static_cast<float>(i) + 0.5f <= at.x + half && i <= static_cast<int>(side_);
           ++i) {
        const int32_t pixel = map_.Wrap(i, j);
        if (pixel < 0) continue;
        SetOpaque(pixel, f.distance_m, f.radiance);
        drawn = true;
      }
    }
    if (!drawn) {
      const int i = std::min(static_cast<int>(at.x), static_cast<int>(side_) - 1);
      const int j = std::min(static_cast<int>(at.y), static_cast<int>(side_) - 1);
      SetOpaque(j * static_cast<int>(side_) + i, f.distance_m, f.radiance);
    }
  }

  // Every pixel's central ray against the disc's plane: correct at seams, corners and for discs
  // that surround the view. Coverage: a kernel (3 A / (pi R²)) (1 - rho² / R²)² of the distance rho
  // to the disc's centre, whose integral over the plane is the surfel's area.
  void DrawDisc(const Footprint& f) {
    const bool opaque = splat_ == Splat::kOpaque;
    const float support_m = f.radius_m * (opaque ? kOpaqueDiscScale : kKernelSupport);
    const float peak = 3.0f / (kKernelSupport * kKernelSupport);
    const Vec3f c = local_ ? ToLocal(f.to_node) : f.to_node;
    const Vec3f n = local_ ? ToLocal(f.normal) : f.normal;
    const float plane = Dot(n, c);  // n·x = plane
    const F8 cx = Set8(c.x), cy = Set8(c.y), cz = Set8(c.z);
    const F8 nx = Set8(n.x), ny = Set8(n.y), nz = Set8(n.z);
    const F8 zero = Set8(0.0f), plane8 = Set8(plane);
    const F8 support2 = Set8(support_m * support_m);
    alignas(32) float rho2_lanes[8], t_lanes[8];
    for (uint32_t p = 0; p < map_.padded(); p += 8) {
      const F8 wx = Load8(map_.dir(0) + p), wy = Load8(map_.dir(1) + p),
               wz = Load8(map_.dir(2) + p);
      const F8 n_dot_w = nx * wx + ny * wy + nz * wz;
      // t = plane / n·w > 0, compared without the division first.
      const M8 ahead = (n_dot_w * plane8) > zero;
      if (Bits8(ahead) == 0) continue;
      const F8 t = Select8(ahead, plane8 / n_dot_w, zero);
      const F8 ex = t * wx - cx, ey = t * wy - cy, ez = t * wz - cz;
      const F8 rho2 = ex * ex + ey * ey + ez * ez;
      unsigned hit = Bits8(ahead & (rho2 < support2));
      if (hit == 0) continue;
      Store8(rho2_lanes, rho2);
      Store8(t_lanes, t);
      for (; hit != 0; hit &= hit - 1) {
        const int k = __builtin_ctz(hit);
        const uint32_t pixel = p + static_cast<uint32_t>(k);
        if (pixel >= map_.pixels()) break;
        if (opaque) {
          SetOpaque(static_cast<int32_t>(pixel), t_lanes[k], f.radiance);
        } else {
          const float q = 1.0f - rho2_lanes[k] / (support_m * support_m);
          AddCoverage(static_cast<int32_t>(pixel), peak * q * q, f.radiance);
        }
      }
    }
  }

  const MicrobufferMap& map_;
  Microbuffer& buffer_;
  RasterCounters& counters_;
  Frame frame_;
  Splat splat_;
  bool local_;
  uint32_t side_;
};

}  // namespace

Microbuffer::Microbuffer(const MicrobufferMap& map)
    : map_(&map), storage_(5 * size_t{map.padded()}) {
  // padded() is a multiple of 8 floats, so every plane is aligned for SIMD.
  for (int i = 0; i < 5; ++i) values_[i] = storage_.data() + i * size_t{map.padded()};
  touched_ = 1;
  Clear();
}

void Microbuffer::Clear() {
  if (touched_ == 0) return;
  const size_t n = map_->padded();
  std::fill(values_[0], values_[0] + 4 * n, 0.0f);
  std::fill(values_[4], values_[4] + n, std::numeric_limits<float>::infinity());
  touched_ = 0;
}

void RasterizeCut(const PointTree& tree, const CutView& view, std::span<const CutNode> cut,
                  Splat splat, Microbuffer& buffer, RasterCounters& counters) {
  Rasterizer rasterizer(view, splat, buffer, counters);
  const uint32_t first_inner_slot =
      tree.levels() > 1 ? tree.first_group(1) * kLanes : ~0u;
  for (const CutNode& node : cut) {
    const NodeGroup& g = tree.group(node.slot / kLanes);
    const RadianceGroup& light = tree.radiance(node.slot / kLanes);
    const uint32_t k = node.slot % kLanes;
    Footprint f;
    f.to_node = Vec3f(g.cx[k], g.cy[k], g.cz[k]) - view.position;
    f.distance_m = node.distance_m;
    f.normal = Vec3f(g.nx[k], g.ny[k], g.nz[k]);
    f.radius_m = g.radius[k];
    f.leaf = node.slot < first_inner_slot;
    const float facing = Dot(f.normal, f.to_node);
    const bool front = facing < 0.0f;
    float area = front ? g.front_area[k] : g.back_area[k];
    if (view.sees_inside) area = std::max(g.front_area[k], g.back_area[k]);
    const float d = f.distance_m;
    if (!(d > 0.0f)) continue;  // a surfel exactly at the receiver has no direction
    f.solid_angle = area * (std::fabs(facing) / d) / (d * d);
    f.radiance = front ? Rgb(light.front[0][k], light.front[1][k], light.front[2][k])
                       : Rgb(light.back[0][k], light.back[1][k], light.back[2][k]);
    rasterizer.Draw(f);
  }
}

Rgb ConvolveCosine(const Microbuffer& far, const Microbuffer* near, const Vec3f& n, Splat splat) {
  const MicrobufferMap& map = far.map();
  const Vec3f axis = map.kind() == BufferMap::kCosine ? Vec3f(0, 0, 1) : n;
  const F8 nx = Set8(axis.x), ny = Set8(axis.y), nz = Set8(axis.z);
  const F8 zero = Set8(0.0f), one = Set8(1.0f);
  F8 sum_w = zero, sum_r = zero, sum_g = zero, sum_b = zero;
  for (uint32_t p = 0; p < map.padded(); p += 8) {
    const F8 w = Max8(nx * Load8(map.weight(0) + p) + ny * Load8(map.weight(1) + p) +
                          nz * Load8(map.weight(2) + p),
                      zero);
    F8 r = Load8(far.radiance(0) + p), g = Load8(far.radiance(1) + p),
       b = Load8(far.radiance(2) + p);
    if (near != nullptr) {
      const F8 nr = Load8(near->radiance(0) + p), ng = Load8(near->radiance(1) + p),
               nb = Load8(near->radiance(2) + p);
      if (splat == Splat::kOpaque) {
        const M8 near_wins = Load8(near->depth() + p) < Load8(far.depth() + p);
        r = Select8(near_wins, nr, r);
        g = Select8(near_wins, ng, g);
        b = Select8(near_wins, nb, b);
      } else {
        // What is far gets the room that is left, and never more than it had.
        const F8 open = one - Load8(near->coverage() + p);
        const F8 far_coverage = Load8(far.coverage() + p);
        const F8 part = Select8(far_coverage > open, open / Max8(far_coverage, Set8(1e-30f)), one);
        r = nr + part * r;
        g = ng + part * g;
        b = nb + part * b;
      }
    }
    sum_w = sum_w + w;
    sum_r = sum_r + w * r;
    sum_g = sum_g + w * g;
    sum_b = sum_b + w * b;
  }
  const float total = Sum8(sum_w);
  if (!(total > 0.0f)) return Rgb();
  const float scale = kPif / total;
  return {Sum8(sum_r) * scale, Sum8(sum_g) * scale, Sum8(sum_b) * scale};
}

}  // namespace farpoint

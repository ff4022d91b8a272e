#include "core/pbgi/microbuffer.h"

#include <algorithm>
#include <cmath>
#include <limits>

#include "core/base/fp_trap.h"
#include "core/math/elementary.h"
#include "core/math/simd8.h"
#include "core/math/vec8.h"

namespace farpoint {

namespace {

class Rasterizer {
 public:
  Rasterizer(const PointTree& tree, const CutView& view, Splat splat, Microbuffer& buffer,
             RasterCounters& counters)
      : tree_(tree),
        map_(buffer.map()),
        buffer_(buffer),
        counters_(counters),
        frame_(view.normal),
        splat_(splat),
        local_(map_.kind() == BufferMap::kCosine),
        side_(map_.side()) {}

  void Draw(const CutNode& node, bool leaf) {
    const float omega = std::fabs(node.signed_solid_angle);
    if (!(omega > 0.0f)) return;
    const Vec3f w = local_ ? ToLocal(node.direction) : node.direction;
    // Compared with the pixel under the centre; a node on the cosine map's horizon uses the lowest.
    const bool below = local_ && w.z < 0.0f;
    const Vec2f at = map_.Project(below ? NormalizeOr(Vec3f(w.x, w.y, 0), Vec3f(1, 0, 0)) : w);
    const int last = static_cast<int>(side_) - 1;
    const int i = std::min(static_cast<int>(at.x), last);
    const int j = std::min(static_cast<int>(at.y), last);
    const float pixel_sr = map_.solid_angle()[j * static_cast<int>(side_) + i];
    ++counters_.splats;
    if (leaf) {
      const float radius_m = tree_.surfel(node.slot).radius_m;
      if (kPif * radius_m * radius_m >
          kExactDiscPixels * kExactDiscPixels * pixel_sr * node.distance_m * node.distance_m) {
        ++counters_.exact_discs;
        DrawDisc(node);
        return;
      }
    }
    if (below) return;
    const float size = std::sqrt(omega / pixel_sr);
    if (splat_ == Splat::kOpaque) {
      DrawOpaqueBox(node, at, size);
    } else {
      DrawCoverageBox(node, omega, at, kCoverageBoxScale * size);
    }
  }

 private:
  Vec3f ToLocal(const Vec3f& w) const {
    return {Dot(w, frame_.t), Dot(w, frame_.b), Dot(w, frame_.n)};
  }

  // What the node reflects to the side from which it is seen.
  Rgb Radiance(const CutNode& node) const {
    return tree_.radiance_of(node.slot, node.signed_solid_angle > 0.0f);
  }

  // A dark back that is seen behind a front is, as a rule, the far side of the same closed object:
  // it hides what the front hides already, not the rest of the pixel. (Added up like other surfaces
  // the two would double every outline.) So dark backs first use up the coverage of the fronts
  // before them, and only what goes beyond hides more: a sheet seen from behind with nothing before
  // it hides all.
  void AddCoverage(int32_t pixel, float alpha, float distance_m, bool back, const Rgb& radiance) {
    float* coverage = buffer_.coverage();
    float& depth = buffer_.depth()[pixel];  // of what was added last
    const float open = 1.0f - coverage[pixel];
    // What comes after a jump in depth lies behind a surface whose gaps it must not fill.
    if (!(open > 0.0f) || (coverage[pixel] > kFullFrom && distance_m > kDepthJump * depth)) {
      ++counters_.hidden_pixels;
      return;
    }
    float& credit = buffer_.front_credit()[pixel];
    if (back && !(MaxComponent(radiance) > 0.0f)) {
      const float used = std::min(alpha, credit);
      credit -= used;
      alpha -= used;
      if (!(alpha > 0.0f)) return;
    } else {
      credit += alpha;
    }
    depth = distance_m;
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
  void DrawCoverageBox(const CutNode& node, float omega, const Vec2f& at, float size) {
    const float half = 0.5f * size;
    const float per_area = omega / (size * size);
    const int n = static_cast<int>(side_);
    const int i0 = std::max(static_cast<int>(std::floor(at.x - half)), -1);
    const int i1 = std::min(static_cast<int>(std::floor(at.x + half)), n);
    const int j0 = std::max(static_cast<int>(std::floor(at.y - half)), -1);
    const int j1 = std::min(static_cast<int>(std::floor(at.y + half)), n);
    const float* coverage = buffer_.coverage();
    Rgb radiance;  // looked up only if a pixel has room
    bool found = false;
    for (int j = j0; j <= j1; ++j) {
      const float oy = std::min(at.y + half, static_cast<float>(j + 1)) -
                       std::max(at.y - half, static_cast<float>(j));
      for (int i = i0; i <= i1; ++i) {
        const int32_t pixel = map_.Wrap(i, j);
        if (pixel < 0) continue;
        if (!(coverage[pixel] < 1.0f)) {
          ++counters_.hidden_pixels;
          continue;
        }
        const float ox = std::min(at.x + half, static_cast<float>(i + 1)) -
                         std::max(at.x - half, static_cast<float>(i));
        const float part_sr = per_area * ox * oy;
        if (!(part_sr > 0.0f)) continue;
        if (!found) {
          radiance = Radiance(node);
          found = true;
        }
        AddCoverage(pixel, part_sr / map_.solid_angle()[pixel], node.distance_m,
                    node.signed_solid_angle < 0.0f, radiance);
      }
    }
  }

  void DrawOpaqueBox(const CutNode& node, const Vec2f& at, float size) {
    const Rgb radiance = Radiance(node);
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
        SetOpaque(pixel, node.distance_m, radiance);
        drawn = true;
      }
    }
    if (!drawn) {
      const int i = std::min(static_cast<int>(at.x), static_cast<int>(side_) - 1);
      const int j = std::min(static_cast<int>(at.y), static_cast<int>(side_) - 1);
      SetOpaque(j * static_cast<int>(side_) + i, node.distance_m, radiance);
    }
  }

  // Every pixel's central ray against the disc's plane: correct at seams, corners and for discs
  // that surround the view. Coverage: a kernel (3 A / (pi R²)) (1 - rho² / R²)² of the distance rho
  // to the disc's centre, whose integral over the plane is the surfel's area.
  void DrawDisc(const CutNode& node) {
    const FpTrapPause pause;  // lanes that are left out
    const bool opaque = splat_ == Splat::kOpaque;
    const Surfel surfel = tree_.surfel(node.slot);
    const Rgb radiance = Radiance(node);
    const Vec3f to_node = node.direction * node.distance_m;
    const Vec3f normal = surfel.normal;
    const float support_m = surfel.radius_m * (opaque ? kOpaqueDiscScale : kKernelSupport);
    const float peak = 3.0f / (kKernelSupport * kKernelSupport);
    const Vec3f c = local_ ? ToLocal(to_node) : to_node;
    const Vec3f n = local_ ? ToLocal(normal) : normal;
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
          SetOpaque(static_cast<int32_t>(pixel), t_lanes[k], radiance);
        } else {
          const float q = 1.0f - rho2_lanes[k] / (support_m * support_m);
          AddCoverage(static_cast<int32_t>(pixel), peak * q * q, node.distance_m,
                      node.signed_solid_angle < 0.0f, radiance);
        }
      }
    }
  }

  const PointTree& tree_;
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
    : map_(&map), storage_(6 * size_t{map.padded()}) {
  // padded() is a multiple of 8 floats, so every plane is aligned for SIMD.
  for (int i = 0; i < 6; ++i) values_[i] = storage_.data() + i * size_t{map.padded()};
  touched_ = 1;
  Clear();
}

void Microbuffer::Clear() {
  if (touched_ == 0) return;
  const size_t n = map_->padded();
  std::fill(values_[0], values_[0] + 4 * n, 0.0f);
  std::fill(values_[4], values_[4] + n, std::numeric_limits<float>::infinity());
  std::fill(values_[5], values_[5] + n, 0.0f);
  touched_ = 0;
}

void RasterizeCut(const PointTree& tree, const CutView& view, std::span<const CutNode> cut,
                  Splat splat, Microbuffer& buffer, RasterCounters& counters) {
  Rasterizer rasterizer(tree, view, splat, buffer, counters);
  const uint32_t first_inner_slot = tree.levels() > 1 ? tree.first_group(1) * kLanes : ~0u;
  for (const CutNode& node : cut) rasterizer.Draw(node, node.slot < first_inner_slot);
}

namespace {

// Radiance of the pixels p to p + 7 of `far` seen through `near`; see ConvolveCosine.
V8 Composite(const Microbuffer& far, const Microbuffer* near, Splat splat, uint32_t p) {
  const F8 one = Set8(1.0f);
  F8 r = Load8(far.radiance(0) + p), g = Load8(far.radiance(1) + p), b = Load8(far.radiance(2) + p);
  if (near != nullptr) {
    const F8 nr = Load8(near->radiance(0) + p), ng = Load8(near->radiance(1) + p),
             nb = Load8(near->radiance(2) + p);
    if (splat == Splat::kOpaque) {
      const M8 near_wins = Load8(near->depth() + p) < Load8(far.depth() + p);
      r = Select8(near_wins, nr, r);
      g = Select8(near_wins, ng, g);
      b = Select8(near_wins, nb, b);
    } else {
      // What is far gets the room that is left, and never more than it had; none behind what is
      // covered for the most part, as within one buffer.
      const F8 near_coverage = Load8(near->coverage() + p);
      const F8 open = Select8(near_coverage > Set8(kFullFrom), Set8(0.0f), one - near_coverage);
      const F8 far_coverage = Load8(far.coverage() + p);
      const F8 part = Select8(far_coverage > open, open / Max8(far_coverage, Set8(1e-30f)), one);
      r = nr + part * r;
      g = ng + part * g;
      b = nb + part * b;
    }
  }
  if (splat == Splat::kCoverage) {
    // A pixel that is covered for the most part is taken for full.
    F8 c = Load8(far.coverage() + p);
    if (near != nullptr) {
      const F8 near_coverage = Load8(near->coverage() + p);
      c = Select8(near_coverage > Set8(kFullFrom), near_coverage, Min8(one, near_coverage + c));
    }
    const F8 fill = Select8(c > Set8(kFullFrom), one / Max8(c, Set8(kFullFrom)), one);
    r = r * fill;
    g = g * fill;
    b = b * fill;
  }
  return {r, g, b};
}

}  // namespace

Rgb ConvolveCosine(const Microbuffer& far, const Microbuffer* near, const Vec3f& n, Splat splat) {
  const MicrobufferMap& map = far.map();
  const Vec3f axis = map.kind() == BufferMap::kCosine ? Vec3f(0, 0, 1) : n;
  const F8 nx = Set8(axis.x), ny = Set8(axis.y), nz = Set8(axis.z);
  const F8 zero = Set8(0.0f);
  F8 sum_w = zero, sum_r = zero, sum_g = zero, sum_b = zero;
  for (uint32_t p = 0; p < map.padded(); p += 8) {
    const F8 w = Max8(nx * Load8(map.weight(0) + p) + ny * Load8(map.weight(1) + p) +
                          nz * Load8(map.weight(2) + p),
                      zero);
    const V8 l = Composite(far, near, splat, p);
    sum_w = sum_w + w;
    sum_r = sum_r + w * l.x;
    sum_g = sum_g + w * l.y;
    sum_b = sum_b + w * l.z;
  }
  const float total = Sum8(sum_w);
  if (!(total > 0.0f)) {
    // A single pixel is the whole sphere and favours no direction: its mean radiance stands.
    Rgb mean(far.radiance(0)[0], far.radiance(1)[0], far.radiance(2)[0]);
    float coverage = far.coverage()[0];
    if (near != nullptr) {
      const Rgb own(near->radiance(0)[0], near->radiance(1)[0], near->radiance(2)[0]);
      const float near_coverage = near->coverage()[0];
      if (splat == Splat::kOpaque) {
        if (near->depth()[0] < far.depth()[0]) mean = own;
      } else {
        const float open = near_coverage > kFullFrom ? 0.0f : 1.0f - near_coverage;
        mean = own + mean * (coverage > open ? open / coverage : 1.0f);
        coverage = near_coverage + std::min(open, coverage);
      }
    }
    const float full = splat == Splat::kCoverage && coverage > kFullFrom ? 1.0f / coverage : 1.0f;
    return mean * (kPif * full);
  }
  const float scale = kPif / total;
  return {Sum8(sum_r) * scale, Sum8(sum_g) * scale, Sum8(sum_b) * scale};
}

Rgb ConvolveLobe(const Microbuffer& far, const Microbuffer* near,
                 const std::array<const float*, 3>& weight, const Rgb& integral, Splat splat) {
  const F8 zero = Set8(0.0f);
  V8 sum(zero, zero, zero), total(zero, zero, zero);
  for (uint32_t p = 0; p < far.map().padded(); p += 8) {
    const V8 w(Load8(weight[0] + p), Load8(weight[1] + p), Load8(weight[2] + p));
    const V8 l = Composite(far, near, splat, p);
    total = total + w;
    sum = sum + V8(w.x * l.x, w.y * l.y, w.z * l.z);
  }
  const auto channel = [](F8 s, F8 t, float all) {
    const float whole = Sum8(t);
    return whole > 0.0f ? Sum8(s) * (all / whole) : 0.0f;
  };
  return {channel(sum.x, total.x, integral.x), channel(sum.y, total.y, integral.y),
          channel(sum.z, total.z, integral.z)};
}

}  // namespace farpoint

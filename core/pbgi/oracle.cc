// The literal, slow versions of cut and convolution: one node, one pixel at a time, in double
// precision, written from the definitions and not from the fast code. Oracles of the tests.
#include <algorithm>
#include <cmath>

#include "core/math/elementary.h"
#include "core/pbgi/microbuffer.h"
#include "core/pbgi/tree_cut.h"

namespace farpoint {

namespace {

struct LiteralNode {
  Vec3d centre, mean;
  double radius, thickness, sin_cone, front_area, back_area;
};

LiteralNode ReadNode(const PointTree& tree, uint32_t slot) {
  const NodeGroup g = tree.group(slot / kLanes);
  const uint32_t k = slot % kLanes;
  return {{g.cx[k], g.cy[k], g.cz[k]},
          {g.nx[k], g.ny[k], g.nz[k]},
          g.radius[k],
          g.thickness[k],
          g.sin_cone[k],
          g.front_area[k],
          g.back_area[k]};
}

bool BelowEveryHorizon(const LiteralNode& n, const CutView& view) {
  if (view.sin_spread >= 1) return false;
  const Vec3d axis(view.normal), v = n.centre - Vec3d(view.position);
  const double d = Length(v);
  const double cosine = Dot(axis, n.mean);
  const double tilt = std::sqrt(std::max(0.0, 1 - cosine * cosine));
  const double reach =
      std::min(n.radius, n.radius * std::min(1.0, tilt + view.sin_spread) + n.thickness);
  // The largest n_x·v over the cone of normals.
  double top = d;
  const double height = Dot(axis, v);
  if (height < d * view.cos_spread) {
    top = height * view.cos_spread +
          std::sqrt(std::max(0.0, d * d - height * height)) * view.sin_spread;
  }
  return top + reach + view.margin_m <= std::max(0.0, d - n.radius) / 512;
}

bool OnlyInvisibleSides(const LiteralNode& n, const CutView& view) {
  double front = n.front_area, back = n.back_area;
  if (view.sees_inside) front = back = std::max(front, back);
  if (front <= 0 && back <= 0) return true;
  const Vec3d v = n.centre - Vec3d(view.position);
  const double length = Length(n.mean);
  if (!(length > 0)) return false;
  const double facing = Dot(n.mean, v) / length;
  const double slack = Length(v) * n.sin_cone + n.radius + view.radius_m;
  return (-facing > slack && front <= 0) || (facing > slack && back <= 0);
}

CutNode MakeNode(const LiteralNode& n, const CutView& view, uint32_t slot, const Vec3d& v,
                 double d) {
  const double cosine = -Dot(n.mean, v) / d;  // > 0: the front is seen
  double area = cosine > 0 ? n.front_area : n.back_area;
  if (view.sees_inside) area = std::max(n.front_area, n.back_area);
  return {slot, static_cast<float>(d), Vec3f(v / d), static_cast<float>(area * cosine / (d * d))};
}

void Visit(const PointTree& tree, const CutView& view, const CutParams& params, uint32_t slot,
           int level, std::vector<CutNode>& far, std::vector<NearNode>* near) {
  const LiteralNode n = ReadNode(tree, slot);
  if (n.radius < 0) return;
  if (BelowEveryHorizon(n, view) || OnlyInvisibleSides(n, view)) return;
  const Vec3d v = n.centre - Vec3d(view.position);
  const double d = Length(v);
  double pixel_sr = params.pixel_sr;
  if (params.map == BufferMap::kCosine) {
    pixel_sr /= std::max(0.1, Dot(Vec3d(view.normal), v) / d);
  }
  const bool fine =
      kPi * n.radius * n.radius <= kCutPixels * pixel_sr * d * d && Length2(n.mean) >= 0.5;
  if (near != nullptr) {
    const bool is_far = view.radius_m < params.epsilon * (d - n.radius);
    const bool is_near = view.radius_m >= params.epsilon * (d + n.radius);
    if (is_near || (!is_far && (level == 0 || fine))) {
      near->push_back({slot, level});
      return;
    }
    if (!is_far) {
      for (uint32_t k = 0; k < kLanes; ++k) {
        Visit(tree, view, params, tree.ChildGroup(level, slot) * kLanes + k, level - 1, far, near);
      }
      return;
    }
  }
  if (level == 0) {
    const bool own = std::fabs(Dot(n.mean, v)) < 0.6 * n.radius &&
                     std::fabs(Dot(n.mean, Vec3d(view.normal))) > 0.5;
    if (!own && d > 0) far.push_back(MakeNode(n, view, slot, v, d));
    return;
  }
  if (fine) {
    far.push_back(MakeNode(n, view, slot, v, d));
    return;
  }
  for (uint32_t k = 0; k < kLanes; ++k) {
    Visit(tree, view, params, tree.ChildGroup(level, slot) * kLanes + k, level - 1, far, near);
  }
}

}  // namespace

void ComputeClusterCutLiteral(const PointTree& tree, const CutView& view, const CutParams& params,
                              std::vector<CutNode>& far, std::vector<NearNode>* near) {
  if (tree.empty()) return;
  for (uint32_t k = 0; k < kLanes; ++k) {
    Visit(tree, view, params, tree.root_group() * kLanes + k, tree.root_level(), far, near);
  }
}

Rgb ConvolveCosineLiteral(const Microbuffer& far, const Microbuffer* near, const Vec3f& n,
                          Splat splat) {
  const MicrobufferMap& map = far.map();
  const Vec3d axis = map.kind() == BufferMap::kCosine ? Vec3d(0, 0, 1) : Vec3d(n);
  double weights = 0;
  Vec3d sum;
  for (uint32_t p = 0; p < map.pixels(); ++p) {
    const Vec3d v(map.weight(0)[p], map.weight(1)[p], map.weight(2)[p]);
    const double w = std::max(0.0, Dot(axis, v));
    Vec3d l(far.radiance(0)[p], far.radiance(1)[p], far.radiance(2)[p]);
    double covered = far.coverage()[p];
    if (near != nullptr) {
      const Vec3d own(near->radiance(0)[p], near->radiance(1)[p], near->radiance(2)[p]);
      if (splat == Splat::kOpaque) {
        if (near->depth()[p] < far.depth()[p]) l = own;
      } else {
        const bool closed = near->coverage()[p] > kFullFrom;
        const double open = closed ? 0.0 : 1.0 - near->coverage()[p];
        const double c = far.coverage()[p];
        l = own + l * (c > open ? open / c : 1.0);
        covered = closed ? near->coverage()[p] : std::min(1.0, near->coverage()[p] + c);
      }
    }
    if (splat == Splat::kCoverage && covered > 0.75) l = l / covered;
    weights += w;
    sum += l * w;
  }
  return Rgb(sum * (kPi / weights));
}

}  // namespace farpoint

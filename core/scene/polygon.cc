#include "core/scene/polygon.h"

#include <algorithm>
#include <cmath>
#include <utility>

#include "core/math/sampling.h"

namespace farpoint {

namespace {

struct Point2 {
  double x, y;
  bool operator==(const Point2&) const = default;
};

// Twice the signed area.
double Orientation(const Point2& a, const Point2& b, const Point2& c) {
  return (b.x - a.x) * (c.y - a.y) - (b.y - a.y) * (c.x - a.x);
}

bool IsInside(const Point2& p, const Point2& a, const Point2& b, const Point2& c) {
  return Orientation(a, b, p) >= 0 && Orientation(b, c, p) >= 0 && Orientation(c, a, p) >= 0;
}

// The polygon without the coordinate along which its normal is longest, counter-clockwise. Empty
// if it has no area.
std::vector<Point2> Flatten(std::span<const Vec3d> corners) {
  Vec3d normal;
  for (size_t i = 1; i + 1 < corners.size(); ++i) {
    normal += Cross(corners[i] - corners[0], corners[i + 1] - corners[0]);
  }
  const Vec3d magnitude(std::fabs(normal.x), std::fabs(normal.y), std::fabs(normal.z));
  int axis = magnitude.x >= magnitude.y ? 0 : 1;
  if (magnitude.z > magnitude[axis]) axis = 2;
  if (!(magnitude[axis] > 0) || !IsFinite(normal)) return {};
  const int u = (axis + 1) % 3, v = (axis + 2) % 3;
  std::vector<Point2> points;
  points.reserve(corners.size());
  for (const Vec3d& p : corners) {
    points.push_back(normal[axis] > 0 ? Point2{p[u], p[v]} : Point2{p[v], p[u]});
  }
  return points;
}

void AppendFan(std::span<const uint32_t> ring, std::vector<std::array<uint32_t, 3>>& triangles) {
  for (size_t i = 1; i + 1 < ring.size(); ++i) triangles.push_back({ring[0], ring[i], ring[i + 1]});
}

// True if the diagonal from corner i to i + 2 of a quadrilateral lies inside.
bool DiagonalIsInside(const std::vector<Point2>& p, size_t i) {
  const size_t a = i, b = i + 1, c = i + 2, d = (i + 3) % 4;
  return Orientation(p[a], p[b], p[c]) > 0 && Orientation(p[a], p[c], p[d]) > 0;
}

// Ear clipping over a ring of the corners that are left.
class EarClipper {
 public:
  explicit EarClipper(const std::vector<Point2>& points) : points_(points) {
    const auto n = static_cast<uint32_t>(points.size());
    next_.resize(n);
    previous_.resize(n);
    for (uint32_t i = 0; i < n; ++i) {
      next_[i] = (i + 1) % n;
      previous_[i] = (i + n - 1) % n;
    }
    for (uint32_t i = 0; i < n; ++i) {
      if (!IsConvex(i)) reflex_.push_back(i);
    }
    budget_ = 4 * uint64_t{n} * n + 64;
  }

  bool Run(std::vector<std::array<uint32_t, 3>>& triangles) {
    bool clean = true;
    size_t left = points_.size();
    uint32_t i = 0;
    size_t misses = 0;
    while (left > 3) {
      const bool ear = IsEar(i);
      // A whole turn without an ear, or far too long a search: the polygon crosses itself.
      const bool forced = !ear && (misses >= left || budget_ == 0);
      if (!ear && !forced) {
        i = next_[i];
        ++misses;
        continue;
      }
      clean &= ear;
      triangles.push_back({previous_[i], i, next_[i]});
      next_[previous_[i]] = next_[i];
      previous_[next_[i]] = previous_[i];
      std::erase(reflex_, i);
      for (const uint32_t neighbour : {previous_[i], next_[i]}) {
        if (IsConvex(neighbour)) std::erase(reflex_, neighbour);
      }
      // Going on behind the next corner keeps long fans around one corner away.
      i = next_[next_[i]];
      --left;
      misses = 0;
    }
    triangles.push_back({previous_[i], i, next_[i]});
    return clean && Orientation(points_[previous_[i]], points_[i], points_[next_[i]]) >= 0;
  }

 private:
  bool IsConvex(uint32_t i) const {
    return Orientation(points_[previous_[i]], points_[i], points_[next_[i]]) > 0;
  }
  bool IsEar(uint32_t i) {
    if (budget_ == 0 || !IsConvex(i)) return false;
    const Point2 &a = points_[previous_[i]], &b = points_[i], &c = points_[next_[i]];
    budget_ -= std::min<uint64_t>(budget_, reflex_.size() + 1);
    return std::none_of(reflex_.begin(), reflex_.end(), [&](uint32_t r) {
      const Point2& p = points_[r];
      // Corners at the same place, as where a hole is joined to the outline, block nothing.
      return !(p == a) && !(p == b) && !(p == c) && IsInside(p, a, b, c);
    });
  }

  const std::vector<Point2>& points_;
  std::vector<uint32_t> next_, previous_, reflex_;
  uint64_t budget_;
};

}  // namespace

bool TriangulatePolygon(std::span<const Vec3d> corners,
                        std::vector<std::array<uint32_t, 3>>& triangles) {
  const size_t n = corners.size();
  if (n == 3) {
    triangles.push_back({0, 1, 2});
    return true;
  }
  const std::vector<Point2> points = Flatten(corners);
  if (points.empty()) {
    std::vector<uint32_t> ring(n);
    for (uint32_t i = 0; i < n; ++i) ring[i] = i;
    AppendFan(ring, triangles);
    return false;
  }
  if (n == 4) {
    const bool first = DiagonalIsInside(points, 0), second = DiagonalIsInside(points, 1);
    if (first || second) {
      const bool first_is_shorter =
          Length2(corners[2] - corners[0]) <= Length2(corners[3] - corners[1]);
      const uint32_t start = first && (!second || first_is_shorter) ? 0 : 1;
      AppendFan(std::array<uint32_t, 4>{start, start + 1, start + 2, (start + 3) % 4}, triangles);
      return true;
    }
  }
  return EarClipper(points).Run(triangles);
}

CornerIndex::CornerIndex(size_t expected_corners) {
  size_t slots = 16;
  while (slots < expected_corners) slots *= 2;
  slots_.assign(slots, MeshCorner::kNone);
}

uint32_t CornerIndex::VertexOf(const MeshCorner& corner) {
  if (2 * corners_.size() >= slots_.size()) Grow();
  const size_t mask = slots_.size() - 1;
  size_t slot = HashKey(corner.position, corner.uv, corner.normal) & mask;
  while (slots_[slot] != MeshCorner::kNone) {
    if (corners_[slots_[slot]] == corner) return slots_[slot];
    slot = (slot + 1) & mask;
  }
  slots_[slot] = static_cast<uint32_t>(corners_.size());
  corners_.push_back(corner);
  return slots_[slot];
}

void CornerIndex::Grow() {
  slots_.assign(2 * slots_.size(), MeshCorner::kNone);
  const size_t mask = slots_.size() - 1;
  for (uint32_t i = 0; i < corners_.size(); ++i) {
    size_t slot = HashKey(corners_[i].position, corners_[i].uv, corners_[i].normal) & mask;
    while (slots_[slot] != MeshCorner::kNone) slot = (slot + 1) & mask;
    slots_[slot] = i;
  }
}

Rgb MeanColor(const Mesh& mesh, std::span<const Rgb> colors) {
  Vec3d sum, plain_sum;
  double area_sum = 0;
  for (const auto& t : mesh.triangles) {
    const Vec3d a(mesh.positions[t[0]]), b(mesh.positions[t[1]]), c(mesh.positions[t[2]]);
    const double area = Length(Cross(b - a, c - a));
    const Vec3d color = Vec3d(colors[t[0]]) + Vec3d(colors[t[1]]) + Vec3d(colors[t[2]]);
    sum += color * (area / 3);
    plain_sum += color * (1.0 / 3);
    area_sum += area;
  }
  if (mesh.triangles.empty()) return Rgb(1);
  if (area_sum > 0 && std::isfinite(area_sum)) return Rgb(sum / area_sum);
  return Rgb(plain_sum / static_cast<double>(mesh.triangles.size()));
}

int32_t AddColorMaterial(const Rgb& color, Scene& scene) {
  Material material;
  material.name = "vertex colours";
  for (int c = 0; c < 3; ++c) {
    material.base_color[c] = color[c] >= 0 ? std::min(color[c], 1.0f) : 0.0f;
  }
  const bool again = !scene.materials.empty() && scene.materials.back().name == material.name &&
                     scene.materials.back().base_color == material.base_color;
  if (!again) scene.materials.push_back(std::move(material));
  return static_cast<int32_t>(scene.materials.size()) - 1;
}

Vec3d OffsetFor(const Box3d& bounds) {
  constexpr double kFar = 16;
  if (bounds.empty()) return {};
  const Vec3d center = bounds.Center();
  if (!IsFinite(center) || MaxAbs(center) <= kFar * bounds.Diagonal()) return {};
  return center;
}

}  // namespace farpoint

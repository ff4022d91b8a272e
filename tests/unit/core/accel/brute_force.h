// Ray queries as loops over all triangles in double precision: the oracle of RayAccel and of what
// is built on it.
#pragma once

#include <algorithm>
#include <cmath>
#include <limits>
#include <optional>
#include <random>
#include <vector>

#include "core/math/elementary.h"
#include "core/math/vec.h"
#include "core/scene/prepared_scene.h"

namespace farpoint {

// The same numbers everywhere: std's distributions are the library's choice, its engines are not.
class TestRandom {
 public:
  explicit TestRandom(uint64_t seed) : engine_(seed) {}
  uint64_t Bits() { return engine_(); }
  double Uniform() { return static_cast<double>(engine_() >> 11) * 0x1p-53; }  // [0, 1)
  double Uniform(double low, double high) { return low + (high - low) * Uniform(); }
  size_t Index(size_t count) { return engine_() % count; }
  // Uniform on the sphere.
  Vec3d Direction() {
    const double z = Uniform(-1, 1), phi_rad = Uniform(0, 2 * kPi);
    const double r = std::sqrt(std::max(0.0, 1 - z * z));
    return {r * std::cos(phi_rad), r * std::sin(phi_rad), z};
  }
  // Density cos / pi about the unit vector n: a point of the unit sphere set upon n.
  Vec3d CosineDirection(const Vec3d& n) { return NormalizeOr(n + Direction(), n); }
  // Uniform in area: barycentric weights of vertices 1 and 2.
  std::pair<double, double> Barycentric() {
    const double s = std::sqrt(Uniform());
    return {s * Uniform(), 1 - s};
  }

 private:
  std::mt19937_64 engine_;
};

// Where a line meets the plane of a triangle, in or near the triangle.
struct Crossing {
  double t;
  double t_error;  // what single precision may err in t
  uint32_t triangle;
  double b1, b2;
  bool certain;  // inside by more than single precision errs; otherwise within that of an edge
};

// Möller and Trumbore 1997, in double. Holes of alpha masks are left out; alpha within 10^-3 of the
// cut-off makes a crossing uncertain.
inline std::optional<Crossing> Cross(const PreparedScene& scene, uint32_t triangle,
                                     const Vec3d& origin, const Vec3d& direction) {
  const auto& v = scene.triangles()[triangle].vertex;
  const Vec3d v0(scene.vertices()[v[0]]);
  const Vec3d e1 = Vec3d(scene.vertices()[v[1]]) - v0, e2 = Vec3d(scene.vertices()[v[2]]) - v0;
  const Vec3d p = Cross(direction, e2);
  const double det = Dot(e1, p);
  if (det == 0) return std::nullopt;
  const Vec3d s = origin - v0;
  const double b1 = Dot(s, p) / det;
  const Vec3d q = Cross(s, e1);
  const double b2 = Dot(direction, q) / det;
  const double inside = std::min({b1, b2, 1 - b1 - b2});
  if (inside < -0.5) return std::nullopt;
  const double double_area = Length(Cross(e1, e2)), length = Length(direction);
  const double cosine = std::fabs(det) / (double_area * length);
  const double longest = std::sqrt(std::max({Length2(e1), Length2(e2), Length2(e2 - e1)}));
  const double reach = static_cast<double>(scene.diagonal_m()) + Length(origin);
  const double error_m = 4e-7 * reach / cosine;
  const double slack = error_m * longest / double_area;
  if (inside < -slack) return std::nullopt;
  Crossing c{Dot(e2, q) / det, error_m / length, triangle, b1, b2, inside > slack};
  const float cutoff = scene.MaterialOf(triangle).alpha_cutoff;
  if (cutoff >= 0) {
    const float alpha = scene.Alpha(triangle, static_cast<float>(b1), static_cast<float>(b2));
    if (std::fabs(alpha - cutoff) < 1e-3f) {
      c.certain = false;
    } else if (alpha < cutoff) {
      // Near the border of a triangle the interpolated alpha says nothing about the neighbour's.
      return std::nullopt;
    }
  }
  return c;
}

// All crossings with t > 0, nearest first.
inline std::vector<Crossing> AllCrossings(const PreparedScene& scene, const Vec3f& origin,
                                          const Vec3f& direction) {
  std::vector<Crossing> all;
  for (uint32_t t = 0; t < scene.triangles().size(); ++t) {
    const auto c = Cross(scene, t, Vec3d(origin), Vec3d(direction));
    if (c && c->t > -c->t_error) all.push_back(*c);
  }
  std::sort(all.begin(), all.end(), [](const Crossing& a, const Crossing& b) { return a.t < b.t; });
  return all;
}

// The nearest crossing beyond t_min, counting all of what lies inside or on an edge.
inline std::optional<Crossing> NearestCrossing(const PreparedScene& scene, const Vec3d& origin,
                                               const Vec3d& direction, double t_min, double t_max) {
  std::optional<Crossing> nearest;
  for (uint32_t t = 0; t < scene.triangles().size(); ++t) {
    const auto c = Cross(scene, t, origin, direction);
    if (c && c->t > t_min && c->t < t_max) {
      nearest = c;
      t_max = c->t;
    }
  }
  return nearest;
}

}  // namespace farpoint

#include "core/pbgi/microbuffer_map.h"

#include <algorithm>
#include <cmath>

#include "core/base/check.h"
#include "core/math/elementary.h"

namespace farpoint {

namespace {

// The octahedral map: p, q in [-1, 1] -> direction, not normalised (|x| + |y| + |z| = 1).
Vec3d OctahedronPoint(double p, double q) {
  const double z = 1.0 - std::fabs(p) - std::fabs(q);
  if (z >= 0.0) return {p, q, z};
  return {(1.0 - std::fabs(q)) * (p >= 0 ? 1.0 : -1.0),
          (1.0 - std::fabs(p)) * (q >= 0 ? 1.0 : -1.0), z};
}

// Adds solid angle (Van Oosterom and Strackee 1983) and irradiance vector (Lambert 1760: half the
// sum over edges of the subtended angle times the edge's unit normal) of the spherical triangle.
void AddTriangle(const Vec3d& a, const Vec3d& b, const Vec3d& c, double& omega, Vec3d& v) {
  const double triple = Dot(a, Cross(b, c));
  omega += 2.0 * DetAtan2(std::fabs(triple), 1.0 + Dot(a, b) + Dot(b, c) + Dot(c, a));
  const double sign = triple >= 0.0 ? 0.5 : -0.5;
  const auto edge = [&](const Vec3d& s, const Vec3d& t) {
    const Vec3d n = Cross(s, t);
    const double length = Length(n);
    if (length > 0.0) v += n * (sign * DetAtan2(length, Dot(s, t)) / length);
  };
  edge(a, b);
  edge(b, c);
  edge(c, a);
}

// [-1, 1]² -> unit disc (Shirley and Chiu 1997), and back.
Vec3d DiscFromSquare(double a, double b) {
  if (a == 0.0 && b == 0.0) return {0, 0, 0};
  double r, phi;
  if (std::fabs(a) > std::fabs(b)) {
    r = a;
    phi = 0.25 * kPi * (b / a);
  } else {
    r = b;
    phi = 0.5 * kPi - 0.25 * kPi * (a / b);
  }
  const SinCos sc = DetSinCos(phi);
  return {r * sc.cos, r * sc.sin, 0};
}

Vec2f SquareFromDisc(float x, float y) {
  const float r = std::sqrt(x * x + y * y);
  if (!(r > 0.0f)) return {0.0f, 0.0f};
  const double four_over_pi = 4.0 / kPi;
  if (std::fabs(x) > std::fabs(y)) {
    const float s = std::copysign(r, x);
    return {s, s * static_cast<float>(four_over_pi *
                                      DetAtan2(y * std::copysign(1.0f, x), std::fabs(x)))};
  }
  const float s = std::copysign(r, y);
  return {s * static_cast<float>(four_over_pi * DetAtan2(x * std::copysign(1.0f, y), std::fabs(y))),
          s};
}

}  // namespace

MicrobufferMap::MicrobufferMap(BufferMap kind, uint32_t side)
    : kind_(kind), side_(side), padded_((side * side + 7) / 8 * 8) {
  FP_CHECK(side >= 1 && side <= 256);
  for (int axis = 0; axis < 3; ++axis) {
    dir_[axis].assign(padded_, 0.0f);
    weight_[axis].assign(padded_, 0.0f);
  }
  solid_angle_.assign(padded_, 0.0f);
  const double n = side;
  reference_solid_angle_ =
      static_cast<float>((kind == BufferMap::kOctahedral ? 4.0 : 1.0) * kPi / (n * n));
  for (uint32_t j = 0; j < side; ++j) {
    for (uint32_t i = 0; i < side; ++i) {
      const uint32_t at = j * side + i;
      const Vec3f centre = Unproject(static_cast<float>(i) + 0.5f, static_cast<float>(j) + 0.5f);
      double omega = 0;
      Vec3d v;
      if (kind == BufferMap::kOctahedral) {
        // Cells are cut into pieces that lie on one face each, along both of the octahedron's
        // folds: the axes (cells of an odd side straddle them) and the diagonals.
        const double p0 = 2.0 * i / n - 1.0, p1 = 2.0 * (i + 1) / n - 1.0;
        const double q0 = 2.0 * j / n - 1.0, q1 = 2.0 * (j + 1) / n - 1.0;
        const double ps[3] = {p0, p0 < 0 && p1 > 0 ? 0.0 : p1, p1};
        const double qs[3] = {q0, q0 < 0 && q1 > 0 ? 0.0 : q1, q1};
        for (int a = 0; a < 2; ++a) {
          for (int b = 0; b < 2; ++b) {
            if (!(ps[a + 1] > ps[a]) || !(qs[b + 1] > qs[b])) continue;
            // The part of this rectangle with |p| + |q| <= 1 and the part beyond.
            const double sp = ps[a] + ps[a + 1] >= 0 ? 1.0 : -1.0;
            const double sq = qs[b] + qs[b + 1] >= 0 ? 1.0 : -1.0;
            // Mirrored into the quadrant p, q >= 0.
            const double x0 = std::min(sp * ps[a], sp * ps[a + 1]);
            const double x1 = std::max(sp * ps[a], sp * ps[a + 1]);
            const double y0 = std::min(sq * qs[b], sq * qs[b + 1]);
            const double y1 = std::max(sq * qs[b], sq * qs[b + 1]);
            const auto add_polygon = [&](bool inner) {
              // Clip the rectangle against x + y <= 1 (inner) or >= 1.
              const double rx[4] = {x0, x1, x1, x0}, ry[4] = {y0, y0, y1, y1};
              double cx[8], cy[8];
              int count = 0;
              for (int k = 0; k < 4; ++k) {
                const int l = (k + 1) % 4;
                const double fk = inner ? 1.0 - rx[k] - ry[k] : rx[k] + ry[k] - 1.0;
                const double fl = inner ? 1.0 - rx[l] - ry[l] : rx[l] + ry[l] - 1.0;
                if (fk >= 0) {
                  cx[count] = rx[k];
                  cy[count++] = ry[k];
                }
                if ((fk > 0 && fl < 0) || (fk < 0 && fl > 0)) {
                  const double t = fk / (fk - fl);
                  cx[count] = rx[k] + t * (rx[l] - rx[k]);
                  cy[count++] = ry[k] + t * (ry[l] - ry[k]);
                }
              }
              if (count < 3) return;
              Vec3d corner[8];
              for (int k = 0; k < count; ++k) {
                // Inside the polygon's own face: on the fold both faces agree.
                const double z = 1.0 - cx[k] - cy[k];
                const Vec3d o = z >= 0 || inner ? Vec3d(cx[k], cy[k], std::max(0.0, z))
                                                : Vec3d(1.0 - cy[k], 1.0 - cx[k], z);
                corner[k] = Normalize(Vec3d(sp * o.x, sq * o.y, o.z));
              }
              for (int k = 1; k + 1 < count; ++k) {
                Vec3d part;
                double part_omega = 0;
                AddTriangle(corner[0], corner[k], corner[k + 1], part_omega, part);
                // Lambert's vector points towards the triangle whatever its winding.
                if (Dot(part, corner[0] + corner[k] + corner[k + 1]) < 0) part = -part;
                omega += part_omega;
                v += part;
              }
            };
            add_polygon(true);
            add_polygon(false);
          }
        }
      } else {
        // Equal-area in the projection on the base: ∫ cos dω is the same for all. The solid angle
        // and the lateral components follow at the centre's cosine.
        const double cosine = std::max(static_cast<double>(centre.z), 0.5 / n);
        omega = kPi / (n * n) / cosine;
        v = {centre.x * omega, centre.y * omega, kPi / (n * n)};
      }
      for (int axis = 0; axis < 3; ++axis) {
        dir_[axis][at] = centre[axis];
        weight_[axis][at] = static_cast<float>(v[axis]);
      }
      solid_angle_[at] = static_cast<float>(omega);
    }
  }
}

Vec2f MicrobufferMap::Project(const Vec3f& w) const {
  const float n = static_cast<float>(side_);
  if (kind_ == BufferMap::kCosine) {
    const Vec2f s = SquareFromDisc(w.x, w.y);
    return {std::clamp((s.x * 0.5f + 0.5f) * n, 0.0f, n),
            std::clamp((s.y * 0.5f + 0.5f) * n, 0.0f, n)};
  }
  const float inverse = 1.0f / (std::fabs(w.x) + std::fabs(w.y) + std::fabs(w.z));
  float p = w.x * inverse;
  float q = w.y * inverse;
  if (w.z < 0.0f) {
    const float fold_p = (1.0f - std::fabs(q)) * (p >= 0.0f ? 1.0f : -1.0f);
    q = (1.0f - std::fabs(p)) * (q >= 0.0f ? 1.0f : -1.0f);
    p = fold_p;
  }
  return {std::clamp((p * 0.5f + 0.5f) * n, 0.0f, n), std::clamp((q * 0.5f + 0.5f) * n, 0.0f, n)};
}

Vec3f MicrobufferMap::Unproject(float u, float v) const {
  const double p = 2.0 * u / side_ - 1.0;
  const double q = 2.0 * v / side_ - 1.0;
  if (kind_ == BufferMap::kCosine) {
    const Vec3d d = DiscFromSquare(p, q);
    return Vec3f(Vec3d(d.x, d.y, std::sqrt(std::max(0.0, 1.0 - d.x * d.x - d.y * d.y))));
  }
  return Vec3f(Normalize(OctahedronPoint(p, q)));
}

}  // namespace farpoint

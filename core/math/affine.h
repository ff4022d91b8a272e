// Affine transforms in double precision, named target-from-source (`world_from_mesh`).
#pragma once

#include "core/math/vec.h"

namespace farpoint {

// x' = linear * x + translation; `linear` holds the three columns.
struct Affine {
  Vec3d column[3] = {{1, 0, 0}, {0, 1, 0}, {0, 0, 1}};
  Vec3d translation;

  bool operator==(const Affine&) const = default;
  Vec3d Point(const Vec3d& p) const { return Vector(p) + translation; }
  Vec3d Vector(const Vec3d& v) const { return column[0] * v.x + column[1] * v.y + column[2] * v.z; }
  // Normals go by the inverse transpose; up to a positive factor that is the cofactor matrix,
  // which exists for singular transforms too. Mirrored transforms keep the side of the face.
  // Not normalised.
  Vec3d Normal(const Vec3d& n) const {
    const Vec3d c = Cross(column[1], column[2]) * n.x + Cross(column[2], column[0]) * n.y +
                    Cross(column[0], column[1]) * n.z;
    return Determinant() < 0 ? -c : c;
  }
  double Determinant() const { return Dot(column[0], Cross(column[1], column[2])); }

  // (a * b)(x) = a(b(x))
  Affine operator*(const Affine& b) const {
    Affine r;
    for (int i = 0; i < 3; ++i) r.column[i] = Vector(b.column[i]);
    r.translation = Point(b.translation);
    return r;
  }
};

}  // namespace farpoint

#include "core/pbgi/surfel_shape.h"

#include <algorithm>
#include <bit>
#include <cmath>
#include <numeric>
#include <span>

#include "core/base/check.h"
#include "core/base/fp_trap.h"
#include "core/math/sampling.h"

namespace farpoint {

namespace {

// Symmetric, row by row.
struct Matrix3 {
  double m[3][3] = {};
};

// Relative precision of the frame; see the header.
constexpr double kFrameBits = 0x1p20;
constexpr double kMaxStretch = 16;

// 2^k with 2^k <= x < 2^(k+1), for normal x.
double PowerOfTwoBelow(double x) {
  return std::bit_cast<double>(std::bit_cast<uint64_t>(x) & 0x7ff0000000000000ull);
}

// Eigenvalues on the diagonal of `a`, eigenvectors in the columns of `v`: Jacobi's method with
// cyclic sweeps (Golub and Van Loan, "Matrix Computations", 8.5).
void Diagonalize(Matrix3& a, Matrix3& v) {
  for (int i = 0; i < 3; ++i) v.m[i][i] = 1;
  const FpTrapPause pause;     // theta may overflow: there is nothing to turn then
  constexpr int kSweeps = 16;  // it converges quadratically: 5 or 6 do
  for (int sweep = 0; sweep < kSweeps; ++sweep) {
    for (const auto& [p, q] : {std::pair{0, 1}, std::pair{0, 2}, std::pair{1, 2}}) {
      if (a.m[p][q] == 0) continue;
      const double theta = (a.m[q][q] - a.m[p][p]) / (2 * a.m[p][q]);
      if (!std::isfinite(theta)) {
        a.m[p][q] = a.m[q][p] = 0;
        continue;
      }
      const double t =
          (theta >= 0 ? 1.0 : -1.0) / (std::fabs(theta) + std::sqrt(theta * theta + 1));
      const double c = 1 / std::sqrt(t * t + 1), s = t * c;
      for (int k = 0; k < 3; ++k) {
        const double kp = a.m[k][p], kq = a.m[k][q];
        a.m[k][p] = c * kp - s * kq;
        a.m[k][q] = s * kp + c * kq;
      }
      for (int k = 0; k < 3; ++k) {
        const double pk = a.m[p][k], qk = a.m[q][k];
        a.m[p][k] = c * pk - s * qk;
        a.m[q][k] = s * pk + c * qk;
      }
      a.m[p][q] = a.m[q][p] = 0;
      for (int k = 0; k < 3; ++k) {
        const double kp = v.m[k][p], kq = v.m[k][q];
        v.m[k][p] = c * kp - s * kq;
        v.m[k][q] = s * kp + c * kq;
      }
    }
  }
}

// A map with the lengths of `linear` (the longest in `unit`), free of its rotation if it stretches
// moderately.
Affine FrameOf(const Affine& linear, double& unit) {
  const double largest =
      std::max({MaxAbs(linear.column[0]), MaxAbs(linear.column[1]), MaxAbs(linear.column[2])});
  Affine frame;
  unit = 1;
  if (!(largest >= 0x1p-900) || !(largest <= 0x1p900)) return linear;  // nothing real comes near
  const double inverse = 1.0 / PowerOfTwoBelow(largest);
  Vec3d column[3];
  for (int c = 0; c < 3; ++c) column[c] = linear.column[c] * inverse;

  Matrix3 gram, vectors;
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 3; ++j) gram.m[i][j] = Dot(column[i], column[j]);
  }
  Diagonalize(gram, vectors);
  double sigma[3], least = 1e300, most = 0;
  for (int i = 0; i < 3; ++i) {
    sigma[i] = std::sqrt(std::max(0.0, gram.m[i][i]));
    least = std::min(least, sigma[i]);
    most = std::max(most, sigma[i]);
  }
  if (most > kMaxStretch * least) {
    for (int c = 0; c < 3; ++c) frame.column[c] = linear.column[c] / largest;
    unit = largest;
    return frame;
  }
  for (int c = 0; c < 3; ++c) {
    for (int r = 0; r < 3; ++r) {
      double sum = 0;
      for (int k = 0; k < 3; ++k) sum += vectors.m[r][k] * sigma[k] * vectors.m[c][k];
      frame.column[c][r] = std::nearbyint(sum / most * kFrameBits) / kFrameBits + 0.0;
    }
  }
  unit = most / inverse;
  return frame;
}

}  // namespace

ObjectShape MakeObjectShape(const Scene& scene, const PreparedScene& prepared, size_t object,
                            uint32_t first_vertex) {
  FP_CHECK(object < prepared.object_instances().size());
  const PreparedObject& o = prepared.objects()[object];
  const Instance& instance = scene.instances[prepared.object_instances()[object]];
  const Mesh& mesh = scene.meshes[instance.mesh];
  Affine linear = instance.world_from_mesh;
  linear.translation = Vec3d();
  ObjectShape shape;
  const Affine frame = FrameOf(linear, shape.unit_m);

  const size_t n = mesh.positions.size();
  shape.triangles.resize(o.triangle_count);
  std::vector<bool> used(n, false);
  for (size_t t = 0; t < shape.triangles.size(); ++t) {
    for (int k = 0; k < 3; ++k) {
      const uint32_t v = prepared.triangles()[o.first_triangle + t].vertex[k] - first_vertex;
      FP_CHECK(v < n);
      shape.triangles[t][k] = v;
      used[v] = true;
    }
  }
  // From the first vertex in use: floats keep their precision however far the mesh lies from the
  // origin of its own frame.
  const Vec3d anchor(mesh.positions[shape.triangles.front()[0]]);
  std::vector<Vec3d> local(n);
  double largest = 0;
  for (size_t v = 0; v < n; ++v) {
    if (!used[v]) continue;
    local[v] = frame.Vector(Vec3d(mesh.positions[v]) - anchor);
    largest = std::max(largest, MaxAbs(local[v]));
  }
  const double power = largest >= 0x1p-900 ? PowerOfTwoBelow(largest) : 1.0;
  shape.unit_m *= power;
  shape.vertices.resize(n);
  for (size_t v = 0; v < n; ++v) shape.vertices[v] = Vec3f(local[v] / power + Vec3d());

  shape.areas.resize(shape.triangles.size());
  for (size_t t = 0; t < shape.triangles.size(); ++t) {
    const auto& v = shape.triangles[t];
    const Vec3d a(shape.vertices[v[0]]);
    const double area =
        0.5 * Length(Cross(Vec3d(shape.vertices[v[1]]) - a, Vec3d(shape.vertices[v[2]]) - a));
    shape.areas[t] = static_cast<float>(area);
    shape.area += shape.areas[t];
  }
  Sha256 hash;
  hash.UpdateU64(n).UpdateU64(shape.triangles.size());
  hash.Update(std::as_bytes(std::span(shape.vertices)));
  hash.Update(std::as_bytes(std::span(shape.triangles)));
  shape.digest = hash.Finish();
  return shape;
}

std::vector<ObjectShape> MakeObjectShapes(const Scene& scene, const PreparedScene& prepared,
                                          Executor& executor) {
  const auto instances = prepared.object_instances();
  FP_CHECK(instances.size() == prepared.objects().size());
  std::vector<uint32_t> first_vertex(instances.size());
  uint32_t next = 0;
  for (size_t i = 0; i < instances.size(); ++i) {
    first_vertex[i] = next;
    next +=
        static_cast<uint32_t>(scene.meshes[scene.instances[instances[i]].mesh].positions.size());
  }
  std::vector<ObjectShape> shapes(instances.size());
  executor.ForEach(instances.size(), 1, [&](size_t i) {
    shapes[i] = MakeObjectShape(scene, prepared, i, first_vertex[i]);
  });
  return shapes;
}

SurfaceSize SizeOf(const std::vector<ObjectShape>& shapes, const std::vector<uint8_t>& repeated) {
  FP_CHECK(shapes.size() == repeated.size());
  SurfaceSize size;
  for (size_t i = 0; i < shapes.size(); ++i) {
    if (repeated[i] != 0) continue;
    size.area_m2 += shapes[i].area_m2();
    size.largest_m2 = std::max(size.largest_m2, shapes[i].area_m2());
  }
  return size;
}

std::vector<uint8_t> RepeatedObjects(const PreparedScene& prepared, Executor& executor) {
  const auto objects = prepared.objects();
  const auto corner = [&](uint64_t triangle, int k) -> const Vec3f& {
    return prepared.vertices()[prepared.triangles()[triangle].vertex[static_cast<size_t>(k)]];
  };
  // Those that may be the same lie in the same box and have as many triangles.
  std::vector<uint64_t> keys(objects.size());
  executor.ForEach(objects.size(), 16, [&](size_t o) {
    Box3f box;
    const PreparedObject& object = objects[o];
    for (uint64_t t = 0; t < object.triangle_count; ++t) {
      for (int k = 0; k < 3; ++k) box.Extend(corner(object.first_triangle + t, k));
    }
    uint64_t key = object.triangle_count;
    for (int c = 0; c < 3; ++c) {
      key = HashKey(key, std::bit_cast<uint32_t>(box.min[c]), std::bit_cast<uint32_t>(box.max[c]));
    }
    keys[o] = key;
  });
  std::vector<uint32_t> order(objects.size());
  std::iota(order.begin(), order.end(), 0u);
  std::sort(order.begin(), order.end(),
            [&](uint32_t a, uint32_t b) { return keys[a] != keys[b] ? keys[a] < keys[b] : a < b; });
  const auto same = [&](const PreparedObject& a, const PreparedObject& b) {
    if (a.triangle_count != b.triangle_count) return false;
    for (uint64_t t = 0; t < a.triangle_count; ++t) {
      for (int k = 0; k < 3; ++k) {
        if (!(corner(a.first_triangle + t, k) == corner(b.first_triangle + t, k))) return false;
      }
    }
    return true;
  };
  std::vector<uint8_t> repeated(objects.size(), 0);
  for (size_t i = 0; i < order.size(); ++i) {
    // Against those before it that are no repetitions themselves; few share a key.
    for (size_t j = i; j-- > 0 && keys[order[j]] == keys[order[i]] && repeated[order[i]] == 0;) {
      const bool holes = prepared.materials()[objects[order[j]].material].alpha_cutoff >= 0.0f;
      if (repeated[order[j]] == 0 && !holes && same(objects[order[i]], objects[order[j]])) {
        repeated[order[i]] = 1;
      }
    }
  }
  return repeated;
}

}  // namespace farpoint

// Eight vectors side by side, with the operations of vec.h in each lane, to the same bits.
#pragma once

#include <cstddef>

#include "core/base/fp_trap.h"
#include "core/math/simd8.h"
#include "core/math/vec.h"

namespace farpoint {

struct V8 {
  F8 x, y, z;

  V8() = default;  // not set
  V8(F8 x_, F8 y_, F8 z_) : x(x_), y(y_), z(z_) {}
  explicit V8(const Vec3f& v) : x(Set8(v.x)), y(Set8(v.y)), z(Set8(v.z)) {}  // in every lane

  V8 operator+(const V8& o) const { return {x + o.x, y + o.y, z + o.z}; }
  V8 operator-(const V8& o) const { return {x - o.x, y - o.y, z - o.z}; }
  V8 operator*(const V8& o) const { return {x * o.x, y * o.y, z * o.z}; }
  V8 operator*(F8 s) const { return {x * s, y * s, z * s}; }
  V8 operator/(F8 s) const { return {x / s, y / s, z / s}; }
  V8 operator-() const { return {-x, -y, -z}; }

  Vec3f Lane(size_t k) const { return {x[k], y[k], z[k]}; }
  void SetLane(size_t k, const Vec3f& v) {
    x[k] = v.x;
    y[k] = v.y;
    z[k] = v.z;
  }
};

inline F8 Dot(const V8& a, const V8& b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
inline F8 Length2(const V8& v) { return Dot(v, v); }
inline V8 Select8(M8 mask, const V8& yes, const V8& no) {
  return {Select8(mask, yes.x, no.x), Select8(mask, yes.y, no.y), Select8(mask, yes.z, no.z)};
}
inline V8 NormalizeOr(const V8& v, const V8& fallback) {
  const FpTrapPause pause;  // lanes that take the fallback
  const F8 m = Max8(Max8(Abs8(v.x), Abs8(v.y)), Abs8(v.z));
  const V8 s = v / m;
  const F8 length2 = Dot(s, s);
  // At least 1, or a NaN that the largest component did not show.
  const M8 good = (length2 >= Set8(1.0f)) & (m >= Set8(std::numeric_limits<float>::min())) &
                  (m <= Set8(std::numeric_limits<float>::max()));
  return Select8(good, s / Sqrt8(length2), fallback);
}
// Precondition: |v| is neither tiny nor huge.
inline V8 Normalize(const V8& v) { return v / Sqrt8(Dot(v, v)); }

struct Frame8 {
  V8 t, b, n;

  explicit Frame8(const V8& normal) : n(normal) {
    const F8 one = Set8(1.0f);
    // copysign(1, n.z)
    const F8 sign = reinterpret_cast<F8>(_mm256_or_ps(
        _mm256_and_ps(_mm256_set1_ps(-0.0f), reinterpret_cast<__m256>(n.z)), _mm256_set1_ps(1.0f)));
    const F8 a = -one / (sign + n.z);
    const F8 c = n.x * n.y * a;
    t = {one + sign * n.x * n.x * a, sign * c, -sign * n.x};
    b = {c, sign + n.y * n.y * a, -n.y};
  }
  V8 ToWorld(const V8& v_local) const { return t * v_local.x + b * v_local.y + n * v_local.z; }
};

}  // namespace farpoint

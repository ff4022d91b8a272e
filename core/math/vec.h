// Small vectors. Component-wise arithmetic in the written order; nothing is fused or reassociated.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>

namespace farpoint {

template <typename T>
struct Vec3 {
  T x{}, y{}, z{};

  constexpr Vec3() = default;
  constexpr Vec3(T x_, T y_, T z_) : x(x_), y(y_), z(z_) {}
  constexpr explicit Vec3(T s) : x(s), y(s), z(s) {}
  template <typename U>
  constexpr explicit Vec3(const Vec3<U>& v)
      : x(static_cast<T>(v.x)), y(static_cast<T>(v.y)), z(static_cast<T>(v.z)) {}

  constexpr T operator[](int i) const { return i == 0 ? x : i == 1 ? y : z; }
  constexpr T& operator[](int i) { return i == 0 ? x : i == 1 ? y : z; }
  constexpr bool operator==(const Vec3&) const = default;

  constexpr Vec3 operator+(const Vec3& o) const { return {x + o.x, y + o.y, z + o.z}; }
  constexpr Vec3 operator-(const Vec3& o) const { return {x - o.x, y - o.y, z - o.z}; }
  constexpr Vec3 operator*(const Vec3& o) const { return {x * o.x, y * o.y, z * o.z}; }
  constexpr Vec3 operator*(T s) const { return {x * s, y * s, z * s}; }
  constexpr Vec3 operator/(T s) const { return {x / s, y / s, z / s}; }
  constexpr Vec3 operator-() const { return {-x, -y, -z}; }
  constexpr Vec3& operator+=(const Vec3& o) { return *this = *this + o; }
  constexpr Vec3& operator-=(const Vec3& o) { return *this = *this - o; }
  constexpr Vec3& operator*=(T s) { return *this = *this * s; }
  constexpr Vec3& operator*=(const Vec3& o) { return *this = *this * o; }
};

template <typename T>
constexpr Vec3<T> operator*(T s, const Vec3<T>& v) {
  return v * s;
}

using Vec3f = Vec3<float>;
using Vec3d = Vec3<double>;
// Scene-linear Rec. 709.
using Rgb = Vec3<float>;

struct Vec2f {
  float x = 0, y = 0;
  constexpr bool operator==(const Vec2f&) const = default;
};

template <typename T>
constexpr T Dot(const Vec3<T>& a, const Vec3<T>& b) {
  return a.x * b.x + a.y * b.y + a.z * b.z;
}
template <typename T>
constexpr Vec3<T> Cross(const Vec3<T>& a, const Vec3<T>& b) {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}
template <typename T>
constexpr T Length2(const Vec3<T>& v) {
  return Dot(v, v);
}
template <typename T>
T Length(const Vec3<T>& v) {
  return std::sqrt(Dot(v, v));
}
template <typename T>
constexpr T MaxAbs(const Vec3<T>& v) {
  return std::max({v.x < 0 ? -v.x : v.x, v.y < 0 ? -v.y : v.y, v.z < 0 ? -v.z : v.z});
}
template <typename T>
constexpr T MaxComponent(const Vec3<T>& v) {
  return std::max({v.x, v.y, v.z});
}

// v/|v| for any finite v whose largest component is a normal number, whatever its exponent (the
// largest component is divided out first); `fallback` for zero, subnormal or non-finite input.
template <typename T>
Vec3<T> NormalizeOr(const Vec3<T>& v, const Vec3<T>& fallback) {
  const T m = MaxAbs(v);
  if (!(m >= std::numeric_limits<T>::min()) || !(m <= std::numeric_limits<T>::max())) {
    return fallback;
  }
  const Vec3<T> s = v / m;
  const T length2 = Dot(s, s);
  // At least 1, or a NaN that the largest component did not show.
  return length2 >= T(1) ? s / std::sqrt(length2) : fallback;
}
// Precondition: |v| is neither tiny nor huge.
template <typename T>
Vec3<T> Normalize(const Vec3<T>& v) {
  return v / std::sqrt(Dot(v, v));
}

template <typename T>
bool IsFinite(const Vec3<T>& v) {
  return std::isfinite(v.x) && std::isfinite(v.y) && std::isfinite(v.z);
}

template <typename T>
constexpr Vec3<T> Min(const Vec3<T>& a, const Vec3<T>& b) {
  return {std::min(a.x, b.x), std::min(a.y, b.y), std::min(a.z, b.z)};
}
template <typename T>
constexpr Vec3<T> Max(const Vec3<T>& a, const Vec3<T>& b) {
  return {std::max(a.x, b.x), std::max(a.y, b.y), std::max(a.z, b.z)};
}

// Rec. 709 luminance.
constexpr float Luminance(const Rgb& c) { return 0.2126f * c.x + 0.7152f * c.y + 0.0722f * c.z; }

// Axis-aligned box; starts empty (min > max).
template <typename T>
struct Box3 {
  Vec3<T> min{Vec3<T>(std::numeric_limits<T>::infinity())};
  Vec3<T> max{Vec3<T>(-std::numeric_limits<T>::infinity())};

  bool empty() const { return !(min.x <= max.x); }
  void Extend(const Vec3<T>& p) {
    min = Min(min, p);
    max = Max(max, p);
  }
  Vec3<T> Center() const { return (min + max) * T(0.5); }
  T Diagonal() const { return empty() ? T(0) : Length(max - min); }
};
using Box3f = Box3<float>;
using Box3d = Box3<double>;

// An orthonormal frame about a unit normal (Duff et al. 2017, "Building an Orthonormal Basis,
// Revisited", listing 3). Maps local (z up) to world.
struct Frame {
  Vec3f t, b, n;

  explicit Frame(const Vec3f& normal) : n(normal) {
    const float sign = std::copysign(1.0f, n.z);
    const float a = -1.0f / (sign + n.z);
    const float c = n.x * n.y * a;
    t = {1.0f + sign * n.x * n.x * a, sign * c, -sign * n.x};
    b = {c, sign + n.y * n.y * a, -n.y};
  }
  Vec3f ToWorld(const Vec3f& v_local) const {
    return t * v_local.x + b * v_local.y + n * v_local.z;
  }
};

}  // namespace farpoint

// Primary rays of a perspective camera.
#pragma once

#include <optional>

#include "core/accel/ray_accel.h"
#include "core/image/tile_rect.h"
#include "core/math/elementary.h"
#include "core/scene/scene.h"

namespace farpoint {

// Pixel (0, 0) is the top left; x to the right, y down. Square pixels.
class CameraRays {
 public:
  CameraRays(const Camera& camera, const FilmSpec& film, const Vec3d& scene_origin)
      : eye_(camera.eye - scene_origin),
        forward_(camera.forward),
        right_(camera.right),
        up_(camera.up),
        width_(film.width),
        height_(film.height),
        half_height_(DetTan(0.5 * camera.yfov_rad)) {}

  // Relative to the scene's origin.
  Vec3f eye() const { return Vec3f(eye_); }
  // Unit direction through the point (x, y) of the raster, in pixels.
  Vec3f Direction(double x, double y) const {
    const double v = half_height_ * (1.0 - 2.0 * y / height_);
    const double u = half_height_ * (2.0 * x - width_) / height_;
    return Vec3f(Normalize(forward_ + right_ * u + up_ * v));
  }
  // The side of a pixel at the depth of p, metres.
  float FootprintAt(const Vec3f& p) const {
    const double depth = Dot(Vec3d(p) - eye_, forward_);
    return static_cast<float>((depth < 0 ? -depth : depth) * 2.0 * half_height_ / height_);
  }
  // Where p lies in the raster, in pixels, perhaps outside it. False: not before the camera.
  bool RasterOf(const Vec3f& p, float& x, float& y) const {
    const Vec3d d = Vec3d(p) - eye_;
    const double depth = Dot(d, forward_);
    if (!(depth > 0)) return false;
    const double scale = height_ / (2 * half_height_ * depth);
    const double u = Dot(d, right_) * scale, v = Dot(d, up_) * scale;
    constexpr double kFar = 1 << 20;  // of a raster
    if (!(u < kFar && u > -kFar && v < kFar && v > -kFar)) return false;
    x = static_cast<float>(0.5 * width_ + u);
    y = static_cast<float>(0.5 * height_ - v);
    return true;
  }
  // Distance along the camera's axis.
  float Depth(const Vec3f& p) const { return static_cast<float>(Dot(Vec3d(p) - eye_, forward_)); }

 private:
  Vec3d eye_, forward_, right_, up_;
  double width_, height_, half_height_;
};

// What an eye sees along the unit direction `w`: the nearest hit, but none within the offset of the
// surface that is hit.
// An eye that lies on a surface, exactly or by its rounding, sees what lies before it.
inline std::optional<RayHit> FirstSeen(const RayAccel& accel, const Vec3f& eye, const Vec3f& w) {
  std::optional<RayHit> hit = accel.Intersect(eye, w);
  if (!hit) return hit;
  const float offset =
      accel.SurfaceOffsetM(hit->triangle, eye, accel.scene().GeometricNormal(hit->triangle));
  if (hit->t > offset) return hit;
  hit = accel.Intersect(eye + w * offset, w);
  if (hit) hit->t += offset;
  return hit;
}

}  // namespace farpoint

#include "core/render/camera_rays.h"

#include <gtest/gtest.h>

#include <cmath>

#include "core/base/executor.h"
#include "core/scene/prepared_scene.h"
#include "core/scene/procedural.h"

namespace farpoint {
namespace {

FilmSpec Whole(int width, int height) { return {width, height, {0, 0, width, height}}; }

void ExpectDirection(const Vec3f& w, const Vec3d& expected) {
  EXPECT_NEAR(w.x, expected.x, 1e-6);
  EXPECT_NEAR(w.y, expected.y, 1e-6);
  EXPECT_NEAR(w.z, expected.z, 1e-6);
}

// Looks along -z with x to the right and y up.
Camera DefaultCamera(double yfov_rad) {
  Camera camera;
  camera.yfov_rad = yfov_rad;
  return camera;
}

TEST(CameraRays, TheCentreOfTheRasterIsForward) {
  for (const auto& [w, h] : {std::pair{100, 50}, std::pair{33, 77}, std::pair{1, 1}}) {
    const CameraRays rays(DefaultCamera(1.0), Whole(w, h), {});
    ExpectDirection(rays.Direction(0.5 * w, 0.5 * h), {0, 0, -1});
  }
}

TEST(CameraRays, XGrowsToTheRightAndYDown) {
  const CameraRays rays(DefaultCamera(1.0), Whole(64, 64), {});
  EXPECT_GT(rays.Direction(40, 32).x, 0);
  EXPECT_LT(rays.Direction(20, 32).x, 0);
  EXPECT_LT(rays.Direction(32, 40).y, 0);
  EXPECT_GT(rays.Direction(32, 20).y, 0);
  // Nothing else moves.
  EXPECT_EQ(rays.Direction(40, 32).y, 0);
  EXPECT_EQ(rays.Direction(32, 40).x, 0);
}

TEST(CameraRays, CornersLieAtTheEdgesOfTheFieldOfView) {
  // Vertical half angle 30°, twice as wide as high: tan of the horizontal half angle 2 tan 30°.
  const double t = std::tan(kPi / 6);
  const CameraRays rays(DefaultCamera(kPi / 3), Whole(200, 100), {});
  ExpectDirection(rays.Direction(0, 0), Normalize(Vec3d(-2 * t, t, -1)));
  ExpectDirection(rays.Direction(200, 0), Normalize(Vec3d(2 * t, t, -1)));
  ExpectDirection(rays.Direction(0, 100), Normalize(Vec3d(-2 * t, -t, -1)));
  ExpectDirection(rays.Direction(200, 100), Normalize(Vec3d(2 * t, -t, -1)));
}

TEST(CameraRays, TheFieldOfViewIsTheHeights) {
  for (const double yfov_rad : {0.01, 0.7, 2.0, 3.0}) {
    for (const int width : {1, 50, 400}) {
      const CameraRays rays(DefaultCamera(yfov_rad), Whole(width, 100), {});
      const Vec3d up(rays.Direction(0.5 * width, 0)), down(rays.Direction(0.5 * width, 100));
      EXPECT_NEAR(std::atan2(Length(Cross(up, down)), Dot(up, down)), yfov_rad, 1e-6);
    }
  }
}

TEST(CameraRays, PixelsAreSquare) {
  // Equal steps on the image plane: w / (w · forward) is linear in x and y, with one step for both.
  const CameraRays rays(DefaultCamera(0.9), Whole(320, 180), {});
  const auto plane = [&](double x, double y) {
    const Vec3d w(rays.Direction(x, y));
    return w / -w.z;
  };
  const double step = 2 * std::tan(0.45) / 180;
  for (const double x : {0.5, 100.0, 319.5}) {
    for (const double y : {0.5, 77.0, 179.5}) {
      EXPECT_NEAR(plane(x + 1, y).x - plane(x, y).x, step, 1e-6);
      EXPECT_NEAR(plane(x, y).y - plane(x, y + 1).y, step, 1e-6);
      EXPECT_NEAR(plane(x + 1, y).y, plane(x, y).y, 1e-6);
    }
  }
}

TEST(CameraRays, TheCropChangesNothing) {
  const Camera camera = DefaultCamera(0.8);
  const CameraRays whole(camera, Whole(64, 48), {});
  const CameraRays crop(camera, {64, 48, {10, 20, 30, 40}}, {});
  EXPECT_EQ(whole.Direction(12.5, 33.5), crop.Direction(12.5, 33.5));
}

TEST(CameraRays, FollowTheCamerasFrame) {
  // Cornell's camera: along +z, y up, so that right is -x.
  Camera camera;
  camera.forward = {0, 0, 1};
  camera.right = {-1, 0, 0};
  camera.yfov_rad = 0.6;
  const CameraRays rays(camera, Whole(10, 10), {});
  const double t = std::tan(0.3);
  ExpectDirection(rays.Direction(10, 0), Normalize(Vec3d(-t, t, 1)));
}

TEST(CameraRays, TheEyeAndTheDepthAreRelativeToTheScenesOrigin) {
  Camera camera = DefaultCamera(1.0);
  // Far from zero, where single precision would be a metre wrong.
  camera.eye = {1e7 + 0.25, 2, -3e7 + 0.5};
  const CameraRays rays(camera, Whole(8, 8), {1e7, 0, -3e7});
  EXPECT_EQ(rays.eye(), Vec3f(0.25f, 2, 0.5f));
  // Along the axis, whatever the position across it; negative behind the eye.
  EXPECT_FLOAT_EQ(rays.Depth({0.25f, 2, -4}), 4.5f);
  EXPECT_FLOAT_EQ(rays.Depth({100, -7, -4}), 4.5f);
  EXPECT_FLOAT_EQ(rays.Depth({0, 0, 2}), -1.5f);
  const Vec3f w = rays.Direction(1, 7);
  EXPECT_NEAR(rays.Depth(rays.eye() + w * 10.0f), -10 * w.z, 1e-5);
}

TEST(CameraRays, DirectionsAreUnit) {
  const CameraRays rays(DefaultCamera(2.8), Whole(1000, 10), {});
  for (const double x : {0.0, 1.0, 500.0, 1000.0}) {
    for (const double y : {0.0, 5.0, 10.0}) {
      EXPECT_NEAR(Length(rays.Direction(x, y)), 1, 2e-7);
    }
  }
}

TEST(FirstSeen, AnEyeOnASurfaceSeesWhatLiesBeforeIt) {
  // The floor of the box, looked at from a point of it: up to the ceiling, and down to nothing.
  Executor executor(1);
  const auto scene = PreparedScene::Prepare(MakeCornellBox(), executor).value();
  const auto accel = RayAccel::Build(scene).value();
  const Vec3f eye(Vec3d(2, 0, 3) - scene->origin());
  const auto below = accel->Intersect(eye + Vec3f(0, 1, 0), {0, -1, 0});
  ASSERT_TRUE(below.has_value());
  const float offset = accel->SurfaceOffsetM(below->triangle, eye, {0, 1, 0});
  for (const Vec3f& on : {eye, eye - Vec3f(0, 0.25f, 0) * offset}) {
    const auto up = FirstSeen(*accel, on, {0, 1, 0});
    ASSERT_TRUE(up.has_value());
    EXPECT_NEAR(up->t, 5.488, 1e-4);
    EXPECT_FALSE(FirstSeen(*accel, on, {0, -1, 0}).has_value());
  }
  // Nothing is clipped beyond it.
  const auto floor = FirstSeen(*accel, eye + Vec3f(0, 4, 0) * offset, {0, -1, 0});
  ASSERT_TRUE(floor.has_value());
  EXPECT_NEAR(floor->t / offset, 4, 0.5);
}

}  // namespace
}  // namespace farpoint

// Light must not pass through walls: single-sided ones, whose unlit backs count as occluders
// although closed objects' backs do not.
#include "tests/render/render_helpers.h"

namespace farpoint {
namespace {

// A floor and a ceiling cut into two halves by a wall of one sheet, both halves closed by outer
// walls; the lamp is in the half x < 0. `facing` turns the dividing sheet's front.
Scene TwoRooms(bool facing_lamp) {
  Scene scene;
  constexpr float w = 2, h = 1, d = 1;
  const auto quad = [&](Vec3f a, Vec3f b, Vec3f c, Vec3f e) {
    AddLambert(scene, QuadMesh(a, b, c, e), 0.8f);
  };
  quad({-w, 0, d}, {w, 0, d}, {w, 0, -d}, {-w, 0, -d});    // floor, up
  quad({-w, h, -d}, {w, h, -d}, {w, h, d}, {-w, h, d});    // ceiling, down
  quad({-w, 0, -d}, {w, 0, -d}, {w, h, -d}, {-w, h, -d});  // back
  quad({-w, 0, d}, {-w, h, d}, {w, h, d}, {w, 0, d});      // front
  quad({-w, 0, d}, {-w, 0, -d}, {-w, h, -d}, {-w, h, d});  // left
  quad({w, 0, -d}, {w, 0, d}, {w, h, d}, {w, h, -d});      // right
  if (facing_lamp) {
    quad({0, 0, -d}, {0, 0, d}, {0, h, d}, {0, h, -d});
  } else {
    quad({0, 0, d}, {0, 0, -d}, {0, h, -d}, {0, h, d});
  }
  PunctualLight lamp;
  lamp.position = {-1, 0.8, 0};
  lamp.intensity = Rgb(1, 1, 1);
  scene.lights.push_back(lamp);
  return scene;
}

double MeanIrradiance(const Scene& scene, const Camera& camera, Integrator integrator) {
  RenderSettings s;
  s.integrator = integrator;
  s.points = 40000;
  s.layers = {Layer::kIrradiance};
  const Film film = RenderScene(scene, camera, Whole(32, 32), s).film;
  double sum = 0;
  for (const float v : film.Plane(Layer::kIrradiance, 0)) sum += v;
  return sum / 1024;
}

TEST(Leak, ADarkRoomBehindASheetStaysDark) {
  const Camera dark = LookAt({1.8, 0.6, 0.8}, {0, 0.3, -0.5}, {0, 1, 0}, 70);
  const Camera bright = LookAt({-1.8, 0.6, 0.8}, {0, 0.3, -0.5}, {0, 1, 0}, 70);
  for (const bool facing : {false, true}) {
    const Scene scene = TwoRooms(facing);
    for (const Integrator integrator : {Integrator::kFpbgi, Integrator::kPbgi}) {
      const double lit = MeanIrradiance(scene, bright, integrator);
      const double leak = MeanIrradiance(scene, dark, integrator);
      EXPECT_GT(lit, 0.1);
      EXPECT_LT(leak, 0.01 * lit) << NameOf(integrator) << " sheet facing lamp: " << facing;
    }
  }
}

// A closed ball of many triangles under a sky, seen from within. Rays of a bundle slip out of it,
// one in half a million or so, and must not bring the sky in.
TEST(Leak, ADarkBallOfManyTrianglesUnderASkyIsBlack) {
  Mesh mesh;
  constexpr int kRings = 200, kSegments = 2 * kRings;
  for (int i = 0; i <= kRings; ++i) {
    for (int j = 0; j < kSegments; ++j) {
      const SinCos t = DetSinCos(kPi * i / kRings), p = DetSinCos(2 * kPi * j / kSegments);
      const double r = i == 0 || i == kRings ? 0.0 : t.sin;
      mesh.positions.push_back(Vec3f(Vec3d(r * p.cos, t.cos, r * p.sin) * 3.3));
    }
  }
  const auto at = [&](int i, int j) {
    return static_cast<uint32_t>(i * kSegments + j % kSegments);
  };
  for (int i = 0; i < kRings; ++i) {
    for (int j = 0; j < kSegments; ++j) {
      if (i > 0) mesh.triangles.push_back({at(i, j), at(i, j + 1), at(i + 1, j)});
      if (i + 1 < kRings) {
        mesh.triangles.push_back({at(i, j + 1), at(i + 1, j + 1), at(i + 1, j)});
      }
    }
  }
  Scene scene;
  AddLambert(scene, std::move(mesh), 0.8f);
  scene.environment.sky = Rgb(1000, 1000, 1000);
  RenderSettings s;
  s.quality = Quality::kFine;
  s.points = 20000;
  s.layers = {Layer::kIrradiance, Layer::kDirectIrradiance};
  const Rendered image = RenderScene(scene, LookAt({0.1, -0.2, 0.3}, {1, 0.3, 0.2}, {0, 1, 0}, 100),
                                     Whole(640, 640), s);
  EXPECT_GT(image.stats.counts.at("gather_rays"), 3'000'000u);
  for (const Layer layer : s.layers) {
    for (const float v : image.film.Plane(layer, 0)) ASSERT_EQ(v, 0.0f) << InfoOf(layer).name;
  }
}

}  // namespace
}  // namespace farpoint

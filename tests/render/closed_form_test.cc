// Renders against closed forms. The first oracle of all: no other renderer is trusted here.
#include "tests/render/render_helpers.h"

namespace farpoint {
namespace {

RenderSettings PathTracer(uint32_t paths) {
  RenderSettings s;
  s.integrator = Integrator::kPt;
  s.paths = paths;
  s.layers = {Layer::kIrradiance, Layer::kDirectIrradiance, Layer::kStdError, Layer::kBeauty};
  return s;
}

// Mean over the image of a layer's first channel, and the standard error of that mean from the
// pixels' own errors.
struct Mean {
  double value = 0, standard_error = 0;
};
Mean MeanOf(const Film& film) {
  const auto e = film.Plane(Layer::kIrradiance, 0);
  Mean m;
  for (const float v : e) m.value += v;
  m.value /= static_cast<double>(e.size());
  if (film.Has(Layer::kStdError)) {
    for (const float v : film.Plane(Layer::kStdError, 0)) {
      m.standard_error += static_cast<double>(v) * static_cast<double>(v);
    }
    m.standard_error = std::sqrt(m.standard_error) / static_cast<double>(e.size());
  }
  return m;
}

// In a closed box that emits L everywhere one bounce gives E = pi rho L.
TEST(Furnace, PathTracerAgreesWithinItsStandardError) {
  const Scene scene = MakeFurnace(0.6f, 1.5f);
  const Rendered r = RenderScene(scene, scene.cameras[0], Whole(32, 32), PathTracer(256));
  const double expected = kPi * 0.6 * 1.5;
  const Mean m = MeanOf(r.film);
  EXPECT_GT(m.standard_error, 0.0);
  EXPECT_NEAR(m.value, expected, 4 * m.standard_error);
  EXPECT_NEAR(m.value, expected, 0.005 * expected);
  // Direct: the whole hemisphere emits L. Twelve emitting triangles chosen by power are a hard case
  // for 32 shadow rays: single pixels are off by up to a third, the mean is not.
  double direct = 0;
  for (const float e : r.film.Plane(Layer::kDirectIrradiance, 0)) {
    EXPECT_NEAR(e, kPi * 1.5, 0.4 * kPi * 1.5);
    direct += e;
  }
  EXPECT_NEAR(direct / 1024, kPi * 1.5, 0.01 * kPi * 1.5);
}

TEST(Furnace, PointBasedIntegratorsAgreeWithinOnePercent) {
  const Scene scene = MakeFurnace(0.6f, 1.5f);
  const double expected = kPi * 0.6 * 1.5;
  for (const Integrator integrator : {Integrator::kPbgi, Integrator::kFpbgi}) {
    RenderSettings s;
    s.integrator = integrator;
    s.points = 60000;
    // Walls that are light all over are the hardest case for the surfels' few shadow rays; here the
    // gather is on trial.
    s.light_samples = 256;
    s.layers = {Layer::kIrradiance};
    const Rendered r = RenderScene(scene, scene.cameras[0], Whole(24, 24), s);
    const Mean m = MeanOf(r.film);
    EXPECT_NEAR(m.value, expected, 0.01 * expected) << NameOf(integrator);
    for (const float e : r.film.Plane(Layer::kIrradiance, 0)) {
      EXPECT_NEAR(e, expected, 0.06 * expected) << NameOf(integrator);
    }
  }
}

// About the origin, with smooth normals that point outwards.
Mesh SphereMesh(float radius, int rings, int segments) {
  Mesh sphere;
  for (int i = 0; i <= rings; ++i) {
    for (int j = 0; j < segments; ++j) {
      const SinCos t = DetSinCos(kPi * i / rings), p = DetSinCos(2 * kPi * j / segments);
      sphere.normals.push_back({static_cast<float>(t.sin * p.cos), static_cast<float>(t.cos),
                                static_cast<float>(t.sin * p.sin)});
      sphere.positions.push_back(sphere.normals.back() * radius);
    }
  }
  const auto at = [&](int i, int j) { return static_cast<uint32_t>(i * segments + j % segments); };
  for (int i = 0; i < rings; ++i) {
    for (int j = 0; j < segments; ++j) {
      if (i > 0) sphere.triangles.push_back({at(i, j), at(i, j + 1), at(i + 1, j)});
      if (i + 1 < rings) sphere.triangles.push_back({at(i, j + 1), at(i + 1, j + 1), at(i + 1, j)});
    }
  }
  return sphere;
}

// A point light at the centre of a sphere of radius R and albedo rho: E_direct = I / R² and, as the
// form factor between any two points of a sphere is the same, E_indirect = rho I / R².
TEST(SphereWithLight, IndirectIsRhoTimesDirect) {
  constexpr float kRadius = 2.0f, kRho = 0.5f, kIntensity = 12.0f;
  const Mesh sphere = SphereMesh(kRadius, 96, 192);
  Scene scene;
  AddLambert(scene, sphere, kRho);
  PunctualLight light;
  light.intensity = Rgb(kIntensity, kIntensity, kIntensity);
  scene.lights.push_back(light);
  const Camera camera = LookAt({0.3, 0.1, 0.2}, {2, 0.5, 0.4}, {0, 1, 0}, 60);
  const double direct = kIntensity / (kRadius * kRadius);

  const Rendered pt = RenderScene(scene, camera, Whole(32, 32), PathTracer(256));
  for (const float e : pt.film.Plane(Layer::kDirectIrradiance, 0)) {
    EXPECT_NEAR(e, direct, 0.01 * direct);
  }
  const Mean m = MeanOf(pt.film);
  // The polyhedron lies inside the sphere: up to 0.1 % nearer to the light.
  EXPECT_NEAR(m.value, kRho * direct, 4 * m.standard_error + 0.002 * direct);

  for (const Integrator integrator : {Integrator::kPbgi, Integrator::kFpbgi}) {
    RenderSettings s;
    s.integrator = integrator;
    s.points = 60000;
    s.layers = {Layer::kIrradiance};
    const Rendered r = RenderScene(scene, camera, Whole(16, 16), s);
    EXPECT_NEAR(MeanOf(r.film).value, kRho * direct, 0.015 * kRho * direct) << NameOf(integrator);
  }
}

// A disc of radius a lit by the sun, over a small parallel receiver on its axis at distance h:
// E = rho E_sun cos(theta) a² / (a² + h²).
TEST(ParallelDiscs, HaveTheirFormFactor) {
  constexpr float kA = 1.0f, kH = 1.5f, kRho = 0.7f, kSun = 3.0f;
  Scene scene;
  AddLambert(scene, DiscMesh({0, 0, 0}, kA, 512, +1), kRho);
  AddLambert(scene, DiscMesh({0, 0, kH}, 0.01f, 32, -1), 0.5f);
  PunctualLight sun;
  sun.kind = PunctualKind::kDirectional;
  sun.direction = Normalize(Vec3d(0.5, 0, -1));
  sun.intensity = Rgb(kSun, kSun, kSun);
  scene.lights.push_back(sun);
  // From beside, a narrow view of the small disc's lower side.
  const Camera camera = LookAt({0.5, 0, 0.5}, {0, 0, kH}, {0, 1, 0}, 0.2);
  const double cosine = 1.0 / std::sqrt(1.25);
  const double expected = kRho * kSun * cosine * kA * kA / (kA * kA + kH * kH);
  const Rendered pt = RenderScene(scene, camera, Whole(8, 8), PathTracer(4096));
  const Mean m = MeanOf(pt.film);
  EXPECT_NEAR(m.value, expected, 4 * m.standard_error + 2e-3 * expected);
  EXPECT_LT(m.standard_error, 0.01 * expected);
  for (const Integrator integrator : {Integrator::kPbgi, Integrator::kFpbgi}) {
    RenderSettings s;
    s.integrator = integrator;
    s.points = 20000;
    s.layers = {Layer::kIrradiance};
    const Rendered r = RenderScene(scene, camera, Whole(8, 8), s);
    EXPECT_NEAR(MeanOf(r.film).value, expected, 0.04 * expected) << NameOf(integrator);
  }
}

// Outside is nothing: a sky of radiance L over an open floor gives E_direct = pi L, and the floor
// sees no other surface.
TEST(Sky, IsDirectLightOnly) {
  Scene scene;
  AddLambert(scene, QuadMesh({-5, 0, 5}, {5, 0, 5}, {5, 0, -5}, {-5, 0, -5}), 0.8f);
  scene.environment.sky = Rgb(2, 1, 0.5f);
  RenderSettings s;
  s.layers = {Layer::kDirectIrradiance, Layer::kIrradiance, Layer::kEmission, Layer::kBeauty};
  s.points = 2000;
  const Camera camera = LookAt({0, 2, 4}, {0, 0.5, 0}, {0, 1, 0}, 60);
  const Rendered r = RenderScene(scene, camera, Whole(32, 32), s);
  EXPECT_NEAR(r.film.Get(Layer::kDirectIrradiance, 0, 16, 28), 2 * kPi, 1e-4);
  EXPECT_EQ(r.film.Get(Layer::kIrradiance, 0, 16, 28), 0.0f);
  EXPECT_EQ(r.film.Get(Layer::kEmission, 0, 16, 0), 2.0f);  // the background
  EXPECT_EQ(r.film.Get(Layer::kBeauty, 3, 16, 0), 0.0f);
  EXPECT_EQ(r.film.Get(Layer::kBeauty, 3, 16, 28), 1.0f);
}

// A wall of infinite length hides of the sky what lies below its edge: at distance d from a wall of
// height h the floor's openness is pi (1 + cos a) / 2, tan a = h / d. Records see it with their own
// rays, shadow rays (of --clusters N) are on their own: both agree with the closed form, and
// records err by half as much.
TEST(Sky, RecordsAndShadowRaysSeeAsMuch) {
  Scene scene;
  AddLambert(scene, QuadMesh({-500, 0, 10}, {500, 0, 10}, {500, 0, 0}, {-500, 0, 0}), 0.5f);
  AddLambert(scene, QuadMesh({-500, 0, 0}, {500, 0, 0}, {500, 2, 0}, {-500, 2, 0}), 0.0f);
  scene.environment.sky = Rgb(1, 1, 1);
  const Camera camera = LookAt({0, 8, 3}, {0, 0, 2.9}, {0, 0, -1}, 40);
  double error[2];
  for (const bool records : {true, false}) {
    RenderSettings s;
    s.points = 4000;
    s.layers = {Layer::kDirectIrradiance, Layer::kPosition, Layer::kNormal};
    if (!records) s.clusters = 16;
    const Rendered r = RenderScene(scene, camera, Whole(96, 96), s);
    double sum = 0, square = 0;
    int n = 0;
    for (int y = 0; y < 96; ++y) {
      for (int x = 0; x < 96; ++x) {
        if (r.film.Get(Layer::kNormal, 1, x, y) < 0.5f) continue;
        const double d = static_cast<double>(r.film.Get(Layer::kPosition, 2, x, y));
        if (!(d > 0.1)) continue;
        const double truth = kPi * (1 + d / std::sqrt(d * d + 4)) / 2;
        const double e =
            static_cast<double>(r.film.Get(Layer::kDirectIrradiance, 0, x, y)) / truth - 1;
        sum += e;
        square += e * e;
        ++n;
      }
    }
    ASSERT_GT(n, 5000);
    EXPECT_NEAR(sum / n, 0, 0.006) << records;
    error[records ? 0 : 1] = std::sqrt(square / n);
  }
  EXPECT_LT(error[0], 0.01);
  EXPECT_LT(error[0], 0.7 * error[1]);
}

// Nothing shadows a sphere that is alone under a sky: pi L everywhere, however it is curved.
TEST(Sky, ASphereIsAsBrightEverywhere) {
  Scene scene;
  AddLambert(scene, SphereMesh(1, 24, 48), 0.5f);
  scene.environment.sky = Rgb(2, 2, 2);
  RenderSettings s;
  s.points = 2000;
  s.layers = {Layer::kDirectIrradiance, Layer::kDepth};
  const Rendered r =
      RenderScene(scene, LookAt({0, 0, 4}, {0, 0, 0}, {0, 1, 0}, 40), Whole(64, 64), s);
  double sum = 0, worst = 0;
  int n = 0;
  for (int y = 0; y < 64; ++y) {
    for (int x = 0; x < 64; ++x) {
      if (!std::isfinite(r.film.Get(Layer::kDepth, 0, x, y))) continue;
      const double e =
          static_cast<double>(r.film.Get(Layer::kDirectIrradiance, 0, x, y)) / (2 * kPi) - 1;
      sum += e;
      worst = std::max(worst, std::fabs(e));
      ++n;
    }
  }
  ASSERT_GT(n, 1000);
  EXPECT_NEAR(sum / n, 0, 0.005);
  EXPECT_LT(worst, 0.06);
}

}  // namespace
}  // namespace farpoint

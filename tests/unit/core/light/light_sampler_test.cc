#include "core/light/light_sampler.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include "core/base/executor.h"
#include "core/math/elementary.h"
#include "core/math/sampling.h"
#include "core/scene/procedural.h"
#include "tests/unit/core/accel/brute_force.h"
#include "tests/unit/core/scene/scene_test_util.h"

namespace farpoint {
namespace {

// A scene with its light; points are given in the world.
class Lit {
 public:
  explicit Lit(const Scene& description, bool gloss = false) {
    Executor executor(1);
    PrepareOptions options;
    options.gloss = gloss;
    auto prepared = PreparedScene::Prepare(description, executor, options);
    EXPECT_TRUE(prepared.ok()) << prepared.status();
    accel_ = RayAccel::Build(*prepared).value();
    sampler_ = std::make_unique<const LightSampler>(accel_);
  }

  const PreparedScene& scene() const { return accel_->scene(); }
  const RayAccel& accel() const { return *accel_; }
  const LightSampler& sampler() const { return *sampler_; }
  // Whether something lies on the way from p by all but the end of v.
  bool Hides(const Vec3d& p_world, const Vec3f& n, const Vec3d& v) const {
    const double d = Length(v);
    return accel_->Occluded(At(Local(p_world), n, n).Leave(), Vec3f(v / d),
                            static_cast<float>(d * (1 - 1e-4)));
  }
  // A point that need not lie on a triangle.
  SurfacePoint At(const Vec3f& p, const Vec3f& ng, const Vec3f& n) const {
    return {p, ng, n, offset_m()};
  }
  float offset_m() const { return scene().diagonal_m() * 0x1p-19f; }
  Vec3f Local(const Vec3d& p_world) const { return Vec3f(p_world - scene().origin()); }

  Rgb E(const Vec3d& p_world, const Vec3f& n, uint32_t samples = 64, uint64_t key = 1) const {
    LightCounters counters;
    return E(p_world, n, samples, key, counters);
  }
  Rgb E(const Vec3d& p_world, const Vec3f& n, uint32_t samples, uint64_t key,
        LightCounters& counters) const {
    return sampler_->Irradiance(At(Local(p_world), n, n), samples, key, 0, 0, counters);
  }

 private:
  std::shared_ptr<const RayAccel> accel_;
  std::unique_ptr<const LightSampler> sampler_;
};

// A mean and its standard error.
class Estimate {
 public:
  void Add(double x) {
    ++count_;
    const double d = x - mean_;
    mean_ += d / count_;
    square_ += d * (x - mean_);
  }
  double mean() const { return mean_; }
  double variance() const { return square_ / (count_ - 1); }
  double standard_error() const { return std::sqrt(variance() / count_); }

 private:
  double count_ = 0, mean_ = 0, square_ = 0;
};

// The first channel over independent keys.
Estimate OverKeys(const Lit& lit, const Vec3d& p_world, const Vec3f& n, int keys,
                  uint32_t samples) {
  Estimate e;
  for (int k = 0; k < keys; ++k) {
    const float x = lit.E(p_world, n, samples, HashKey(77, static_cast<uint64_t>(k))).x;
    e.Add(static_cast<double>(x));
  }
  return e;
}

using Quad = std::array<Vec3d, 4>;

void AddQuad(Scene& scene, const Quad& q, const Material& material) {
  Mesh mesh;
  for (const Vec3d& v : q) mesh.positions.push_back(Vec3f(v));
  mesh.uv[0] = {{0, 0}, {1, 0}, {1, 1}, {0, 1}};
  mesh.triangles = {{0, 1, 2}, {0, 2, 3}};
  mesh.material = static_cast<int32_t>(scene.materials.size());
  scene.materials.push_back(material);
  scene.instances.push_back({"quad", static_cast<uint32_t>(scene.meshes.size()), {}});
  scene.meshes.push_back(std::move(mesh));
}

Material Emitting(float radiance) {
  Material material;
  material.emission = Rgb(radiance);
  return material;
}

Quad FloorQuad(double half, double y = 0) {
  return {Vec3d(-half, y, half), Vec3d(half, y, half), Vec3d(half, y, -half),
          Vec3d(-half, y, -half)};
}

constexpr Vec3f kUp{0, 1, 0}, kDown{0, -1, 0};

// Irradiance from a polygon of radiance 1 above the horizon: Lambert 1760, in the form of Baum,
// Rushmeier and Winget 1989, E = 1/2 |Σ_i β_i n·Γ_i|, β_i the angle under which edge i is seen and
// Γ_i the unit normal of the plane through it and the point.
template <size_t N>
double PolygonIrradiance(const std::array<Vec3d, N>& polygon, const Vec3d& p, const Vec3d& n) {
  double sum = 0;
  for (size_t i = 0; i < N; ++i) {
    const Vec3d a = polygon[i] - p, b = polygon[(i + 1) % N] - p;
    const Vec3d normal = Cross(a, b);
    const double length = Length(normal);
    sum += std::atan2(length, Dot(a, b)) * Dot(n, normal / length);
  }
  return 0.5 * std::fabs(sum);
}

// --- Punctual lights ---

Scene FloorWithLight(const PunctualLight& light, double half = 5) {
  Scene scene;
  AddQuad(scene, FloorQuad(half), Material());
  scene.lights.push_back(light);
  return scene;
}

TEST(PointLight, IsIntensityTimesCosineOverSquaredDistance) {
  PunctualLight light;
  light.position = {1, 3, -0.5};
  light.intensity = {7, 0.5f, 100};
  const Lit lit(FloorWithLight(light));
  EXPECT_TRUE(lit.sampler().any_light());
  EXPECT_FALSE(lit.sampler().has_emitters());
  EXPECT_FALSE(lit.sampler().has_sky());
  TestRandom random(1);
  for (int i = 0; i < 200; ++i) {
    const Vec3d p(random.Uniform(-4, 4), 0, random.Uniform(-4, 4));
    const Vec3d v = light.position - p;
    const double f = v.y / Length(v) / Length2(v);
    LightCounters counters;
    const Rgb e = lit.E(p, kUp, 16, 3, counters);
    for (int c = 0; c < 3; ++c) {
      const double expected = static_cast<double>(light.intensity[c]) * f;
      EXPECT_NEAR(e[c], expected, 1e-5 * expected);
    }
    EXPECT_EQ(counters.rays, 1u);  // whatever the number of samples
    EXPECT_EQ(lit.E(p, kDown), Rgb());
  }
}

TEST(PointLight, RangeIsGltfsWindow) {
  PunctualLight light;
  light.intensity = Rgb(8);
  light.range_m = 2.5;
  for (const double d : {0.5, 1.0, 2.0, 2.4, 2.499, 2.501, 4.0}) {
    light.position = {0, d, 0};
    const Lit lit(FloorWithLight(light));
    LightCounters counters;
    const double window = std::max(0.0, 1 - std::pow(d / light.range_m, 4));
    const double e = static_cast<double>(lit.E({0, 0, 0}, kUp, 1, 1, counters).x);
    EXPECT_NEAR(e, 8 / (d * d) * window, 1e-5 * 8 / (d * d)) << d;
    EXPECT_EQ(counters.rays, d < light.range_m ? 1u : 0u) << d;
  }
}

TEST(PointLight, IsShadowedByWhatLiesBetweenOnly) {
  PunctualLight light;
  light.position = {0, 2, 0};
  light.intensity = Rgb(4);
  const auto e_with_quad_at = [&](double y) {
    Scene scene = FloorWithLight(light);
    AddQuad(scene, FloorQuad(1, y), Material());
    return Lit(scene).E({0, 0, 0}, kUp).x;
  };
  EXPECT_EQ(e_with_quad_at(1.0), 0);
  EXPECT_EQ(e_with_quad_at(1.999), 0);
  EXPECT_NEAR(e_with_quad_at(2.001), 1, 1e-5);
  EXPECT_NEAR(e_with_quad_at(2.0), 1, 1e-5);  // a light upon a ceiling
  EXPECT_NEAR(e_with_quad_at(-1.0), 1, 1e-5);
}

TEST(SpotLight, FalloffIsGltfs) {
  PunctualLight light;
  light.kind = PunctualKind::kSpot;
  light.position = {0, 2, 0};
  light.direction = {0, -1, 0};
  light.intensity = Rgb(5);
  light.inner_cone_rad = 0.3;
  light.outer_cone_rad = 0.6;
  const Lit lit(FloorWithLight(light));
  const double cos_inner = std::cos(0.3), cos_outer = std::cos(0.6);
  for (const double angle_rad :
       {0.0, 0.1, 0.2999, 0.3001, 0.35, 0.45, 0.55, 0.5999, 0.6001, 0.7, 1.0}) {
    const double cosine = std::cos(angle_rad);
    const double f = std::clamp((cosine - cos_outer) / (cos_inner - cos_outer), 0.0, 1.0);
    const Vec3d p(2 * std::tan(angle_rad), 0, 0);
    const double d = 2 / cosine, expected = 5 * f * f * cosine / (d * d);
    LightCounters counters;
    EXPECT_NEAR(lit.E(p, kUp, 1, 1, counters).x, expected, 1e-5) << angle_rad;
    EXPECT_EQ(counters.rays, angle_rad < 0.6 ? 1u : 0u) << angle_rad;
    EXPECT_EQ(counters.skipped_facing_away, angle_rad < 0.6 ? 0u : 1u) << angle_rad;
  }
  // With equal cones the edge is sharp.
  light.inner_cone_rad = light.outer_cone_rad;
  const Lit sharp(FloorWithLight(light));
  EXPECT_NEAR(sharp.E({2 * std::tan(0.599), 0, 0}, kUp).x, 5 * std::pow(std::cos(0.599), 3) / 4,
              1e-5);
  EXPECT_EQ(sharp.E({2 * std::tan(0.601), 0, 0}, kUp).x, 0);
}

TEST(DirectionalLight, IsIrradianceTimesCosine) {
  PunctualLight light;
  light.kind = PunctualKind::kDirectional;
  light.direction = Vec3d(0.3, -0.8, 0.1);  // of any length
  light.intensity = {3, 2, 1};
  Scene scene = FloorWithLight(light);
  const double cosine = 0.8 / Length(light.direction);
  const Rgb e = Lit(scene).E({1, 0, 2}, kUp);
  EXPECT_NEAR(e.x, 3 * cosine, 1e-5);
  EXPECT_NEAR(e.y, 2 * cosine, 1e-5);
  EXPECT_NEAR(e.z, 1 * cosine, 1e-5);
  EXPECT_EQ(Lit(scene).E({1, 0, 2}, kDown), Rgb());
  AddQuad(scene, FloorQuad(100, 50), Material());
  EXPECT_EQ(Lit(scene).E({1, 0, 2}, kUp), Rgb());
}

// --- Emitters ---

// Within four standard errors of the mean and what single precision and the surface offset leave.
void ExpectIrradiance(const Lit& lit, const Vec3d& p, const Vec3f& n, double expected,
                      uint32_t samples = 64, int keys = 64) {
  const Estimate e = OverKeys(lit, p, n, keys, samples);
  EXPECT_NEAR(e.mean(), expected, 4 * e.standard_error() + 2e-5 * expected);
  // The check above means something only where the estimate itself is good.
  EXPECT_LT(e.standard_error(), 0.02 * expected + 1e-30);
}

// Howell, A Catalog of Radiation Heat Transfer Configuration Factors, B-3: from an element to a
// parallel rectangle a x b at distance c, a corner of it on the element's normal. E = pi L F.
double ParallelFactor(double a, double b, double c) {
  const double x = a / c, y = b / c, rx = std::sqrt(1 + x * x), ry = std::sqrt(1 + y * y);
  return (x / rx * std::atan(y / rx) + y / ry * std::atan(x / ry)) / (2 * kPi);
}

// Ibid., B-4: to a rectangle in a plane at right angles to the element's, at distance c from it;
// the edge of length b lies in the element's plane, a is the height, a corner is the foot.
double PerpendicularFactor(double a, double b, double c) {
  const double x = a / b, y = c / b, r = std::sqrt(x * x + y * y);
  return (std::atan(1 / y) - y / r * std::atan(1 / r)) / (2 * kPi);
}

TEST(RectangularEmitter, MatchesTheFactorOfAParallelRectangle) {
  constexpr float kRadiance = 3;
  for (const auto& [a, b, c] :
       {std::array{1.0, 1.0, 1.0}, std::array{2.0, 0.5, 0.7}, std::array{1.0, 3.0, 0.01},
        std::array{1.0, 1.0, 1e-3}, std::array{1.0, 1.0, 30.0}, std::array{1.0, 2.0, 1e3}}) {
    SCOPED_TRACE(c);
    Scene scene;
    AddQuad(scene, {Vec3d(0, c, 0), Vec3d(a, c, 0), Vec3d(a, c, b), Vec3d(0, c, b)},
            Emitting(kRadiance));
    // The points are surface points: within the scene.
    AddQuad(scene, FloorQuad(1e-3, -1e-6 * c), Material());
    AddQuad(scene, FloorQuad(1e-3, 2 * c + 1e-6 * c), Material());
    const Lit lit(scene);
    EXPECT_TRUE(lit.sampler().has_emitters());
    const double expected = kPi * kRadiance * ParallelFactor(a, b, c);
    ExpectIrradiance(lit, {0, 0, 0}, kUp, expected);
    // It emits from both sides: the same from the mirrored point.
    ExpectIrradiance(lit, {0, 2 * c, 0}, kDown, expected);
  }
}

TEST(RectangularEmitter, MatchesTheFactorOfAPerpendicularRectangle) {
  constexpr float kRadiance = 0.25f;
  for (const auto& [a, b, c] :
       {std::array{1.0, 1.0, 1.0}, std::array{2.0, 0.5, 0.7}, std::array{1.0, 3.0, 0.01},
        std::array{1.0, 1.0, 1e-3}, std::array{1.0, 1.0, 30.0}}) {
    SCOPED_TRACE(c);
    Scene scene;
    AddQuad(scene, {Vec3d(c, 0, 0), Vec3d(c, 0, b), Vec3d(c, a, b), Vec3d(c, a, 0)},
            Emitting(kRadiance));
    ExpectIrradiance(Lit(scene), {0, 0, 0}, kUp, kPi * kRadiance * PerpendicularFactor(a, b, c));
  }
}

TEST(RectangularEmitter, MatchesAtGrazingAngles) {
  // The emitter is seen at an angle of about height / 2; the point sees it at the same or, with the
  // other normal, head-on. Turned, so that no plane is exact in single precision.
  const SinCos a = DetSinCos(0.4), b = DetSinCos(1.1);
  const Vec3d x(a.cos, a.sin * b.cos, a.sin * b.sin), y(-a.sin, a.cos * b.cos, a.cos * b.sin),
      z(0, -b.sin, b.cos);
  for (const double height : {0.3, 0.1, 0.03, 0.01, 1e-3}) {
    SCOPED_TRACE(height);
    Quad q = {Vec3d(2, height, -0.5), Vec3d(2, height, 0.5), Vec3d(3, height, 0.5),
              Vec3d(3, height, -0.5)};
    for (Vec3d& v : q) v = x * v.x + y * v.y + z * v.z;
    Scene scene;
    AddQuad(scene, q, Emitting(1));
    AddQuad(scene, {x * -1.0, x * -0.9, z * 0.1, y * -0.5}, Material());
    const Lit lit(scene);
    for (const Vec3d& n : {y, x}) {
      // Rays start at an offset from the surface, which is seen here.
      const Vec3d start = n * static_cast<double>(lit.offset_m());
      const Estimate e = OverKeys(lit, {0, 0, 0}, Vec3f(n), 64, 64);
      const double expected = PolygonIrradiance(q, start, n);
      EXPECT_NEAR(e.mean(), expected, 4 * e.standard_error() + 1e-6 / height * expected);
      EXPECT_LT(e.standard_error(), 0.01 * expected);
    }
  }
}

TEST(RectangularEmitter, NearItIsSeenAsAHalfSpace) {
  Scene scene;
  AddQuad(scene, FloorQuad(1), Emitting(2));
  const Lit lit(scene);
  for (const double height : {1e-2, 1e-3, 1e-4, 1e-5}) {
    ExpectIrradiance(lit, {0.1, height, -0.3}, kDown,
                     2 * PolygonIrradiance(FloorQuad(1), {0.1, height, -0.3}, {0, -1, 0}));
    EXPECT_NEAR(lit.E({0.1, height, -0.3}, kDown, 4096).x, 2 * kPi, 0.01 * 2 * kPi);
  }
}

TEST(Emitters, TrianglesOfAllShapesMatchTheClosedForm) {
  // Slivers, triangles that fill half of what is seen and such as fill next to nothing, high over
  // the point and just over its horizon.
  TestRandom random(31);
  for (int i = 0; i < 300; ++i) {
    SCOPED_TRACE(i);
    const double size = std::exp2(random.Uniform(-5, 5)), thin = std::exp2(random.Uniform(-8, 0));
    const Vec3d center(random.Uniform(-1, 1), std::exp2(random.Uniform(-3, 1)),
                       random.Uniform(-1, 1));
    const auto direction = [&] {
      return Normalize(Vec3d(random.Uniform(-1, 1), random.Uniform(-1, 1), random.Uniform(-1, 1)) +
                       Vec3d(1e-3, 0, 0));
    };
    const Vec3d along = direction(), across = NormalizeOr(Cross(along, direction()), along);
    std::array<Vec3d, 3> corner = {
        center - along * (0.5 * size), center + along * (0.5 * size),
        center + along * (size * random.Uniform(-0.5, 0.5)) + across * (size * thin)};
    // All above the horizon, for the closed form; not edge-on, where both lose their digits.
    double lowest = 1e30;
    for (const Vec3d& v : corner) lowest = std::min(lowest, v.y);
    const double lift = std::max(0.0, 0.02 - lowest);
    for (Vec3d& v : corner) v.y += lift;
    const Vec3d normal = Normalize(Cross(corner[1] - corner[0], corner[2] - corner[0]));
    if (std::fabs(Dot(normal, Normalize(corner[0]))) < 0.02) continue;
    for (Vec3d& v : corner) v = Vec3d(Vec3f(v));
    Scene scene;
    Mesh mesh;
    for (const Vec3d& v : corner) mesh.positions.push_back(Vec3f(v));
    mesh.triangles = {{0, 1, 2}};
    mesh.material = 0;
    scene.materials.push_back(Emitting(1));
    scene.instances.push_back({"triangle", 0, {}});
    scene.meshes.push_back(mesh);
    AddQuad(scene, FloorQuad(0.01, -1e-3), Material());
    const Lit lit(scene);
    const Estimate e = OverKeys(lit, {0, 0, 0}, kUp, 32, 256);
    const double expected =
        PolygonIrradiance(corner, {0, static_cast<double>(lit.offset_m()), 0}, {0, 1, 0});
    EXPECT_NEAR(e.mean(), expected, 5 * e.standard_error() + 5e-5 * expected);
    EXPECT_LT(e.standard_error(), 0.01 * expected);
  }
}

TEST(IrradianceEach, IsIrradianceOfEachPointAlone) {
  TestRandom random(7);
  Scene two, many, all;
  AddQuad(two, FloorQuad(0.5, 2), Emitting(3));
  for (int i = 0; i < 12; ++i) {
    const double x = i % 4 - 1.5, z = i / 4 - 1.0;
    const Quad q = {Vec3d(x, 2, z), Vec3d(x + 0.4, 2, z), Vec3d(x + 0.4, 2.1, z + 0.4),
                    Vec3d(x, 2.1, z + 0.4)};
    AddQuad(many, q, Emitting(static_cast<float>(i + 1)));
  }
  all = many;
  PunctualLight light;
  light.position = {0, 3, 0.3};
  light.intensity = {7, 0.5f, 100};
  all.lights.push_back(light);
  light.kind = PunctualKind::kDirectional;
  light.direction = Vec3d(0.3, -0.8, 0.1);
  all.lights.push_back(light);
  all.environment.sky = {1, 2, 0.5f};
  for (Scene* scene : {&two, &many, &all}) {
    AddQuad(*scene, FloorQuad(2), Material());
    AddQuad(*scene, FloorQuad(0.7, 1), Material());  // a table, for shadows
    const Lit lit(*scene);
    std::vector<SurfacePoints8> points(11);
    for (size_t i = 0; i < points.size(); ++i) {
      for (size_t k = 0; k < 8; ++k) {
        points[i].p.SetLane(k,
                            lit.Local({random.Uniform(-1.5, 1.5), 0, random.Uniform(-1.5, 1.5)}));
        points[i].ng.SetLane(k, kUp);
        points[i].n.SetLane(k, Normalize(Vec3f(static_cast<float>(random.Uniform(-0.3, 0.3)), 1,
                                               static_cast<float>(random.Uniform(-0.3, 0.3)))));
        points[i].offset_m[k] = lit.offset_m();
        points[i].index[k] = static_cast<uint32_t>(8 * i + k + (i > 5 ? 1000 : 0));
      }
      points[i].active = i == 3 ? 0u : i == 4 ? 0x51u : 0xffu;
    }
    std::vector<V8> together(points.size());
    LightCounters counters, counters_alone;
    lit.sampler().IrradianceEach(points, 99, 2, together, counters);
    bool lit_anywhere = false, dark_anywhere = false;
    for (size_t i = 0; i < points.size(); ++i) {
      for (size_t k = 0; k < 8; ++k) {
        Rgb alone;
        if ((points[i].active >> k & 1u) != 0) {
          alone = lit.sampler().Irradiance(points[i].Lane(k), 1, 99, points[i].index[k], 2,
                                           counters_alone);
          (alone.x > 0 ? lit_anywhere : dark_anywhere) = true;
        }
        EXPECT_EQ(together[i].Lane(k), alone) << i << " " << k;
      }
    }
    EXPECT_TRUE(lit_anywhere);
    EXPECT_TRUE(dark_anywhere || scene == &all);
    EXPECT_EQ(counters.rays, counters_alone.rays);
    EXPECT_EQ(counters.blocked, counters_alone.blocked);
    EXPECT_EQ(counters.samples, counters_alone.samples);
    EXPECT_EQ(counters.skipped_facing_away, counters_alone.skipped_facing_away);
  }
}

TEST(Emitters, ManyOfDifferentPowerAddUp) {
  Scene scene;
  TestRandom random(5);
  const Vec3d p(0.5, 0, 0.5);
  double expected = 0;
  for (int i = 0; i < 100; ++i) {
    // All at one height, so that none hides another.
    const double x = i % 10 * 0.5, z = i / 10 * 0.5, y = 1;
    const double size = random.Uniform(0.01, 0.4);
    const auto radiance = static_cast<float>(std::exp2(random.Uniform(-3, 3)));
    const Quad q = {Vec3d(x, y, z), Vec3d(x + size, y, z), Vec3d(x + size, y, z + size),
                    Vec3d(x, y, z + size)};
    AddQuad(scene, q, Emitting(radiance));
    expected += static_cast<double>(radiance) * PolygonIrradiance(q, p, {0, 1, 0});
  }
  ExpectIrradiance(Lit(scene), p, kUp, expected, 256, 100);
}

TEST(Emitters, ColourIsTheMaterials) {
  Material material;
  material.emission = {4, 2, 0};
  Scene scene;
  AddQuad(scene, FloorQuad(1, 1), material);
  const Rgb e = Lit(scene).E({0, 0, 0}, kUp);
  EXPECT_GT(e.x, 0);
  EXPECT_FLOAT_EQ(e.y, e.x / 2);
  EXPECT_EQ(e.z, 0);
}

TEST(Emitters, AClosedBoxGivesPiL) {
  const Lit lit(MakeFurnace(0.5f, 2.0f));
  const PreparedScene& scene = lit.scene();
  TestRandom random(6);
  Estimate e;
  for (int i = 0; i < 4000; ++i) {
    const auto t = static_cast<uint32_t>(random.Index(scene.triangles().size()));
    const auto [b1, b2] = random.Barycentric();
    const Vec3f p = scene.PointOn(t, static_cast<float>(b1), static_cast<float>(b2));
    const Vec3f n = scene.GeometricNormal(t);  // the fronts face inwards
    LightCounters counters;
    e.Add(static_cast<double>(
        lit.sampler().Irradiance(lit.At(p, n, n), 32, random.Bits(), 0, 0, counters).x));
  }
  EXPECT_NEAR(e.mean(), 2 * kPi, 4 * e.standard_error());
  EXPECT_LT(e.standard_error(), 0.005 * e.mean());
}

// A material of radiance 6 times a texture of two texels, left and right.
Material TexturedEmitter(Scene& scene, const std::vector<uint8_t>& two_texels) {
  Texture texture;
  texture.name = "two texels";
  texture.encoded = Blob::FromString(MakePng(2, 1, two_texels));
  texture.wrap_s = texture.wrap_t = WrapMode::kClampToEdge;
  texture.nearest = true;
  scene.textures.push_back(texture);
  Material material = Emitting(6);
  material.emission_texture.texture = 0;
  return material;
}

TEST(Emitters, TextureScalesTheRadiance) {
  const Quad q = {Vec3d(-1, 1, 1), Vec3d(1, 1, 1), Vec3d(1, 1, -1), Vec3d(-1, 1, -1)};
  const Quad left = {Vec3d(-1, 1, 1), Vec3d(0, 1, 1), Vec3d(0, 1, -1), Vec3d(-1, 1, -1)};
  const Quad right = {Vec3d(0, 1, 1), Vec3d(1, 1, 1), Vec3d(1, 1, -1), Vec3d(0, 1, -1)};
  Scene scene;
  AddQuad(scene, q, TexturedEmitter(scene, {0, 0, 0, 255, 188, 188, 188, 255}));
  const double grey = SrgbToLinear(188 / 255.0);
  for (const Vec3d& p : {Vec3d(0.7, 0, 0.2), Vec3d(-0.7, 0.5, 0.2)}) {
    ExpectIrradiance(Lit(scene), p, kUp, 6 * grey * PolygonIrradiance(right, p, {0, 1, 0}), 256);
  }
  Scene both;
  AddQuad(both, q, TexturedEmitter(both, {255, 255, 255, 255, 188, 188, 188, 255}));
  const Vec3d p(0.4, 0.2, 0);
  ExpectIrradiance(
      Lit(both), p, kUp,
      6 * (PolygonIrradiance(left, p, {0, 1, 0}) + grey * PolygonIrradiance(right, p, {0, 1, 0})));
}

TEST(Emitters, HolesOfAMaskEmitNothing) {
  const Quad q = {Vec3d(-1, 1, 1), Vec3d(1, 1, 1), Vec3d(1, 1, -1), Vec3d(-1, 1, -1)};
  const Quad right = {Vec3d(0, 1, 1), Vec3d(1, 1, 1), Vec3d(1, 1, -1), Vec3d(0, 1, -1)};
  Scene scene;
  Material material = TexturedEmitter(scene, {255, 255, 255, 0, 255, 255, 255, 255});
  material.base_color_texture = material.emission_texture;
  material.emission_texture = {};
  material.alpha_mode = AlphaMode::kMask;
  AddQuad(scene, q, material);
  const Vec3d p(-0.3, 0, 0.2);
  ExpectIrradiance(Lit(scene), p, kUp, 6 * PolygonIrradiance(right, p, {0, 1, 0}), 256);
}

TEST(Emitters, BlackAndDegenerateOnesAreNone) {
  Scene scene;
  AddQuad(scene, FloorQuad(1, 1), Emitting(0));
  AddQuad(scene, {Vec3d(0, 2, 0), Vec3d(1, 2, 0), Vec3d(2, 2, 0), Vec3d(3, 2, 0)}, Emitting(1e6f));
  const Lit lit(scene);
  EXPECT_FALSE(lit.sampler().any_light());
  EXPECT_FALSE(lit.sampler().has_emitters());
  LightCounters counters;
  EXPECT_EQ(lit.E({0, 0, 0}, kUp, 64, 1, counters), Rgb());
  EXPECT_EQ(counters.rays, 0u);
  EXPECT_EQ(counters.samples, 0u);
}

// --- Sky ---

TEST(Sky, AnOpenPointReceivesPiL) {
  Scene scene;
  scene.environment.sky = {1, 2, 0.5f};
  const Lit empty(scene);
  EXPECT_TRUE(empty.sampler().has_sky());
  EXPECT_TRUE(empty.sampler().any_light());
  AddQuad(scene, FloorQuad(1), Material());
  const Lit floor(scene);
  TestRandom random(8);
  for (int i = 0; i < 20; ++i) {
    const Rgb a = empty.E({0, 0, 0}, Vec3f(random.Direction()));
    const Rgb b = floor.E({random.Uniform(-1, 1), 0, random.Uniform(-1, 1)}, kUp);
    for (const Rgb& e : {a, b}) {
      EXPECT_FLOAT_EQ(e.x, kPif);
      EXPECT_FLOAT_EQ(e.y, 2 * kPif);
      EXPECT_FLOAT_EQ(e.z, 0.5f * kPif);
    }
  }
}

TEST(Sky, AHalfBlockedHorizonGivesHalf) {
  // A wall of height 1000 and width 2000 at distance 1 takes F = 0.49950 of the hemisphere.
  Scene scene;
  scene.environment.sky = Rgb(2);
  const Quad wall = {Vec3d(1, 0, -1000), Vec3d(1, 0, 1000), Vec3d(1, 1000, 1000),
                     Vec3d(1, 1000, -1000)};
  AddQuad(scene, wall, Material());
  const double blocked = 2 * PolygonIrradiance(wall, {0, 0, 0}, {0, 1, 0});
  ASSERT_NEAR(blocked, kPi, 0.002 * kPi);
  // The offset of the surface, 1/190 of the distance here, moves the horizon by less than 10^-5.
  const Estimate e = OverKeys(Lit(scene), {0, 0, 0}, kUp, 200, 64);
  EXPECT_NEAR(e.mean(), 2 * kPi - blocked, 4 * e.standard_error() + 1e-4);
  EXPECT_LT(e.standard_error(), 0.005 * kPi);
  EXPECT_NEAR(e.mean(), kPi, 0.01 * kPi);
}

TEST(Sky, BelowTheSurfaceIsDark) {
  // A shading normal at 60° to the surface: what it sees beneath the surface carries nothing. The
  // lune left of the hemisphere about n has E = pi L (1 + cos 60°) / 2.
  Scene scene;
  scene.environment.sky = Rgb(1);
  const Lit lit(scene);
  const Vec3f n(static_cast<float>(std::sin(kPi / 3)), 0.5f, 0);
  LightCounters counters;
  const Rgb e = lit.sampler().Irradiance(lit.At({0, 0, 0}, kUp, n), 4096, 9, 0, 0, counters);
  EXPECT_NEAR(e.x, 0.75 * kPi, 0.005 * kPi);
  EXPECT_LT(counters.rays, 4096u);
  EXPECT_GT(counters.rays, 2048u);
}

// --- Many lights ---

// Point and spot lights over a floor with walls, by the light tree and one by one.
Scene ManyPunctualLights(int count, double scale = 1) {
  Scene scene;
  AddQuad(scene, FloorQuad(10 * scale), Material());
  TestRandom random(21);
  for (int i = 0; i < 6; ++i) {
    const double x = random.Uniform(-8, 8), z = random.Uniform(-8, 8);
    AddQuad(scene,
            {Vec3d(x, 0, z) * scale, Vec3d(x + 1, 0, z + 1) * scale, Vec3d(x + 1, 2, z + 1) * scale,
             Vec3d(x, 2, z) * scale},
            Material());
  }
  for (int i = 0; i < count; ++i) {
    PunctualLight light;
    light.kind = i % 3 == 0 ? PunctualKind::kSpot : PunctualKind::kPoint;
    light.position =
        Vec3d(random.Uniform(-9, 9), random.Uniform(1, 3), random.Uniform(-9, 9)) * scale;
    light.direction = Normalize(Vec3d(random.Uniform(-0.5, 0.5), -1, random.Uniform(-0.5, 0.5)));
    light.inner_cone_rad = 0.4;
    light.outer_cone_rad = 1.0;
    light.range_m = i % 2 == 0 ? 0 : 5 * scale;
    light.intensity = Rgb(static_cast<float>(std::exp2(random.Uniform(-3, 3)) * scale * scale));
    if (i % 10 == 9) light.intensity = Rgb(0);
    scene.lights.push_back(light);
  }
  return scene;
}

TEST(ManyLights, PunctualOnesAreDrawnWithoutBias) {
  const Lit lit(ManyPunctualLights(300));
  TestRandom random(22);
  for (int i = 0; i < 12; ++i) {
    const Vec3d p(random.Uniform(-8, 8), 0, random.Uniform(-8, 8));
    // More samples than lights: one ray each, which is exact.
    LightCounters exact;
    const auto expected = static_cast<double>(lit.E(p, kUp, 512, 1, exact).x);
    EXPECT_EQ(exact.rays + exact.skipped_facing_away, 270u);
    for (const uint32_t samples : {1u, 32u}) {
      LightCounters counters;
      lit.E(p, kUp, samples, 1, counters);
      EXPECT_EQ(counters.samples, samples);
      EXPECT_LE(counters.rays + counters.skipped_facing_away, samples);
      const Estimate e = OverKeys(lit, p, kUp, 2000, samples);
      EXPECT_NEAR(e.mean(), expected, 4 * e.standard_error() + 1e-5 * expected) << i;
      if (samples == 32) {
        EXPECT_LT(std::sqrt(e.variance()), 0.2 * expected);
      }
    }
  }
}

TEST(ManyLights, FewHaveARayEachAndNoNoise) {
  const Lit lit(ManyPunctualLights(8));
  for (uint64_t key = 0; key < 10; ++key) {
    EXPECT_EQ(lit.E({1, 0, 2}, kUp, 1, key), lit.E({1, 0, 2}, kUp, 64, 0));
  }
}

TEST(ManyLights, DirectionalOnesAreDrawnByWhatTheySend) {
  Scene scene;
  AddQuad(scene, FloorQuad(10), Material());
  AddQuad(scene, {Vec3d(2, 0, -10), Vec3d(2, 0, 10), Vec3d(2, 5, 10), Vec3d(2, 5, -10)},
          Material());
  TestRandom random(23);
  for (int i = 0; i < 500; ++i) {
    PunctualLight light;
    light.kind = PunctualKind::kDirectional;
    light.direction = random.Direction();
    light.intensity = Rgb(static_cast<float>(std::exp2(random.Uniform(-4, 4))));
    scene.lights.push_back(light);
  }
  const Lit lit(scene);
  for (const Vec3d& p : {Vec3d(1.9, 0, 0), Vec3d(-3, 0, 1), Vec3d(5, 0, 3)}) {
    const auto expected = static_cast<double>(lit.E(p, kUp, 512).x);
    for (const uint32_t samples : {1u, 32u}) {
      LightCounters counters;
      lit.E(p, kUp, samples, 1, counters);
      EXPECT_LE(counters.rays, samples);
      const Estimate e = OverKeys(lit, p, kUp, 2000, samples);
      EXPECT_NEAR(e.mean(), expected, 4 * e.standard_error() + 1e-5 * expected);
    }
  }
}

// Emitters of all sizes around a floor with walls: a tiny one 10^6 times brighter, a huge dim one,
// many between.
Scene ManyEmitters(int count) {
  Scene scene;
  AddQuad(scene, FloorQuad(10), Material());
  AddQuad(scene, {Vec3d(2, 0, -3), Vec3d(2, 0, 3), Vec3d(2, 2, 3), Vec3d(2, 2, -3)}, Material());
  TestRandom random(24);
  for (int i = 0; i < count; ++i) {
    const Vec3d at(random.Uniform(-9, 9), random.Uniform(1, 4), random.Uniform(-9, 9));
    const Vec3d a = random.Direction() * std::exp2(random.Uniform(-6, -1));
    const Vec3d b = random.Direction() * Length(a);
    AddQuad(scene, {at, at + a, at + a + b, at + b},
            Emitting(static_cast<float>(std::exp2(random.Uniform(-4, 4)))));
  }
  AddQuad(scene, FloorQuad(10, 6), Emitting(0.05f));
  const Vec3d at(-1, 3, 1);
  AddQuad(scene, {at, at + Vec3d(2e-3, 0, 0), at + Vec3d(2e-3, 0, 2e-3), at + Vec3d(0, 0, 2e-3)},
          Emitting(1e6f));
  return scene;
}

TEST(ManyLights, EmittersOfAllSizesAreDrawnWithoutBias) {
  const Lit lit(ManyEmitters(150));
  const std::pair<Vec3d, Vec3f> points[] = {
      {{0, 0, 0}, kUp}, {{2.5, 0, 0.5}, kUp}, {{-6, 0, 5}, kUp}, {{2, 1, 0}, {-1, 0, 0}}};
  for (const auto& [p, n] : points) {
    const PreparedScene& scene = lit.scene();
    // A plain point on each of the triangles.
    Estimate plain;
    TestRandom random(25);
    const Vec3d local(lit.Local(p));
    for (int i = 0; i < 1500; ++i) {
      double sum = 0;
      for (const uint32_t t : scene.emissive_triangles()) {
        const auto [b1, b2] = random.Barycentric();
        const Vec3d v =
            Vec3d(scene.PointOn(t, static_cast<float>(b1), static_cast<float>(b2))) - local;
        const double d = Length(v), cos_p = Dot(Vec3d(n), v) / d;
        const double cos_l = std::fabs(Dot(Vec3d(scene.GeometricNormal(t)), v)) / d;
        if (cos_p <= 0 || lit.Hides(p, n, v)) continue;
        sum += static_cast<double>(scene.MaterialOf(t).emission.x) * cos_p * cos_l / (d * d) *
               static_cast<double>(scene.TriangleArea(t));
      }
      plain.Add(sum);
    }
    for (const uint32_t samples : {1u, 32u}) {
      const Estimate e = OverKeys(lit, p, n, 4000, samples);
      const double error = std::hypot(e.standard_error(), plain.standard_error());
      EXPECT_NEAR(e.mean(), plain.mean(), 4 * error) << p.x << " " << samples;
      EXPECT_LT(error, 0.03 * plain.mean());
      if (samples == 32) {
        EXPECT_LT(std::sqrt(e.variance()), 0.15 * plain.mean());
      }
    }
  }
}

// Every wall emits: E = pi L everywhere, and near it with few samples.
TEST(ManyLights, AFurnaceOfEmittersGivesPiL) {
  Scene scene;
  const double h = 2;
  const Vec3d c[8] = {{-h, -h, -h}, {h, -h, -h}, {h, h, -h}, {-h, h, -h},
                      {-h, -h, h},  {h, -h, h},  {h, h, h},  {-h, h, h}};
  for (const auto& f : {std::array{0, 1, 2, 3},
                        {4, 5, 6, 7},
                        {0, 1, 5, 4},
                        {2, 3, 7, 6},
                        {0, 3, 7, 4},
                        {1, 2, 6, 5}}) {
    AddQuad(scene, {c[f[0]], c[f[1]], c[f[2]], c[f[3]]}, Emitting(3));
  }
  const Lit lit(scene);
  TestRandom random(26);
  for (int i = 0; i < 30; ++i) {
    Vec3d p(random.Uniform(-h, h), random.Uniform(-h, h), random.Uniform(-h, h));
    Vec3d n;
    p[i % 3] = i % 2 == 0 ? -h : h;
    n[i % 3] = i % 2 == 0 ? 1 : -1;
    const Estimate e = OverKeys(lit, p, Vec3f(n), 100, 32);
    EXPECT_NEAR(e.mean(), 3 * kPi, 4 * e.standard_error() + 0.002 * 3 * kPi);
    EXPECT_LT(std::sqrt(e.variance()), 0.1 * 3 * kPi);
  }
}

// A texture that is black but for one corner, over many triangles: only those with light count.
TEST(ManyLights, BlackPartsOfATextureAreNoLights) {
  Scene scene;
  Texture texture;
  std::vector<uint8_t> pixels;
  for (int y = 0; y < 16; ++y) {
    for (int x = 0; x < 16; ++x) {
      const auto v = static_cast<uint8_t>(x < 2 && y < 2 ? 255 : 0);
      pixels.insert(pixels.end(), {v, v, v, 255});
    }
  }
  texture.encoded = Blob::FromString(MakePng(16, 16, pixels));
  texture.wrap_s = texture.wrap_t = WrapMode::kClampToEdge;
  texture.nearest = true;
  scene.textures.push_back(texture);
  Material material = Emitting(5);
  material.emission_texture.texture = 0;
  Mesh mesh;
  for (int y = 0; y <= 16; ++y) {
    for (int x = 0; x <= 16; ++x) {
      const auto u = static_cast<float>(x) / 16, v = static_cast<float>(y) / 16;
      mesh.positions.push_back({u * 2 - 1, 1, v * 2 - 1});
      mesh.uv[0].push_back({u, v});
    }
  }
  for (uint32_t y = 0; y < 16; ++y) {
    for (uint32_t x = 0; x < 16; ++x) {
      const uint32_t a = y * 17 + x;
      mesh.triangles.push_back({a, a + 1, a + 18});
      mesh.triangles.push_back({a, a + 18, a + 17});
    }
  }
  mesh.material = 0;
  scene.materials.push_back(material);
  scene.instances.push_back({"panel", 0, {}});
  scene.meshes.push_back(mesh);
  const Lit lit(scene);
  const Quad lit_part = {Vec3d(-1, 1, -1), Vec3d(-0.75, 1, -1), Vec3d(-0.75, 1, -0.75),
                         Vec3d(-1, 1, -0.75)};
  const Vec3d p(0.3, 0, 0.4);
  const double expected = 5 * PolygonIrradiance(lit_part, p, {0, 1, 0});
  ExpectIrradiance(lit, p, kUp, expected, 32);
  // With all 512 triangles drawn alike, 4 of 32 rays would hit: the error would be far larger.
  EXPECT_LT(std::sqrt(OverKeys(lit, p, kUp, 200, 32).variance()), 0.1 * expected);
}

TEST(ManyLights, ScaleExactlyByPowersOfTwo) {
  const Lit one(ManyPunctualLights(200)), other(ManyPunctualLights(200, 0x1p-7));
  TestRandom random(27);
  for (int i = 0; i < 200; ++i) {
    const Vec3d p(random.Uniform(-8, 8), 0, random.Uniform(-8, 8));
    EXPECT_EQ(one.E(p, kUp, 16, static_cast<uint64_t>(i)),
              other.E(p * 0x1p-7, kUp, 16, static_cast<uint64_t>(i)));
  }
}

// --- Environment maps ---

TEST(Map, AMapOfOneColourIsTheSameSky) {
  Scene sky, map;
  for (Scene* scene : {&sky, &map}) {
    AddQuad(*scene, FloorQuad(5), Material());
    AddQuad(*scene, {Vec3d(1, 0, -3), Vec3d(1, 0, 3), Vec3d(1, 5, 3), Vec3d(1, 5, -3)}, Material());
  }
  sky.environment.sky = {1, 2, 0.3f};
  map.environment.map.assign(32, {1, 2, 0.3f});
  map.environment.map_width = 8;
  map.environment.map_height = 4;
  const Lit a(sky), b(map);
  for (const Vec3d& p : {Vec3d(0, 0, 0), Vec3d(0.9, 0, 1), Vec3d(3, 0, 0)}) {
    EXPECT_EQ(a.E(p, kUp), b.E(p, kUp));
  }
  // One texel a little brighter: no longer a sky, and drawn by the map's own sampler.
  map.environment.map[0] = Rgb(1.001f, 2.002f, 0.3003f);
  const Lit c(map);
  for (const Vec3d& p : {Vec3d(0, 0, 0), Vec3d(0.9, 0, 1), Vec3d(3, 0, 0)}) {
    const Estimate e = OverKeys(a, p, kUp, 200, 64), f = OverKeys(c, p, kUp, 200, 64);
    EXPECT_NEAR(e.mean(), f.mean(),
                4 * std::hypot(e.standard_error(), f.standard_error()) + 1e-3 * e.mean());
  }
}

TEST(Map, IsShadowedAndCounted) {
  Scene scene;
  AddQuad(scene, FloorQuad(5), Material());
  AddQuad(scene, FloorQuad(4, 2), Material());
  scene.environment.map = {Rgb(3), Rgb(1), Rgb(3), Rgb(1)};
  scene.environment.map_width = scene.environment.map_height = 2;
  const Lit lit(scene);
  EXPECT_TRUE(lit.sampler().has_sky());
  EXPECT_TRUE(lit.sampler().any_light());
  LightCounters counters;
  const double below = static_cast<double>(lit.E({0, 0, 0}, kUp, 256, 1, counters).x);
  EXPECT_EQ(counters.samples, 256u);
  EXPECT_EQ(counters.rays + counters.skipped_facing_away, 256u);
  EXPECT_GT(counters.rays, 200u);
  const double above = static_cast<double>(lit.E({0, 2, 0}, kUp, 256).x);
  EXPECT_GT(below, 0);
  EXPECT_LT(below, 0.4 * above);
  // On average 2 over the hemisphere: the map depends on the longitude only.
  EXPECT_NEAR(above, 2 * kPi, 0.03 * 2 * kPi);
}

// --- The estimator ---

// Direct irradiance by plain random points on the emitters and a loop over all triangles.
Estimate PlainEstimate(const PreparedScene& scene, const Vec3d& p, const Vec3d& n, int samples) {
  TestRandom random(123);
  double area = 0;
  for (const uint32_t t : scene.emissive_triangles()) {
    area += static_cast<double>(scene.TriangleArea(t));
  }
  Estimate e;
  for (int i = 0; i < samples; ++i) {
    double u = random.Uniform() * area;
    uint32_t chosen = scene.emissive_triangles().back();
    for (const uint32_t t : scene.emissive_triangles()) {
      u -= static_cast<double>(scene.TriangleArea(t));
      if (u < 0) {
        chosen = t;
        break;
      }
    }
    const auto [b1, b2] = random.Barycentric();
    const Vec3d v =
        Vec3d(scene.PointOn(chosen, static_cast<float>(b1), static_cast<float>(b2))) - p;
    const double d = Length(v), cos_p = Dot(n, v) / d;
    const double cos_l = std::fabs(Dot(Vec3d(scene.GeometricNormal(chosen)), v)) / d;
    const bool dark = cos_p <= 0 || NearestCrossing(scene, p, v, 1e-5, 1 - 1e-5).has_value();
    e.Add(dark ? 0
               : static_cast<double>(scene.MaterialOf(chosen).emission.x) * cos_p * cos_l /
                     (d * d) * area);
  }
  return e;
}

TEST(LightSampler, IsUnbiasedWhateverTheNumberOfSamples) {
  const Lit lit(MakeCornellBox());
  // On the floor in the open, half in the shadow of a block, on the back wall, on the short block.
  const std::pair<Vec3d, Vec3f> points[] = {{{3.8, 0, 1.0}, kUp},
                                            {{1.0, 0, 3.2}, kUp},
                                            {{3.4, 0, 2.4}, kUp},
                                            {{1.5, 2.5, 5.592}, {0, 0, -1}},
                                            {{1.9, 1.65, 1.7}, kUp}};
  bool any_shadow = false;
  for (const auto& [p, n] : points) {
    const Estimate plain = PlainEstimate(lit.scene(), Vec3d(lit.Local(p)), Vec3d(n), 20000);
    any_shadow = any_shadow || plain.variance() > 0.2 * plain.mean() * plain.mean();
    for (const uint32_t samples : {1u, 3u, 16u}) {
      const Estimate e = OverKeys(lit, p, n, 600, samples);
      const double error = std::hypot(e.standard_error(), plain.standard_error());
      EXPECT_NEAR(e.mean(), plain.mean(), 4 * error) << p.x << " " << p.z << ", " << samples;
      EXPECT_LT(error, 0.05 * plain.mean());
    }
  }
  EXPECT_TRUE(any_shadow);
}

TEST(LightSampler, BothPairsOfDimensionsAreUnbiasedAndDifferent) {
  const Lit lit(MakeCornellBox());
  const Vec3f p = lit.Local({1.0, 0, 3.2});
  Estimate e[2];
  for (uint64_t key = 0; key < 600; ++key) {
    LightCounters counters;
    const float a = lit.sampler().Irradiance(lit.At(p, kUp, kUp), 4, key, 0, 0, counters).x;
    const float b = lit.sampler().Irradiance(lit.At(p, kUp, kUp), 4, key, 0, 2, counters).x;
    e[0].Add(static_cast<double>(a));
    e[1].Add(static_cast<double>(b));
  }
  EXPECT_NE(e[0].mean(), e[1].mean());
  EXPECT_NEAR(e[0].mean(), e[1].mean(),
              4 * std::hypot(e[0].standard_error(), e[1].standard_error()));
}

// An emitter over the origin and a wall beside it that hides part of the sky.
Lit HalfOpen() {
  Scene scene;
  scene.environment.sky = Rgb(1);
  AddQuad(scene, {Vec3d(1, 0, -3), Vec3d(1, 0, 3), Vec3d(1, 5, 3), Vec3d(1, 5, -3)}, Material());
  AddQuad(scene, FloorQuad(1, 2), Emitting(4));
  return Lit(scene);
}

TEST(LightSampler, IndexRangesOfOneKeyAreOneSet) {
  const Lit lit = HalfOpen();
  const Vec3f p = lit.Local({0, 0, 0});
  const auto mean_of_ranges = [&](uint64_t key, uint32_t first, uint32_t ranges, uint32_t samples) {
    double sum = 0;
    for (uint32_t r = 0; r < ranges; ++r) {
      LightCounters counters;
      sum += static_cast<double>(
          lit.sampler()
              .Irradiance(lit.At(p, kUp, kUp), samples, key, first + r * samples, 0, counters)
              .x);
    }
    return sum / ranges;
  };
  Estimate one_set, independent;
  for (uint64_t key = 0; key < 200; ++key) {
    // One by one or all at once is the same set.
    const double whole = mean_of_ranges(key, 0, 1, 64);
    EXPECT_NEAR(mean_of_ranges(key, 0, 4, 16), whole, 1e-5 * whole);
    EXPECT_NEAR(mean_of_ranges(key, 0, 64, 1), whole, 1e-5 * whole);
    one_set.Add(whole);
    double sum = 0;
    for (uint64_t k = 0; k < 64; ++k) sum += mean_of_ranges(HashKey(key, k, 5), 0, 1, 1);
    independent.Add(sum / 64);
  }
  EXPECT_NEAR(one_set.mean(), independent.mean(),
              4 * std::hypot(one_set.standard_error(), independent.standard_error()));
  EXPECT_LT(one_set.variance(), 0.25 * independent.variance());
}

// A panel over a floor with a wall between them: in the penumbra four times the rays, elsewhere as
// many as ever.
TEST(LightSampler, RefinesPenumbrasOnly) {
  Scene scene;
  const auto quad = [&](const Vec3f& a, const Vec3f& b, const Vec3f& c, const Vec3f& d,
                        float light) {
    Mesh mesh;
    mesh.positions = {a, b, c, d};
    mesh.triangles = {{0, 1, 2}, {0, 2, 3}};
    mesh.material = static_cast<uint32_t>(scene.materials.size());
    Material material;
    material.emission = Rgb(light, light, light);
    scene.materials.push_back(material);
    Instance instance;
    instance.mesh = static_cast<uint32_t>(scene.meshes.size());
    scene.meshes.push_back(mesh);
    scene.instances.push_back(instance);
  };
  quad({-1, -1, 4}, {1, -1, 4}, {1, 1, 4}, {-1, 1, 4}, 5);  // panel
  quad({0, -9, 2}, {9, -9, 2}, {9, 9, 2}, {0, 9, 2}, 0);    // half a ceiling
  quad({-9, -9, 0}, {9, -9, 0}, {9, 9, 0}, {-9, 9, 0}, 0);  // floor
  const Lit lit(scene);
  const auto estimate = [&](double x, bool refine, uint64_t key, LightCounters& counters) {
    return static_cast<double>(lit.sampler()
                                   .Irradiance(lit.At(lit.Local({x, 0, 0}), {0, 0, 1}, {0, 0, 1}),
                                               8, key, 0, 0, counters,
                                               refine ? LightSampler::kOfReceivers : Refinement{})
                                   .x);
  };
  for (const double x : {-3.0, 3.0}) {  // all of the panel is seen, none of it
    LightCounters a, b;
    EXPECT_NEAR(estimate(x, false, 1, a), estimate(x, true, 1, b), 0.05);
    EXPECT_EQ(a.rays, b.rays);
    EXPECT_EQ(b.blocked, x < 0 ? 0u : b.rays);
  }
  Estimate plain, refined;
  LightCounters few, many;
  for (uint64_t key = 0; key < 2000; ++key) {
    plain.Add(estimate(0.2, false, key, few));
    refined.Add(estimate(0.2, true, key, many));
  }
  EXPECT_GT(many.rays, 3.2 * static_cast<double>(few.rays));
  EXPECT_LE(many.rays, LightSampler::kOfReceivers.emitters * few.rays);
  EXPECT_LT(refined.variance(), 0.5 * plain.variance());
}

// What is decided by a ray must not be decided about that ray: shares far from a half, few samples.
TEST(LightSampler, RefiningIsUnbiasedWhateverTheShareThatIsSeen) {
  for (const double width : {0.9, 6.0}) {  // of a window in a ceiling under a sky
    Scene scene;
    Mesh mesh;
    const float w = static_cast<float>(width / 2), far = 500;
    mesh.positions = {{-far, -far, 1}, {far, -far, 1}, {far, far, 1}, {-far, far, 1},
                      {-w, -w, 1},     {w, -w, 1},     {w, w, 1},     {-w, w, 1}};
    mesh.triangles = {{0, 1, 5}, {0, 5, 4}, {1, 2, 6}, {1, 6, 5},
                      {2, 3, 7}, {2, 7, 6}, {3, 0, 4}, {3, 4, 7}};
    scene.meshes.push_back(mesh);
    scene.instances.push_back({});
    scene.environment.sky = Rgb(1, 1, 1);
    const Lit lit(scene);
    LightCounters counters;
    const auto estimate = [&](uint32_t samples, uint64_t key, bool refine) {
      return static_cast<double>(lit.sampler()
                                     .Irradiance(lit.At(lit.Local({0, 0, 0}), {0, 0, 1}, {0, 0, 1}),
                                                 samples, key, 0, 0, counters,
                                                 refine ? LightSampler::kOfReceivers : Refinement{})
                                     .x);
    };
    const double truth = estimate(1 << 16, 99, false);
    EXPECT_NEAR(truth / kPi, width < 1 ? 0.2 : 0.9, 0.07);
    for (const uint32_t samples : {4u, 5u, 8u}) {
      Estimate e;
      for (uint64_t key = 0; key < 20000; ++key) e.Add(estimate(samples, key, true));
      EXPECT_NEAR(e.mean(), truth, 4 * e.standard_error()) << width << " " << samples;
      EXPECT_LT(e.standard_error(), 0.004 * kPi);
    }
  }
}

TEST(LightSampler, IsAFunctionOfItsArguments) {
  const Lit lit = HalfOpen();
  EXPECT_EQ(lit.E({0, 0, 0}, kUp, 16, 4), lit.E({0, 0, 0}, kUp, 16, 4));
  EXPECT_NE(lit.E({0, 0, 0}, kUp, 16, 4), lit.E({0, 0, 0}, kUp, 16, 5));
}

TEST(LightSampler, LightsBehindTheSurfaceCostNoRay) {
  Scene scene;
  AddQuad(scene, FloorQuad(1, 2), Emitting(4));
  PunctualLight light;
  light.intensity = Rgb(1);
  light.position = {0, 1, 0};
  scene.lights.push_back(light);
  light.kind = PunctualKind::kDirectional;
  light.direction = {0, -1, 0};
  scene.lights.push_back(light);
  light.kind = PunctualKind::kSpot;
  scene.lights.push_back(light);
  const Lit lit(scene);
  LightCounters away;
  EXPECT_EQ(lit.E({0, 0, 0}, kDown, 32, 1, away), Rgb());
  EXPECT_EQ(away.rays, 0u);
  EXPECT_EQ(away.samples, 32u);
  EXPECT_EQ(away.skipped_facing_away, 32u + 3u);

  LightCounters towards;
  EXPECT_GT(lit.E({0, 0, 0}, kUp, 32, 1, towards).x, 0);
  EXPECT_EQ(towards.rays, 32u + 3u);
  EXPECT_EQ(towards.skipped_facing_away, 0u);

  // In front of the shading normal but behind the surface counts as behind.
  const Vec3f n(0.99f, std::sqrt(1 - 0.99f * 0.99f), 0);
  LightCounters tilted;
  const Rgb e =
      lit.sampler().Irradiance(lit.At(lit.Local({0, 0, 0}), {1, 0, 0}, n), 32, 1, 0, 0, tilted);
  EXPECT_GE(e.x, 0);
  EXPECT_LT(tilted.rays, 32u + 3u);
}

TEST(LightSampler, PlacesWhereALightTouchesThePointAreFinite) {
  Scene scene;
  const Quad q = FloorQuad(1);
  AddQuad(scene, q, Emitting(1e6f));
  PunctualLight light;
  light.intensity = Rgb(1e6f);
  light.position = {0.25, 0.5, 0.25};
  light.range_m = 3;
  scene.lights.push_back(light);
  light.kind = PunctualKind::kSpot;
  light.direction = {0, -1, 0};
  scene.lights.push_back(light);
  const Lit lit(scene);
  TestRandom random(9);
  const Vec3d places[] = {light.position,  // exactly at the lights
                          q[0],
                          q[1],
                          q[2],
                          q[3],                 // corners of the emitter
                          (q[0] + q[2]) * 0.5,  // on its inner edge
                          {1, 0, 0},
                          {0.3, 0, 0.1},  // on its outer edge, inside
                          {3, 0, 0.5},
                          {1 + 1e-6, 0, 0},  // in its plane, outside
                          {0.3, 1e-7, 0.1},
                          {0.3, -1e-7, 0.1},  // nearer than the surface offset
                          {1, 1e-7, 1},
                          {1, 1e-30, 1}};
  for (const Vec3d& p : places) {
    for (int i = 0; i < 100; ++i) {
      const Vec3f n = i == 0 ? kUp : i == 1 ? kDown : Vec3f(random.Direction());
      const Rgb e = lit.E(p, n, 16, random.Bits());
      EXPECT_TRUE(IsFinite(e)) << p.x << " " << p.y << " " << p.z;
      EXPECT_GE(std::min({e.x, e.y, e.z}), 0);
    }
  }
  // In the emitter's plane but beside it, nothing arrives from it; a point of it lights not itself.
  Scene alone;
  AddQuad(alone, q, Emitting(1));
  EXPECT_EQ(Lit(alone).E({0.3, 0, 0.1}, kUp), Rgb());
  EXPECT_EQ(Lit(alone).E({3, 0, 0.1}, {-1, 0, 0}), Rgb());
}

TEST(LightSampler, RandomInputGivesFiniteValues) {
  TestRandom random(10);
  for (int round = 0; round < 40; ++round) {
    const double scale = std::exp2(random.Uniform(-12, 12));
    Scene scene;
    for (int i = 0; i < 12; ++i) {
      // Some long, some tiny, some far.
      const double size = scale * std::exp2(random.Uniform(-12, 0));
      const Vec3d at = random.Direction() * scale;
      Quad q;
      for (Vec3d& v : q) v = at + random.Direction() * size;
      if (i % 3 == 0) q[2] = q[0] + (q[1] - q[0]) * 1e3;
      AddQuad(scene, q,
              Emitting(i % 4 == 0 ? 0.0f : static_cast<float>(std::exp2(random.Uniform(-30, 30)))));
    }
    for (int i = 0; i < 3; ++i) {
      PunctualLight light;
      light.kind = static_cast<PunctualKind>(i);
      light.position = random.Direction() * scale;
      light.direction = random.Direction();
      light.intensity = Rgb(static_cast<float>(std::exp2(random.Uniform(-20, 20))));
      light.range_m = round % 2 == 0 ? 0 : scale * random.Uniform();
      light.inner_cone_rad = light.outer_cone_rad * random.Uniform();
      scene.lights.push_back(light);
    }
    scene.environment.sky = Rgb(static_cast<float>(random.Uniform()));
    const Lit lit(scene);
    const PreparedScene& prepared = lit.scene();
    for (int i = 0; i < 300; ++i) {
      const auto t = static_cast<uint32_t>(random.Index(prepared.triangles().size()));
      auto [b1, b2] = random.Barycentric();
      if (i % 3 == 0) b1 = b2 = 0;       // at a vertex
      if (i % 5 == 0) b1 = 0, b2 = 0.5;  // on an edge
      Vec3f p = prepared.PointOn(t, static_cast<float>(b1), static_cast<float>(b2));
      Vec3f ng = prepared.GeometricNormal(t);
      if (i % 2 == 0) ng = -ng;
      if (i % 7 == 0) p += ng * static_cast<float>(scale * std::exp2(random.Uniform(-40, 2)));
      if (i % 11 == 0) ng = Vec3f(random.Direction());
      Vec3f n(random.Direction());
      if (Dot(n, ng) < 0) n = -n;
      LightCounters counters;
      const Rgb e = lit.sampler().Irradiance(lit.At(p, ng, n), 8, random.Bits(), 0, 0, counters);
      ASSERT_TRUE(IsFinite(e)) << "round " << round << ", point " << i;
      ASSERT_GE(std::min({e.x, e.y, e.z}), 0);
    }
  }
}

TEST(LightSampler, ScalesExactlyByPowersOfTwo) {
  const auto scaled = [](double scale) {
    Scene scene = MakeCornellBox();
    for (Instance& instance : scene.instances) {
      for (Vec3d& column : instance.world_from_mesh.column) column = column * scale;
    }
    PunctualLight light;
    light.position = Vec3d(1.5, 4, 2) * scale;
    light.intensity = Rgb(static_cast<float>(9 * scale * scale));  // E stays as it is
    light.range_m = 11 * scale;
    scene.lights.push_back(light);
    light.kind = PunctualKind::kSpot;
    light.direction = {0.2, -1, 0.1};
    scene.lights.push_back(light);
    light.kind = PunctualKind::kDirectional;
    light.intensity = Rgb(0.3f);
    light.direction = {0.1, -0.3, 1};
    scene.lights.push_back(light);
    scene.environment.sky = Rgb(0.7f);
    return Lit(scene);
  };
  const Lit one = scaled(1);
  for (const double scale : {0x1p-20, 0x1p-3, 2.0, 0x1p20}) {
    const Lit other = scaled(scale);
    TestRandom random(11);
    int lit = 0;
    for (int i = 0; i < 200; ++i) {
      const auto t = static_cast<uint32_t>(random.Index(one.scene().triangles().size()));
      const auto [b1, b2] = random.Barycentric();
      const auto b1f = static_cast<float>(b1), b2f = static_cast<float>(b2);
      const Vec3f n = one.scene().GeometricNormal(t);
      ASSERT_EQ(other.scene().GeometricNormal(t), n);
      LightCounters counters;
      const Rgb a = one.sampler().Irradiance(one.At(one.scene().PointOn(t, b1f, b2f), n, n), 8,
                                             static_cast<uint64_t>(i), 0, 0, counters);
      const Rgb b = other.sampler().Irradiance(other.At(other.scene().PointOn(t, b1f, b2f), n, n),
                                               8, static_cast<uint64_t>(i), 0, 0, counters);
      EXPECT_EQ(a, b) << "scale " << scale << ", point " << i;
      lit += a.x > 0;
    }
    EXPECT_GT(lit, 100);
  }
}

// A reflector of 1 keeps what it was told.
class Told final : public Reflector {
 public:
  Rgb Toward(const Vec3f& w, float density_sr) const override {
    directions.push_back(w);
    densities.push_back(density_sr);
    return Rgb(1);
  }
  mutable std::vector<Vec3f> directions;
  mutable std::vector<float> densities;
};

TEST(Reflected, IsTheIrradianceWhereAllReflectsAlike) {
  Scene scene = MakeCornellBox();
  scene.environment.sky = Rgb(0.3f);
  PunctualLight point;
  point.position = {2, 3, 1};
  point.intensity = Rgb(4);
  scene.lights.push_back(point);
  const Lit lit(scene, true);
  const Vec3f up(0, 1, 0);
  for (const bool refine : {false, true}) {
    for (const Vec3d& p : {Vec3d(2.7, 0.01, 1.0), Vec3d(3.8, 0.01, 3.0), Vec3d(1, 2, 4)}) {
      const SurfacePoint at = lit.At(lit.Local(p), up, up);
      LightCounters a, b;
      const Told told;
      const Rgb e = lit.sampler().Irradiance(at, 16, 5, 0, 0, a,
                                             refine ? LightSampler::kOfReceivers : Refinement{});
      const Rgb r = lit.sampler().Reflected(at, told, 16, 5, 0, 0, b,
                                            refine ? LightSampler::kOfReceivers : Refinement{});
      for (int c = 0; c < 3; ++c) EXPECT_NEAR(r[c], e[c], 1e-5f * e[c]);
      EXPECT_EQ(a.rays, b.rays);
    }
  }
}

// A ray that happens to go where a sample of the lights went finds the density that the sample
// told.
TEST(Reflected, TellsTheDensityThatRaysFind) {
  Scene scene = MakeGlossyCornellBox(0.5f);
  const Lit lit(scene, true);
  const Vec3f up(0, 1, 0);
  const SurfacePoint at = lit.At(lit.Local({1.5, 4.0, 1.0}), up, up);
  LightCounters counters;
  const Told told;
  lit.sampler().Reflected(at, told, 32, 9, 0, 0, counters);
  ASSERT_GT(told.directions.size(), 16u);
  size_t found = 0;
  for (size_t i = 0; i < told.directions.size(); ++i) {
    const auto hit = lit.accel().Intersect(at.Leave(), told.directions[i]);
    ASSERT_TRUE(hit);
    const LightSampler::Seen seen = lit.sampler().EmissionSeen(at, *hit);
    if (!(MaxComponent(seen.radiance) > 0)) continue;  // at the emitter's edge
    ++found;
    EXPECT_EQ(seen.radiance, Rgb(17, 12, 4));
    EXPECT_NEAR(seen.density_sr, told.densities[i], 1e-4f * told.densities[i]);
  }
  EXPECT_GT(found, 16u);
  // What does not emit is nothing.
  const auto floor = lit.accel().Intersect(at.p, {0, -1, 0});
  ASSERT_TRUE(floor);
  EXPECT_EQ(lit.sampler().EmissionSeen(at, *floor).radiance, Rgb());
}

TEST(Reflected, SkiesHaveTheDensityOfTheCosine) {
  Scene scene = MakeGlossyCornellBox(0.5f);
  scene.environment.sky = {1, 2, 3};
  const Lit lit(scene, true);
  const Vec3f up(0, 1, 0), w = Normalize(Vec3f(0, 1, -1));
  const SurfacePoint at = lit.At({}, up, up);
  EXPECT_EQ(lit.sampler().EnvironmentSeen(at, w).radiance, Rgb(1, 2, 3));
  EXPECT_FLOAT_EQ(lit.sampler().EnvironmentSeen(at, w).density_sr, w.y * kInvPif);
  EXPECT_EQ(lit.sampler().EnvironmentSeen(at, -w).density_sr, 0);
}

}  // namespace
}  // namespace farpoint

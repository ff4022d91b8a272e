#include "core/render/path_tracer.h"

#include <gtest/gtest.h>

#include <cmath>
#include <memory>
#include <vector>

#include "core/base/executor.h"
#include "core/math/elementary.h"
#include "core/math/sampling.h"
#include "core/scene/procedural.h"
#include "tests/unit/core/accel/brute_force.h"

namespace farpoint {
namespace {

struct World {
  explicit World(const Scene& description) {
    Executor executor(1);
    auto prepared = PreparedScene::Prepare(description, executor);
    EXPECT_TRUE(prepared.ok()) << prepared.status();
    accel = RayAccel::Build(*prepared).value();
    lights = std::make_unique<const LightSampler>(accel);
  }
  const PreparedScene& scene() const { return accel->scene(); }
  Receiver At(const Vec3d& p_world, const Vec3f& n) const {
    return {Vec3f(p_world - scene().origin()), n, n, false, scene().diagonal_m() * 0x1p-19f};
  }
  TracedIrradiance Trace(const Receiver& r, uint32_t paths, uint64_t key,
                         uint32_t bounces = 1) const {
    LightCounters counters;
    uint64_t rays = 0;
    return TraceIndirect(*accel, *lights, r, paths, bounces, key, counters, rays);
  }

  std::shared_ptr<const RayAccel> accel;
  std::unique_ptr<const LightSampler> lights;
};

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

// One-bounce indirect irradiance by independent random paths, in double, over all triangles: a
// cosine direction, and at its hit a point uniform over the area of all emitters.
std::vector<Estimate> PlainPaths(const PreparedScene& scene, const Receiver& r, int paths) {
  TestRandom random(321);
  double area = 0;
  for (const uint32_t t : scene.emissive_triangles()) {
    area += static_cast<double>(scene.TriangleArea(t));
  }
  std::vector<Estimate> e(3);
  const Vec3d p(r.position), n(r.normal);
  const double near = 1e-5 * static_cast<double>(scene.diagonal_m());
  for (int i = 0; i < paths; ++i) {
    Vec3d sample;
    const Vec3d w = random.CosineDirection(n);
    const auto hit = NearestCrossing(scene, p, w, near, 1e30);
    if (hit) {
      const Vec3d y = p + w * hit->t;
      Vec3d ny(scene.GeometricNormal(hit->triangle));
      if (Dot(ny, w) > 0) ny = -ny;
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
          Vec3d(scene.PointOn(chosen, static_cast<float>(b1), static_cast<float>(b2))) - y;
      const double d = Length(v), cos_y = Dot(ny, v) / d;
      const double cos_l = std::fabs(Dot(Vec3d(scene.GeometricNormal(chosen)), v)) / d;
      if (cos_y > 0 && !NearestCrossing(scene, y, v / d, near, d - near)) {
        const SurfaceSample surface =
            scene.Surface(hit->triangle, static_cast<float>(hit->b1), static_cast<float>(hit->b2));
        // E = pi * albedo / pi * E_direct(y)
        sample = Vec3d(surface.albedo * scene.MaterialOf(chosen).emission) *
                 (cos_y * cos_l / (d * d) * area);
      }
    }
    for (int c = 0; c < 3; ++c) e[static_cast<size_t>(c)].Add(sample[c]);
  }
  return e;
}

// On the floor in the open, in the shadow of a block, on the ceiling, on the red wall.
std::vector<Receiver> CornellReceivers(const World& world) {
  return {world.At({3.8, 0, 1.0}, {0, 1, 0}), world.At({1.0, 0, 3.2}, {0, 1, 0}),
          world.At({1.0, 5.488, 1.0}, {0, -1, 0}),
          world.At({5.55, 4.0, 3.0}, Normalize(Vec3f(-1, 0, 0)))};
}

// One path after the other, as the header says.
Rgb OneByOne(const World& world, const Receiver& r, uint32_t paths, uint64_t key) {
  const PreparedScene& scene = world.scene();
  const uint32_t seed = static_cast<uint32_t>(HashKey(key, 11));
  const Frame frame(r.normal);
  LightCounters counters;
  Vec3d sum;
  for (uint32_t i = 0; i < paths; ++i) {
    const Vec3f w = frame.ToWorld(CosineHemisphere(OwenSobol(i, 0, seed), OwenSobol(i, 1, seed)));
    if (!(Dot(w, r.geometric_normal) > 0.0f)) continue;
    const auto hit = world.accel->Intersect(r.Leave(), w);
    if (!hit) continue;
    Vec3f ng = scene.GeometricNormal(hit->triangle);
    Vec3f n = scene.ShadingNormal(hit->triangle, hit->b1, hit->b2, ng);
    if (Dot(ng, w) > 0.0f) {
      ng = -ng;
      n = -n;
    }
    const Vec3f p = scene.PointOn(hit->triangle, hit->b1, hit->b2);
    const Rgb e =
        world.lights->Irradiance({p, ng, n, world.accel->SurfaceOffsetM(hit->triangle, p, ng)}, 1,
                                 HashKey(key, 12), i, 2, counters);
    sum += Vec3d(scene.Surface(hit->triangle, hit->b1, hit->b2).albedo * e);
  }
  return Rgb(sum / static_cast<double>(paths));
}

TEST(TraceIndirect, PathsSideBySideAreThoseOneByOne) {
  // Directions differ in their last bits, so now and then a path takes another turn at an edge.
  Scene smooth = MakeCornellBox();
  for (Mesh& mesh : smooth.meshes) {
    TestRandom random(mesh.positions.size());
    mesh.normals.clear();
    for (size_t v = 0; v < mesh.positions.size(); ++v) {
      mesh.normals.push_back(Normalize(Vec3f(static_cast<float>(random.Uniform(-1, 1)),
                                             static_cast<float>(random.Uniform(-1, 1)), 1.5f)));
    }
  }
  for (const Scene& scene : {MakeCornellBox(), smooth}) {
    const World world(scene);
    int off = 0, count = 0;
    for (const Receiver& r : CornellReceivers(world)) {
      for (const uint32_t paths : {1u, 5u, 8u, 63u, 64u, 65u, 200u, 256u}) {
        for (uint64_t key = 0; key < 8; ++key) {
          const Rgb together = world.Trace(r, paths, key).irradiance;
          const Rgb alone = OneByOne(world, r, paths, key);
          for (int c = 0; c < 3; ++c) {
            ++count;
            off += std::fabs(together[c] - alone[c]) > 1e-4f * alone[c] + 1e-6f;
          }
        }
      }
    }
    EXPECT_LE(off, count / 50);
  }
}

TEST(TraceIndirect, MeanOverKeysEqualsPlainRandomPaths) {
  const World world(MakeCornellBox());
  for (const Receiver& r : CornellReceivers(world)) {
    const std::vector<Estimate> plain = PlainPaths(world.scene(), r, 60000);
    Estimate traced[3];
    for (uint64_t key = 0; key < 400; ++key) {
      const TracedIrradiance t = world.Trace(r, 48, HashKey(8, key));
      for (int c = 0; c < 3; ++c) traced[c].Add(static_cast<double>(t.irradiance[c]));
    }
    for (size_t c = 0; c < 3; ++c) {
      const double error = std::hypot(plain[c].standard_error(), traced[c].standard_error());
      EXPECT_NEAR(traced[c].mean(), plain[c].mean(), 4 * error);
      EXPECT_LT(error, 0.02 * plain[c].mean());
    }
  }
}

TEST(TraceIndirect, StandardErrorIsHonest) {
  const World world(MakeCornellBox());
  for (const Receiver& r : CornellReceivers(world)) {
    constexpr int kTruthKeys = 1000, kKeys = 200;
    Estimate truth;
    for (uint64_t key = 0; key < kTruthKeys; ++key) {
      truth.Add(static_cast<double>(world.Trace(r, 256, HashKey(9, key)).irradiance.x));
    }
    // With fewer than the default of 64 paths the distribution is too skewed for the promise.
    for (const uint32_t paths : {64u, 256u}) {
      int within = 0;
      double claimed = 0, actual = 0;
      for (uint64_t key = 0; key < kKeys; ++key) {
        const TracedIrradiance t = world.Trace(r, paths, HashKey(10, key));
        const double error = static_cast<double>(t.irradiance.x) - truth.mean();
        const double se = static_cast<double>(t.standard_error.x);
        within += std::fabs(error) <= 3 * se;
        claimed += se * se;
        actual += error * error;
      }
      EXPECT_GE(within, kKeys * 9 / 10) << paths << " paths";
      // On the high side, but no empty claim.
      EXPECT_GT(claimed, 0.7 * actual);
      EXPECT_LT(claimed, 25 * actual);
    }
  }
}

TEST(TraceIndirect, ErrorFallsFasterThanThatOfRandomPaths) {
  const World world(MakeCornellBox());
  const Receiver r = CornellReceivers(world)[0];
  const auto variance = [&](uint32_t paths) {
    Estimate e;
    for (uint64_t key = 0; key < 200; ++key) {
      e.Add(static_cast<double>(world.Trace(r, paths, HashKey(11, key)).irradiance.x));
    }
    return e.variance();
  };
  // Sixteen times the paths: a sixteenth of the variance at random, less when stratified.
  EXPECT_LT(variance(256), variance(16) / 25);
}

TEST(TraceIndirect, AFurnaceGivesPiRhoL) {
  const World world(MakeFurnace(0.6f, 1.5f));
  const double expected = kPi * 0.6 * 1.5;
  Estimate e;
  for (uint64_t key = 0; key < 200; ++key) {
    const Receiver r = world.At({0.3, -1, 0.2}, {0, 1, 0});
    e.Add(static_cast<double>(world.Trace(r, 128, HashKey(12, key)).irradiance.x));
  }
  EXPECT_NEAR(e.mean(), expected, 4 * e.standard_error());
  EXPECT_LT(e.standard_error(), 0.01 * expected);
}

TEST(TraceIndirect, FurtherBouncesGiveTheGeometricSeries) {
  const World world(MakeFurnace(0.6f, 1.5f));
  for (const uint32_t bounces : {2u, 4u, 8u}) {
    double expected = 0;
    for (uint32_t k = 1; k <= bounces; ++k) expected += kPi * 1.5 * std::pow(0.6, k);
    Estimate e;
    for (uint64_t key = 0; key < 100; ++key) {
      const Receiver r = world.At({0.3, -1, 0.2}, {0, 1, 0});
      e.Add(static_cast<double>(world.Trace(r, 128, HashKey(13, key), bounces).irradiance.x));
    }
    EXPECT_NEAR(e.mean(), expected, 4 * e.standard_error());
    EXPECT_LT(e.standard_error(), 0.01 * expected);
  }
}

// The second bounce by hand: a path's first vertex receives what one bounce brings there.
TEST(TraceIndirect, TheSecondBounceIsTheFirstOfItsVertices) {
  const World world(MakeCornellBox());
  const PreparedScene& scene = world.scene();
  const Receiver r = CornellReceivers(world)[0];
  TestRandom random(77);
  Estimate by_hand[3], traced[3];
  for (int i = 0; i < 4000; ++i) {
    const Vec3f w(random.CosineDirection(Vec3d(r.normal)));
    const auto hit = world.accel->Intersect(r.Leave(), w);
    Rgb brings;
    if (hit) {
      Receiver at;
      at.position = scene.PointOn(hit->triangle, hit->b1, hit->b2);
      const Vec3f n = scene.GeometricNormal(hit->triangle);
      at.normal = at.geometric_normal = hit->front ? n : -n;
      at.offset_m = world.accel->SurfaceOffsetM(hit->triangle, at.position, n);
      brings = scene.Surface(hit->triangle, hit->b1, hit->b2).albedo *
               world.Trace(at, 8, static_cast<uint64_t>(i)).irradiance;
    }
    for (int c = 0; c < 3; ++c) by_hand[c].Add(static_cast<double>(brings[c]));
  }
  for (uint64_t key = 0; key < 400; ++key) {
    const Rgb two = world.Trace(r, 64, key, 2).irradiance, one = world.Trace(r, 64, key).irradiance;
    for (int c = 0; c < 3; ++c) traced[c].Add(static_cast<double>(two[c] - one[c]));
  }
  for (int c = 0; c < 3; ++c) {
    const double error = std::hypot(by_hand[c].standard_error(), traced[c].standard_error());
    EXPECT_NEAR(traced[c].mean(), by_hand[c].mean(), 4 * error);
    EXPECT_LT(error, 0.1 * by_hand[c].mean());
  }
}

TEST(TraceIndirect, BlackSurroundingsReflectNothingAndCostNoShadowRay) {
  Scene scene = MakeCornellBox();
  for (Material& m : scene.materials) m.base_color = {};
  const World world(scene);
  LightCounters counters;
  uint64_t rays = 0;
  const TracedIrradiance t = TraceIndirect(*world.accel, *world.lights, CornellReceivers(world)[0],
                                           64, 1, 1, counters, rays);
  EXPECT_EQ(t.irradiance, Rgb());
  EXPECT_EQ(t.standard_error, Rgb());
  EXPECT_EQ(rays, 64u);
  EXPECT_EQ(counters.rays, 0u);
  EXPECT_EQ(counters.samples, 0u);
}

TEST(TraceIndirect, PathsThatLeaveTheSceneCarryNothing) {
  // Emitters and the sky count as direct light: a path that ends in them adds nothing.
  Scene scene;
  scene.environment.sky = Rgb(1);
  Mesh floor;
  floor.positions = {{-1, 0, 1}, {1, 0, 1}, {1, 0, -1}, {-1, 0, -1}};
  floor.triangles = {{0, 1, 2}, {0, 2, 3}};
  scene.meshes.push_back(floor);
  scene.instances.push_back({"floor", 0, {}});
  const World world(scene);
  LightCounters counters;
  uint64_t rays = 0;
  const TracedIrradiance t = TraceIndirect(
      *world.accel, *world.lights, world.At({0.1, 0, 0.2}, {0, 1, 0}), 100, 1, 1, counters, rays);
  EXPECT_EQ(t.irradiance, Rgb());
  EXPECT_EQ(t.standard_error, Rgb());
  EXPECT_EQ(rays, 100u);
  EXPECT_EQ(counters.rays, 0u);
}

TEST(TraceIndirect, DirectionsBelowTheSurfaceAreNotTraced) {
  // A shading normal at 60° to the surface: a quarter of its cosine-weighted hemisphere is below.
  const World world(MakeFurnace(0.5f, 1.0f));
  Receiver r = world.At({0, -1, 0}, {0, 1, 0});
  r.normal = {static_cast<float>(std::sin(kPi / 3)), 0.5f, 0};
  LightCounters counters;
  uint64_t rays = 0;
  TraceIndirect(*world.accel, *world.lights, r, 4096, 1, 2, counters, rays);
  EXPECT_NEAR(static_cast<double>(rays), 0.75 * 4096, 0.01 * 4096);
}

TEST(TraceIndirect, FewPathsHaveNoStandardError) {
  const World world(MakeCornellBox());
  const Receiver r = CornellReceivers(world)[0];
  for (const uint32_t paths : {1u, 7u}) {
    EXPECT_EQ(world.Trace(r, paths, 3).standard_error, Rgb());
  }
  // One path may find nothing; of twenty one finds something.
  float found = 0;
  for (uint64_t key = 0; key < 20; ++key) found += world.Trace(r, 1, key).irradiance.x;
  EXPECT_GT(found, 0);
  EXPECT_GT(world.Trace(r, 8, 3).standard_error.x, 0);
  EXPECT_GT(world.Trace(r, 13, 3).standard_error.x, 0);  // batches of unequal size
}

TEST(TraceIndirect, IsAFunctionOfTheKey) {
  const World world(MakeCornellBox());
  const Receiver r = CornellReceivers(world)[0];
  EXPECT_EQ(world.Trace(r, 32, 5).irradiance, world.Trace(r, 32, 5).irradiance);
  EXPECT_NE(world.Trace(r, 32, 5).irradiance, world.Trace(r, 32, 6).irradiance);
}

}  // namespace
}  // namespace farpoint

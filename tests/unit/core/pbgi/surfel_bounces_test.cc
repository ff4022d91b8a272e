#include "core/pbgi/surfel_bounces.h"

#include <gtest/gtest.h>

#include <cmath>

#include "core/math/elementary.h"
#include "core/pbgi/surfel_atlas.h"
#include "core/pbgi/surfel_sampler.h"
#include "core/pbgi/surfel_shader.h"
#include "core/scene/procedural.h"

namespace farpoint {
namespace {

struct Bounced {
  std::shared_ptr<const PreparedScene> scene;
  SurfelCloud cloud;
  SurfelShading direct, shading;
  std::shared_ptr<const PointTree> tree;
  Stats stats;
};

Bounced Bounce(const Scene& description, uint64_t n, uint32_t bounces, unsigned threads = 2) {
  Executor executor(threads);
  Bounced b;
  b.scene = PreparedScene::Prepare(description, executor).value();
  const auto accel = RayAccel::Build(b.scene).value();
  const LightSampler lights(accel);
  b.cloud = SampleSurfels(description, *b.scene, n, 0, executor);
  const SurfelSides open = FindOpenSides(b.cloud, *accel, 0, executor, b.stats);
  b.shading = ShadeSurfels(b.cloud, open, *accel, lights, ShadeOptions(), executor, b.stats);
  b.direct = b.shading;
  const auto topology = PointTree::BuildTopology(b.cloud, open, executor);
  BounceOptions options;
  options.bounces = bounces;
  EXPECT_TRUE(
      AddBounces(b.cloud, open, topology, *accel, lights, options, executor, b.shading, b.stats)
          .ok());
  b.tree = PointTree::FromBlobs(topology.blob, PointTree::BuildRadiance(topology, b.cloud, open,
                                                                        b.shading, executor))
               .value();
  return b;
}

// In a closed room whose walls emit L and reflect rho, E_b of b bounces is pi L Σ rho^k, k = 1..b.
// Surfels gather one less than the image shows.
TEST(SurfelBounces, AFurnaceGivesTheGeometricSeries) {
  constexpr double kRho = 0.7, kRadiance = 2;
  for (const uint32_t bounces : {1u, 2u, 3u, 6u}) {
    SCOPED_TRACE(bounces);
    const Bounced b =
        Bounce(MakeFurnace(static_cast<float>(kRho), static_cast<float>(kRadiance)), 4000, bounces);
    double expected = 0;
    for (uint32_t k = 1; k < bounces; ++k) expected += kPi * kRadiance * std::pow(kRho, k);
    double mean = 0, square = 0;
    for (size_t i = 0; i < b.cloud.size(); ++i) {
      const bool front = b.direct.front[i].x > 0;
      const Rgb e = (front ? b.shading.indirect_front : b.shading.indirect_back)[i];
      const Rgb all = (front ? b.shading.front : b.shading.back)[i];
      const Rgb direct = (front ? b.direct.front : b.direct.back)[i];
      EXPECT_NEAR(all.x, direct.x + static_cast<float>(kRho) * e.x * kInvPif, 1e-5f * all.x);
      mean += static_cast<double>(e.x);
      square += static_cast<double>(e.x) * static_cast<double>(e.x);
    }
    mean /= static_cast<double>(b.cloud.size());
    square /= static_cast<double>(b.cloud.size());
    EXPECT_NEAR(mean, expected, 0.01 * expected);
    EXPECT_LT(std::sqrt(std::max(0.0, square - mean * mean)), 0.05 * expected + 1e-6);
    EXPECT_EQ(b.stats.counts.at("bounces"), bounces);
  }
}

TEST(SurfelBounces, StopWhereTheyAddNothing) {
  const Bounced b = Bounce(MakeFurnace(0.1f, 1.0f), 2000, 64);
  // 0.1^3 of what is reflected is below a thousandth of it.
  EXPECT_GE(b.stats.counts.at("bounces"), 3u);
  EXPECT_LE(b.stats.counts.at("bounces"), 5u);
  EXPECT_EQ(b.stats.counts.at("bounces") + b.stats.skipped.at("bounces"), 64u);
}

TEST(SurfelBounces, AreTheSameForAnyNumberOfThreads) {
  const Bounced a = Bounce(MakeCornellBox(), 5000, 4, 1), b = Bounce(MakeCornellBox(), 5000, 4, 3);
  EXPECT_EQ(a.shading.front, b.shading.front);
  EXPECT_EQ(a.shading.back, b.shading.back);
  EXPECT_EQ(a.shading.indirect_front, b.shading.indirect_front);
  EXPECT_EQ(a.shading.indirect_back, b.shading.indirect_back);
}

TEST(SurfelBounces, WithoutLightBringNothing) {
  Scene dark = MakeCornellBox();
  for (Material& m : dark.materials) m.emission = Rgb();
  const Bounced b = Bounce(dark, 1000, 5);
  for (size_t i = 0; i < b.cloud.size(); ++i) {
    EXPECT_EQ(b.shading.indirect_front[i], Rgb());
    EXPECT_EQ(b.shading.front[i], Rgb());
  }
}

TEST(SurfelBounces, TheTreeAndItsGridKnowTheIrradiance) {
  const Bounced b = Bounce(MakeCornellBox(), 3000, 3);
  ASSERT_TRUE(b.tree->has_indirect());
  const SurfelGrid grid(*b.tree);
  int found = 0;
  for (uint32_t slot = 0; slot < b.tree->surfel_count(); slot += 7) {
    const Surfel s = b.tree->surfel(slot);
    const Rgb e = b.tree->indirect_of(slot, true);
    if (!(MaxComponent(e) > 0)) continue;
    const auto at = grid.FindVisible(s.position, s.normal, true);
    ASSERT_TRUE(at.has_value());
    EXPECT_EQ(at->slot, slot);
    EXPECT_TRUE(at->front);
    ++found;
  }
  EXPECT_GT(found, 100);
  Executor executor(1);
  const PointTree::Blobs direct = PointTree::Build(b.cloud, b.direct, executor);
  EXPECT_FALSE(PointTree::FromBlobs(direct.topology, direct.radiance).value()->has_indirect());
}

}  // namespace
}  // namespace farpoint

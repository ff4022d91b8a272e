#include "core/pbgi/microbuffer.h"

#include <gtest/gtest.h>

#include "tests/unit/core/pbgi/test_cloud.h"

namespace farpoint {
namespace {

struct Gathered {
  Rgb irradiance;
  double mean_coverage = 0;
};

Gathered Gather(const PointTree& tree, const CutView& view, const MicrobufferMap& map,
                Splat splat) {
  CutParams params;
  params.map = map.kind();
  params.pixel_sr = map.reference_solid_angle();
  std::vector<CutNode> cut, scratch;
  CutCounters counters;
  ComputeClusterCut(tree, view, params, cut, nullptr, counters);
  SortFrontToBack(cut, scratch);
  Microbuffer buffer(map);
  RasterCounters raster;
  RasterizeCut(tree, view, cut, splat, buffer, raster);
  Gathered out;
  double omega = 0;
  for (uint32_t p = 0; p < map.pixels(); ++p) {
    EXPECT_GE(buffer.coverage()[p], 0.0f);
    EXPECT_LE(buffer.coverage()[p], 1.0f);
    const double w =
        std::max(0.0f, view.normal.x * map.weight(0)[p] + view.normal.y * map.weight(1)[p] +
                           view.normal.z * map.weight(2)[p]);
    out.mean_coverage += w * buffer.coverage()[p];
    omega += w;
  }
  out.mean_coverage /= omega;
  out.irradiance = ConvolveCosine(buffer, nullptr, view.normal, splat);
  const Rgb literal = ConvolveCosineLiteral(buffer, nullptr, view.normal, splat);
  EXPECT_NEAR(out.irradiance.x, literal.x, 1e-5f * (1 + literal.x));
  return out;
}

// A closed sphere of radiance L seen from inside: E = pi L whatever the place and the normal.
class Furnace : public testing::TestWithParam<Splat> {};

TEST_P(Furnace, SphereOfConstantRadianceGivesPiL) {
  const auto tree = InwardSphere(20000, 2.0f, Rgb(1.0f, 0.5f, 0.25f)).Build();
  const MicrobufferMap map(BufferMap::kOctahedral, 32);
  // Coverage loses in gaps what it cannot gain where squares overlap.
  const float tolerance = GetParam() == Splat::kCoverage ? 0.05f : 0.03f;
  for (uint32_t i = 0; i < 12; ++i) {
    CutView view;
    view.normal = UniformSphere(OwenSobol(i, 0, 5), OwenSobol(i, 1, 5));
    view.position = UniformSphere(OwenSobol(i, 2, 5), OwenSobol(i, 3, 5)) * 0.8f;
    const Gathered g = Gather(*tree, view, map, GetParam());
    EXPECT_NEAR(g.irradiance.x, kPif, kPif * tolerance) << i;
    EXPECT_LE(g.irradiance.x, kPif * 1.0001f);
    EXPECT_NEAR(g.irradiance.y, 0.5f * g.irradiance.x, 1e-4f);
    EXPECT_NEAR(g.irradiance.z, 0.25f * g.irradiance.x, 1e-4f);
  }
}

INSTANTIATE_TEST_SUITE_P(Splats, Furnace, testing::Values(Splat::kCoverage, Splat::kOpaque));

// A disc of radius a at height h before a parallel receiver on its axis: form factor a²/(a² + h²).
TEST(Microbuffer, ParallelDiscHasItsFormFactor) {
  TestCloud t;
  constexpr float a = 1.0f;
  constexpr int n = 160;
  const float step = 2 * a / n;
  for (int j = 0; j < n; ++j) {
    for (int i = 0; i < n; ++i) {
      const float x = (static_cast<float>(i) + 0.5f) * step - a;
      const float y = (static_cast<float>(j) + 0.5f) * step - a;
      if (x * x + y * y < a * a) t.Add({x, y, 0}, {0, 0, -1}, step * step, Rgb(1, 1, 1));
    }
  }
  const auto tree = t.Build();
  for (const BufferMap kind : {BufferMap::kOctahedral, BufferMap::kCosine}) {
    const MicrobufferMap map(kind, 48);
    for (const float h : {0.5f, 1.0f, 2.0f}) {
      CutView view;
      view.position = {0, 0, -h};
      view.normal = {0, 0, 1};
      const Gathered g = Gather(*tree, view, map, Splat::kCoverage);
      const float expected = kPif * a * a / (a * a + h * h);
      EXPECT_NEAR(g.irradiance.x, expected, 0.03f * expected) << "h " << h;
    }
  }
}

TEST(Microbuffer, NearHidesFar) {
  // A bright wall far away, a dark wall nearer: nothing of the bright one is seen.
  TestCloud t;
  AddSquare(t, 100, 40.0f, 10.0f, {0, 0, -1}, Rgb(100, 100, 100));
  AddSquare(t, 100, 16.0f, 2.0f, {0, 0, -1}, Rgb(1, 1, 1));
  const auto tree = t.Build();
  const MicrobufferMap map(BufferMap::kOctahedral, 32);
  CutView view;
  view.normal = {0, 0, 1};
  for (const Splat splat : {Splat::kCoverage, Splat::kOpaque}) {
    // Beyond the near wall's edge (76° off the axis) some of the far one's is left: 6 % of E.
    const Gathered g = Gather(*tree, view, map, splat);
    EXPECT_LT(g.irradiance.x, kPif * 15.0f);
    EXPECT_GT(g.irradiance.x, kPif * 0.9f);
  }
}

// The dark far side of a closed object must not hide more than its front does; a sheet of which
// only the dark back is seen must hide what lies behind it.
TEST(Microbuffer, ADarkBackHidesOnlyWhatNoFrontHidesAlready) {
  const auto irradiance = [](bool front_side, bool far_side) {
    TestCloud t;
    AddSquare(t, 120, 60.0f, 12.0f, {0, 0, -1}, Rgb(1, 1, 1));  // a bright wall
    // Slats narrower than a pixel: half open, half hidden.
    for (int slat = -9; slat <= 9; ++slat) {
      for (int i = -100; i <= 100; ++i) {
        const float x = 0.4f * static_cast<float>(slat), y = 0.04f * static_cast<float>(i);
        for (int k = -2; k < 2; ++k) {
          const float dx = 0.05f * (static_cast<float>(k) + 0.5f);
          if (front_side) t.Add({x + dx, y, 4.0f}, {0, 0, -1}, 0.002f, Rgb());
          if (far_side) t.Add({x + dx, y, 4.2f}, {0, 0, 1}, 0.002f, Rgb(), Rgb());
        }
      }
    }
    const MicrobufferMap map(BufferMap::kOctahedral, 24);
    CutView view;
    view.normal = {0, 0, 1};
    return Gather(*t.Build(), view, map, Splat::kCoverage).irradiance.x;
  };
  const float open = irradiance(false, false);
  const float sheet = irradiance(true, false);
  const float object = irradiance(true, true);
  const float back = irradiance(false, true);
  EXPECT_LT(sheet, 0.9f * open);
  EXPECT_NEAR(object, sheet, 0.03f * open);  // added up it would be twice as dark
  EXPECT_NEAR(back, sheet, 0.05f * open);
}

TEST(Microbuffer, CompositeIsFarWhereNearIsOpen) {
  const MicrobufferMap map(BufferMap::kOctahedral, 16);
  Microbuffer far(map), near(map);
  for (uint32_t p = 0; p < map.pixels(); ++p) {
    far.radiance(0)[p] = 0.7f;
    far.coverage()[p] = 0.7f;
    far.depth()[p] = 5.0f;
    const bool half = p % 2 == 0;
    near.radiance(0)[p] = half ? 0.5f * 3.0f : 0.0f;
    near.coverage()[p] = half ? 0.5f : 0.0f;
  }
  far.MarkTouched();
  near.MarkTouched();
  const Vec3f n = Normalize(Vec3f(1, 2, 3));
  const Rgb fast = ConvolveCosine(far, &near, n, Splat::kCoverage);
  const Rgb literal = ConvolveCosineLiteral(far, &near, n, Splat::kCoverage);
  EXPECT_NEAR(fast.x, literal.x, 1e-5f);
  // Half of the pixels: near 0.5·3 and the far in the other half; the rest: far as it is.
  EXPECT_NEAR(fast.x, kPif * 0.5f * ((1.5f + 0.5f) + 0.7f), 0.05f);
}

// What is near and covers a pixel for the most part leaves gaps between its splats; nothing far may
// shine through them.
TEST(Microbuffer, FarIsHiddenWhereNearCoversMostOfAPixel) {
  const MicrobufferMap map(BufferMap::kOctahedral, 16);
  Microbuffer far(map), near(map);
  for (uint32_t p = 0; p < map.pixels(); ++p) {
    far.radiance(0)[p] = 100.0f;
    far.coverage()[p] = 1.0f;
    near.radiance(0)[p] = 0.8f * 2.0f;
    near.coverage()[p] = 0.8f;
  }
  far.MarkTouched();
  near.MarkTouched();
  const Vec3f n = Normalize(Vec3f(1, 2, 3));
  const Rgb fast = ConvolveCosine(far, &near, n, Splat::kCoverage);
  EXPECT_NEAR(fast.x, kPif * 2.0f, 1e-4f);
  EXPECT_NEAR(ConvolveCosineLiteral(far, &near, n, Splat::kCoverage).x, fast.x, 1e-4f);
}

TEST(Microbuffer, OpaqueCompositeTakesTheNearer) {
  const MicrobufferMap map(BufferMap::kOctahedral, 16);
  Microbuffer far(map), near(map);
  for (uint32_t p = 0; p < map.pixels(); ++p) {
    far.radiance(1)[p] = 1.0f;
    far.depth()[p] = 5.0f;
    near.radiance(1)[p] = 7.0f;
    near.depth()[p] = p % 2 == 0 ? 4.0f : 6.0f;
  }
  const Vec3f n(0, 0, 1);
  const Rgb fast = ConvolveCosine(far, &near, n, Splat::kOpaque);
  EXPECT_NEAR(fast.y, ConvolveCosineLiteral(far, &near, n, Splat::kOpaque).y, 1e-5f);
  EXPECT_NEAR(fast.y, kPif * 4.0f, 0.1f);
}

TEST(Microbuffer, NearDiscAtTheSeamOfTheMapIsWhole) {
  // The map's border is the direction -z: a surfel right there must cover what it covers elsewhere.
  const MicrobufferMap map(BufferMap::kOctahedral, 32);
  double covered[2];
  for (int k = 0; k < 2; ++k) {
    TestCloud t;
    const Vec3f d = k == 0 ? Vec3f(0, 0, -1) : Vec3f(0, 0, 1);
    t.Add(d, -d, 0.3f, Rgb(1, 1, 1));
    CutView view;
    view.normal = d;
    covered[k] = Gather(*t.Build(), view, map, Splat::kCoverage).mean_coverage;
  }
  EXPECT_GT(covered[0], 0.02);
  EXPECT_NEAR(covered[0], covered[1], 0.05 * covered[1]);
}

TEST(Microbuffer, SmallSplatConservesItsSolidAngleAnywhere) {
  const MicrobufferMap map(BufferMap::kOctahedral, 32);
  for (uint32_t i = 0; i < 200; ++i) {
    const Vec3f d = UniformSphere(OwenSobol(i, 0, 9), OwenSobol(i, 1, 9));
    TestCloud t;
    t.Add(d * 10.0f, -d, 0.1f, Rgb(1, 1, 1));
    const auto tree = t.Build();
    CutView view;
    view.normal = d;
    CutParams params;
    params.pixel_sr = map.reference_solid_angle();
    std::vector<CutNode> cut;
    CutCounters counters;
    ComputeClusterCut(*tree, view, params, cut, nullptr, counters);
    ASSERT_EQ(cut.size(), 1u);
    Microbuffer buffer(map);
    RasterCounters raster;
    RasterizeCut(*tree, view, cut, Splat::kCoverage, buffer, raster);
    double omega = 0;
    for (uint32_t p = 0; p < map.pixels(); ++p) {
      omega += static_cast<double>(buffer.coverage()[p]) * map.solid_angle()[p];
    }
    // Exact inside; at the folds of the map a square reaches into corners that do not exist.
    EXPECT_NEAR(omega, 0.001, 0.00002) << i;
  }
}

TEST(Microbuffer, ClearEmptiesIt) {
  const MicrobufferMap map(BufferMap::kOctahedral, 8);
  const auto tree = InwardSphere(500, 1.0f, Rgb(1, 1, 1)).Build();
  Microbuffer buffer(map);
  EXPECT_TRUE(buffer.empty());
  CutView view;
  view.normal = {0, 0, 1};
  CutParams params;
  params.pixel_sr = map.reference_solid_angle();
  std::vector<CutNode> cut;
  CutCounters counters;
  ComputeClusterCut(*tree, view, params, cut, nullptr, counters);
  RasterCounters raster;
  RasterizeCut(*tree, view, cut, Splat::kOpaque, buffer, raster);
  EXPECT_FALSE(buffer.empty());
  buffer.Clear();
  EXPECT_TRUE(buffer.empty());
  for (uint32_t p = 0; p < map.padded(); ++p) {
    EXPECT_EQ(buffer.radiance(0)[p], 0.0f);
    EXPECT_EQ(buffer.coverage()[p], 0.0f);
    EXPECT_TRUE(std::isinf(buffer.depth()[p]));
  }
}

}  // namespace
}  // namespace farpoint

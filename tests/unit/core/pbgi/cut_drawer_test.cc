#include "core/pbgi/cut_drawer.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <cstring>

#include "tests/unit/core/pbgi/test_cloud.h"

namespace farpoint {
namespace {

// A closed room of edge 2 about the origin, clutter around it and some within.
TestCloud Room(int clutter) {
  TestCloud t;
  constexpr int kSide = 60;
  const float step = 2.0f / kSide;
  for (int axis = 0; axis < 3; ++axis) {
    for (const float sign : {-1.0f, 1.0f}) {
      for (int j = 0; j < kSide; ++j) {
        for (int i = 0; i < kSide; ++i) {
          Vec3f p, n;
          p[axis] = sign;
          p[(axis + 1) % 3] = (static_cast<float>(i) + 0.5f) * step - 1;
          p[(axis + 2) % 3] = (static_cast<float>(j) + 0.5f) * step - 1;
          n[axis] = -sign;
          t.Add(p, n, step * step, Rgb(0.5f, 0.4f + 0.1f * sign, 0.3f), Rgb(0.1f, 0.2f, 0.3f));
        }
      }
    }
  }
  for (int i = 0; i < clutter; ++i) {
    const auto u = [&](uint64_t k) {
      return ToUnitFloat(static_cast<uint32_t>(HashKey(77, static_cast<uint64_t>(i), k)));
    };
    Vec3f p(u(0) * 12 - 6, u(1) * 12 - 6, u(2) * 12 - 6);
    if (i % 50 == 0) p = p * 0.15f;
    t.Add(p, UniformSphere(u(3), u(4)), 0.001f + 0.004f * u(5), Rgb(u(6), u(7), u(8)),
          Rgb(u(9), u(10), u(11)));
  }
  return t;
}

CutView View(uint64_t i, float extent, float radius_m, float spread) {
  const auto u = [&](uint64_t k) { return ToUnitFloat(static_cast<uint32_t>(HashKey(5, i, k))); };
  CutView v;
  v.position = Vec3f(u(0) - 0.5f, u(1) - 0.5f, u(2) - 0.5f) * (2 * extent);
  v.normal = UniformSphere(u(3), u(4));
  v.radius_m = radius_m;
  v.sin_spread = spread;
  v.cos_spread = std::sqrt(1 - spread * spread);
  v.margin_m = radius_m * spread;
  return v;
}

// The part of the cosine-weighted hemisphere in pixels that the horizon of `n` may cut.
float HorizonShare(const MicrobufferMap& map, const Vec3f& n) {
  // Twice what half a pixel's diagonal spans in the middle of the map.
  const float radius = 4.3f / static_cast<float>(map.side());
  float cut = 0, all = 0;
  for (uint32_t p = 0; p < map.pixels(); ++p) {
    const float w =
        std::max(0.0f, n.x * map.weight(0)[p] + n.y * map.weight(1)[p] + n.z * map.weight(2)[p]);
    const float height = n.x * map.dir(0)[p] + n.y * map.dir(1)[p] + n.z * map.dir(2)[p];
    all += w;
    if (height < radius) cut += w;
  }
  return cut / all;
}

struct Drawn {
  size_t nodes = 0;
  CutCounters cut;
  RasterCounters raster;
  HiddenCounters hidden;
  std::vector<NearNode> near;
};

Drawn Draw(const PointTree& tree, const MicrobufferMap& map, const CutParams& params, Splat splat,
           bool hide, const CutView& view, bool sharing, Microbuffer& buffer) {
  Drawn out;
  CutDrawer drawer(tree, map, params, splat, hide);
  out.nodes = drawer.Draw(view, sharing ? &out.near : nullptr, buffer, out.cut, out.raster,
                          out.hidden, [](CutDrawer::Part) {});
  return out;
}

class CutDrawerSplat : public testing::TestWithParam<Splat> {};

// What receivers convolve is the same to the last bit, and so are near nodes and their order.
TEST_P(CutDrawerSplat, LeavingOutWhatIsHiddenChangesNoBit) {
  for (const bool closed_room : {true, false}) {
    const auto tree = (closed_room ? Room(40000) : RandomCloud(60000, 6)).Build();
    for (const uint32_t side : {8u, 16u, 19u, 32u, 48u}) {
      const MicrobufferMap map(BufferMap::kOctahedral, side);
      CutParams params;
      params.pixel_sr = map.reference_solid_angle();
      Microbuffer all(map), seen(map);
      uint64_t hidden = 0, subtrees = 0, nodes = 0;
      for (uint64_t i = 0; i < 24; ++i) {
        const bool sharing = i % 3 != 0;
        const float spread = i % 4 == 3 ? 0.3f : 0.0f;
        CutView view = View(i, closed_room ? 0.95f : 1.8f, sharing ? 0.02f : 0.0f, spread);
        view.sees_inside = i % 5 == 4;
        const Drawn a = Draw(*tree, map, params, GetParam(), false, view, sharing, all);
        const Drawn b = Draw(*tree, map, params, GetParam(), true, view, sharing, seen);
        ASSERT_EQ(a.near.size(), b.near.size());
        for (size_t k = 0; k < a.near.size(); ++k) {
          ASSERT_EQ(a.near[k].slot, b.near[k].slot);
        }
        for (int r = 0; r < 6; ++r) {
          // Receivers of the cluster: their normals lie within its spread.
          const Frame frame(view.normal);
          const float phi = static_cast<float>(r);
          const Vec3f n = frame.ToWorld(
              {spread * std::cos(phi), spread * std::sin(phi), std::sqrt(1 - spread * spread)});
          const Rgb e = ConvolveCosine(all, nullptr, n, GetParam());
          const Rgb f = ConvolveCosine(seen, nullptr, n, GetParam());
          EXPECT_EQ(std::memcmp(&e, &f, sizeof(Rgb)), 0)
              << "side " << side << " view " << i << ": " << e.x << " " << f.x;
        }
        subtrees += b.cut.hidden_subtrees;
        hidden += b.hidden.nodes;
        EXPECT_EQ(a.cut.hidden_subtrees, 0u);
        EXPECT_EQ(a.hidden.nodes, 0u);
        nodes += b.nodes;
        EXPECT_LE(b.cut.groups_visited, a.cut.groups_visited);
        EXPECT_LE(b.nodes, a.nodes);
      }
      if (closed_room && side >= 19) {
        EXPECT_GT(hidden, nodes / 4) << side;
      }
      if (closed_room && side >= 32) {
        EXPECT_GT(subtrees, 0u) << side;
      }
      if (side < 16) {
        EXPECT_EQ(hidden, 0u);
      }
    }
  }
}

INSTANTIATE_TEST_SUITE_P(Splats, CutDrawerSplat, testing::Values(Splat::kCoverage, Splat::kOpaque));

TEST(CutDrawer, ShellsAreTheSortedCut) {
  const auto tree = RandomCloud(60000, 8).Build();
  for (uint64_t i = 0; i < 24; ++i) {
    CutParams params;
    params.pixel_sr = 0.02f;
    const bool sharing = i % 2 != 0;
    const CutView view = View(i, 1.5f, sharing ? 0.03f : 0.0f, 0.0f);
    std::vector<CutNode> cut, scratch, shells;
    std::vector<NearNode> near, near_of_shells;
    CutCounters counters, shell_counters;
    ComputeClusterCut(*tree, view, params, cut, sharing ? &near : nullptr, counters);
    SortFrontToBack(cut, scratch);
    ShellCut shell_cut(*tree, params);
    shell_cut.Start(view, sharing ? &near_of_shells : nullptr);
    std::vector<CutNode> shell;
    int count = 0;
    float from_m = 0;
    while (shell_cut.Next(nullptr, shell, shell_counters)) {
      for (const CutNode& n : shell) {
        EXPECT_GE(n.distance_m, from_m);
        EXPECT_LT(n.distance_m, shell_cut.distance_m());
      }
      from_m = shell_cut.distance_m();
      SortFrontToBack(shell, scratch);
      shells.insert(shells.end(), shell.begin(), shell.end());
      shell.clear();
      ++count;
    }
    EXPECT_GE(count, 2);
    ASSERT_EQ(shells.size(), cut.size());
    for (size_t k = 0; k < cut.size(); ++k) {
      ASSERT_EQ(std::memcmp(&shells[k], &cut[k], sizeof(CutNode)), 0) << k;
    }
    ASSERT_EQ(near_of_shells.size(), near.size());
    for (size_t k = 0; k < near.size(); ++k) EXPECT_EQ(near_of_shells[k].slot, near[k].slot);
    EXPECT_EQ(shell_counters.groups_visited, counters.groups_visited);
  }
}

TEST(CutDrawer, AnEmptyTreeDrawsNothing) {
  const auto tree = TestCloud().Build();
  const MicrobufferMap map(BufferMap::kOctahedral, 16);
  CutParams params;
  Microbuffer buffer(map);
  EXPECT_EQ(Draw(*tree, map, params, Splat::kCoverage, true, CutView(), false, buffer).nodes, 0u);
  EXPECT_TRUE(buffer.empty());
}

// Nodes of which only sides are seen that do not count draw nothing: skipping them changes no bit
// of any pixel.
TEST(CutDrawer, InvisibleSidesDrawNothing) {
  TestCloud t = RandomCloud(30000, 11);
  // Balls with insides that nobody sees.
  for (int i = 0; i < 40; ++i) {
    TestCloud ball = InwardSphere(200, 0.1f, Rgb(1, 1, 1));
    const Vec3f centre(0.3f * static_cast<float>(i % 8) - 1, 0.3f * static_cast<float>(i / 8) - 1,
                       0.5f);
    for (size_t k = 0; k < ball.cloud.size(); ++k) {
      t.Add(centre + ball.cloud.position[k], -ball.cloud.normal[k], ball.cloud.area_m2[k],
            Rgb(1, 0.5f, 0.2f), Rgb(), kFrontVisible);
    }
  }
  const auto tree = t.Build();
  const MicrobufferMap map(BufferMap::kOctahedral, 24);
  Microbuffer with(map), without(map);
  uint64_t skipped = 0;
  for (uint64_t i = 0; i < 16; ++i) {
    const CutView view = View(i, 1.5f, 0, 0);
    CutParams params;
    params.pixel_sr = map.reference_solid_angle();
    skipped +=
        Draw(*tree, map, params, Splat::kCoverage, false, view, false, with).cut.invisible_side;
    params.skip_invisible_side = false;
    const Drawn d = Draw(*tree, map, params, Splat::kCoverage, false, view, false, without);
    EXPECT_EQ(d.cut.invisible_side, 0u);
    for (int plane = 0; plane < 3; ++plane) {
      EXPECT_EQ(
          std::memcmp(with.radiance(plane), without.radiance(plane), map.padded() * sizeof(float)),
          0);
    }
    EXPECT_EQ(std::memcmp(with.coverage(), without.coverage(), map.padded() * sizeof(float)), 0);
  }
  EXPECT_GT(skipped, 0u);
}

// Nodes below the horizon reach into pixels that the horizon cuts. Those are a ring of a pixel's
// width about it: what they hold counts by its share of the cosine-weighted hemisphere.
TEST(CutDrawer, NodesBelowTheHorizonChangeTheRingAboutIt) {
  const auto tree = RandomCloud(60000, 12).Build();
  for (const uint32_t side : {16u, 32u, 64u}) {
    const MicrobufferMap map(BufferMap::kOctahedral, side);
    Microbuffer with(map), without(map);
    for (uint64_t i = 0; i < 12; ++i) {
      const CutView view = View(i, 1.5f, 0, 0);
      CutParams params;
      params.pixel_sr = map.reference_solid_angle();
      const Drawn d = Draw(*tree, map, params, Splat::kCoverage, false, view, false, with);
      EXPECT_GT(d.cut.below_horizon, 0u);
      params.skip_below_horizon = false;
      Draw(*tree, map, params, Splat::kCoverage, false, view, false, without);
      const Rgb e = ConvolveCosine(with, nullptr, view.normal, Splat::kCoverage);
      const Rgb f = ConvolveCosine(without, nullptr, view.normal, Splat::kCoverage);
      EXPECT_NEAR(e.x, f.x, HorizonShare(map, view.normal) * kPif) << side << " " << i;
      EXPECT_NE(e.x, f.x);
    }
  }
}

}  // namespace
}  // namespace farpoint

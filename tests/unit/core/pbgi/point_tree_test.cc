#include "core/pbgi/point_tree.h"

#include <gtest/gtest.h>

#include <cstring>
#include <functional>
#include <set>

#include "tests/unit/core/pbgi/test_cloud.h"

namespace farpoint {
namespace {

// Calls visit(surfel slot) for every surfel below a node.
void EachSurfel(const PointTree& tree, int level, uint32_t slot,
                const std::function<void(uint32_t)>& visit) {
  if (tree.group(slot / kLanes).radius[slot % kLanes] < 0) return;
  if (level == 0) {
    visit(slot);
    return;
  }
  for (uint32_t k = 0; k < kLanes; ++k) {
    EachSurfel(tree, level - 1, tree.ChildGroup(level, slot) * kLanes + k, visit);
  }
}

Vec3f Centre(const PointTree& t, uint32_t s) {
  const NodeGroup& g = t.group(s / kLanes);
  return {g.cx[s % kLanes], g.cy[s % kLanes], g.cz[s % kLanes]};
}
Vec3f Normal(const PointTree& t, uint32_t s) {
  const NodeGroup& g = t.group(s / kLanes);
  return {g.nx[s % kLanes], g.ny[s % kLanes], g.nz[s % kLanes]};
}

class PointTreeSize : public testing::TestWithParam<int> {};

TEST_P(PointTreeSize, NodesBoundAndSumWhatIsBelowThem) {
  const TestCloud t = RandomCloud(GetParam(), 5);
  const auto tree = t.Build();
  ASSERT_EQ(tree->surfel_count(), static_cast<uint64_t>(GetParam()));
  std::set<uint32_t> seen;
  for (uint32_t k = 0; k < kLanes; ++k) {
    EachSurfel(*tree, tree->root_level(), tree->root_group() * kLanes + k,
               [&](uint32_t s) { EXPECT_TRUE(seen.insert(s).second); });
  }
  EXPECT_EQ(seen.size(), static_cast<size_t>(GetParam()));

  for (int level = 1; level < tree->levels(); ++level) {
    const uint32_t begin = tree->first_group(level);
    const uint32_t end = level + 1 < tree->levels() ? tree->first_group(level + 1)
                                                    : static_cast<uint32_t>(tree->groups().size());
    for (uint32_t slot = begin * kLanes; slot < end * kLanes; ++slot) {
      const NodeGroup& g = tree->group(slot / kLanes);
      const uint32_t k = slot % kLanes;
      if (g.radius[k] < 0) continue;
      double area = 0, front = 0;
      Vec3d flux, normal;
      const Vec3f c = Centre(*tree, slot);
      const Vec3f unit = NormalizeOr(Normal(*tree, slot), Vec3f(0, 0, 1));
      const float cos_cone = std::sqrt(std::max(0.0f, 1 - g.sin_cone[k] * g.sin_cone[k]));
      EachSurfel(*tree, level, slot, [&](uint32_t s) {
        const NodeGroup& leaf = tree->group(s / kLanes);
        const uint32_t l = s % kLanes;
        const Vec3f offset = Centre(*tree, s) - c, n = Normal(*tree, s);
        EXPECT_LE(Length(offset) + leaf.radius[l], g.radius[k] * 1.00001f);
        const float cosine = Dot(n, unit);
        const float height = leaf.radius[l] * std::sqrt(std::max(0.0f, 1 - cosine * cosine));
        EXPECT_LE(std::fabs(Dot(offset, unit)) + height, g.thickness[k] * 1.0001f + 1e-6f);
        if (g.sin_cone[k] < 1) {
          EXPECT_GE(cosine, cos_cone - 1e-4f);
        }
        area += leaf.area[l];
        front += leaf.front_area[l];
        normal += Vec3d(n) * static_cast<double>(leaf.area[l]);
        const RadianceGroup& r = tree->radiance(s / kLanes);
        flux += Vec3d(r.lane[l].front) * static_cast<double>(leaf.front_area[l]);
      });
      EXPECT_NEAR(g.area[k], area, area * 1e-5);
      EXPECT_NEAR(g.front_area[k], front, area * 1e-5);
      EXPECT_LT(Length(Vec3f(normal / area) - Normal(*tree, slot)), 1e-5f);
      const RadianceGroup& r = tree->radiance(slot / kLanes);
      EXPECT_NEAR(r.lane[k].front.x * front, flux.x, 1e-5 * (1e-3 + flux.x));
      EXPECT_NEAR(r.lane[k].front.z * front, flux.z, 1e-5 * (1e-3 + flux.z));
    }
  }
}

TEST_P(PointTreeSize, IsTheSameForAnyNumberOfThreads) {
  const TestCloud t = RandomCloud(GetParam(), 6);
  Executor one(1), three(3);
  const auto a = PointTree::Build(t.cloud, t.shading, one);
  const auto b = PointTree::Build(t.cloud, t.shading, three);
  EXPECT_EQ(a.topology.Hash(), b.topology.Hash());
  EXPECT_EQ(a.radiance.Hash(), b.radiance.Hash());
}

INSTANTIATE_TEST_SUITE_P(Sizes, PointTreeSize, testing::Values(1, 7, 8, 9, 64, 65, 1000, 20000));

TEST_P(PointTreeSize, SidesThatALightOpensEqualThoseThatAreOpen) {
  // The same visible sides, once as open ones in the topology, once named by the radiance.
  const TestCloud t = RandomCloud(GetParam(), 7);
  Executor executor(2);
  const auto whole = PointTree::Build(t.cloud, t.shading, executor);
  for (const unsigned hidden : {1u, 3u, 255u}) {
    SurfelSides open = t.shading.visible_sides;
    for (size_t i = 0; i < open.size(); ++i) {
      const unsigned bits = static_cast<unsigned>(HashKey(hidden, i)) & hidden;
      if (hidden == 255) {
        open[i] = 0;
      } else if (i % 5 == 0) {
        open[i] = static_cast<uint8_t>(open[i] & ~bits);
      }
    }
    const auto topology = PointTree::BuildTopology(t.cloud, open, executor);
    const Blob radiance = PointTree::BuildRadiance(topology, t.cloud, open, t.shading, executor);
    const auto a = PointTree::FromBlobs(whole.topology, whole.radiance).value();
    const auto b = PointTree::FromBlobs(topology.blob, radiance).value();
    ASSERT_EQ(a->groups().size(), b->groups().size());
    for (uint32_t g = 0; g < a->groups().size(); ++g) {
      ASSERT_EQ(std::memcmp(&a->group(g), &b->group(g), sizeof(NodeGroup)), 0) << g;
      ASSERT_EQ(std::memcmp(&a->radiance(g), &b->radiance(g), sizeof(RadianceGroup)), 0) << g;
    }
  }
}

TEST(PointTree, RefusesLitSidesThatNoTreeHas) {
  TestCloud t = RandomCloud(20, 3);
  Executor executor(1);
  SurfelSides open(20, 0);
  for (auto& v : t.shading.visible_sides) v = kFrontVisible;
  const auto topology = PointTree::BuildTopology(t.cloud, open, executor);
  const Blob radiance = PointTree::BuildRadiance(topology, t.cloud, open, t.shading, executor);
  ASSERT_TRUE(PointTree::FromBlobs(topology.blob, radiance).ok());
  const auto bytes = radiance.bytes();
  // Twenty entries behind the header, the count and the padding.
  for (const uint32_t wrong : {40u, 3u, ~0u}) {
    std::vector<std::byte> changed(bytes.begin(), bytes.end());
    std::memcpy(changed.data() + 64 + 5 * 4, &wrong, 4);
    const auto tree = PointTree::FromBlobs(topology.blob, Blob::FromVector(changed));
    ASSERT_FALSE(tree.ok()) << wrong;
    EXPECT_NE(std::string(tree.status().message()).find("lit sides"), std::string::npos);
  }
}

TEST(PointTree, OfNothingIsEmpty) {
  const auto tree = TestCloud().Build();
  EXPECT_TRUE(tree->empty());
  EXPECT_FALSE(tree->lit());
}

TEST(PointTree, KnowsWhetherItIsLit) {
  TestCloud dark;
  dark.Add({0, 0, 0}, {0, 0, 1}, 1, Rgb());
  EXPECT_FALSE(dark.Build()->lit());
  dark.Add({1, 0, 0}, {0, 0, 1}, 1, Rgb(), Rgb(0, 1e-6f, 0));
  EXPECT_TRUE(dark.Build()->lit());
}

TEST(PointTree, NeighboursOnTheHilbertCurveAreNeighboursInSpace) {
  // Unit steps along the curve within a small cube: every index once, each a step of length 1.
  std::vector<Vec3d> at(512);
  std::vector<int> count(512, 0);
  for (uint32_t x = 0; x < 8; ++x) {
    for (uint32_t y = 0; y < 8; ++y) {
      for (uint32_t z = 0; z < 8; ++z) {
        const uint64_t i = HilbertIndex(x, y, z);
        ASSERT_LT(i, 512u);
        at[i] = Vec3d(x, y, z);
        ++count[i];
      }
    }
  }
  for (int i = 0; i < 512; ++i) EXPECT_EQ(count[i], 1);
  for (int i = 1; i < 512; ++i) EXPECT_EQ(Length(at[i] - at[i - 1]), 1.0) << i;
}

TEST(PointTree, RefusesDamagedBlobs) {
  const TestCloud t = RandomCloud(300, 9);
  Executor executor(1);
  const auto blobs = PointTree::Build(t.cloud, t.shading, executor);
  const auto bytes = blobs.topology.bytes();
  for (size_t size = 0; size < bytes.size(); size += 977) {
    const Blob cut = Blob::FromVector({bytes.begin(), bytes.begin() + static_cast<long>(size)});
    const auto tree = PointTree::FromBlobs(cut, blobs.radiance);
    ASSERT_FALSE(tree.ok());
    EXPECT_EQ(tree.status().code(), absl::StatusCode::kDataLoss);
  }
  // A surfel count that the groups do not have; a radiance of another tree; a NaN.
  std::vector<std::byte> changed(bytes.begin(), bytes.end());
  changed[8] = std::byte{1};
  EXPECT_FALSE(PointTree::FromBlobs(Blob::FromVector(changed), blobs.radiance).ok());
  const auto other =
      PointTree::Build(RandomCloud(310, 9).cloud, RandomCloud(310, 9).shading, executor);
  EXPECT_FALSE(PointTree::FromBlobs(blobs.topology, other.radiance).ok());
  changed.assign(bytes.begin(), bytes.end());
  for (size_t i = 0; i < 4; ++i) changed[changed.size() - 384 + i] = std::byte{0xff};
  const auto nan = PointTree::FromBlobs(Blob::FromVector(changed), blobs.radiance);
  ASSERT_FALSE(nan.ok());
  EXPECT_NE(std::string(nan.status().message()).find("values"), std::string::npos);
}

}  // namespace
}  // namespace farpoint

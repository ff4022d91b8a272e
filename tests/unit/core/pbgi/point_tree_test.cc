#include "core/pbgi/point_tree.h"

#include <gtest/gtest.h>

#include <cstddef>
#include <cstring>
#include <functional>
#include <limits>
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
  const NodeGroup g = t.group(s / kLanes);
  return {g.cx[s % kLanes], g.cy[s % kLanes], g.cz[s % kLanes]};
}
Vec3f Normal(const PointTree& t, uint32_t s) {
  const NodeGroup g = t.group(s / kLanes);
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
    const uint32_t end =
        level + 1 < tree->levels() ? tree->first_group(level + 1) : tree->group_count();
    for (uint32_t slot = begin * kLanes; slot < end * kLanes; ++slot) {
      const NodeGroup g = tree->group(slot / kLanes);
      const uint32_t k = slot % kLanes;
      if (g.radius[k] < 0) continue;
      double area = 0, front = 0, brightness = 0;
      Vec3d flux, normal;
      const Vec3f c = Centre(*tree, slot);
      const Vec3f unit = NormalizeOr(Normal(*tree, slot), Vec3f(0, 0, 1));
      const float cos_cone = std::sqrt(std::max(0.0f, 1 - g.sin_cone[k] * g.sin_cone[k]));
      EachSurfel(*tree, level, slot, [&](uint32_t s) {
        const NodeGroup leaf = tree->group(s / kLanes);
        const uint32_t l = s % kLanes;
        const Vec3f offset = Centre(*tree, s) - c, n = Normal(*tree, s);
        EXPECT_LE(Length(offset) + leaf.radius[l], g.radius[k] * 1.00001f);
        const float cosine = Dot(n, unit);
        const float sine2 = 1 - cosine * cosine / Length2(n);
        const float height = leaf.radius[l] * std::sqrt(std::max(0.0f, sine2));
        EXPECT_LE(std::fabs(Dot(offset, unit)) + height, g.thickness[k] * 1.0001f + 1e-6f);
        if (g.sin_cone[k] < 1) {
          EXPECT_GE(cosine / Length(n), cos_cone - 1e-4f);
        }
        const double leaf_area = kPi * static_cast<double>(leaf.radius[l]) * leaf.radius[l];
        area += leaf_area;
        front += leaf.front_area[l];
        normal += Vec3d(n) * leaf_area;
        const Rgb radiance = tree->radiance_of(s).front;
        flux += Vec3d(radiance) * static_cast<double>(leaf.front_area[l]);
        brightness += static_cast<double>(MaxComponent(radiance) * leaf.front_area[l]);
      });
      // Each level rounds areas to halves; normals have steps of 1 / 511, radiances 9 bits.
      EXPECT_NEAR(g.front_area[k], front, front * level * 0x1p-11);
      EXPECT_EQ(g.front_area[k] > 0, front > 0);
      EXPECT_LT(Length(Vec3f(normal / area) - Normal(*tree, slot)), 0.0018f);
      const RadianceSides r = tree->radiance_of(slot);
      const double step = 0x1p-9 * (MaxComponent(r.front) * front + 2 * brightness);
      EXPECT_NEAR(r.front.x * front, flux.x, step);
      EXPECT_NEAR(r.front.z * front, flux.z, step);
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
    ASSERT_EQ(a->group_count(), b->group_count());
    for (uint32_t g = 0; g < a->group_count(); ++g) {
      if (g < a->first_group(0) + (t.cloud.size() + kLanes - 1) / kLanes) {
        const auto &x = a->packed_surfels(g), &y = b->packed_surfels(g);
        ASSERT_EQ(std::memcmp(&x, &y, sizeof x), 0) << g;
      } else {
        const auto &x = a->packed_nodes(g), &y = b->packed_nodes(g);
        ASSERT_EQ(std::memcmp(&x, &y, sizeof x), 0) << g;
      }
      const RadianceGroup x = a->radiance(g), y = b->radiance(g);
      ASSERT_EQ(std::memcmp(&x, &y, sizeof x), 0) << g;
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

TEST(PointTree, HilbertIndicesOfEightAreThoseOfOne) {
  for (uint64_t i = 0; i < 500; ++i) {
    U8 x, y, z;
    for (uint64_t k = 0; k < kLanes; ++k) {
      x[k] = static_cast<uint32_t>(HashKey(i, k, 0) & 0xffff);
      y[k] = static_cast<uint32_t>(HashKey(i, k, 1) & 0xffff);
      z[k] = static_cast<uint32_t>(HashKey(i, k, 2) & 0xffff);
    }
    const auto indices = HilbertIndex8(x, y, z);
    for (size_t k = 0; k < kLanes; ++k) EXPECT_EQ(indices[k], HilbertIndex(x[k], y[k], z[k]));
  }
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
}

TEST(PointTree, RefusesValuesThatNoTreeHas) {
  const TestCloud t = RandomCloud(300, 9);  // 38 groups of surfels, 5 and 1 of nodes
  Executor executor(1);
  const auto blobs = PointTree::Build(t.cloud, t.shading, executor);
  const auto bytes = blobs.topology.bytes();
  const size_t surfels = 64, nodes = bytes.size() - 6 * sizeof(PackedNodes);
  struct Damage {
    size_t at;
    std::vector<uint8_t> bytes;
  };
  const size_t radius = offsetof(PackedSurfels, radius), normal = offsetof(PackedSurfels, normal);
  const std::vector<Damage> damages = {
      {surfels, {0, 0, 0xc0, 0x7f}},               // NaN as an origin
      {surfels, {0, 0, 0x80, 0x7f}},               // infinity
      {surfels + 4, {0, 0, 0, 0x7e}},              // an origin too far away for the unit
      {surfels + 12, {1, 0, 0x80, 0x3f}},          // a unit that is no power of two
      {surfels + 12, {0, 0, 0, 0}},                // none
      {surfels + 12, {0, 0, 0x80, 0xbf}},          // a negative one
      {surfels + radius, {0, 0x7c}},               // an infinite radius
      {surfels + radius, {0, 0xbc}},               // an empty slot that is not behind the last
      {surfels + normal, {0, 2, 0, 0}},            // -512 / 511
      {surfels + 37 * 112 + radius + 14, {0, 0}},  // a surfel behind the last
      {nodes + offsetof(PackedNodes, thickness), {0, 0x80}},
      {nodes + offsetof(PackedNodes, sin_cone), {1, 0x3c}},  // above 1
      {nodes + offsetof(PackedNodes, inverse_length), {0, 0x7c}},
      {nodes + offsetof(PackedNodes, front_area), {0, 0x7e}},
      {nodes + offsetof(PackedNodes, back_area), {0, 0}},  // none, but the node shows its back
  };
  ASSERT_TRUE(PointTree::FromBlobs(blobs.topology, blobs.radiance).ok());
  for (size_t i = 0; i < damages.size(); ++i) {
    std::vector<std::byte> changed(bytes.begin(), bytes.end());
    for (size_t b = 0; b < damages[i].bytes.size(); ++b) {
      changed[damages[i].at + b] = std::byte{damages[i].bytes[b]};
    }
    ASSERT_NE(std::memcmp(changed.data(), bytes.data(), bytes.size()), 0) << i;
    const auto tree = PointTree::FromBlobs(Blob::FromVector(changed), blobs.radiance);
    ASSERT_FALSE(tree.ok()) << i;
    EXPECT_EQ(tree.status().code(), absl::StatusCode::kDataLoss);
    EXPECT_NE(std::string(tree.status().message()).find("values"), std::string::npos) << i;
  }
  // The radiance's unit.
  const auto light = blobs.radiance.bytes();
  for (const float wrong : {0.0f, -1.0f, 3.0f, 1e30f, std::numeric_limits<float>::quiet_NaN()}) {
    std::vector<std::byte> changed(light.begin(), light.end());
    std::memcpy(changed.data() + 16, &wrong, sizeof wrong);
    EXPECT_FALSE(PointTree::FromBlobs(blobs.topology, Blob::FromVector(changed)).ok()) << wrong;
  }
}

TEST(PointTree, TakesFewBytes) {
  const TestCloud t = RandomCloud(20000, 2);
  Executor executor(2);
  const auto tree = t.Build();
  EXPECT_LE(static_cast<double>(tree->size_bytes()) / 20000, 26.7);
  // Also where lights open sides: then the tree has nodes of its own and lets go of the blob.
  const SurfelSides open(20000, 0);
  const auto topology = PointTree::BuildTopology(t.cloud, open, executor);
  const Blob radiance = PointTree::BuildRadiance(topology, t.cloud, open, t.shading, executor);
  const auto lit = PointTree::FromBlobs(topology.blob, radiance).value();
  EXPECT_LE(static_cast<double>(lit->size_bytes()) / 20000, 26.7 + 8);
}

TEST(PointTree, SurfelsAreWithinTheirSteps) {
  // Clustered, so that groups of all widths come about.
  TestCloud t;
  for (int i = 0; i < 3000; ++i) {
    const auto u = [&](uint64_t k) {
      return ToUnitFloat(static_cast<uint32_t>(HashKey(3, static_cast<uint64_t>(i), k)));
    };
    const float scale = i % 3 == 0 ? 10.0f : 0.01f;
    t.Add(Vec3f(u(0), u(1), u(2)) * scale, UniformSphere(u(3), u(4)), 1e-5f * (0.1f + u(5)),
          Rgb(u(6), 100 * u(7) * u(6), 0.001f));
  }
  Executor executor(1);
  const auto topology = PointTree::BuildTopology(t.cloud, t.shading.visible_sides, executor);
  const Blob radiance =
      PointTree::BuildRadiance(topology, t.cloud, t.shading.visible_sides, t.shading, executor);
  const auto tree = PointTree::FromBlobs(topology.blob, radiance).value();
  for (uint32_t slot = 0; slot < 3000; ++slot) {
    const uint32_t i = topology.order[slot];
    const uint32_t first = slot / kLanes * kLanes;
    Box3f box;
    float widest = 0;
    for (uint32_t s = first; s < first + kLanes; ++s) {
      box.Extend(t.cloud.position[topology.order[s]]);
      widest = std::max(widest, std::sqrt(t.cloud.area_m2[topology.order[s]] / kPif));
    }
    const Surfel s = tree->surfel(slot);
    const float step = std::max(MaxComponent(box.max - box.min) * 0x1p-15f, widest * 0x1p-13f);
    EXPECT_LE(MaxAbs(s.position - t.cloud.position[i]), 0.5f * step + 2e-6f) << slot;
    EXPECT_LE(MaxAbs(s.normal - t.cloud.normal[i]), 0.5f / 511 + 1e-6f);
    EXPECT_NEAR(kPif * s.radius_m * s.radius_m, t.cloud.area_m2[i], t.cloud.area_m2[i] * 0x1p-9f);
    const RadianceSides sides = tree->radiance_of(slot);
    const Rgb exact = t.shading.front[i];
    EXPECT_LE(MaxAbs(sides.front - exact), MaxComponent(exact) * 0x1p-9f);
    EXPECT_EQ(sides.front, (Rgb(tree->radiance_of(slot, true))));
    EXPECT_EQ(sides.back, (Rgb(tree->radiance_of(slot, false))));
  }
}

TEST(PointTree, AScaleByAPowerOfTwoChangesUnitsOnly) {
  const TestCloud t = RandomCloud(700, 12);
  Executor executor(1);
  const auto one = t.Build();
  for (const int power : {-20, -3, 1, 13}) {
    TestCloud scaled = t;
    const float s = std::ldexp(1.0f, power);
    for (Vec3f& p : scaled.cloud.position) p *= s;
    for (float& a : scaled.cloud.area_m2) a *= s * s;
    const auto other = scaled.Build();
    for (uint32_t g = 0; g < one->group_count(); ++g) {
      if (g < 88) {
        PackedSurfels a = one->packed_surfels(g);
        for (float& o : a.frame.origin) o *= s;
        a.frame.unit *= s;
        ASSERT_EQ(std::memcmp(&a, &other->packed_surfels(g), sizeof a), 0) << g;
      } else {
        PackedNodes a = one->packed_nodes(g);
        for (float& o : a.frame.origin) o *= s;
        a.frame.unit *= s;
        ASSERT_EQ(std::memcmp(&a, &other->packed_nodes(g), sizeof a), 0) << g;
      }
    }
  }
}

}  // namespace
}  // namespace farpoint

#include "core/pbgi/receiver_cluster.h"

#include <gtest/gtest.h>

#include <set>

#include "core/math/sampling.h"

namespace farpoint {
namespace {

// A block that sees a floor, a wall and, far behind, something round.
std::vector<Receiver> Block(float scale = 1.0f) {
  std::vector<Receiver> receivers;
  for (int y = 0; y < 32; ++y) {
    for (int x = 0; x < 32; ++x) {
      Receiver r;
      const float u = static_cast<float>(x) / 31.0f, v = static_cast<float>(y) / 31.0f;
      if (y < 12) {
        r.position = Vec3f(u, 0.0f, 3.0f + v);
        r.normal = {0, 1, 0};
      } else if (x < 20) {
        r.position = Vec3f(0.0f, v, 3.0f + u);
        r.normal = {1, 0, 0};
      } else {
        r.normal = Normalize(Vec3f(u - 0.8f, v - 0.7f, -0.4f));
        r.position = Vec3f(5, 5, 40) + r.normal * 2.0f;
      }
      r.position = r.position * scale;
      r.geometric_normal = r.normal;
      receivers.push_back(r);
    }
  }
  return receivers;
}

ClusterParams Params(uint32_t k) {
  ClusterParams p;
  p.k = k;
  p.seed_key = 99;
  return p;
}

TEST(ReceiverCluster, FastAssignmentEqualsTheLiteralOne) {
  const auto receivers = Block();
  for (const uint32_t k : {1u, 5u, 8u, 37u, 100u, 1024u}) {
    EXPECT_EQ(AssignClusters(receivers, Params(k)), AssignClustersLiteral(receivers, Params(k)))
        << "k " << k;
  }
}

// Ties go to the lower index, so a round that changes nothing is the last one: hundreds of rounds,
// odd or even, end where they would without a bound.
TEST(ReceiverCluster, RoundsEndAndDoNotCycle) {
  std::vector<Receiver> grid;  // equal distances everywhere
  for (int i = 0; i < 256; ++i) {
    Receiver r;
    r.position = Vec3f(static_cast<float>(i % 16), static_cast<float>(i / 16), 0);
    r.normal = r.geometric_normal = {0, 0, 1};
    grid.push_back(r);
  }
  // Three places only: most centres are re-seeded over and over.
  std::vector<Receiver> places = grid;
  for (size_t i = 0; i < places.size(); ++i) {
    places[i].position = Vec3f(static_cast<float>(i % 3), 0, 0);
  }
  for (const auto& receivers : {Block(), grid, places}) {
    for (const uint32_t k : {2u, 9u, 40u, 250u}) {
      for (uint64_t seed = 0; seed < 10; ++seed) {
        ClusterParams p = Params(k);
        p.seed_key = seed;
        p.iterations = 400;
        const auto end = AssignClusters(receivers, p);
        p.iterations = 401;
        EXPECT_EQ(AssignClusters(receivers, p), end) << "k " << k << " seed " << seed;
      }
    }
  }
}

TEST(ReceiverCluster, EveryReceiverIsInExactlyOneCluster) {
  const auto receivers = Block();
  for (const uint32_t k : {1u, 7u, 100u, 5000u}) {
    const auto clusters = ClusterReceivers(receivers, Params(k));
    std::set<uint32_t> seen;
    for (const ReceiverCluster& c : clusters) {
      ASSERT_FALSE(c.members.empty());
      bool active_is_member = false;
      for (const uint32_t i : c.members) {
        EXPECT_TRUE(seen.insert(i).second);
        active_is_member |= i == c.active;
        const Receiver& x = receivers[i];
        const Vec3f d = receivers[c.active].position - x.position;
        EXPECT_LE(Length(d), c.radius_m);
        EXPECT_LE(Dot(x.normal, d), c.margin_m);
        if (c.sin_spread < 1) {
          EXPECT_GE(Dot(x.normal, c.mean_normal), c.cos_spread - 1e-6f);
        }
      }
      EXPECT_TRUE(active_is_member);
    }
    EXPECT_EQ(seen.size(), receivers.size());
    EXPECT_LE(clusters.size(), std::max<size_t>(2 * k, 16));
  }
}

TEST(ReceiverCluster, EdgesInDepthAndNormalSplitClusters) {
  const auto receivers = Block();
  for (const ReceiverCluster& c : ClusterReceivers(receivers, Params(2))) {
    bool floor = false, wall = false, distant = false;
    for (const uint32_t i : c.members) {
      floor |= receivers[i].normal.y == 1.0f;
      wall |= receivers[i].normal.x == 1.0f;
      distant |= receivers[i].position.z > 30;
    }
    EXPECT_EQ(floor + wall + distant, 1);
  }
}

// Erratum of §3.1: with α a length the clusters of a scene in millimetres would differ.
TEST(ReceiverCluster, ScaleOfTheSceneChangesNothing) {
  const auto metres = AssignClusters(Block(), Params(50));
  EXPECT_EQ(metres, AssignClusters(Block(1024.0f), Params(50)));
  EXPECT_EQ(metres, AssignClusters(Block(1.0f / 4096.0f), Params(50)));
}

TEST(ReceiverCluster, FlatClusterHasNoSpread) {
  std::vector<Receiver> receivers(64);
  for (size_t i = 0; i < receivers.size(); ++i) {
    receivers[i].position = {static_cast<float>(i % 8), static_cast<float>(i / 8), 0};
    receivers[i].normal = Normalize(Vec3f(0.3f, 0.2f, 0.9f));
  }
  for (const ReceiverCluster& c : ClusterReceivers(receivers, Params(4))) {
    EXPECT_EQ(c.sin_spread, 0.0f);
    EXPECT_EQ(c.cos_spread, 1.0f);
    EXPECT_EQ(c.mean_normal, receivers[0].normal);
  }
}

TEST(ReceiverCluster, OfNothingOneAndCoincidentReceivers) {
  EXPECT_TRUE(ClusterReceivers({}, Params(10)).empty());
  std::vector<Receiver> one(1);
  one[0].normal = {0, 0, 1};
  const auto clusters = ClusterReceivers(one, Params(10));
  ASSERT_EQ(clusters.size(), 1u);
  EXPECT_EQ(clusters[0].radius_m, 0.0f);
  const std::vector<Receiver> same(100, one[0]);
  size_t members = 0;
  for (const auto& c : ClusterReceivers(same, Params(10))) members += c.members.size();
  EXPECT_EQ(members, 100u);
}

TEST(ReceiverCluster, NormalsThatCancelStillClusters) {
  std::vector<Receiver> receivers(40);
  for (size_t i = 0; i < receivers.size(); ++i) {
    receivers[i].position = {static_cast<float>(i) * 1e-3f, 0, 0};
    receivers[i].normal = {0, 0, i % 2 == 0 ? 1.0f : -1.0f};
  }
  for (const auto& c : ClusterReceivers(receivers, Params(1))) {
    EXPECT_NEAR(Length(c.mean_normal), 1.0f, 1e-5f);
    EXPECT_EQ(c.sin_spread, 0.0f);  // split into the two sides
  }
}

}  // namespace
}  // namespace farpoint

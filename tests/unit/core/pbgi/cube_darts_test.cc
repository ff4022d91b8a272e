#include "core/pbgi/cube_darts.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <numeric>

#include "core/math/sampling.h"

namespace farpoint {
namespace {

struct Point {
  Vec3f position, normal;
  CubeDarts::LocalCell cell;
};

CubeDarts::LocalCell CellOf(const Vec3f& p) {
  return {static_cast<int>(std::floor(p.x)), static_cast<int>(std::floor(p.y)),
          static_cast<int>(std::floor(p.z))};
}

float Uniform(uint64_t a, uint64_t b) { return ToUnitFloat(static_cast<uint32_t>(HashKey(a, b))); }

// Leaves with candidates in the cube [0, 16)³, cells of width 1: two crossing sheets of both
// windings, one of them crumpled.
class CubeDartsTest : public testing::Test {
 protected:
  void Make(size_t leaves, uint64_t seed) {
    darts_.Clear(1.0f);
    for (size_t i = 0; i < leaves; ++i) {
      const bool flat = i % 2 == 0;
      const Vec3f corner(Uniform(seed, 8 * i) * 14.0f, Uniform(seed, 8 * i + 1) * 14.0f,
                         flat ? 7.5f : 6.0f + 3.0f * Uniform(seed, 8 * i + 2));
      const Vec3f e1(1.7f, 0.1f, flat ? 0.0f : 0.8f), e2(0.2f, 1.6f, 0.0f);
      const Vec3f normal = Normalize(Cross(e1, e2)) * (i % 3 == 0 ? -1.0f : 1.0f);
      const CandidateLeaf leaf{
          {Vec2f{0, 0}, {1, 0}, {0, 1}}, static_cast<uint32_t>(i), 0x3fff1fffu, HashKey(seed, i)};
      ForCandidates(leaf, corner, e1, e2, {{0, 0, 0}, 1.0f}, [&](const CandidateLanes& lanes) {
        unsigned inside = 0;
        for (unsigned k = 0; k < 8; ++k) {
          const Vec3f p = lanes.position.Lane(k);
          const CubeDarts::LocalCell cell = CellOf(p);
          ASSERT_EQ(lanes.cell_x[k], static_cast<uint32_t>(cell.x));
          ASSERT_EQ(lanes.cell_y[k], static_cast<uint32_t>(cell.y));
          ASSERT_EQ(lanes.cell_z[k], static_cast<uint32_t>(cell.z));
          if ((lanes.kept >> k & 1u) == 0) continue;
          inside |= 1u << k;
          candidates_.push_back({p, normal, cell});
        }
        darts_.Add(lanes, inside, {0, 0, 0}, leaf.triangle, normal);
      });
    }
    ASSERT_EQ(darts_.candidates(), candidates_.size());
  }
  // Surfels of the neighbours, on all sides of the cube.
  void MakeSurfels(size_t count, uint64_t seed, std::vector<uint32_t>& shares) {
    shares.assign(count, 0);
    for (size_t i = 0; i < count; ++i) {
      const auto u = [&](uint64_t k) { return Uniform(seed, 8 * i + k); };
      const Vec3f p(u(0) * 20.0f - 2.0f, u(1) * 20.0f - 2.0f, u(2) * 20.0f - 2.0f);
      surfels_.push_back({p, UniformSphere(u(3), u(4)), CellOf(p)});
      darts_.AddSurfel(CellOf(p), p, surfels_.back().normal, &shares[i]);
    }
  }
  static bool Touch(const CubeDarts::LocalCell& a, const CubeDarts::LocalCell& b) {
    return std::abs(a.x - b.x) <= 1 && std::abs(a.y - b.y) <= 1 && std::abs(a.z - b.z) <= 1;
  }
  static bool SameSheet(const Point& a, const Point& b) {
    return Dot(a.normal, b.normal) > kSameSheetCosine;
  }

  CubeDarts darts_;
  std::vector<Point> candidates_, surfels_;
};

TEST_F(CubeDartsTest, ThrowsAsTheLiteralAlgorithmDoes) {
  std::vector<uint32_t> shares;
  for (uint64_t seed = 0; seed < 3; ++seed) {
    candidates_.clear();
    surfels_.clear();
    Make(60, seed);
    MakeSurfels(300, seed + 100, shares);
    std::vector<AcceptedCandidate> accepted;
    darts_.Throw(seed, accepted);

    std::vector<size_t> order(candidates_.size());
    std::iota(order.begin(), order.end(), size_t{0});
    std::vector<Point> standing = surfels_;
    std::vector<Vec3f> expected;
    uint64_t random = seed;
    for (size_t k = 0; k < order.size(); ++k) {
      random = random * 6364136223846793005ull + 1442695040888963407ull;
      std::swap(order[k], order[k + (((random >> 32) * (order.size() - k)) >> 32)]);
      const Point& c = candidates_[order[k]];
      if (std::any_of(standing.begin(), standing.end(), [&](const Point& s) {
            return Length2(s.position - c.position) < 1.0f && SameSheet(s, c);
          })) {
        continue;
      }
      standing.push_back(c);
      expected.push_back(c.position);
    }
    ASSERT_EQ(accepted.size(), expected.size());
    EXPECT_GT(accepted.size(), 50u);
    for (size_t i = 0; i < accepted.size(); ++i) EXPECT_EQ(accepted[i].position, expected[i]);
  }
}

TEST_F(CubeDartsTest, GivesEachCandidateToTheNearestOfItsSheet) {
  Make(120, 5);
  std::vector<uint32_t> shares;
  MakeSurfels(2500, 6, shares);
  darts_.AssignShares();
  std::vector<uint32_t> expected(surfels_.size(), 0);
  size_t without = 0;
  for (const Point& c : candidates_) {
    size_t nearest = surfels_.size();
    float nearest2 = 1e30f;
    for (size_t s = 0; s < surfels_.size(); ++s) {
      if (!Touch(surfels_[s].cell, c.cell) || !SameSheet(surfels_[s], c)) continue;
      const float d2 = Length2(surfels_[s].position - c.position);
      if (d2 < nearest2) {
        nearest2 = d2;
        nearest = s;
      }
    }
    if (nearest < surfels_.size()) {
      ++expected[nearest];
    } else {
      ++without;
    }
  }
  EXPECT_EQ(shares, expected);
  EXPECT_LT(without, candidates_.size() / 5);
}

TEST_F(CubeDartsTest, OfEquallyNearSurfelsOneGetsTheCandidate) {
  Make(40, 9);
  std::vector<uint32_t> shares(2 * candidates_.size(), 0);
  for (size_t i = 0; i < candidates_.size(); ++i) {
    const Point& c = candidates_[i];
    for (size_t twin = 0; twin < 2; ++twin) {
      darts_.AddSurfel(c.cell, c.position, c.normal, &shares[2 * i + twin]);
    }
  }
  darts_.AssignShares();
  uint64_t sum = 0;
  for (size_t i = 0; i < candidates_.size(); ++i) {
    EXPECT_TRUE(shares[2 * i] == 0 || shares[2 * i + 1] == 0) << i;
    sum += shares[2 * i] + shares[2 * i + 1];
  }
  EXPECT_EQ(sum, candidates_.size());
}

TEST(CandidateLanes, CellsCountModulo) {
  // A corner far outside of 2^25 cells, and one before the origin.
  const Lattice lattice{{0, 0, 0}, 1.0f};
  const F8 p = {0.5f, -0.5f, 0x1p25f, 0x1p30f + 0x1p10f, -0x1p26f, 33554430.0f, 0x1p60f, 15.99f};
  const U8 cell = lattice.CellOf(p, 0.0f);
  const std::array<uint32_t, 8> expected = {0, 33554431u, 0, 1024u, 0, 33554430u, 0, 15u};
  for (size_t k = 0; k < 8; ++k) EXPECT_EQ(cell[k], expected[k]) << k;
}

}  // namespace
}  // namespace farpoint

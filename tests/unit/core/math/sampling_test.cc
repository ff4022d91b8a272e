#include "core/math/sampling.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <numeric>
#include <set>
#include <vector>

#include "core/math/elementary.h"

namespace farpoint {
namespace {

constexpr uint32_t kSeeds[] = {0, 1, 12345, 0xffffffffu};

TEST(OwenSobol, EveryDimensionIsStratifiedInAlignedBlocks) {
  for (const uint32_t seed : kSeeds) {
    for (unsigned dimension = 0; dimension < 4; ++dimension) {
      for (const uint32_t log2_size : {0u, 1u, 5u, 10u}) {
        const uint32_t size = 1u << log2_size;
        for (const uint32_t block : {0u, 1u, 77u}) {
          std::set<uint32_t> strata;
          for (uint32_t i = 0; i < size; ++i) {
            const uint64_t bits = OwenSobolBits(block * size + i, dimension, seed);
            strata.insert(static_cast<uint32_t>(bits << log2_size >> 32));
          }
          EXPECT_EQ(strata.size(), size) << seed << " " << dimension << " " << block;
        }
      }
    }
  }
}

// The first two dimensions are a (0, k, 2)-net: each box 2^-a x 2^-(k-a) holds one point.
TEST(OwenSobol, ThePlaneIsStratifiedInEveryElementaryBox) {
  constexpr uint32_t kLog2 = 8;
  for (const uint32_t seed : kSeeds) {
    for (const uint32_t block : {0u, 3u, 1000u}) {
      for (uint32_t a = 0; a <= kLog2; ++a) {
        std::set<uint64_t> boxes;
        for (uint32_t i = 0; i < (1u << kLog2); ++i) {
          const uint32_t index = (block << kLog2) + i;
          const uint64_t x = uint64_t{OwenSobolBits(index, 0, seed)} << a >> 32;
          const uint64_t y = uint64_t{OwenSobolBits(index, 1, seed)} << (kLog2 - a) >> 32;
          boxes.insert(x << (kLog2 - a) | y);
        }
        EXPECT_EQ(boxes.size(), size_t{1} << kLog2) << seed << " " << block << " " << a;
      }
    }
  }
}

// Exact: the extrema are taken at corners of the grid that the points' coordinates span.
double StarDiscrepancy(const std::vector<Vec2f>& points) {
  std::vector<float> xs, ys;
  for (const Vec2f& p : points) {
    xs.push_back(p.x);
    ys.push_back(p.y);
  }
  xs.push_back(1);
  ys.push_back(1);
  std::sort(xs.begin(), xs.end());
  std::sort(ys.begin(), ys.end());
  double worst = 0;
  for (const float x : xs) {
    for (const float y : ys) {
      int open = 0, closed = 0;
      for (const Vec2f& p : points) {
        open += p.x < x && p.y < y;
        closed += p.x <= x && p.y <= y;
      }
      const double volume = double{x} * y, n = static_cast<double>(points.size());
      worst = std::max({worst, volume - open / n, closed / n - volume});
    }
  }
  return worst;
}

TEST(OwenSobol, HasALowerStarDiscrepancyThanRandomPoints) {
  constexpr uint32_t kCount = 256;
  for (const uint32_t seed : kSeeds) {
    std::vector<Vec2f> sobol, random;
    for (uint32_t i = 0; i < kCount; ++i) {
      sobol.push_back({OwenSobol(i, 0, seed), OwenSobol(i, 1, seed)});
      const uint64_t h = HashKey(seed, i);
      random.push_back(
          {ToUnitFloat(static_cast<uint32_t>(h)), ToUnitFloat(static_cast<uint32_t>(h >> 32))});
    }
    const double d_sobol = StarDiscrepancy(sobol), d_random = StarDiscrepancy(random);
    EXPECT_LT(d_sobol, 0.025) << seed;
    EXPECT_LT(2 * d_sobol, d_random) << seed;
  }
}

TEST(OwenSobol, SeedsGiveDifferentPointSets) {
  int same = 0;
  for (uint32_t i = 0; i < 1000; ++i) same += OwenSobolBits(i, 0, 1) == OwenSobolBits(i, 0, 2);
  EXPECT_LT(same, 2);
}

TEST(OwenSobolAxis, GivesTheSameBitsInLanes) {
  for (unsigned dimension = 0; dimension < 4; ++dimension) {
    for (const uint32_t seed : {0u, 1u, 0x9e3779b9u}) {
      const OwenSobolAxis axis(dimension, seed);
      for (uint32_t i = 0; i < 2000; ++i) {
        const uint32_t far = i * 0x01234567u;
        const U8 index = {i, i + 1, i + 7, far, far + 1, 255, 256, ~i};
        const U8 bits = axis.BitsOf(index);
        const F8 points = axis.PointsOf(index);
        for (int k = 0; k < 8; ++k) {
          ASSERT_EQ(bits[k], OwenSobolBits(index[k], dimension, seed));
          ASSERT_EQ(points[k], OwenSobol(index[k], dimension, seed));
        }
      }
    }
  }
}

TEST(OwenShuffledIndex, KeepsAlignedBlocksTogetherAndLosesNone) {
  for (const uint32_t seed : kSeeds) {
    for (const uint32_t log2_size : {2u, 8u}) {
      for (uint32_t block = 0; block < 4; ++block) {
        std::set<uint32_t> visited;
        for (uint32_t i = 0; i < (1u << log2_size); ++i) {
          visited.insert(OwenShuffledIndex((block << log2_size) + i, seed));
        }
        EXPECT_EQ(visited.size(), size_t{1} << log2_size);
        EXPECT_EQ(*visited.begin() >> log2_size, *visited.rbegin() >> log2_size);
      }
    }
  }
}

TEST(ToUnitFloat, IsBelowOne) {
  EXPECT_EQ(ToUnitFloat(0), 0.0f);
  EXPECT_LT(ToUnitFloat(0xffffffffu), 1.0f);
  EXPECT_EQ(ToUnitFloat(0x80000000u), 0.5f);
}

// Flipping one bit of the input flips each bit of the output with probability 1/2: of 64 x 64
// pairs over 256 keys, each count is binomial(256, 1/2); 6 sigma is 48.
TEST(Mix64, HasFullAvalanche) {
  for (int in = 0; in < 64; ++in) {
    int flips[64] = {};
    for (uint64_t key = 0; key < 256; ++key) {
      const uint64_t x = Mix64(key * 0x1234567ull);
      const uint64_t difference = Mix64(x) ^ Mix64(x ^ (uint64_t{1} << in));
      for (int out = 0; out < 64; ++out) flips[out] += static_cast<int>(difference >> out & 1);
    }
    for (const int count : flips) ASSERT_NEAR(count, 128, 48) << in;
  }
}

TEST(HashKey, DependsOnOrderAndNumberOfParts) {
  EXPECT_NE(HashKey(1, 2), HashKey(2, 1));
  EXPECT_NE(HashKey(1), HashKey(1, 0));
  EXPECT_NE(HashKey(0, 0), HashKey(0, 0, 0));
}

// Averages over 2^16 quasi-random points; the errors of these smooth integrands are far below the
// tolerance, a wrong measure is far above it.
template <typename F>
double Mean(F&& f) {
  constexpr uint32_t kCount = 1u << 16;
  double sum = 0;
  for (uint32_t i = 0; i < kCount; ++i) sum += f(OwenSobol(i, 0, 5), OwenSobol(i, 1, 5));
  return sum / kCount;
}

TEST(ConcentricDisc, PreservesArea) {
  for (const double r2 : {0.1, 0.3, 0.7, 0.95}) {
    EXPECT_NEAR(Mean([&](float u, float v) {
                  const Vec2f d = ConcentricDisc(u, v);
                  return double{d.x} * d.x + double{d.y} * d.y < r2 ? 1.0 : 0.0;
                }),
                r2, 2e-3);
  }
  // The octants about the axes have equal shares.
  EXPECT_NEAR(Mean([](float u, float v) {
                const Vec2f d = ConcentricDisc(u, v);
                return d.x > 0 && d.y > 0 && d.y < d.x ? 1.0 : 0.0;
              }),
              0.125, 2e-3);
  EXPECT_EQ(ConcentricDisc(0.5f, 0.5f), Vec2f{});
}

TEST(CosineHemisphere, HasTheMomentsOfCosineOverPi) {
  const auto moment = [](auto&& f) {
    return Mean([&](float u, float v) { return static_cast<double>(f(CosineHemisphere(u, v))); });
  };
  EXPECT_NEAR(moment([](const Vec3f& w) { return w.z; }), 2.0 / 3.0, 1e-4);
  EXPECT_NEAR(moment([](const Vec3f& w) { return w.z * w.z; }), 0.5, 1e-4);
  EXPECT_NEAR(moment([](const Vec3f& w) { return w.x; }), 0.0, 1e-4);
  EXPECT_NEAR(moment([](const Vec3f& w) { return w.y; }), 0.0, 1e-4);
  EXPECT_NEAR(moment([](const Vec3f& w) { return w.x * w.x; }), 0.25, 1e-4);
  EXPECT_NEAR(moment([](const Vec3f& w) { return w.x * w.y; }), 0.0, 1e-4);
  EXPECT_NEAR(moment([](const Vec3f& w) { return w.x * w.x * w.z * w.z; }), 1.0 / 12.0, 1e-4);
}

TEST(CosineHemisphere, IsUnitAndAboveTheHorizon) {
  for (uint32_t i = 0; i < 4096; ++i) {
    const Vec3f w = CosineHemisphere(OwenSobol(i, 0, 3), OwenSobol(i, 1, 3));
    ASSERT_NEAR(Length(w), 1.0f, 1e-6f);
    ASSERT_GE(w.z, 0.0f);
  }
  const float last = ToUnitFloat(0xffffffffu);
  for (const float u : {0.0f, last}) {
    for (const float v : {0.0f, last}) EXPECT_TRUE(IsFinite(CosineHemisphere(u, v)));
  }
}

TEST(CosineHemisphere8, IsThatOfOneLane) {
  for (uint32_t i = 0; i < 20000; ++i) {
    F8 u, v;
    for (uint32_t k = 0; k < 8; ++k) {
      u[k] = OwenSobol(8 * i + k, 0, 5);
      v[k] = OwenSobol(8 * i + k, 1, 5);
    }
    // The centre, the edges and the diagonals of the square.
    if (i == 0) {
      u = F8{0.5f, 0, 0, 0.99999994f, 0.5f, 0.25f, 0.75f, 0};
      v = F8{0.5f, 0, 0.5f, 0.99999994f, 0, 0.75f, 0.25f, 0.99999994f};
    }
    const V8 w = CosineHemisphere8(u, v);
    for (size_t k = 0; k < 8; ++k) {
      const Vec3f one = CosineHemisphere(u[k], v[k]);
      ASSERT_LT(std::fabs(w.x[k] - one.x), 4e-7f) << u[k] << " " << v[k];
      ASSERT_LT(std::fabs(w.y[k] - one.y), 4e-7f) << u[k] << " " << v[k];
      // At the horizon a rounding error in x or y is its square root in z.
      ASSERT_LT(std::fabs(w.z[k] * w.z[k] - one.z * one.z), 8e-7f) << u[k] << " " << v[k];
      ASSERT_GE(w.z[k], 0.0f);
    }
  }
}

TEST(UniformSphere, HasTheMomentsOfTheSphere) {
  for (int axis = 0; axis < 3; ++axis) {
    EXPECT_NEAR(Mean([&](float u, float v) { return double{UniformSphere(u, v)[axis]}; }), 0.0,
                1e-4);
    EXPECT_NEAR(Mean([&](float u, float v) {
                  const double w = UniformSphere(u, v)[axis];
                  return w * w;
                }),
                1.0 / 3.0, 1e-4);
  }
  EXPECT_NEAR(Mean([](float u, float v) { return double{Length(UniformSphere(u, v))}; }), 1.0,
              1e-6);
}

TEST(UniformTriangle, HasTheMomentsOfTheTriangle) {
  EXPECT_NEAR(Mean([](float u, float v) { return double{UniformTriangle(u, v).x}; }), 1 / 3., 1e-4);
  EXPECT_NEAR(Mean([](float u, float v) { return double{UniformTriangle(u, v).y}; }), 1 / 3., 1e-4);
  EXPECT_NEAR(Mean([](float u, float v) {
                const Vec2f b = UniformTriangle(u, v);
                return double{b.x} * b.x;
              }),
              1 / 6., 1e-4);
  EXPECT_NEAR(Mean([](float u, float v) {
                const Vec2f b = UniformTriangle(u, v);
                return double{b.x} * b.y;
              }),
              1 / 12., 1e-4);
}

TEST(UniformTriangle, StaysInsideAndFillsItsQuarters) {
  // The four triangles that the edges' midpoints cut have equal shares.
  int quarter[4] = {};
  constexpr uint32_t kCount = 1u << 16;
  for (uint32_t i = 0; i < kCount; ++i) {
    const Vec2f b = UniformTriangle(OwenSobol(i, 0, 9), OwenSobol(i, 1, 9));
    ASSERT_GE(b.x, 0.0f);
    ASSERT_GE(b.y, 0.0f);
    ASSERT_LE(b.x + b.y, 1.0f);
    ++quarter[b.x > 0.5f ? 0 : b.y > 0.5f ? 1 : b.x + b.y < 0.5f ? 2 : 3];
  }
  for (const int count : quarter) EXPECT_NEAR(count / double{kCount}, 0.25, 2e-3);
}

}  // namespace
}  // namespace farpoint

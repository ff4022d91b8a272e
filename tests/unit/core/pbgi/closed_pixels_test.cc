#include "core/pbgi/closed_pixels.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <limits>

#include "core/math/sampling.h"
#include "tests/unit/core/pbgi/test_cloud.h"

namespace farpoint {
namespace {

bool IsClosed(const ClosedPixels& closed, uint32_t pixel) {
  const auto side = closed.map().side();
  return closed.closed_square(static_cast<int>(pixel % side), static_cast<int>(pixel / side)) > 0;
}

bool IsClosed(const ClosedPixels& closed, const Vec3f& w) {
  const Vec2f at = closed.map().Project(w);
  const auto last = static_cast<int>(closed.map().side()) - 1;
  return closed.closed_square(std::min(static_cast<int>(at.x), last),
                              std::min(static_cast<int>(at.y), last)) > 0;
}

// A view whose horizons hide nothing.
CutView Everywhere() {
  CutView view;
  view.normal = {0, 0, 1};
  view.sin_spread = 1;
  view.cos_spread = 0;
  return view;
}

TEST(ClosedPixels, FullOnesAndThoseWellBehindWhatTheyShow) {
  const MicrobufferMap map(BufferMap::kOctahedral, 16);
  Microbuffer buffer(map);
  ClosedPixels closed(map);
  buffer.coverage()[3] = 1.0f;
  buffer.depth()[3] = 9.0f;
  buffer.coverage()[4] = kFullFrom;
  buffer.depth()[4] = 1.0f;
  buffer.coverage()[5] = 0.8f;
  buffer.depth()[5] = 2.0f;
  closed.Find(buffer, Everywhere(), Splat::kCoverage, 2.0f, 0.1f);
  EXPECT_TRUE(IsClosed(closed, 3));
  EXPECT_FALSE(IsClosed(closed, 4));
  EXPECT_FALSE(IsClosed(closed, 5));
  EXPECT_EQ(closed.full(), 1u);
  closed.Find(buffer, Everywhere(), Splat::kCoverage, 2.0f * kDepthJump + 1e-3f, 0.1f);
  EXPECT_TRUE(IsClosed(closed, 5));
  // Opaque: what is shown must lie before all that a disc can reach.
  closed.Find(buffer, Everywhere(), Splat::kOpaque, 2.0f, 0.1f);
  EXPECT_TRUE(IsClosed(closed, 4));
  EXPECT_FALSE(IsClosed(closed, 5));
  EXPECT_FALSE(IsClosed(closed, 3));
  EXPECT_FALSE(IsClosed(closed, 200));
}

TEST(ClosedPixels, BelowTheHorizonOnlyWhatNobodyWeighs) {
  for (const uint32_t side : {16u, 21u, 32u}) {
    const MicrobufferMap map(BufferMap::kOctahedral, side);
    const Microbuffer buffer(map);
    ClosedPixels closed(map);
    for (const float spread : {0.0f, 0.4f}) {
      CutView view;
      view.normal = Normalize(Vec3f(0.3f, -0.8f, 0.4f));
      view.sin_spread = spread;
      view.cos_spread = std::sqrt(1 - spread * spread);
      closed.Find(buffer, view, Splat::kCoverage, 1, 0.1f);
      EXPECT_EQ(closed.full(), 0u);
      uint32_t count = 0;
      for (uint32_t p = 0; p < map.pixels(); ++p) count += IsClosed(closed, p);
      if (side == 32 && spread == 0) {
        EXPECT_GT(count, map.pixels() / 4);
      }
      // Directions above some receiver's horizon fall on no closed pixel.
      for (uint32_t i = 0; i < 20000; ++i) {
        const Vec3f w = UniformSphere(OwenSobol(i, 0, 9), OwenSobol(i, 1, 9));
        EXPECT_FALSE(Dot(w, view.normal) >= -spread && IsClosed(closed, w));
      }
    }
  }
}

// Boxes of all sizes, across the borders too, against a look at each of their pixels.
TEST(ClosedPixels, BoxesAreClosedIfAllTheirPixelsAre) {
  const MicrobufferMap map(BufferMap::kOctahedral, 19);
  Microbuffer buffer(map);
  ClosedPixels closed(map);
  const int n = static_cast<int>(map.side());
  // One column or row over a border may be asked of the map itself.
  const auto wrap = [&](int i, int j) {
    while (i < 0 || i >= n || j < 0 || j >= n) {
      if (i < 0 || i >= n) {
        i = i < 0 ? -1 - i : 2 * n - 1 - i;
        j = n - 1 - j;
      } else {
        j = j < 0 ? -1 - j : 2 * n - 1 - j;
        i = n - 1 - i;
      }
    }
    return j * n + i;
  };
  for (int i = -1; i <= n; ++i) {
    for (int j = -1; j <= n; ++j) EXPECT_EQ(wrap(i, j), map.Wrap(i, j));
  }
  size_t said = 0, true_ones = 0;
  for (uint32_t round = 0; round < 300; ++round) {
    const auto u = [&](uint64_t k) {
      return ToUnitFloat(static_cast<uint32_t>(HashKey(round, k)));
    };
    // A few open pixels.
    std::fill_n(buffer.coverage(), map.padded(), 1.0f);
    std::vector<int32_t> open;
    for (uint64_t k = 0; k < 1 + round % 4; ++k) {
      open.push_back(static_cast<int32_t>(u(k) * static_cast<float>(map.pixels())));
      buffer.coverage()[open.back()] = 0.0f;
    }
    closed.Find(buffer, Everywhere(), Splat::kCoverage, 1, 0);
    V8 w;
    F8 half;
    for (size_t k = 0; k < 8; ++k) {
      w.SetLane(k, UniformSphere(u(10 + k), u(20 + k)));
      half[k] = 9.0f * u(30 + k) * u(40 + k);
    }
    if (round % 50 == 0) half[2] = std::numeric_limits<float>::quiet_NaN();
    const ClosedPixels::Places at = closed.At(w);
    const unsigned all = closed.AllClosed(at, half);
    for (size_t k = 0; k < 8; ++k) {
      const Vec2f projected = map.Project(w.Lane(k));
      EXPECT_EQ(at.u[k], projected.x);
      EXPECT_EQ(at.v[k], projected.y);
      const int32_t pixel = std::min(static_cast<int>(projected.y), n - 1) * n +
                            std::min(static_cast<int>(projected.x), n - 1);
      EXPECT_EQ(at.solid_angle[k], map.solid_angle()[pixel]);
      const bool says = (all >> k & 1u) != 0;
      if (!(half[k] < 8)) {
        EXPECT_FALSE(says);
        continue;
      }
      bool truth = true;
      const auto floor = [](float x) { return static_cast<int>(std::floor(x)); };
      for (int j = floor(at.v[k] - half[k]); j <= floor(at.v[k] + half[k]); ++j) {
        for (int i = floor(at.u[k] - half[k]); i <= floor(at.u[k] + half[k]); ++i) {
          truth &= std::find(open.begin(), open.end(), wrap(i, j)) == open.end();
        }
      }
      EXPECT_TRUE(!says || truth) << round << " " << k;
      said += says;
      true_ones += truth;
    }
  }
  // It says yes often enough to be of use.
  EXPECT_GT(said, true_ones * 3 / 4);
}

// Directions within an angle fall within the reach of their middle, on pixels that are not smaller.
TEST(ClosedPixels, ReachBoundsTheImageOfACap) {
  for (const uint32_t side : {16u, 33u, 64u}) {
    const MicrobufferMap map(BufferMap::kOctahedral, side);
    const ClosedPixels closed(map);
    const auto n = static_cast<float>(side);
    for (uint64_t round = 0; round < 60; ++round) {
      const auto u = [&](uint64_t k) {
        return ToUnitFloat(static_cast<uint32_t>(HashKey(side, round, k)));
      };
      V8 w;
      F8 angle;
      for (size_t k = 0; k < 8; ++k) {
        Vec3f axis = UniformSphere(u(k), u(10 + k));
        // Corners and edges of the octahedron now and then.
        if (round % 6 == 1) axis = NormalizeOr(Vec3f(axis.x, 0, 0), {0, 0, 1});
        if (round % 6 == 2) axis = NormalizeOr(Vec3f(0, axis.y, axis.z), {0, 0, 1});
        w.SetLane(k, axis);
        angle[k] = 0.6f * u(20 + k);
      }
      const ClosedPixels::Places middle = closed.At(w);
      const ClosedPixels::Reach reach = closed.ReachAbout(w, angle);
      for (size_t k = 0; k < 8; ++k) {
        const Frame frame(w.Lane(k));
        for (uint32_t i = 0; i < 100; ++i) {
          const float a = angle[k] * std::sqrt(OwenSobol(i, 0, 3));
          const float phi = 6.2831853f * OwenSobol(i, 1, 3);
          const Vec3f d = frame.ToWorld(
              {std::sin(a) * std::cos(phi), std::sin(a) * std::sin(phi), std::cos(a)});
          const Vec2f at = map.Project(d);
          // As it is, or across one border or two.
          float off = std::numeric_limits<float>::infinity();
          for (const Vec2f copy : {at, Vec2f{-at.x, n - at.y}, Vec2f{2 * n - at.x, n - at.y},
                                   Vec2f{n - at.x, -at.y}, Vec2f{n - at.x, 2 * n - at.y}}) {
            for (const Vec2f c : {copy, Vec2f{copy.x < n / 2 ? n + copy.x : copy.x - n,
                                              copy.y < n / 2 ? n + copy.y : copy.y - n}}) {
              off = std::min(off,
                             std::max(std::fabs(c.x - middle.u[k]), std::fabs(c.y - middle.v[k])));
            }
          }
          EXPECT_LE(off, reach.px_per_rad[k] * angle[k] * 1.0001f + 1e-3f) << round << " " << k;
          const int last = static_cast<int>(side) - 1;
          const int pixel = std::min(static_cast<int>(at.y), last) * static_cast<int>(side) +
                            std::min(static_cast<int>(at.x), last);
          EXPECT_GE(map.solid_angle()[pixel], reach.least_pixel_sr[k] * 0.9999f);
        }
      }
    }
  }
}

}  // namespace
}  // namespace farpoint

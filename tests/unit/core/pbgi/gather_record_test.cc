#include "core/pbgi/gather_record.h"

#include <gtest/gtest.h>

#include <cmath>
#include <functional>
#include <limits>

#include "core/math/elementary.h"
#include "core/math/sampling.h"

namespace farpoint {
namespace {

// What is seen along a unit direction of the world from a point: radiance, and distance (inf:
// nothing; negative: not seen).
struct Seen {
  Rgb radiance;
  float distance_m;
};
using Surroundings = std::function<Seen(const Vec3f& x, const Vec3f& w)>;

HemisphereSamples Sample(const HemisphereGrid& grid, const Frame& frame, const Vec3f& x,
                         const Surroundings& world, uint64_t key) {
  HemisphereSamples s(grid);
  grid.Directions(key, s.direction(0), s.direction(1), s.direction(2));
  for (uint32_t j = 0; j < grid.rings(); ++j) {
    for (uint32_t k = 0; k < grid.sectors(); ++k) {
      const size_t at = size_t{j} * grid.stride() + k;
      const Seen seen =
          world(x, frame.ToWorld({s.direction(0)[at], s.direction(1)[at], s.direction(2)[at]}));
      s.inverse_distance()[at] = seen.distance_m < 0 ? -1.0f : 1.0f / seen.distance_m;
      if (seen.distance_m < 0) continue;
      for (int c = 0; c < 3; ++c) s.radiance(c)[at] = seen.radiance[c];
    }
  }
  return s;
}

const Surroundings kRandom = [](const Vec3f&, const Vec3f& w) {
  const auto u = [&](int i) {
    return ToUnitFloat(static_cast<uint32_t>(HashKey(static_cast<uint64_t>((w.x + 2) * 1e6f),
                                                     static_cast<uint64_t>((w.y + 2) * 1e6f),
                                                     static_cast<uint64_t>(i))));
  };
  const float pick = u(0);
  const float distance = pick < 0.1f   ? -1.0f
                         : pick < 0.2f ? std::numeric_limits<float>::infinity()
                                       : 0.1f + 10 * u(1);
  return Seen{distance > 0 && std::isfinite(distance) ? Rgb(u(2), u(3), u(4)) : Rgb(), distance};
};

TEST(HemisphereGrid, DirectionsLieInTheirStrata) {
  for (const uint32_t samples : {1u, 4u, 64u, 363u, 1024u, 5000u}) {
    const HemisphereGrid grid(samples);
    EXPECT_NEAR(grid.size(), samples, 4.0 + std::sqrt(static_cast<double>(samples)));
    AlignedVector<float> x(grid.padded()), y(grid.padded()), z(grid.padded());
    for (const bool centres : {false, true}) {
      if (centres) {
        grid.Centres(x.data(), y.data(), z.data());
      } else {
        grid.Directions(7, x.data(), y.data(), z.data());
      }
      for (uint32_t j = 0; j < grid.rings(); ++j) {
        for (uint32_t k = 0; k < grid.sectors(); ++k) {
          const size_t at = size_t{j} * grid.stride() + k;
          EXPECT_NEAR(x[at] * x[at] + y[at] * y[at] + z[at] * z[at], 1, 2e-6);
          EXPECT_GE(z[at], 0);
          const double sin2 = x[at] * x[at] + y[at] * y[at];
          EXPECT_GE(sin2, static_cast<double>(j) / grid.rings() - 2e-6);
          EXPECT_LE(sin2, static_cast<double>(j + 1) / grid.rings() + 2e-6);
          double phi = std::atan2(static_cast<double>(y[at]), static_cast<double>(x[at]));
          if (phi < 0) phi += 2 * M_PI;
          const double sector = phi / (2 * M_PI) * grid.sectors();
          const double off = std::min(std::fabs(sector - (k + 0.5)),
                                      grid.sectors() - std::fabs(sector - (k + 0.5)));
          if (sin2 > 1e-4) {
            EXPECT_LE(off, 0.5 + 1e-3);
          }
        }
      }
    }
  }
}

TEST(HemisphereGrid, MoreDirectionsOfAStratumCoverItEvenly) {
  const HemisphereGrid grid(363);
  AlignedVector<float> x0(grid.padded()), y0(grid.padded()), z0(grid.padded());
  grid.Directions(9, x0.data(), y0.data(), z0.data());
  for (const uint32_t ring : {0u, 4u, grid.rings() - 1}) {
    for (const uint32_t sector : {0u, 17u, grid.sectors() - 1}) {
      constexpr uint32_t kCount = 64;
      alignas(32) float x[kCount], y[kCount], z[kCount];
      grid.DirectionsIn(ring, sector, 9, 0, kCount, x, y, z);
      const size_t at = size_t{ring} * grid.stride() + sector;
      EXPECT_EQ(x[0], x0[at]);
      EXPECT_EQ(y[0], y0[at]);
      EXPECT_EQ(z[0], z0[at]);
      alignas(32) float later[3][8];
      grid.DirectionsIn(ring, sector, 9, 40, 3, later[0], later[1], later[2]);
      EXPECT_EQ(later[0][2], x[42]);
      // A quarter of them, give or take two, in each quarter of the stratum.
      int quarters[4] = {};
      for (uint32_t i = 0; i < kCount; ++i) {
        const double sin2 = x[i] * x[i] + y[i] * y[i];
        double phi = std::atan2(static_cast<double>(y[i]), static_cast<double>(x[i]));
        if (phi < 0) phi += 2 * M_PI;
        const double u = sin2 * grid.rings() - ring, v = phi / (2 * M_PI) * grid.sectors() - sector;
        EXPECT_GT(u, -1e-3);
        EXPECT_LT(u, 1 + 1e-3);
        EXPECT_GT(v, -1e-2);
        EXPECT_LT(v, 1 + 1e-2);
        ++quarters[(u > 0.5 ? 1 : 0) + (v > 0.5 ? 2 : 0)];
      }
      for (const int n : quarters) EXPECT_NEAR(n, 16, 3) << ring << " " << sector;
    }
  }
}

TEST(GatherRecord, EqualsTheLiteralSums) {
  for (const uint32_t samples : {1u, 16u, 64u, 250u, 1024u}) {
    const HemisphereGrid grid(samples);
    const Frame frame(Normalize(Vec3f(0.3f, -0.5f, 0.8f)));
    HemisphereSamples s = Sample(grid, frame, {}, kRandom, samples);
    for (uint32_t at = 0; at < grid.padded(); ++at) {
      s.radiance(3)[at] = s.radiance(0)[at] > s.radiance(1)[at] ? 1.0f : 0.25f * s.radiance(2)[at];
    }
    const GatherRecord a = MakeGatherRecord(grid, s, {1, 2, 3}, frame);
    const GatherRecord b = MakeGatherRecordLiteral(grid, s, {1, 2, 3}, frame);
    EXPECT_EQ(a.position, b.position);
    EXPECT_EQ(a.normal, b.normal);
    EXPECT_NEAR(a.harmonic_distance_m, b.harmonic_distance_m, 1e-4f * b.harmonic_distance_m);
    for (int c = 0; c < 3; ++c) {
      EXPECT_NEAR(a.irradiance[c], b.irradiance[c], 1e-5) << samples;
      for (int i = 0; i < 3; ++i) EXPECT_NEAR(a.gradient[c][i], b.gradient[c][i], 2e-4) << samples;
      for (int i = 0; i < 3; ++i) EXPECT_NEAR(a.vector[c][i], b.vector[c][i], 2e-4) << samples;
    }
    EXPECT_GT(b.openness, 0.1f);
    EXPECT_NEAR(a.openness, b.openness, 1e-5) << samples;
    for (int i = 0; i < 3; ++i) EXPECT_NEAR(a.open_gradient[i], b.open_gradient[i], 2e-4);
    for (int i = 0; i < 3; ++i) EXPECT_NEAR(a.open_vector[i], b.open_vector[i], 2e-4);
    EXPECT_EQ(a.unhidden, 0.0f);

    // What is unhidden is summed alike, and changes nothing else.
    HemisphereSamples with(grid, true);
    for (uint32_t at = 0; at < grid.padded(); ++at) {
      for (int i = 0; i < 3; ++i) with.direction(i)[at] = s.direction(i)[at];
      for (int c = 0; c < 4; ++c) with.radiance(c)[at] = s.radiance(c)[at];
      with.inverse_distance()[at] = s.inverse_distance()[at];
      with.unhidden()[at] = s.radiance(3)[at];
    }
    GatherRecord c = MakeGatherRecord(grid, with, {1, 2, 3}, frame);
    const GatherRecord d = MakeGatherRecordLiteral(grid, with, {1, 2, 3}, frame);
    EXPECT_EQ(c.unhidden, a.openness);
    EXPECT_EQ(c.unhidden_gradient, a.open_gradient);
    EXPECT_EQ(c.unhidden_vector, a.open_vector);
    EXPECT_EQ(d.unhidden, b.openness);
    EXPECT_EQ(d.unhidden_gradient, b.open_gradient);
    EXPECT_EQ(d.unhidden_vector, b.open_vector);
    EXPECT_EQ(c.irradiance, a.irradiance);
    EXPECT_EQ(c.gradient, a.gradient);
    EXPECT_EQ(c.vector, a.vector);
    EXPECT_EQ(c.openness, a.openness);
    EXPECT_EQ(c.open_gradient, a.open_gradient);
    EXPECT_EQ(c.harmonic_distance_m, a.harmonic_distance_m);
  }
}

TEST(GatherRecord, WhatIsUnhiddenIsCarriedWithinBounds) {
  GatherRecord r;
  r.normal = {0, 0, 1};
  r.unhidden = 2;
  r.unhidden_gradient = {1, 0, 0};
  r.unhidden_vector = {0, 0, 2};
  EXPECT_EQ(UnhiddenAt(r, {}, {0, 0, 1}), 2.0f);
  EXPECT_NEAR(UnhiddenAt(r, {0.25f, 3, 0}, {0, 0, 1}), 2.25f, 1e-6);
  EXPECT_NEAR(UnhiddenAt(r, {-5, 0, 0}, {0, 0, 1}), 1.0f, 1e-6);  // by half of it at most
  EXPECT_NEAR(UnhiddenAt(r, {5, 0, 0}, {0, 0, 1}), kPif, 1e-6);   // never above π
  EXPECT_NEAR(UnhiddenAt(r, {}, {0, 1, 0}), 2.0f, 1e-6);  // a turn reveals as much as it hides
  r.unhidden_vector = {0, 1, 2};
  EXPECT_NEAR(UnhiddenAt(r, {}, Normalize(Vec3f(0, 3, 4))), 2.6f, 1e-5);
}

TEST(GatherRecord, AConstantSkyGivesPiTimesItsRadianceAndNoGradient) {
  const HemisphereGrid grid(400);
  const Frame frame(Vec3f(0, 0, 1));
  const Surroundings sphere = [](const Vec3f&, const Vec3f&) { return Seen{Rgb(2, 3, 4), 5.0f}; };
  const GatherRecord r = MakeGatherRecord(grid, Sample(grid, frame, {}, sphere, 1), {}, frame);
  EXPECT_NEAR(r.harmonic_distance_m, 5, 1e-4);
  for (int c = 0; c < 3; ++c) {
    EXPECT_NEAR(r.irradiance[c], kPi * (2 + c), 1e-4);
    EXPECT_NEAR(Length(r.gradient[c]), 0, 1e-5);
  }
  EXPECT_NEAR(IrradianceAt(r, {0.1f, 0.2f, 0}, {0, 0, 1}).y, kPi * 3, 1e-4);
}

TEST(GatherRecord, NothingSeenIsDarkAndFinite) {
  const HemisphereGrid grid(100);
  const Frame frame(Vec3f(0, 1, 0));
  for (const float distance : {-1.0f, std::numeric_limits<float>::infinity()}) {
    const Surroundings empty = [&](const Vec3f&, const Vec3f&) { return Seen{Rgb(), distance}; };
    const GatherRecord r = MakeGatherRecord(grid, Sample(grid, frame, {}, empty, 1), {}, frame);
    EXPECT_EQ(r.irradiance, Rgb());
    EXPECT_EQ(r.harmonic_distance_m, std::numeric_limits<float>::infinity());
    EXPECT_EQ(IrradianceAt(r, {5, 5, 5}, {1, 0, 0}), Rgb());
  }
}

// A plane at height h over the receivers, lit on the side x > 0 of an edge: E(x) and dE/dx have
// the closed form of a half plane, E = pi/2 (1 + x / sqrt(x² + h²)).
TEST(GatherRecord, GradientOfAnEdgeOverheadIsThatOfTheClosedForm) {
  const float h = 2;
  const Surroundings half = [&](const Vec3f& x, const Vec3f& w) {
    if (!(w.z > 1e-4f)) return Seen{Rgb(), std::numeric_limits<float>::infinity()};
    const float t = h / w.z;
    return Seen{x.x + t * w.x > 0 ? Rgb(1, 1, 1) : Rgb(), t};
  };
  const Frame frame(Vec3f(0, 0, 1));
  const HemisphereGrid grid(16384);
  for (const float x : {-3.0f, -1.0f, 0.0f, 0.7f, 2.5f}) {
    const Vec3f p(x, 0.4f, 0);
    const GatherRecord r = MakeGatherRecord(grid, Sample(grid, frame, p, half, 3), p, frame);
    const double e = M_PI / 2 * (1 + x / std::hypot(x, h));
    const double slope = M_PI / 2 * h * h / std::pow(std::hypot(x, h), 3);
    EXPECT_NEAR(r.irradiance.x, e, 0.01 * M_PI) << x;
    EXPECT_NEAR(r.gradient[0].x, slope, 0.08 * M_PI / 2 / h) << x;
    EXPECT_NEAR(r.gradient[0].y, 0, 0.05) << x;
    EXPECT_NEAR(r.gradient[0].z, 0, 1e-6) << x;
  }
}

// An occluder close to the receiver hides half of a bright far plane: the border moves with the
// near one.
TEST(GatherRecord, ANearOccluderSetsTheGradient) {
  const float near = 0.5f, far = 50;
  const Surroundings hidden = [&](const Vec3f& x, const Vec3f& w) {
    if (!(w.z > 1e-4f)) return Seen{Rgb(), std::numeric_limits<float>::infinity()};
    const float t = near / w.z;
    if (x.x + t * w.x < 0) return Seen{Rgb(), t};
    return Seen{Rgb(1, 1, 1), far / w.z};
  };
  const Frame frame(Vec3f(0, 0, 1));
  const HemisphereGrid grid(16384);
  const GatherRecord r = MakeGatherRecord(grid, Sample(grid, frame, {}, hidden, 3), {}, frame);
  EXPECT_NEAR(r.gradient[0].x, M_PI / 2 / near, 0.1 * M_PI / 2 / near);
}

// A smooth sky: E(n) of other normals, to first order in the turn: what lies below the new horizon
// is counted as negative, and what is new is missing, together of order π L δ² / 2.
TEST(GatherRecord, TurnsToOtherNormals) {
  // L = 1 + w·d: E(n) = pi + 2 pi / 3 n·d for a whole sphere of it.
  const Vec3f d = Normalize(Vec3f(1, 2, -0.5f)) * 0.8f;
  const Surroundings sky = [&](const Vec3f&, const Vec3f& w) {
    const float l = 1 + Dot(w, d);
    return Seen{Rgb(l, l, l), 10.0f};
  };
  const Vec3f n0 = Normalize(Vec3f(0.2f, 0.9f, 0.3f));
  const HemisphereGrid grid(4096);
  const Frame frame(n0);
  const GatherRecord r = MakeGatherRecord(grid, Sample(grid, frame, {}, sky, 3), {}, frame);
  for (const float tilt : {0.0f, 0.1f, 0.3f}) {
    const Vec3f n = Normalize(n0 + Vec3f(tilt, 0, -tilt));
    const double expected = M_PI + 2 * M_PI / 3 * static_cast<double>(Dot(n, d));
    EXPECT_NEAR(IrradianceAt(r, {}, n).x, expected, 0.004 * M_PI + M_PI * tilt * tilt) << tilt;
  }
}

TEST(GatherRecord, CarriesAtMostDoubleAndAtLeastHalf) {
  GatherRecord r;
  r.normal = Vec3f(0, 0, 1);
  r.irradiance = Rgb(1, 1, 1);
  for (Vec3f& g : r.gradient) g = Vec3f(100, 0, 0);
  EXPECT_FLOAT_EQ(IrradianceAt(r, {1, 0, 0}, r.normal).x, 2);
  EXPECT_FLOAT_EQ(IrradianceAt(r, {-1, 0, 0}, r.normal).x, 0.5f);
  EXPECT_FLOAT_EQ(IrradianceAt(r, {0.001f, 0, 0}, r.normal).x, 1.1f);
}

}  // namespace
}  // namespace farpoint

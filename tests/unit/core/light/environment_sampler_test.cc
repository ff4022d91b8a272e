#include "core/light/environment_sampler.h"

#include <gtest/gtest.h>

#include <cmath>
#include <functional>
#include <memory>
#include <utility>
#include <vector>

#include "core/base/executor.h"
#include "core/math/elementary.h"
#include "core/math/sampling.h"
#include "core/scene/environment_image.h"
#include "tests/unit/core/accel/brute_force.h"

namespace farpoint {
namespace {

using Colour = std::function<Rgb(uint32_t x, uint32_t y)>;

struct Sky {
  Sky(uint32_t width, uint32_t height, const Colour& colour, const Rgb& constant = Rgb(),
      const Vec3d& up = {0, 1, 0}, double rotation_deg = 0) {
    Environment& e = description.environment;
    e.sky = constant;
    e.map_width = width;
    e.map_height = height;
    for (uint32_t y = 0; y < height; ++y) {
      for (uint32_t x = 0; x < width; ++x) e.map.push_back(colour(x, y));
    }
    EXPECT_TRUE(OrientEnvironmentMap(up, rotation_deg, e).ok());
    Executor executor(1);
    auto prepared = PreparedScene::Prepare(description, executor);
    EXPECT_TRUE(prepared.ok()) << prepared.status();
    scene = *prepared;
    sampler = std::make_unique<EnvironmentSampler>(*scene);
  }

  // The unshadowed irradiance by `samples` stratified directions.
  Vec3d Estimate(const Vec3f& n, uint32_t samples, uint32_t seed) const {
    EnvironmentSampler::View view;
    sampler->LookAlong(n, view);
    Vec3d sum;
    for (uint32_t i = 0; i < samples; ++i) {
      const auto draw = sampler->Sample(view, OwenSobolBits(i, 0, seed) * 0x1p-32,
                                        OwenSobolBits(i, 1, seed) * 0x1p-32);
      if (draw) sum += Vec3d(draw->contribution);
    }
    return sum / samples;
  }

  // ∫ L(ω) (n·ω)⁺ dω by a fine grid over the sphere and the scene's own lookup.
  Vec3d Integral(const Vec3f& n) const {
    constexpr int kRows = 1200, kColumns = 2400;
    Vec3d sum;
    for (int y = 0; y < kRows; ++y) {
      const double latitude = kPi * (0.5 - (y + 0.5) / kRows), c = std::cos(latitude);
      Vec3d row;
      for (int x = 0; x < kColumns; ++x) {
        const double longitude = 2 * kPi * (x + 0.5) / kColumns;
        const Vec3f w(Vec3d(std::sin(longitude) * c, std::sin(latitude), std::cos(longitude) * c));
        const auto cosine = static_cast<double>(Dot(n, w));
        if (cosine > 0) row += Vec3d(scene->EnvironmentRadiance(w)) * cosine;
      }
      sum += row * c;
    }
    return sum * (kPi / kRows * 2 * kPi / kColumns);
  }

  Scene description;
  std::shared_ptr<const PreparedScene> scene;
  std::unique_ptr<const EnvironmentSampler> sampler;
};

double RelativeRms(const Sky& sky, const Vec3f& n, uint32_t samples, double expected) {
  double sum = 0;
  for (uint32_t seed = 0; seed < 64; ++seed) {
    const double d = sky.Estimate(n, samples, seed).x - expected;
    sum += d * d;
  }
  return std::sqrt(sum / 64) / expected;
}

Rgb Mixed(uint32_t x, uint32_t y) {
  const auto f = static_cast<float>((x * 7 + y * 13) % 11);
  return {0.2f + f, 1.0f, f * f * 0.1f};
}

TEST(EnvironmentSampler, MatchesTheIntegralOfWhatIsLookedUp) {
  const Sky skies[] = {Sky(13, 7, Mixed),
                       Sky(1, 2, [](uint32_t, uint32_t y) { return Rgb(y == 0 ? 4.0f : 1.0f); }),
                       Sky(2, 1, [](uint32_t x, uint32_t) { return Rgb(x == 0 ? 4.0f : 0.0f); }),
                       Sky(200, 100, Mixed, {1, 0, 3}, {1, 1, 0}, 33)};
  TestRandom random(1);
  for (const Sky& sky : skies) {
    for (int i = 0; i < 4; ++i) {
      const Vec3f n = i == 0 ? Vec3f(0, 1, 0) : Vec3f(random.Direction());
      const Vec3d expected = sky.Integral(n), e = sky.Estimate(n, 1 << 17, 5);
      for (int c = 0; c < 3; ++c) EXPECT_NEAR(e[c], expected[c], 2e-3 * expected[c] + 1e-6) << c;
    }
  }
}

// All but one texel of the same colour, that one nearly: as a sky of that colour.
TEST(EnvironmentSampler, AnAlmostConstantMapIsASky) {
  for (const auto& [width, height] : {std::pair{2u, 1u}, {64u, 32u}, {301u, 150u}}) {
    const Sky sky(width, height,
                  [](uint32_t x, uint32_t y) { return Rgb(x + y == 0 ? 2.0002f : 2.0f); });
    TestRandom random(2);
    for (int i = 0; i < 8; ++i) {
      const Vec3f n(random.Direction());
      EXPECT_NEAR(sky.Estimate(n, 1 << 16, 1).x, 2 * kPi, 2e-3 * kPi);
      // As few samples as are usual are good.
      EXPECT_LT(RelativeRms(sky, n, 32, 2 * kPi), 0.05) << width;
    }
  }
}

// A sun of four texels that sends a thousand times as much as all the rest.
TEST(EnvironmentSampler, ATinySunConvergesAtOnce) {
  const Sky sky(1024, 512, [](uint32_t x, uint32_t y) {
    return Rgb((x == 300 || x == 301) && (y == 100 || y == 101) ? 3e8f : 1.0f);
  });
  // Its direction, and its irradiance on a facing surface.
  const double longitude = kPi * (1 - 2 * 301 / 1024.0), latitude = kPi * (0.5 - 101 / 512.0);
  const Vec3d to_sun(std::sin(longitude) * std::cos(latitude), std::sin(latitude),
                     std::cos(longitude) * std::cos(latitude));
  const double facing = 3e8 * 4 * 2 * kPi * kPi / (1024.0 * 512) * std::cos(latitude);
  for (const double cosine : {1.0, 0.7, 0.2, 0.05}) {
    const Vec3d side = Normalize(Cross(to_sun, Vec3d(0.3, 1, 0)));
    const Vec3f n(to_sun * cosine + side * std::sqrt(1 - cosine * cosine));
    EXPECT_NEAR(sky.Estimate(n, 16, 1).x, facing * cosine + kPi, 0.02 * facing * cosine);
    EXPECT_LT(RelativeRms(sky, n, 16, facing * cosine), 0.02);
  }
  // Below the horizon it costs nothing: what is left of the map is as good as a map without it.
  const Vec3f away(Vec3d(0, -1, 0));
  EXPECT_LT(RelativeRms(sky, away, 32, kPi), 0.05);
  // Just below it, too: the sun is a cell of its own.
  const Vec3d side = Normalize(Cross(to_sun, Vec3d(0.3, 1, 0)));
  EXPECT_LT(RelativeRms(sky, Vec3f(Normalize(side - to_sun * 0.1)), 32, kPi), 0.06);
}

// In the sun's shadow the rest of the map still has half of the samples, exactly.
TEST(EnvironmentSampler, ASunTakesHalfOfTheSamplesAtMost) {
  const auto drawn_of_sun = [](float radiance) {
    const Sky sky(512, 256, [&](uint32_t x, uint32_t y) {
      return Rgb((x == 255 || x == 256) && y == 40 ? radiance : 1.0f);
    });
    EnvironmentSampler::View view;
    sky.sampler->LookAlong({0, 1, 0}, view);
    int count = 0;
    for (uint32_t i = 0; i < 32; ++i) {
      const auto draw = sky.sampler->Sample(view, OwenSobolBits(i, 0, 9) * 0x1p-32,
                                            OwenSobolBits(i, 1, 9) * 0x1p-32);
      count += draw && sky.scene->EnvironmentRadiance(draw->direction).x > 1 ? 1 : 0;
    }
    return count;
  };
  EXPECT_EQ(drawn_of_sun(1e9f), 16);
  EXPECT_EQ(drawn_of_sun(1e5f), 16);
  EXPECT_EQ(drawn_of_sun(2000), 4);
}

TEST(EnvironmentSampler, DirectionsAreUnitAboveTheHorizonAndLit) {
  const Sky sky(64, 32, [](uint32_t x, uint32_t y) { return y < 16 && x < 9 ? Rgb(2) : Rgb(); });
  TestRandom random(4);
  int drawn = 0;
  for (int i = 0; i < 200; ++i) {
    const Vec3f n(random.Direction());
    EnvironmentSampler::View view;
    sky.sampler->LookAlong(n, view);
    for (int s = 0; s < 20; ++s) {
      const double u = s == 0 ? 0 : s == 1 ? 1 - 0x1p-32 : random.Uniform();
      const auto draw = sky.sampler->Sample(view, u, s == 2 ? 0 : random.Uniform());
      if (!draw) continue;
      ++drawn;
      EXPECT_NEAR(Length(draw->direction), 1, 1e-6);
      EXPECT_GT(Dot(draw->direction, n), -1e-6);
      EXPECT_TRUE(IsFinite(draw->contribution));
      EXPECT_GT(draw->contribution.x, 0);
      EXPECT_GT(sky.scene->EnvironmentRadiance(draw->direction).x, 0);
    }
  }
  EXPECT_GT(drawn, 500);
  // Of a light below the horizon nothing is drawn.
  const Sky spot(64, 32, [](uint32_t x, uint32_t y) { return x == 32 && y == 4 ? Rgb(9) : Rgb(); });
  EnvironmentSampler::View view;
  spot.sampler->LookAlong({0, -1, 0}, view);
  EXPECT_FALSE(spot.sampler->Sample(view, 0.5, 0.5).has_value());
  spot.sampler->LookAlong({0, 1, 0}, view);
  EXPECT_TRUE(spot.sampler->Sample(view, 0.5, 0.5).has_value());
}

TEST(EnvironmentSampler, RadianceScalesExactlyByPowersOfTwo) {
  const auto scaled = [](float scale) {
    return Sky(40, 20, [scale](uint32_t x, uint32_t y) { return Mixed(x, y) * scale; });
  };
  const Sky one = scaled(1);
  for (const float scale : {0x1p-30f, 0.5f, 0x1p20f}) {
    const Sky other = scaled(scale);
    for (uint32_t seed = 0; seed < 20; ++seed) {
      const Vec3f n(Normalize(Vec3d(1, seed - 7.5, 2)));
      EXPECT_EQ(other.Estimate(n, 16, seed),
                one.Estimate(n, 16, seed) * static_cast<double>(scale));
    }
  }
}

// Turning map and normal together turns what is drawn.
TEST(EnvironmentSampler, TurnsWithTheMap) {
  const Sky still(40, 20, Mixed), turned(40, 20, Mixed, {}, {0, 1, 0}, 90);
  const Vec3f n(Normalize(Vec3d(0.3, 0.5, 0.8))), n_turned(n.z, n.y, -n.x);
  EXPECT_NEAR(Length(still.Estimate(n, 4096, 3) - turned.Estimate(n_turned, 4096, 3)), 0, 1e-3);
  EXPECT_GT(Length(still.Estimate(n, 4096, 3) - turned.Estimate(n, 4096, 3)), 0.01);
}

}  // namespace
}  // namespace farpoint

#include "bench/accuracy_checks.h"

#include <gtest/gtest.h>

#include <cmath>

#include "bench/accuracy_frame.h"
#include "core/math/sampling.h"

namespace farpoint {
namespace {

// A plane seen from above, one metre a pixel; E is given.
Film PlaneWith(int width, int height, const std::function<float(int x, int y)>& irradiance) {
  Film film({0, 0, width, height},
            {Layer::kNormal, Layer::kPosition, Layer::kDepth, Layer::kIrradiance});
  for (int y = 0; y < height; ++y) {
    for (int x = 0; x < width; ++x) {
      const float e = irradiance(x, y);
      const float n[] = {0, 1, 0}, z[] = {100};
      const float p[] = {static_cast<float>(x), 0, static_cast<float>(y)};
      const float rgb[] = {e, e, e};
      film.Set(Layer::kNormal, x, y, n);
      film.Set(Layer::kPosition, x, y, p);
      film.Set(Layer::kDepth, x, y, z);
      film.Set(Layer::kIrradiance, x, y, rgb);
    }
  }
  return film;
}

TEST(Seams, ASlopeHasNoJumps) {
  const Film film =
      PlaneWith(64, 48, [](int x, int y) { return 2.0f + 0.01f * static_cast<float>(x + 2 * y); });
  const std::vector<PixelPair> pairs = SmoothPairs(film);
  // All pixels with two before and one after.
  EXPECT_EQ(pairs.size(), size_t{61 * 48 + 64 * 45});
  for (const PixelPair& p : pairs) EXPECT_LT(JumpOf(film, p), 1e-5);
}

TEST(Seams, AStepAtBordersIsFoundAtItsPeriodOnly) {
  const Film film = PlaneWith(128, 64, [](int x, int) { return x / 32 % 2 == 1 ? 1.02f : 1.0f; });
  const std::vector<PixelPair> pairs = SmoothPairs(film);
  const JumpFigures at_32 = GridJumps(film, pairs, 32);
  // Three columns of 64 pairs with a step, one row of 128 without.
  EXPECT_EQ(at_32.pairs, 3u * 64 + 128);
  EXPECT_NEAR(at_32.jump, 0.0198 * 192 / 320, 1e-4);
  EXPECT_NEAR(at_32.jump_beside, 0, 1e-6);
  EXPECT_GT(at_32.jump, 3 * at_32.excess_error);
  const JumpFigures at_8 = GridJumps(film, pairs, 8);
  EXPECT_LT(at_8.jump, at_32.jump / 3);
}

TEST(Seams, WhatTheBordersCrossIsNotTheirs) {
  // A striped band about the line x = 32: as rough beside the border as on it.
  const Film film =
      PlaneWith(64, 64, [](int x, int) { return x > 20 && x < 44 && x % 2 == 1 ? 1.05f : 1.0f; });
  const JumpFigures jumps = GridJumps(film, SmoothPairs(film), 32);
  EXPECT_GT(jumps.jump, 0.02);
  EXPECT_NEAR(jumps.jump, jumps.jump_beside, 1e-4);
}

TEST(Seams, NoiseHasNoBorders) {
  const Film film = PlaneWith(160, 160, [](int x, int y) {
    const uint64_t bits = HashKey(7, static_cast<uint64_t>(x), static_cast<uint64_t>(y));
    return 1.0f + 0.05f * ToUnitFloat(static_cast<uint32_t>(bits >> 32));
  });
  const std::vector<PixelPair> pairs = SmoothPairs(film);
  for (const int period : {8, 32}) {
    const JumpFigures jumps = GridJumps(film, pairs, period);
    EXPECT_LT(std::fabs(jumps.jump - jumps.jump_beside), 5 * jumps.excess_error) << period;
    EXPECT_GT(jumps.excess_error, 0) << period;
    EXPECT_LT(jumps.excess_error, 0.1 * jumps.jump) << period;
  }
}

TEST(Seams, EdgesOfSurfacesDoNotCount) {
  Film film = PlaneWith(32, 8, [](int, int) { return 1.0f; });
  const size_t all = SmoothPairs(film).size();
  const float up[] = {0, 0, 1};
  for (int y = 0; y < 8; ++y) film.Set(Layer::kNormal, 16, y, up);
  EXPECT_LT(SmoothPairs(film).size(), all);
  for (const PixelPair& p : SmoothPairs(film)) {
    // Four pixels in a row stay clear of column 16.
    EXPECT_TRUE(p.vertical || p.x + 1 < 16 || p.x - 2 > 16) << p.x;
  }
  const float infinite[] = {std::numeric_limits<float>::infinity()};
  Film background = PlaneWith(32, 8, [](int, int) { return 1.0f; });
  for (int y = 0; y < 8; ++y) {
    for (int x = 0; x < 32; ++x) background.Set(Layer::kDepth, x, y, infinite);
  }
  EXPECT_TRUE(SmoothPairs(background).empty());
}

TEST(Seams, DarkPixelsDoNotCount) {
  const Film film = PlaneWith(32, 8, [](int x, int) { return x < 16 ? 1.0f : 0.001f; });
  for (const PixelPair& p : SmoothPairs(film)) EXPECT_LT(p.x, 16);
}

// The largest irradiance that pt finds from a camera.
float TracedMaximum(const Scene& scene, const Camera& camera) {
  Executor executor(2);
  RenderSettings settings;
  settings.integrator = Integrator::kPt;
  settings.paths = 64;
  settings.light_samples = 4;
  const LoadedFrame loaded = LoadFrame(scene, camera, 32, 32, settings, nullptr, executor).value();
  settings.layers = {Layer::kIrradiance, Layer::kDirectIrradiance};
  const Film film = RenderByTiles(loaded.frame, settings, executor).value().film;
  float max = 0;
  for (const Layer layer : film.layers()) {
    for (int c = 0; c < 3; ++c) {
      for (const float v : film.Plane(layer, c)) max = std::max(max, v);
    }
  }
  return max;
}

TEST(Leak, TheDarkSidesAreDarkInTruth) {
  for (const double thickness : {0.0, 0.02, 0.2}) {
    const Scene room = MakeDarkRoom(thickness);
    EXPECT_EQ(TracedMaximum(room, room.cameras[0]), 0) << thickness;
    EXPECT_GT(TracedMaximum(room, room.cameras[1]), 0.5f) << thickness;
    const Scene split = MakeSplitRoom(thickness);
    EXPECT_EQ(TracedMaximum(split, split.cameras[0]), 0) << thickness;
    EXPECT_GT(TracedMaximum(split, split.cameras[1]), 0.5f) << thickness;
  }
}

FlickerFrame FrameOf(std::vector<Rgb> truth) {
  FlickerFrame frame;
  frame.hit.assign(truth.size(), 1);
  frame.truth_error.assign(truth.size(), Rgb());
  frame.truth = std::move(truth);
  return frame;
}

TEST(Flicker, WhatTheTruthDoesIsNone) {
  const std::vector<FlickerFrame> truth = {FrameOf({Rgb(1), Rgb(2)}), FrameOf({Rgb(3), Rgb(1)})};
  // A constant error does not flicker either.
  const std::vector<std::vector<Rgb>> image = {{Rgb(1.5f), Rgb(2)}, {Rgb(3.5f), Rgb(1)}};
  EXPECT_NEAR(FlickerOf(image, truth).change, 0, 1e-6);
}

TEST(Flicker, IsTheChangeOverTheMean) {
  const std::vector<FlickerFrame> truth(3, FrameOf({Rgb(2), Rgb(2)}));
  std::vector<std::vector<Rgb>> image = {
      {Rgb(2), Rgb(2)}, {Rgb(2.2f), Rgb(1.8f)}, {Rgb(2), Rgb(2)}};
  const Flicker flicker = FlickerOf(image, truth);
  EXPECT_NEAR(flicker.change, 0.1, 1e-6);
  EXPECT_NEAR(flicker.error, 0, 1e-6);
  // A pixel that hits nothing in the middle has no change left.
  std::vector<FlickerFrame> hidden = truth;
  hidden[1].hit[0] = 0;
  image[1][0] = Rgb(99);
  const Flicker one = FlickerOf(image, hidden);
  EXPECT_EQ(one.change, 0) << "one pixel has no spread";
}

TEST(Flicker, TheTruthsNoiseIsTakenOut) {
  // Truth: 1 with independent noise in two halves; the image is exact.
  constexpr size_t kPixels = 4000;
  std::vector<FlickerFrame> truth;
  const std::vector<std::vector<Rgb>> image(6, std::vector<Rgb>(kPixels, Rgb(1)));
  std::vector<std::vector<Rgb>> shaking;
  for (uint64_t t = 0; t < 6; ++t) {
    FlickerFrame& frame = truth.emplace_back(FrameOf(std::vector<Rgb>(kPixels)));
    std::vector<Rgb>& shaken = shaking.emplace_back(kPixels);
    for (uint64_t i = 0; i < kPixels; ++i) {
      const auto noise = [&](uint64_t k) {
        return ToUnitFloat(static_cast<uint32_t>(HashKey(t, i, k) >> 32)) - 0.5f;
      };
      const float a = 1 + 0.2f * noise(1), b = 1 + 0.2f * noise(2);
      frame.truth[i] = Rgb(0.5f * (a + b));
      frame.truth_error[i] = Rgb(0.5f * std::fabs(a - b));
      shaken[i] = Rgb(1 + 0.1f * noise(3));
    }
  }
  const Flicker still = FlickerOf(image, truth);
  // The noise alone would be sqrt(2) 0.2 / sqrt(12) / sqrt(2) = 0.058.
  EXPECT_LT(std::fabs(still.change), 0.015);
  const Flicker shaken = FlickerOf(shaking, truth);
  EXPECT_NEAR(shaken.change, std::sqrt(2.0) * 0.1 / std::sqrt(12.0), 4 * shaken.error);
  EXPECT_LT(shaken.error, 0.005);
}

}  // namespace
}  // namespace farpoint

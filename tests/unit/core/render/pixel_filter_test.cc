#include "core/render/pixel_filter.h"

#include <gtest/gtest.h>

#include <cmath>

#include "core/math/sampling.h"

namespace farpoint {
namespace {

constexpr PixelFilter kAll[] = {PixelFilter::kBox, PixelFilter::kTriangle, PixelFilter::kGaussian,
                                PixelFilter::kBlackmanHarris};

TEST(PixelFilter, SamplesStayWithinTheSupportAndAreSymmetric) {
  for (const PixelFilter filter : kAll) {
    for (const float width : {0.01f, 1.0f, 3.0f, 16.0f}) {
      const PixelFilterSampler sampler(filter, width);
      float last = -width;
      for (int i = 0; i <= 1000; ++i) {
        const float u = std::min(static_cast<float>(i) / 1000, 0x1.fffffep-1f);
        const Vec2f p = sampler.Sample(u, 0.5f);
        EXPECT_LE(std::fabs(p.x), 0.5f * width) << NameOf(filter) << " " << u;
        EXPECT_GE(p.x, last) << NameOf(filter) << " " << u;
        last = p.x;
        EXPECT_NEAR(p.y, 0, 1e-4 * width) << NameOf(filter);
        EXPECT_NEAR(p.x, -sampler.Sample(1.0f - u < 1.0f ? 1.0f - u : 0x1.fffffep-1f, 0).x,
                    width * 2e-3)
            << NameOf(filter) << " " << u;
      }
    }
  }
}

// ∫ x² k / ∫ k over [-1, 1], by hand: box 1/3; triangle 1/6; gaussian and blackman-harris by the
// trapezium rule on their formulas, which the header states.
double Variance(PixelFilter filter) {
  double sum = 0, weight = 0;
  const int n = 20000;
  for (int i = 0; i < n; ++i) {
    const double x = -1 + 2.0 * (i + 0.5) / n;
    double k = 1;
    if (filter == PixelFilter::kTriangle) k = 1 - std::fabs(x);
    if (filter == PixelFilter::kGaussian) k = std::exp(-4.5 * x * x) - std::exp(-4.5);
    if (filter == PixelFilter::kBlackmanHarris) {
      k = 0.35875 + 0.48829 * std::cos(M_PI * x) + 0.14128 * std::cos(2 * M_PI * x) +
          0.01168 * std::cos(3 * M_PI * x);
    }
    sum += x * x * k;
    weight += k;
  }
  return sum / weight;
}

TEST(PixelFilter, MomentsAreThoseOfTheFilter) {
  EXPECT_NEAR(Variance(PixelFilter::kBox), 1.0 / 3, 1e-6);
  EXPECT_NEAR(Variance(PixelFilter::kTriangle), 1.0 / 6, 1e-6);
  for (const PixelFilter filter : kAll) {
    const float width = 3;
    const PixelFilterSampler sampler(filter, width);
    double mean = 0, square = 0;
    const int n = 1 << 14;
    for (int i = 0; i < n; ++i) {
      const Vec2f p = sampler.Sample((static_cast<float>(i) + 0.5f) / n, 0.3f);
      mean += p.x;
      square += static_cast<double>(p.x) * p.x;
    }
    EXPECT_NEAR(mean / n, 0, 1e-4) << NameOf(filter);
    const double h = 0.5 * width;
    EXPECT_NEAR(square / n, Variance(filter) * h * h, 1e-3) << NameOf(filter);
  }
}

TEST(PixelFilter, APixelsSamplesAreItsOwnAndOneIsItsCentre) {
  const PixelFilterSampler sampler(PixelFilter::kBox, 1);
  const Vec2f one = SamplePosition(sampler, 5, 1, 3, 4, 0);
  EXPECT_EQ(one.x, 0.5f);
  EXPECT_EQ(one.y, 0.5f);
  // Each quarter of the pixel has one of four.
  for (const uint64_t seed : {0u, 1u}) {
    for (int x = 0; x < 8; ++x) {
      unsigned quarters = 0;
      for (uint32_t s = 0; s < 4; ++s) {
        const Vec2f p = SamplePosition(sampler, seed, 4, x, 2, s);
        ASSERT_GE(p.x, 0);
        ASSERT_LE(p.x, 1);
        quarters |= 1u << (2 * (p.x >= 0.5f) + (p.y >= 0.5f));
      }
      EXPECT_EQ(quarters, 15u) << x;
    }
  }
  EXPECT_NE(SamplePosition(sampler, 0, 4, 1, 2, 0).x, SamplePosition(sampler, 0, 4, 2, 2, 0).x);
  EXPECT_NE(SamplePosition(sampler, 0, 4, 1, 2, 0).x, SamplePosition(sampler, 1, 4, 1, 2, 0).x);
}

}  // namespace
}  // namespace farpoint

#include "core/image/rgb_image.h"

#include <gtest/gtest.h>

#include "core/math/sampling.h"

namespace farpoint {
namespace {

// The definition: one sum over both kernels, borders clamped.
float Direct(const ImagePlane& image, std::span<const float> kx, std::span<const float> ky, int x,
             int y) {
  double sum = 0;
  for (int j = 0; j < static_cast<int>(ky.size()); ++j) {
    for (int i = 0; i < static_cast<int>(kx.size()); ++i) {
      const int sx = std::clamp(x + i - static_cast<int>(kx.size() / 2), 0, image.width - 1);
      const int sy = std::clamp(y + j - static_cast<int>(ky.size() / 2), 0, image.height - 1);
      sum += double{kx[static_cast<size_t>(i)]} * ky[static_cast<size_t>(j)] * image.Row(sy)[sx];
    }
  }
  return static_cast<float>(sum);
}

TEST(FilterSeparable, EqualsTheTwoDimensionalSum) {
  const float kx[5] = {0.1f, -0.3f, 0.5f, 0.2f, 0.7f}, ky[3] = {1.0f, -0.5f, 0.25f};
  for (const auto& [w, h] : {std::pair{1, 1}, std::pair{2, 7}, std::pair{13, 9}}) {
    ImagePlane image(w, h);
    for (size_t i = 0; i < image.values.size(); ++i) {
      image.values[i] = ToUnitFloat(static_cast<uint32_t>(HashKey(i)));
    }
    const ImagePlane filtered = FilterSeparable(image, kx, ky);
    for (int y = 0; y < h; ++y) {
      for (int x = 0; x < w; ++x) {
        EXPECT_NEAR(filtered.Row(y)[x], Direct(image, kx, ky, x, y), 1e-6f) << x << "," << y;
      }
    }
  }
}

}  // namespace
}  // namespace farpoint

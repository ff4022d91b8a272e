// Three planes of scene-linear values, and the separable filters that the perceptual metrics need.
#pragma once

#include <algorithm>
#include <array>
#include <cstddef>
#include <span>
#include <vector>

namespace farpoint {

// One value per pixel, rows top down.
struct ImagePlane {
  int width = 0, height = 0;
  std::vector<float> values;

  ImagePlane() = default;
  ImagePlane(int w, int h)
      : width(w), height(h), values(static_cast<size_t>(w) * static_cast<size_t>(h)) {}
  float* Row(int y) { return values.data() + static_cast<size_t>(y) * static_cast<size_t>(width); }
  const float* Row(int y) const {
    return values.data() + static_cast<size_t>(y) * static_cast<size_t>(width);
  }
};

// Scene-linear Rec. 709; three planes of one size.
using RgbImage = std::array<ImagePlane, 3>;

// Correlates rows with `along_x`, then columns with `along_y` (odd lengths, centre in the middle).
// Beyond the border stands the border's value. Sums run in the order of the taps.
ImagePlane FilterSeparable(const ImagePlane& image, std::span<const float> along_x,
                           std::span<const float> along_y);

}  // namespace farpoint

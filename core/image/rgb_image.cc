#include "core/image/rgb_image.h"

namespace farpoint {

ImagePlane FilterSeparable(const ImagePlane& image, std::span<const float> along_x,
                           std::span<const float> along_y) {
  const int w = image.width, h = image.height;
  const int rx = static_cast<int>(along_x.size() / 2), ry = static_cast<int>(along_y.size() / 2);
  ImagePlane rows(w, h), result(w, h);
  std::vector<float> padded(static_cast<size_t>(w + 2 * rx));
  for (int y = 0; y < h; ++y) {
    const float* from = image.Row(y);
    for (int x = -rx; x < w + rx; ++x) {
      padded[static_cast<size_t>(x + rx)] = from[std::clamp(x, 0, w - 1)];
    }
    float* to = rows.Row(y);
    for (size_t k = 0; k < along_x.size(); ++k) {
      const float weight = along_x[k];
      for (int x = 0; x < w; ++x) to[x] += weight * padded[static_cast<size_t>(x) + k];
    }
  }
  for (int y = 0; y < h; ++y) {
    float* to = result.Row(y);
    for (size_t k = 0; k < along_y.size(); ++k) {
      const float* from = rows.Row(std::clamp(y + static_cast<int>(k) - ry, 0, h - 1));
      const float weight = along_y[k];
      for (int x = 0; x < w; ++x) to[x] += weight * from[x];
    }
  }
  return result;
}

}  // namespace farpoint

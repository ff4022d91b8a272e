#include <algorithm>
#include <cmath>
#include <vector>

#include "core/image/exr_io.h"
#include "core/image/png_io.h"
#include "core/math/elementary.h"

namespace farpoint {

absl::Status WritePngPreview(const std::string& path, const Film& film, float exposure_stops) {
  if (!film.Has(Layer::kBeauty)) {
    return absl::InvalidArgumentError(
        "'" + path + "': a preview needs the layer 'beauty', which was not rendered");
  }
  const size_t area = static_cast<size_t>(film.rect().area());
  const double scale = std::exp2(static_cast<double>(exposure_stops));
  std::vector<uint8_t> rgb(3 * area);
  for (int c = 0; c < 3; ++c) {
    const std::span<const float> plane = film.Plane(Layer::kBeauty, c);
    for (size_t i = 0; i < area; ++i) {
      const double v = plane[i] * scale;
      const double linear = v > 0.0 ? std::min(v, 1.0) : 0.0;  // a NaN is black
      rgb[3 * i + c] = static_cast<uint8_t>(255.0 * LinearToSrgb(linear) + 0.5);
    }
  }
  return WritePng(path, film.rect().width(), film.rect().height(), rgb);
}

}  // namespace farpoint

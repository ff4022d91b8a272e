#include "bench/accuracy_pictures.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <functional>
#include <utility>

namespace farpoint {

namespace {

// IEC 61966-2-1; clamped.
float SrgbOf(float linear) {
  const float v = std::clamp(linear, 0.0f, 1.0f);
  return v <= 0.0031308f ? 12.92f * v : 1.055f * std::pow(v, 1.0f / 2.4f) - 0.055f;
}

uint8_t ByteOf(float v) {
  return static_cast<uint8_t>(std::lround(255.0f * std::clamp(v, 0.0f, 1.0f)));
}

Rgb ValueAt(const Film& film, Layer layer, int x, int y) {
  return {film.Get(layer, 0, x, y), film.Get(layer, 1, x, y), film.Get(layer, 2, x, y)};
}

// `colour` gives display values in [0, 1].
Picture Paint(const PixelRect& rect, const std::function<Rgb(int x, int y)>& colour) {
  Picture picture{rect.width(), rect.height(), {}};
  picture.rgb.reserve(static_cast<size_t>(rect.area()) * 3);
  for (int y = rect.y0; y < rect.y1; ++y) {
    for (int x = rect.x0; x < rect.x1; ++x) {
      const Rgb c = colour(x, y);
      for (int i = 0; i < 3; ++i) picture.rgb.push_back(ByteOf(c[i]));
    }
  }
  return picture;
}

// Blue, white, red for -1, 0, 1.
Rgb SignedColour(float v) {
  const float t = std::clamp(v, -1.0f, 1.0f);
  return t < 0 ? Rgb(1 + t, 1 + 0.75f * t, 1) : Rgb(1, 1 - 0.85f * t, 1 - t);
}

Rgb Ramp(float v) {
  static constexpr std::array<std::array<float, 3>, 5> kStops = {{{0.0f, 0.0f, 0.0f},
                                                                  {0.30f, 0.05f, 0.48f},
                                                                  {0.82f, 0.16f, 0.20f},
                                                                  {0.98f, 0.74f, 0.12f},
                                                                  {1.0f, 1.0f, 0.95f}}};
  const float at = std::clamp(v, 0.0f, 1.0f) * (kStops.size() - 1);
  const size_t i = std::min(kStops.size() - 2, static_cast<size_t>(at));
  const float t = at - static_cast<float>(i);
  Rgb c;
  for (int k = 0; k < 3; ++k) {
    c[k] = kStops[i][static_cast<size_t>(k)] * (1 - t) + kStops[i + 1][static_cast<size_t>(k)] * t;
  }
  return c;
}

}  // namespace

float LuminanceQuantile(const Film& film, Layer layer, double part) {
  const PixelRect& rect = film.rect();
  std::vector<float> lit;
  for (int y = rect.y0; y < rect.y1; ++y) {
    for (int x = rect.x0; x < rect.x1; ++x) {
      const float l = Luminance(ValueAt(film, layer, x, y));
      if (l > 0) lit.push_back(l);
    }
  }
  if (lit.empty()) return 0;
  const size_t at =
      std::min(lit.size() - 1, static_cast<size_t>(part * static_cast<double>(lit.size())));
  std::nth_element(lit.begin(), lit.begin() + static_cast<ptrdiff_t>(at), lit.end());
  return lit[at];
}

Picture ColourPicture(const Film& film, Layer layer, float white) {
  return Paint(film.rect(), [&](int x, int y) {
    const Rgb v = ValueAt(film, layer, x, y) / white;
    return Rgb(SrgbOf(v.x), SrgbOf(v.y), SrgbOf(v.z));
  });
}

Picture ContrastPicture(const Film& film, Layer layer, float white, float middle, float contrast) {
  const float from = SrgbOf(middle);
  return Paint(film.rect(), [&](int x, int y) {
    const Rgb v = ValueAt(film, layer, x, y) / white;
    const auto stretched = [&](float c) { return 0.5f + contrast * (SrgbOf(c) - from); };
    return Rgb(stretched(v.x), stretched(v.y), stretched(v.z));
  });
}

Picture FalseColourPicture(const Film& film, Layer layer, float white) {
  return Paint(film.rect(),
               [&](int x, int y) { return Ramp(Luminance(ValueAt(film, layer, x, y)) / white); });
}

Picture ErrorPicture(const Film& film, Layer layer, float white,
                     std::span<const PixelPosition> pixels, std::span<const float> errors,
                     float full_scale) {
  const PixelRect& rect = film.rect();
  Picture picture = Paint(rect, [&](int x, int y) {
    const float v = 0.45f * SrgbOf(Luminance(ValueAt(film, layer, x, y)) / white);
    return Rgb(v, v, v);
  });
  // About a third of the distance between pixels of the reference.
  const double area =
      pixels.empty() ? 1.0 : static_cast<double>(rect.area()) / static_cast<double>(pixels.size());
  const int radius = std::clamp(static_cast<int>(std::sqrt(area) / 4), 0, 4);
  for (size_t i = 0; i < pixels.size(); ++i) {
    const Rgb c = SignedColour(errors[i] / full_scale);
    const PixelPosition& p = pixels[i];
    const PixelRect dot =
        PixelRect{p.x - radius, p.y - radius, p.x + radius + 1, p.y + radius + 1}.Intersect(rect);
    for (int y = dot.y0; y < dot.y1; ++y) {
      for (int x = dot.x0; x < dot.x1; ++x) {
        const size_t at =
            3 * (static_cast<size_t>(y - rect.y0) * static_cast<size_t>(rect.width()) +
                 static_cast<size_t>(x - rect.x0));
        for (int k = 0; k < 3; ++k) picture.rgb[at + static_cast<size_t>(k)] = ByteOf(c[k]);
      }
    }
  }
  return picture;
}

Picture DenseErrorPicture(const PixelRect& rect, std::span<const float> errors, float full_scale) {
  size_t at = 0;
  return Paint(rect, [&](int, int) { return SignedColour(errors[at++] / full_scale); });
}

Picture ShrunkTo(Picture picture, int width) {
  while (picture.width > width && picture.width > 1 && picture.height > 1) {
    Picture half{picture.width / 2, picture.height / 2, {}};
    half.rgb.reserve(size_t{3} * static_cast<size_t>(half.width) *
                     static_cast<size_t>(half.height));
    const size_t stride = size_t{3} * static_cast<size_t>(picture.width);
    for (int y = 0; y < half.height; ++y) {
      for (int x = 0; x < half.width; ++x) {
        const size_t at = static_cast<size_t>(2 * y) * stride + static_cast<size_t>(6 * x);
        for (size_t k = at; k < at + 3; ++k) {
          const int sum = picture.rgb[k] + picture.rgb[k + 3] + picture.rgb[k + stride] +
                          picture.rgb[k + stride + 3];
          half.rgb.push_back(static_cast<uint8_t>((sum + 2) / 4));
        }
      }
    }
    picture = std::move(half);
  }
  return picture;
}

Picture Enlarged(const Picture& picture, const PixelRect& part, int times) {
  const PixelRect inside = part.Intersect({0, 0, picture.width, picture.height});
  Picture out{inside.empty() ? 0 : inside.width() * times,
              inside.empty() ? 0 : inside.height() * times,
              {}};
  for (int y = 0; y < out.height; ++y) {
    for (int x = 0; x < out.width; ++x) {
      const size_t at =
          3 * (static_cast<size_t>(inside.y0 + y / times) * static_cast<size_t>(picture.width) +
               static_cast<size_t>(inside.x0 + x / times));
      out.rgb.insert(out.rgb.end(), picture.rgb.begin() + static_cast<ptrdiff_t>(at),
                     picture.rgb.begin() + static_cast<ptrdiff_t>(at + 3));
    }
  }
  return out;
}

Picture SideBySide(const std::vector<Picture>& parts) {
  constexpr int kGap = 6;
  Picture row;
  for (const Picture& part : parts) {
    row.width += part.width + (row.width > 0 ? kGap : 0);
    row.height = std::max(row.height, part.height);
  }
  row.rgb.assign(size_t{3} * static_cast<size_t>(row.width) * static_cast<size_t>(row.height), 255);
  int x0 = 0;
  for (const Picture& part : parts) {
    for (int y = 0; y < part.height; ++y) {
      std::copy_n(part.rgb.begin() + ptrdiff_t{3} * y * part.width, 3 * part.width,
                  row.rgb.begin() + 3 * (ptrdiff_t{y} * row.width + x0));
    }
    x0 += part.width + kGap;
  }
  return row;
}

}  // namespace farpoint

// Pictures of what was measured.
#pragma once

#include <cstdint>
#include <span>
#include <vector>

#include "bench/sparse_reference.h"
#include "core/image/film.h"
#include "core/math/vec.h"

namespace farpoint {

struct Picture {
  int width = 0, height = 0;
  std::vector<uint8_t> rgb;  // sRGB, rows top down
};

// The value below which `part` of the luminances of pixels that are lit lie; 0 if none is.
float LuminanceQuantile(const Film& film, Layer layer, double part);

// A layer of three or more channels over `white`, clamped, in sRGB. white > 0.
Picture ColourPicture(const Film& film, Layer layer, float white);

// The same with `contrast` times its distance from `middle`, both in parts of white, after the
// sRGB curve: faint steps show.
Picture ContrastPicture(const Film& film, Layer layer, float white, float middle, float contrast);

// Luminance over `white` in false colour: black, violet, red, yellow, white.
Picture FalseColourPicture(const Film& film, Layer layer, float white);

// The layer in dim grey with a square at each pixel: blue where the error is negative, red where it
// is positive, full at `full_scale`, white at none. errors[i] belongs to pixels[i].
Picture ErrorPicture(const Film& film, Layer layer, float white,
                     std::span<const PixelPosition> pixels, std::span<const float> errors,
                     float full_scale);

// The film's error everywhere: error(x, y) for each pixel of the film as in ErrorPicture.
Picture DenseErrorPicture(const PixelRect& rect, std::span<const float> errors, float full_scale);

// Means of 2x2 pixels, as often as it takes for the width to be at most `width`.
Picture ShrunkTo(Picture picture, int width);
// The part of it that lies in the rectangle, each pixel `times` as wide and high.
Picture Enlarged(const Picture& picture, const PixelRect& part, int times);
// From left to right, six white pixels between them.
Picture SideBySide(const std::vector<Picture>& parts);

}  // namespace farpoint

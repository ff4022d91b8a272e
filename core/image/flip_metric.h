// HDR-FLIP: the difference that a viewer perceives when flipping between two images.
//   Andersson, Nilsson, Akenine-Möller, Oskarsson, Åström, Fairchild, "FLIP: A Difference Evaluator
//   for Alternating Images", HPG 2020 (LDR-FLIP);
//   Andersson, Nilsson, Shirley, Akenine-Möller, "Visualizing Errors in Rendered High Dynamic Range
//   Images", Eurographics 2021 (HDR-FLIP).
#pragma once

#include <cstdint>
#include <span>

#include "core/image/rgb_image.h"

namespace farpoint {

// 0.7 m before a 0.7 m wide screen of 3840 pixels, the authors' default.
inline constexpr double kFlipPixelsPerDegree = 67.02064327658225;

struct ExposureRange {
  double start_stops = 0, stop_stops = 0;
  int count = 2;  // evenly spaced, both ends included
};
// HDR-FLIP §4.2: the brightest reference pixel and the median one each come to 0.85 under the ACES
// curve; one exposure per stop between them, at least two. Over the pixels with mask != 0.
ExposureRange FlipExposures(const RgbImage& reference, std::span<const uint8_t> mask);

// LDR-FLIP per pixel, in [0, 1]. Values linear, 0 to 1. One size.
ImagePlane LdrFlip(const RgbImage& test, const RgbImage& reference, double pixels_per_degree);

// HDR-FLIP per pixel, in [0, 1]: the maximum of LDR-FLIP over the exposures under the ACES curve.
// Negative values count as 0, those above 65536 as 65536. Time: about 0.7 s per megapixel and stop.
ImagePlane HdrFlip(const RgbImage& test, const RgbImage& reference, const ExposureRange& exposures,
                   double pixels_per_degree);

}  // namespace farpoint

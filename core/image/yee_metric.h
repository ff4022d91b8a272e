// Which pixels of two images a viewer could tell apart: Yangli Hector Yee, "A Perceptual Metric for
// Production Testing", Journal of Graphics Tools 9(4), 2004.
#pragma once

#include <cstdint>
#include <span>
#include <vector>

#include "core/image/rgb_image.h"

namespace farpoint {

struct YeeViewing {
  double field_of_view_deg = 45.0;  // what `view_width` pixels span
  int view_width = 0;               // pixels; 0: the image's width
  double white_cd_m2 = 100.0;       // the display's luminance for (1, 1, 1)
};

// 1 at the pixels with mask != 0 that differ perceptibly, 0 elsewhere. Values are linear in the
// display's light, 0 to 1, Rec. 709. (The paper's display gamma of 2.2 undoes the encoding of 8-bit
// images; these are not encoded.) `a` and `b` have one size, `mask` one byte per pixel. The filters
// see the pixels outside the mask too. Symmetric in a and b.
//
// A departure from Yee's own program: its scotopic damping of the colour test is a constant by a
// slip; here it is what its comment says, a ramp with the adaptation luminance below 10 cd/m².
std::vector<uint8_t> PerceptiblyDifferent(const RgbImage& a, const RgbImage& b,
                                          std::span<const uint8_t> mask, const YeeViewing& viewing);

// How many they are.
int64_t CountPerceptiblyDifferent(const RgbImage& a, const RgbImage& b,
                                  std::span<const uint8_t> mask, const YeeViewing& viewing);

}  // namespace farpoint

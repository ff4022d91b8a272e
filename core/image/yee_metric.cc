#include "core/image/yee_metric.h"

#include <cmath>
#include <numeric>
#include <vector>

#include "core/base/check.h"
#include "core/math/elementary.h"

namespace farpoint {

namespace {

constexpr int kLevels = 8;           // of the Gaussian stack
constexpr int kBands = kLevels - 2;  // a band's contrast is taken relative to two levels above
constexpr double kTiny = 1e-5;       // cd/m² and contrasts: what counts as darkness or flatness
// Burt and Adelson 1983, a = 0.4.
constexpr float kBurtAdelson[5] = {0.05f, 0.25f, 0.4f, 0.25f, 0.05f};

// CIE XYZ of Rec. 709 with D65.
constexpr double kXyzFromRgb[3][3] = {{0.4124564, 0.3575761, 0.1804375},
                                      {0.2126729, 0.7151522, 0.0721750},
                                      {0.0193339, 0.1191920, 0.9503041}};

// CIE a* and b*.
struct Chroma {
  double a, b;
};

double LabCurve(double r) {
  constexpr double kEpsilon = 216.0 / 24389.0, kKappa = 24389.0 / 27.0;  // CIE 15:2004
  return r > kEpsilon ? std::cbrt(r) : (kKappa * r + 16.0) / 116.0;
}

Chroma ChromaOf(const RgbImage& image, size_t i) {
  double f[3];
  for (int r = 0; r < 3; ++r) {
    double value = 0.0, white = 0.0;
    for (int c = 0; c < 3; ++c) {
      value += kXyzFromRgb[r][c] * image[static_cast<size_t>(c)].values[i];
      white += kXyzFromRgb[r][c];
    }
    f[r] = LabCurve(value / white);
  }
  return {500.0 * (f[0] - f[1]), 200.0 * (f[1] - f[2])};
}

std::vector<ImagePlane> LuminanceStack(const RgbImage& image, double white_cd_m2) {
  std::vector<ImagePlane> stack;
  stack.emplace_back(image[0].width, image[0].height);
  for (size_t i = 0; i < stack[0].values.size(); ++i) {
    stack[0].values[i] = static_cast<float>(white_cd_m2 * (kXyzFromRgb[1][0] * image[0].values[i] +
                                                           kXyzFromRgb[1][1] * image[1].values[i] +
                                                           kXyzFromRgb[1][2] * image[2].values[i]));
  }
  // As in Yee's program the levels keep the full resolution: successively blurred images.
  for (int level = 1; level < kLevels; ++level) {
    stack.push_back(FilterSeparable(stack.back(), kBurtAdelson, kBurtAdelson));
  }
  return stack;
}

// Contrast sensitivity at a spatial frequency in cycles per degree (Barten 1989).
double ContrastSensitivity(double frequency_cpd, double luminance_cd_m2) {
  const double a = 440.0 * std::pow(1.0 + 0.7 / luminance_cd_m2, -0.2);
  const double b = 0.3 * std::pow(1.0 + 100.0 / luminance_cd_m2, 0.15);
  return a * frequency_cpd * std::exp(-b * frequency_cpd) *
         std::sqrt(1.0 + 0.06 * std::exp(b * frequency_cpd));
}

// Elevation of the threshold by contrast, in units of the threshold (Daly 1993).
double Masking(double contrast) {
  const double a = std::pow(392.498 * contrast, 0.7);
  return std::pow(1.0 + std::pow(0.0153 * a, 4.0), 0.25);
}

// The visible luminance difference at an adaptation luminance, both in cd/m²: threshold versus
// intensity (Ward Larson, Rushmeier and Piatko 1997, table 1).
double ThresholdVersusIntensity(double adaptation_cd_m2) {
  const double l = std::log10(adaptation_cd_m2);
  double r;
  if (l < -3.94) {
    r = -2.86;
  } else if (l < -1.44) {
    r = std::pow(0.405 * l + 1.6, 2.18) - 2.86;
  } else if (l < -0.0184) {
    r = l - 0.395;
  } else if (l < 1.9) {
    r = std::pow(0.249 * l + 0.65, 2.7) - 0.72;
  } else {
    r = l - 1.255;
  }
  return std::pow(10.0, r);
}

}  // namespace

std::vector<uint8_t> PerceptiblyDifferent(const RgbImage& a, const RgbImage& b,
                                          std::span<const uint8_t> mask,
                                          const YeeViewing& viewing) {
  FP_CHECK(a[0].width == b[0].width && a[0].height == b[0].height);
  FP_CHECK(mask.size() == a[0].values.size());
  const std::vector<ImagePlane> la = LuminanceStack(a, viewing.white_cd_m2);
  const std::vector<ImagePlane> lb = LuminanceStack(b, viewing.white_cd_m2);

  const double degrees = 2.0 * std::tan(viewing.field_of_view_deg * kPi / 360.0) * 180.0 / kPi;
  const int view_width = viewing.view_width > 0 ? viewing.view_width : a[0].width;
  const double pixels_per_degree = view_width / degrees;
  // The first level whose pixels span more than a degree.
  int adaptation_level = 0;
  for (double pixels = 1; adaptation_level + 1 < kLevels && pixels <= degrees; pixels *= 2) {
    ++adaptation_level;
  }

  double frequency_cpd[kBands], frequency_factor[kBands];
  const double most_sensitive = ContrastSensitivity(3.248, 100.0);
  for (int i = 0; i < kBands; ++i) {
    frequency_cpd[i] = std::ldexp(0.5 * pixels_per_degree, -i);
    frequency_factor[i] = most_sensitive / ContrastSensitivity(frequency_cpd[i], 100.0);
  }

  std::vector<uint8_t> differs(mask.size());
  for (size_t p = 0; p < mask.size(); ++p) {
    if (mask[p] == 0) continue;
    const double delta = std::abs(double{la[0].values[p]} - lb[0].values[p]);
    if (a[0].values[p] == b[0].values[p] && a[1].values[p] == b[1].values[p] &&
        a[2].values[p] == b[2].values[p]) {
      continue;  // neither test below can fail
    }
    const double adaptation =
        std::max(kTiny, 0.5 * (double{la[static_cast<size_t>(adaptation_level)].values[p]} +
                               lb[static_cast<size_t>(adaptation_level)].values[p]));
    double factor = 0.0, contrast_sum = 0.0;
    for (size_t i = 0; i < kBands; ++i) {
      const double band = std::max(std::abs(double{la[i].values[p]} - la[i + 1].values[p]),
                                   std::abs(double{lb[i].values[p]} - lb[i + 1].values[p]));
      const double base =
          std::max({std::abs(la[i + 2].values[p]), std::abs(lb[i + 2].values[p]), 1e-5f});
      const double contrast = band / base;
      contrast_sum += contrast;
      factor += contrast * frequency_factor[i] *
                Masking(contrast * ContrastSensitivity(frequency_cpd[i], adaptation));
    }
    factor = std::clamp(factor / std::max(contrast_sum, kTiny), 1.0, 10.0);

    if (delta > factor * ThresholdVersusIntensity(adaptation)) {
      differs[p] = 1;
      continue;
    }
    const double ramp = std::min(1.0, adaptation / 10.0);
    const Chroma ca = ChromaOf(a, p), cb = ChromaOf(b, p);
    const double da = ca.a - cb.a, db = ca.b - cb.b;
    if ((da * da + db * db) * (ramp * ramp) > factor) differs[p] = 1;
  }
  return differs;
}

int64_t CountPerceptiblyDifferent(const RgbImage& a, const RgbImage& b,
                                  std::span<const uint8_t> mask, const YeeViewing& viewing) {
  const std::vector<uint8_t> differs = PerceptiblyDifferent(a, b, mask, viewing);
  return std::accumulate(differs.begin(), differs.end(), int64_t{0});
}

}  // namespace farpoint

#include "core/image/flip_metric.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

#include "core/base/check.h"
#include "core/math/elementary.h"

namespace farpoint {

namespace {

// FLIP 2020, table 1 and §4: exponents, redistribution, the feature detector's width in degrees.
constexpr double kQc = 0.7, kQf = 0.5, kPc = 0.4, kPt = 0.95, kFeatureWidth_deg = 0.082;

struct Color {
  double v[3];
};

// The authors' sRGB primaries and white (D65), as exact fractions.
constexpr double kXyzFromRgb[3][3] = {
    {10135552.0 / 24577794.0, 8788810.0 / 24577794.0, 4435075.0 / 24577794.0},
    {2613072.0 / 12288897.0, 8788810.0 / 12288897.0, 887015.0 / 12288897.0},
    {1425312.0 / 73733382.0, 8788810.0 / 73733382.0, 70074185.0 / 73733382.0}};
constexpr double kRgbFromXyz[3][3] = {{3.241003275, -1.537398934, -0.498615861},
                                      {-0.969224334, 1.875930071, 0.041554224},
                                      {0.055639423, -0.204011202, 1.057148933}};
constexpr double kWhite[3] = {0.950428545, 1.0, 1.088900371};

Color Multiply(const double (&m)[3][3], const Color& c) {
  Color r;
  for (int i = 0; i < 3; ++i) {
    r.v[i] = m[i][0] * c.v[0] + m[i][1] * c.v[1] + m[i][2] * c.v[2];
  }
  return r;
}

// YCxCz, the linearised L*a*b* of the spatial filters.
Color YcxczFromRgb(const Color& rgb) {
  const Color xyz = Multiply(kXyzFromRgb, rgb);
  const double x = xyz.v[0] / kWhite[0], y = xyz.v[1] / kWhite[1], z = xyz.v[2] / kWhite[2];
  return {{116.0 * y - 16.0, 500.0 * (x - y), 200.0 * (y - z)}};
}

Color RgbFromYcxcz(const Color& c) {
  const double y = (c.v[0] + 16.0) / 116.0;
  const double x = y + c.v[1] / 500.0, z = y - c.v[2] / 200.0;
  return Multiply(kRgbFromXyz, {{x * kWhite[0], y * kWhite[1], z * kWhite[2]}});
}

// L*a*b* with the Hunt effect: chroma is scaled by lightness.
Color HuntLabFromRgb(const Color& rgb) {
  const Color xyz = Multiply(kXyzFromRgb, rgb);
  constexpr double kDelta = 6.0 / 29.0;
  double f[3];
  for (int i = 0; i < 3; ++i) {
    const double r = xyz.v[i] / kWhite[i];
    f[i] = r > kDelta * kDelta * kDelta ? std::cbrt(r) : r / (3.0 * kDelta * kDelta) + 4.0 / 29.0;
  }
  const double lightness = 116.0 * f[1] - 16.0;
  return {{lightness, 0.01 * lightness * 500.0 * (f[0] - f[1]),
           0.01 * lightness * 200.0 * (f[1] - f[2])}};
}

double HyAb(const Color& a, const Color& b) {
  const double da = a.v[1] - b.v[1], db = a.v[2] - b.v[2];
  return std::abs(a.v[0] - b.v[0]) + std::sqrt(da * da + db * db);
}

// exp(-x²/(2 sd²)) at -radius..radius.
std::vector<double> Gaussian(int radius, double sd) {
  std::vector<double> g;
  for (int x = -radius; x <= radius; ++x) g.push_back(std::exp(-x * x / (2.0 * sd * sd)));
  return g;
}

std::vector<float> Scaled(const std::vector<double>& kernel, double factor) {
  std::vector<float> r;
  for (const double v : kernel) r.push_back(static_cast<float>(v * factor));
  return r;
}

double Sum(const std::vector<double>& kernel) {
  double sum = 0.0;
  for (const double v : kernel) sum += v;
  return sum;
}

// Positive weights scaled to sum to 1 and negative ones to -1.
std::vector<float> BalanceSigns(const std::vector<double>& kernel) {
  double positive = 0.0, negative = 0.0;
  for (const double v : kernel) (v > 0.0 ? positive : negative) += v;
  std::vector<float> r;
  for (const double v : kernel) {
    r.push_back(static_cast<float>(v > 0.0 ? v / positive : v < 0.0 ? -v / negative : 0.0));
  }
  return r;
}

// A term a·sqrt(pi/b)·exp(-pi²·d²/b) of a contrast sensitivity function, d in degrees.
struct CsfTerm {
  double a, b;
};

// Filters with a sum of Gaussians whose total weight is 1. The published filters are sampled in
// two dimensions; a Gaussian's samples are separable, so this is the same filter.
ImagePlane FilterCsf(const ImagePlane& image, std::span<const CsfTerm> terms, int radius,
                     double pixels_per_degree) {
  double total = 0.0;
  std::vector<std::vector<double>> kernels;
  for (const CsfTerm& t : terms) {
    kernels.push_back(Gaussian(radius, pixels_per_degree * std::sqrt(0.5 * t.b) / kPi));
    const double sum = Sum(kernels.back());
    total += t.a * std::sqrt(kPi / t.b) * sum * sum;
  }
  ImagePlane result(image.width, image.height);
  for (size_t i = 0; i < terms.size(); ++i) {
    const double weight = terms[i].a * std::sqrt(kPi / terms[i].b) / total;
    const ImagePlane part =
        FilterSeparable(image, Scaled(kernels[i], weight), Scaled(kernels[i], 1.0));
    for (size_t p = 0; p < part.values.size(); ++p) result.values[p] += part.values[p];
  }
  return result;
}

// What the metric needs to know of one image.
struct Features {
  RgbImage color;          // filtered, in Hunt-adjusted L*a*b*
  ImagePlane edge, point;  // feature strengths
};

Features Analyse(const RgbImage& rgb, double pixels_per_degree) {
  const int w = rgb[0].width, h = rgb[0].height;
  RgbImage ycxcz = {ImagePlane(w, h), ImagePlane(w, h), ImagePlane(w, h)};
  ImagePlane y_unit(w, h);
  const size_t pixels = y_unit.values.size();
  for (size_t p = 0; p < pixels; ++p) {
    const Color c = YcxczFromRgb({{rgb[0].values[p], rgb[1].values[p], rgb[2].values[p]}});
    for (size_t i = 0; i < 3; ++i) ycxcz[i].values[p] = static_cast<float>(c.v[i]);
    y_unit.values[p] = static_cast<float>((c.v[0] + 16.0) / 116.0);
  }

  // FLIP 2020, table 1: achromatic, red-green, blue-yellow.
  constexpr CsfTerm kAchromatic[] = {{1.0, 0.0047}};
  constexpr CsfTerm kRedGreen[] = {{1.0, 0.0053}};
  constexpr CsfTerm kBlueYellow[] = {{34.1, 0.04}, {13.5, 0.025}};
  const int radius =
      static_cast<int>(std::ceil(3.0 * std::sqrt(0.04 / (2.0 * kPi * kPi)) * pixels_per_degree));
  Features f;
  f.color[0] = FilterCsf(ycxcz[0], kAchromatic, radius, pixels_per_degree);
  f.color[1] = FilterCsf(ycxcz[1], kRedGreen, radius, pixels_per_degree);
  f.color[2] = FilterCsf(ycxcz[2], kBlueYellow, radius, pixels_per_degree);
  for (size_t p = 0; p < pixels; ++p) {
    Color c = RgbFromYcxcz({{f.color[0].values[p], f.color[1].values[p], f.color[2].values[p]}});
    for (double& v : c.v) v = std::clamp(v, 0.0, 1.0);
    const Color lab = HuntLabFromRgb(c);
    for (size_t i = 0; i < 3; ++i) f.color[i].values[p] = static_cast<float>(lab.v[i]);
  }

  // First and second derivatives of a Gaussian.
  const double sd = 0.5 * kFeatureWidth_deg * pixels_per_degree;
  const int feature_radius = static_cast<int>(std::ceil(3.0 * sd));
  const std::vector<double> g = Gaussian(feature_radius, sd);
  std::vector<double> first, second;
  for (int x = -feature_radius; x <= feature_radius; ++x) {
    const double weight = g[static_cast<size_t>(x + feature_radius)];
    first.push_back(-x * weight);
    second.push_back((x * x / (sd * sd) - 1.0) * weight);
  }
  const std::vector<float> smooth = Scaled(g, 1.0 / Sum(g));
  const auto strength = [&](const std::vector<float>& derivative) {
    ImagePlane along_x = FilterSeparable(y_unit, derivative, smooth);
    const ImagePlane along_y = FilterSeparable(y_unit, smooth, derivative);
    for (size_t p = 0; p < pixels; ++p) {
      const float fx = along_x.values[p], fy = along_y.values[p];
      along_x.values[p] = std::sqrt(fx * fx + fy * fy);
    }
    return along_x;
  };
  f.edge = strength(BalanceSigns(first));
  f.point = strength(BalanceSigns(second));
  return f;
}

// ACES, the fit of Narkowicz 2016 without its exposure of 0.6 (HDR-FLIP §4.1): x·(k0·x + k1) /
// (x·(k3·x + k4) + k5).
constexpr double kAces0 = 0.6 * 0.6 * 2.51, kAces1 = 0.6 * 0.03, kAces3 = 0.6 * 0.6 * 2.43,
                 kAces4 = 0.6 * 0.59, kAces5 = 0.14;

double ToneMap(double x) {
  return std::clamp(x * (kAces0 * x + kAces1) / (x * (kAces3 * x + kAces4) + kAces5), 0.0, 1.0);
}

// Where the curve reaches t: the larger root of its quadratic.
double InverseToneMap(double t) {
  const double c0 = (kAces1 - kAces4 * t) / (kAces0 - kAces3 * t);
  const double c1 = -kAces5 * t / (kAces0 - kAces3 * t);
  return -0.5 * c0 + std::sqrt(0.25 * c0 * c0 - c1);
}

double ClampHdr(float v) { return v > 0.0f ? std::min(double{v}, 65536.0) : 0.0; }

RgbImage Exposed(const RgbImage& image, double stops) {
  const double scale = std::exp2(stops);
  RgbImage r = image;
  for (ImagePlane& plane : r) {
    for (float& v : plane.values) v = static_cast<float>(ToneMap(scale * ClampHdr(v)));
  }
  return r;
}

}  // namespace

ExposureRange FlipExposures(const RgbImage& reference, std::span<const uint8_t> mask) {
  FP_CHECK(mask.size() == reference[0].values.size());
  std::vector<double> luminance;
  for (size_t p = 0; p < mask.size(); ++p) {
    if (mask[p] == 0) continue;
    luminance.push_back(0.2126 * ClampHdr(reference[0].values[p]) +
                        0.7152 * ClampHdr(reference[1].values[p]) +
                        0.0722 * ClampHdr(reference[2].values[p]));
  }
  FP_CHECK(!luminance.empty());
  // As the authors' program: black counts as the smallest number that 1 can be told from.
  constexpr double kBlack = std::numeric_limits<float>::epsilon();
  const auto middle = luminance.begin() + static_cast<std::ptrdiff_t>((luminance.size() - 1) / 2);
  std::nth_element(luminance.begin(), middle, luminance.end());
  const double median = std::max(*middle, kBlack);
  const double maximum = std::max(*std::max_element(luminance.begin(), luminance.end()), kBlack);
  const double x = InverseToneMap(0.85);
  ExposureRange range;
  range.start_stops = std::log2(x / maximum);
  range.stop_stops = std::log2(x / median);
  range.count = std::max(2, static_cast<int>(std::ceil(range.stop_stops - range.start_stops)));
  return range;
}

ImagePlane LdrFlip(const RgbImage& test, const RgbImage& reference, double pixels_per_degree) {
  FP_CHECK(test[0].width == reference[0].width && test[0].height == reference[0].height);
  const Features t = Analyse(test, pixels_per_degree);
  const Features r = Analyse(reference, pixels_per_degree);
  // The largest colour difference: green against blue.
  const double max_color =
      std::pow(HyAb(HuntLabFromRgb({{0, 1, 0}}), HuntLabFromRgb({{0, 0, 1}})), kQc);
  const double knee = kPc * max_color;
  ImagePlane result(test[0].width, test[0].height);
  for (size_t p = 0; p < result.values.size(); ++p) {
    const Color ct = {{t.color[0].values[p], t.color[1].values[p], t.color[2].values[p]}};
    const Color cr = {{r.color[0].values[p], r.color[1].values[p], r.color[2].values[p]}};
    const double power = std::pow(HyAb(ct, cr), kQc);
    const double color =
        power < knee ? kPt / knee * power : kPt + (power - knee) / (max_color - knee) * (1.0 - kPt);
    const double feature = std::max(std::abs(double{t.edge.values[p]} - r.edge.values[p]),
                                    std::abs(double{t.point.values[p]} - r.point.values[p]));
    const double exponent = std::pow(feature / std::sqrt(2.0), kQf);
    result.values[p] = static_cast<float>(
        color <= 0.0 ? 0.0 : std::pow(std::min(color, 1.0), std::max(0.0, 1.0 - exponent)));
  }
  return result;
}

ImagePlane HdrFlip(const RgbImage& test, const RgbImage& reference, const ExposureRange& exposures,
                   double pixels_per_degree) {
  const double step =
      (exposures.stop_stops - exposures.start_stops) / std::max(1, exposures.count - 1);
  ImagePlane result(test[0].width, test[0].height);
  for (int i = 0; i < exposures.count; ++i) {
    const double stops = exposures.start_stops + i * step;
    const ImagePlane ldr =
        LdrFlip(Exposed(test, stops), Exposed(reference, stops), pixels_per_degree);
    for (size_t p = 0; p < ldr.values.size(); ++p) {
      result.values[p] = std::max(result.values[p], ldr.values[p]);
    }
  }
  return result;
}

}  // namespace farpoint

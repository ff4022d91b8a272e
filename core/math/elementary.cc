#include "core/math/elementary.h"

#include <algorithm>
#include <bit>
#include <cmath>
#include <cstdint>

namespace farpoint {

namespace {

// Taylor series on [-pi/4, pi/4]; the first omitted term is below 1e-17.
double SinSeries(double x) {
  const double z = x * x;
  double p = -1.0 / 1307674368000.0;
  p = p * z + 1.0 / 6227020800.0;
  p = p * z - 1.0 / 39916800.0;
  p = p * z + 1.0 / 362880.0;
  p = p * z - 1.0 / 5040.0;
  p = p * z + 1.0 / 120.0;
  p = p * z - 1.0 / 6.0;
  return x + x * z * p;
}

double CosSeries(double x) {
  const double z = x * x;
  double p = 1.0 / 20922789888000.0;
  p = p * z - 1.0 / 87178291200.0;
  p = p * z + 1.0 / 479001600.0;
  p = p * z - 1.0 / 3628800.0;
  p = p * z + 1.0 / 40320.0;
  p = p * z - 1.0 / 720.0;
  p = p * z + 1.0 / 24.0;
  return 1.0 - 0.5 * z + z * z * p;
}

// atan on [0, 1]: two half-angle steps, then the series on [0, tan(pi/16)].
double AtanUnit(double x) {
  double scale = 1.0;
  for (int i = 0; i < 2; ++i) {
    x = x / (1.0 + std::sqrt(1.0 + x * x));
    scale *= 2.0;
  }
  const double z = x * x;
  double p = 0.0;
  for (int k = 12; k >= 1; --k) p = ((k & 1) ? -1.0 : 1.0) / (2 * k + 1) + z * p;
  return scale * (x + x * z * p);
}

}  // namespace

SinCos DetSinCos(double angle_rad) {
  // Cody-Waite reduction by pi/2 in three parts.
  const double q = std::nearbyint(angle_rad * (2.0 / kPi));
  double r = angle_rad - q * 1.57079632673412561417e+00;
  r = r - q * 6.07710050630396597660e-11;
  r = r - q * 2.02226624879595063154e-21;
  const double s = SinSeries(r);
  const double c = CosSeries(r);
  switch (static_cast<int64_t>(q) & 3) {
    case 0:
      return {s, c};
    case 1:
      return {c, -s};
    case 2:
      return {-s, -c};
    default:
      return {-c, s};
  }
}

double DetTan(double angle_rad) {
  const SinCos sc = DetSinCos(angle_rad);
  return sc.sin / sc.cos;
}

double DetAtan2(double y, double x) {
  const double ax = std::fabs(x);
  const double ay = std::fabs(y);
  if (ax == 0.0 && ay == 0.0) return 0.0;
  double a = ay <= ax ? AtanUnit(ay / ax) : 0.5 * kPi - AtanUnit(ax / ay);
  if (x < 0.0) a = kPi - a;
  return y < 0.0 ? -a : a;
}

double DetAcos(double x) {
  x = std::clamp(x, -1.0, 1.0);
  return DetAtan2(std::sqrt((1.0 - x) * (1.0 + x)), x);
}

double DetExp(double x) {
  if (!(x > -708.0)) return 0.0;
  x = std::min(x, 708.0);
  const double k = std::nearbyint(x * 1.44269504088896338700);
  const double r = (x - k * 6.93147180369123816490e-01) - k * 1.90821492927058770002e-10;
  double p = 1.0;
  for (int i = 14; i >= 1; --i) p = 1.0 + p * r / i;
  const uint64_t bits = static_cast<uint64_t>(static_cast<int64_t>(k) + 1023) << 52;
  return p * std::bit_cast<double>(bits);
}

double DetLog(double x) {
  const uint64_t bits = std::bit_cast<uint64_t>(x);
  int64_t exponent = static_cast<int64_t>(bits >> 52) - 1023;
  double m = std::bit_cast<double>((bits & 0x000fffffffffffffull) | 0x3ff0000000000000ull);
  if (m > 1.4142135623730951) {
    m *= 0.5;
    ++exponent;
  }
  // ln m = 2 artanh((m - 1) / (m + 1))
  const double s = (m - 1.0) / (m + 1.0);
  const double z = s * s;
  double p = 0.0;
  for (int k = 11; k >= 1; --k) p = 1.0 / (2 * k + 1) + z * p;
  const double e = static_cast<double>(exponent);
  return e * 6.93147180369123816490e-01 + (2.0 * (s + s * z * p) + e * 1.90821492927058770002e-10);
}

double DetPow(double x, double y) { return x > 0.0 ? DetExp(y * DetLog(x)) : 0.0; }

double SrgbToLinear(double v) {
  if (v <= 0.04045) return v / 12.92;
  return DetPow((v + 0.055) / 1.055, 2.4);
}

double LinearToSrgb(double v) {
  if (v <= 0.0031308) return 12.92 * v;
  return 1.055 * DetPow(v, 1.0 / 2.4) - 0.055;
}

}  // namespace farpoint

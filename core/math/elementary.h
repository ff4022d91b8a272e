// Elementary functions of our own, made of +, -, *, / and sqrt only. IEEE 754 fixes the result of
// each of those, so these give the same bits on every machine and with every C library, which
// libm's do not promise (docs/decisions/0001-determinism.md). Errors were measured against libm
// in tests/unit/core/math/elementary_test.cc.
#pragma once

namespace farpoint {

inline constexpr double kPi = 3.14159265358979323846;
inline constexpr float kPif = 3.14159274101257324f;
inline constexpr float kInvPif = 0.318309886183790672f;

struct SinCos {
  double sin, cos;
};
// Angle in radians, |angle_rad| <= 1e6. Absolute error < 1e-14 for |angle_rad| <= 100.
SinCos DetSinCos(double angle_rad);
double DetTan(double angle_rad);

// atan2(y, x) in (-pi, pi]; absolute error < 1e-14; 0 for (0, 0).
double DetAtan2(double y, double x);
// x in [-1, 1], clamped; absolute error < 1e-14 (< 1e-8 within 1e-15 of +-1).
double DetAcos(double x);

// e^x, relative error < 1e-14; 0 below -708, clamped above 708.
double DetExp(double x);
// Natural logarithm of a positive normal number, absolute error < 1e-14 * max(1, |ln x|).
double DetLog(double x);
// x^y = e^(y ln x) for x > 0; 0 for x <= 0.
double DetPow(double x, double y);

// sRGB electro-optical transfer function (IEC 61966-2-1), v in [0, 1] -> linear [0, 1].
double SrgbToLinear(double v);
double LinearToSrgb(double v);

}  // namespace farpoint

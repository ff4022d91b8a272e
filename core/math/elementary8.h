// Elementary functions of eight floats at once, made of +, -, *, / and sqrt only like those of
// elementary.h, and so the same bits on every machine. Polynomials of Cephes (Moshier 1992).
#pragma once

#include "core/math/elementary.h"
#include "core/math/simd8.h"

namespace farpoint {

struct SinCos8 {
  F8 sin, cos;
};
// |angle_rad| <= pi/4. Absolute error < 1e-7.
inline SinCos8 DetSinCosEighth8(F8 angle_rad) {
  const F8 z = angle_rad * angle_rad;
  const F8 s = (Set8(-1.9515295891e-4f) * z + Set8(8.3321608736e-3f)) * z + Set8(-1.6666654611e-1f);
  const F8 c = (Set8(2.443315711809948e-5f) * z + Set8(-1.388731625493765e-3f)) * z +
               Set8(4.166664568298827e-2f);
  return {angle_rad + angle_rad * z * s, Set8(1.0f) - Set8(0.5f) * z + z * z * c};
}

// |angle_rad| <= 100. Absolute error < 2e-7.
inline SinCos8 DetSinCos8(F8 angle_rad) {
  // Cody-Waite reduction by pi/2 in three parts, the first two of which have few digits.
  const F8 q = Round8(angle_rad * Set8(0.63661977236758134f));
  F8 r = angle_rad - q * Set8(1.5703125f);
  r = r - q * Set8(4.837512969970703125e-4f);
  r = r - q * Set8(7.549789954892e-8f);
  const SinCos8 part = DetSinCosEighth8(r);
  const M8 quarter = __builtin_convertvector(q, M8);
  const M8 odd = (quarter & 1) != 0;
  const F8 s = Select8(odd, part.cos, part.sin), c = Select8(odd, part.sin, part.cos);
  return {Select8((quarter & 2) != 0, -s, s), Select8(((quarter + 1) & 2) != 0, -c, c)};
}

// atan2(y, x) in [0, pi] for y >= 0 (normal numbers or zero); relative error < 3e-7; 0 for (0, 0)
// with x not negative.
inline F8 DetAtan2Upper8(F8 y, F8 x) {
  const F8 abs_x = Abs8(x);
  const F8 low = Min8(abs_x, y), high = Max8(abs_x, y);
  // Above tan(pi/8): atan(q) = pi/4 + atan((q - 1) / (q + 1)).
  const M8 above = low > high * Set8(0.414213562373095f);
  const F8 q =
      Select8(above, low - high, low) / Max8(Select8(above, low + high, high), Set8(0x1p-126f));
  const F8 z = q * q;
  const F8 p =
      ((Set8(8.05374449538e-2f) * z - Set8(1.38776856032e-1f)) * z + Set8(1.99777106478e-1f)) * z -
      Set8(3.33329491539e-1f);
  F8 angle = q + q * z * p;
  angle = Select8(above, angle + Set8(0.25f * kPif), angle);
  angle = Select8(y > abs_x, Set8(0.5f * kPif) - angle, angle);
  return Select8(x < Set8(0.0f), Set8(kPif) - angle, angle);
}

}  // namespace farpoint

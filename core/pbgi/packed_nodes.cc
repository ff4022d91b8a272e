#include "core/pbgi/packed_nodes.h"

#include <algorithm>
#include <cmath>

namespace farpoint {

namespace {

void StoreCentres(const GroupFrame& f, const uint16_t* x, const uint16_t* y, const uint16_t* z,
                  NodeGroup& g) {
  const F8 unit = Set8(f.unit);
  Store8(g.cx, Set8(f.origin[0]) + LoadWholes(x) * unit);
  Store8(g.cy, Set8(f.origin[1]) + LoadWholes(y) * unit);
  Store8(g.cz, Set8(f.origin[2]) + LoadWholes(z) * unit);
}

void StoreNormals(const NormalLanes& n, NodeGroup& g) {
  const F8 step = Set8(kInverseNormalSteps);
  Store8(g.nx, n.steps.x * step);
  Store8(g.ny, n.steps.y * step);
  Store8(g.nz, n.steps.z * step);
}

// Of lanes that are not empty: times the unit; -1 for the others.
F8 Radius(const uint16_t* halves, float unit) {
  const F8 r = LoadHalves(halves);
  return Select8(r >= Set8(0.0f), r * Set8(unit), r);
}

}  // namespace

NodeGroup Unpack(const PackedSurfels& s) {
  NodeGroup g;
  const F8 zero = Set8(0.0f);
  StoreCentres(s.frame, s.x, s.y, s.z, g);
  const NormalLanes normal(s.normal);
  StoreNormals(normal, g);
  const F8 radius = Radius(s.radius, s.frame.unit);
  Store8(g.radius, radius);
  Store8(g.thickness, zero);
  Store8(g.sin_cone, zero);
  Store8(g.inverse_length, Select8(radius >= zero, Set8(1.0f), zero));
  const F8 area = DiscArea(Max8(radius, zero));
  Store8(g.front_area, Select8(Mask8(normal.front()), area, zero));
  Store8(g.back_area, Select8(Mask8(normal.back()), area, zero));
  return g;
}

NodeGroup Unpack(const PackedNodes& n) {
  NodeGroup g;
  StoreCentres(n.frame, n.x, n.y, n.z, g);
  StoreNormals(NormalLanes(n.normal), g);
  const float unit = n.frame.unit;
  Store8(g.radius, Radius(n.radius, unit));
  Store8(g.thickness, LoadHalves(n.thickness) * Set8(unit));
  Store8(g.sin_cone, LoadHalves(n.sin_cone));
  Store8(g.inverse_length, Abs8(LoadHalves(n.inverse_length)));
  const F8 area = Set8(unit * unit * kAreaUnits);
  Store8(g.front_area, LoadHalves(n.front_area) * area);
  Store8(g.back_area, LoadHalves(n.back_area) * area);
  return g;
}

uint32_t PackNormal(const Vec3f& n) {
  const auto component = [](float c) {
    const float steps = std::nearbyint(std::clamp(c, -1.0f, 1.0f) * kNormalSteps);
    return static_cast<uint32_t>(static_cast<int32_t>(steps)) & 0x3ffu;
  };
  return component(n.x) | component(n.y) << 10 | component(n.z) << 20;
}

uint16_t HalfAbove(float x) {
  const uint16_t h = FloatToHalf(x);
  return HalfToFloat(h) < x ? static_cast<uint16_t>(h + 1) : h;
}

uint16_t HalfBelow(float x) {
  const uint16_t h = FloatToHalf(x);
  return HalfToFloat(h) > x ? static_cast<uint16_t>(h - 1) : h;
}

uint16_t HalfNearest(float x) {
  const uint16_t h = FloatToHalf(x);
  return h == 0 && x > 0.0f ? uint16_t{1} : h;
}

float PowerOfTwoAbove(float x) {
  const auto bits = std::bit_cast<uint32_t>(std::max(x, 0x1p-126f));
  const uint32_t whole = (bits + 0x7fffffu) & 0x7f800000u;
  return std::bit_cast<float>(std::min(whole, 0x7f000000u));
}

RadianceUnit::RadianceUnit(float unit) {
  for (size_t e = 0; e < scale_.size(); ++e) {
    scale_[e] = unit;
    unit *= 2.0f;
  }
}

RadianceUnit RadianceUnit::For(float brightest) {
  // 2^39 units are above it. Not so small that a scale is subnormal, nor so large that one is
  // infinite.
  return RadianceUnit(std::clamp(PowerOfTwoAbove(brightest) * 0x1p-39f, 0x1p-126f, 0x1p88f));
}

uint32_t RadianceUnit::Pack(const Rgb& radiance) const {
  const float most = MaxComponent(radiance);
  if (!(most > 0.0f)) return 0;
  const auto exponent = [](float x) { return static_cast<int>(std::bit_cast<uint32_t>(x) >> 23); };
  // The exponent at which the brightest channel has nine bits, one more if it rounds to 512.
  int e = std::clamp(exponent(most) - exponent(unit()) - 8, 0, 31);
  if (e < 31 && most > 511.5f * scale_[static_cast<size_t>(e)]) ++e;
  const float steps = 1.0f / scale_[static_cast<size_t>(e)];  // exact
  uint32_t word = 0;
  for (int c = 0; c < 3; ++c) {
    const auto mantissa = static_cast<uint32_t>(
        std::min(std::nearbyint(std::max(radiance[c], 0.0f) * steps), 511.0f));
    word |= mantissa << (9 * c);
  }
  if (word == 0) word = 1u << (radiance.x == most ? 0 : radiance.y == most ? 9 : 18);
  return word | static_cast<uint32_t>(e) << 27;
}

}  // namespace farpoint

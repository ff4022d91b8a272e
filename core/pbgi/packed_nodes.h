// How the point tree's nodes lie in memory and in its blobs: eight side by side, quantised, 14
// bytes a surfel and 24 a node, and 8 bytes of radiance for either.
//
// - Centres are whole numbers of 16 bits of a group's own unit, a power of two, from the group's
//   corner: a step is at most 2^-15 of the group's width, or 2^-14 of its largest radius.
// - Normals are three whole numbers of 10 bits over 511: axes are exact, other directions within
//   0.002 of a component, lengths within 0.2 %.
// - Lengths are halves in the group's unit, areas halves in 2^20 of its squared unit, sines halves:
//   within 2^-11 of the value. What is a bound (radius, thickness and cone of an inner node) is
//   made from the quantised children, about the quantised centre and normal, and rounded up. So a
//   tree holds for the surfels that are read from it, exactly.
// - Radiance has 9 bits of mantissa for each channel and an exponent for the three, in a unit of
//   the tree's, a power of two: within 2^-9 of the brightest channel.
//
// Units are powers of two so that a scene scaled by one has the same numbers.
#pragma once

#include <array>
#include <bit>
#include <cstdint>

#include "core/math/half.h"
#include "core/math/simd8.h"
#include "core/math/vec8.h"

namespace farpoint {

inline constexpr uint32_t kLanes = 8;

// A centre along x is origin[0] + x * unit.
struct GroupFrame {
  float origin[3];  // metres, relative to the scene's origin
  float unit;       // metres; a power of two
};

// Eight surfels, or empty slots behind the last.
struct alignas(16) PackedSurfels {
  GroupFrame frame;
  uint16_t x[kLanes], y[kLanes], z[kLanes];
  uint32_t normal[kLanes];  // PackNormal; visible sides: kPackedFront, kPackedBack
  uint16_t radius[kLanes];  // of a disc of the surfel's area; half, units; -1: empty
};
static_assert(sizeof(PackedSurfels) == 112);

// Eight inner nodes, or empty slots.
struct alignas(64) PackedNodes {
  GroupFrame frame;
  uint16_t x[kLanes], y[kLanes], z[kLanes];  // area-weighted centre
  uint32_t normal[kLanes];     // Σ A n / Σ A; visible sides: those that any surfel below shows
  uint16_t radius[kLanes];     // of a sphere that holds all discs; half, units; -1: empty
  uint16_t thickness[kLanes];  // half height along the mean normal of all discs; half, units
  uint16_t sin_cone[kLanes];   // of the largest angle to the mean normal; half; 1: 90° or more
  uint16_t inverse_length[kLanes];  // 1 / |mean normal|, rounded down, 0 if that is 0; half. With
                                    // the sign bit: normals look in so different directions that
                                    // the node is no disc at any distance (kMinCoherence2)
  uint16_t front_area[kLanes];      // Σ A of surfels whose front is visible; half, kAreaUnits
  uint16_t back_area[kLanes];
};
static_assert(sizeof(PackedNodes) == 192);

// An area is its half times this and the squared unit.
inline constexpr float kAreaUnits = 0x1p20f;
inline constexpr uint16_t kEmptyRadius = 0xbc00;  // -1
inline constexpr uint32_t kPackedFront = 1u << 30, kPackedBack = 1u << 31;
inline constexpr float kNormalSteps = 511.0f;
inline constexpr float kInverseNormalSteps = 1.0f / kNormalSteps;
static_assert(kNormalSteps * kInverseNormalSteps == 1.0f, "axes are exact");
// Below this squared length of the mean normal a node is scattered.
inline constexpr float kMinCoherence2 = 0.5f;

// Eight nodes unpacked. Lengths in metres, positions relative to the scene's origin.
struct alignas(32) NodeGroup {
  float cx[kLanes], cy[kLanes], cz[kLanes];  // area-weighted centre
  float radius[kLanes];     // of a sphere about the centre that holds all discs; -1: empty slot
  float thickness[kLanes];  // half height along the mean normal of all discs below
  float nx[kLanes], ny[kLanes], nz[kLanes];  // Σ A n / Σ A: as short as the normals spread
  float sin_cone[kLanes];        // sine of the largest angle to the mean normal; 1: 90° or more
  float inverse_length[kLanes];  // 1 / |mean normal|; 0 if that is 0
  float front_area[kLanes];  // Σ A of surfels whose front is visible (in the topology blob: open)
  float back_area[kLanes];   // Σ A of surfels whose back is visible
};

// ---- eight lanes at a time

inline F8 LoadHalves(const uint16_t* p) {  // at a multiple of 16 bytes
  return reinterpret_cast<F8>(_mm256_cvtph_ps(_mm_load_si128(reinterpret_cast<const __m128i*>(p))));
}
inline F8 LoadWholes(const uint16_t* p) {
  return reinterpret_cast<F8>(_mm256_cvtepi32_ps(
      _mm256_cvtepu16_epi32(_mm_load_si128(reinterpret_cast<const __m128i*>(p)))));
}
// Components in steps of 1 / kNormalSteps.
struct NormalLanes {
  V8 steps;
  M8 word;

  explicit NormalLanes(const uint32_t* p)  // at a multiple of 16 bytes
      : word(reinterpret_cast<M8>(_mm256_loadu_si256(reinterpret_cast<const __m256i*>(p)))) {
    const auto component = [this](int shift) {
      return __builtin_convertvector((word << shift) >> 22, F8);
    };
    steps = {component(22), component(12), component(2)};
  }
  // Bit k: that side of lane k is visible.
  unsigned front() const { return Bits8(word << 1); }
  unsigned back() const { return Bits8(word); }
};
// π r²
inline F8 DiscArea(F8 radius) { return Set8(3.14159274101257324f) * radius * radius; }

NodeGroup Unpack(const PackedSurfels& surfels);
NodeGroup Unpack(const PackedNodes& nodes);

// ---- one lane

inline Vec3f CentreIn(const GroupFrame& f, uint16_t x, uint16_t y, uint16_t z) {
  return {f.origin[0] + static_cast<float>(x) * f.unit,
          f.origin[1] + static_cast<float>(y) * f.unit,
          f.origin[2] + static_cast<float>(z) * f.unit};
}
inline Vec3f UnpackNormal(uint32_t word) {
  const auto component = [word](int shift) {
    return static_cast<float>(static_cast<int32_t>(word << shift) >> 22) * kInverseNormalSteps;
  };
  return {component(22), component(12), component(2)};
}
// Components in [-1, 1]; no visible side.
uint32_t PackNormal(const Vec3f& n);

// The least half at or above x, the greatest at or below it; 0 <= x <= kMaxHalf.
uint16_t HalfAbove(float x);
uint16_t HalfBelow(float x);
// The nearest half, and not 0 unless x is.
uint16_t HalfNearest(float x);
// The least power of two at or above x; at least 2^-126, at most 2^127.
float PowerOfTwoAbove(float x);

// ---- radiance

// Three mantissas of 9 bits (R lowest) and from bit 27 on an exponent e: channel =
// mantissa * 2^e * unit.
class RadianceUnit {
 public:
  RadianceUnit() : RadianceUnit(1.0f) {}
  // `unit` is a power of two.
  explicit RadianceUnit(float unit);
  // One that suits radiances up to `brightest`.
  static RadianceUnit For(float brightest);

  float unit() const { return scale_[0]; }
  // Channels that are finite and not negative, to the nearest; black only if they all are.
  uint32_t Pack(const Rgb& radiance) const;
  Rgb Unpack(uint32_t word) const {
    const float scale = scale_[word >> 27];
    return {static_cast<float>(word & 0x1ffu) * scale,
            static_cast<float>(word >> 9 & 0x1ffu) * scale,
            static_cast<float>(word >> 18 & 0x1ffu) * scale};
  }

 private:
  std::array<float, 32> scale_;
};

}  // namespace farpoint

// Counter-based random numbers and low-discrepancy points. Every value is a function of its
// arguments: nothing depends on threads, order or time.
#pragma once

#include <cmath>
#include <cstdint>

#include "core/math/vec.h"
#include "core/math/vec8.h"

namespace farpoint {

// Finaliser of SplitMix64 (Steele, Lea, Flood 2014): a bijection with full avalanche.
constexpr uint64_t Mix64(uint64_t x) {
  x += 0x9e3779b97f4a7c15ull;
  x = (x ^ (x >> 30)) * 0xbf58476d1ce4e5b9ull;
  x = (x ^ (x >> 27)) * 0x94d049bb133111ebull;
  return x ^ (x >> 31);
}
// Keys of several parts: HashKey(seed, a, b, …).
constexpr uint64_t HashKey(uint64_t a) { return Mix64(a); }
template <typename... Rest>
constexpr uint64_t HashKey(uint64_t a, uint64_t b, Rest... rest) {
  return HashKey(Mix64(a) ^ (b * 0xd6e8feb86659fd93ull), rest...);
}

// The upper 24 bits as a number in [0, 1): exact in float.
constexpr float ToUnitFloat(uint32_t bits) {
  return static_cast<float>(bits >> 8) * (1.0f / 16777216.0f);
}

// Point `index` of the Sobol' sequence, dimensions 0 to 3 (Joe and Kuo 2008), with hashed Owen
// scrambling (Laine and Karras 2011, improved by Vegdahl 2021) by `seed`. Any 2^k aligned block of
// indices is a (t, k, s)-net. Values in [0, 1), as 32 bits.
uint32_t OwenSobolBits(uint32_t index, unsigned dimension, uint32_t seed);
inline float OwenSobol(uint32_t index, unsigned dimension, uint32_t seed) {
  return ToUnitFloat(OwenSobolBits(index, dimension, seed));
}
// One dimension under one seed, for many points: the same bits.
class OwenSobolAxis {
 public:
  OwenSobolAxis(unsigned dimension, uint32_t seed)
      : dimension_(dimension), scramble_(static_cast<uint32_t>(HashKey(seed, dimension))) {}
  U8 BitsOf(const U8& index) const;
  // As OwenSobol.
  F8 PointsOf(const U8& index) const {
    return __builtin_convertvector(reinterpret_cast<M8>(BitsOf(index) >> 8), F8) *
           Set8(1.0f / 16777216.0f);
  }

 private:
  unsigned dimension_;
  uint32_t scramble_;
};
// Visits [0, 2^32) in an order shuffled by `seed` such that aligned blocks of 2^k stay together.
uint32_t OwenShuffledIndex(uint32_t index, uint32_t seed);

// u, v in [0, 1) -> unit disc, area-preserving (Shirley and Chiu 1997). Measure: area / pi.
Vec2f ConcentricDisc(float u, float v);
// u, v in [0, 1) -> hemisphere about +z. pdf_sr = cos(theta) / pi.
Vec3f CosineHemisphere(float u, float v);
// The same in eight lanes and in single precision: x, y and z² differ by less than 8e-7.
V8 CosineHemisphere8(F8 u, F8 v);
// u, v in [0, 1) -> the whole sphere. pdf_sr = 1 / (4 pi).
Vec3f UniformSphere(float u, float v);
// u, v in [0, 1) -> barycentric weights of vertices 1 and 2 of a triangle (Heitz 2019, low
// distortion). Measure: area / triangle area.
Vec2f UniformTriangle(float u, float v);

}  // namespace farpoint

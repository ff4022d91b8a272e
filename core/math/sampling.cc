#include "core/math/sampling.h"

#include <algorithm>
#include <array>

#include "core/math/elementary.h"
#include "core/math/elementary8.h"

namespace farpoint {

namespace {

uint32_t ReverseBits(uint32_t x) {
  x = ((x >> 1) & 0x55555555u) | ((x & 0x55555555u) << 1);
  x = ((x >> 2) & 0x33333333u) | ((x & 0x33333333u) << 2);
  x = ((x >> 4) & 0x0f0f0f0fu) | ((x & 0x0f0f0f0fu) << 4);
  return __builtin_bswap32(x);
}
// The bytes of each lane in turn, and in each byte the two halves by a table.
U8 ReverseBits(const U8& x) {
  const __m256i order = _mm256_set_epi8(12, 13, 14, 15, 8, 9, 10, 11, 4, 5, 6, 7, 0, 1, 2, 3,  //
                                        12, 13, 14, 15, 8, 9, 10, 11, 4, 5, 6, 7, 0, 1, 2, 3);
  const __m256i reversed = _mm256_set_epi8(15, 7, 11, 3, 13, 5, 9, 1, 14, 6, 10, 2, 12, 4, 8, 0,  //
                                           15, 7, 11, 3, 13, 5, 9, 1, 14, 6, 10, 2, 12, 4, 8, 0);
  const __m256i half = _mm256_set1_epi8(0x0f);
  const __m256i swapped = _mm256_shuffle_epi8(reinterpret_cast<__m256i>(x), order);
  const __m256i low = _mm256_shuffle_epi8(reversed, _mm256_and_si256(swapped, half));
  const __m256i high =
      _mm256_shuffle_epi8(reversed, _mm256_and_si256(_mm256_srli_epi32(swapped, 4), half));
  return reinterpret_cast<U8>(_mm256_or_si256(_mm256_slli_epi32(low, 4), high));
}

// Generator matrices of dimensions 0 to 3, from the primitive polynomials and initial direction
// numbers of Joe and Kuo's table new-joe-kuo-6.
constexpr std::array<std::array<uint32_t, 32>, 4> MakeDirections() {
  std::array<std::array<uint32_t, 32>, 4> v{};
  for (int i = 0; i < 32; ++i) v[0][i] = 1u << (31 - i);
  struct Row {
    int s;
    uint32_t a;
    std::array<uint32_t, 3> m;
  };
  constexpr Row rows[3] = {{1, 0, {1, 0, 0}}, {2, 1, {1, 3, 0}}, {3, 1, {1, 3, 1}}};
  for (int d = 0; d < 3; ++d) {
    const Row& r = rows[d];
    auto& w = v[d + 1];
    for (int i = 0; i < r.s; ++i) w[i] = r.m[i] << (31 - i);
    for (int i = r.s; i < 32; ++i) {
      w[i] = w[i - r.s] ^ (w[i - r.s] >> r.s);
      for (int k = 1; k < r.s; ++k) w[i] ^= ((r.a >> (r.s - 1 - k)) & 1u) * w[i - k];
    }
  }
  return v;
}
constexpr auto kDirections = MakeDirections();

// What each value of each byte of an index adds, its bits reversed, as the scrambling wants them:
// four look-ups instead of a loop over the bits.
constexpr std::array<std::array<std::array<uint32_t, 256>, 4>, 4> MakeByteTables() {
  std::array<std::array<std::array<uint32_t, 256>, 4>, 4> tables{};
  for (size_t d = 0; d < 4; ++d) {
    for (size_t byte = 0; byte < 4; ++byte) {
      auto& table = tables[d][byte];
      for (size_t bit = 0; bit < 8; ++bit) {
        uint32_t reversed = 0;
        for (uint32_t b = 0; b < 32; ++b) {
          reversed |= (kDirections[d][8 * byte + bit] >> b & 1u) << (31 - b);
        }
        for (size_t i = 0; i < size_t{1} << bit; ++i) {
          table[(size_t{1} << bit) + i] = table[i] ^ reversed;
        }
      }
    }
  }
  return tables;
}
constexpr auto kByteTables = MakeByteTables();

// Permutes the bits of x from the lowest up, each depending on those below it only: between two
// reversals, nested uniform (Owen) scrambling. Bits is uint32_t or U8.
template <typename Bits>
Bits LaineKarrasPermutation(Bits x, uint32_t seed) {
  x ^= x * 0x3d20adeau;
  x += seed;
  x *= (seed >> 16) | 1u;
  x ^= x * 0x05526c56u;
  x ^= x * 0x53a22864u;
  return x;
}

}  // namespace

uint32_t OwenSobolBits(uint32_t index, unsigned dimension, uint32_t seed) {
  const auto& table = kByteTables[dimension];
  uint32_t x = table[0][index & 0xffu];
  for (uint32_t i = index >> 8, byte = 1; i != 0; i >>= 8, ++byte) x ^= table[byte][i & 0xffu];
  return ReverseBits(LaineKarrasPermutation(x, static_cast<uint32_t>(HashKey(seed, dimension))));
}

U8 OwenSobolAxis::BitsOf(const U8& index) const {
  const auto& table = kByteTables[dimension_];
  const auto look_up = [&](size_t byte) {
    return reinterpret_cast<U8>(_mm256_i32gather_epi32(
        reinterpret_cast<const int*>(table[byte].data()),
        reinterpret_cast<__m256i>((index >> (8 * static_cast<uint32_t>(byte))) & 0xffu),
        sizeof(uint32_t)));
  };
  U8 x = look_up(0);
  if (Bits8(reinterpret_cast<M8>(index > 0xffu)) != 0) x ^= look_up(1) ^ look_up(2) ^ look_up(3);
  return ReverseBits(LaineKarrasPermutation(x, scramble_));
}

uint32_t OwenShuffledIndex(uint32_t index, uint32_t seed) {
  return ReverseBits(LaineKarrasPermutation(ReverseBits(index), seed));
}

Vec2f ConcentricDisc(float u, float v) {
  const float a = 2.0f * u - 1.0f;
  const float b = 2.0f * v - 1.0f;
  if (a == 0.0f && b == 0.0f) return {0.0f, 0.0f};
  float r, phi_rad;
  if (std::fabs(a) > std::fabs(b)) {
    r = a;
    phi_rad = 0.78539816339744831f * (b / a);
  } else {
    r = b;
    phi_rad = 1.57079632679489662f - 0.78539816339744831f * (a / b);
  }
  const SinCos sc = DetSinCos(phi_rad);
  return {static_cast<float>(r * sc.cos), static_cast<float>(r * sc.sin)};
}

Vec3f CosineHemisphere(float u, float v) {
  const Vec2f d = ConcentricDisc(u, v);
  return {d.x, d.y, std::sqrt(std::max(0.0f, 1.0f - d.x * d.x - d.y * d.y))};
}

V8 CosineHemisphere8(F8 u, F8 v) {
  const F8 one = Set8(1.0f), two = Set8(2.0f);
  const F8 a = two * u - one, b = two * v - one;
  // The angle is counted from the axis that is nearer, so it never exceeds an eighth of a turn.
  const M8 along_a = Abs8(a) > Abs8(b);
  const F8 r = Select8(along_a, a, b), other = Select8(along_a, b, a);
  const F8 quotient = Select8(r == Set8(0.0f), r, other / r);
  const SinCos8 sc = DetSinCosEighth8(Set8(0.78539816339744831f) * quotient);
  const F8 near = r * sc.cos, far = r * sc.sin;
  return {Select8(along_a, near, far), Select8(along_a, far, near), Sqrt8(one - r * r)};
}

Vec3f UniformSphere(float u, float v) {
  const float z = 1.0f - 2.0f * u;
  const float r = std::sqrt(std::max(0.0f, 1.0f - z * z));
  const SinCos sc = DetSinCos(2.0 * kPi * v);
  return {static_cast<float>(r * sc.cos), static_cast<float>(r * sc.sin), z};
}

Vec2f UniformTriangle(float u, float v) {
  if (v > u) {
    u *= 0.5f;
    v -= u;
  } else {
    v *= 0.5f;
    u -= v;
  }
  return {u, v};
}

}  // namespace farpoint

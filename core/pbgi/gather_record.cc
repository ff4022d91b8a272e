#include "core/pbgi/gather_record.h"

#include <algorithm>
#include <cmath>

#include "core/math/elementary.h"
#include "core/math/sampling.h"
#include "core/math/simd8.h"

namespace farpoint {

namespace {

constexpr float kLeastCosine = 0.02f;
// cos and sin of 2 pi t, t in [0, 1]: Taylor's series about the nearest quarter turn, absolute
// error below 4e-7.
void SinCosTurns8(F8 t, F8& sine, F8& cosine) {
  const F8 quarter = reinterpret_cast<F8>(_mm256_round_ps(
      reinterpret_cast<__m256>(t * Set8(4.0f)), _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC));
  const F8 a = (t - quarter * Set8(0.25f)) * Set8(static_cast<float>(2 * kPi));  // |a| <= pi / 4
  const F8 a2 = a * a;
  const F8 s =
      a * (Set8(1.0f) +
           a2 * (Set8(-1.0f / 6) +
                 a2 * (Set8(1.0f / 120) + a2 * (Set8(-1.0f / 5040) + a2 * Set8(1.0f / 362880)))));
  const F8 c = Set8(1.0f) +
               a2 * (Set8(-0.5f) +
                     a2 * (Set8(1.0f / 24) + a2 * (Set8(-1.0f / 720) + a2 * Set8(1.0f / 40320))));
  const __m256i q =
      _mm256_and_si256(_mm256_cvtps_epi32(reinterpret_cast<__m256>(quarter)), _mm256_set1_epi32(3));
  const M8 k = reinterpret_cast<M8>(q);
  const M8 swap = (k & 1) != 0;
  const F8 s0 = Select8(swap, c, s), c0 = Select8(swap, s, c);
  sine = Select8((k & 2) != 0, -s0, s0);
  cosine = Select8(((k + 1) & 2) != 0, -c0, c0);
}

}  // namespace

HemisphereGrid::HemisphereGrid(uint32_t samples) {
  const double rings = std::sqrt(static_cast<double>(samples) / kPi);
  rings_ = std::max(1u, static_cast<uint32_t>(rings + 0.5));
  sectors_ = std::max(4u, (samples + rings_ / 2) / rings_);
  stride_ = (sectors_ + 7) / 8 * 8;
  for (auto* table : {&cos_middle_, &sin_middle_, &cos_border_, &sin_border_}) {
    table->assign(stride_, 0.0f);
  }
  for (uint32_t k = 0; k < sectors_; ++k) {
    const SinCos middle = DetSinCos(2 * kPi * (k + 0.5) / sectors_);
    const SinCos border = DetSinCos(2 * kPi * k / sectors_);
    cos_middle_[k] = static_cast<float>(middle.cos);
    sin_middle_[k] = static_cast<float>(middle.sin);
    cos_border_[k] = static_cast<float>(border.cos);
    sin_border_[k] = static_cast<float>(border.sin);
  }
}

namespace {

// sin²θ = u and φ = 2 pi v, eight at a time.
void StoreDirections8(F8 u, F8 v, float* x, float* y, float* z) {
  const F8 sin2 = Min8(u, Set8(1.0f));
  F8 sine, cosine;
  SinCosTurns8(Min8(v, Set8(1.0f)), sine, cosine);
  const F8 r = Sqrt8(sin2);
  Store8(x, r * cosine);
  Store8(y, r * sine);
  Store8(z, Sqrt8(Max8(Set8(1.0f) - sin2, Set8(0.0f))));
}

}  // namespace

void HemisphereGrid::Directions(uint64_t key, float* x, float* y, float* z) const {
  const float inverse_rings = 1.0f / static_cast<float>(rings_);
  const float inverse_sectors = 1.0f / static_cast<float>(sectors_);
  alignas(32) float u[8], v[8];
  for (uint32_t j = 0; j < rings_; ++j) {
    for (uint32_t k = 0; k < stride_; k += 8) {
      for (uint32_t i = 0; i < 8; ++i) {
        const uint64_t random = HashKey(key, j * stride_ + k + i);
        u[i] = (static_cast<float>(j) + ToUnitFloat(static_cast<uint32_t>(random))) * inverse_rings;
        v[i] = (static_cast<float>(k + i) + ToUnitFloat(static_cast<uint32_t>(random >> 32))) *
               inverse_sectors;
      }
      const size_t at = size_t{j} * stride_ + k;
      StoreDirections8(Load8(u), Load8(v), x + at, y + at, z + at);
      for (uint32_t i = 0; i < 8; ++i) {
        if (k + i >= sectors_) x[at + i] = y[at + i] = z[at + i] = 0.0f;
      }
    }
  }
}

void HemisphereGrid::DirectionsIn(uint32_t ring, uint32_t sector, uint64_t key, uint32_t first,
                                  uint32_t count, float* x, float* y, float* z) const {
  // 2^32 / g and 2^32 / g², g the real root of g³ = g + 1.
  constexpr uint32_t kStepU = 3242174889u, kStepV = 2447445414u;
  const float inverse_rings = 1.0f / static_cast<float>(rings_);
  const float inverse_sectors = 1.0f / static_cast<float>(sectors_);
  const uint64_t random = HashKey(key, ring * stride_ + sector);
  alignas(32) float u[8], v[8];
  for (uint32_t at = 0; at < count; at += 8) {
    for (uint32_t i = 0; i < 8; ++i) {
      const uint32_t index = first + at + i;
      u[i] =
          (static_cast<float>(ring) + ToUnitFloat(static_cast<uint32_t>(random) + index * kStepU)) *
          inverse_rings;
      v[i] = (static_cast<float>(sector) +
              ToUnitFloat(static_cast<uint32_t>(random >> 32) + index * kStepV)) *
             inverse_sectors;
    }
    StoreDirections8(Load8(u), Load8(v), x + at, y + at, z + at);
  }
}

void HemisphereGrid::Centres(float* x, float* y, float* z) const {
  for (uint32_t j = 0; j < rings_; ++j) {
    const float sin2 = (static_cast<float>(j) + 0.5f) / static_cast<float>(rings_);
    const float r = std::sqrt(sin2), up = std::sqrt(1.0f - sin2);
    for (uint32_t k = 0; k < stride_; ++k) {
      const size_t at = size_t{j} * stride_ + k;
      x[at] = k < sectors_ ? r * cos_middle_[k] : 0.0f;
      y[at] = k < sectors_ ? r * sin_middle_[k] : 0.0f;
      z[at] = k < sectors_ ? up : 0.0f;
    }
  }
}

HemisphereSamples::HemisphereSamples(const HemisphereGrid& grid, bool tells_near)
    : storage_(size_t{tells_near ? 9u : 8u} * grid.padded(), 0.0f) {
  for (int i = 0; i < 8; ++i) values_[i] = storage_.data() + size_t(i) * grid.padded();
  values_[8] = tells_near ? storage_.data() + size_t{8} * grid.padded() : nullptr;
}

Rgb IrradianceAt(const GatherRecord& record, const Vec3f& x, const Vec3f& n) {
  const Vec3f d = x - record.position;
  const Vec3f turn = n - record.normal;
  Rgb out;
  for (int c = 0; c < 3; ++c) {
    const float e = record.irradiance[c];
    out[c] = std::max(0.0f, e + std::clamp(Dot(record.gradient[c], d), -0.5f * e, e) +
                                std::clamp(Dot(record.vector[c], turn), -0.5f * e, e));
  }
  return out;
}

float UnhiddenAt(const GatherRecord& record, const Vec3f& x, const Vec3f& n) {
  const float v = record.unhidden;
  const float moved = Dot(record.unhidden_gradient, x - record.position);
  const float turned =
      Dot(record.unhidden_vector, n - record.normal) + v * (1.0f - Dot(n, record.normal));
  return std::clamp(v + std::clamp(moved, -0.5f * v, v) + std::clamp(turned, -0.5f * v, v), 0.0f,
                    kPif);
}

struct RecordMaker {
  // kChannels: radiance, what is open, and with five what is unhidden.
  template <int kChannels>
  static GatherRecord Make(const HemisphereGrid& grid, const HemisphereSamples& samples,
                           const Vec3f& position, const Frame& frame) {
    const uint32_t rings = grid.rings_, sectors = grid.sectors_, stride = grid.stride_;
    const F8 zero = Set8(0.0f), one = Set8(1.0f);
    F8 sum[kChannels], inverse = zero, seen = zero;
    F8 vector[kChannels][3];  // by channel and local axis
    const float* value[kChannels];
    for (int c = 0; c < kChannels; ++c) {
      sum[c] = zero;
      value[c] = c < 4 ? samples.radiance(c) : samples.unhidden();
    }
    for (auto& channel : vector) channel[0] = channel[1] = channel[2] = zero;
    F8 along_t[kChannels], along_b[kChannels];  // ∇E
    for (int c = 0; c < kChannels; ++c) along_t[c] = along_b[c] = zero;
    // A row of neighbours in the ring: the sample of the sector before.
    AlignedVector<float> before(size_t{kChannels + 1} * stride);
    for (uint32_t j = 0; j < rings; ++j) {
      const size_t row = size_t{j} * stride;
      for (int c = 0; c <= kChannels; ++c) {
        const float* values = c < kChannels ? value[c] : samples.inverse_distance();
        float* shifted = before.data() + size_t(c) * stride;
        shifted[0] = values[row + sectors - 1];
        std::copy_n(values + row, sectors - 1, shifted + 1);
        std::fill(shifted + sectors, shifted + stride, 0.0f);
      }
      const float sin2_inner = static_cast<float>(j) / static_cast<float>(rings);
      const float sin_inner = std::sqrt(sin2_inner);
      const float sin_outer = std::sqrt(static_cast<float>(j + 1) / static_cast<float>(rings));
      const F8 outward_weight = Set8(sin_inner * (1.0f - sin2_inner) * static_cast<float>(2 * kPi) /
                                     static_cast<float>(sectors));
      const F8 sideways_weight = Set8(sin_outer - sin_inner);
      for (uint32_t k = 0; k < stride; k += 8) {
        const size_t at = row + k;
        const F8 d = Load8(samples.inverse_distance() + at);
        const F8 x = Load8(samples.direction(0) + at), y = Load8(samples.direction(1) + at),
                 z = Load8(samples.direction(2) + at);
        // Padding has z = 0 and counts for nothing.
        const M8 valid = (d >= zero) & (z > zero);
        inverse += Select8(valid, d, zero);
        seen += Select8(valid, one, zero);
        const F8 inverse_cosine = one / Max8(z, Set8(kLeastCosine));
        const F8 d_before = Load8(before.data() + size_t{kChannels} * stride + k);
        const F8 beside =
            Select8((d >= zero) & (d_before >= zero), Max8(d, d_before), zero) * sideways_weight;
        F8 inward = zero;
        if (j > 0) {
          const F8 d_inner = Load8(samples.inverse_distance() + at - stride);
          inward =
              Select8((d >= zero) & (d_inner >= zero), Max8(d, d_inner), zero) * outward_weight;
        }
        const F8 cm = Load8(grid.cos_middle_.data() + k), sm = Load8(grid.sin_middle_.data() + k);
        const F8 cb = Load8(grid.cos_border_.data() + k), sb = Load8(grid.sin_border_.data() + k);
        for (int c = 0; c < kChannels; ++c) {
          const F8 l = Load8(value[c] + at);
          sum[c] += l;
          const F8 weighted = l * inverse_cosine;
          vector[c][0] += weighted * x;
          vector[c][1] += weighted * y;
          vector[c][2] += weighted * z;
          const F8 sideways = (l - Load8(before.data() + size_t(c) * stride + k)) * beside;
          along_t[c] -= sideways * sb;
          along_b[c] += sideways * cb;
          if (j > 0) {
            const F8 outward = (l - Load8(value[c] + at - stride)) * inward;
            along_t[c] += outward * cm;
            along_b[c] += outward * sm;
          }
        }
      }
    }
    GatherRecord record;
    record.position = position;
    record.normal = frame.n;
    const float each = kPif / static_cast<float>(grid.size());
    const float inverse_sum = Sum8(inverse);
    record.harmonic_distance_m =
        inverse_sum > 0.0f ? Sum8(seen) / inverse_sum : std::numeric_limits<float>::infinity();
    for (int c = 0; c < kChannels; ++c) {
      const Vec3f gradient = frame.t * Sum8(along_t[c]) + frame.b * Sum8(along_b[c]);
      const Vec3f v =
          frame.ToWorld(Vec3f(Sum8(vector[c][0]), Sum8(vector[c][1]), Sum8(vector[c][2])) * each);
      const size_t channel = static_cast<size_t>(c);
      (c < 3    ? record.irradiance[c]
       : c == 3 ? record.openness
                : record.unhidden) = Sum8(sum[c]) * each;
      (c < 3    ? record.gradient[channel]
       : c == 3 ? record.open_gradient
                : record.unhidden_gradient) = gradient;
      (c < 3 ? record.vector[channel] : c == 3 ? record.open_vector : record.unhidden_vector) = v;
    }
    return record;
  }
};

GatherRecord MakeGatherRecord(const HemisphereGrid& grid, const HemisphereSamples& samples,
                              const Vec3f& position, const Frame& frame) {
  return samples.unhidden() != nullptr ? RecordMaker::Make<5>(grid, samples, position, frame)
                                       : RecordMaker::Make<4>(grid, samples, position, frame);
}

GatherRecord MakeGatherRecordLiteral(const HemisphereGrid& grid, const HemisphereSamples& samples,
                                     const Vec3f& position, const Frame& frame) {
  GatherRecord record;
  record.position = position;
  record.normal = frame.n;
  const uint32_t rings = grid.rings(), sectors = grid.sectors();
  const double each = kPi / grid.size();
  const auto index = [&](uint32_t j, uint32_t k) { return size_t{j} * grid.stride() + k; };
  const auto radiance = [&](size_t at, int c) {
    return static_cast<double>(c < 4 ? samples.radiance(c)[at] : samples.unhidden()[at]);
  };
  const int channels = samples.unhidden() != nullptr ? 5 : 4;
  // 1 / the distance of the nearer one of two; 0 if one was not seen.
  const auto nearer = [&](size_t a, size_t b) {
    const double x = static_cast<double>(samples.inverse_distance()[a]);
    const double y = static_cast<double>(samples.inverse_distance()[b]);
    return x < 0 || y < 0 ? 0.0 : std::max(x, y);
  };
  std::array<double, 5> sum = {};
  double inverse = 0;
  uint32_t seen = 0;
  std::array<Vec3d, 5> vector, gradient;
  for (uint32_t j = 0; j < rings; ++j) {
    for (uint32_t k = 0; k < sectors; ++k) {
      const size_t at = index(j, k);
      if (samples.inverse_distance()[at] >= 0) {
        ++seen;
        inverse += static_cast<double>(samples.inverse_distance()[at]);
      }
      const Vec3f local(samples.direction(0)[at], samples.direction(1)[at],
                        samples.direction(2)[at]);
      const double cosine =
          std::max(static_cast<double>(kLeastCosine), static_cast<double>(local.z));
      for (int c = 0; c < channels; ++c) {
        const size_t channel = static_cast<size_t>(c);
        sum[channel] += radiance(at, c);
        vector[channel] += Vec3d(frame.ToWorld(local)) * (radiance(at, c) * each / cosine);
      }

      const double sin2 = static_cast<double>(j) / rings;
      const SinCos middle = DetSinCos(2 * kPi * (k + 0.5) / sectors);
      const SinCos border = DetSinCos(2 * kPi * k / sectors);
      const Vec3d outward = Vec3d(frame.t) * middle.cos + Vec3d(frame.b) * middle.sin;
      const Vec3d sideways = Vec3d(frame.b) * border.cos - Vec3d(frame.t) * border.sin;
      const size_t inner = j > 0 ? index(j - 1, k) : at;
      const size_t beside = index(j, k == 0 ? sectors - 1 : k - 1);
      const double ring_weight =
          std::sqrt(sin2) * (1 - sin2) * 2 * kPi / sectors * nearer(at, inner);
      const double sector_weight =
          (std::sqrt((j + 1.0) / rings) - std::sqrt(sin2)) * nearer(at, beside);
      for (int c = 0; c < channels; ++c) {
        gradient[static_cast<size_t>(c)] +=
            outward * ((radiance(at, c) - radiance(inner, c)) * ring_weight) +
            sideways * ((radiance(at, c) - radiance(beside, c)) * sector_weight);
      }
    }
  }
  record.irradiance = Rgb(Vec3d(sum[0], sum[1], sum[2]) * each);
  record.openness = static_cast<float>(sum[3] * each);
  record.open_gradient = Vec3f(gradient[3]);
  record.open_vector = Vec3f(vector[3]);
  record.unhidden = static_cast<float>(sum[4] * each);
  record.unhidden_gradient = Vec3f(gradient[4]);
  record.unhidden_vector = Vec3f(vector[4]);
  record.harmonic_distance_m =
      inverse > 0 ? static_cast<float>(seen / inverse) : std::numeric_limits<float>::infinity();
  for (int c = 0; c < 3; ++c) {
    record.gradient[c] = Vec3f(gradient[c]);
    record.vector[c] = Vec3f(vector[c]);
  }
  return record;
}

}  // namespace farpoint

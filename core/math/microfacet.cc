#include "core/math/microfacet.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>

#include "core/math/elementary.h"
#include "core/math/sampling.h"

namespace farpoint {

namespace {

constexpr int kRows = 32, kColumns = 32;
constexpr uint32_t kTableSamples = 1024;
// Of cosines with the horizon, for what is seen edge-on.
constexpr float kLeastCosine = 1e-3f;
// Of draws by the cosine: what they are for would else get none where it is faint.
constexpr float kLeastCosineShare = 0.05f;
// Light that is reflected more than once counts from this part of all on.
constexpr float kNegligible = 5e-5f;

float Fresnel(float cosine) {
  const float x = std::clamp(1.0f - cosine, 0.0f, 1.0f);
  const float x2 = x * x;
  return x2 * x2 * x;
}

float Smith(float alpha2, float cosine) {
  return std::sqrt(alpha2 + (1.0f - alpha2) * cosine * cosine);
}

// D of a half vector of any length > 0.
float Distribution(float alpha2, const Vec3f& h) {
  const float length2 = Length2(h);
  const float d = h.x * h.x + h.y * h.y + alpha2 * h.z * h.z;
  const float q = length2 / d;
  return alpha2 * kInvPif * q * q;
}

Vec3f VisibleNormal(float alpha, const Vec3f& wo, float u, float v) {
  const Vec3f stretched = Normalize(Vec3f(alpha * wo.x, alpha * wo.y, wo.z));
  const float across2 = stretched.x * stretched.x + stretched.y * stretched.y;
  const Vec3f t1 = across2 > 0.0f
                       ? Vec3f(-stretched.y, stretched.x, 0) * (1.0f / std::sqrt(across2))
                       : Vec3f(1, 0, 0);
  const Vec3f t2 = Cross(stretched, t1);
  const Vec2f disc = ConcentricDisc(u, v);
  const float s = 0.5f * (1.0f + stretched.z);
  const float a = disc.x;
  const float b = (1.0f - s) * std::sqrt(std::max(0.0f, 1.0f - a * a)) + s * disc.y;
  const float c = std::sqrt(std::max(0.0f, 1.0f - a * a - b * b));
  const Vec3f n = t1 * a + t2 * b + stretched * c;
  return NormalizeOr(Vec3f(alpha * n.x, alpha * n.y, std::max(0.0f, n.z)), Vec3f(0, 0, 1));
}

Vec3f Reflected(const Vec3f& wo, const Vec3f& h) { return h * (2.0f * Dot(wo, h)) - wo; }

// What single reflections return of uniform light: a + f b with F0 = f (so a: Fresnel's share that
// does not depend on F0, b: the rest; a + b is E), by roughness (rows) and sqrt of the cosine.
struct Tables {
  std::array<std::array<float, kColumns>, kRows> fresnel, rest;
  std::array<float, kRows> mean_fresnel, mean_rest;  // over the hemisphere, by the cosine

  Tables() {
    for (int r = 0; r < kRows; ++r) {
      const float alpha = AlphaOf(static_cast<float>(r) / (kRows - 1));
      for (int c = 0; c < kColumns; ++c) {
        const float t = static_cast<float>(c) / (kColumns - 1);
        Fill(alpha, std::max(t * t, kLeastCosine), fresnel[Index(r)][Index(c)],
             rest[Index(r)][Index(c)]);
      }
      mean_fresnel[Index(r)] = Mean(fresnel[Index(r)]);
      mean_rest[Index(r)] = Mean(rest[Index(r)]);
    }
  }

 private:
  static size_t Index(int i) { return static_cast<size_t>(i); }

  static void Fill(float alpha, float cosine, float& fresnel, float& rest) {
    const Vec3f wo{std::sqrt(1.0f - cosine * cosine), 0, cosine};
    const float alpha2 = alpha * alpha;
    const float smith_o = Smith(alpha2, cosine);
    double by_fresnel = 0, others = 0;
    for (uint32_t i = 0; i < kTableSamples; ++i) {
      const Vec3f h = VisibleNormal(alpha, wo, OwenSobol(i, 0, 1), OwenSobol(i, 1, 1));
      const Vec3f wi = Reflected(wo, h);
      if (!(wi.z > 0.0f)) continue;
      // f cosθ / pdf without F is G2 / G1(wo).
      const float weight =
          wi.z * (cosine + smith_o) / (wi.z * smith_o + cosine * Smith(alpha2, wi.z));
      const float f = Fresnel(Dot(wo, h));
      by_fresnel += static_cast<double>(weight * f);
      others += static_cast<double>(weight * (1.0f - f));
    }
    fresnel = static_cast<float>(by_fresnel / kTableSamples);
    rest = static_cast<float>(others / kTableSamples);
  }

  // 2 ∫ x μ dμ with μ = t², of what is linear in t between the columns: three points of Gauss a
  // column are exact.
  static float Mean(const std::array<float, kColumns>& x) {
    constexpr double kNode = 0.7745966692414834;  // sqrt(3/5)
    constexpr double kAt[3] = {0.5 - 0.5 * kNode, 0.5, 0.5 + 0.5 * kNode};
    constexpr double kWeight[3] = {5.0 / 18, 8.0 / 18, 5.0 / 18};
    double sum = 0;
    for (size_t c = 0; c + 1 < kColumns; ++c) {
      for (int k = 0; k < 3; ++k) {
        const double t = (static_cast<double>(c) + kAt[k]) / (kColumns - 1);
        const double value =
            static_cast<double>(x[c]) * (1 - kAt[k]) + static_cast<double>(x[c + 1]) * kAt[k];
        sum += kWeight[k] * value * 4 * t * t * t / (kColumns - 1);
      }
    }
    return static_cast<float>(sum);
  }
};

const Tables& TablesOf() {
  static const Tables tables;
  return tables;
}

struct Tap {
  size_t first;
  float weight;  // of the next one
};
Tap TapOf(float at, int count) {
  const int first = std::clamp(static_cast<int>(at), 0, count - 2);
  return {static_cast<size_t>(first), std::clamp(at - static_cast<float>(first), 0.0f, 1.0f)};
}

float RowOf(float roughness) { return std::clamp(roughness, 0.0f, 1.0f) * (kRows - 1); }

struct Shares {
  float fresnel, rest;
  float all() const { return fresnel + rest; }
};

Shares SharesAt(float row, float cosine) {
  const Tables& t = TablesOf();
  const Tap r = TapOf(row, kRows);
  const Tap c = TapOf(std::sqrt(std::clamp(cosine, 0.0f, 1.0f)) * (kColumns - 1), kColumns);
  const auto at = [&](const std::array<std::array<float, kColumns>, kRows>& x) {
    const auto column = [&](size_t i) {
      return x[r.first][i] * (1.0f - r.weight) + x[r.first + 1][i] * r.weight;
    };
    return column(c.first) * (1.0f - c.weight) + column(c.first + 1) * c.weight;
  };
  return {at(t.fresnel), at(t.rest)};
}

Shares MeanSharesAt(float row) {
  const Tables& t = TablesOf();
  const Tap r = TapOf(row, kRows);
  const auto at = [&](const std::array<float, kRows>& x) {
    return x[r.first] * (1.0f - r.weight) + x[r.first + 1] * r.weight;
  };
  return {at(t.mean_fresnel), at(t.mean_rest)};
}

// Kulla and Conty's: of the light that is reflected again and again, the part that gets out.
// `mean` is E_avg.
float MultipleFresnel(float f0, float mean) {
  const float f = f0 + (1.0f - f0) * (1.0f / 21);  // Schlick's, averaged by the cosine
  return f * f * mean / (1.0f - f * (1.0f - mean));
}

// Reflectance of the interface for uniform light, all bounces, given its shares.
float InterfaceReflectance(float f0, float ms, const Shares& shares) {
  return std::min(1.0f, shares.fresnel + f0 * shares.rest + ms * (1.0f - shares.all()));
}

}  // namespace

float AlphaOf(float roughness) { return std::max(kLeastAlpha, roughness * roughness); }

Rgb MeanReflectance(const MicrofacetMaterial& m) {
  const Shares mean = MeanSharesAt(RowOf(m.roughness));
  const auto interface = [&](float f0) {
    return InterfaceReflectance(f0, MultipleFresnel(f0, mean.all()), mean);
  };
  const float dielectric = interface(m.dielectric_f0);
  Rgb out;
  for (int c = 0; c < 3; ++c) {
    const float base = m.base_color[c];
    out[c] = std::clamp((1.0f - m.metallic) * (dielectric + base * (1.0f - dielectric)) +
                            m.metallic * interface(base),
                        0.0f, 1.0f);
  }
  return out;
}

MicrofacetBrdf::MicrofacetBrdf(const MicrofacetMaterial& m, const Vec3f& wo_local)
    : wo_(wo_local),
      alpha_(AlphaOf(m.roughness)),
      alpha2_(alpha_ * alpha_),
      row_(RowOf(m.roughness)),
      dielectric_f0_(m.dielectric_f0) {
  if (!(wo_.z > kLeastCosine)) wo_ = Normalize(Vec3f(wo_.x, wo_.y, kLeastCosine));
  smith_o_ = Smith(alpha2_, wo_.z);
  const Shares at = SharesAt(row_, wo_.z), mean = MeanSharesAt(row_);
  // Neither is quite 0, or this would divide by it: E_avg is below 1 by the tables' error.
  const float lost = std::max(1.0f - at.all(), 0.0f),
              lost_mean = std::max(1.0f - mean.all(), 1e-4f);
  dielectric_ms_ = MultipleFresnel(dielectric_f0_, mean.all());
  const float r_o = InterfaceReflectance(dielectric_f0_, dielectric_ms_, at);
  const float r_mean = InterfaceReflectance(dielectric_f0_, dielectric_ms_, mean);
  const float through = (1.0f - m.metallic) * (1.0f - r_o);
  diffuse_albedo_ = m.base_color * through;
  diffuse_ = diffuse_albedo_ * (kInvPif / std::max(1.0f - r_mean, 1e-4f));
  Rgb single, multiple;
  for (int c = 0; c < 3; ++c) {
    const float base = m.base_color[c];
    f0_[c] = dielectric_f0_ + (base - dielectric_f0_) * m.metallic;
    const float of_metal = MultipleFresnel(base, mean.all());
    multiple[c] = (dielectric_ms_ + (of_metal - dielectric_ms_) * m.metallic) * lost;
    single[c] = at.fresnel + f0_[c] * at.rest;
  }
  const float first = std::max(Luminance(single), 1e-4f);
  // What does not matter would cost draws that a mirror needs.
  if (1.0f - mean.all() < kNegligible) multiple = Rgb();
  ms_ = multiple * (kInvPif / lost_mean);
  glossy_albedo_ = single + multiple;
  const auto share_beside = [&](float others) {
    return others > 0.0f ? std::min(first / (first + others), 1.0f - kLeastCosineShare) : 1.0f;
  };
  glossy_share_ = share_beside(Luminance(multiple));
  whole_share_ = share_beside(Luminance(multiple) + Luminance(diffuse_albedo_));
}

MicrofacetBrdf::Value MicrofacetBrdf::Evaluate(const Vec3f& wi) const {
  Value out;
  if (!(wi.z > 0.0f)) return out;
  const Shares at = SharesAt(row_, wi.z);
  const Vec3f h = wo_ + wi;
  const float v = 0.5f / (wi.z * smith_o_ + wo_.z * Smith(alpha2_, wi.z));
  const float f = Fresnel(Dot(wi, h) / std::sqrt(Length2(h)));
  const float dv = Distribution(alpha2_, h) * v;
  out.glossy = (f0_ * (1.0f - f) + Rgb(f)) * dv + ms_ * std::max(1.0f - at.all(), 0.0f);
  out.diffuse = diffuse_ * (1.0f - InterfaceReflectance(dielectric_f0_, dielectric_ms_, at));
  return out;
}

Vec3f MicrofacetBrdf::Sample(float u, float v, float share) const {
  if (u < share) {
    const float within = std::min(u / share, 0.99999994f);
    return Reflected(wo_, VisibleNormal(alpha_, wo_, within, v));
  }
  return CosineHemisphere(std::min((u - share) / (1.0f - share), 0.99999994f), v);
}

float MicrofacetBrdf::Pdf(const Vec3f& wi, float share) const {
  if (!(wi.z > 0.0f)) return 0.0f;
  const Vec3f h = wo_ + wi;
  const float visible = Distribution(alpha2_, h) / (2.0f * (wo_.z + smith_o_));
  return share * visible + (1.0f - share) * wi.z * kInvPif;
}

}  // namespace farpoint

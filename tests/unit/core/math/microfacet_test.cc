#include "core/math/microfacet.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <vector>

#include "core/math/elementary.h"
#include "core/math/sampling.h"

namespace farpoint {
namespace {

constexpr float kRoughness[] = {0.0f, 0.05f, 0.1f, 0.2f,  0.3f, 0.45f,
                                0.5f, 0.7f,  0.8f, 0.93f, 1.0f};
constexpr float kCosines[] = {0.01f, 0.05f, 0.1f, 0.3f, 0.5f, 0.77f, 0.95f, 1.0f};

Vec3f DirectionAt(float cosine, float phi = 0) {
  const float s = std::sqrt(1 - cosine * cosine);
  return {s * std::cos(phi), s * std::sin(phi), cosine};
}

struct Albedo {
  Vec3d diffuse, glossy;
};
// ∫ f cosθ dω by the BRDF's own directions.
Albedo Integrate(const MicrofacetBrdf& brdf, uint32_t samples) {
  Albedo sum;
  for (uint32_t i = 0; i < samples; ++i) {
    const Vec3f wi = brdf.Sample(OwenSobol(i, 0, 7), OwenSobol(i, 1, 7));
    if (!(wi.z > 0)) continue;
    const auto f = brdf.Evaluate(wi);
    const double weight = static_cast<double>(wi.z) / static_cast<double>(brdf.Pdf(wi));
    sum.diffuse += Vec3d(f.diffuse) * weight;
    sum.glossy += Vec3d(f.glossy) * weight;
  }
  return {sum.diffuse / samples, sum.glossy / samples};
}

TEST(Microfacet, AWhiteMetalReflectsAllLight) {
  for (const float roughness : kRoughness) {
    for (const float cosine : kCosines) {
      const MicrofacetBrdf brdf({Rgb(1), 1, roughness, 0.04f}, DirectionAt(cosine));
      const Albedo a = Integrate(brdf, 1 << 14);
      EXPECT_NEAR(a.glossy.x, 1, cosine < 0.05f ? 0.025 : 0.005) << roughness << " " << cosine;
      EXPECT_EQ(a.diffuse, Vec3d());
    }
  }
}

TEST(Microfacet, AWhiteDielectricReflectsAllLight) {
  for (const float roughness : kRoughness) {
    for (const float cosine : kCosines) {
      const MicrofacetBrdf brdf({Rgb(1), 0, roughness, 0.04f}, DirectionAt(cosine));
      const Albedo a = Integrate(brdf, 1 << 14);
      EXPECT_NEAR(a.diffuse.y + a.glossy.y, 1, cosine < 0.05f ? 0.025 : 0.007)
          << roughness << " " << cosine;
    }
  }
}

// What is said of uniform light is what the integral gives; the mean over all directions is
// MeanReflectance.
TEST(Microfacet, AlbedosAreTheIntegrals) {
  for (const float roughness : kRoughness) {
    for (const float metallic : {0.0f, 0.4f, 1.0f}) {
      const MicrofacetMaterial material{{0.9f, 0.5f, 0.1f}, metallic, roughness, 0.04f};
      Vec3d mean;
      constexpr int kMean = 64;
      for (int i = 0; i < kMean; ++i) {
        const float cosine = std::sqrt((static_cast<float>(i) + 0.5f) / kMean);
        const MicrofacetBrdf brdf(material, DirectionAt(cosine));
        const Albedo a = Integrate(brdf, 1 << 10);
        for (int c = 0; c < 3; ++c) {
          EXPECT_NEAR(a.glossy[c], brdf.glossy_albedo()[c], 0.02) << roughness << " " << cosine;
          EXPECT_NEAR(a.diffuse[c], brdf.diffuse_albedo()[c], 0.02) << roughness << " " << cosine;
        }
        mean += (Vec3d(brdf.glossy_albedo()) + Vec3d(brdf.diffuse_albedo())) / kMean;
      }
      const Rgb all = MeanReflectance(material);
      for (int c = 0; c < 3; ++c) {
        EXPECT_NEAR(mean[c], all[c], 0.004) << roughness << " " << metallic;
        EXPECT_LE(all[c], 1.0f);
      }
    }
  }
}

TEST(Microfacet, IsReciprocal) {
  for (const float roughness : kRoughness) {
    for (const float metallic : {0.0f, 0.5f, 1.0f}) {
      const MicrofacetMaterial material{{0.9f, 0.5f, 0.1f}, metallic, roughness, 0.04f};
      for (uint32_t i = 0; i < 64; ++i) {
        const Vec3f a = CosineHemisphere(OwenSobol(i, 0, 3), OwenSobol(i, 1, 3));
        const Vec3f b = CosineHemisphere(OwenSobol(i, 2, 3), OwenSobol(i, 3, 3));
        if (a.z < 0.01f || b.z < 0.01f) continue;
        const auto ab = MicrofacetBrdf(material, a).Evaluate(b);
        const auto ba = MicrofacetBrdf(material, b).Evaluate(a);
        for (int c = 0; c < 3; ++c) {
          EXPECT_NEAR(ab.glossy[c], ba.glossy[c], 1e-4f * (1 + ab.glossy[c]));
          EXPECT_NEAR(ab.diffuse[c], ba.diffuse[c], 1e-4f * (1 + ab.diffuse[c]));
        }
      }
    }
  }
}

// Of lobes that a grid over the hemisphere resolves.
TEST(Microfacet, DensitiesIntegrateToWhatLiesAboveTheHorizon) {
  for (const float roughness : {0.3f, 0.5f, 0.8f, 1.0f}) {
    for (const float cosine : kCosines) {
      for (const float metallic : {0.0f, 1.0f}) {
        const MicrofacetBrdf brdf({Rgb(0.5f), metallic, roughness, 0.04f}, DirectionAt(cosine));
        double glossy = 0, whole = 0;
        constexpr int kZ = 400, kPhi = 400;
        for (int i = 0; i < kZ; ++i) {
          for (int j = 0; j < kPhi; ++j) {
            // Finer towards the horizon and the plane of the mirror: lobes of grazing light are
            // thin.
            const float t = (static_cast<float>(i) + 0.5f) / kZ;
            const float s = 2 * (static_cast<float>(j) + 0.5f) / kPhi - 1;
            const Vec3f wi = DirectionAt(t * t, kPif * (1 + s * s * s));
            const double each = 2 * t * 3 * s * s * kPi * 2 / (kZ * kPhi);
            glossy += each * static_cast<double>(brdf.GlossyPdf(wi));
            whole += each * static_cast<double>(brdf.Pdf(wi));
          }
        }
        uint32_t glossy_above = 0, whole_above = 0;
        constexpr uint32_t kDraws = 1 << 14;
        for (uint32_t i = 0; i < kDraws; ++i) {
          const float u = OwenSobol(i, 0, 5), v = OwenSobol(i, 1, 5);
          glossy_above += brdf.SampleGlossy(u, v).z > 0;
          whole_above += brdf.Sample(u, v).z > 0;
        }
        EXPECT_NEAR(glossy, glossy_above / double{kDraws}, 0.01) << roughness << cosine;
        EXPECT_NEAR(whole, whole_above / double{kDraws}, 0.01) << roughness << cosine;
      }
    }
  }
}

// Counts of draws in the cells of a grid against the density's integral there.
TEST(Microfacet, DrawsFollowTheDensity) {
  constexpr int kZ = 8, kPhi = 8, kFine = 24;
  constexpr uint32_t kDraws = 1 << 16;
  for (const float roughness : {0.35f, 0.7f, 1.0f}) {
    const MicrofacetBrdf brdf({Rgb(0.7f), 0.5f, roughness, 0.04f}, DirectionAt(0.6f, 1.0f));
    std::vector<double> expected(kZ * kPhi), counted(kZ * kPhi);
    for (int i = 0; i < kZ * kFine; ++i) {
      for (int j = 0; j < kPhi * kFine; ++j) {
        const float z = (static_cast<float>(i) + 0.5f) / (kZ * kFine);
        const float phi = 2 * kPif * ((static_cast<float>(j) + 0.5f) / (kPhi * kFine) - 0.5f);
        expected[static_cast<size_t>(i / kFine * kPhi + j / kFine)] +=
            static_cast<double>(brdf.GlossyPdf(DirectionAt(z, phi))) * 2 * kPi /
            (kZ * kFine * kPhi * kFine);
      }
    }
    for (uint32_t i = 0; i < kDraws; ++i) {
      const Vec3f w = brdf.SampleGlossy(OwenSobol(i, 0, 9), OwenSobol(i, 1, 9));
      if (!(w.z > 0)) continue;
      const double phi = std::atan2(static_cast<double>(w.y), static_cast<double>(w.x));
      const int a = std::min(kZ - 1, static_cast<int>(w.z * kZ));
      const int b = std::clamp(static_cast<int>((phi / (2 * kPi) + 0.5) * kPhi), 0, kPhi - 1);
      counted[static_cast<size_t>(a * kPhi + b)] += 1.0 / kDraws;
    }
    for (size_t k = 0; k < expected.size(); ++k) {
      EXPECT_NEAR(counted[k], expected[k], 0.002 + 0.03 * expected[k]) << roughness << " " << k;
    }
  }
}

TEST(Microfacet, IsFiniteForWhateverDirections) {
  for (const float roughness : {0.0f, 0.01f, 1.0f}) {
    for (const Vec3f& wo :
         {Vec3f(0, 0, 1), Vec3f(1, 0, 0), Vec3f(0, 1, 0), Vec3f(0, 0, -1), Vec3f(0.6f, 0, -0.8f)}) {
      for (const float metallic : {0.0f, 1.0f}) {
        const MicrofacetBrdf brdf({Rgb(1), metallic, roughness, 0.04f}, wo);
        for (uint32_t i = 0; i < 256; ++i) {
          const Vec3f w = brdf.Sample(OwenSobol(i, 0, 2), OwenSobol(i, 1, 2));
          EXPECT_TRUE(IsFinite(w));
          const auto f = brdf.Evaluate(w);
          EXPECT_TRUE(IsFinite(f.diffuse) && IsFinite(f.glossy));
          EXPECT_TRUE(std::isfinite(brdf.Pdf(w)));
          EXPECT_GE(std::min(f.glossy.x, f.diffuse.x), 0.0f);
        }
      }
    }
  }
}

TEST(Microfacet, ASmoothMetalIsAMirror) {
  const Vec3f wo = DirectionAt(0.5f);
  const MicrofacetBrdf brdf({Rgb(1), 1, 0, 0.04f}, wo);
  uint32_t near = 0;
  for (uint32_t i = 0; i < 256; ++i) {
    const Vec3f w = brdf.Sample(OwenSobol(i, 0, 4), OwenSobol(i, 1, 4));
    near += Length(w - Vec3f(-wo.x, -wo.y, wo.z)) < 0.05f;
  }
  EXPECT_GT(near, 235u);
}

}  // namespace
}  // namespace farpoint

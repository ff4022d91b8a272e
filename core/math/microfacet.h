// The metallic-roughness surface of glTF 2.0 (appendix B): a dielectric, a diffuse base under a
// clear, rough interface, mixed with a rough metal. Directions are in the frame of the shading
// normal (z), away from the surface; everything is per steradian and without the cosine.
//
//   f = (1 - m) (f_s(F0 = f0) + f_d) + m f_s(F0 = base colour),          m = metallic
//   f_s = D V F + F_ms (1 - E(μo)) (1 - E(μi)) / (π (1 - E_avg))
//   f_d = base / π (1 - R(μo)) (1 - R(μi)) / (1 - R_avg)
//
// D: GGX [Walter et al. 2007, eq. 33] with α = roughness², at least kLeastAlpha; V: height-
// correlated Smith [Heitz 2014, eq. 99] over 4 μo μi; F: Schlick 1994. The second term of f_s is
// the light that a rough interface reflects more than once [Kulla and Conty 2017, with their F_ms]:
// E(μ) is what D V reflects of uniform light if F is 1, so with F0 = 1 all light comes back. f_d is
// lit by what f_s (reflectance R at F0 = f0) lets through on both ways [Kelemen and Szirmay-Kalos
// 2001], so with base colour 1 all light comes back, too. Every term is reciprocal.
//
// E and its share by Fresnel are tabulated (32 roughnesses x 32 cosines, linear between them); the
// white furnace closes to 0.7 % at any roughness and cosine >= 0.05, and to 2.5 % down to 0.01.
#pragma once

#include "core/math/vec.h"

namespace farpoint {

struct MicrofacetMaterial {
  Rgb base_color;           // linear, [0, 1]
  float metallic = 0;       // [0, 1]
  float roughness = 1;      // perceptual, [0, 1]
  float dielectric_f0 = 0;  // reflectance at normal incidence where it is no metal, [0, 1)
};

// The least α: below it a lobe is narrower than a pixel of any image, and D would leave a float.
inline constexpr float kLeastAlpha = 0.002f;

// α of a material.
float AlphaOf(float roughness);

// The part of uniform light that comes back in all directions: what a surface reflects if one does
// not ask where to. Within [0, 1].
Rgb MeanReflectance(const MicrofacetMaterial& material);

// The reflection towards one direction. Immutable; cheap to make beside a ray.
class MicrofacetBrdf {
 public:
  // `wo_local` is unit; one below or near the horizon is taken to lie just above it.
  MicrofacetBrdf(const MicrofacetMaterial& material, const Vec3f& wo_local);

  struct Value {
    Rgb diffuse, glossy;  // 1/sr
  };
  // Of light from the unit direction `wi_local`; zero below the horizon.
  Value Evaluate(const Vec3f& wi_local) const;

  // What uniform light of radiance 1 gives, to the tables' error: ∫ f cosθ dω.
  const Rgb& diffuse_albedo() const { return diffuse_albedo_; }
  const Rgb& glossy_albedo() const { return glossy_albedo_; }
  float alpha() const { return alpha_; }

  // Directions by the glossy part's density: visible normals [Heitz 2018] for the first reflection,
  // the cosine for the others, in proportion to what each reflects. A direction below the horizon
  // carries nothing; the density counts those too, so over the hemisphere it integrates to less
  // than 1.
  Vec3f SampleGlossy(float u, float v) const { return Sample(u, v, glossy_share_); }
  float GlossyPdf(const Vec3f& wi_local) const { return Pdf(wi_local, glossy_share_); }  // 1/sr
  // The same of the whole.
  Vec3f Sample(float u, float v) const { return Sample(u, v, whole_share_); }
  float Pdf(const Vec3f& wi_local) const { return Pdf(wi_local, whole_share_); }

 private:
  Vec3f Sample(float u, float v, float share) const;
  float Pdf(const Vec3f& wi_local, float share) const;

  Vec3f wo_;
  float alpha_, alpha2_;
  float smith_o_;  // sqrt(α² + (1 - α²) μo²)
  float row_;      // into the tables, by roughness
  Rgb f0_;
  float dielectric_f0_, dielectric_ms_;
  Rgb ms_;       // F_ms (1 - E(μo)) / (π (1 - E_avg))
  Rgb diffuse_;  // base (1 - m) / π (1 - R(μo)) / (1 - R_avg)
  Rgb diffuse_albedo_, glossy_albedo_;
  float glossy_share_, whole_share_;  // of draws by visible normals
};

}  // namespace farpoint

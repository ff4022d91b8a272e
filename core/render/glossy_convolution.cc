#include "core/render/glossy_convolution.h"

#include "core/math/elementary.h"

namespace farpoint {

bool CarriesLobe(const MicrobufferMap& map, float alpha) {
  return 4.0f * kPif * alpha * alpha >= kLobePixels * map.reference_solid_angle();
}

GlossyConvolution::GlossyConvolution(const MicrobufferMap& map) : map_(map) {
  for (auto& w : weight_) w.resize(map.padded());
}

Rgb GlossyConvolution::Reflect(const Microbuffer& far, const Microbuffer* near,
                               const GlossyPoint& point, Splat splat) {
  const bool world = map_.kind() == BufferMap::kOctahedral;
  const Vec3f axis = world ? point.surface().n : Vec3f(0, 0, 1);
  for (uint32_t p = 0; p < map_.pixels(); ++p) {
    const Vec3f v(map_.weight(0)[p], map_.weight(1)[p], map_.weight(2)[p]);
    const float cosine_sr = Dot(axis, v);
    Rgb w;
    if (cosine_sr > 0.0f) {
      Vec3f d(map_.dir(0)[p], map_.dir(1)[p], map_.dir(2)[p]);
      if (world) d = point.ToLocal(d);
      // Pixels that the horizon cuts may have their centre below it.
      constexpr float kLeastCosine = 1e-3f;
      if (!(d.z > kLeastCosine)) d = Normalize(Vec3f(d.x, d.y, kLeastCosine));
      w = point.brdf().Evaluate(d).glossy * cosine_sr;
    }
    for (int c = 0; c < 3; ++c) weight_[c][p] = w[c];
  }
  return ConvolveLobe(far, near, {weight_[0].data(), weight_[1].data(), weight_[2].data()},
                      point.brdf().glossy_albedo(), splat);
}

}  // namespace farpoint

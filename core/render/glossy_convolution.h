// What a glossy receiver reflects of a microbuffer: the paper's BRDF convolution, where the
// buffer's pixels carry the lobe.
#pragma once

#include "core/base/aligned.h"
#include "core/pbgi/microbuffer.h"
#include "core/render/glossy_point.h"

namespace farpoint {

// The lobe about its mirror direction is about 4 pi α² steradians wide (one over the density of GGX
// there, seen straight on). It is carried by pixels of which it holds at least kLobePixels: 32 x 32
// of the whole sphere carry α >= 0.177, a roughness of 0.42, 16 x 16 one of 0.6.
inline constexpr float kLobePixels = 32;
bool CarriesLobe(const MicrobufferMap& map, float alpha);

// For one thread.
class GlossyConvolution {
 public:
  // The map must outlive it.
  explicit GlossyConvolution(const MicrobufferMap& map);
  // The glossy part's radiance, W/(m² sr), of `far` seen through `near` (may be null). The lobe is
  // taken at the pixels' centres; a buffer of constant radiance is exact.
  Rgb Reflect(const Microbuffer& far, const Microbuffer* near, const GlossyPoint& point,
              Splat splat);

 private:
  const MicrobufferMap& map_;
  AlignedVector<float> weight_[3];
};

}  // namespace farpoint

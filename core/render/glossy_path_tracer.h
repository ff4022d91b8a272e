// The ground truth where surfaces are glossy: path tracing with the whole BRDF at the receiver and
// at every hit. Indirect light is what paths of up to `bounces` reflections before the receiver's
// own bring, where light that an emitter or the environment sends to a hit is estimated by
// GlossyPoint::Direct's rule (glossy hits) or one sample of each kind of light (Lambert hits);
// emission that the receiver itself meets is no part of it, but of direct light.
#pragma once

#include <cstdint>

#include "core/accel/ray_accel.h"
#include "core/light/light_sampler.h"
#include "core/render/glossy_point.h"
#include "core/render/path_tracer.h"

namespace farpoint {

struct TracedReflection {
  Rgb diffuse, glossy;  // W/(m² sr)
  Rgb standard_error;   // of their sum; 0 with fewer than 8 paths
};

// Unbiased. Owen-scrambled Sobol' points as in TraceIndirect, another set for each bounce in
// another order. `counters`, `rays`, `needless` as there.
TracedReflection TraceGlossyIndirect(const RayAccel& accel, const LightSampler& lights,
                                     const GlossyPoint& receiver, uint32_t paths, uint32_t bounces,
                                     uint64_t key, LightCounters& counters, uint64_t& rays,
                                     unsigned needless = 0);

// TraceIndirect in a scene with glossy surfaces: the same irradiance.
TracedIrradiance TraceIndirectAmongGloss(const RayAccel& accel, const LightSampler& lights,
                                         const Receiver& receiver, uint32_t paths, uint32_t bounces,
                                         uint64_t key, LightCounters& counters, uint64_t& rays,
                                         unsigned needless = 0);

}  // namespace farpoint

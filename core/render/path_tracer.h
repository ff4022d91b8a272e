// The ground truth: diffuse indirect irradiance by path tracing over the triangles.
#pragma once

#include <cstdint>

#include "core/accel/ray_accel.h"
#include "core/light/light_sampler.h"
#include "core/math/vec.h"
#include "core/pbgi/receiver_cluster.h"

namespace farpoint {

struct TracedIrradiance {
  Rgb irradiance;      // W/m²
  Rgb standard_error;  // of it; 0 with fewer than 8 paths
};

// E = 1/N Σ_i Σ_(b <= bounces) albedo(y_i1) … albedo(y_ib) E_direct(y_ib), y_ib the b-th vertex of
// the i-th path, each by a cosine-distributed direction about the shading normal of the one before;
// E_direct with one shadow ray per light. Unbiased. Owen-scrambled Sobol' points, another set for
// each bounce in another order: dimensions 0, 1 choose the direction, 2, 3 the point on the light.
// The standard error comes from eight consecutive runs of N/8 paths, whose own errors are larger
// than their share of the whole sequence's: it errs on the high side. `needless`: NeedlessLight,
// `keep_black`: also hits on what reflects nothing ask for light; the same bits.
TracedIrradiance TraceIndirect(const RayAccel& accel, const LightSampler& lights,
                               const Receiver& receiver, uint32_t paths, uint32_t bounces,
                               uint64_t key, LightCounters& counters, uint64_t& rays,
                               unsigned needless = 0, bool keep_black = false);

}  // namespace farpoint

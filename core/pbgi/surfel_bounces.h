// Further bounces of indirect light: surfels gather from surfels before the final gather reads
// them.
//
// The links between surfels are traced once: K = 8 cosine-distributed rays from each visible side
// of each surfel, each to the surfel nearest to what it hits. Then a bounce is one product of that
// sparse matrix with the radiance [W/(m² sr)] of the bounce before,
//   L_1 = ρ/π E_direct,   E_b = π / K Σ L_b(link) [W/m²],   L_(b+1) = L_1 + ρ/π E_b,
// without a ray. Surfels share their gathers like receivers do (paper, section 3): E_b is the mean
// over the surfel's neighbours on the same plane, those within 2.5 spacings of the 48 sides before
// it and after it in the order of the tree, about a hundred rays in all. What is left of their
// noise the final gather averages over the surfels that it sees.
#pragma once

#include "core/accel/ray_accel.h"
#include "core/base/executor.h"
#include "core/base/stats.h"
#include "core/light/light_sampler.h"
#include "core/pbgi/point_tree.h"
#include "core/pbgi/surfel.h"

namespace farpoint {

struct BounceOptions {
  uint32_t bounces = 2;  // of the image: the final gather is the last; >= 1
  uint64_t seed = 0;
  // A bounce that changes what all surfels reflect by less than this share is the last.
  double least_change = 1e-3;
};

// Adds what arrives after further bounces to `shading` (its radiance, and `indirect_…`, the
// irradiance of it), which ShadeSurfels made for this cloud; `topology` is that of its tree. Each
// surfel's share is a function of scene, cloud and seed: any number of threads gives the same.
// Adds the counts "bounces" (the final gather among them), "bounce_rays" and "bounce_links" to
// `stats`, and skipped "bounces" where they changed too little.
// Errors: those of PointTree::FromBlobs, never with what BuildTopology made.
absl::Status AddBounces(const SurfelCloud& cloud, const SurfelSides& open_sides,
                        const PointTree::Topology& topology, const RayAccel& accel,
                        const LightSampler& lights, const BounceOptions& options,
                        Executor& executor, SurfelShading& shading, Stats& stats);

}  // namespace farpoint

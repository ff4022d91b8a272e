// The layer ambient_occlusion: A = 1/π ∫ V cosθ dω over the hemisphere about the shading normal,
// V(ω) = 1 where the surface lets a ray leave and it hits nothing nearer than the distance D of the
// settings, else 0. Hits at D and beyond hide nothing; there is no fall-off before it. So A does
// not depend on light or materials, D = ∞ is a uniform sky's light over what it would be without
// shadows, and A grows as D falls.
#pragma once

#include <cstdint>

#include "core/accel/ray_accel.h"
#include "core/pbgi/receiver_cluster.h"
#include "core/render/settings.h"
#include "core/scene/prepared_scene.h"

namespace farpoint {

// Of the diagonal of the scene's bounding box, where the settings name no distance.
inline constexpr float kAoPartOfScene = 0.1f;

// D in metres: what the settings say; if that is 0, kAoPartOfScene of the diagonal, rounded down to
// a quarter of an octave, so that most frames of a sequence have the same. > 0, or +inf.
float AoDistance(const RenderSettings& settings, const PreparedScene& scene);

// x > 0 or 0, rounded down to a quarter of an octave.
float RoundToQuarterOctave(double x);

// The literal one: the mean of V along `paths` cosine-distributed directions, Owen-scrambled Sobol'
// points; watertight rays, their number is added to `rays`. In [0, 1].
float TraceAmbientOcclusion(const RayAccel& accel, const Receiver& receiver, float distance_m,
                            uint32_t paths, uint64_t key, uint64_t& rays);

}  // namespace farpoint

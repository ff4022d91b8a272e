#include "core/render/ambient_occlusion.h"

#include <algorithm>
#include <cmath>
#include <limits>

#include "core/math/sampling.h"

namespace farpoint {

namespace {

enum : uint64_t { kKeyDirections = 51 };

}  // namespace

float RoundToQuarterOctave(double x) {
  if (!(x > 0)) return 0;
  int octave;
  const double mantissa = std::frexp(x, &octave);  // in [1/2, 1)
  double rounded = 0.5;
  for (const double step : {0.5946035575013605, 0.7071067811865476, 0.8408964152537145}) {
    if (mantissa >= step) rounded = step;
  }
  return static_cast<float>(std::ldexp(rounded, octave));
}

float AoDistance(const RenderSettings& settings, const PreparedScene& scene) {
  if (settings.ao_distance_m != 0.0f) return settings.ao_distance_m;
  const float part = RoundToQuarterOctave(static_cast<double>(kAoPartOfScene * scene.diagonal_m()));
  // A scene of one point has no size, and nothing that hides.
  return part > 0.0f ? part : std::numeric_limits<float>::infinity();
}

float TraceAmbientOcclusion(const RayAccel& accel, const Receiver& receiver, float distance_m,
                            uint32_t paths, uint64_t key, uint64_t& rays) {
  const Frame frame(receiver.normal);
  const Vec3f origin = receiver.Leave();
  const auto seed = static_cast<uint32_t>(HashKey(key, kKeyDirections));
  uint32_t open = 0;
  for (uint32_t i = 0; i < paths; ++i) {
    const Vec3f w = frame.ToWorld(CosineHemisphere(OwenSobol(i, 0, seed), OwenSobol(i, 1, seed)));
    // Directions that the shading normal allows and the surface does not.
    if (!(Dot(w, receiver.geometric_normal) > 0.0f)) continue;
    ++rays;
    open += !accel.Occluded(origin, w, distance_m);
  }
  return static_cast<float>(open) / static_cast<float>(paths);
}

}  // namespace farpoint

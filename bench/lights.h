// Time and error of direct light against the number and kind of lights: docs/lights.md.
#pragma once

#include <cstdint>
#include <functional>
#include <string>
#include <string_view>
#include <vector>

#include "core/base/status.h"

namespace farpoint {

struct LightsOptions {
  uint32_t light_samples = 32;
  uint32_t receivers = 1000;
  uint32_t reference_samples = 1u << 14;  // of emitters and maps; punctual lights are summed
  uint64_t seed = 0;
  bool quick = false;  // few receivers, up to 100 lights, short references
};

struct LightsCase {
  std::string kind;            // "points", "spots", "emitters", "box", "furnace", "map", "sun map"
  uint64_t lights = 0;         // emitters: triangles; maps: texels
  double prepare_s = 0;        // building trees and tables
  double us_per_receiver = 0;  // one thread, shadow rays included
  double rays_per_receiver = 0;
  double rr = 0;    // RMSE of the irradiance over its mean, at light_samples
  double bias = 0;  // mean error over the mean
};

struct LightsReport {
  LightsOptions options;
  std::vector<LightsCase> cases;
};

// One thread. The scenes are fixed: a floor of 20 m with walls under lights that differ in power by
// up to 2^6, a closed box with a lamp, a furnace.
absl::StatusOr<LightsReport> RunLights(const LightsOptions& options,
                                       const std::function<void(std::string_view)>& log);

std::string LightsJson(const LightsReport& report);
std::string LightsTable(const LightsReport& report);

}  // namespace farpoint

// The layers that a render can have: their names, channels, storage and meaning.
#pragma once

#include <array>
#include <cstdint>
#include <span>
#include <string>
#include <string_view>
#include <vector>

#include "core/base/status.h"

namespace farpoint {

enum class Layer : uint32_t {
  kBeauty,            // R,G,B,A: direct + indirect + emission; A is the covered part of the pixel
  kDirect,            // radiance from reflected direct light
  kIndirect,          // radiance from reflected indirect light
  kEmission,          // emitted radiance; the background's too
  kAlbedo,            // Lambert reflectance; of what is glossy its mean over all directions
  kNormal,            // N.X N.Y N.Z: shading normal, world, unit, towards the viewer; 0: background
  kPosition,          // P.X P.Y P.Z: world, metres; 0: background
  kDepth,             // Z: distance along the camera's axis, metres; +inf: background
  kIrradiance,        // indirect irradiance E before the albedo, W/m²
  kDirectIrradiance,  // direct irradiance E, W/m²
  kStdError,          // standard error of kIrradiance (pt only)
  kCluster,  // index of the receiver's cluster within its block, averaged over samples; -1: none
  kCutSize,  // nodes in the receiver's own cut, mean over samples
  kDiffuseIndirect,  // the part of kIndirect that the diffuse base reflects; all of it on Lambert
  kGlossyIndirect,   // the rest: what interfaces of dielectrics and metals reflect
  // 1/π ∫ V cosθ dω: the part of what a receiver could see from which light of further away than
  // the settings' distance reaches it; 1: all. Mean over the samples that hit; 0: background.
  kAmbientOcclusion,
};
inline constexpr int kLayerCount = 16;

struct LayerInfo {
  Layer layer;
  std::string_view name;                       // as in --aov and in the EXR: "name.R"
  std::span<const std::string_view> channels;  // full EXR channel names, in fixed order
  bool half;                                   // stored as binary16, else as binary32
  bool on_by_default;
};

// All layers in the fixed order in which they are stored and hashed.
std::span<const LayerInfo> AllLayers();
const LayerInfo& InfoOf(Layer layer);
// kInvalidArgument lists the known names and the nearest one.
absl::StatusOr<Layer> LayerFromName(std::string_view name);
// The layers on by default.
std::vector<Layer> DefaultLayers();

}  // namespace farpoint

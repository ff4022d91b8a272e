#include "core/image/layers.h"

#include <algorithm>

#include "core/base/check.h"

namespace farpoint {

namespace {

using Names = std::string_view;
constexpr std::array<Names, 4> kBeautyChannels = {"R", "G", "B", "A"};
constexpr std::array<Names, 3> kDirectChannels = {"direct.R", "direct.G", "direct.B"};
constexpr std::array<Names, 3> kIndirectChannels = {"indirect.R", "indirect.G", "indirect.B"};
constexpr std::array<Names, 3> kEmissionChannels = {"emission.R", "emission.G", "emission.B"};
constexpr std::array<Names, 3> kAlbedoChannels = {"albedo.R", "albedo.G", "albedo.B"};
constexpr std::array<Names, 3> kNormalChannels = {"N.X", "N.Y", "N.Z"};
constexpr std::array<Names, 3> kPositionChannels = {"P.X", "P.Y", "P.Z"};
constexpr std::array<Names, 1> kDepthChannels = {"Z"};
constexpr std::array<Names, 3> kIrradianceChannels = {"irradiance.R", "irradiance.G",
                                                      "irradiance.B"};
constexpr std::array<Names, 3> kDirectIrradianceChannels = {
    "direct_irradiance.R", "direct_irradiance.G", "direct_irradiance.B"};
constexpr std::array<Names, 3> kStdErrorChannels = {"stderr.R", "stderr.G", "stderr.B"};
constexpr std::array<Names, 1> kClusterChannels = {"cluster.Y"};
constexpr std::array<Names, 1> kCutSizeChannels = {"cutsize.Y"};
constexpr std::array<Names, 3> kDiffuseIndirectChannels = {
    "diffuse_indirect.R", "diffuse_indirect.G", "diffuse_indirect.B"};
constexpr std::array<Names, 3> kGlossyIndirectChannels = {"glossy_indirect.R", "glossy_indirect.G",
                                                          "glossy_indirect.B"};

constexpr std::array<Names, 1> kAmbientOcclusionChannels = {"ambient_occlusion.Y"};

// What is looked at is stored in half; what is measured or indexed, in float.
constexpr std::array<LayerInfo, kLayerCount> kLayers = {{
    {Layer::kBeauty, "beauty", kBeautyChannels, true, true},
    {Layer::kDirect, "direct", kDirectChannels, true, true},
    {Layer::kIndirect, "indirect", kIndirectChannels, true, true},
    {Layer::kEmission, "emission", kEmissionChannels, true, true},
    {Layer::kAlbedo, "albedo", kAlbedoChannels, true, true},
    {Layer::kNormal, "N", kNormalChannels, true, true},
    {Layer::kPosition, "P", kPositionChannels, false, true},
    {Layer::kDepth, "Z", kDepthChannels, false, true},
    {Layer::kIrradiance, "irradiance", kIrradianceChannels, false, false},
    {Layer::kDirectIrradiance, "direct_irradiance", kDirectIrradianceChannels, false, false},
    {Layer::kStdError, "stderr", kStdErrorChannels, false, false},
    {Layer::kCluster, "cluster", kClusterChannels, false, false},
    {Layer::kCutSize, "cutsize", kCutSizeChannels, false, false},
    {Layer::kDiffuseIndirect, "diffuse_indirect", kDiffuseIndirectChannels, true, false},
    {Layer::kGlossyIndirect, "glossy_indirect", kGlossyIndirectChannels, true, false},
    {Layer::kAmbientOcclusion, "ambient_occlusion", kAmbientOcclusionChannels, true, false},
}};

// Levenshtein distance.
size_t EditDistance(std::string_view a, std::string_view b) {
  std::vector<size_t> row(b.size() + 1);
  for (size_t j = 0; j <= b.size(); ++j) row[j] = j;
  for (size_t i = 1; i <= a.size(); ++i) {
    size_t diagonal = row[0];
    row[0] = i;
    for (size_t j = 1; j <= b.size(); ++j) {
      const size_t substituted = diagonal + (a[i - 1] == b[j - 1] ? 0 : 1);
      diagonal = row[j];
      row[j] = std::min({row[j] + 1, row[j - 1] + 1, substituted});
    }
  }
  return row[b.size()];
}

}  // namespace

std::span<const LayerInfo> AllLayers() { return kLayers; }

const LayerInfo& InfoOf(Layer layer) {
  const size_t index = static_cast<size_t>(layer);
  FP_CHECK(index < kLayers.size());
  return kLayers[index];
}

absl::StatusOr<Layer> LayerFromName(std::string_view name) {
  std::string known;
  std::string_view nearest;
  size_t nearest_distance = SIZE_MAX;
  // Longer input is no typing error; the distance's cost must not grow with it.
  const std::string_view compared = name.substr(0, 64);
  for (const LayerInfo& info : kLayers) {
    if (info.name == name) return info.layer;
    const size_t distance = EditDistance(compared, info.name);
    if (distance < nearest_distance) {
      nearest_distance = distance;
      nearest = info.name;
    }
    known += known.empty() ? "" : ", ";
    known += info.name;
  }
  return absl::InvalidArgumentError("unknown layer '" + std::string(compared) +
                                    "'; did you mean '" + std::string(nearest) +
                                    "'? The layers are " + known);
}

std::vector<Layer> DefaultLayers() {
  std::vector<Layer> layers;
  for (const LayerInfo& info : kLayers) {
    if (info.on_by_default) layers.push_back(info.layer);
  }
  return layers;
}

}  // namespace farpoint

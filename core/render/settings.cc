#include "core/render/settings.h"

#include <array>
#include <cmath>

#include "core/image/tile_rect.h"
#include "core/light/light_sampler.h"

namespace farpoint {

namespace {

constexpr uint32_t kDefaultMicrobuffer = 32;
constexpr uint32_t kDefaultDegradedMicrobuffer = 16;

constexpr std::array<std::string_view, 5> kIntegratorNames = {"fpbgi", "pbgi", "dpbgi", "pt",
                                                              "irrcache"};

constexpr std::array<std::string_view, 4> kFilterNames = {"box", "triangle", "gaussian",
                                                          "blackman-harris"};
constexpr std::array<std::string_view, 3> kFillNames = {"auto", "rays", "cut"};
constexpr std::array<std::string_view, 2> kMaterialsNames = {"lambert", "gltf"};
constexpr std::array<std::string_view, 3> kQualityNames = {"draft", "normal", "fine"};
// Of irrcache, by quality: docs/decisions/0016-irradiance-cache.md has the figures.
constexpr std::array<float, 3> kCacheErrors = {0.3f, 0.2f, 0.1f};
constexpr std::array<uint32_t, 3> kCacheSamples = {512, 1024, 2048};
constexpr std::array<float, 4> kFilterWidths = {1.0f, 2.0f, 3.0f, 3.0f};

template <typename T>
absl::Status CheckRange(std::string_view name, T value, T low, T high) {
  if (value >= low && value <= high) return absl::OkStatus();
  return absl::InvalidArgumentError(std::string(name) + " is " + std::to_string(value) +
                                    "; allowed is " + std::to_string(low) + " to " +
                                    std::to_string(high));
}

}  // namespace

uint32_t RenderSettings::microbuffer_px() const {
  if (microbuffer != 0) return microbuffer;
  return integrator == Integrator::kDpbgi ? kDefaultDegradedMicrobuffer : kDefaultMicrobuffer;
}

Fill RenderSettings::fill_in_force() const {
  if (integrator == Integrator::kIrrcache) return Fill::kRays;
  if (fill != Fill::kAuto) return fill;
  return adaptive() ? Fill::kRays : Fill::kCut;
}

float RenderSettings::cache_error_in_force() const {
  return cache_error != 0.0f ? cache_error : kCacheErrors[static_cast<size_t>(quality)];
}

uint32_t RenderSettings::cache_samples_in_force() const {
  return cache_samples != 0 ? cache_samples : kCacheSamples[static_cast<size_t>(quality)];
}

float RenderSettings::filter_width() const {
  return filter_width_px != 0.0f ? filter_width_px : kFilterWidths[static_cast<size_t>(filter)];
}

unsigned NeedlessLightOf(const RenderSettings& settings) {
  return (settings.skips(kSkipShadowRays) ? 0u : kNeedlessRays) |
         (settings.skips(kSkipEnvironment) ? 0u : kNeedlessEnvironment);
}

absl::Status ValidateSettings(const RenderSettings& s) {
  if (static_cast<uint32_t>(s.integrator) >= kIntegratorNames.size()) {
    return absl::InvalidArgumentError(
        "integrator: unknown value; use fpbgi, pbgi, dpbgi, pt or irrcache");
  }
  FP_RETURN_IF_ERROR(CheckRange<uint32_t>("spp", s.spp, 1, 256));
  if (static_cast<uint32_t>(s.filter) >= kFilterNames.size()) {
    return absl::InvalidArgumentError(
        "filter: unknown value; use box, triangle, gaussian or blackman-harris");
  }
  if (s.filter_width_px != 0.0f && !(s.filter_width_px >= 0.01f && s.filter_width_px <= 16.0f)) {
    return absl::InvalidArgumentError("filter-width must be between 0.01 and 16 pixels");
  }
  FP_RETURN_IF_ERROR(CheckRange<uint32_t>("paths", s.paths, 1, 1u << 20));
  FP_RETURN_IF_ERROR(CheckRange<uint32_t>("bounces", s.bounces, 1, kMostBounces));
  if (s.bounces > 1 && s.integrator == Integrator::kIrrcache) {
    return absl::InvalidArgumentError(
        "irrcache gathers one bounce; leave bounces at 1, or use fpbgi, pbgi, dpbgi or pt");
  }
  FP_RETURN_IF_ERROR(CheckRange<uint32_t>("light-samples", s.light_samples, 1, 4096));
  FP_RETURN_IF_ERROR(CheckRange<uint64_t>("points", s.points, 0, uint64_t{1} << 31));
  FP_RETURN_IF_ERROR(CheckRange<uint32_t>("microbuffer", s.microbuffer, 0, 256));
  FP_RETURN_IF_ERROR(CheckRange<uint32_t>("clusters", s.clusters, 0, 1024));
  FP_RETURN_IF_ERROR(CheckRange<uint32_t>("kmeans-iterations", s.kmeans_iterations, 0, 100));
  if (!(s.epsilon >= 0.0f) || !std::isfinite(s.epsilon)) {
    return absl::InvalidArgumentError("epsilon must be a finite number of at least 0");
  }
  if (!(s.normal_weight >= 0.0f) || !std::isfinite(s.normal_weight)) {
    return absl::InvalidArgumentError("normal-weight must be a finite number of at least 0");
  }
  if (s.buffer_map != BufferMap::kOctahedral && s.buffer_map != BufferMap::kCosine) {
    return absl::InvalidArgumentError("buffer-map: unknown value; use octahedral or cosine");
  }
  if (s.splat != Splat::kCoverage && s.splat != Splat::kOpaque) {
    return absl::InvalidArgumentError("splat: unknown value; use coverage or opaque");
  }
  if (s.integrator == Integrator::kFpbgi && s.clusters != 0 && s.buffer_map == BufferMap::kCosine) {
    return absl::InvalidArgumentError(
        "buffer-map cosine is the hemisphere of one receiver and cannot be shared by one of k "
        "clusters; use octahedral, adaptive clusters, or pbgi");
  }
  if (static_cast<uint32_t>(s.fill) >= kFillNames.size()) {
    return absl::InvalidArgumentError("fill: unknown value; use auto, rays or cut");
  }
  if (static_cast<uint32_t>(s.quality) >= kQualityNames.size()) {
    return absl::InvalidArgumentError("quality: unknown value; use draft, normal or fine");
  }
  if (static_cast<uint32_t>(s.materials) >= kMaterialsNames.size()) {
    return absl::InvalidArgumentError("materials: unknown value; use lambert or gltf");
  }
  if (s.cache_error != 0.0f && !(s.cache_error >= 0.01f && s.cache_error <= 10.0f)) {
    return absl::InvalidArgumentError("cache-error must be 0 or between 0.01 and 10");
  }
  if (s.cache_samples != 0) {
    FP_RETURN_IF_ERROR(CheckRange<uint32_t>("cache-samples", s.cache_samples, 4, 1u << 20));
  }
  if (!(s.ao_distance_m >= 0.0f)) {
    return absl::InvalidArgumentError(
        "ao-distance must be 0 or a positive number of metres, inf included");
  }
  if (s.tile_px == 0 || s.tile_px % kBlockSize != 0 || s.tile_px > 65536) {
    return absl::InvalidArgumentError("tile is " + std::to_string(s.tile_px) +
                                      "; it must be a multiple of " + std::to_string(kBlockSize) +
                                      " up to 65536");
  }
  if (s.layers.empty()) return absl::InvalidArgumentError("aov: no layer is asked for");
  for (const Layer layer : s.layers) {
    if (static_cast<uint32_t>(layer) >= kLayerCount) {
      return absl::InvalidArgumentError("aov: unknown layer");
    }
    if (layer == Layer::kStdError && s.integrator != Integrator::kPt) {
      return absl::InvalidArgumentError("layer '" + std::string(InfoOf(layer).name) +
                                        "' is the path tracer's; use --integrator pt with it");
    }
    if (layer == Layer::kCluster && s.integrator != Integrator::kFpbgi) {
      return absl::InvalidArgumentError("layer 'cluster' needs --integrator fpbgi");
    }
    if (layer == Layer::kAmbientOcclusion && s.integrator != Integrator::kPt &&
        (s.integrator == Integrator::kPbgi || s.integrator == Integrator::kDpbgi ||
         s.fill_in_force() == Fill::kCut)) {
      return absl::InvalidArgumentError(
          "layer 'ambient_occlusion' needs buffers that rays fill, since discs hide what touches "
          "them; use fpbgi with adaptive clusters or --fill rays, irrcache, or pt");
    }
    if (layer == Layer::kCutSize && !s.point_based()) {
      return absl::InvalidArgumentError("layer 'cutsize' needs a point-based integrator, not " +
                                        std::string(NameOf(s.integrator)));
    }
  }
  return absl::OkStatus();
}

void ApplyPaperPreset(RenderSettings& s) {
  s.buffer_map = BufferMap::kOctahedral;
  s.splat = Splat::kOpaque;
  s.clusters = 100;
  s.fill = Fill::kCut;
  s.epsilon = 0.1f;
  s.normal_weight = 1.0f;
  s.kmeans_iterations = 5;
  // Of the whole sphere: above a horizon as many pixels as a hemisphere of 45x45 has.
  s.microbuffer = 64;
}

absl::StatusOr<Integrator> IntegratorFromName(std::string_view name) {
  for (size_t i = 0; i < kIntegratorNames.size(); ++i) {
    if (kIntegratorNames[i] == name) return static_cast<Integrator>(i);
  }
  return absl::InvalidArgumentError("unknown integrator '" + std::string(name) +
                                    "'; use fpbgi, pbgi, dpbgi, pt or irrcache");
}

std::string_view NameOf(Integrator integrator) {
  return kIntegratorNames[static_cast<size_t>(integrator)];
}

absl::StatusOr<PixelFilter> PixelFilterFromName(std::string_view name) {
  for (size_t i = 0; i < kFilterNames.size(); ++i) {
    if (kFilterNames[i] == name) return static_cast<PixelFilter>(i);
  }
  return absl::InvalidArgumentError("unknown filter '" + std::string(name) +
                                    "'; use box, triangle, gaussian or blackman-harris");
}

std::string_view NameOf(PixelFilter filter) { return kFilterNames[static_cast<size_t>(filter)]; }

absl::StatusOr<Fill> FillFromName(std::string_view name) {
  for (size_t i = 0; i < kFillNames.size(); ++i) {
    if (kFillNames[i] == name) return static_cast<Fill>(i);
  }
  return absl::InvalidArgumentError("unknown fill '" + std::string(name) +
                                    "'; use auto, rays or cut");
}

std::string_view NameOf(Fill fill) { return kFillNames[static_cast<size_t>(fill)]; }

absl::StatusOr<Quality> QualityFromName(std::string_view name) {
  for (size_t i = 0; i < kQualityNames.size(); ++i) {
    if (kQualityNames[i] == name) return static_cast<Quality>(i);
  }
  return absl::InvalidArgumentError("unknown quality '" + std::string(name) +
                                    "'; use draft, normal or fine");
}

std::string_view NameOf(Quality quality) { return kQualityNames[static_cast<size_t>(quality)]; }

absl::StatusOr<Materials> MaterialsFromName(std::string_view name) {
  for (size_t i = 0; i < kMaterialsNames.size(); ++i) {
    if (kMaterialsNames[i] == name) return static_cast<Materials>(i);
  }
  return absl::InvalidArgumentError("unknown materials '" + std::string(name) +
                                    "'; use lambert or gltf");
}

std::string_view NameOf(Materials materials) {
  return kMaterialsNames[static_cast<size_t>(materials)];
}

}  // namespace farpoint

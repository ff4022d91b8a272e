// Parameters of a render. What changes the image stands apart from what changes only the speed.
#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include "core/base/status.h"
#include "core/image/layers.h"
#include "core/pbgi/gather_params.h"

namespace farpoint {

enum class Integrator : uint32_t {
  kFpbgi,  // factorized point-based GI [Wang et al. 2013]
  kPbgi,   // point-based GI [Christensen 2008]: every receiver alone, from the root
  kDpbgi,  // pbgi with a smaller microbuffer ("degraded", paper §4)
  kPt,     // path tracing over the triangles: the ground truth
  // The irradiance cache with gradients [WRC88, WH92], to compare with: every process that renders
  // a tile makes the cache of the whole frame (core/irrcache/irradiance_cache.h).
  kIrrcache,
};

// How the samples of a pixel are weighted. They are drawn from the filter's density about the
// pixel's centre and counted alike ("filter importance sampling", Ernst et al. 2006), so a sample
// belongs to one pixel and a tile needs nothing of its neighbours.
enum class PixelFilter : uint32_t { kBox, kTriangle, kGaussian, kBlackmanHarris };

// What fills the buffer that a cluster shares.
enum class Fill : uint32_t {
  kAuto,  // rays for adaptive clusters, cuts for k per block: the best of each
  kRays,  // rays, which bring back the radiance of the nearest surfel
  kCut,   // a cut of the point tree, rasterized (the paper)
};
// The error that adaptive clusters aim at: how many, and how finely sampled.
enum class Quality : uint32_t { kDraft, kNormal, kFine };

// What surfaces are made of.
enum class Materials : uint32_t {
  kLambert,  // all Lambert, with the base colour
  kGltf,     // glTF's metallic-roughness model, with normal maps (core/math/microfacet.h)
};

// What a frame computes only if the scene needs it (docs/skipping.md). Values of a mask.
enum SkipMask : uint32_t {
  kSkipBlack = 1u << 0,          // receivers, surfels and hits that reflect nothing
  kSkipUnlit = 1u << 1,          // surfels and gathers of a scene without light
  kSkipIdleBlocks = 1u << 2,     // records where no receiver of a block gathers
  kSkipBelowHorizon = 1u << 3,   // nodes below the horizons of all receivers; changes bits
  kSkipInvisibleSide = 1u << 4,  // nodes of which only sides inside closed objects are seen
  kSkipHidden = 1u << 5,         // nodes behind a filled part of the buffer
  kSkipShadowRays = 1u << 6,     // of lights that cannot reach
  kSkipEnvironment = 1u << 7,    // of a scene that has none
  kSkipTextures = 1u << 8,       // that no surface shows
  kSkipBakeStages = 1u << 9,     // whose product an earlier bake left
};

inline constexpr uint32_t kMostBounces = 64;

struct RenderSettings {
  // --- Changes the image ---
  Integrator integrator = Integrator::kFpbgi;
  uint32_t spp = 1;  // receivers per pixel, 1..256; 1: the pixel's centre
  PixelFilter filter = PixelFilter::kBlackmanHarris;  // of no effect at spp 1
  float filter_width_px = 0;  // of its whole support, 0.01..16; 0: the filter's default
  uint32_t paths = 64;        // pt: paths per receiver, 1..2^20
  Materials materials = Materials::kLambert;
  uint32_t bounces = 1;         // of indirect light, 1..kMostBounces; irrcache knows one
  uint32_t light_samples = 32;  // shadow rays per receiver, see docs/lights.md, 1..4096
  uint64_t points = 0;          // surfels, 1..2^31; 0: from the scene's area and size
  uint32_t microbuffer = 0;     // side of the buffer in pixels, 1..256; 0: the map's default
  BufferMap buffer_map = BufferMap::kOctahedral;
  Splat splat = Splat::kCoverage;
  uint32_t clusters = 0;               // fpbgi: k per block, 1..1024; 0: adaptive, see Quality
  Fill fill = Fill::kAuto;             // fpbgi: what fills a cluster's buffer
  Quality quality = Quality::kNormal;  // fpbgi with adaptive clusters; irrcache
  float cache_error = 0.0f;            // irrcache: a of WRC88, 0.01..10; 0: by quality
  uint32_t cache_samples = 0;          // irrcache: rays of a record, 4..2^20; 0: by quality
  float epsilon = 0.2f;                // far: R_cluster < epsilon (d - r); >= 0
  float normal_weight = 1.0f;          // alpha / squared block diagonal (paper §3.1)
  uint32_t kmeans_iterations = 5;      // 0..100
  // Of the layer ambient_occlusion: what lies at least so far away hides nothing, metres, > 0,
  // +inf: all hides; 0: by the scene's size (core/render/ambient_occlusion.h).
  float ao_distance_m = 0.0f;
  uint64_t seed = 0;
  std::vector<Layer> layers = DefaultLayers();

  // --- Changes only the speed ---
  uint32_t tile_px = 128;  // a multiple of 32
  bool no_skip = false;    // compute also what the scene does not need
  uint32_t computed = 0;   // SkipMask: the same for single items, to measure them; not on the wire

  // The value in force where 0 means "default".
  uint32_t microbuffer_px() const;
  // Whether the integrator gathers from surfels and their tree; the others need none.
  bool point_based() const {
    return integrator != Integrator::kPt && integrator != Integrator::kIrrcache;
  }
  float cache_error_in_force() const;
  uint32_t cache_samples_in_force() const;
  bool adaptive() const { return integrator == Integrator::kFpbgi && clusters == 0; }
  Fill fill_in_force() const;
  // Whether surfels are read where rays end, and not seen as discs.
  bool reads_surfels_by_rays() const { return adaptive() && fill_in_force() == Fill::kRays; }
  float filter_width() const;  // pixels
  bool skips(SkipMask item) const { return !no_skip && (computed & item) == 0; }
};

// For LightSampler: NeedlessLight of what the settings do not skip.
unsigned NeedlessLightOf(const RenderSettings& settings);

// kInvalidArgument names the setting, its value and what is allowed.
absl::Status ValidateSettings(const RenderSettings& settings);

// Every parameter as in the paper: 32x32 blocks, k = 100, epsilon = 0.1, opaque splats,
// depth composite, 5 iterations, 64x64 buffers. What differs from the paper whatever the parameters
// stands in docs/paper-map.md.
void ApplyPaperPreset(RenderSettings& settings);

absl::StatusOr<Integrator> IntegratorFromName(std::string_view name);
std::string_view NameOf(Integrator integrator);

absl::StatusOr<PixelFilter> PixelFilterFromName(std::string_view name);
std::string_view NameOf(PixelFilter filter);

absl::StatusOr<Fill> FillFromName(std::string_view name);
std::string_view NameOf(Fill fill);
absl::StatusOr<Quality> QualityFromName(std::string_view name);
std::string_view NameOf(Quality quality);
absl::StatusOr<Materials> MaterialsFromName(std::string_view name);
std::string_view NameOf(Materials materials);

}  // namespace farpoint

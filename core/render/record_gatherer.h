// Fills the buffers of gather records: by rays, or by cuts of the point tree.
#pragma once

#include <memory>
#include <mutex>

#include "core/base/executor.h"
#include "core/base/stats.h"
#include "core/pbgi/microbuffer_map.h"
#include "core/pbgi/receiver_hierarchy.h"
#include "core/pbgi/tree_cut.h"
#include "core/render/camera_rays.h"
#include "core/render/loaded_scene.h"
#include "core/render/settings.h"

namespace farpoint {

// By rays: one through each stratum of the hemisphere; what it brings back is the radiance of the
// nearest surfel, or, near the receiver, where a surfel's size would show, that of the point itself
// (one shadow ray per light). The irradiance cache shades every point, as `pt` does. By cuts: the
// receiver's own cut from the root (§1.1), rasterized into its microbuffer, whose pixels then stand
// for the strata.
class RecordGatherer final : public PlaceSource {
 public:
  // All must outlive the gatherer. `settings.fill` decides the way. `sees_sky`: records by rays
  // tell their openness. `ao_distance_m` > 0: and what is unhidden within that distance. `shades`
  // false: they bring no light, and their openness is what is unhidden, so that records are placed
  // and refined for its sake.
  RecordGatherer(const LoadedSceneData& scene, const CameraRays& rays,
                 const RenderSettings& settings, const MicrobufferMap& map,
                 const CutParams& cut_params, bool sees_sky = false, float ao_distance_m = 0,
                 bool shades = true);

  // What a few hundred receivers of `frame` see, which are gathered here.
  struct Means {
    float irradiance = 0;  // of the three channels, W/m²
    float openness = 0;    // see GatherRecord
  };
  // Rounded to quarters of an octave, so that they are the same in most frames of a sequence.
  Means MeanOf(const PixelRect& frame, Executor& executor) const;
  // From now on strata are refined down to these standard deviations; 0: not for its sake. And
  // cuts leave out what is hidden only if that was worth its while so far. Records of fewer than
  // `strata` strata are refined in proportion less. Not to be called while others gather.
  void Refine(const Means& deviation, uint32_t strata = 0);

  bool ReceiverAt(int x, int y, Receiver& receiver, float& footprint_m) const override;
  bool ReceiverAlong(const CellProbe& probe, ReceiverPlace& place) const override;
  GatherRecord Gather(const Receiver& receiver, const HemisphereGrid& grid,
                      uint64_t key) const override;

  // Seconds of the stages trace, cut and raster, and counts, since the last call.
  Stats TakeStats() const;

 private:
  GatherRecord GatherByRays(const Receiver& receiver, const HemisphereGrid& grid,
                            uint64_t key) const;
  GatherRecord GatherByCut(const Receiver& receiver, const HemisphereGrid& grid) const;

  const LoadedSceneData& scene_;
  const CameraRays& rays_;
  const RenderSettings& settings_;
  const MicrobufferMap& map_;
  const CutParams& cut_params_;
  const bool sees_sky_;
  const float ao_distance_m_;  // 0: nobody asks
  const bool shades_;
  const SurfelAtlas* atlas_ = nullptr;     // null: shade every hit
  const SurfelAtlas* indirect_ = nullptr;  // what shaded hits get by further bounces; null: one
  Means least_share_;                      // of standard deviation, for a ray more; 0: none
  uint32_t strata_ = 0;                    // from which that holds
  bool hide_ = true;                       // leave out of cuts what is hidden
  float near_m_ = 0;                       // hits nearer than this are shaded afresh
  mutable std::mutex mutex_;
  mutable Stats stats_;
};

// The receiver of a hit by a ray of direction `w`, turned towards where the ray came from.
Receiver ReceiverOfHit(const RayAccel& accel, const RayHit& hit, const Vec3f& w);

}  // namespace farpoint

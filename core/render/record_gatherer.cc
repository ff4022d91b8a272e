#include "core/render/record_gatherer.h"

#include <algorithm>
#include <cmath>

#include "core/base/clock.h"
#include "core/math/sampling.h"
#include "core/pbgi/microbuffer.h"

namespace farpoint {

namespace {

// Below this many surfel spacings from the receiver a hit is shaded afresh.
constexpr float kNearSpacings = 2.0f;
enum : uint64_t { kKeyDirections = 31, kKeyLight = 32 };

}  // namespace

Receiver ReceiverOfHit(const PreparedScene& scene, const RayHit& hit, const Vec3f& w) {
  Receiver r;
  r.position = scene.PointOn(hit.triangle, hit.b1, hit.b2);
  r.geometric_normal = scene.GeometricNormal(hit.triangle);
  r.normal = scene.ShadingNormal(hit.triangle, hit.b1, hit.b2);
  r.on_back = Dot(r.geometric_normal, w) > 0.0f;
  if (r.on_back) {
    r.geometric_normal = -r.geometric_normal;
    r.normal = -r.normal;
  }
  return r;
}

RecordGatherer::RecordGatherer(const LoadedSceneData& scene, const CameraRays& rays,
                               const RenderSettings& settings, const MicrobufferMap& map,
                               const CutParams& cut_params)
    : scene_(scene), rays_(rays), settings_(settings), map_(map), cut_params_(cut_params) {
  if (settings.point_based() && settings.fill_in_force() == Fill::kRays && scene.tree != nullptr &&
      !scene.tree->empty()) {
    atlas_ = &scene.Atlas();
    near_m_ = kNearSpacings * atlas_->spacing_m();
  }
}

bool RecordGatherer::ReceiverAt(int x, int y, Receiver& receiver, float& footprint_m) const {
  const Vec3f w = rays_.Direction(x + 0.5, y + 0.5);
  const std::optional<RayHit> hit = scene_.accel->Intersect(rays_.eye(), w);
  if (!hit) return false;
  receiver = ReceiverOfHit(*scene_.scene, *hit, w);
  footprint_m = rays_.FootprintAt(receiver.position);
  return true;
}

GatherRecord RecordGatherer::Gather(const Receiver& receiver, const HemisphereGrid& grid,
                                    uint64_t key) const {
  return settings_.fill_in_force() == Fill::kCut ? GatherByCut(receiver, grid)
                                                 : GatherByRays(receiver, grid, key);
}

GatherRecord RecordGatherer::GatherByRays(const Receiver& receiver, const HemisphereGrid& grid,
                                          uint64_t key) const {
  const double start = ThreadCpuSeconds();
  const PreparedScene& scene = *scene_.scene;
  const RayAccel& accel = *scene_.accel;
  const Frame frame(receiver.normal);
  const Vec3f origin = accel.LeaveSurface(receiver.position, receiver.geometric_normal);
  HemisphereSamples samples(grid);
  grid.Directions(HashKey(key, kKeyDirections), samples.direction(0), samples.direction(1),
                  samples.direction(2));
  LightCounters counters;
  uint64_t rays = 0, read = 0, shaded = 0;
  for (uint32_t ring = 0; ring < grid.rings(); ++ring) {
    for (uint32_t sector = 0; sector < grid.sectors(); ++sector) {
      const size_t at = size_t{ring} * grid.stride() + sector;
      const Vec3f w = frame.ToWorld(
          {samples.direction(0)[at], samples.direction(1)[at], samples.direction(2)[at]});
      // Directions that the shading normal allows and the surface does not carry nothing.
      if (!(Dot(w, receiver.geometric_normal) > 0.0f)) {
        samples.inverse_distance()[at] = -1;
        continue;
      }
      ++rays;
      const std::optional<RayHit> hit = accel.Intersect(origin, w);
      if (!hit) continue;
      // A hit at the origin itself has no distance: as near as the offset that the ray took.
      const float t = std::max(hit->t, accel.surface_offset_m());
      samples.inverse_distance()[at] = 1.0f / t;
      Vec3f ng = scene.GeometricNormal(hit->triangle);
      const bool front = !(Dot(ng, w) > 0.0f);
      if (!front) ng = -ng;
      std::optional<Rgb> radiance;
      if (atlas_ != nullptr && t > near_m_) {
        radiance = atlas_->Radiance(hit->triangle, hit->b1, hit->b2, front);
      }
      if (radiance) {
        ++read;
      } else {
        const SurfaceSample surface = scene.Surface(hit->triangle, hit->b1, hit->b2);
        if (!(MaxComponent(surface.albedo) > 0.0f)) continue;
        ++shaded;
        Vec3f ns = scene.ShadingNormal(hit->triangle, hit->b1, hit->b2);
        if (!front) ns = -ns;
        const Vec3f y = scene.PointOn(hit->triangle, hit->b1, hit->b2);
        const Rgb e = scene_.lights->Irradiance(y, ng, ns, 1, HashKey(key, kKeyLight),
                                                static_cast<uint32_t>(at), 2, counters);
        radiance = surface.albedo * e * kInvPif;
      }
      for (int c = 0; c < 3; ++c) samples.radiance(c)[at] = (*radiance)[c];
    }
  }
  const GatherRecord record = MakeGatherRecord(grid, samples, receiver.position, frame);
  const std::lock_guard lock(mutex_);
  stats_.seconds[static_cast<int>(Stage::kTrace)] += ThreadCpuSeconds() - start;
  stats_.counts["rays"] += rays + counters.rays;
  stats_.counts["hits_shaded"] += shaded;
  stats_.skipped["hits_read_from_surfels"] += read;
  stats_.skipped["shadow_rays"] += counters.skipped_facing_away;
  return record;
}

GatherRecord RecordGatherer::GatherByCut(const Receiver& receiver,
                                         const HemisphereGrid& grid) const {
  const double start = ThreadCpuSeconds();
  const PointTree& tree = *scene_.tree;
  CutView view;
  view.position = receiver.position;
  view.normal = receiver.normal;
  view.sees_inside = receiver.on_back;
  std::vector<CutNode> cut, scratch;
  CutCounters cut_counters;
  ComputeClusterCut(tree, view, cut_params_, cut, nullptr, cut_counters);
  const double after_cut = ThreadCpuSeconds();
  Microbuffer buffer(map_);
  RasterCounters raster_counters;
  SortFrontToBack(cut, scratch);
  RasterizeCut(tree, view, cut, settings_.splat, buffer, raster_counters);

  // The strata read the pixels that hold their centres.
  const Frame frame(receiver.normal);
  HemisphereSamples samples(grid);
  grid.Centres(samples.direction(0), samples.direction(1), samples.direction(2));
  const bool world = map_.kind() == BufferMap::kOctahedral;
  const int last = static_cast<int>(map_.side()) - 1;
  for (uint32_t ring = 0; ring < grid.rings(); ++ring) {
    for (uint32_t sector = 0; sector < grid.sectors(); ++sector) {
      const size_t at = size_t{ring} * grid.stride() + sector;
      const Vec3f local(samples.direction(0)[at], samples.direction(1)[at],
                        samples.direction(2)[at]);
      const Vec2f uv = map_.Project(world ? frame.ToWorld(local) : local);
      const int i = std::clamp(static_cast<int>(uv.x), 0, last);
      const int j = std::clamp(static_cast<int>(uv.y), 0, last);
      const size_t pixel = static_cast<size_t>(j) * map_.side() + static_cast<size_t>(i);
      const float coverage = buffer.coverage()[pixel];
      if (!(coverage > 0.0f)) continue;
      const float fill =
          settings_.splat == Splat::kCoverage && coverage > kFullFrom ? 1.0f / coverage : 1.0f;
      const float depth = buffer.depth()[pixel];
      samples.inverse_distance()[at] = depth > 0.0f ? 1.0f / depth : 0.0f;
      for (int c = 0; c < 3; ++c) samples.radiance(c)[at] = buffer.radiance(c)[pixel] * fill;
    }
  }
  GatherRecord record = MakeGatherRecord(grid, samples, receiver.position, frame);
  // The buffer's own quadrature is finer than that of the strata.
  record.irradiance = ConvolveCosine(buffer, nullptr, receiver.normal, settings_.splat);
  const double end = ThreadCpuSeconds();
  const std::lock_guard lock(mutex_);
  stats_.seconds[static_cast<int>(Stage::kCut)] += after_cut - start;
  stats_.seconds[static_cast<int>(Stage::kRaster)] += end - after_cut;
  stats_.counts["cut_nodes"] += cut.size();
  stats_.counts["node_visits"] += cut_counters.groups_visited * kLanes;
  stats_.counts["splats"] += raster_counters.splats;
  stats_.counts["exact_discs"] += raster_counters.exact_discs;
  stats_.skipped["nodes_below_horizon"] += cut_counters.below_horizon;
  stats_.skipped["nodes_invisible_side"] += cut_counters.invisible_side;
  stats_.skipped["pixels_hidden"] += raster_counters.hidden_pixels;
  return record;
}

Stats RecordGatherer::TakeStats() const {
  const std::lock_guard lock(mutex_);
  Stats out;
  std::swap(out, stats_);
  return out;
}

}  // namespace farpoint

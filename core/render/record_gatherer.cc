#include "core/render/record_gatherer.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <span>

#include "core/base/clock.h"
#include "core/math/sampling.h"
#include "core/pbgi/cut_drawer.h"
#include "core/pbgi/microbuffer.h"
#include "core/render/ambient_occlusion.h"
#include "core/render/hit_reader.h"

namespace farpoint {

namespace {

// Of a stratum, beyond its first. A multiple of eight.
constexpr uint32_t kMostExtraRays = 32;
// The receivers that say how bright a frame is: one for so many pixels, within bounds.
constexpr int kPixelsPerPilot = 256, kLeastPilots = 16, kMostPilots = 256;
constexpr uint32_t kPilotSamples = 128;
// Rays that bring more than so many times the mean of their record are traced again, watertight.
constexpr float kOdd = 16.0f;
enum : uint64_t { kKeyDirections = 31, kKeyLight = 32, kKeyPilot = 33, kKeyPilotGather = 34 };

float Grey(const Rgb& c) { return (c.x + c.y + c.z) * (1.0f / 3); }
float GreyAt(const HemisphereSamples& samples, size_t at) {
  return (samples.radiance(0)[at] + samples.radiance(1)[at] + samples.radiance(2)[at]) * (1.0f / 3);
}

// The standard deviation of `value`, an array of grid.padded() elements, among the up to eight
// neighbours of each stratum, squared and times `scale`², is added to `squares_out`. The first and
// the last sector are neighbours.
void AddVariance(const HemisphereGrid& grid, std::span<const float> value, float scale,
                 std::span<float> squares_out) {
  const uint32_t rings = grid.rings(), sectors = grid.sectors(), stride = grid.stride();
  // Sums of columns of three rings, and of their squares.
  std::vector<float> sum(sectors + 2), squares(sectors + 2);
  for (uint32_t j = 0; j < rings; ++j) {
    const uint32_t first = j > 0 ? j - 1 : 0, last = std::min(j + 1, rings - 1);
    for (uint32_t k = 0; k < sectors; ++k) {
      float s = 0, q = 0;
      for (uint32_t i = first; i <= last; ++i) {
        const float l = value[size_t{i} * stride + k];
        s += l;
        q += l * l;
      }
      sum[k + 1] = s;
      squares[k + 1] = q;
    }
    sum[0] = sum[sectors], squares[0] = squares[sectors];
    sum[sectors + 1] = sum[1], squares[sectors + 1] = squares[1];
    const float inverse = 1.0f / static_cast<float>(3 * (last - first + 1) - 1);
    for (uint32_t k = 0; k < sectors; ++k) {
      const size_t at = size_t{j} * stride + k;
      const float own = value[at];
      const float mean = (sum[k] + sum[k + 1] + sum[k + 2] - own) * inverse;
      const float square = (squares[k] + squares[k + 1] + squares[k + 2] - own * own) * inverse;
      squares_out[at] += std::max(0.0f, square - mean * mean) * scale * scale;
    }
  }
}

// How many more rays each stratum deserves, an array of grid.padded() elements: the standard
// deviation of what its neighbours see times its solid angle, over `least_share`.
std::vector<uint8_t> ExtraRays(const HemisphereGrid& grid, const HemisphereSamples& samples,
                               const RecordGatherer::Means& least_share) {
  const float each = kPif / static_cast<float>(grid.size());
  std::vector<float> squares(grid.padded(), 0.0f);
  if (least_share.irradiance > 0) {
    std::vector<float> grey(grid.padded());
    for (size_t at = 0; at < grey.size(); ++at) {
      grey[at] = GreyAt(samples, at);
    }
    AddVariance(grid, grey, each / least_share.irradiance, squares);
  }
  if (least_share.openness > 0) {
    AddVariance(grid, {samples.radiance(3), grid.padded()}, each / least_share.openness, squares);
  }
  std::vector<uint8_t> extra(grid.padded(), 0);
  for (uint32_t j = 0; j < grid.rings(); ++j) {
    for (uint32_t k = 0; k < grid.sectors(); ++k) {
      const size_t at = size_t{j} * grid.stride() + k;
      if (samples.inverse_distance()[at] < 0) continue;
      extra[at] = static_cast<uint8_t>(
          std::min(std::sqrt(squares[at]), static_cast<float>(kMostExtraRays)));
    }
  }
  return extra;
}

}  // namespace

Receiver ReceiverOfHit(const RayAccel& accel, const RayHit& hit, const Vec3f& w) {
  const PreparedScene& scene = accel.scene();
  Receiver r;
  r.position = scene.PointOn(hit.triangle, hit.b1, hit.b2);
  r.geometric_normal = scene.GeometricNormal(hit.triangle);
  r.normal = scene.ShadingNormal(hit.triangle, hit.b1, hit.b2);
  r.on_back = Dot(r.geometric_normal, w) > 0.0f;
  if (r.on_back) {
    r.geometric_normal = -r.geometric_normal;
    r.normal = -r.normal;
  }
  r.offset_m = accel.SurfaceOffsetM(hit.triangle, r.position, r.geometric_normal);
  return r;
}

RecordGatherer::RecordGatherer(const LoadedSceneData& scene, const CameraRays& rays,
                               const RenderSettings& settings, const MicrobufferMap& map,
                               const CutParams& cut_params, bool sees_sky, float ao_distance_m,
                               bool shades)
    : scene_(scene),
      rays_(rays),
      settings_(settings),
      map_(map),
      cut_params_(cut_params),
      sees_sky_(sees_sky),
      ao_distance_m_(ao_distance_m),
      shades_(shades) {
  hide_ = settings.skips(kSkipHidden);
  if (shades && settings.point_based() && settings.fill_in_force() == Fill::kRays &&
      scene.tree != nullptr && !scene.tree->empty()) {
    atlas_ = &scene.Atlas();
    indirect_ = scene.IndirectAtlas();
    near_m_ = kNearSpacings * atlas_->spacing_m();
  }
}

void RecordGatherer::Refine(const Means& deviation, uint32_t strata) {
  least_share_ = deviation;
  strata_ = strata;
  const std::lock_guard lock(mutex_);
  hide_ = hide_ &&
          stats_.skipped["nodes_hidden"] * CutDrawer::kWorthwhilePart >= stats_.counts["cut_nodes"];
}

bool RecordGatherer::ReceiverAt(int x, int y, Receiver& receiver, float& footprint_m) const {
  const Vec3f w = rays_.Direction(x + 0.5, y + 0.5);
  const std::optional<RayHit> hit = FirstSeen(*scene_.accel, rays_.eye(), w);
  if (!hit) return false;
  receiver = ReceiverOfHit(*scene_.accel, *hit, w);
  footprint_m = rays_.FootprintAt(receiver.position);
  return true;
}

bool RecordGatherer::ReceiverAlong(const CellProbe& probe, ReceiverPlace& place) const {
  const std::optional<RayHit> hit =
      scene_.accel->Intersect(probe.origin, probe.direction, probe.length_m);
  if (!hit) return false;
  place.receiver = ReceiverOfHit(*scene_.accel, *hit, probe.direction);
  place.footprint_m = rays_.FootprintAt(place.receiver.position);
  const Vec3f to_eye = rays_.eye() - place.receiver.position;
  const float distance = Length(to_eye);
  if (!(Dot(to_eye, place.receiver.geometric_normal) > 0.0f)) return false;
  if (scene_.accel->Occluded(place.receiver.Leave(), to_eye / distance, distance)) {
    return false;
  }
  return rays_.RasterOf(place.receiver.position, place.x_px, place.y_px);
}

GatherRecord RecordGatherer::Gather(const Receiver& receiver, const HemisphereGrid& grid,
                                    uint64_t key) const {
  return settings_.fill_in_force() == Fill::kCut ? GatherByCut(receiver, grid)
                                                 : GatherByRays(receiver, grid, key);
}

RecordGatherer::Means RecordGatherer::MeanOf(const PixelRect& frame, Executor& executor) const {
  if (frame.empty()) return {};
  const int pilots = static_cast<int>(
      std::clamp<int64_t>(frame.area() / kPixelsPerPilot, kLeastPilots, kMostPilots));
  const int side =
      std::max(1, static_cast<int>(std::sqrt(static_cast<double>(frame.area()) / pilots)));
  const int columns = (frame.width() + side - 1) / side;
  const int rows = (frame.height() + side - 1) / side;
  const HemisphereGrid grid(kPilotSamples);
  const size_t count = static_cast<size_t>(columns) * static_cast<size_t>(rows);
  std::vector<double> seen(count, -1.0), open(count, 0.0);
  executor.ForEach(count, 1, [&](size_t i) {
    const uint64_t jitter = HashKey(settings_.seed, kKeyPilot, i);
    const auto within = [&](uint64_t random) {
      return static_cast<int>(random % static_cast<uint64_t>(side));
    };
    const int x = frame.x0 + static_cast<int>(i) % columns * side + within(jitter & 0xffffffffu);
    const int y = frame.y0 + static_cast<int>(i) / columns * side + within(jitter >> 32);
    Receiver receiver;
    float footprint_m;
    if (!frame.Contains(x, y) || !ReceiverAt(x, y, receiver, footprint_m)) return;
    const GatherRecord g = Gather(receiver, grid, HashKey(settings_.seed, kKeyPilotGather, i));
    const Rgb& e = g.irradiance;
    seen[i] = (static_cast<double>(e.x) + static_cast<double>(e.y) + static_cast<double>(e.z)) / 3;
    open[i] = static_cast<double>(g.openness);
  });
  double sum = 0, open_sum = 0;
  int hits = 0;
  for (size_t i = 0; i < count; ++i) {
    if (!(seen[i] >= 0)) continue;
    sum += seen[i];
    open_sum += open[i];
    ++hits;
  }
  if (hits == 0) return {};
  return {RoundToQuarterOctave(sum / hits), RoundToQuarterOctave(open_sum / hits)};
}

GatherRecord RecordGatherer::GatherByRays(const Receiver& receiver, const HemisphereGrid& grid,
                                          uint64_t key) const {
  const double start = ThreadCpuSeconds();
  const Frame frame(receiver.normal);
  const bool tells_near = ao_distance_m_ > 0;
  HemisphereSamples samples(grid, tells_near);
  const float most_inverse = tells_near ? 1.0f / ao_distance_m_ : 0.0f;  // of what hides nothing
  const uint64_t directions_key = HashKey(key, kKeyDirections);
  grid.Directions(directions_key, samples.direction(0), samples.direction(1), samples.direction(2));
  HitReader reader(scene_, atlas_, indirect_, near_m_, receiver, HashKey(key, kKeyLight), shades_);
  HitReader::Rays rays;
  // Reads the rays, once again those that bring so much more than the others that one which slipped
  // between two triangles would show, and hands them to `take`.
  float odd = 0;
  bool odd_misses = false;
  const auto flush = [&](const auto& take) {
    reader.Read(rays);
    for (uint32_t i = 0; i < rays.count; ++i) {
      if (Grey(rays.radiance[i]) > odd || (odd_misses && rays.inverse_distance[i] == 0)) {
        reader.ReadAgain(rays, i);
      }
      take(i);
    }
    rays.count = 0;
  };
  const auto first = [&](uint32_t i) {
    const size_t at = rays.stratum[i];
    for (int c = 0; c < 3; ++c) samples.radiance(c)[at] = rays.radiance[i][c];
    samples.inverse_distance()[at] = rays.inverse_distance[i];
    if (sees_sky_ && rays.inverse_distance[i] == 0) samples.radiance(3)[at] = 1;
    if (tells_near) {
      samples.unhidden()[at] = rays.inverse_distance[i] <= most_inverse ? 1.0f : 0.0f;
      if (!shades_) samples.radiance(3)[at] = samples.unhidden()[at];
    }
  };
  const auto direction_of = [&](size_t at) {
    return frame.ToWorld(
        {samples.direction(0)[at], samples.direction(1)[at], samples.direction(2)[at]});
  };
  odd = std::numeric_limits<float>::infinity();
  for (uint32_t ring = 0; ring < grid.rings(); ++ring) {
    for (uint32_t sector = 0; sector < grid.sectors(); ++sector) {
      const uint32_t at = ring * grid.stride() + sector;
      const Vec3f w = direction_of(at);
      // Directions that the shading normal allows and the surface does not carry nothing.
      if (!(Dot(w, receiver.geometric_normal) > 0.0f)) {
        samples.inverse_distance()[at] = -1;
        continue;
      }
      rays.Add(w, at, at);
      if (rays.count == kRaysTogether) flush(first);
    }
  }
  flush(first);
  double sum = 0, misses = 0;
  for (size_t at = 0; at < grid.padded(); ++at) {
    sum += static_cast<double>(GreyAt(samples, at));
    misses += static_cast<double>(samples.radiance(3)[at]);
  }
  odd = static_cast<float>(kOdd * sum / grid.size());
  odd_misses = misses * kOdd < grid.size();
  for (uint32_t at = 0; at < grid.padded(); ++at) {
    if (GreyAt(samples, at) > odd || (odd_misses && samples.radiance(3)[at] > 0)) {
      rays.Add(direction_of(at), at, at);
      samples.radiance(3)[at] = 0;
      reader.ReadAgain(rays, 0);
      first(0);
      rays.count = 0;
    }
  }

  uint64_t refined = 0;
  if (least_share_.irradiance > 0 || least_share_.openness > 0) {
    // Without this the rays that are added would be as many however few strata there are.
    const float relaxed =
        std::max(1.0f, static_cast<float>(strata_) / static_cast<float>(grid.size()));
    const std::vector<uint8_t> extra = ExtraRays(
        grid, samples, {least_share_.irradiance * relaxed, least_share_.openness * relaxed});
    alignas(32) float x[kMostExtraRays], y[kMostExtraRays], z[kMostExtraRays];
    const auto add = [&](uint32_t i) {
      const size_t at = rays.stratum[i];
      for (int c = 0; c < 3; ++c) samples.radiance(c)[at] += rays.radiance[i][c];
      samples.inverse_distance()[at] += rays.inverse_distance[i];
      if (sees_sky_ && rays.inverse_distance[i] == 0) samples.radiance(3)[at] += 1;
      if (tells_near && rays.inverse_distance[i] <= most_inverse) {
        samples.unhidden()[at] += 1;
        if (!shades_) samples.radiance(3)[at] += 1;
      }
    };
    for (uint32_t ring = 0; ring < grid.rings(); ++ring) {
      for (uint32_t sector = 0; sector < grid.sectors(); ++sector) {
        const uint32_t at = ring * grid.stride() + sector;
        if (extra[at] == 0) continue;
        ++refined;
        grid.DirectionsIn(ring, sector, directions_key, 1, extra[at], x, y, z);
        for (uint32_t i = 0; i < extra[at]; ++i) {
          const Vec3f w = frame.ToWorld({x[i], y[i], z[i]});
          if (!(Dot(w, receiver.geometric_normal) > 0.0f)) continue;
          rays.Add(w, (i + 1) * grid.padded() + at, at);
          if (rays.count == kRaysTogether) flush(add);
        }
      }
    }
    flush(add);
    for (size_t at = 0; at < grid.padded(); ++at) {
      if (extra[at] == 0) continue;
      const float share = 1.0f / static_cast<float>(extra[at] + 1);
      for (int c = 0; c < 4; ++c) samples.radiance(c)[at] *= share;
      samples.inverse_distance()[at] *= share;
      if (tells_near) samples.unhidden()[at] *= share;
    }
  }
  const GatherRecord record = MakeGatherRecord(grid, samples, receiver.position, frame);
  const std::lock_guard lock(mutex_);
  stats_.seconds[static_cast<int>(Stage::kTrace)] += ThreadCpuSeconds() - start;
  stats_.counts["rays"] += reader.traced + reader.counters.rays;
  stats_.counts["gather_rays"] += reader.traced;
  stats_.counts["rays_again"] += reader.again;
  stats_.counts["strata_refined"] += refined;
  stats_.counts["hits_shaded"] += reader.shaded;
  stats_.skipped["hits_read_from_surfels"] += reader.read;
  stats_.skipped["shadow_rays"] += reader.counters.skipped_facing_away;
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
  Microbuffer buffer(map_);
  CutCounters cut_counters;
  RasterCounters raster_counters;
  HiddenCounters hidden_counters;
  double clock = start, cut_s = 0;
  CutDrawer drawer(tree, map_, cut_params_, settings_.splat, hide_);
  const size_t cut_nodes = drawer.Draw(view, nullptr, buffer, cut_counters, raster_counters,
                                       hidden_counters, [&](CutDrawer::Part part) {
                                         const double now = ThreadCpuSeconds();
                                         if (part == CutDrawer::Part::kCut) cut_s += now - clock;
                                         clock = now;
                                       });

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
  stats_.seconds[static_cast<int>(Stage::kCut)] += cut_s;
  stats_.seconds[static_cast<int>(Stage::kRaster)] += end - start - cut_s;
  stats_.counts["cut_nodes"] += cut_nodes;
  stats_.counts["node_visits"] += cut_counters.groups_visited * kLanes;
  stats_.counts["splats"] += raster_counters.splats;
  stats_.counts["exact_discs"] += raster_counters.exact_discs;
  stats_.skipped["nodes_below_horizon"] += cut_counters.below_horizon;
  stats_.skipped["nodes_invisible_side"] += cut_counters.invisible_side;
  stats_.skipped["pixels_hidden"] += raster_counters.hidden_pixels;
  stats_.skipped["nodes_hidden"] += hidden_counters.nodes;
  stats_.skipped["subtrees_hidden"] += cut_counters.hidden_subtrees;
  return record;
}

Stats RecordGatherer::TakeStats() const {
  const std::lock_guard lock(mutex_);
  Stats out;
  std::swap(out, stats_);
  return out;
}

}  // namespace farpoint

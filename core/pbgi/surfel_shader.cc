#include "core/pbgi/surfel_shader.h"

#include <algorithm>
#include <array>

#include "core/base/check.h"
#include "core/math/elementary.h"
#include "core/math/sampling.h"

namespace farpoint {

namespace {

constexpr uint32_t kInteriorRays = 4;
constexpr size_t kPiece = 1024;

struct PieceCounts {
  uint64_t shadow = 0, interior = 0, inside = 0, black = 0, away = 0, environments = 0;
};

// Sets of kInteriorRays directions about +z, stratified by the cosine. Drawing from a table costs
// nothing beside the ray.
constexpr size_t kInteriorSets = 256;
using InteriorSet = std::array<Vec3f, kInteriorRays>;

std::array<InteriorSet, kInteriorSets> MakeInteriorSets() {
  std::array<InteriorSet, kInteriorSets> sets;
  for (size_t set = 0; set < kInteriorSets; ++set) {
    const auto seed = static_cast<uint32_t>(HashKey(set));
    for (uint32_t i = 0; i < kInteriorRays; ++i) {
      sets[set][i] = CosineHemisphere(OwenSobol(i, 0, seed), OwenSobol(i, 1, seed));
    }
  }
  return sets;
}

// GeometricNormal of every triangle: rays ask for each many times.
std::vector<Vec3f> NormalsOf(const PreparedScene& scene, Executor& executor) {
  std::vector<Vec3f> normals(scene.triangles().size());
  executor.ForEachPiece(normals.size(), kPiece, [&](size_t begin, size_t end) {
    for (size_t t = begin; t < end; ++t) {
      normals[t] = scene.GeometricNormal(static_cast<uint32_t>(t));
    }
  });
  return normals;
}

// Whether all rays that leave `p` on the side of `ng` hit surfaces from behind.
bool SeesOnlyBackFaces(const RayAccel& accel, const std::vector<Vec3f>& normals, uint32_t triangle,
                       const Vec3f& p, const Vec3f& ng, const InteriorSet& set,
                       PieceCounts& counts) {
  const Frame frame(ng);
  const Vec3f origin = accel.LeaveSurface(triangle, p, ng);
  for (const Vec3f& local : set) {
    const Vec3f w = frame.ToWorld(local);
    ++counts.interior;
    const std::optional<RayHit> hit = accel.Intersect(origin, w);
    if (!hit || Dot(normals[hit->triangle], w) < 0.0f) return false;
  }
  return true;
}

}  // namespace

uint64_t SurfelKey(const SurfelCloud& cloud, size_t i, const PreparedScene& scene, uint64_t seed) {
  const uint32_t t = cloud.triangle[i];
  const PreparedObject& object = scene.objects()[scene.triangles()[t].object];
  return HashKey(seed, object.content_key, t - object.first_triangle,
                 static_cast<uint64_t>(cloud.barycentric[i].x * 16777216.0f));
}

SurfelSides FindOpenSides(const SurfelCloud& cloud, const RayAccel& accel, uint64_t seed,
                          Executor& executor, Stats& stats) {
  static const std::array<InteriorSet, kInteriorSets> sets = MakeInteriorSets();
  const size_t n = cloud.size();
  SurfelSides sides(n);
  if (n == 0) return sides;
  const std::vector<Vec3f> normals = NormalsOf(accel.scene(), executor);
  std::vector<PieceCounts> piece_counts((n + kPiece - 1) / kPiece);
  executor.ForEachPiece(n, kPiece, [&](size_t begin, size_t end) {
    PieceCounts& counts = piece_counts[begin / kPiece];
    for (size_t i = begin; i < end; ++i) {
      const uint64_t key = SurfelKey(cloud, i, accel.scene(), seed);
      uint8_t open = 0;
      for (unsigned side = 0; side < 2; ++side) {
        const Vec3f ng = side == 0 ? cloud.normal[i] : -cloud.normal[i];
        const InteriorSet& set = sets[HashKey(key, side, 5) % kInteriorSets];
        if (!SeesOnlyBackFaces(accel, normals, cloud.triangle[i], cloud.position[i], ng, set,
                               counts)) {
          open |= side == 0 ? kFrontVisible : kBackVisible;
        }
      }
      sides[i] = open;
    }
  });
  for (const PieceCounts& c : piece_counts) stats.counts["interior_rays"] += c.interior;
  return sides;
}

SurfelShading ShadeSurfels(const SurfelCloud& cloud, const SurfelSides& open_sides,
                           const RayAccel& accel, const LightSampler& lights,
                           const ShadeOptions& options, Executor& executor, Stats& stats) {
  const PreparedScene& scene = accel.scene();
  const size_t n = cloud.size();
  FP_CHECK(open_sides.size() == n);
  SurfelShading out;
  out.front.resize(n);
  out.back.resize(n);
  out.visible_sides.resize(n);
  const uint32_t samples =
      std::max(1u, (options.light_samples + kSurfelLightShare - 1) / kSurfelLightShare);

  std::vector<PieceCounts> piece_counts((n + kPiece - 1) / kPiece);
  executor.ForEachPiece(n, kPiece, [&](size_t begin, size_t end) {
    PieceCounts& counts = piece_counts[begin / kPiece];
    LightCounters light_counters;
    for (size_t i = begin; i < end; ++i) {
      out.front[i] = out.back[i] = Rgb();
      const uint32_t t = cloud.triangle[i];
      const Vec2f b = cloud.barycentric[i];
      const Vec3f p = cloud.position[i];
      const Rgb albedo = scene.Surface(t, b.x, b.y).albedo;
      const Vec3f ns_front = scene.ShadingNormal(t, b.x, b.y);
      const bool black = !(MaxComponent(albedo) > 0.0f);
      const uint64_t key = SurfelKey(cloud, i, scene, options.seed);
      uint8_t visible = open_sides[i];
      for (unsigned side = 0; side < 2; ++side) {
        const uint8_t bit = side == 0 ? kFrontVisible : kBackVisible;
        const Vec3f ng = side == 0 ? cloud.normal[i] : -cloud.normal[i];
        const Vec3f ns = side == 0 ? ns_front : -ns_front;
        const uint64_t side_key = HashKey(key, side);
        // A side that seems to lie inside is believed to only if no light reaches it by any of the
        // rays that it would be shaded with: a room whose walls are modelled outside in shows its
        // back faces everywhere, and a single ray would darken its penumbras.
        const bool open = (visible & bit) != 0;
        if (black && open && options.skip_black) {
          ++counts.black;
          continue;
        }
        const SurfacePoint at{p, ng, ns, accel.SurfaceOffsetM(t, p, ng)};
        const Rgb e =
            lights.Irradiance(at, samples, side_key, 0, 0, light_counters, LightSampler::kOfSurfels,
                              /*environment=*/true, options.needless);
        if (!open) {
          if (!(MaxComponent(e) > 0.0f)) {
            ++counts.inside;
            continue;
          }
          visible |= bit;
        }
        (side == 0 ? out.front : out.back)[i] = albedo * e * kInvPif;
      }
      out.visible_sides[i] = visible;
    }
    counts.shadow = light_counters.rays + light_counters.needless;
    counts.away = light_counters.skipped_facing_away;
    counts.environments = light_counters.skipped_environments;
  });
  for (const PieceCounts& c : piece_counts) {
    stats.counts["shadow_rays"] += c.shadow;
    stats.skipped["surfel_sides_inside"] += c.inside;
    stats.skipped["surfel_sides_black"] += c.black;
    stats.skipped["shadow_rays"] += c.away;
    stats.skipped["environment_terms"] += c.environments;
  }
  return out;
}

}  // namespace farpoint

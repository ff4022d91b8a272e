#include "core/render/hit_reader.h"

#include <algorithm>
#include <optional>

#include "core/math/elementary.h"
#include "core/math/sampling.h"
#include "core/render/glossy_point.h"

namespace farpoint {

namespace {

enum : uint64_t { kKeyGlossyLight = 41, kKeyGlossyRay = 42 };

}  // namespace

void HitReader::Trace(Rays& rays) {
  traced += rays.count;
  scene_.accel->IntersectBundle(origin_, std::span(rays.direction).first(rays.count), rays.hit);
}

void HitReader::Read(Rays& rays) {
  Trace(rays);
  ReadHits(rays);
}

void HitReader::ReadAgain(Rays& rays, uint32_t i) {
  ++traced;
  ++again;
  Rays one;
  one.Add(rays.direction[i], rays.index[i], rays.stratum[i]);
  const std::optional<RayHit> hit = scene_.accel->Intersect(origin_, one.direction[0]);
  one.hit[0].triangle = kNoTriangle;
  if (hit) one.hit[0] = *hit;
  ReadHits(one);
  rays.hit[i] = one.hit[0];
  rays.radiance[i] = one.radiance[0];
  rays.inverse_distance[i] = one.inverse_distance[0];
}

void HitReader::ReadHits(Rays& rays) {
  const std::span<const RayHit> hits = rays.hit;
  // What lies far brings its surfel's radiance …
  std::array<SurfelAtlas::Point, kRaysTogether> far;
  std::array<uint32_t, kRaysTogether> far_ray;
  uint32_t far_count = 0;
  RayHits near;
  const auto shade = [&](uint32_t i) {
    const uint32_t k = near.count++;
    near.ray[k] = i;
    near.index[k] = rays.index[i];
    near.triangle[k] = hits[i].triangle;
    near.b1[k] = hits[i].b1;
    near.b2[k] = hits[i].b2;
    near.direction.Set(k, rays.direction[i]);
  };
  for (uint32_t i = 0; i < rays.count; ++i) {
    rays.radiance[i] = Rgb();
    rays.inverse_distance[i] = 0;
    const RayHit& hit = hits[i];
    if (hit.triangle == kNoTriangle) continue;
    // A hit at the origin itself has no distance: as near as the offset that the ray took.
    const float t = std::max(hit.t, offset_m_);
    rays.inverse_distance[i] = 1.0f / t;
    if (!shades_) continue;
    if (scene_.scene->IsGlossy(hit.triangle)) {
      ++glossy;
      rays.radiance[i] = ShadeGlossy(rays, i);
    } else if (atlas_ != nullptr && t > near_m_) {
      far_ray[far_count] = i;
      far[far_count++] = {hit.triangle, hit.b1, hit.b2, hit.front};
    } else {
      shade(i);
    }
  }
  if (far_count > 0) {
    std::array<Rgb, kRaysTogether> radiance;
    const uint64_t found = atlas_->Radiances(std::span(far).first(far_count), radiance);
    for (uint32_t k = 0; k < far_count; ++k) {
      if ((found >> k & 1) != 0) {
        ++read;
        rays.radiance[far_ray[k]] = radiance[k];
      } else {
        shade(far_ray[k]);
      }
    }
  }
  // … and the rest is shaded.
  const PreparedScene& scene = *scene_.scene;
  KeepWhatReflects(scene, near);
  if (near.count == 0) return;
  shaded += near.count;
  std::array<SurfacePoints8, kRaysTogether / kHitLanes> points;
  std::array<V8, kRaysTogether / kHitLanes> irradiance;
  const size_t groups = SurfacesOf(near, points);
  scene_.lights->IrradianceEach(std::span(points).first(groups), light_key_, 2,
                                std::span(irradiance).first(groups), counters);
  std::array<Rgb, kRaysTogether> indirect;
  uint64_t found = 0;
  if (indirect_ != nullptr) {
    std::array<SurfelAtlas::Point, kRaysTogether> at;
    for (uint32_t k = 0; k < near.count; ++k) {
      at[k] = {near.triangle[k], near.b1[k], near.b2[k], hits[near.ray[k]].front};
    }
    found = indirect_->Radiances(std::span(at).first(near.count), indirect);
  }
  for (uint32_t k = 0; k < near.count; ++k) {
    Rgb arriving = irradiance[k / kHitLanes].Lane(k % kHitLanes);
    if ((found >> k & 1) != 0) arriving += indirect[k];
    // Textures are looked up where light arrives only.
    if (!(MaxComponent(arriving) > 0.0f)) continue;
    const Rgb albedo = scene.Surface(near.triangle[k], near.b1[k], near.b2[k]).albedo;
    rays.radiance[near.ray[k]] = albedo * arriving * kInvPif;
  }
}

Rgb HitReader::ShadeGlossy(const Rays& rays, uint32_t i) {
  const RayHit& hit = rays.hit[i];
  const GlossyPoint point(*scene_.accel, hit, rays.direction[i]);
  const uint32_t index = rays.index[i];
  const auto seed = static_cast<uint32_t>(HashKey(light_key_, kKeyGlossyRay));
  uint64_t extra = 0;
  Rgb radiance =
      point.Direct(*scene_.accel, *scene_.lights, HashKey(light_key_, kKeyGlossyLight), index,
                   OwenSobol(index, 0, seed), OwenSobol(index, 1, seed), counters, extra);
  traced += extra;
  if (indirect_ != nullptr) {
    // What came by further bounces has lost its direction.
    const auto found = indirect_->Radiance({hit.triangle, hit.b1, hit.b2, hit.front});
    if (found) {
      radiance += *found * scene_.scene->Surface(hit.triangle, hit.b1, hit.b2).albedo * kInvPif;
    }
  }
  return radiance;
}

}  // namespace farpoint

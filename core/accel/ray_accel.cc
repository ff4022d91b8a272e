#include "core/accel/ray_accel.h"

#if __has_include(<embree4/rtcore.h>)
#include <embree4/rtcore.h>
#else
#include <embree3/rtcore.h>
#endif

#include <array>
#include <mutex>
#include <string>
#include <vector>

#include "core/base/fp_trap.h"
#include "core/base/pulse.h"

namespace farpoint {

namespace {

// Triangles of masked materials are a geometry of their own, so that only their hits are asked for
// alpha.
enum : unsigned { kOpaque = 0, kMasked = 1 };

// Spatial splits make rays of a bundle a tenth faster (Sponza) and take five times as long to
// build: 0.2 s for 262,000 triangles.
constexpr size_t kMostSplitTriangles = 2'000'000;

// What the filter of the masked geometry needs.
struct Masks {
  const PreparedScene* scene = nullptr;
  std::vector<uint32_t> triangles;  // of the masked geometry's primitives
};

// Makes holes of the points whose alpha lies below the cutoff, for nearest-hit and any-hit rays.
void AlphaFilter(const RTCFilterFunctionNArguments* args) {
  const auto& masks = *static_cast<const Masks*>(args->geometryUserPtr);
  for (unsigned i = 0; i < args->N; ++i) {
    if (args->valid[i] == 0) continue;
    const uint32_t triangle = masks.triangles[RTCHitN_primID(args->hit, args->N, i)];
    const float b1 = RTCHitN_u(args->hit, args->N, i);
    const float b2 = RTCHitN_v(args->hit, args->N, i);
    if (masks.scene->Alpha(triangle, b1, b2) < masks.scene->MaterialOf(triangle).alpha_cutoff) {
      args->valid[i] = 0;
    }
  }
}

void FillRay(RTCRay& ray, const Vec3f& origin, const Vec3f& direction, float t_max) {
  ray.org_x = origin.x;
  ray.org_y = origin.y;
  ray.org_z = origin.z;
  ray.dir_x = direction.x;
  ray.dir_y = direction.y;
  ray.dir_z = direction.z;
  ray.tnear = 0.0f;
  ray.tfar = t_max;
  ray.time = 0.0f;
  ray.mask = ~0u;
  ray.id = 0;
  ray.flags = 0;
}

}  // namespace

struct RayAccel::Impl {
  RTCDevice device = nullptr;
  RTCScene scene = nullptr;
  RTCScene loose = nullptr;  // without the robust flag
  RTCGeometry geometries[2] = {nullptr, nullptr};
  std::vector<uint32_t> opaque;  // triangles of kOpaque's primitives; empty: each is its own
  Masks masks;
  std::string error_text;
  std::once_flag loose_once;
  ~Impl() {
    for (RTCGeometry geometry : geometries) {
      if (geometry) rtcReleaseGeometry(geometry);
    }
    if (scene) rtcReleaseScene(scene);
    if (loose) rtcReleaseScene(loose);
    if (device) rtcReleaseDevice(device);
  }

  // A scene of the geometries.
  RTCScene MakeScene(RTCSceneFlags flags, RTCBuildQuality quality) {
    RTCScene made = rtcNewScene(device);
    rtcSetSceneFlags(made, flags);
    rtcSetSceneBuildQuality(made, quality);
    for (unsigned id = 0; id < 2; ++id) {
      if (geometries[id]) rtcAttachGeometryByID(made, geometries[id], id);
    }
    rtcSetSceneProgressMonitorFunction(
        made,
        [](void*, double) {
          Pulse();
          return true;
        },
        nullptr);
    rtcCommitScene(made);
    return made;
  }

  uint32_t TriangleOf(unsigned geometry, uint32_t primitive) const {
    if (geometry == kMasked) return masks.triangles[primitive];
    return opaque.empty() ? primitive : opaque[primitive];
  }

  // Runs a query for the nearest hit; false: none.
  static bool Nearest(RTCScene in, RTCRayHit& query) {
    query.hit.geomID = RTC_INVALID_GEOMETRY_ID;
    query.hit.instID[0] = RTC_INVALID_GEOMETRY_ID;
#if RTC_VERSION_MAJOR >= 4
    rtcIntersect1(in, &query);
#else
    RTCIntersectContext context;
    rtcInitIntersectContext(&context);
    rtcIntersect1(in, &context, &query);
#endif
    return query.hit.geomID != RTC_INVALID_GEOMETRY_ID;
  }

  RayHit HitOf(const RTCRayHit& query) const {
    const bool front = !(query.hit.Ng_x * query.ray.dir_x + query.hit.Ng_y * query.ray.dir_y +
                             query.hit.Ng_z * query.ray.dir_z >
                         0.0f);
    return {query.ray.tfar, TriangleOf(query.hit.geomID, query.hit.primID), query.hit.u,
            query.hit.v, front};
  }
};

RayAccel::RayAccel(std::shared_ptr<const PreparedScene> scene)
    : scene_(std::move(scene)), impl_(std::make_unique<Impl>()) {}

RayAccel::~RayAccel() = default;

absl::StatusOr<std::shared_ptr<const RayAccel>> RayAccel::Build(
    std::shared_ptr<const PreparedScene> scene, std::vector<TracedRay>* record) {
  std::shared_ptr<RayAccel> accel(new RayAccel(std::move(scene)));
  accel->record_ = record;
  Impl& impl = *accel->impl_;
  impl.device = rtcNewDevice("isa=avx2");
  if (!impl.device) {
    return absl::UnavailableError(
        "Embree gave no device; this machine's processor must know AVX2 (rtcNewDevice error " +
        std::to_string(static_cast<int>(rtcGetDeviceError(nullptr))) + ")");
  }
  rtcSetDeviceErrorFunction(
      impl.device,
      [](void* text, RTCError code, const char* what) {
        *static_cast<std::string*>(text) =
            "Embree error " + std::to_string(static_cast<int>(code)) + ": " + (what ? what : "");
      },
      &impl.error_text);
  const PreparedScene& s = *accel->scene_;
  const auto add = [&](unsigned id, const std::vector<uint32_t>& triangles) {
    RTCGeometry geometry = rtcNewGeometry(impl.device, RTC_GEOMETRY_TYPE_TRIANGLE);
    impl.geometries[id] = geometry;
    // Embree reads 16 bytes at each vertex; the blob goes on after the last one.
    rtcSetSharedGeometryBuffer(geometry, RTC_BUFFER_TYPE_VERTEX, 0, RTC_FORMAT_FLOAT3,
                               s.vertices().data(), 0, sizeof(Vec3f), s.vertices().size());
    if (triangles.empty()) {
      rtcSetSharedGeometryBuffer(geometry, RTC_BUFFER_TYPE_INDEX, 0, RTC_FORMAT_UINT3,
                                 s.triangles().data(), 0, sizeof(PreparedTriangle),
                                 s.triangles().size());
    } else if (auto* out = static_cast<std::array<uint32_t, 3>*>(
                   rtcSetNewGeometryBuffer(geometry, RTC_BUFFER_TYPE_INDEX, 0, RTC_FORMAT_UINT3,
                                           sizeof(std::array<uint32_t, 3>), triangles.size()))) {
      for (const uint32_t t : triangles) *out++ = s.triangles()[t].vertex;
    }
    if (id == kMasked) {
      rtcSetGeometryUserData(geometry, &impl.masks);
      rtcSetGeometryIntersectFilterFunction(geometry, AlphaFilter);
      rtcSetGeometryOccludedFilterFunction(geometry, AlphaFilter);
    }
    rtcCommitGeometry(geometry);
  };
  if (s.has_alpha_masks()) {
    impl.masks.scene = &s;
    for (uint32_t t = 0; t < s.triangles().size(); ++t) {
      (s.MaterialOf(t).alpha_cutoff < 0.0f ? impl.opaque : impl.masks.triangles).push_back(t);
    }
    if (!impl.opaque.empty()) add(kOpaque, impl.opaque);
    if (!impl.masks.triangles.empty()) add(kMasked, impl.masks.triangles);
  } else if (!s.triangles().empty()) {
    add(kOpaque, {});
  }
  impl.scene = impl.MakeScene(RTC_SCENE_FLAG_ROBUST, RTC_BUILD_QUALITY_MEDIUM);
  if (!impl.error_text.empty()) return absl::UnavailableError(impl.error_text);
  return std::shared_ptr<const RayAccel>(std::move(accel));
}

absl::Status RayAccel::PrepareBundles() const {
  std::call_once(impl_->loose_once, [this] {
    const bool split = scene_->triangles().size() <= kMostSplitTriangles;
    impl_->loose = impl_->MakeScene(RTC_SCENE_FLAG_NONE,
                                    split ? RTC_BUILD_QUALITY_HIGH : RTC_BUILD_QUALITY_MEDIUM);
  });
  if (!impl_->error_text.empty()) return absl::UnavailableError(impl_->error_text);
  return absl::OkStatus();
}

std::optional<RayHit> RayAccel::Intersect(const Vec3f& origin, const Vec3f& direction,
                                          float t_max) const {
  const FpTrapPause pause;
  if (record_ != nullptr) [[unlikely]]
    record_->push_back({origin, direction, t_max, false});
  RTCRayHit query;
  FillRay(query.ray, origin, direction, t_max);
  if (!Impl::Nearest(impl_->scene, query)) return std::nullopt;
  return impl_->HitOf(query);
}

void RayAccel::IntersectBundle(const Vec3f& origin, std::span<const Vec3f> directions,
                               std::span<RayHit> hits) const {
  const FpTrapPause pause;
  constexpr float kFar = std::numeric_limits<float>::infinity();
  for (size_t i = 0; i < directions.size(); ++i) {
    if (record_ != nullptr) [[unlikely]]
      record_->push_back({origin, directions[i], kFar, false});
    RTCRayHit query;
    FillRay(query.ray, origin, directions[i], kFar);
    if (Impl::Nearest(impl_->loose, query)) {
      hits[i] = impl_->HitOf(query);
    } else {
      hits[i].triangle = kNoTriangle;
    }
  }
}

bool RayAccel::Occluded(const Vec3f& origin, const Vec3f& direction, float t_max) const {
  const FpTrapPause pause;
  if (record_ != nullptr) [[unlikely]]
    record_->push_back({origin, direction, t_max, true});
  RTCRay ray;
  FillRay(ray, origin, direction, t_max);
#if RTC_VERSION_MAJOR >= 4
  rtcOccluded1(impl_->scene, &ray);
#else
  RTCIntersectContext context;
  rtcInitIntersectContext(&context);
  rtcOccluded1(impl_->scene, &context, &ray);
#endif
  return ray.tfar < 0.0f;
}

unsigned RayAccel::Occluded8(std::span<const Vec3f, 8> origins,
                             std::span<const Vec3f, 8> directions, std::span<const float, 8> t_max,
                             unsigned mask, bool from_one_point) const {
  const FpTrapPause pause;
  alignas(32) int valid[8];
  alignas(32) RTCRay8 rays;
  for (size_t i = 0; i < 8; ++i) {
    valid[i] = (mask >> i & 1) != 0 ? -1 : 0;
    if (record_ != nullptr && valid[i] != 0) [[unlikely]]
      record_->push_back({origins[i], directions[i], t_max[i], true});
    rays.org_x[i] = origins[i].x;
    rays.org_y[i] = origins[i].y;
    rays.org_z[i] = origins[i].z;
    rays.dir_x[i] = directions[i].x;
    rays.dir_y[i] = directions[i].y;
    rays.dir_z[i] = directions[i].z;
    rays.tnear[i] = 0.0f;
    rays.tfar[i] = t_max[i];
    rays.time[i] = 0.0f;
    rays.mask[i] = ~0u;
    rays.id[i] = 0;
    rays.flags[i] = 0;
  }
#if RTC_VERSION_MAJOR >= 4
  RTCOccludedArguments arguments;
  rtcInitOccludedArguments(&arguments);
  if (from_one_point) arguments.flags = RTC_RAY_QUERY_FLAG_COHERENT;
  rtcOccluded8(valid, impl_->scene, &rays, &arguments);
#else
  RTCIntersectContext context;
  rtcInitIntersectContext(&context);
  if (from_one_point) context.flags = RTC_INTERSECT_CONTEXT_FLAG_COHERENT;
  rtcOccluded8(valid, impl_->scene, &context, &rays);
#endif
  unsigned blocked = 0;
  for (size_t i = 0; i < 8; ++i) {
    if (valid[i] != 0 && rays.tfar[i] < 0.0f) blocked |= 1u << i;
  }
  return blocked;
}

size_t RayAccel::TraceBare(std::span<const TracedRay> rays) const {
  size_t hits = 0;
#if RTC_VERSION_MAJOR < 4
  RTCIntersectContext context;
  rtcInitIntersectContext(&context);
#endif
  for (const TracedRay& r : rays) {
    if (r.any_hit) {
      RTCRay ray;
      FillRay(ray, r.origin, r.direction, r.t_max);
#if RTC_VERSION_MAJOR >= 4
      rtcOccluded1(impl_->scene, &ray);
#else
      rtcOccluded1(impl_->scene, &context, &ray);
#endif
      hits += ray.tfar < 0.0f;
    } else {
      RTCRayHit query;
      FillRay(query.ray, r.origin, r.direction, r.t_max);
      hits += Impl::Nearest(impl_->scene, query);
    }
  }
  return hits;
}

}  // namespace farpoint

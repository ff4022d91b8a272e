#include "core/accel/ray_accel.h"

#if __has_include(<embree4/rtcore.h>)
#include <embree4/rtcore.h>
#else
#include <embree3/rtcore.h>
#endif

#include <string>

#include "core/base/fp_trap.h"

namespace farpoint {

namespace {

// Makes holes of the points whose alpha lies below the cutoff, for nearest-hit and any-hit rays.
void AlphaFilter(const RTCFilterFunctionNArguments* args) {
  const auto& scene = *static_cast<const PreparedScene*>(args->geometryUserPtr);
  for (unsigned i = 0; i < args->N; ++i) {
    if (args->valid[i] == 0) continue;
    const uint32_t triangle = RTCHitN_primID(args->hit, args->N, i);
    const PreparedMaterial& material = scene.MaterialOf(triangle);
    if (material.alpha_cutoff < 0.0f) continue;
    const float b1 = RTCHitN_u(args->hit, args->N, i);
    const float b2 = RTCHitN_v(args->hit, args->N, i);
    if (scene.Alpha(triangle, b1, b2) < material.alpha_cutoff) args->valid[i] = 0;
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
  ~Impl() {
    if (scene) rtcReleaseScene(scene);
    if (device) rtcReleaseDevice(device);
  }
};

RayAccel::RayAccel(std::shared_ptr<const PreparedScene> scene)
    : scene_(std::move(scene)),
      surface_offset_m_(scene_->diagonal_m() * (1.0f / 524288.0f)),
      impl_(std::make_unique<Impl>()) {}

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
  std::string error_text;
  rtcSetDeviceErrorFunction(
      impl.device,
      [](void* text, RTCError code, const char* what) {
        *static_cast<std::string*>(text) =
            "Embree error " + std::to_string(static_cast<int>(code)) + ": " + (what ? what : "");
      },
      &error_text);
  impl.scene = rtcNewScene(impl.device);
  rtcSetSceneFlags(impl.scene, RTC_SCENE_FLAG_ROBUST);
  const PreparedScene& s = *accel->scene_;
  if (!s.triangles().empty()) {
    RTCGeometry geometry = rtcNewGeometry(impl.device, RTC_GEOMETRY_TYPE_TRIANGLE);
    // Embree reads 16 bytes at each vertex; the blob goes on after the last one.
    rtcSetSharedGeometryBuffer(geometry, RTC_BUFFER_TYPE_VERTEX, 0, RTC_FORMAT_FLOAT3,
                               s.vertices().data(), 0, sizeof(Vec3f), s.vertices().size());
    rtcSetSharedGeometryBuffer(geometry, RTC_BUFFER_TYPE_INDEX, 0, RTC_FORMAT_UINT3,
                               s.triangles().data(), 0, sizeof(PreparedTriangle),
                               s.triangles().size());
    rtcSetGeometryUserData(geometry, const_cast<PreparedScene*>(&s));
    if (s.has_alpha_masks()) {
      rtcSetGeometryIntersectFilterFunction(geometry, AlphaFilter);
      rtcSetGeometryOccludedFilterFunction(geometry, AlphaFilter);
    }
    rtcCommitGeometry(geometry);
    rtcAttachGeometry(impl.scene, geometry);
    rtcReleaseGeometry(geometry);
  }
  rtcCommitScene(impl.scene);
  rtcSetDeviceErrorFunction(impl.device, nullptr, nullptr);
  if (!error_text.empty()) return absl::UnavailableError(error_text);
  return std::shared_ptr<const RayAccel>(std::move(accel));
}

std::optional<RayHit> RayAccel::Intersect(const Vec3f& origin, const Vec3f& direction,
                                          float t_max) const {
  const FpTrapPause pause;
  if (record_ != nullptr) [[unlikely]]
    record_->push_back({origin, direction, t_max, false});
  RTCRayHit query;
  FillRay(query.ray, origin, direction, t_max);
  query.hit.geomID = RTC_INVALID_GEOMETRY_ID;
  query.hit.instID[0] = RTC_INVALID_GEOMETRY_ID;
#if RTC_VERSION_MAJOR >= 4
  rtcIntersect1(impl_->scene, &query);
#else
  RTCIntersectContext context;
  rtcInitIntersectContext(&context);
  rtcIntersect1(impl_->scene, &context, &query);
#endif
  if (query.hit.geomID == RTC_INVALID_GEOMETRY_ID) return std::nullopt;
  return RayHit{query.ray.tfar, query.hit.primID, query.hit.u, query.hit.v};
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
      query.hit.geomID = RTC_INVALID_GEOMETRY_ID;
      query.hit.instID[0] = RTC_INVALID_GEOMETRY_ID;
#if RTC_VERSION_MAJOR >= 4
      rtcIntersect1(impl_->scene, &query);
#else
      rtcIntersect1(impl_->scene, &context, &query);
#endif
      hits += query.hit.geomID != RTC_INVALID_GEOMETRY_ID;
    }
  }
  return hits;
}

}  // namespace farpoint

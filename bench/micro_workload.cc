#include "bench/micro_workload.h"

#include <optional>
#include <utility>

#include "core/image/tile_rect.h"
#include "core/math/sampling.h"
#include "core/render/camera_rays.h"
#include "core/render/record_gatherer.h"
#include "core/scene/procedural.h"

namespace farpoint {

namespace {

constexpr uint64_t kSeed = 1;
constexpr uint32_t kRaysPerReceiver = 8;

// As core/render makes them.
CutView ViewOf(const Receiver& r) {
  CutView view;
  view.position = r.position;
  view.normal = r.normal;
  view.sees_inside = r.on_back;
  return view;
}

CutView ViewOf(const ReceiverCluster& c, const std::vector<Receiver>& receivers) {
  CutView view;
  view.position = receivers[c.active].position;
  view.normal = c.mean_normal;
  view.radius_m = c.radius_m;
  view.sin_spread = c.sin_spread;
  view.cos_spread = c.cos_spread;
  view.margin_m = c.margin_m;
  view.sees_inside = c.sees_inside;
  return view;
}

void TraceBlock(const Camera& camera, int side, MicroWorkload& work) {
  const FilmSpec film{side, side, {0, 0, side, side}};
  const CameraRays rays(camera, film, work.scene->origin());
  const int first = side / kBlockSize / 2 * kBlockSize;
  for (int y = first; y < first + kBlockSize; ++y) {
    for (int x = first; x < first + kBlockSize; ++x) {
      const Vec3f w = rays.Direction(x + 0.5, y + 0.5);
      work.coherent.push_back({rays.eye(), w});
      const std::optional<RayHit> hit = work.accel->Intersect(rays.eye(), w);
      if (!hit) continue;
      work.receivers.push_back(ReceiverOfHit(*work.accel, *hit, w));
    }
  }
}

void ScatterRays(MicroWorkload& work) {
  for (size_t i = 0; i < work.receivers.size(); ++i) {
    const Receiver& r = work.receivers[i];
    const Frame frame(r.normal);
    const uint32_t seed = static_cast<uint32_t>(HashKey(kSeed, i));
    for (uint32_t s = 0; s < kRaysPerReceiver; ++s) {
      const Vec3f local = CosineHemisphere(OwenSobol(s, 0, seed), OwenSobol(s, 1, seed));
      work.incoherent.push_back({r.Leave(), frame.ToWorld(local)});
    }
  }
}

void MakeViews(MicroWorkload& work) {
  for (const Receiver& r : work.receivers) work.receiver_views.push_back(ViewOf(r));
  std::vector<CutNode> far;
  std::vector<NearNode> near;
  CutCounters counters;
  for (const ReceiverCluster& c : ClusterReceivers(work.receivers, work.cluster_params)) {
    if (c.members.size() < 2) continue;
    ClusterViews& views = work.cluster_views.emplace_back();
    views.view = ViewOf(c, work.receivers);
    far.clear();
    near.clear();
    ComputeClusterCut(*work.tree, views.view, work.cut_params(BufferMap::kOctahedral), far, &near,
                      counters);
    views.near.Pack(*work.tree, near);
    for (const uint32_t r : c.members) views.members.push_back(work.receiver_views[r]);
  }
}

}  // namespace

absl::StatusOr<std::unique_ptr<MicroWorkload>> MicroWorkload::Make(bool quick) {
  auto work = std::make_unique<MicroWorkload>();
  work->quick = quick;
  work->description = MakeCornellBox();
  const Scene& scene = work->description;
  FP_ASSIGN_OR_RETURN(work->scene, PreparedScene::Prepare(scene, work->executor));
  FP_ASSIGN_OR_RETURN(work->accel, RayAccel::Build(work->scene));
  work->lights = std::make_unique<LightSampler>(work->accel);
  work->surfel_count = quick ? 5'000 : 100'000;
  work->shade.seed = kSeed;
  work->cloud = SampleSurfels(scene, *work->scene, work->surfel_count, kSeed, work->executor);
  Stats stats;
  work->open_sides = FindOpenSides(work->cloud, *work->accel, kSeed, work->executor, stats);
  work->shading = ShadeSurfels(work->cloud, work->open_sides, *work->accel, *work->lights,
                               work->shade, work->executor, stats);
  work->blobs = PointTree::Build(work->cloud, work->shading, work->executor);
  FP_ASSIGN_OR_RETURN(work->tree, PointTree::FromBlobs(work->blobs.topology, work->blobs.radiance));
  TraceBlock(scene.cameras.front(), quick ? 64 : 256, *work);
  work->cluster_params.seed_key = kSeed;
  MakeViews(*work);
  ScatterRays(*work);
  if (work->receivers.empty() || work->cluster_views.empty() || !work->tree->lit()) {
    return absl::InternalError("the Cornell box gave no receivers, clusters or light");
  }
  return work;
}

}  // namespace farpoint

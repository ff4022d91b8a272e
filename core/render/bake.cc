#include "core/render/bake.h"

#include <algorithm>
#include <chrono>
#include <memory>
#include <span>
#include <string_view>
#include <vector>

#include "core/accel/ray_accel.h"
#include "core/base/clock.h"
#include "core/light/light_sampler.h"
#include "core/pbgi/point_tree.h"
#include "core/pbgi/surfel_bounces.h"
#include "core/pbgi/surfel_sampler.h"
#include "core/pbgi/surfel_shader.h"
#include "core/scene/prepared_scene.h"

namespace farpoint {

namespace {

// Wall seconds of a stage; its thread-seconds are bounded by wall × threads and reported as the
// process's processor time over the stage.
class StageTimer {
 public:
  StageTimer(Stats& stats, Stage stage)
      : stats_(stats),
        stage_(static_cast<int>(stage)),
        wall_(std::chrono::steady_clock::now()),
        cpu_(ProcessCpuSeconds()) {}
  ~StageTimer() {
    stats_.wall_seconds[stage_] +=
        std::chrono::duration<double>(std::chrono::steady_clock::now() - wall_).count();
    stats_.seconds[stage_] += ProcessCpuSeconds() - cpu_;
  }

 private:
  Stats& stats_;
  int stage_;
  std::chrono::steady_clock::time_point wall_;
  double cpu_;
};

// A tree's topology with what shading anew needs of it.
struct BakedTopology {
  PointTree::Topology topology;
  SurfelSides open_sides;

  uint64_t size_bytes() const {
    return topology.blob.size() + topology.order.size() * sizeof(uint32_t) + open_sides.size();
  }
};

struct BakedRadiance {
  Blob blob;
  uint64_t surfels = 0;
};

template <typename T>
void HashArray(Sha256& hash, std::span<const T> values) {
  hash.UpdateU64(values.size());
  hash.Update(std::as_bytes(values));
}
void HashDigest(Sha256& hash, const Digest& digest) {
  hash.Update(std::as_bytes(std::span(digest.bytes)));
}

// All that decides which triangle, if any, a ray meets, and by which keys surfels seed theirs.
Digest GeometryKey(const Scene& scene, const PreparedScene& prepared) {
  Sha256 hash;
  hash.Update("geometry");
  HashArray(hash, prepared.vertices());
  HashArray(hash, prepared.triangles());
  bool masked = false;
  for (size_t o = 0; o < prepared.objects().size(); ++o) {
    const PreparedObject& object = prepared.objects()[o];
    hash.UpdateU64(object.first_triangle).UpdateU64(object.content_key);
    const PreparedMaterial& material = prepared.materials()[object.material];
    if (material.alpha_cutoff < 0) continue;
    masked = true;
    HashArray(hash, std::span(&material.alpha_cutoff, 1));
    HashArray(hash, std::span(&material.base_alpha, 1));
    hash.UpdateU32(material.base_color_uv_set);
    HashArray(hash, std::span<const float>(material.base_color_uv));
    if (material.base_color_texture < 0) continue;
    const PreparedTexture& t =
        prepared.textures()[static_cast<size_t>(material.base_color_texture)];
    hash.UpdateU32(t.wrap_s).UpdateU32(t.wrap_t).UpdateU32(t.nearest);
    // The texels by the file that they are decoded from.
    const Mesh& mesh = scene.meshes[scene.instances[prepared.object_instances()[o]].mesh];
    const TextureRef& ref = scene.materials[static_cast<size_t>(mesh.material)].base_color_texture;
    HashArray(hash, scene.textures[static_cast<size_t>(ref.texture)].encoded.bytes());
  }
  if (masked) {
    for (unsigned set = 0; set < 2; ++set) HashArray(hash, prepared.uvs(set));
  }
  return hash.Finish();
}

float SpacingFor(const RenderSettings& settings, const SurfaceSize& size,
                 const PreparedScene& prepared) {
  if (settings.points != 0) return SurfelSpacingM(size, settings.points);
  // Where light is soft and faces are large, light is smooth. A map may hold a sun.
  constexpr uint64_t kMostPerTriangle = 64;
  constexpr uint64_t kLeast = 100'000, kLeastOfSoftRays = 20'000;
  if (!prepared.lights().empty() || prepared.has_environment_map()) {
    return DefaultSurfelSpacingM(size, prepared.diagonal_m(), kLeast, ~uint64_t{0});
  }
  // Rays shade what lies nearer than two spacings; a cut has nothing but the surfels.
  const uint64_t least = settings.reads_surfels_by_rays() ? kLeastOfSoftRays : kLeast;
  return DefaultSurfelSpacingM(size, prepared.diagonal_m(), least,
                               kMostPerTriangle * prepared.triangles().size());
}

PrepareOptions PrepareOptionsOf(const RenderSettings& settings) {
  PrepareOptions options;
  options.all_textures = !settings.skips(kSkipTextures);
  options.gloss = settings.materials == Materials::kGltf;
  return options;
}

// The stages after the prepared scene.
class TreeBake {
 public:
  TreeBake(const Scene& scene, std::shared_ptr<const PreparedScene> prepared,
           const RenderSettings& settings, const BakeOptions& options, Executor& executor,
           Stats& stats)
      : scene_(scene),
        prepared_(std::move(prepared)),
        settings_(settings),
        options_(options),
        cache_(settings.skips(kSkipBakeStages) ? options.cache : nullptr),
        executor_(executor),
        stats_(stats) {}

  absl::Status Run(BakedScene& baked) {
    FindKeys();
    std::shared_ptr<const BakedTopology> topology;
    std::shared_ptr<const BakedRadiance> radiance;
    if (cache_ != nullptr) {
      topology = cache_->Find<BakedTopology>(topology_key_);
      radiance = cache_->Find<BakedRadiance>(radiance_key_);
    }
    if (topology != nullptr && radiance != nullptr) {
      stats_.skipped["bake_stages"] += 3;
      stats_.skipped["objects_kept"] += shapes_.size();
      stats_.skipped["surfels_kept"] += radiance->surfels;
      stats_.skipped["surfels_shaded_kept"] += radiance->surfels;
    } else {
      FP_RETURN_IF_ERROR(Build(topology, radiance));
    }
    baked.tree_topology = topology->topology.blob;
    baked.tree_radiance = radiance->blob;
    stats_.counts["surfels"] = radiance->surfels;
    stats_.counts["nodes"] = PointTree::NodeCount(radiance->surfels);
    stats_.bytes["tree"] = baked.tree_topology.size() + baked.tree_radiance.size();
    return absl::OkStatus();
  }

 private:
  absl::Status CheckNotStopped() const {
    if (options_.cancel != nullptr && options_.cancel->load()) {
      return absl::CancelledError("the bake was stopped");
    }
    return absl::OkStatus();
  }

  void FindKeys() {
    StageTimer timer(stats_, Stage::kSample);
    shapes_ = MakeObjectShapes(scene_, *prepared_, executor_);
    repeated_ = RepeatedObjects(*prepared_, executor_);
    for (const uint8_t r : repeated_) stats_.skipped["objects_repeated"] += r;
    spacing_m_ = options_.surfel_spacing_m > 0
                     ? options_.surfel_spacing_m
                     : SpacingFor(settings_, SizeOf(shapes_, repeated_), *prepared_);
    if (spacing_m_ > 0) {
      samplers_.resize(shapes_.size());
      executor_.ForEach(shapes_.size(), 1, [&](size_t i) {
        if (repeated_[i] != 0) return;
        samplers_[i] = std::make_unique<ObjectSampler>(shapes_[i], *prepared_, i, spacing_m_,
                                                       settings_.seed, executor_);
      });
    }
    if (cache_ == nullptr) return;
    Sha256 topology;
    topology.Update("topology").UpdateU64(settings_.seed).UpdateU64(samplers_.size());
    for (const auto& sampler : samplers_) HashDigest(topology, sampler ? sampler->key() : Digest());
    HashDigest(topology, GeometryKey(scene_, *prepared_));
    topology_key_ = topology.Finish();
    Sha256 radiance;
    radiance.Update("radiance").UpdateU64(settings_.seed).UpdateU32(settings_.light_samples);
    radiance.UpdateU32(settings_.bounces);
    HashDigest(radiance, topology_key_);
    HashDigest(radiance, prepared_->blob().Hash());
    radiance_key_ = radiance.Finish();
  }

  absl::Status Build(std::shared_ptr<const BakedTopology>& topology,
                     std::shared_ptr<const BakedRadiance>& radiance) {
    FP_RETURN_IF_ERROR(CheckNotStopped());
    std::shared_ptr<const RayAccel> accel;
    std::unique_ptr<const LightSampler> lights;
    {
      StageTimer timer(stats_, Stage::kImport);
      FP_ASSIGN_OR_RETURN(accel, RayAccel::Build(prepared_));
      lights = std::make_unique<const LightSampler>(accel);
    }
    SurfelCloud cloud;
    const bool lit = lights->any_light() || !settings_.skips(kSkipUnlit);
    if (lit) {
      StageTimer timer(stats_, Stage::kSample);
      cloud = Sample();
    } else {
      ++stats_.skipped["bakes_without_light"];
      topology = nullptr;
    }
    FP_RETURN_IF_ERROR(CheckNotStopped());

    if (topology == nullptr) {
      auto built = std::make_shared<BakedTopology>();
      {
        StageTimer timer(stats_, Stage::kShade);
        built->open_sides = FindOpenSides(cloud, *accel, settings_.seed, executor_, stats_);
      }
      FP_RETURN_IF_ERROR(CheckNotStopped());
      StageTimer timer(stats_, Stage::kTree);
      built->topology = PointTree::BuildTopology(cloud, built->open_sides, executor_);
      topology = std::move(built);
      // A tree without surfels is that of a scene without light, not that of its geometry.
      if (cache_ != nullptr && lit) cache_->Put(topology_key_, topology, topology->size_bytes());
    } else {
      ++stats_.skipped["bake_stages"];
    }
    FP_RETURN_IF_ERROR(CheckNotStopped());

    SurfelShading shading;
    {
      StageTimer timer(stats_, Stage::kShade);
      ShadeOptions options;
      options.light_samples = settings_.light_samples;
      options.seed = settings_.seed;
      options.skip_black = settings_.skips(kSkipBlack);
      options.needless = NeedlessLightOf(settings_);
      shading =
          ShadeSurfels(cloud, topology->open_sides, *accel, *lights, options, executor_, stats_);
    }
    if (settings_.bounces > 1 && cloud.size() > 0) {
      FP_RETURN_IF_ERROR(CheckNotStopped());
      StageTimer timer(stats_, Stage::kShade);
      BounceOptions options;
      options.bounces = settings_.bounces;
      options.seed = settings_.seed;
      FP_RETURN_IF_ERROR(AddBounces(cloud, topology->open_sides, topology->topology, *accel,
                                    *lights, options, executor_, shading, stats_));
    }
    FP_RETURN_IF_ERROR(CheckNotStopped());
    StageTimer timer(stats_, Stage::kTree);
    auto built = std::make_shared<BakedRadiance>();
    built->surfels = cloud.size();
    built->blob = PointTree::BuildRadiance(topology->topology, cloud, topology->open_sides, shading,
                                           executor_);
    radiance = std::move(built);
    if (cache_ != nullptr && lit) cache_->Put(radiance_key_, radiance, radiance->blob.size());
    return absl::OkStatus();
  }

  SurfelCloud Sample() {
    if (samplers_.empty()) return {};
    std::vector<std::shared_ptr<const ObjectSurfels>> surfels(samplers_.size());
    std::vector<uint8_t> kept(samplers_.size(), 0);
    executor_.ForEach(samplers_.size(), 1, [&](size_t i) {
      if (!samplers_[i]) {
        surfels[i] = std::make_shared<const ObjectSurfels>();
        return;
      }
      const Digest& key = samplers_[i]->key();
      if (cache_ != nullptr) surfels[i] = cache_->Find<ObjectSurfels>(key);
      kept[i] = surfels[i] != nullptr;
      if (surfels[i] == nullptr) {
        surfels[i] = std::make_shared<const ObjectSurfels>(samplers_[i]->Sample());
        if (cache_ != nullptr) cache_->Put(key, surfels[i], surfels[i]->size_bytes());
      }
      samplers_[i].reset();
    });
    uint64_t objects = 0, kept_surfels = 0;
    for (size_t i = 0; i < kept.size(); ++i) {
      objects += kept[i];
      if (kept[i] != 0) kept_surfels += surfels[i]->size();
    }
    if (objects > 0) {
      stats_.skipped["objects_kept"] += objects;
      stats_.skipped["surfels_kept"] += kept_surfels;
      const auto repeated = std::count(repeated_.begin(), repeated_.end(), uint8_t{1});
      if (objects + static_cast<uint64_t>(repeated) == kept.size()) {
        ++stats_.skipped["bake_stages"];
      }
    }
    return PlaceSurfels(*prepared_, shapes_, surfels, executor_);
  }

  const Scene& scene_;
  const std::shared_ptr<const PreparedScene> prepared_;
  const RenderSettings& settings_;
  const BakeOptions& options_;
  BakeCache* const cache_;
  Executor& executor_;
  Stats& stats_;

  std::vector<ObjectShape> shapes_;
  std::vector<uint8_t> repeated_;  // by object
  float spacing_m_ = 0;
  std::vector<std::unique_ptr<ObjectSampler>> samplers_;  // by object; none for what has none
  Digest topology_key_, radiance_key_;
};

}  // namespace

absl::StatusOr<BakedScene> Bake(const Scene& scene, const RenderSettings& settings,
                                Executor& executor, Stats& stats, const BakeOptions& options) {
  FP_RETURN_IF_ERROR(ValidateSettings(settings));
  BakedScene baked;
  std::shared_ptr<const PreparedScene> prepared;
  {
    StageTimer timer(stats, Stage::kImport);
    FP_ASSIGN_OR_RETURN(prepared,
                        PreparedScene::Prepare(scene, executor, PrepareOptionsOf(settings)));
    baked.prepared_scene = prepared->blob();
  }
  stats.skipped["textures"] += prepared->skipped_textures();
  stats.counts["triangles"] = prepared->triangles().size();
  stats.bytes["scene"] = baked.prepared_scene.size();
  if (!settings.point_based()) return baked;
  FP_RETURN_IF_ERROR(
      TreeBake(scene, std::move(prepared), settings, options, executor, stats).Run(baked));
  return baked;
}

absl::StatusOr<float> SurfelSpacing(const Scene& scene, const RenderSettings& settings,
                                    Executor& executor) {
  FP_ASSIGN_OR_RETURN(const auto prepared,
                      PreparedScene::Prepare(scene, executor, PrepareOptionsOf(settings)));
  return SpacingFor(
      settings,
      SizeOf(MakeObjectShapes(scene, *prepared, executor), RepeatedObjects(*prepared, executor)),
      *prepared);
}

}  // namespace farpoint

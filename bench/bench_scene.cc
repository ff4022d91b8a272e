#include "bench/bench_scene.h"

#include <utility>

#include "core/math/elementary.h"
#include "core/scene/asset.h"
#include "core/scene/importer.h"
#include "core/scene/procedural.h"

namespace farpoint {

namespace {

constexpr unsigned kCityBlocks = 4, kSmallCityBlocks = 2;
constexpr uint64_t kCitySeed = 1;

absl::StatusOr<BenchScene> Load(const std::string& name_or_path, bool small,
                                const SceneChanges& changes) {
  if (name_or_path == "cornell") return BenchScene{MakeCornellBox(), {}};
  if (name_or_path == "furnace") return BenchScene{MakeFurnace(0.5f, 1.0f), {}};
  if (name_or_path == "city") {
    return BenchScene{MakeCity(small ? kSmallCityBlocks : kCityBlocks, kCitySeed), {}};
  }
  FP_ASSIGN_OR_RETURN(const AssetBundle asset, CollectAsset(name_or_path));
  FP_ASSIGN_OR_RETURN(ImportedScene imported, ImportScene(asset, ImportOptions()));
  // One that is chosen need not be made up.
  if (changes.view && imported.scene.cameras.empty()) imported.scene.cameras.resize(1);
  EnsureCameraAndLight(imported, changes.sun.has_value() || changes.sky.has_value());
  return BenchScene{std::move(imported.scene), std::move(imported.notes)};
}

constexpr double kDegree = kPi / 180.0;

}  // namespace

absl::StatusOr<Camera> CameraOf(const AccuracyView& view) {
  const Vec3d forward = view.target - view.eye;
  const Vec3d right = Cross(forward, Vec3d(0, 1, 0));
  if (!(Length2(right) > 0.0)) {
    return absl::InvalidArgumentError("the camera looks straight up or down, or at itself");
  }
  Camera camera;
  camera.eye = view.eye;
  camera.forward = Normalize(forward);
  camera.right = Normalize(right);
  camera.up = Cross(camera.right, camera.forward);
  camera.yfov_rad = view.yfov_deg * kDegree;
  return camera;
}

absl::StatusOr<BenchScene> MakeBenchScene(const std::string& name_or_path, bool small,
                                          const SceneChanges& changes) {
  FP_ASSIGN_OR_RETURN(BenchScene made, Load(name_or_path, small, changes));
  Scene& scene = made.scene;
  if (changes.sun) {
    PunctualLight sun;
    sun.name = "sun 0";
    sun.kind = PunctualKind::kDirectional;
    sun.direction = -NormalizeOr(changes.sun->to_sun, Vec3d(0, 1, 0));
    sun.intensity = changes.sun->irradiance;
    scene.lights = {std::move(sun)};
  }
  if (changes.sky) scene.environment.sky = *changes.sky;
  if (changes.view) {
    FP_ASSIGN_OR_RETURN(const Camera camera, CameraOf(*changes.view));
    scene.cameras = {camera};
  }
  return made;
}

}  // namespace farpoint

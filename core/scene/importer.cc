#include "core/scene/importer.h"

#include <algorithm>
#include <cmath>

#include "core/math/elementary.h"
#include "core/scene/gltf_importer.h"
#include "core/scene/obj_importer.h"
#include "core/scene/ply_importer.h"
#include "core/scene/scene_format.h"

namespace farpoint {

namespace {

Box3d WorldBounds(const Scene& scene) {
  Box3d bounds;
  for (const Instance& instance : scene.instances) {
    const Mesh& mesh = scene.meshes[instance.mesh];
    for (const auto& triangle : mesh.triangles) {
      for (const uint32_t v : triangle) {
        bounds.Extend(instance.world_from_mesh.Point(Vec3d(mesh.positions[v])));
      }
    }
  }
  return bounds;
}

bool HasTriangles(const Scene& scene) {
  return std::any_of(scene.instances.begin(), scene.instances.end(), [&](const Instance& instance) {
    return !scene.meshes[instance.mesh].triangles.empty();
  });
}

bool IsLit(const Scene& scene) {
  if (MaxComponent(scene.environment.sky) > 0) return true;
  for (const Rgb& texel : scene.environment.map) {
    if (MaxComponent(texel) > 0) return true;
  }
  for (const PunctualLight& light : scene.lights) {
    if (MaxComponent(light.intensity) > 0) return true;
  }
  for (const Instance& instance : scene.instances) {
    const int32_t material = scene.meshes[instance.mesh].material;
    if (material >= 0 && MaxComponent(scene.materials[material].emission) > 0) return true;
  }
  return false;
}

// Looks from the upper right front at the centre, far enough to see the bounding sphere.
Camera FramingCamera(const Box3d& bounds) {
  Camera camera;
  camera.name = "framing";
  const Vec3d center = bounds.empty() ? Vec3d() : bounds.Center();
  const double diagonal = bounds.Diagonal();
  const double radius = diagonal > 0 ? 0.5 * diagonal : 1.0;
  const Vec3d from_center = Normalize(Vec3d(0.6, 0.45, 1.0));
  camera.forward = -from_center;
  camera.right = Normalize(Cross(camera.forward, Vec3d(0, 1, 0)));
  camera.up = Cross(camera.right, camera.forward);
  camera.eye = center + from_center * (radius / DetSinCos(0.5 * camera.yfov_rad).sin);
  return camera;
}

}  // namespace

absl::StatusOr<ImportedScene> ImportScene(const AssetBundle& asset, const ImportOptions& options) {
  FP_ASSIGN_OR_RETURN(const SceneFormat format, SceneFormatOf(asset.root));
  switch (format) {
    case SceneFormat::kGltf:
      return ImportGltf(asset, options);
    case SceneFormat::kObj:
      return ImportObj(asset, options);
    case SceneFormat::kPly:
      return ImportPly(asset, options);
  }
  return absl::InternalError("unknown scene format");
}

absl::StatusOr<std::optional<TimeRange>> FindAnimation(const AssetBundle& asset) {
  FP_ASSIGN_OR_RETURN(const SceneFormat format, SceneFormatOf(asset.root));
  if (format != SceneFormat::kGltf) return std::optional<TimeRange>();
  return FindGltfAnimation(asset);
}

void EnsureCameraAndLight(ImportedScene& imported, bool light_chosen) {
  Scene& scene = imported.scene;
  if (!HasTriangles(scene)) {
    imported.notes.push_back("the scene has no triangles: the image shows its background only");
  }
  if (scene.cameras.empty()) {
    scene.cameras.push_back(FramingCamera(WorldBounds(scene)));
    imported.notes.push_back(
        "no camera: one was placed that frames the whole scene; choose your "
        "own with --eye, --target and --fov");
  }
  if (!light_chosen && !IsLit(scene)) {
    PunctualLight sun;
    sun.name = "sun";
    sun.kind = PunctualKind::kDirectional;
    sun.direction = Normalize(Vec3d(-0.35, -0.85, -0.4));
    sun.intensity = {2.8f, 2.6f, 2.3f};
    scene.lights.push_back(sun);
    scene.environment.sky = {0.28f, 0.34f, 0.45f};
    imported.notes.push_back(
        "no light: a sun and a sky were added; choose your own with --sun "
        "and --sky");
  }
}

void NoteHiddenGloss(ImportedScene& imported) {
  const auto glossy =
      std::count_if(imported.scene.materials.begin(), imported.scene.materials.end(),
                    [](const Material& m) { return m.metallic > 0 || m.roughness < 1; });
  if (glossy == 0) return;
  imported.notes.push_back(std::to_string(glossy) +
                           (glossy == 1 ? " material is" : " materials are") +
                           " metallic or glossy and shown as Lambert with the base colour; "
                           "--materials gltf shows gloss");
}

}  // namespace farpoint

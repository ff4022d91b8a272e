// Where a benchmark's scene comes from.
#pragma once

#include <optional>
#include <string>
#include <vector>

#include "core/base/status.h"
#include "core/scene/scene.h"

namespace farpoint {

struct AccuracySun {
  Vec3d to_sun;    // towards the sun, any length > 0
  Rgb irradiance;  // on a facing surface, W/m²
};

// A free camera, as by --eye, --target and --fov of `farpoint render`; up is +y.
struct AccuracyView {
  Vec3d eye, target;  // world, metres
  double yfov_deg = 0;
};

// +y is up; `view` is checked: eye and target differ, not above each other.
absl::StatusOr<Camera> CameraOf(const AccuracyView& view);

struct BenchScene {
  Scene scene;
  // What a user should know, one line each (core/scene/importer.h).
  std::vector<std::string> notes;
};

// In place of what the scene has, own scenes included.
struct SceneChanges {
  std::optional<AccuracySun> sun;    // of its punctual lights
  std::optional<Rgb> sky;            // W/(m² sr)
  std::optional<AccuracyView> view;  // of its camera
};

// "cornell", "city" (four blocks by four, two by two if `small`) and "furnace" (reflectance 0.5,
// radiance 1) are the project's own scenes and always the same; everything else is a glTF file. The
// scene has a camera and a light. Errors are those of CollectAsset and ImportScene.
absl::StatusOr<BenchScene> MakeBenchScene(const std::string& name_or_path, bool small,
                                          const SceneChanges& changes = {});

}  // namespace farpoint

// From the files of an asset to a Scene.
#pragma once

#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include "core/base/status.h"
#include "core/scene/asset.h"
#include "core/scene/scene.h"

namespace farpoint {

enum class LightUnits { kPhotometric, kRaw };

struct ImportOptions {
  // glTF's punctual lights are photometric (lux, candela): divided by 683 lm/W. kRaw takes the
  // numbers as radiometric.
  LightUnits light_units = LightUnits::kPhotometric;
  uint64_t max_triangles = 200'000'000;  // after instancing
  // Nothing: the rest pose. Else all animations of the file, played together, each at this time or
  // at the end of its keyframes that is nearest.
  std::optional<double> time_s;
  // Reads also the textures that only gloss needs: of metal and roughness, and normal maps.
  bool gloss = false;
};

// Of keyframes, in seconds; begin_s <= end_s.
struct TimeRange {
  double begin_s = 0, end_s = 0;
  bool operator==(const TimeRange&) const = default;
};

struct ImportedScene {
  Scene scene;
  // What a user should know, one line each: what was ignored or made up ("no camera: …").
  std::vector<std::string> notes;
  // From the first to the last keyframe of the file's animations, whatever time was asked for;
  // nothing if it has none.
  std::optional<TimeRange> animation;
};

// Reads asset.files[asset.root] by its extension (.gltf, .glb, .obj, .ply); docs/formats.md says
// what of each is read. Every index, size and offset of
// the file is checked before use; every refusal is kInvalidArgument (or kNotFound, kUnimplemented
// for an extension that the file requires) and names file, place (JSON path, line) and fix. Node
// transforms are accumulated in double precision. The scene is as in the file: no camera or light
// is made up here (see EnsureCameraAndLight).
absl::StatusOr<ImportedScene> ImportScene(const AssetBundle& asset, const ImportOptions& options);

// ImportedScene::animation without the scene: reads no meshes and no images, and only the JSON
// where there are no animations. Errors are those of ImportScene.
absl::StatusOr<std::optional<TimeRange>> FindAnimation(const AssetBundle& asset);

// Gives a scene without camera one that frames its bounding box, and a scene without any light
// (punctual, emissive, sky, map) a sun and a sky; a note for each. `light_chosen`: the user chose
// the light, and what is dark stays dark. A scene without triangles gets a note, too.
void EnsureCameraAndLight(ImportedScene& imported, bool light_chosen);

// Notes that materials of the scene are metallic or glossy, which is not shown. What only textures
// say is not looked at.
void NoteHiddenGloss(ImportedScene& imported);

}  // namespace farpoint

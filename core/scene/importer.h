// From the files of an asset to a Scene.
#pragma once

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
};

struct ImportedScene {
  Scene scene;
  // What a user should know, one line each: what was ignored or made up ("no camera: …").
  std::vector<std::string> notes;
};

// Reads asset.files[asset.root] by its extension (.gltf, .glb). Every index, size and offset of
// the file is checked before use; every refusal is kInvalidArgument (or kNotFound, kUnimplemented
// for an extension that the file requires) and names file, place (JSON path) and fix. Node
// transforms are accumulated in double precision. The scene is as in the file: no camera or light
// is made up here (see EnsureCameraAndLight).
absl::StatusOr<ImportedScene> ImportScene(const AssetBundle& asset, const ImportOptions& options);

// Gives a scene without camera one that frames its bounding box, and a scene without any light
// (punctual, emissive, sky) a sun and a sky; a note for each.
void EnsureCameraAndLight(ImportedScene& imported);

}  // namespace farpoint

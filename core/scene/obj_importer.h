// Wavefront OBJ with MTL to Scene. Called by ImportScene and CollectAsset; docs/formats.md says
// what is read.
#pragma once

#include <string>

#include "core/base/blob.h"
#include "core/base/status.h"
#include "core/scene/asset_source.h"
#include "core/scene/importer.h"

namespace farpoint {

absl::StatusOr<ImportedScene> ImportObj(const AssetBundle& asset, const ImportOptions& options);

// Reads from `source` what the OBJ file needs, which `name` names in messages: its material
// libraries, and the textures of the materials that it uses. Errors are those of
// ObjMaterials::Load.
absl::Status VisitObjReferences(const std::string& name, const Blob& file, AssetSource& source);

}  // namespace farpoint

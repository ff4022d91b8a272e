// glTF 2.0 to Scene. Called by ImportScene.
#pragma once

#include "core/base/status.h"
#include "core/scene/importer.h"

namespace farpoint {

absl::StatusOr<ImportedScene> ImportGltf(const AssetBundle& asset, const ImportOptions& options);

}  // namespace farpoint

// glTF 2.0 to Scene. Called by ImportScene.
#pragma once

#include <optional>

#include "core/base/status.h"
#include "core/scene/importer.h"

namespace farpoint {

absl::StatusOr<ImportedScene> ImportGltf(const AssetBundle& asset, const ImportOptions& options);

absl::StatusOr<std::optional<TimeRange>> FindGltfAnimation(const AssetBundle& asset);

}  // namespace farpoint

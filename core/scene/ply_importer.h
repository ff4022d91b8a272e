// Stanford PLY (ascii, binary of both byte orders) to Scene. Called by ImportScene;
// docs/formats.md says what is read.
#pragma once

#include "core/base/status.h"
#include "core/scene/importer.h"

namespace farpoint {

absl::StatusOr<ImportedScene> ImportPly(const AssetBundle& asset, const ImportOptions& options);

}  // namespace farpoint

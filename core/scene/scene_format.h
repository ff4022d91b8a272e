// Which reader a scene file belongs to.
#pragma once

#include <string>

#include "core/base/status.h"

namespace farpoint {

enum class SceneFormat { kGltf, kObj, kPly };  // kGltf: .gltf and .glb

// By the extension, in any case. kInvalidArgument names the file and the extensions that are known.
absl::StatusOr<SceneFormat> SceneFormatOf(const std::string& file_name);

}  // namespace farpoint

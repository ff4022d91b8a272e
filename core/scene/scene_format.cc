#include "core/scene/scene_format.h"

namespace farpoint {

absl::StatusOr<SceneFormat> SceneFormatOf(const std::string& file_name) {
  const size_t dot = file_name.find_last_of("./\\");
  std::string extension;
  if (dot != std::string::npos && file_name[dot] == '.') extension = file_name.substr(dot);
  for (char& c : extension) c = c >= 'A' && c <= 'Z' ? static_cast<char>(c - 'A' + 'a') : c;
  if (extension == ".gltf" || extension == ".glb") return SceneFormat::kGltf;
  if (extension == ".obj") return SceneFormat::kObj;
  if (extension == ".ply") return SceneFormat::kPly;
  return absl::InvalidArgumentError("'" + file_name + "' is not a scene that farpoint reads; it " +
                                    "reads .gltf, .glb, .obj and .ply: convert it to one of those");
}

}  // namespace farpoint

#include "core/scene/asset.h"

#include <filesystem>
#include <utility>
#include <vector>

#include "core/scene/gltf_check.h"
#include "core/scene/scene_format.h"

namespace farpoint {

namespace {

// A file that the main file refers to, and where.
struct Reference {
  std::string uri;
  std::string place;
};

absl::StatusOr<std::vector<Reference>> ListReferences(const std::string& root, const Blob& file) {
  FP_ASSIGN_OR_RETURN(const SceneFormat format, SceneFormatOf(root));
  std::vector<Reference> references;
  switch (format) {
    case SceneFormat::kGltf: {
      FP_ASSIGN_OR_RETURN(const GltfContainer container, OpenGltfContainer(root, file));
      FP_ASSIGN_OR_RETURN(auto list, ListGltfReferences(root, container));
      for (auto& r : list) references.push_back({std::move(r.uri), std::move(r.place)});
      break;
    }
  }
  return references;
}

}  // namespace

absl::StatusOr<Blob> AssetBundle::Find(const std::string& uri) const {
  const auto it = files.find(uri);
  if (it != files.end()) return it->second;
  return absl::NotFoundError("'" + uri + "', which '" + root +
                             "' refers to, is missing; put it beside '" + root + "'");
}

absl::StatusOr<AssetBundle> CollectAsset(const std::string& path) {
  const std::filesystem::path main_path(path);
  AssetBundle bundle;
  bundle.root = main_path.filename().string();
  FP_RETURN_IF_ERROR(SceneFormatOf(bundle.root).status());
  FP_ASSIGN_OR_RETURN(Blob main_file, ReadFile(path));
  FP_ASSIGN_OR_RETURN(const auto references, ListReferences(bundle.root, main_file));
  bundle.files.emplace(bundle.root, std::move(main_file));
  for (const Reference& reference : references) {
    if (bundle.files.count(reference.uri) != 0) continue;
    auto file = ReadFile((main_path.parent_path() / reference.uri).string());
    if (!file.ok()) {
      const absl::Status& status = file.status();
      return absl::Status(status.code(), path + ": " + reference.place + ": " +
                                             std::string(status.message()) +
                                             "; put the file beside the scene");
    }
    bundle.files.emplace(reference.uri, *std::move(file));
  }
  return bundle;
}

}  // namespace farpoint

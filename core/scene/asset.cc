#include "core/scene/asset.h"

#include <filesystem>
#include <system_error>
#include <utility>

#include "core/scene/asset_source.h"
#include "core/scene/gltf_check.h"
#include "core/scene/obj_importer.h"
#include "core/scene/scene_format.h"

namespace farpoint {

namespace {

// Files in a folder of this machine, kept as they are read.
class FolderSource : public AssetSource {
 public:
  FolderSource(std::filesystem::path folder, std::map<std::string, Blob>& files)
      : folder_(std::move(folder)), files_(files) {}

  bool Has(const std::string& uri) override {
    std::error_code error;
    return files_.count(uri) != 0 || std::filesystem::is_regular_file(folder_ / uri, error);
  }
  absl::StatusOr<Blob> Read(const std::string& uri) override {
    if (const auto it = files_.find(uri); it != files_.end()) return it->second;
    FP_ASSIGN_OR_RETURN(Blob blob, ReadFile((folder_ / uri).string()));
    files_.emplace(uri, blob);
    return blob;
  }

 private:
  std::filesystem::path folder_;
  std::map<std::string, Blob>& files_;
};

// Reads all that the main file refers to.
absl::Status ReadReferences(const std::string& path, const std::string& root, const Blob& file,
                            bool gloss, AssetSource& source) {
  FP_ASSIGN_OR_RETURN(const SceneFormat format, SceneFormatOf(root));
  switch (format) {
    case SceneFormat::kGltf: {
      FP_ASSIGN_OR_RETURN(const GltfContainer container, OpenGltfContainer(root, file));
      FP_ASSIGN_OR_RETURN(const auto references, ListGltfReferences(root, container, gloss));
      for (const GltfReference& reference : references) {
        const auto blob = source.Read(reference.uri);
        if (blob.ok()) continue;
        return absl::Status(blob.status().code(), path + ": " + reference.place + ": " +
                                                      std::string(blob.status().message()) +
                                                      "; put the file beside the scene");
      }
      return absl::OkStatus();
    }
    case SceneFormat::kObj:
      return VisitObjReferences(path, file, source);
    case SceneFormat::kPly:
      return absl::OkStatus();  // one file
  }
  return absl::InternalError("unknown scene format");
}

}  // namespace

absl::StatusOr<Blob> AssetBundle::Find(const std::string& uri) const {
  const auto it = files.find(uri);
  if (it != files.end()) return it->second;
  return absl::NotFoundError("'" + uri + "', which '" + root +
                             "' refers to, is missing; put it beside '" + root + "'");
}

absl::StatusOr<AssetBundle> CollectAsset(const std::string& path, bool gloss) {
  const std::filesystem::path main_path(path);
  AssetBundle bundle;
  bundle.root = main_path.filename().string();
  FP_RETURN_IF_ERROR(SceneFormatOf(bundle.root).status());
  FP_ASSIGN_OR_RETURN(const Blob main_file, ReadFile(path));
  bundle.files.emplace(bundle.root, main_file);
  FolderSource source(main_path.parent_path(), bundle.files);
  FP_RETURN_IF_ERROR(ReadReferences(path, bundle.root, main_file, gloss, source));
  return bundle;
}

}  // namespace farpoint

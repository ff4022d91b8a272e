// A scene's files as named blobs, so that what reads a scene never opens a path: the client
// collects them from its disk, a coordinator gets them from the wire.
#pragma once

#include <map>
#include <string>

#include "core/base/blob.h"
#include "core/base/status.h"

namespace farpoint {

struct AssetBundle {
  std::string root;                   // key of the main file in `files`, e.g. "scene.gltf"
  std::map<std::string, Blob> files;  // by URI, decoded, relative to the root's folder

  // The file named `uri`, or kNotFound naming the root, the URI and what to do.
  absl::StatusOr<Blob> Find(const std::string& uri) const;
};

// Reads the main file at `path` and the files that it needs, each relative to its folder: glTF's
// buffers and the images of base colours and emission, with `gloss` also those of metal, roughness
// and normals; OBJ's material libraries and the images of
// the materials that it uses. kNotFound names the missing file and who refers to it;
// kInvalidArgument for an unknown extension (names those known), for URIs with a scheme other than
// data:, and for malformed JSON and MTL with the line.
absl::StatusOr<AssetBundle> CollectAsset(const std::string& path, bool gloss = false);

}  // namespace farpoint

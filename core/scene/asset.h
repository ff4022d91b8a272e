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
  std::map<std::string, Blob> files;  // by the URI under which the main file names them, decoded

  // The file named `uri`, or kNotFound naming the root, the URI and what to do.
  absl::StatusOr<Blob> Find(const std::string& uri) const;
};

// Reads the main file at `path` and the files that it refers to (buffers, images), each relative
// to its folder. kNotFound names the missing file and who refers to it; kInvalidArgument for an
// unknown extension (names those known), for URIs with a scheme other than data:, and for
// malformed JSON with its line and column.
absl::StatusOr<AssetBundle> CollectAsset(const std::string& path);

}  // namespace farpoint

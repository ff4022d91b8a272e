// What stands between a glTF file of unknown origin and the library that reads it: the container
// is split, and everything that the importer will follow (types of fields, indices into arrays,
// offsets, counts, sizes) is checked on the JSON before anything else looks at it.
#pragma once

#include <cstddef>
#include <span>
#include <string>
#include <string_view>
#include <vector>

#include "core/base/blob.h"
#include "core/base/status.h"
#include "core/scene/asset.h"

namespace farpoint {

// Views into the main file.
struct GltfContainer {
  bool binary = false;  // .glb
  std::string_view json;
  std::span<const std::byte> bin;  // the BIN chunk of a .glb, else empty
};

// Splits a .glb by its chunks; a .gltf is JSON as a whole. `name` stands in the messages.
// kInvalidArgument or kDataLoss say which header field is wrong.
absl::StatusOr<GltfContainer> OpenGltfContainer(const std::string& name, const Blob& file);

// A file that the main file needs, and where it says so.
struct GltfReference {
  std::string uri;    // decoded, relative
  std::string place;  // JSON path, "/buffers/0/uri"
};

// The external files that are needed: all buffers, and the images that a base colour or emission
// uses, with `gloss` also those of metal, roughness and normals. kInvalidArgument for malformed
// JSON (line, column) and for URIs that are absolute, leave the scene's folder or have a scheme
// other than data:.
absl::StatusOr<std::vector<GltfReference>> ListGltfReferences(const std::string& name,
                                                              const GltfContainer& container,
                                                              bool gloss = false);

// A buffer in a file of its own: its URI as it is written, and how many of its bytes count.
struct GltfBufferFile {
  std::string uri;
  size_t byte_length = 0;
};

// OK if every field that the importer reads has its type and range, every index its target, every
// buffer its bytes in `asset`, and every view and accessor lies inside of what it views. What is
// left to the importer: the values in the buffers (indices, positions) and the graph of the nodes.
// kUnimplemented names a required extension that is not supported. Returns the buffers that have
// files of their own.
absl::StatusOr<std::vector<GltfBufferFile>> CheckGltf(const AssetBundle& asset,
                                                      const GltfContainer& container);

// Percent-decoding (RFC 3986); "%" without two hexadecimal digits stays as it is.
std::string DecodeUri(std::string_view uri);

// True for "data:" URIs.
bool IsDataUri(std::string_view uri);

}  // namespace farpoint

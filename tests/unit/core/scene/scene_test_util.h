// Tiny glTF files and images for the tests of core/scene.
#pragma once

#include <gtest/gtest.h>

#include <cstring>
#include <nlohmann/json.hpp>
#include <string>
#include <vector>

#include "core/base/blob.h"
#include "core/scene/asset.h"
#include "core/scene/importer.h"

namespace farpoint {

// A document and its one buffer, "scene.bin".
struct TinyGltf {
  nlohmann::json json;
  std::vector<std::byte> bin;

  // Appends values at a multiple of 4 and returns the index of a new bufferView on them.
  template <typename T>
  size_t View(const std::vector<T>& values) {
    bin.resize((bin.size() + 3) / 4 * 4);
    const size_t at = bin.size(), size = values.size() * sizeof(T);
    bin.resize(at + size);
    std::memcpy(bin.data() + at, values.data(), size);
    json["bufferViews"].push_back({{"buffer", 0}, {"byteOffset", at}, {"byteLength", size}});
    return json["bufferViews"].size() - 1;
  }
  template <typename T>
  size_t Accessor(const std::vector<T>& values, int component_type, const char* type,
                  size_t components) {
    json["accessors"].push_back({{"bufferView", View(values)},
                                 {"componentType", component_type},
                                 {"count", values.size() / components},
                                 {"type", type}});
    return json["accessors"].size() - 1;
  }
  AssetBundle Asset() const {
    nlohmann::json full = json;
    full["buffers"] = {{{"byteLength", bin.size()}, {"uri", "scene.bin"}}};
    return {"scene.gltf",
            {{"scene.gltf", Blob::FromString(full.dump())}, {"scene.bin", Blob::FromVector(bin)}}};
  }
  absl::StatusOr<ImportedScene> Import(const ImportOptions& options = {}) const {
    return ImportScene(Asset(), options);
  }
};

// One triangle (0,0,0), (1,0,0), (0,1,0) in one node.
inline TinyGltf TriangleGltf() {
  TinyGltf gltf;
  gltf.json = {{"asset", {{"version", "2.0"}}},
               {"scene", 0},
               {"scenes", {{{"nodes", {0}}}}},
               {"nodes", {{{"mesh", 0}}}}};
  const size_t positions = gltf.Accessor<float>({0, 0, 0, 1, 0, 0, 0, 1, 0}, 5126, "VEC3", 3);
  const size_t indices = gltf.Accessor<uint16_t>({0, 1, 2}, 5123, "SCALAR", 1);
  nlohmann::json primitive;
  primitive["attributes"]["POSITION"] = positions;
  primitive["indices"] = indices;
  nlohmann::json mesh;
  mesh["primitives"] = nlohmann::json::array({primitive});
  gltf.json["meshes"] = nlohmann::json::array({mesh});
  return gltf;
}

inline nlohmann::json& Primitive(TinyGltf& gltf) { return gltf.json["meshes"][0]["primitives"][0]; }

// An RGBA8 PNG, rows from the top, in stored deflate blocks. `declared_*` lie about the size.
std::string MakePng(uint32_t width, uint32_t height, const std::vector<uint8_t>& rgba,
                    uint32_t declared_width = 0, uint32_t declared_height = 0);

// Standard base64 with padding.
std::string Base64(const std::string& bytes);

}  // namespace farpoint

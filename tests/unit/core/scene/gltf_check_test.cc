#include "core/scene/gltf_check.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "core/base/executor.h"
#include "core/math/sampling.h"
#include "core/scene/prepared_scene.h"
#include "tests/unit/core/scene/scene_test_util.h"

namespace farpoint {
namespace {

using ::testing::AllOf;
using ::testing::HasSubstr;
using Json = nlohmann::json;

// A file with one of everything that the importer follows.
TinyGltf FullGltf() {
  TinyGltf gltf = TriangleGltf();
  Json& attributes = Primitive(gltf)["attributes"];
  attributes["TEXCOORD_0"] = gltf.Accessor<float>({0, 0, 1, 0, 0, 1}, 5126, "VEC2", 2);
  attributes["NORMAL"] = gltf.Accessor<float>({0, 0, 1, 0, 0, 1, 0, 0, 1}, 5126, "VEC3", 3);
  const auto sparse_indices = gltf.View<uint16_t>({1});
  const auto sparse_values = gltf.View<float>({2, 0, 0});
  gltf.json["accessors"][0]["sparse"] = {
      {"count", 1},
      {"indices", {{"bufferView", sparse_indices}, {"componentType", 5123}, {"byteOffset", 0}}},
      {"values", {{"bufferView", sparse_values}, {"byteOffset", 0}}}};
  const std::string png = MakePng(2, 1, {255, 0, 0, 255, 0, 255, 0, 100});
  const auto image_view = gltf.View(std::vector<char>(png.begin(), png.end()));
  gltf.json["images"] = {{{"bufferView", image_view}, {"mimeType", "image/png"}},
                         {{"uri", "data:image/png;base64," + Base64(png)}}};
  gltf.json["samplers"] = {{{"wrapS", 33071}, {"magFilter", 9729}}};
  gltf.json["textures"] = {{{"source", 0}, {"sampler", 0}}, {{"source", 1}}};
  Json material = {{"name", "m"},
                   {"alphaMode", "MASK"},
                   {"alphaCutoff", 0.5},
                   {"emissiveFactor", {1, 1, 1}},
                   {"emissiveTexture", {{"index", 1}}}};
  material["pbrMetallicRoughness"] = {{"baseColorFactor", {1, 1, 1, 1}}};
  material["pbrMetallicRoughness"]["baseColorTexture"] = {{"index", 0}, {"texCoord", 0}};
  material["pbrMetallicRoughness"]["baseColorTexture"]["extensions"]["KHR_texture_transform"] = {
      {"offset", {0, 0}}, {"scale", {1, 1}}, {"rotation", 0.5}};
  material["extensions"]["KHR_materials_emissive_strength"]["emissiveStrength"] = 2.5;
  gltf.json["materials"] = Json::array({material});
  Primitive(gltf)["material"] = 0;
  Primitive(gltf)["mode"] = 4;
  gltf.json["cameras"] = {{{"type", "perspective"}, {"perspective", {{"yfov", 1}, {"znear", 1}}}}};
  gltf.json["extensions"]["KHR_lights_punctual"]["lights"] = {
      {{"type", "spot"},
       {"color", {1, 1, 1}},
       {"intensity", 5},
       {"range", 3},
       {"spot", {{"innerConeAngle", 0.1}, {"outerConeAngle", 0.5}}}}};
  Json light_node = {{"translation", {0, 0, 1}}, {"rotation", {0, 0, 0, 1}}, {"scale", {1, 1, 1}}};
  light_node["extensions"]["KHR_lights_punctual"]["light"] = 0;
  gltf.json["nodes"] = {
      {{"mesh", 0}, {"children", {1, 2}}, {"name", "root"}},
      {{"camera", 0}, {"matrix", {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1}}},
      light_node};
  gltf.json["scenes"][0]["extras"]["farpoint_sky"] = {1, 1, 1};
  gltf.json["extensionsUsed"] = {"KHR_lights_punctual"};
  return gltf;
}

TEST(CheckGltf, AcceptsAFileWithEverything) {
  const auto imported = FullGltf().Import();
  ASSERT_TRUE(imported.ok()) << imported.status();
  EXPECT_EQ(imported->scene.lights.size(), 1u);
  EXPECT_EQ(imported->scene.textures.size(), 2u);
}

struct Refusal {
  const char* pointer;  // what is replaced
  const char* value;    // by this
  const char* message;
};

TEST(CheckGltf, RefusesWrongFieldsWithTheirPath) {
  const Refusal refusals[] = {
      {"/asset", "[]", "/asset: expected an object"},
      {"/asset/version", "\"1.0\"", "/asset/version: is '1.0'"},
      {"/asset/minVersion", "\"2.1\"", "/asset/minVersion"},
      {"/scene", "1", "/scene: index 1 is beyond the 1 scenes"},
      {"/scene", "1.5", "/scene: expected an index"},
      {"/scenes", "{}", "/scenes: expected an array, found object"},
      {"/scenes/0", "7", "/scenes/0: expected an object"},
      {"/scenes/0/nodes/0", "3", "/scenes/0/nodes/0: index 3 is beyond the 3 nodes"},
      {"/scenes/0/nodes/0", "-1", "/scenes/0/nodes/0: index -1"},
      {"/scenes/0/nodes", "\"all\"", "/scenes/0/nodes: expected an array"},
      {"/nodes/0/mesh", "5", "/nodes/0/mesh: index 5 is beyond the 1 meshes"},
      {"/nodes/0/children/0", "true", "/nodes/0/children/0"},
      {"/nodes/0/name", "3", "/nodes/0/name: expected a string"},
      {"/nodes/1/matrix/3", "\"0\"", "/nodes/1/matrix/3: expected a number"},
      {"/nodes/1/matrix", "[1, 2]", "/nodes/1/matrix: has 2 numbers instead of 16"},
      {"/nodes/1/camera", "1", "/nodes/1/camera"},
      {"/nodes/2/rotation", "[0, 0, 0]", "/nodes/2/rotation"},
      {"/nodes/2/extensions/KHR_lights_punctual/light", "1", "/light: index 1"},
      {"/nodes/2/extensions/KHR_lights_punctual", "{}", "has no 'light'"},
      {"/meshes/0/primitives", "null", "/meshes/0/primitives"},
      {"/meshes/0/primitives/0/mode", "7", "/mode: is 7, outside of [0, 6]"},
      {"/meshes/0/primitives/0/material", "1", "/material: index 1 is beyond the 1 materials"},
      {"/meshes/0/primitives/0/indices", "0", "is not SCALAR"},
      {"/meshes/0/primitives/0/indices", "77", "beyond the 4 accessors"},
      {"/meshes/0/primitives/0/attributes/POSITION", "1", "/POSITION: accessor 1 is not VEC3"},
      {"/meshes/0/primitives/0/attributes/POSITION", "1e3", "/POSITION"},
      {"/meshes/0/primitives/0/attributes/TEXCOORD_0", "0", "/TEXCOORD_0: accessor 0 is not VEC2"},
      {"/accessors/0/bufferView", "99", "/accessors/0/bufferView"},
      {"/accessors/0/byteOffset", "4", "/accessors/0"},
      {"/accessors/0/byteOffset", "-4", "/accessors/0/byteOffset: is -4"},
      {"/accessors/0/byteOffset", "18446744073709551615", "/accessors/0/byteOffset"},
      {"/accessors/0/count", "4", "/accessors/0: its 4 elements"},
      {"/accessors/0/count", "4294967296", "/accessors/0"},
      {"/accessors/0/count", "99999999999999999", "/accessors/0/count"},
      {"/accessors/0/componentType", "5127", "/accessors/0/componentType"},
      {"/accessors/0/componentType", "5125", "32-bit integers"},
      {"/accessors/0/type", "\"VEC5\"", "/accessors/0/type"},
      {"/accessors/0/normalized", "1", "/accessors/0/normalized"},
      {"/accessors/0/sparse/count", "4", "/accessors/0/sparse/count: is 4, outside of [0, 3]"},
      {"/accessors/0/sparse/count", "2", "/accessors/0/sparse"},
      {"/accessors/0/sparse/indices/bufferView", "50", "/sparse/indices/bufferView"},
      {"/accessors/0/sparse/indices/componentType", "5126", "/sparse/indices/componentType"},
      {"/accessors/0/sparse/values/byteOffset", "8", "/sparse/values"},
      {"/accessors/2/count", "2", "/TEXCOORD_0: has 2 elements for 3 positions"},
      {"/bufferViews/0/buffer", "1", "/bufferViews/0/buffer: index 1 is beyond the 1 buffers"},
      {"/bufferViews/0/byteLength", "100000", "/bufferViews/0: bytes 0 to 100000"},
      {"/bufferViews/0/byteLength", "0", "/bufferViews/0/byteLength: is 0"},
      {"/bufferViews/0/byteOffset", "1099511627776", "/bufferViews/0"},
      {"/bufferViews/0/byteStride", "6", "/bufferViews/0/byteStride"},
      {"/bufferViews/0/byteStride", "4", "do not fit the 4 bytes of byteStride"},
      {"/images/0", "{}", "/images/0: needs either"},
      {"/images/0/bufferView", "50", "/images/0/bufferView"},
      {"/images/1/uri", "\"data:image/webp;base64,AAAA\"", "/images/1/uri"},
      {"/images/1/uri", "\"data:image/png;base64,A?AA\"", "not part of base64"},
      {"/images/1/uri", "\"data:image/png;base64,\"", "holds no bytes"},
      {"/textures/0/source", "2", "/textures/0/source"},
      {"/textures/0/sampler", "2", "/textures/0/sampler"},
      {"/samplers/0/wrapS", "1", "/samplers/0/wrapS"},
      {"/materials/0/alphaMode", "\"GLASS\"", "/materials/0/alphaMode"},
      {"/materials/0/emissiveFactor/1", "-1", "/materials/0/emissiveFactor/1: is -1"},
      {"/materials/0/emissiveTexture/index", "2", "/materials/0/emissiveTexture/index"},
      {"/materials/0/pbrMetallicRoughness/baseColorFactor", "[1, 1, 1]", "3 numbers instead of 4"},
      {"/materials/0/pbrMetallicRoughness/baseColorTexture/extensions/KHR_texture_transform/offset",
       "[1]", "/KHR_texture_transform/offset"},
      {"/materials/0/extensions/KHR_materials_emissive_strength/emissiveStrength", "\"9\"",
       "/emissiveStrength: expected a number"},
      {"/cameras/0/type", "\"fisheye\"", "/cameras/0/type"},
      {"/cameras/0/perspective/yfov", "4", "/cameras/0/perspective/yfov"},
      {"/cameras/0/perspective/yfov", "0", "/cameras/0/perspective/yfov"},
      {"/cameras/0/perspective", "{}", "/cameras/0/perspective: has no 'yfov'"},
      {"/extensions/KHR_lights_punctual/lights/0/type", "\"area\"", "/lights/0/type"},
      {"/extensions/KHR_lights_punctual/lights/0/intensity", "-1", "/lights/0/intensity"},
      {"/extensions/KHR_lights_punctual/lights/0/color", "[1, 2]", "/lights/0/color"},
      {"/extensions/KHR_lights_punctual/lights/0/spot/innerConeAngle", "0.6", "greater than outer"},
      {"/extensionsRequired", "[3]", "/extensionsRequired/0"},
  };
  const TinyGltf good = FullGltf();
  for (const Refusal& refusal : refusals) {
    TinyGltf bad = good;
    bad.json[Json::json_pointer(refusal.pointer)] = Json::parse(refusal.value);
    const auto imported = bad.Import();
    ASSERT_FALSE(imported.ok()) << refusal.pointer << " = " << refusal.value;
    EXPECT_EQ(imported.status().code(), absl::StatusCode::kInvalidArgument);
    EXPECT_THAT(std::string(imported.status().message()),
                AllOf(HasSubstr("scene.gltf: "), HasSubstr(refusal.message)));
  }
}

TEST(CheckGltf, RefusesBuffersThatAreShorterThanTheySay) {
  const TinyGltf gltf = TriangleGltf();
  AssetBundle asset = gltf.Asset();
  asset.files["scene.bin"] = Blob::FromVector(std::vector<std::byte>(10));
  EXPECT_THAT(std::string(ImportScene(asset, {}).status().message()),
              AllOf(HasSubstr("/buffers/0"), HasSubstr("'scene.bin' has 10 bytes")));
  asset.files.erase("scene.bin");
  const auto missing = ImportScene(asset, {});
  EXPECT_EQ(missing.status().code(), absl::StatusCode::kNotFound);
  EXPECT_THAT(std::string(missing.status().message()), HasSubstr("/buffers/0/uri"));
}

TEST(CheckGltf, RefusesCountsThatCostTheFileNothing) {
  TinyGltf gltf = TriangleGltf();
  gltf.json["accessors"][0] = {{"componentType", 5126}, {"count", 1u << 30}, {"type", "VEC3"}};
  EXPECT_THAT(std::string(gltf.Import().status().message()),
              AllOf(HasSubstr("/accessors/0"), HasSubstr("no bufferView")));
}

// Every value of the file replaced by every kind of wrong value: refused or read, never a crash;
// and what is read can be prepared or is refused there.
TEST(CheckGltf, SurvivesEveryValueReplaced) {
  Executor executor(1);
  const TinyGltf good = FullGltf();
  const Json flat = good.json.flatten();
  const char* values[] = {"null",
                          "true",
                          "-1",
                          "0",
                          "1",
                          "2",
                          "255",
                          "1e300",
                          "0.5",
                          "65536",
                          "4294967295",
                          "18446744073709551615",
                          "-9223372036854775808",
                          "\"\"",
                          "\"VEC4\"",
                          "\"data:,\"",
                          "[]",
                          "[0]",
                          "{}",
                          "{\"a\": 1}"};
  size_t refused = 0, total = 0;
  for (auto it = flat.begin(); it != flat.end(); ++it) {
    // The leaf, and the object or array that holds it.
    Json::json_pointer pointer(it.key());
    for (int level = 0; level < 2 && !pointer.empty(); ++level, pointer.pop_back()) {
      for (const char* value : values) {
        TinyGltf bad = good;
        bad.json[pointer] = Json::parse(value);
        const auto imported = bad.Import();
        ++total;
        if (!imported.ok()) {
          ++refused;
          EXPECT_FALSE(imported.status().message().empty());
          continue;
        }
        const auto prepared = PreparedScene::Prepare(imported->scene, executor);
        if (!prepared.ok()) {
          EXPECT_NE(prepared.status().code(), absl::StatusCode::kDataLoss) << prepared.status();
        }
      }
    }
  }
  EXPECT_GT(refused, total / 2);
  EXPECT_LT(refused, total);
}

TEST(CheckGltf, SurvivesDamagedBuffers) {
  Executor executor(1);
  const TinyGltf good = FullGltf();
  for (uint64_t i = 0; i < 2000; ++i) {
    TinyGltf bad = good;
    for (uint64_t k = 0; k < 4; ++k) {
      const uint64_t r = HashKey(i, k);
      bad.bin[r % bad.bin.size()] = static_cast<std::byte>(r >> 32);
    }
    const auto imported = bad.Import();
    if (imported.ok()) {
      const auto prepared = PreparedScene::Prepare(imported->scene, executor);
      EXPECT_TRUE(prepared.ok() || prepared.status().code() == absl::StatusCode::kInvalidArgument)
          << prepared.status();
    } else {
      EXPECT_EQ(imported.status().code(), absl::StatusCode::kInvalidArgument);
    }
  }
}

TEST(CheckGltf, SurvivesDamagedText) {
  Executor executor(1);
  const TinyGltf good = FullGltf();
  const AssetBundle asset = good.Asset();
  const auto bytes = asset.files.at("scene.gltf").bytes();
  const std::string text(reinterpret_cast<const char*>(bytes.data()), bytes.size());
  for (uint64_t i = 0; i < 4000; ++i) {
    std::string damaged = text;
    for (uint64_t k = 0; k <= i % 3; ++k) {
      const uint64_t r = HashKey(i, k);
      const size_t at = r % damaged.size();
      switch (r >> 60 & 3) {
        case 0:
          damaged[at] = static_cast<char>(r >> 32);
          break;
        case 1:
          damaged.erase(at, 1 + (r >> 40) % 20);
          break;
        case 2:
          damaged.insert(at, damaged.substr((r >> 24) % damaged.size(), (r >> 50) % 40));
          break;
        default:
          damaged[at] = static_cast<char>('0' + (r >> 32) % 10);
          break;
      }
    }
    AssetBundle bad = asset;
    bad.files["scene.gltf"] = Blob::FromString(damaged);
    const auto imported = ImportScene(bad, {});
    if (imported.ok()) {
      const auto prepared = PreparedScene::Prepare(imported->scene, executor);
      EXPECT_TRUE(prepared.ok() || prepared.status().code() != absl::StatusCode::kDataLoss);
    }
  }
}

}  // namespace
}  // namespace farpoint

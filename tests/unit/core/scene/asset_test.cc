#include "core/scene/asset.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <filesystem>
#include <fstream>

#include "core/scene/gltf_check.h"
#include "tests/unit/core/scene/scene_test_util.h"

namespace farpoint {
namespace {

using ::testing::AllOf;
using ::testing::HasSubstr;

class AssetTest : public ::testing::Test {
 protected:
  AssetTest() {
    folder_ =
        std::filesystem::path(::testing::TempDir()) /
        ("asset_" + std::string(::testing::UnitTest::GetInstance()->current_test_info()->name()));
    std::filesystem::remove_all(folder_);
    std::filesystem::create_directories(folder_ / "textures");
  }
  ~AssetTest() override { std::filesystem::remove_all(folder_); }

  std::string Write(const std::string& name, const std::string& text) {
    const std::string path = (folder_ / name).string();
    std::ofstream(path, std::ios::binary) << text;
    return path;
  }
  std::string MessageOf(const std::string& name, const std::string& text) {
    const auto bundle = CollectAsset(Write(name, text));
    return bundle.ok() ? "OK" : std::string(bundle.status().message());
  }

  std::filesystem::path folder_;
};

TEST_F(AssetTest, CollectsBuffersAndUsedImagesUnderTheirDecodedUris) {
  Write("my data+1.bin", "abcd");
  Write("textures/wall.png", "png");
  Write("textures/normal.png", "png");
  const auto bundle = CollectAsset(Write("scene.gltf", R"({
    "asset": {"version": "2.0"},
    "buffers": [{"byteLength": 4, "uri": "my%20data+1.bin"},
                {"byteLength": 1, "uri": "data:application/octet-stream;base64,AA=="}],
    "images": [{"uri": "textures/normal.png"}, {"uri": "textures%2fwall.png"}],
    "textures": [{"source": 0}, {"source": 1}],
    "materials": [{"normalTexture": {"index": 0},
                   "pbrMetallicRoughness": {"baseColorTexture": {"index": 1}}}]})"));
  ASSERT_TRUE(bundle.ok()) << bundle.status();
  EXPECT_EQ(bundle->root, "scene.gltf");
  EXPECT_EQ(bundle->files.size(), 3u);
  EXPECT_EQ(bundle->Find("my data+1.bin")->size(), 4u);
  EXPECT_TRUE(bundle->Find("textures/wall.png").ok());
}

TEST_F(AssetTest, NamesTheMissingFileAndWhoRefersToIt) {
  const std::string text = MessageOf(
      "scene.gltf",
      R"({"asset": {"version": "2.0"}, "buffers": [{"byteLength": 4, "uri": "gone.bin"}]})");
  EXPECT_THAT(text, AllOf(HasSubstr("scene.gltf: /buffers/0/uri"), HasSubstr("gone.bin"),
                          HasSubstr("put the file beside the scene")));
  const auto missing = CollectAsset((folder_ / "none.gltf").string());
  EXPECT_EQ(missing.status().code(), absl::StatusCode::kNotFound);
}

TEST_F(AssetTest, RefusesUrisThatLeadElsewhere) {
  for (const char* uri :
       {"/etc/hostname", "../secret.bin", "a/../../secret.bin", "%2e%2e/secret.bin",
        "..\\secret.bin", "C:/secret.bin", "http://example.com/a.bin", "file:///etc/hostname"}) {
    const nlohmann::json json = {{"asset", {{"version", "2.0"}}},
                                 {"buffers", {{{"byteLength", 1}, {"uri", uri}}}}};
    const auto bundle = CollectAsset(Write("scene.gltf", json.dump()));
    EXPECT_EQ(bundle.status().code(), absl::StatusCode::kInvalidArgument) << uri;
    EXPECT_THAT(std::string(bundle.status().message()), HasSubstr("/buffers/0/uri")) << uri;
  }
}

TEST_F(AssetTest, RefusesUnknownExtensionsAndNamesTheKnownOnes) {
  EXPECT_THAT(MessageOf("scene.fbx", ""),
              AllOf(HasSubstr("scene.fbx"), HasSubstr(".gltf"), HasSubstr(".glb")));
  EXPECT_THAT(MessageOf("scene", ""), HasSubstr(".gltf"));
}

TEST_F(AssetTest, NamesLineAndColumnOfMalformedJson) {
  EXPECT_THAT(MessageOf("scene.gltf", "{\n \"asset\": {,}\n}"),
              AllOf(HasSubstr("line 2"), HasSubstr("column")));
  EXPECT_THAT(MessageOf("scene.gltf", "[]"), HasSubstr("expected an object"));
  EXPECT_THAT(MessageOf("scene.gltf", "{\"a\": " + std::string(1000, '[')), HasSubstr("nested"));
  EXPECT_THAT(MessageOf("scene.gltf", ""), HasSubstr("malformed JSON"));
}

TEST_F(AssetTest, RefusesDamagedBinaryContainers) {
  const TinyGltf gltf = TriangleGltf();
  const std::string json = gltf.json.dump();
  const auto u32 = [](uint32_t v) { return std::string(reinterpret_cast<const char*>(&v), 4); };
  const std::string good = "glTF" + u32(2) + u32(static_cast<uint32_t>(20 + json.size())) +
                           u32(static_cast<uint32_t>(json.size())) + "JSON" + json;
  ASSERT_TRUE(CollectAsset(Write("good.glb", good)).ok());
  for (size_t size = 4; size < good.size(); size += 5) {
    EXPECT_EQ(CollectAsset(Write("short.glb", good.substr(0, size))).status().code(),
              absl::StatusCode::kDataLoss);
  }
  std::string wrong = good;
  wrong[4] = 1;
  EXPECT_THAT(MessageOf("v1.glb", wrong), HasSubstr("version 1"));
  wrong = good;
  wrong[16] = 'X';
  EXPECT_THAT(MessageOf("chunk.glb", wrong), HasSubstr("JSON chunk"));
  wrong = good;
  wrong[15] = '\x7f';
  EXPECT_THAT(MessageOf("length.glb", wrong), HasSubstr("beyond the file"));
}

TEST(DecodeUri, DecodesPairsOfHexadecimalDigitsOnly) {
  EXPECT_EQ(DecodeUri("a%20b%2Fc+d"), "a b/c+d");
  EXPECT_EQ(DecodeUri("100%"), "100%");
  EXPECT_EQ(DecodeUri("%4"), "%4");
  EXPECT_EQ(DecodeUri("%zz%41"), "%zzA");
  EXPECT_EQ(DecodeUri("%C3%A4"), "\xc3\xa4");
}

}  // namespace
}  // namespace farpoint

#include "core/scene/gltf_importer.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cmath>
#include <limits>

#include "tests/unit/core/scene/scene_test_util.h"

namespace farpoint {
namespace {

using ::testing::AllOf;
using ::testing::ElementsAre;
using ::testing::HasSubstr;
using ::testing::IsEmpty;
using Json = nlohmann::json;

Scene ImportOk(const TinyGltf& gltf, const ImportOptions& options = {}) {
  auto imported = gltf.Import(options);
  EXPECT_TRUE(imported.ok()) << imported.status();
  return imported.ok() ? std::move(imported->scene) : Scene();
}

std::string MessageOf(const TinyGltf& gltf) {
  const auto imported = gltf.Import();
  return imported.ok() ? "OK" : std::string(imported.status().message());
}

std::string NotesOf(const TinyGltf& gltf) {
  const auto imported = gltf.Import();
  if (!imported.ok()) return imported.status().ToString();
  std::string all;
  for (const std::string& note : imported->notes) all += note + "\n";
  return all;
}

void ExpectNear(const Vec3d& a, const Vec3d& b) {
  for (int i = 0; i < 3; ++i) EXPECT_NEAR(a[i], b[i], 1e-12);
}

TEST(GltfImporter, ReadsATriangle) {
  const Scene scene = ImportOk(TriangleGltf());
  ASSERT_EQ(scene.meshes.size(), 1u);
  ASSERT_EQ(scene.instances.size(), 1u);
  EXPECT_THAT(scene.meshes[0].positions,
              ElementsAre(Vec3f(0, 0, 0), Vec3f(1, 0, 0), Vec3f(0, 1, 0)));
  EXPECT_EQ(scene.meshes[0].triangles, (std::vector<std::array<uint32_t, 3>>{{0, 1, 2}}));
  EXPECT_THAT(scene.meshes[0].normals, IsEmpty());
  EXPECT_EQ(scene.meshes[0].material, -1);
  EXPECT_EQ(scene.instances[0].world_from_mesh, Affine());
  EXPECT_THAT(NotesOf(TriangleGltf()), IsEmpty());
}

TEST(GltfImporter, ReadsEveryKindOfIndices) {
  TinyGltf gltf = TriangleGltf();
  const auto bytes = gltf.Accessor<uint8_t>({2, 0, 1}, 5121, "SCALAR", 1);
  const auto words = gltf.Accessor<uint32_t>({2, 0, 1}, 5125, "SCALAR", 1);
  for (const size_t accessor : {bytes, words}) {
    Primitive(gltf)["indices"] = accessor;
    EXPECT_EQ(ImportOk(gltf).meshes[0].triangles,
              (std::vector<std::array<uint32_t, 3>>{{2, 0, 1}}));
  }
  Primitive(gltf).erase("indices");
  EXPECT_EQ(ImportOk(gltf).meshes[0].triangles, (std::vector<std::array<uint32_t, 3>>{{0, 1, 2}}));
}

TEST(GltfImporter, ReadsStripsAndFansWithTheirWinding) {
  TinyGltf gltf = TriangleGltf();
  Primitive(gltf)["attributes"]["POSITION"] =
      gltf.Accessor<float>({0, 0, 0, 1, 0, 0, 0, 1, 0, 1, 1, 0, 0, 2, 0}, 5126, "VEC3", 3);
  Primitive(gltf).erase("indices");
  Primitive(gltf)["mode"] = 5;
  EXPECT_EQ(ImportOk(gltf).meshes[0].triangles,
            (std::vector<std::array<uint32_t, 3>>{{0, 1, 2}, {1, 3, 2}, {2, 3, 4}}));
  Primitive(gltf)["mode"] = 6;
  EXPECT_EQ(ImportOk(gltf).meshes[0].triangles,
            (std::vector<std::array<uint32_t, 3>>{{1, 2, 0}, {2, 3, 0}, {3, 4, 0}}));
  for (const int mode : {0, 1, 2, 3}) {
    Primitive(gltf)["mode"] = mode;
    EXPECT_THAT(ImportOk(gltf).instances, IsEmpty());
    EXPECT_THAT(NotesOf(gltf), HasSubstr("1 primitive of points or lines skipped"));
  }
  Primitive(gltf)["mode"] = 4;
  EXPECT_THAT(MessageOf(gltf), HasSubstr("no multiple of 3"));
}

TEST(GltfImporter, KeepsOnlyTheVerticesThatTrianglesUse) {
  TinyGltf gltf = TriangleGltf();
  std::vector<float> many(3 * 1000);
  for (size_t i = 0; i < many.size(); ++i) many[i] = static_cast<float>(i);
  many[3] = std::numeric_limits<float>::infinity();  // vertex 1 is not used
  Primitive(gltf)["attributes"]["POSITION"] = gltf.Accessor<float>(many, 5126, "VEC3", 3);
  Primitive(gltf)["indices"] = gltf.Accessor<uint16_t>({999, 7, 500, 7, 999, 8}, 5123, "SCALAR", 1);
  const Scene scene = ImportOk(gltf);
  EXPECT_THAT(scene.meshes[0].positions,
              ElementsAre(Vec3f(21, 22, 23), Vec3f(24, 25, 26), Vec3f(1500, 1501, 1502),
                          Vec3f(2997, 2998, 2999)));
  EXPECT_EQ(scene.meshes[0].triangles,
            (std::vector<std::array<uint32_t, 3>>{{3, 0, 2}, {0, 3, 1}}));
}

TEST(GltfImporter, ReadsStridesAndOffsets) {
  TinyGltf gltf = TriangleGltf();
  const auto view = gltf.View<float>({9, 0, 0, 5, 9, 1, 0, 5, 9, 0, 1, 5});
  gltf.json["bufferViews"][view]["byteStride"] = 16;
  gltf.json["accessors"][0] = {{"bufferView", view},
                               {"byteOffset", 8},
                               {"componentType", 5126},
                               {"count", 3},
                               {"type", "VEC3"}};
  EXPECT_THAT(MessageOf(gltf),
              HasSubstr("/accessors/0"));  // the last element ends at byte 52 of 48
  gltf.json["accessors"][0]["byteOffset"] = 4;
  EXPECT_THAT(ImportOk(gltf).meshes[0].positions,
              ElementsAre(Vec3f(0, 0, 5), Vec3f(1, 0, 5), Vec3f(0, 1, 5)));
}

TEST(GltfImporter, ReadsNormalisedAndPlainIntegers) {
  TinyGltf gltf = TriangleGltf();
  auto& attributes = Primitive(gltf)["attributes"];
  const auto positions =
      gltf.Accessor<int16_t>({-32768, 0, 32767, 16384, 0, 0, 0, -32767, 0}, 5122, "VEC3", 3);
  gltf.json["accessors"][positions]["normalized"] = true;
  attributes["POSITION"] = positions;
  const auto uv0 = gltf.Accessor<uint8_t>({0, 255, 51, 0, 0, 102}, 5121, "VEC2", 2);
  gltf.json["accessors"][uv0]["normalized"] = true;
  attributes["TEXCOORD_0"] = uv0;
  attributes["TEXCOORD_1"] = gltf.Accessor<uint16_t>({0, 1, 2, 3, 4, 65535}, 5123, "VEC2", 2);
  const auto normals = gltf.Accessor<int8_t>({0, 0, 127, 0, 0, -128, 127, 0, 0}, 5120, "VEC3", 3);
  gltf.json["accessors"][normals]["normalized"] = true;
  attributes["NORMAL"] = normals;
  gltf.json["extensionsRequired"] = {"KHR_mesh_quantization"};
  const Mesh mesh = ImportOk(gltf).meshes[0];
  EXPECT_THAT(mesh.positions,
              ElementsAre(Vec3f(-1, 0, 1), Vec3f(16384.0f / 32767, 0, 0), Vec3f(0, -1, 0)));
  EXPECT_THAT(mesh.uv[0], ElementsAre(Vec2f{0, 1}, Vec2f{0.2f, 0}, Vec2f{0, 0.4f}));
  EXPECT_THAT(mesh.uv[1], ElementsAre(Vec2f{0, 1}, Vec2f{2, 3}, Vec2f{4, 65535}));
  EXPECT_THAT(mesh.normals, ElementsAre(Vec3f(0, 0, 1), Vec3f(0, 0, -1), Vec3f(1, 0, 0)));
}

TEST(GltfImporter, AppliesSparseValuesOverABaseAndOverNothing) {
  TinyGltf gltf = TriangleGltf();
  const auto indices = gltf.View<uint8_t>({1, 2});
  const auto values = gltf.View<float>({7, 7, 7, 8, 8, 8});
  gltf.json["accessors"][0]["sparse"] = {
      {"count", 2},
      {"indices", {{"bufferView", indices}, {"componentType", 5121}}},
      {"values", {{"bufferView", values}}}};
  EXPECT_THAT(ImportOk(gltf).meshes[0].positions,
              ElementsAre(Vec3f(0, 0, 0), Vec3f(7, 7, 7), Vec3f(8, 8, 8)));
  gltf.json["accessors"][0].erase("bufferView");
  EXPECT_THAT(ImportOk(gltf).meshes[0].positions,
              ElementsAre(Vec3f(0, 0, 0), Vec3f(7, 7, 7), Vec3f(8, 8, 8)));
  for (const std::vector<uint8_t>& bad :
       {std::vector<uint8_t>{2, 1}, std::vector<uint8_t>{1, 3}, std::vector<uint8_t>{1, 1}}) {
    gltf.json["accessors"][0]["sparse"]["indices"]["bufferView"] = gltf.View(bad);
    EXPECT_THAT(MessageOf(gltf), HasSubstr("/meshes/0/primitives/0/attributes/POSITION"));
  }
}

TEST(GltfImporter, MultipliesTransformsDownTheTreeInDouble) {
  TinyGltf gltf = TriangleGltf();
  const double h = std::sqrt(0.5);
  gltf.json["nodes"] = {
      {{"translation", {1e6, 0, 0.1}}, {"children", {1, 2}}},
      {{"rotation", {0, 0, h, h}}, {"scale", {2, 3, 4}}, {"mesh", 0}},
      {{"matrix", {0, 1, 0, 0, 1, 0, 0, 0, 0, 0, 5, 0, 6, 7, 8, 1}}, {"mesh", 0}}};
  const Scene scene = ImportOk(gltf);
  ASSERT_EQ(scene.instances.size(), 2u);
  // A quarter turn about z after scaling: x -> 2 y, y -> -3 x.
  const Affine& trs = scene.instances[0].world_from_mesh;
  ExpectNear(trs.column[0], {0, 2, 0});
  ExpectNear(trs.column[1], {-3, 0, 0});
  ExpectNear(trs.column[2], {0, 0, 4});
  EXPECT_EQ(trs.translation, Vec3d(1e6, 0, 0.1));
  const Affine& matrix = scene.instances[1].world_from_mesh;
  EXPECT_EQ(matrix.column[0], Vec3d(0, 1, 0));
  EXPECT_EQ(matrix.column[1], Vec3d(1, 0, 0));
  EXPECT_EQ(matrix.column[2], Vec3d(0, 0, 5));
  EXPECT_EQ(matrix.translation, Vec3d(1e6 + 6, 7, 8.1));
  EXPECT_LT(matrix.Determinant(), 0);
}

TEST(GltfImporter, ShowsTheDefaultSceneElseTheFirstElseAllRoots) {
  TinyGltf gltf = TriangleGltf();
  gltf.json["nodes"] = {{{"mesh", 0}, {"name", "a"}}, {{"mesh", 0}, {"name", "b"}}};
  gltf.json["scenes"] = {{{"nodes", {0}}}, {{"nodes", {1}}}};
  gltf.json["scene"] = 1;
  EXPECT_EQ(ImportOk(gltf).instances.at(0).name, "b");
  gltf.json.erase("scene");
  EXPECT_EQ(ImportOk(gltf).instances.at(0).name, "a");
  EXPECT_THAT(NotesOf(gltf), HasSubstr("no default scene"));
  gltf.json.erase("scenes");
  EXPECT_EQ(ImportOk(gltf).instances.size(), 2u);
  EXPECT_THAT(NotesOf(gltf), HasSubstr("no scene in the file"));
}

TEST(GltfImporter, RefusesNodesThatFormNoTree) {
  TinyGltf gltf = TriangleGltf();
  gltf.json["nodes"] = {{{"children", {1}}}, {{"children", {0}}}};
  EXPECT_THAT(MessageOf(gltf), AllOf(HasSubstr("/nodes/0"), HasSubstr("node 1")));
  gltf.json["nodes"] = {{{"children", {0}}}};
  EXPECT_THAT(MessageOf(gltf), HasSubstr("/nodes/0"));
  gltf.json["nodes"] = {{{"children", {1, 2}}}, {{"children", {2}}}, {{"mesh", 0}}};
  EXPECT_THAT(MessageOf(gltf), HasSubstr("must form a tree"));
  gltf.json["nodes"] = {{{"children", {1}}}, {{"children", {0}}}};
  gltf.json.erase("scene");
  gltf.json.erase("scenes");
  EXPECT_THAT(MessageOf(gltf), HasSubstr("form cycles"));
}

TEST(GltfImporter, WalksDeepHierarchiesWithoutRecursion) {
  TinyGltf gltf = TriangleGltf();
  Json nodes = Json::array();
  constexpr int kDepth = 20000;
  for (int i = 0; i < kDepth; ++i)
    nodes.push_back({{"children", {i + 1}}, {"translation", {0, 0, 1}}});
  nodes.push_back({{"mesh", 0}});
  gltf.json["nodes"] = nodes;
  const Scene scene = ImportOk(gltf);
  ASSERT_EQ(scene.instances.size(), 1u);
  EXPECT_EQ(scene.instances[0].world_from_mesh.translation, Vec3d(0, 0, kDepth));
}

TEST(GltfImporter, ReadsMaterials) {
  TinyGltf gltf = TriangleGltf();
  gltf.json["materials"] = {
      {{"name", "leaf"},
       {"alphaMode", "MASK"},
       {"alphaCutoff", 0.25},
       {"emissiveFactor", {1, 0.5, 0.25}},
       {"extensions", {{"KHR_materials_emissive_strength", {{"emissiveStrength", 8}}}}},
       {"pbrMetallicRoughness",
        {{"baseColorFactor", {0.5, 0.25, 0.125, 0.75}}, {"metallicFactor", 0}}}},
      {{"alphaMode", "BLEND"}},
      Json::object()};
  Primitive(gltf)["material"] = 0;
  const Scene scene = ImportOk(gltf);
  ASSERT_EQ(scene.materials.size(), 3u);
  const Material& m = scene.materials[0];
  EXPECT_EQ(m.name, "leaf");
  EXPECT_EQ(m.base_color, Rgb(0.5f, 0.25f, 0.125f));
  EXPECT_EQ(m.base_alpha, 0.75f);
  EXPECT_EQ(m.alpha_mode, AlphaMode::kMask);
  EXPECT_EQ(m.alpha_cutoff, 0.25f);
  EXPECT_EQ(m.emission, Rgb(8, 4, 2));
  EXPECT_EQ(m.metallic, 0);
  EXPECT_EQ(scene.materials[1].alpha_mode, AlphaMode::kMask);
  EXPECT_EQ(scene.materials[1].alpha_cutoff, 0.5f);
  EXPECT_EQ(scene.materials[2].alpha_mode, AlphaMode::kOpaque);
  EXPECT_EQ(scene.materials[2].base_color, Rgb(1));
  EXPECT_EQ(scene.materials[2].emission, Rgb());
  EXPECT_EQ(scene.meshes[0].material, 0);
  EXPECT_THAT(NotesOf(gltf), HasSubstr("1 material of alphaMode BLEND"));
}

TEST(GltfImporter, ReadsTexturesFromFilesDataAndBuffers) {
  const std::string png = MakePng(1, 1, {1, 2, 3, 255});
  TinyGltf gltf = TriangleGltf();
  const auto view = gltf.View(std::vector<char>(png.begin(), png.end()));
  gltf.json["images"] = {{{"uri", "a%20b.png"}},
                         {{"uri", "data:image/png;base64," + Base64(png)}},
                         {{"bufferView", view}, {"mimeType", "image/png"}, {"name", "inner"}}};
  gltf.json["samplers"] = {{{"wrapS", 33071}, {"wrapT", 33648}, {"magFilter", 9728}}};
  gltf.json["textures"] = {{{"source", 0}, {"sampler", 0}},
                           {{"source", 1}},
                           {{"source", 2}},
                           {{"source", 2}, {"sampler", 0}}};
  gltf.json["materials"] = Json::array();
  for (int t = 0; t < 4; ++t) {
    gltf.json["materials"].push_back({{"emissiveTexture", {{"index", t}, {"texCoord", 1}}}});
  }
  AssetBundle asset = gltf.Asset();
  EXPECT_EQ(ImportScene(asset, {}).status().code(), absl::StatusCode::kNotFound);
  asset.files["a b.png"] = Blob::FromString(png);
  const auto imported = ImportScene(asset, {});
  ASSERT_TRUE(imported.ok()) << imported.status();
  ASSERT_EQ(imported->scene.textures.size(), 4u);
  for (const Texture& texture : imported->scene.textures) {
    EXPECT_EQ(texture.encoded.Hash(), Blob::FromString(png).Hash());
  }
  const auto& textures = imported->scene.textures;
  EXPECT_EQ(textures[0].name, "a b.png");
  EXPECT_EQ(textures[0].wrap_s, WrapMode::kClampToEdge);
  EXPECT_EQ(textures[0].wrap_t, WrapMode::kMirroredRepeat);
  EXPECT_TRUE(textures[0].nearest);
  EXPECT_EQ(textures[1].wrap_s, WrapMode::kRepeat);
  EXPECT_FALSE(textures[1].nearest);
  EXPECT_EQ(textures[2].name, "inner");
  EXPECT_EQ(textures[2].encoded.bytes().data(), textures[3].encoded.bytes().data());
  EXPECT_EQ(imported->scene.materials[3].emission_texture.texture, 3);
  EXPECT_EQ(imported->scene.materials[3].emission_texture.uv_set, 1u);
}

TEST(GltfImporter, ReadsTextureTransforms) {
  TinyGltf gltf = TriangleGltf();
  gltf.json["images"] = {{{"uri", "data:image/png;base64," + Base64(MakePng(1, 1, {0, 0, 0, 0}))}}};
  gltf.json["textures"] = {{{"source", 0}}};
  Json info = {{"index", 0}};
  info["extensions"]["KHR_texture_transform"] = {
      {"offset", {0.25, 0.5}}, {"scale", {2, -3}}, {"rotation", 0.75}, {"texCoord", 1}};
  gltf.json["materials"] = Json::array({{{"pbrMetallicRoughness", {{"baseColorTexture", info}}}}});
  gltf.json["extensionsRequired"] = {"KHR_texture_transform"};
  const TextureRef ref = ImportOk(gltf).materials.at(0).base_color_texture;
  EXPECT_EQ(ref.uv_set, 1u);
  EXPECT_EQ(ref.transform.offset, (Vec2f{0.25f, 0.5f}));
  EXPECT_EQ(ref.transform.scale, (Vec2f{2, -3}));
  EXPECT_EQ(ref.transform.rotation_rad, 0.75f);
  auto& coordinates = gltf.json["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]
                               ["extensions"]["KHR_texture_transform"]["texCoord"];
  coordinates = 2;
  EXPECT_FALSE(ImportOk(gltf).materials.at(0).base_color_texture.present());
  EXPECT_THAT(NotesOf(gltf), HasSubstr("TEXCOORD_2"));
}

TEST(GltfImporter, ReadsGlossOnDemand) {
  TinyGltf gltf = TriangleGltf();
  gltf.json["images"] = {{{"uri", "data:image/png;base64," + Base64(MakePng(1, 1, {0, 9, 8, 7}))}}};
  gltf.json["textures"] = {{{"source", 0}}};
  Json material;
  material["pbrMetallicRoughness"] = {{"metallicFactor", 0.5},
                                      {"roughnessFactor", 0.25},
                                      {"metallicRoughnessTexture", {{"index", 0}}}};
  material["normalTexture"] = {{"index", 0}, {"scale", 2}};
  material["extensions"]["KHR_materials_ior"] = {{"ior", 2}};
  gltf.json["materials"] = Json::array({material});
  Primitive(gltf)["material"] = 0;
  ImportOptions options;
  options.gloss = true;
  const Scene scene = ImportOk(gltf, options);
  const Material& m = scene.materials.at(0);
  EXPECT_EQ(m.metallic, 0.5f);
  EXPECT_EQ(m.roughness, 0.25f);
  EXPECT_NEAR(m.dielectric_f0, 1.0f / 9, 1e-6f);
  EXPECT_EQ(m.metal_roughness_texture.texture, 0);
  EXPECT_EQ(m.normal_texture.texture, 0);
  EXPECT_EQ(m.normal_scale, 2);
  EXPECT_GT(scene.textures.at(0).encoded.size(), 0u);

  const Scene lambert = ImportOk(gltf);
  EXPECT_FALSE(lambert.materials.at(0).normal_texture.present());
  EXPECT_EQ(lambert.textures.at(0).encoded.size(), 0u);
  ImportedScene imported{lambert, {}, {}};
  NoteHiddenGloss(imported);
  EXPECT_THAT(imported.notes, ElementsAre(HasSubstr("1 material is metallic or glossy")));
}

TEST(GltfImporter, ReadsLightsInBothUnits) {
  TinyGltf gltf = TriangleGltf();
  gltf.json["extensions"]["KHR_lights_punctual"]["lights"] = {
      {{"type", "point"}, {"color", {1, 0.5, 0}}, {"intensity", 683}, {"range", 9}},
      {{"type", "spot"}, {"spot", {{"innerConeAngle", 0.1}, {"outerConeAngle", 0.2}}}},
      {{"type", "directional"}, {"color", Json::array()}, {"intensity", 1366}}};
  Json nodes = Json::array();
  for (int l = 0; l < 3; ++l) {
    // A quarter turn about x takes -z to +y.
    Json node = {{"translation", {1, 2, 3}},
                 {"rotation", {std::sqrt(0.5), 0, 0, std::sqrt(0.5)}},
                 {"scale", {2, 2, 2}}};
    node["extensions"]["KHR_lights_punctual"]["light"] = l;
    nodes.push_back(node);
  }
  gltf.json["nodes"] = nodes;
  gltf.json["scenes"][0]["nodes"] = {0, 1, 2};
  const Scene scene = ImportOk(gltf);
  ASSERT_EQ(scene.lights.size(), 3u);
  EXPECT_EQ(scene.lights[0].kind, PunctualKind::kPoint);
  EXPECT_EQ(scene.lights[0].intensity, Rgb(1, 0.5f, 0));
  EXPECT_EQ(scene.lights[0].position, Vec3d(1, 2, 3));
  EXPECT_EQ(scene.lights[0].range_m, 9);
  EXPECT_EQ(scene.lights[1].kind, PunctualKind::kSpot);
  EXPECT_EQ(scene.lights[1].intensity, Rgb(static_cast<float>(1 / 683.0)));
  EXPECT_EQ(scene.lights[1].inner_cone_rad, 0.1);
  EXPECT_EQ(scene.lights[1].outer_cone_rad, 0.2);
  ExpectNear(scene.lights[1].direction, {0, 1, 0});
  EXPECT_EQ(scene.lights[2].kind, PunctualKind::kDirectional);
  EXPECT_EQ(scene.lights[2].intensity, Rgb(2));
  const Scene raw = ImportOk(gltf, {.light_units = LightUnits::kRaw});
  EXPECT_EQ(raw.lights[2].intensity, Rgb(1366));
  EXPECT_EQ(raw.lights[1].intensity, Rgb(1));
}

TEST(GltfImporter, ReadsPerspectiveCamerasAndIgnoresTheirScale) {
  TinyGltf gltf = TriangleGltf();
  gltf.json["cameras"] = {
      {{"type", "perspective"},
       {"perspective", {{"yfov", 0.5}, {"znear", 100}, {"aspectRatio", 3}}}},
      {{"type", "orthographic"},
       {"orthographic", {{"xmag", 1}, {"ymag", 1}, {"znear", 1}, {"zfar", 2}}}}};
  // Half a turn about y.
  gltf.json["nodes"] = {{{"name", "cam"},
                         {"camera", 0},
                         {"translation", {1, 2, 3}},
                         {"rotation", {0, 1, 0, 0}},
                         {"scale", {5, 7, 9}}},
                        {{"camera", 1}}};
  gltf.json["scenes"][0]["nodes"] = {0, 1};
  const Scene scene = ImportOk(gltf);
  ASSERT_EQ(scene.cameras.size(), 1u);
  const Camera& camera = scene.cameras[0];
  EXPECT_EQ(camera.name, "cam");
  EXPECT_EQ(camera.yfov_rad, 0.5);
  EXPECT_EQ(camera.eye, Vec3d(1, 2, 3));
  ExpectNear(camera.forward, {0, 0, 1});
  ExpectNear(camera.up, {0, 1, 0});
  ExpectNear(camera.right, {-1, 0, 0});
  EXPECT_THAT(NotesOf(gltf), HasSubstr("/cameras/1 is orthographic"));
}

TEST(GltfImporter, ReadsTheSkyThatItsWriterLeaves) {
  TinyGltf gltf = TriangleGltf();
  gltf.json["scenes"][0]["extras"]["farpoint_sky"] = {0.5, 1, 2};
  EXPECT_EQ(ImportOk(gltf).environment.sky, Rgb(0.5f, 1, 2));
  gltf.json["scenes"][0]["extras"]["farpoint_sky"] = {0.5, "x", 2};
  EXPECT_THAT(MessageOf(gltf), HasSubstr("/scenes/0/extras/farpoint_sky/1"));
}

TEST(GltfImporter, RefusesRequiredExtensionsByNameAndNotesOptionalOnes) {
  TinyGltf gltf = TriangleGltf();
  gltf.json["extensionsUsed"] = {"KHR_materials_clearcoat", "KHR_materials_ior"};
  EXPECT_THAT(NotesOf(gltf), AllOf(HasSubstr("'KHR_materials_clearcoat' is ignored"),
                                   Not(HasSubstr("KHR_materials_ior"))));
  gltf.json["extensionsRequired"] = {"KHR_draco_mesh_compression"};
  const auto imported = gltf.Import();
  EXPECT_EQ(imported.status().code(), absl::StatusCode::kUnimplemented);
  EXPECT_THAT(std::string(imported.status().message()),
              AllOf(HasSubstr("scene.gltf: /extensionsRequired/0"),
                    HasSubstr("KHR_draco_mesh_compression"), HasSubstr("gltf-transform")));
  gltf.json["extensionsRequired"] = {"ACME_unknown"};
  EXPECT_THAT(MessageOf(gltf), AllOf(HasSubstr("ACME_unknown"), HasSubstr("export the scene")));
}

TEST(GltfImporter, RefusesBadValuesInBuffers) {
  TinyGltf gltf = TriangleGltf();
  Primitive(gltf)["indices"] = gltf.Accessor<uint16_t>({0, 1, 3}, 5123, "SCALAR", 1);
  EXPECT_THAT(MessageOf(gltf), AllOf(HasSubstr("scene.gltf: /meshes/0/primitives/0/indices"),
                                     HasSubstr("index 3 is beyond the 3 positions")));
  for (const float bad :
       {std::numeric_limits<float>::quiet_NaN(), std::numeric_limits<float>::infinity()}) {
    TinyGltf other = TriangleGltf();
    Primitive(other)["attributes"]["POSITION"] =
        other.Accessor<float>({0, 0, 0, 1, bad, 0, 0, 1, 0}, 5126, "VEC3", 3);
    EXPECT_THAT(MessageOf(other), HasSubstr("position 1 is not finite"));
  }
}

TEST(GltfImporter, StopsAtTheLimitOfTriangles) {
  TinyGltf gltf = TriangleGltf();
  gltf.json["nodes"] = Json::array();
  gltf.json["scenes"][0]["nodes"] = Json::array();
  for (int i = 0; i < 11; ++i) {
    gltf.json["nodes"].push_back({{"mesh", 0}});
    gltf.json["scenes"][0]["nodes"].push_back(i);
  }
  EXPECT_TRUE(gltf.Import({.max_triangles = 11}).ok());
  const auto imported = gltf.Import({.max_triangles = 10});
  EXPECT_EQ(imported.status().code(), absl::StatusCode::kResourceExhausted);
  EXPECT_THAT(std::string(imported.status().message()), HasSubstr("/nodes/10"));
}

TEST(GltfImporter, FindsBuffersWhoseNamesHoldBlanksAndPluses) {
  const TinyGltf gltf = TriangleGltf();
  for (const std::string name : {"a b.bin", "a+b.bin", "a%2Bb.bin", "d/e.bin", "\xc3\xa4.bin"}) {
    Json full = gltf.json;
    full["buffers"] = Json::array({{{"byteLength", gltf.bin.size()}, {"uri", name}}});
    AssetBundle asset{"scene.gltf", {{"scene.gltf", Blob::FromString(full.dump())}}};
    // The file may be longer than what the buffer uses.
    std::vector<std::byte> longer = gltf.bin;
    longer.resize(longer.size() + 5);
    asset.files[name == "a%2Bb.bin" ? "a+b.bin" : name] = Blob::FromVector(longer);
    const auto imported = ImportScene(asset, {});
    EXPECT_TRUE(imported.ok()) << name << ": " << imported.status();
  }
}

TEST(GltfImporter, ReadsBinaryContainers) {
  const TinyGltf gltf = TriangleGltf();
  Json full = gltf.json;
  full["buffers"] = Json::array({{{"byteLength", gltf.bin.size()}}});
  std::string json = full.dump();
  json.resize((json.size() + 3) / 4 * 4, ' ');
  std::string bin(reinterpret_cast<const char*>(gltf.bin.data()), gltf.bin.size());
  bin.resize((bin.size() + 3) / 4 * 4);
  const auto u32 = [](size_t v) {
    const auto value = static_cast<uint32_t>(v);
    return std::string(reinterpret_cast<const char*>(&value), 4);
  };
  const std::string glb = "glTF" + u32(2) + u32(28 + json.size() + bin.size()) + u32(json.size()) +
                          "JSON" + json + u32(bin.size()) + std::string("BIN\0", 4) + bin;
  const auto imported = ImportScene({"scene.glb", {{"scene.glb", Blob::FromString(glb)}}}, {});
  ASSERT_TRUE(imported.ok()) << imported.status();
  EXPECT_EQ(imported->scene.meshes.at(0).positions.size(), 3u);
}

TEST(GltfImporter, CopiesInstancesOfTheInstancingExtension) {
  TinyGltf gltf = TriangleGltf();
  gltf.json["extensionsRequired"] = {"EXT_mesh_gpu_instancing"};
  const float h = std::sqrt(0.5f);
  Json attributes = {{"TRANSLATION", gltf.Accessor<float>({0, 0, 0, 10, 0, 0}, 5126, "VEC3", 3)},
                     {"ROTATION", gltf.Accessor<float>({0, 0, 0, 1, 0, 0, h, h}, 5126, "VEC4", 4)},
                     {"SCALE", gltf.Accessor<float>({1, 1, 1, 2, 3, 4}, 5126, "VEC3", 3)},
                     {"_ID", gltf.Accessor<float>({5}, 5126, "SCALAR", 1)}};
  gltf.json["nodes"][0]["extensions"]["EXT_mesh_gpu_instancing"]["attributes"] = attributes;
  gltf.json["nodes"][0]["translation"] = {0, 0, 5};
  const Scene scene = ImportOk(gltf);
  ASSERT_EQ(scene.instances.size(), 2u);
  EXPECT_EQ(scene.instances[0].mesh, scene.instances[1].mesh);
  EXPECT_EQ(scene.instances[0].world_from_mesh.translation, Vec3d(0, 0, 5));
  const Affine& m = scene.instances[1].world_from_mesh;
  EXPECT_EQ(m.translation, Vec3d(10, 0, 5));
  for (int i = 0; i < 3; ++i) {
    EXPECT_NEAR(m.column[0][i], Vec3d(0, 2, 0)[i], 1e-6);
    EXPECT_NEAR(m.column[1][i], Vec3d(-3, 0, 0)[i], 1e-6);
    EXPECT_NEAR(m.column[2][i], Vec3d(0, 0, 4)[i], 1e-6);
  }
  EXPECT_EQ(gltf.Import({.max_triangles = 1}).status().code(),
            absl::StatusCode::kResourceExhausted);
  auto& places = gltf.json["nodes"][0]["extensions"]["EXT_mesh_gpu_instancing"]["attributes"];
  places["SCALE"] = gltf.Accessor<float>({1, 1, 1}, 5126, "VEC3", 3);
  EXPECT_THAT(MessageOf(gltf), HasSubstr("EXT_mesh_gpu_instancing/attributes/"));
  places = {{"TRANSLATION", gltf.json["accessors"].size()}};
  gltf.json["accessors"].push_back({{"componentType", 5126}, {"count", 1 << 24}, {"type", "VEC3"}});
  EXPECT_THAT(MessageOf(gltf), HasSubstr("has no bufferView"));
  places = {{"TRANSLATION", gltf.Accessor<float>({NAN, 0, 0}, 5126, "VEC3", 3)}};
  EXPECT_THAT(MessageOf(gltf), HasSubstr("instance 0 is not finite"));
}

TEST(GltfImporter, MultipliesTheBaseColourByColoursOfVertices) {
  TinyGltf gltf = TriangleGltf();
  gltf.json["materials"] = {{{"pbrMetallicRoughness", {{"baseColorFactor", {0.5, 1, 1, 1}}}}}};
  Primitive(gltf)["material"] = 0;
  // The same at all vertices: exact.
  Primitive(gltf)["attributes"]["COLOR_0"] =
      gltf.Accessor<float>({0.5f, 0.25f, 1, 0.5f, 0.25f, 1, 0.5f, 0.25f, 1}, 5126, "VEC3", 3);
  Scene scene = ImportOk(gltf);
  ASSERT_EQ(scene.meshes[0].material, 1);
  EXPECT_EQ(scene.materials[1].base_color, Rgb(0.25f, 0.25f, 1));
  EXPECT_EQ(scene.materials[0].base_color, Rgb(0.5f, 1, 1));
  EXPECT_THAT(NotesOf(gltf), IsEmpty());
  // Others in their mean, with a note; alpha too.
  const auto colors =
      gltf.Accessor<uint8_t>({255, 0, 0, 255, 0, 255, 0, 255, 0, 0, 255, 0}, 5121, "VEC4", 4);
  gltf.json["accessors"][colors]["normalized"] = true;
  Primitive(gltf)["attributes"]["COLOR_0"] = colors;
  Primitive(gltf).erase("material");
  scene = ImportOk(gltf);
  const Material& mean = scene.materials.at(static_cast<size_t>(scene.meshes[0].material));
  for (int c = 0; c < 3; ++c) EXPECT_NEAR(mean.base_color[c], 1 / 3.0, 1e-6);
  EXPECT_NEAR(mean.base_alpha, 2 / 3.0, 1e-6);
  EXPECT_THAT(NotesOf(gltf), HasSubstr("1 primitive with colours at the vertices"));
  gltf.json["accessors"][colors]["normalized"] = false;
  EXPECT_THAT(MessageOf(gltf), HasSubstr("/attributes/COLOR_0: accessor"));
}

TEST(GltfImporter, TakesTheDiffusePartOfSpecularGlossiness) {
  TinyGltf gltf = TriangleGltf();
  gltf.json["images"] = {{{"uri", "data:image/png;base64," + Base64(MakePng(1, 1, {0, 0, 0, 0}))}}};
  gltf.json["textures"] = {{{"source", 0}}};
  Json extension = {{"diffuseFactor", {0.1, 0.2, 0.3, 0.4}}};
  extension["diffuseTexture"] = {{"index", 0}, {"texCoord", 1}};
  extension["diffuseTexture"]["extensions"]["KHR_texture_transform"]["scale"] = {3, 4};
  gltf.json["materials"] = Json::array({Json::object()});
  gltf.json["materials"][0]["extensions"]["KHR_materials_pbrSpecularGlossiness"] = extension;
  gltf.json["extensionsRequired"] = {"KHR_materials_pbrSpecularGlossiness"};
  Scene scene = ImportOk(gltf);
  const Material& m = scene.materials.at(0);
  EXPECT_EQ(m.base_color, Rgb(0.1f, 0.2f, 0.3f));
  EXPECT_EQ(m.base_alpha, 0.4f);
  EXPECT_EQ(m.base_color_texture.texture, 0);
  EXPECT_EQ(m.base_color_texture.uv_set, 1u);
  EXPECT_EQ(m.base_color_texture.transform.scale, (Vec2f{3, 4}));
  EXPECT_GT(scene.textures.at(0).encoded.size(), 0u);
  gltf.json["materials"][0]["extensions"]["KHR_materials_pbrSpecularGlossiness"]["diffuseFactor"] =
      {1, 1, 1};
  EXPECT_THAT(MessageOf(gltf), HasSubstr("diffuseFactor: has 3 numbers"));
}

TEST(GltfImporter, NotesExtensionsThatChangeTheLook) {
  TinyGltf gltf = TriangleGltf();
  gltf.json["extensionsUsed"] = {"KHR_materials_unlit", "KHR_materials_variants",
                                 "EXT_mesh_gpu_instancing"};
  EXPECT_THAT(NotesOf(gltf),
              AllOf(HasSubstr("'KHR_materials_unlit' is ignored: its materials"),
                    HasSubstr("the default materials are shown"), Not(HasSubstr("instancing"))));
  gltf.json["extensionsRequired"] = {"KHR_materials_variants"};
  EXPECT_TRUE(gltf.Import().ok());
}

TEST(GltfImporter, SaysWhatIsWrongWithATinyGlb) {
  for (const char* text : {"", "g", "glT", "{}", "nonsense that is longer than a header"}) {
    const auto imported = ImportScene({"a.glb", {{"a.glb", Blob::FromString(text)}}}, {});
    EXPECT_THAT(std::string(imported.status().message()),
                AllOf(HasSubstr("a.glb: byte 0: is no .glb"), HasSubstr("export")));
  }
  const auto header = ImportScene({"a.glb", {{"a.glb", Blob::FromString("glTF\2")}}}, {});
  EXPECT_THAT(std::string(header.status().message()), HasSubstr("a.glb: byte 5: ends inside"));
}

TEST(GltfImporter, NamesTheAllowedRange) {
  TinyGltf gltf = TriangleGltf();
  gltf.json["materials"] = {{{"pbrMetallicRoughness", {{"metallicFactor", 1.5}}}}};
  EXPECT_THAT(MessageOf(gltf), HasSubstr("metallicFactor: is 1.5, outside of [0, 1]"));
}

TEST(GltfImporter, RefusesJsonOfAMillionLevels) {
  const std::string deep = "{\"asset\": " + std::string(1'000'000, '[');
  const auto imported = ImportScene({"a.gltf", {{"a.gltf", Blob::FromString(deep)}}}, {});
  EXPECT_THAT(std::string(imported.status().message()),
              AllOf(HasSubstr("a.gltf: byte"), HasSubstr("nested")));
}

TEST(GltfImporter, RefusesOffsetsAndCountsThatOverflow) {
  const uint64_t huge[] = {uint64_t{1} << 31, (uint64_t{1} << 32) - 1, uint64_t{1} << 32,
                           (uint64_t{1} << 63) - 1, ~uint64_t{0}};
  for (const uint64_t value : huge) {
    for (const char* field : {"/accessors/0/count", "/accessors/0/byteOffset",
                              "/bufferViews/0/byteOffset", "/bufferViews/0/byteLength"}) {
      TinyGltf gltf = TriangleGltf();
      gltf.json[Json::json_pointer(field)] = value;
      EXPECT_THAT(MessageOf(gltf), HasSubstr(std::string(field).substr(0, 10))) << value;
    }
  }
}

}  // namespace
}  // namespace farpoint

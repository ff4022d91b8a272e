#include "core/scene/obj_importer.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <algorithm>
#include <filesystem>
#include <fstream>
#include <map>

#include "core/base/executor.h"
#include "core/math/sampling.h"
#include "core/scene/image_decode.h"
#include "core/scene/prepared_scene.h"
#include "tests/unit/core/scene/scene_test_util.h"

namespace farpoint {
namespace {

using ::testing::AllOf;
using ::testing::ElementsAre;
using ::testing::HasSubstr;
using ::testing::IsEmpty;
using Triangles = std::vector<std::array<uint32_t, 3>>;

constexpr const char* kTriangle = "v 0 0 0\nv 1 0 0\nv 0 1 0\n";

absl::StatusOr<ImportedScene> Import(const std::string& obj,
                                     const std::map<std::string, std::string>& files = {},
                                     const ImportOptions& options = {}) {
  AssetBundle asset{"scene.obj", {{"scene.obj", Blob::FromString(obj)}}};
  for (const auto& [name, text] : files) asset.files[name] = Blob::FromString(text);
  return ImportScene(asset, options);
}

Scene ImportOk(const std::string& obj, const std::map<std::string, std::string>& files = {}) {
  auto imported = Import(obj, files);
  EXPECT_TRUE(imported.ok()) << imported.status();
  return imported.ok() ? std::move(imported->scene) : Scene();
}

std::string MessageOf(const std::string& obj,
                      const std::map<std::string, std::string>& files = {}) {
  const auto imported = Import(obj, files);
  return imported.ok() ? "OK" : std::string(imported.status().message());
}

std::string NotesOf(const std::string& obj, const std::map<std::string, std::string>& files = {}) {
  const auto imported = Import(obj, files);
  if (!imported.ok()) return imported.status().ToString();
  std::string all;
  for (const std::string& note : imported->notes) all += note + "\n";
  return all;
}

TEST(ObjImporter, ReadsATriangle) {
  const std::string obj = std::string("# comment\n") + kTriangle + "f 1 2 3 # the only one\n";
  const Scene scene = ImportOk(obj);
  ASSERT_EQ(scene.meshes.size(), 1u);
  ASSERT_EQ(scene.instances.size(), 1u);
  EXPECT_THAT(scene.meshes[0].positions,
              ElementsAre(Vec3f(0, 0, 0), Vec3f(1, 0, 0), Vec3f(0, 1, 0)));
  EXPECT_EQ(scene.meshes[0].triangles, (Triangles{{0, 1, 2}}));
  EXPECT_THAT(scene.meshes[0].normals, IsEmpty());  // flat
  EXPECT_EQ(scene.meshes[0].material, -1);
  EXPECT_EQ(scene.instances[0].world_from_mesh, Affine());
  EXPECT_THAT(NotesOf(obj), IsEmpty());
}

TEST(ObjImporter, CountsNegativeIndicesBackwardsFromWhereTheyStand) {
  const Scene scene = ImportOk(std::string(kTriangle) + "f -3 -2 -1\nv 5 0 0\nf -4 -1 -2\n");
  const Mesh& mesh = scene.meshes.at(0);
  ASSERT_EQ(mesh.triangles.size(), 2u);
  EXPECT_EQ(mesh.positions[mesh.triangles[1][1]], Vec3f(5, 0, 0));
  EXPECT_EQ(mesh.triangles[1][0], mesh.triangles[0][0]);
}

TEST(ObjImporter, AcceptsIndicesOfVerticesThatFollow) {
  EXPECT_EQ(ImportOk(std::string("f 1 2 3\n") + kTriangle).meshes.at(0).triangles.size(), 1u);
}

TEST(ObjImporter, JoinsCornersThatAreEqualInAllThree) {
  const Scene scene = ImportOk(
      "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0.25 0.75\nvt 1 0\nvn 0 0 2\nvn 0 1 0\n"
      "f 1/1/1 2/2/1 3/1/1\nf 1/1/1 3/1/1 4/2/2\n");
  const Mesh& mesh = scene.meshes.at(0);
  EXPECT_EQ(mesh.positions.size(), 4u);
  EXPECT_EQ(mesh.triangles, (Triangles{{0, 1, 2}, {0, 2, 3}}));
  // From the lower edge of the image to the upper one.
  EXPECT_EQ(mesh.uv[0][0], (Vec2f{0.25f, 0.25f}));
  EXPECT_EQ(mesh.normals[0], Vec3f(0, 0, 1));
  EXPECT_EQ(mesh.normals[3], Vec3f(0, 1, 0));
}

TEST(ObjImporter, SplitsFacesWithAndWithoutNormalsAndCoordinates) {
  const Scene scene = ImportOk(std::string(kTriangle) +
                               "vt 0 0\nvn 0 0 1\nf 1 2 3\nf 1//1 2//1 3//1\nf 1/1 2/1 3/1\n"
                               "f 1/1/1 2/1/1 3/1/1\nf 1/1/1 2 3//1\n");
  ASSERT_EQ(scene.meshes.size(), 4u);
  EXPECT_EQ(scene.meshes[0].triangles.size(), 2u);  // the last face too
  EXPECT_TRUE(scene.meshes[0].normals.empty() && scene.meshes[0].uv[0].empty());
  EXPECT_TRUE(!scene.meshes[1].normals.empty() && scene.meshes[1].uv[0].empty());
  EXPECT_TRUE(scene.meshes[2].normals.empty() && !scene.meshes[2].uv[0].empty());
  EXPECT_TRUE(!scene.meshes[3].normals.empty() && !scene.meshes[3].uv[0].empty());
}

TEST(ObjImporter, CutsConcavePolygons) {
  const Scene scene =
      ImportOk("v 0 0 0\nv 2 0 0\nv 2 1 0\nv 1 1 0\nv 1 2 0\nv 0 2 0\nf 1 2 3 4 \\\n 5 6\n");
  const Mesh& mesh = scene.meshes.at(0);
  double area = 0;
  for (const auto& t : mesh.triangles) {
    const Vec3d a(mesh.positions[t[0]]), b(mesh.positions[t[1]]), c(mesh.positions[t[2]]);
    const double part = Cross(b - a, c - a).z / 2;
    EXPECT_GT(part, 0);
    area += part;
  }
  EXPECT_DOUBLE_EQ(area, 3);
}

TEST(ObjImporter, MakesOneMeshOfEachObjectGroupAndMaterial) {
  const std::string obj = std::string("mtllib a.mtl\n") + kTriangle +
                          "o left\nusemtl red\nf 1 2 3\nusemtl blue metal\nf 1 2 3\nusemtl red\n"
                          "f 3 2 1\no right\ng knob\nf 1 2 3\nusemtl\nf 1 2 3\n";
  const Scene scene =
      ImportOk(obj, {{"a.mtl", "newmtl red\nKd 1 0 0\nnewmtl blue metal\nKd 0 0 1 # cold\n"}});
  ASSERT_EQ(scene.meshes.size(), 4u);
  EXPECT_EQ(scene.meshes[0].name, "left");
  EXPECT_EQ(scene.meshes[0].triangles.size(), 2u);
  EXPECT_EQ(scene.materials[static_cast<size_t>(scene.meshes[0].material)].base_color,
            Rgb(1, 0, 0));
  EXPECT_EQ(scene.materials[static_cast<size_t>(scene.meshes[1].material)].name, "blue metal");
  EXPECT_EQ(scene.meshes[2].name, "right/knob");
  EXPECT_EQ(scene.meshes[2].material, scene.meshes[0].material);
  EXPECT_EQ(scene.meshes[3].material, -1);
}

TEST(ObjImporter, ReadsMaterials) {
  const std::string obj = std::string("mtllib m.mtl\n") + kTriangle +
                          "usemtl lamp\nf 1 2 3\nusemtl glass\nf 1 2 3\nusemtl mist\nf 1 2 3\n"
                          "usemtl grey\nf 1 2 3\nusemtl plain\nf 1 2 3\n";
  const std::string mtl =
      "newmtl lamp\nKd 0.5 0.25 0.125\nKe 17 12 4\nPr 0.5\nPm 1\n"
      "newmtl glass\nd 0.25\nnewmtl mist\nTr 0.25\nnewmtl grey\nKd 0.5\nd 1\nTr 1\nnewmtl plain\n";
  const Scene scene = ImportOk(obj, {{"m.mtl", mtl}});
  ASSERT_EQ(scene.materials.size(), 5u);
  const auto find = [&](const std::string& name) {
    return *std::find_if(scene.materials.begin(), scene.materials.end(),
                         [&](const Material& m) { return m.name == name; });
  };
  EXPECT_EQ(find("lamp").base_color, Rgb(0.5f, 0.25f, 0.125f));
  EXPECT_EQ(find("lamp").emission, Rgb(17, 12, 4));  // radiance as it stands
  EXPECT_EQ(find("lamp").roughness, 0.5f);
  EXPECT_EQ(find("lamp").metallic, 1);
  EXPECT_EQ(find("glass").alpha_mode, AlphaMode::kMask);
  EXPECT_EQ(find("glass").base_alpha, 0.25f);
  EXPECT_EQ(find("mist").alpha_mode, AlphaMode::kOpaque);  // 0.75 cuts nothing out
  EXPECT_EQ(find("grey").base_color, Rgb(0.5f));
  EXPECT_EQ(find("grey").alpha_mode, AlphaMode::kOpaque);  // d wins over Tr
  EXPECT_EQ(find("plain").base_color, Rgb(1));
  EXPECT_EQ(find("plain").metallic, 0);
  EXPECT_THAT(NotesOf(obj, {{"m.mtl", mtl}}), HasSubstr("2 materials of d, Tr or map_d"));
}

TEST(ObjImporter, ReadsTexturesWithOptionsBlanksAndBackslashes) {
  const std::string obj = std::string("mtllib sub dir/m.mtl\n") + kTriangle +
                          "vt 0 0\nusemtl a\nf 1/1 2/1 3/1\nusemtl b\nf 1/1 2/1 3/1\n";
  const std::string png = MakePng(1, 1, {10, 20, 30, 40});
  const std::map<std::string, std::string> files = {
      {"sub dir/m.mtl",
       "newmtl a\nKd 0 0 0\nmap_Kd -s 2 3 -o 0.5 0.25 0 -clamp on -bm 2 maps\\my wall.png\n"
       "newmtl b\nmap_Kd C:\\Users\\me\\my wall.png\nmap_Ke ..\\lamp.png\n"
       "newmtl c\nmap_Kd nowhere.png\n"},
      {"sub dir/maps/my wall.png", png},
      {"my wall.png", png},
      {"lamp.png", png}};
  const Scene scene = ImportOk(obj, files);
  ASSERT_EQ(scene.materials.size(), 2u);
  const Material& a = scene.materials[0];
  EXPECT_EQ(a.base_color, Rgb(1));  // Kd 0 would hide the texture
  EXPECT_EQ(a.alpha_mode, AlphaMode::kOpaque);
  const Texture& wall = scene.textures[static_cast<size_t>(a.base_color_texture.texture)];
  EXPECT_EQ(wall.name, "sub dir/maps/my wall.png");
  EXPECT_EQ(wall.wrap_s, WrapMode::kClampToEdge);
  EXPECT_EQ(a.base_color_texture.transform.scale, (Vec2f{2, 3}));
  // v = 1 - t from below: 3 v + 0.25 is 1 - t' with t' = 3 t + (1 - 3 - 0.25).
  EXPECT_EQ(a.base_color_texture.transform.offset, (Vec2f{0.5f, -2.25f}));
  const Material& b = scene.materials[1];
  EXPECT_EQ(scene.textures[static_cast<size_t>(b.base_color_texture.texture)].name, "my wall.png");
  EXPECT_EQ(b.emission, Rgb(1));
  EXPECT_EQ(scene.textures[static_cast<size_t>(b.emission_texture.texture)].name, "lamp.png");
  EXPECT_EQ(scene.textures[static_cast<size_t>(b.emission_texture.texture)].wrap_s,
            WrapMode::kRepeat);
}

TEST(ObjImporter, JoinsMapDToMapKd) {
  const std::string obj =
      std::string("mtllib m.mtl\n") + kTriangle + "vt 0 0\nusemtl a\nf 1/1 2/1 3/1\n";
  const auto texels = [&](const std::string& mtl,
                          const std::map<std::string, std::string>& images) {
    std::map<std::string, std::string> files = images;
    files["m.mtl"] = mtl;
    const Scene scene = ImportOk(obj, files);
    const Material& material = scene.materials.at(0);
    EXPECT_EQ(material.alpha_mode, AlphaMode::kMask);
    EXPECT_EQ(material.alpha_cutoff, 0.5f);
    const Texture& texture =
        scene.textures.at(static_cast<size_t>(material.base_color_texture.texture));
    return DecodeImage("joined", texture.encoded.bytes())->texels;
  };
  const std::string color = MakePng(1, 1, {200, 100, 50, 255});
  const std::string mask = MakePng(2, 1, {0, 0, 0, 255, 255, 255, 255, 255});
  const std::string alpha = MakePng(2, 1, {9, 9, 9, 255, 8, 8, 8, 7});
  EXPECT_THAT(texels("newmtl a\nmap_Kd c.png\nmap_d m.png\n", {{"c.png", color}, {"m.png", mask}}),
              ElementsAre(0x003264c8u, 0xff3264c8u));
  EXPECT_THAT(texels("newmtl a\nmap_d m.png\n", {{"m.png", mask}}),
              ElementsAre(0x00ffffffu, 0xffffffffu));
  EXPECT_THAT(texels("newmtl a\nmap_Kd t.png\nmap_d t.png\n", {{"t.png", alpha}}),
              ElementsAre(0xff090909u, 0x07080808u));
}

TEST(ObjImporter, NamesWhatIsMissing) {
  const std::string obj = std::string("mtllib m.mtl\n") + kTriangle + "usemtl a\nf 1 2 3\n";
  EXPECT_EQ(Import(obj).status().code(), absl::StatusCode::kNotFound);
  EXPECT_THAT(MessageOf(obj), AllOf(HasSubstr("scene.obj: line 1: mtllib"), HasSubstr("'m.mtl'"),
                                    HasSubstr("put the file")));
  EXPECT_THAT(MessageOf(obj, {{"m.mtl", "\nnewmtl a\n map_Kd  x y.png\n"}}),
              AllOf(HasSubstr("m.mtl: line 3"), HasSubstr("'x y.png'"), HasSubstr("put the file")));
  // A material that nothing uses needs no textures.
  EXPECT_EQ(MessageOf(obj, {{"m.mtl", "newmtl a\nnewmtl b\nmap_Kd x.png\n"}}), "OK");
  EXPECT_THAT(NotesOf(obj, {{"m.mtl", "newmtl b\n"}}),
              AllOf(HasSubstr("'a' in line 5"), HasSubstr("white")));
  EXPECT_EQ(MessageOf(std::string("mtllib a.mtl  b\\ c.mtl\n") + kTriangle,
                      {{"a.mtl", ""}, {"b c.mtl", ""}}),
            "OK");
}

TEST(ObjImporter, RefusesWithTheLine) {
  const std::pair<std::string, const char*> refusals[] = {
      {"v 1 2\n", "line 1: the position has 2 numbers instead of 3"},
      {"v 0 0 0\nv nan 0 0\n", "line 2: 'nan' of the position is not finite"},
      {"v 1e39 0 0\n", "line 1: the position is beyond"},
      {"v 1 x 0\n", "line 1: 'x' of the position is no number"},
      {"vt\n", "line 1: the texture coordinate has 0"},
      {"vn 1 0\n", "line 1: the normal has 2"},
      {"v 0 0 0\nf 1 1 0\n", "line 2: index 0"},
      {"v 0 0 0\nf 1 1 4294967297\n", "line 2: index 4294967297 of a position is beyond 2^32"},
      {"v 0 0 0\nf 1 1 99999999999999999999\n", "line 2: '99999999999999999999' is no index"},
      {"v 0 0 0\n\nf 1 1 2\n", "line 3: index 2 of a position is beyond the 1"},
      {"v 0 0 0\nf 1 1 -2\n", "line 2: index -2 of a position is before the first of the 1"},
      {"v 0 0 0\nf 1/1 1/1 1/1\n", "line 2: index 1 of a texture coordinate is beyond the 0"},
      {"v 0 0 0\nf 1//1 1//1 1//1\n", "line 2: index 1 of a normal is beyond the 0"},
      {"v 0 0 0\nf 1/a 1 1\n", "line 2: 'a' is no index"},
      {"hello\nworld\n", "line 1: holds no statement"},
      {"", "line 1: holds no statement"},
      {std::string("\xff\xfev\0 \0", 6), "UTF-16"}};
  for (const auto& [obj, expected] : refusals) {
    EXPECT_THAT(MessageOf(obj), AllOf(HasSubstr("scene.obj: "), HasSubstr(expected)));
    EXPECT_EQ(Import(obj).status().code(), absl::StatusCode::kInvalidArgument);
  }
  const std::string base = std::string("mtllib m.mtl\n") + kTriangle + "usemtl a\nf 1 2 3\n";
  for (const auto& [mtl, expected] : std::initializer_list<std::pair<const char*, const char*>>{
           {"newmtl a\nKd 1 red 0\n", "m.mtl: line 2: Kd holds 'red'"},
           {"newmtl a\nKd 1 1\n", "m.mtl: line 2: Kd has two numbers"},
           {"newmtl a\nKe -1 0 0\n", "m.mtl: line 2: Ke holds '-1'"},
           {"newmtl a\nd 2\n", "m.mtl: line 2: d is '2' instead of a number in [0, 1]"},
           {"newmtl a\nmap_Kd -s 2\n", "m.mtl: line 2: a texture map names no file"}}) {
    EXPECT_THAT(MessageOf(base, {{"m.mtl", mtl}}), HasSubstr(expected));
  }
}

TEST(ObjImporter, NotesWhatItLeavesOut) {
  const std::string notes =
      NotesOf(std::string(kTriangle) +
              "s 1\nl 1 2\np 1\nf 1 2\nf 1 2 3\nf 1 1 1 1\ncstype bezier\nfoo bar\n");
  EXPECT_THAT(notes, AllOf(HasSubstr("2 statements of points or lines"),
                           HasSubstr("1 face of fewer than 3"), HasSubstr("smoothing groups"),
                           HasSubstr("cstype"), HasSubstr("'foo' in line 11"),
                           HasSubstr("1 face that cross")));
}

TEST(ObjImporter, ShowsColoursOfVerticesInTheirMean) {
  const Scene scene = ImportOk("v 0 0 0 1 0 0\nv 1 0 0 1 0 0\nv 0 1 0 1 0.75 0\nf 1 2 3\n");
  ASSERT_EQ(scene.materials.size(), 1u);
  EXPECT_EQ(scene.meshes[0].material, 0);
  EXPECT_FLOAT_EQ(scene.materials[0].base_color.x, 1);
  EXPECT_FLOAT_EQ(scene.materials[0].base_color.y, 0.25f);
}

TEST(ObjImporter, KeepsDetailFarFromZero) {
  const Scene scene =
      ImportOk("v 10000000.125 0 0\nv 10000001.25 0 0\nv 10000000.125 1 0\nf 1 2 3\n");
  const Instance& instance = scene.instances.at(0);
  const Mesh& mesh = scene.meshes.at(0);
  const double x[] = {10000000.125, 10000001.25, 10000000.125};
  for (size_t v = 0; v < 3; ++v) {
    EXPECT_EQ(instance.world_from_mesh.Point(Vec3d(mesh.positions[v])).x, x[v]);
  }
}

TEST(ObjImporter, StopsAtItsLimits) {
  const std::string two = std::string(kTriangle) + "f 1 2 3\nf 1 2 3\n";
  const auto many = Import(two, {}, {.max_triangles = 1});
  EXPECT_EQ(many.status().code(), absl::StatusCode::kResourceExhausted);
  EXPECT_THAT(std::string(many.status().message()), HasSubstr("line 5"));
  std::string polygon = std::string(kTriangle) + "f";
  for (size_t i = 0; i < 10'001; ++i) polygon += " 1";
  EXPECT_THAT(MessageOf(polygon), HasSubstr("10001 corners"));
  // More groups than meshes are made of.
  std::string groups = kTriangle;
  for (int i = 0; i < 70'000; ++i) groups += "g g" + std::to_string(i) + "\nf 1 2 3\n";
  const Scene scene = ImportOk(groups);
  EXPECT_EQ(scene.meshes.size(), 65'537u);
}

TEST(ObjImporter, SurvivesDamagedText) {
  Executor executor(1);
  const std::string obj = std::string("mtllib m.mtl\n") + kTriangle +
                          "v 1 1 0 0.5 0.5 0.5\nvt 0 1\nvt 1 0\nvn 0 0 1\no a\ng b\nusemtl a\n"
                          "f 1/1/1 2/2/1 4/1/1 3/2/1\nf -1 -2 -3\nusemtl b\nf 1//1 2//1 3//1\n";
  const std::string mtl =
      "newmtl a\nKd 1 0.5 0\nKe 0 1 0\nd 0.4\nmap_Kd -s 1 2 t.png\nnewmtl b\n"
      "map_d t.png\n";
  const std::string png = MakePng(1, 1, {1, 2, 3, 100});
  size_t scenes = 0;
  for (uint64_t i = 0; i < 4000; ++i) {
    std::string texts[2] = {obj, mtl};
    std::string& text = texts[i % 2];
    for (uint64_t k = 0; k <= i % 3; ++k) {
      const uint64_t r = HashKey(i, k);
      const size_t at = r % text.size();
      switch (r >> 60 & 3) {
        case 0:
          text[at] = static_cast<char>(r >> 32);
          break;
        case 1:
          text.erase(at, 1 + (r >> 40) % 9);
          break;
        case 2:
          text.insert(at, text.substr((r >> 24) % text.size(), (r >> 50) % 30));
          break;
        default:
          text[at] = static_cast<char>('0' + (r >> 32) % 10);
          break;
      }
    }
    const auto imported = Import(texts[0], {{"m.mtl", texts[1]}, {"t.png", png}});
    if (!imported.ok()) {
      EXPECT_THAT(std::string(imported.status().message()),
                  ::testing::ContainsRegex("line [0-9]+"));
      continue;
    }
    ++scenes;
    const auto prepared = PreparedScene::Prepare(imported->scene, executor);
    EXPECT_TRUE(prepared.ok() || prepared.status().code() == absl::StatusCode::kInvalidArgument)
        << prepared.status();
  }
  EXPECT_GT(scenes, 500u);
}

TEST(ObjImporter, CollectsTheFilesThatItNeedsFromTheDisk) {
  const auto folder = std::filesystem::path(::testing::TempDir()) / "obj_collect";
  std::filesystem::remove_all(folder);
  std::filesystem::create_directories(folder / "maps");
  const auto write = [&](const std::string& name, const std::string& text) {
    std::ofstream(folder / name, std::ios::binary) << text;
  };
  write("my scene.obj", std::string("mtllib my mat.mtl\n") + kTriangle + "usemtl a\nf 1 2 3\n");
  write("my mat.mtl", "newmtl a\nmap_Kd maps\\a b.png\nmap_Bump maps/bump.png\n");
  const auto missing = CollectAsset((folder / "my scene.obj").string());
  EXPECT_EQ(missing.status().code(), absl::StatusCode::kNotFound);
  EXPECT_THAT(std::string(missing.status().message()),
              AllOf(HasSubstr("my scene.obj: my mat.mtl: line 2"), HasSubstr("a b.png")));
  write("maps/a b.png", MakePng(1, 1, {1, 2, 3, 4}));
  const auto asset = CollectAsset((folder / "my scene.obj").string());
  ASSERT_TRUE(asset.ok()) << asset.status();
  EXPECT_EQ(asset->files.size(), 3u);
  EXPECT_TRUE(ImportScene(*asset, {}).ok());
  std::filesystem::remove_all(folder);
}

}  // namespace
}  // namespace farpoint

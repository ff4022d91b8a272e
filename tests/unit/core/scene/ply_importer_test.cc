#include "core/scene/ply_importer.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <algorithm>
#include <bit>
#include <cmath>

#include "core/base/executor.h"
#include "core/math/elementary.h"
#include "core/math/sampling.h"
#include "core/scene/prepared_scene.h"
#include "tests/unit/core/scene/scene_test_util.h"

namespace farpoint {
namespace {

using ::testing::AllOf;
using ::testing::ElementsAre;
using ::testing::HasSubstr;
using ::testing::IsEmpty;
using Triangles = std::vector<std::array<uint32_t, 3>>;

absl::StatusOr<ImportedScene> Import(const std::string& ply, const ImportOptions& options = {}) {
  return ImportScene({"a.ply", {{"a.ply", Blob::FromString(ply)}}}, options);
}
Scene ImportOk(const std::string& ply) {
  auto imported = Import(ply);
  EXPECT_TRUE(imported.ok()) << imported.status();
  return imported.ok() ? std::move(imported->scene) : Scene();
}
std::string MessageOf(const std::string& ply) {
  const auto imported = Import(ply);
  return imported.ok() ? "OK" : std::string(imported.status().message());
}
std::string NotesOf(const std::string& ply) {
  const auto imported = Import(ply);
  if (!imported.ok()) return imported.status().ToString();
  std::string all;
  for (const std::string& note : imported->notes) all += note + "\n";
  return all;
}

std::string Header(const std::string& format, size_t vertices, size_t faces) {
  return "ply\nformat " + format + " 1.0\ncomment made by hand\nelement vertex " +
         std::to_string(vertices) +
         "\nproperty float x\nproperty double y\nproperty short z\nelement face " +
         std::to_string(faces) +
         "\nproperty uchar flags\nproperty list uchar int vertex_indices\nend_header\n";
}
const char* const kAscii = "0 0 0\n1 0.5 0\n0 1 -2\n1 1 0\n7 3 0 1 2\n7 4 0 1 3 2\n";

// The same in binary.
std::string Binary(bool big) {
  std::string bytes;
  const auto put = [&](auto value) {
    char raw[sizeof(value)];
    std::memcpy(raw, &value, sizeof(value));
    if (big) std::reverse(raw, raw + sizeof(value));
    bytes.append(raw, sizeof(value));
  };
  const double vertices[4][3] = {{0, 0, 0}, {1, 0.5, 0}, {0, 1, -2}, {1, 1, 0}};
  for (const auto& v : vertices) {
    put(static_cast<float>(v[0]));
    put(v[1]);
    put(static_cast<int16_t>(v[2]));
  }
  for (const std::vector<int32_t>& face :
       {std::vector<int32_t>{0, 1, 2}, std::vector<int32_t>{0, 1, 3, 2}}) {
    put(uint8_t{7});
    put(static_cast<uint8_t>(face.size()));
    for (const int32_t v : face) put(v);
  }
  return bytes;
}

TEST(PlyImporter, ReadsTheSameFromEveryFormat) {
  for (const std::string& ply :
       {Header("ascii", 4, 2) + kAscii, Header("binary_little_endian", 4, 2) + Binary(false),
        Header("binary_big_endian", 4, 2) + Binary(true)}) {
    const Scene scene = ImportOk(ply);
    ASSERT_EQ(scene.meshes.size(), 1u);
    EXPECT_THAT(scene.meshes[0].positions,
                ElementsAre(Vec3f(0, 0, 0), Vec3f(1, 0.5f, 0), Vec3f(0, 1, -2), Vec3f(1, 1, 0)));
    ASSERT_EQ(scene.meshes[0].triangles.size(), 3u);
    EXPECT_EQ(scene.meshes[0].triangles[0], (std::array<uint32_t, 3>{0, 1, 2}));
    EXPECT_THAT(scene.meshes[0].normals, IsEmpty());
    EXPECT_EQ(scene.meshes[0].material, -1);
    EXPECT_EQ(scene.instances.size(), 1u);
    EXPECT_THAT(NotesOf(ply), IsEmpty());
  }
}

TEST(PlyImporter, ReadsEveryTypeUnderBothNames) {
  std::string header = "ply\r\nformat ascii 1.0\r\nelement vertex 3\r\n";
  const char* types[] = {"char",   "int8",    "uchar",  "uint8",  "short", "int16",
                         "ushort", "uint16",  "int",    "int32",  "uint",  "uint32",
                         "float",  "float32", "double", "float64"};
  for (const char* type : types) header += std::string("property ") + type + " p\r\n";
  header +=
      "property float x\r\nproperty float y\r\nproperty float z\r\n"
      "property list uint8 float32 weights\r\n"
      "element face 1\r\nproperty list ushort uint vertex_index\r\nend_header\r\n";
  std::string rows;
  for (const char* position : {"0 0 0", "1 0 0", "0 1 0"}) {
    rows += "1 2 3 4 5 6 7 8 9 10 11 12 13 14 15 16 " + std::string(position) + " 2 0.5 0.5\r\n";
  }
  EXPECT_EQ(ImportOk(header + rows + "3 2 1 0\r\n").meshes.at(0).triangles, (Triangles{{2, 1, 0}}));
}

TEST(PlyImporter, ReadsNormalsAndColours) {
  const Scene scene = ImportOk(
      "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\n"
      "property float z\nproperty float nx\nproperty float ny\nproperty float nz\n"
      "property uchar red\nproperty uchar green\nproperty uchar blue\nelement face 1\n"
      "property list uchar int vertex_indices\nend_header\n"
      "0 0 0 0 0 2 255 188 0\n1 0 0 0 3 0 255 188 0\n0 1 0 0 0 1 255 188 0\n3 0 1 2\n");
  EXPECT_THAT(scene.meshes.at(0).normals,
              ElementsAre(Vec3f(0, 0, 1), Vec3f(0, 1, 0), Vec3f(0, 0, 1)));
  ASSERT_EQ(scene.materials.size(), 1u);
  EXPECT_EQ(scene.meshes[0].material, 0);
  // 8-bit colours are sRGB.
  EXPECT_FLOAT_EQ(scene.materials[0].base_color.x, 1);
  EXPECT_NEAR(scene.materials[0].base_color.y, SrgbToLinear(188 / 255.0), 1e-6);
  EXPECT_EQ(scene.materials[0].base_color.z, 0);
}

TEST(PlyImporter, ReadsTriangleStrips) {
  const Scene scene = ImportOk(
      "ply\nformat ascii 1.0\nelement vertex 5\nproperty float x\nproperty float y\n"
      "property float z\nelement tristrips 1\nproperty list int int vertex_indices\nend_header\n"
      "0 0 0\n1 0 0\n0 1 0\n1 1 0\n0 2 0\n9 0 1 2 3 -1 2 3 4 -1\n");
  EXPECT_EQ(scene.meshes.at(0).triangles, (Triangles{{0, 1, 2}, {1, 3, 2}, {2, 3, 4}}));
}

TEST(PlyImporter, NotesWhatItLeavesOut) {
  EXPECT_THAT(NotesOf("ply\nformat ascii 1.0\ncomment TextureFile skin a.png\n"
                      "element camera 1\nproperty float f\nproperty list uchar int l\n"
                      "element vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
                      "element face 2\nproperty list uchar int vertex_indices\nend_header\n"
                      "0.5 2 7 8\n0 0 0\n1 0 0\n0 1 0\n2 0 1\n3 0 1 2\n"),
              AllOf(HasSubstr("elements ignored: camera"), HasSubstr("1 faces of fewer than 3"),
                    HasSubstr("'skin a.png'")));
  EXPECT_THAT(NotesOf("ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\n"
                      "property float y\nproperty float z\nend_header\n0 0 0\n"),
              HasSubstr("its 1 points are not shown"));
}

TEST(PlyImporter, RefusesHeadersWithTheLine) {
  const std::pair<const char*, const char*> refusals[] = {
      {"", "line 1: does not start with 'ply'"},
      {"plx\n", "line 1: does not start with 'ply'"},
      {"ply\nformat ascii 1.0\n", "line 3: the header has no 'end_header'"},
      {"ply\nend_header\n", "line 2: the header has no 'format'"},
      {"ply\nformat ascii 2.0\n", "line 2: the version is '2.0'"},
      {"ply\nformat text 1.0\n", "line 2: the format is 'text'"},
      {"ply\nformat ascii 1.0\nelement vertex -1\n", "line 3: expected 'element NAME COUNT'"},
      {"ply\nformat ascii 1.0\nelement vertex\n", "line 3: expected 'element NAME COUNT'"},
      {"ply\nformat ascii 1.0\nproperty float x\n", "line 3: a property before"},
      {"ply\nformat ascii 1.0\nelement vertex 0\nproperty half x\n", "line 4: 'half' is no type"},
      {"ply\nformat ascii 1.0\nelement f 0\nproperty list float int x\n", "line 4: 'float' is no"},
      {"ply\nformat ascii 1.0\nelements 4\n", "line 3: 'elements' is no statement"},
      {"ply\nformat ascii 1.0\nend_header\n", "has no 'element vertex'"},
      {"ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nend_header\n",
       "no properties x, y and z"}};
  for (const auto& [ply, expected] : refusals) {
    EXPECT_THAT(MessageOf(ply), AllOf(HasSubstr("a.ply: "), HasSubstr(expected)));
    EXPECT_EQ(Import(ply).status().code(), absl::StatusCode::kInvalidArgument);
  }
}

TEST(PlyImporter, RefusesDataWithItsPlace) {
  const std::string head = Header("ascii", 4, 2);
  const std::pair<const char*, const char*> refusals[] = {
      {"0 0 0\n1 0 0\n0 x 0\n1 1 0\n7 3 0 1 2\n7 3 0 1 2\n", "vertex 2, line 14: 'x' for 'y'"},
      {"0 0 0\n1 0 0\n0 1 0\nnan 1 0\n7 3 0 1 2\n7 3 0 1 2\n", "vertex 3, line 15: the position"},
      {"0 0 0\n1 0 0\n0 1 0\n1 nan 0\n7 3 0 1 2\n7 3 0 1 2\n", "vertex 3, line 15: the position"},
      {"0 0 0\n1 0 0\n0 1 0\n1 1e60 0\n7 3 0 1 2\n7 3 0 1 2\n", "vertex 3, line 15: the position"},
      {"0 0 0\n1 0 0\n0 1 0\n1 1 0\n7 3 0 1 2\n7 3 0 1 4\n", "face 1: vertex index 4 is beyond"},
      {"0 0 0\n1 0 0\n0 1 0\n1 1 0\n7 3 0 1 -2\n7 3 0 1 3\n", "face 0, line 16: a vertex index"},
      {"0 0 0\n1 0 0\n0 1 0\n1 1 0\n7 9999 1 2 3\n7 3 0 1\n", "face 0, line 16: the list"},
      {"0 0 0\n1 0 0\n0 1 0\n1 1 0\n7 2.5 1 2 3\n7 3 0 1\n", "face 0, line 16: the list"},
      {"0 0 0\n1 0 0\n0 1 0\n1 1 0\n7 3 0 1 2\n7 3 0 1   \n", "face 1, line 18: the file ends"}};
  for (const auto& [data, expected] : refusals) {
    EXPECT_THAT(MessageOf(head + data), HasSubstr(expected)) << data;
  }
  EXPECT_THAT(MessageOf(Header("binary_big_endian", 4, 2) + Binary(true).substr(0, 70)),
              AllOf(HasSubstr("face 1, byte 279"), HasSubstr("correct the file")));
}

// A count of the header allocates nothing that the file does not hold.
TEST(PlyImporter, RefusesCountsBeyondTheFile) {
  for (const char* format : {"ascii", "binary_little_endian"}) {
    for (const size_t count : {size_t{100}, size_t{4294967295}, size_t{9223372036854775807u}}) {
      EXPECT_THAT(MessageOf(Header(format, count, 0)), HasSubstr("elements 'vertex'"));
      EXPECT_THAT(MessageOf(Header(format, 0, count)), HasSubstr("elements 'face'"));
    }
  }
  // Elements without properties take no bytes, however many there are.
  EXPECT_EQ(MessageOf("ply\nformat ascii 1.0\nelement nothing 9223372036854775807\n"
                      "element vertex 0\nproperty float x\nproperty float y\nproperty float z\n"
                      "end_header\n"),
            "OK");
  EXPECT_EQ(Import(Header("ascii", 4, 2) + kAscii, {.max_triangles = 2}).status().code(),
            absl::StatusCode::kResourceExhausted);
}

TEST(PlyImporter, SurvivesEveryTruncationAndDamage) {
  Executor executor(1);
  const std::string files[] = {Header("ascii", 4, 2) + kAscii,
                               Header("binary_little_endian", 4, 2) + Binary(false),
                               Header("binary_big_endian", 4, 2) + Binary(true)};
  const auto look = [&](const std::string& ply) {
    const auto imported = Import(ply);
    if (!imported.ok()) {
      EXPECT_THAT(std::string(imported.status().message()),
                  ::testing::ContainsRegex(
                      "a.ply: (line [0-9]+|header|.+ [0-9]+(, (line|byte) [0-9]+)?): "));
      return;
    }
    const auto prepared = PreparedScene::Prepare(imported->scene, executor);
    EXPECT_TRUE(prepared.ok() || prepared.status().code() == absl::StatusCode::kInvalidArgument)
        << prepared.status();
  };
  for (const std::string& file : files) {
    for (size_t size = 0; size < file.size(); ++size) look(file.substr(0, size));
    for (uint64_t i = 0; i < 2000; ++i) {
      std::string damaged = file;
      for (uint64_t k = 0; k <= i % 3; ++k) {
        const uint64_t r = HashKey(i, k);
        damaged[r % damaged.size()] = static_cast<char>(r >> 32);
      }
      look(damaged);
    }
  }
}

}  // namespace
}  // namespace farpoint

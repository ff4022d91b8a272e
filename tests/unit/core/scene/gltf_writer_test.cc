// WriteGltf (core/scene/procedural.h, gltf_writer.cc).
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <filesystem>
#include <fstream>
#include <sstream>

#include "core/scene/importer.h"
#include "core/scene/procedural.h"
#include "tests/unit/core/scene/scene_test_util.h"

namespace farpoint {
namespace {

using ::testing::HasSubstr;

class GltfWriterTest : public ::testing::Test {
 protected:
  GltfWriterTest() {
    folder_ =
        std::filesystem::path(::testing::TempDir()) /
        ("writer_" + std::string(::testing::UnitTest::GetInstance()->current_test_info()->name()));
    std::filesystem::remove_all(folder_);
    std::filesystem::create_directories(folder_);
  }
  ~GltfWriterTest() override { std::filesystem::remove_all(folder_); }

  Scene RoundTrip(const Scene& scene, const std::string& name) {
    const std::string path = (folder_ / name).string();
    const absl::Status written = WriteGltf(scene, path);
    EXPECT_TRUE(written.ok()) << written;
    const auto asset = CollectAsset(path);
    EXPECT_TRUE(asset.ok()) << asset.status();
    auto imported = ImportScene(*asset, {});
    EXPECT_TRUE(imported.ok()) << imported.status();
    EXPECT_TRUE(imported->notes.empty()) << imported->notes[0];
    return std::move(imported->scene);
  }

  std::filesystem::path folder_;
};

void ExpectClose(const Rgb& a, const Rgb& b) {
  for (int c = 0; c < 3; ++c) EXPECT_NEAR(a[c], b[c], 1e-6 * std::abs(b[c]));
}
void ExpectClose(const Vec3d& a, const Vec3d& b) {
  for (int c = 0; c < 3; ++c) EXPECT_NEAR(a[c], b[c], 1e-12 * (1 + std::abs(b[c])));
}
void ExpectSame(const TextureRef& a, const TextureRef& b) {
  EXPECT_EQ(a.texture, b.texture);
  if (!a.present()) return;
  EXPECT_EQ(a.uv_set, b.uv_set);
  EXPECT_EQ(a.transform.offset, b.transform.offset);
  EXPECT_EQ(a.transform.scale, b.transform.scale);
  EXPECT_EQ(a.transform.rotation_rad, b.transform.rotation_rad);
}

void ExpectSame(const Scene& a, const Scene& b) {
  ASSERT_EQ(a.meshes.size(), b.meshes.size());
  for (size_t m = 0; m < a.meshes.size(); ++m) {
    EXPECT_EQ(a.meshes[m].name, b.meshes[m].name);
    EXPECT_EQ(a.meshes[m].material, b.meshes[m].material);
    EXPECT_TRUE(a.meshes[m].positions == b.meshes[m].positions) << b.meshes[m].name;
    EXPECT_TRUE(a.meshes[m].normals == b.meshes[m].normals);
    EXPECT_TRUE(a.meshes[m].uv == b.meshes[m].uv);
    EXPECT_TRUE(a.meshes[m].triangles == b.meshes[m].triangles);
  }
  ASSERT_EQ(a.instances.size(), b.instances.size());
  for (size_t i = 0; i < a.instances.size(); ++i) {
    EXPECT_EQ(a.instances[i].name, b.instances[i].name);
    EXPECT_EQ(a.instances[i].mesh, b.instances[i].mesh);
    EXPECT_TRUE(a.instances[i].world_from_mesh == b.instances[i].world_from_mesh) << i;
  }
  ASSERT_EQ(a.materials.size(), b.materials.size());
  for (size_t m = 0; m < a.materials.size(); ++m) {
    const Material &x = a.materials[m], &y = b.materials[m];
    EXPECT_EQ(x.name, y.name);
    EXPECT_EQ(x.base_color, y.base_color);
    EXPECT_EQ(x.base_alpha, y.base_alpha);
    ExpectClose(x.emission, y.emission);
    EXPECT_EQ(x.alpha_mode, y.alpha_mode);
    if (x.alpha_mode == AlphaMode::kMask) {
      EXPECT_EQ(x.alpha_cutoff, y.alpha_cutoff);
    }
    EXPECT_EQ(x.metallic, y.metallic);
    EXPECT_EQ(x.roughness, y.roughness);
    ExpectSame(x.base_color_texture, y.base_color_texture);
    ExpectSame(x.emission_texture, y.emission_texture);
  }
  ASSERT_EQ(a.textures.size(), b.textures.size());
  for (size_t t = 0; t < a.textures.size(); ++t) {
    EXPECT_EQ(a.textures[t].encoded.Hash(), b.textures[t].encoded.Hash());
    EXPECT_EQ(a.textures[t].wrap_s, b.textures[t].wrap_s);
    EXPECT_EQ(a.textures[t].wrap_t, b.textures[t].wrap_t);
    EXPECT_EQ(a.textures[t].nearest, b.textures[t].nearest);
  }
  ASSERT_EQ(a.lights.size(), b.lights.size());
  for (size_t l = 0; l < a.lights.size(); ++l) {
    EXPECT_EQ(a.lights[l].kind, b.lights[l].kind);
    ExpectClose(a.lights[l].intensity, b.lights[l].intensity);
    ExpectClose(a.lights[l].position, b.lights[l].position);
    if (a.lights[l].kind != PunctualKind::kPoint) {
      ExpectClose(a.lights[l].direction, b.lights[l].direction);
    }
    EXPECT_EQ(a.lights[l].range_m, b.lights[l].range_m);
    if (a.lights[l].kind == PunctualKind::kSpot) {
      EXPECT_EQ(a.lights[l].inner_cone_rad, b.lights[l].inner_cone_rad);
      EXPECT_EQ(a.lights[l].outer_cone_rad, b.lights[l].outer_cone_rad);
    }
  }
  ASSERT_EQ(a.cameras.size(), b.cameras.size());
  for (size_t c = 0; c < a.cameras.size(); ++c) {
    EXPECT_EQ(a.cameras[c].name, b.cameras[c].name);
    ExpectClose(a.cameras[c].eye, b.cameras[c].eye);
    ExpectClose(a.cameras[c].forward, b.cameras[c].forward);
    ExpectClose(a.cameras[c].up, b.cameras[c].up);
    ExpectClose(a.cameras[c].right, b.cameras[c].right);
    EXPECT_EQ(a.cameras[c].yfov_rad, b.cameras[c].yfov_rad);
  }
  EXPECT_EQ(a.environment.sky, b.environment.sky);
}

// A scene with all that the writer knows.
Scene FullScene() {
  Scene scene = MakeCornellBox();
  Texture texture;
  texture.encoded = Blob::FromString(MakePng(1, 1, {1, 2, 3, 4}));
  texture.wrap_t = WrapMode::kMirroredRepeat;
  scene.textures = {texture, texture};
  scene.textures[1].nearest = true;
  scene.textures[1].wrap_s = WrapMode::kClampToEdge;
  Material& material = scene.materials[0];
  material.alpha_mode = AlphaMode::kMask;
  material.alpha_cutoff = 0.3f;
  material.base_alpha = 0.9f;
  material.base_color_texture = {0, 1, {{0.1f, 0.2f}, {3, 4}, 0.5f}};
  material.emission = {0.25f, 0.5f, 0.125f};
  material.emission_texture = {1, 0, {}};
  Mesh& mesh = scene.meshes[0];
  for (size_t v = 0; v < mesh.positions.size(); ++v) {
    mesh.normals.push_back({0, 1, 0});
    mesh.uv[0].push_back({static_cast<float>(v), 0.5f});
    mesh.uv[1].push_back({0.25f, static_cast<float>(v)});
  }
  for (Mesh& m : scene.meshes) {
    if (m.uv[0].empty()) m.uv[0] = m.uv[1] = std::vector<Vec2f>(m.positions.size());
  }
  scene.instances[3].world_from_mesh.column[0] = {0, 0, -1.25};
  scene.instances[3].world_from_mesh.column[2] = {1, 0.1, 0};
  scene.instances[3].world_from_mesh.translation = {0.1, 1e6, 0.3};
  PunctualLight light;
  light.name = "lamp";
  light.position = {1, 2, 3};
  light.intensity = {3, 2, 1};
  light.range_m = 12.5;
  scene.lights.push_back(light);
  light.kind = PunctualKind::kSpot;
  light.direction = Normalize(Vec3d(1, -2, 3));
  light.inner_cone_rad = 0.2;
  light.outer_cone_rad = 0.4;
  scene.lights.push_back(light);
  light.kind = PunctualKind::kDirectional;
  light.direction = {0, -1, 0};
  light.range_m = 0;
  scene.lights.push_back(light);
  scene.environment.sky = {0.1f, 0.2f, 0.3f};
  return scene;
}

TEST_F(GltfWriterTest, GivesEverySceneBack) {
  for (const char* name : {"a.gltf", "b.glb", "with blank+plus.gltf"}) {
    SCOPED_TRACE(name);
    const Scene full = FullScene();
    ExpectSame(RoundTrip(full, name), full);
    ExpectSame(RoundTrip(MakeCornellBox(), name), MakeCornellBox());
    ExpectSame(RoundTrip(MakeFurnace(0.3f, 2.5f), name), MakeFurnace(0.3f, 2.5f));
    ExpectSame(RoundTrip(MakeCity(2, 3), name), MakeCity(2, 3));
  }
}

TEST_F(GltfWriterTest, WritesLargeIndices) {
  Scene scene;
  Mesh mesh;
  mesh.name = "many";
  for (int i = 0; i < 70000; ++i) {
    mesh.positions.push_back({static_cast<float>(i), static_cast<float>(i % 7), 1});
  }
  for (uint32_t i = 0; i + 2 < 70000; ++i) mesh.triangles.push_back({i, i + 1, i + 2});
  scene.meshes = {mesh};
  scene.instances = {{"many", 0, {}}};
  ExpectSame(RoundTrip(scene, "many.glb"), scene);
}

TEST_F(GltfWriterTest, RefusesWhatGltfCannotSay) {
  Scene scene = MakeCornellBox();
  scene.meshes[2].triangles.clear();
  EXPECT_THAT(std::string(WriteGltf(scene, (folder_ / "a.gltf").string()).message()),
              HasSubstr("mesh 2 ('light') has no triangles"));
  EXPECT_EQ(WriteGltf(MakeCornellBox(), (folder_ / "a.obj").string()).code(),
            absl::StatusCode::kInvalidArgument);
  EXPECT_EQ(WriteGltf(MakeCornellBox(), (folder_ / "none" / "a.gltf").string()).code(),
            absl::StatusCode::kNotFound);
}

// scenes/ holds what the code makes (scenes/README.md says how to renew it).
TEST_F(GltfWriterTest, CommittedScenesAreUpToDate) {
  const std::filesystem::path committed = FARPOINT_SOURCE_DIR "/scenes";
  ASSERT_TRUE(WriteGltf(MakeCornellBox(), (folder_ / "cornell.gltf").string()).ok());
  ASSERT_TRUE(WriteGltf(MakeFurnace(0.5f, 1), (folder_ / "furnace.gltf").string()).ok());
  ASSERT_TRUE(WriteGltf(MakeCity(3, 1), (folder_ / "city.glb").string()).ok());
  for (const char* name :
       {"cornell.gltf", "cornell.bin", "furnace.gltf", "furnace.bin", "city.glb"}) {
    const auto made = ReadFile((folder_ / name).string());
    const auto kept = ReadFile((committed / name).string());
    ASSERT_TRUE(made.ok() && kept.ok()) << name << ": " << kept.status();
    EXPECT_EQ(made->Hash().Hex(), kept->Hash().Hex())
        << name << " differs from what the code makes";
    EXPECT_LT(kept->size(), size_t{1} << 20);
  }
}

}  // namespace
}  // namespace farpoint

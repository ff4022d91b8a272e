#include "core/scene/prepared_scene.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <bit>
#include <cmath>
#include <limits>

#include "core/math/elementary.h"
#include "core/math/sampling.h"
#include "core/scene/procedural.h"
#include "tests/unit/core/scene/scene_test_util.h"

namespace farpoint {
namespace {

using ::testing::AllOf;
using ::testing::HasSubstr;
using Prepared = std::shared_ptr<const PreparedScene>;

Prepared PrepareOk(const Scene& scene, unsigned threads = 2) {
  Executor executor(threads);
  auto prepared = PreparedScene::Prepare(scene, executor);
  EXPECT_TRUE(prepared.ok()) << prepared.status();
  return prepared.ok() ? *prepared : nullptr;
}
std::string MessageOf(const Scene& scene) {
  Executor executor(1);
  const auto prepared = PreparedScene::Prepare(scene, executor);
  return prepared.ok() ? "OK" : std::string(prepared.status().message());
}

// The triangle (0,0,0), (2,0,0), (0,2,0) with normals and uv.
Scene TriangleScene() {
  Scene scene;
  Mesh mesh;
  mesh.name = "triangle";
  mesh.positions = {{0, 0, 0}, {2, 0, 0}, {0, 2, 0}};
  mesh.normals = {{0, 0, 1}, {0, 0, 3}, {0, 0, 1e-30f}};
  mesh.uv[0] = {{0, 0}, {1, 0}, {0, 1}};
  mesh.triangles = {{0, 1, 2}};
  scene.meshes = {mesh};
  scene.instances = {{"a", 0, {}}};
  return scene;
}

Scene TexturedScene(uint32_t width, uint32_t height, const std::vector<uint8_t>& rgba) {
  Scene scene = TriangleScene();
  Texture texture;
  texture.name = "texture";
  texture.encoded = Blob::FromString(MakePng(width, height, rgba));
  scene.textures = {texture};
  Material material;
  material.base_color_texture.texture = 0;
  scene.materials = {material};
  scene.meshes[0].material = 0;
  return scene;
}

std::vector<uint8_t> RandomPixels(size_t count, uint64_t seed) {
  std::vector<uint8_t> pixels(count * 4);
  for (size_t i = 0; i < pixels.size(); ++i) pixels[i] = static_cast<uint8_t>(HashKey(seed, i));
  return pixels;
}

bool SameBits(const Vec3f& a, const Vec3f& b) {
  return std::bit_cast<std::array<uint32_t, 3>>(a) == std::bit_cast<std::array<uint32_t, 3>>(b);
}

TEST(PreparedScene, KeepsATriangleAboutItsOrigin) {
  const Prepared p = PrepareOk(TriangleScene());
  EXPECT_EQ(p->origin(), Vec3d(1, 1, 0));
  ASSERT_EQ(p->triangles().size(), 1u);
  EXPECT_EQ(p->vertices()[0], Vec3f(-1, -1, 0));
  EXPECT_EQ(p->bounds().min, Vec3f(-1, -1, 0));
  EXPECT_EQ(p->bounds().max, Vec3f(1, 1, 0));
  EXPECT_FLOAT_EQ(p->diagonal_m(), std::sqrt(8.0f));
  EXPECT_EQ(p->TriangleArea(0), 2);
  EXPECT_EQ(p->GeometricNormal(0), Vec3f(0, 0, 1));
  for (const Vec3f& n : p->normals()) EXPECT_EQ(n, Vec3f(0, 0, 1));
  EXPECT_EQ(p->PointOn(0, 0.5f, 0.25f), Vec3f(0, -0.5f, 0));
  EXPECT_EQ(p->Surface(0, 0.3f, 0.3f).albedo, Rgb(1));
  EXPECT_EQ(p->Surface(0, 0.3f, 0.3f).emission, Rgb());
  EXPECT_EQ(p->dropped_triangles(), 0u);
}

TEST(PreparedScene, HoldsPrecisionFarFromZero) {
  Scene scene = TriangleScene();
  scene.instances[0].world_from_mesh.translation = {1e6, -2e6, 3e6};
  const Prepared p = PrepareOk(scene);
  EXPECT_EQ(p->origin(), Vec3d(1e6 + 1, -2e6 + 1, 3e6));
  const Prepared near = PrepareOk(TriangleScene());
  for (size_t v = 0; v < 3; ++v) EXPECT_EQ(p->vertices()[v], near->vertices()[v]);
}

TEST(PreparedScene, HoldsPrecisionBesideWhatLiesFarAway) {
  // A room's worth of small triangles about (3, 1, -2) and a few that lie 10^8 m away.
  Mesh mesh;
  for (int i = 0; i < 200; ++i) {
    const bool far = i % 20 == 7;
    const Vec3f at = far ? Vec3f(1e8f, -2e8f, 3e8f) : Vec3f(3, 1, -2);
    const Vec3f p = at + Vec3f(0.1f * static_cast<float>(i % 11), 0.1f * static_cast<float>(i % 7),
                               0.1f * static_cast<float>(i % 5));
    const float side = far ? 100.0f : 1.0f;
    mesh.positions.insert(mesh.positions.end(), {p, p + Vec3f(side, 0, 0), p + Vec3f(0, side, 0)});
    const auto first = static_cast<uint32_t>(3 * i);
    mesh.triangles.push_back({first, first + 1, first + 2});
  }
  Scene scene;
  scene.meshes.push_back(mesh);
  scene.instances.push_back({"only", 0, {}});
  const Prepared p = PrepareOk(scene);
  EXPECT_LT(MaxAbs(p->origin() - Vec3d(3.5, 1.5, -2)), 2.0);
  ASSERT_EQ(p->triangles().size(), 200u);  // the small ones are not taken for degenerate
  for (size_t i = 0; i < 60; ++i) {
    if (i / 3 == 7) continue;
    EXPECT_LT(MaxAbs(Vec3d(p->vertices()[i]) + p->origin() - Vec3d(mesh.positions[i])), 1e-6);
  }
}

TEST(PreparedScene, KeepsFrontsOfMirroredAndStretchedInstances) {
  // Each transform, and the normal that the front then has: the inverse transpose.
  for (int i = 0; i < 64; ++i) {
    Scene scene = TriangleScene();
    Affine& m = scene.instances[0].world_from_mesh;
    for (int c = 0; c < 3; ++c) {
      for (int r = 0; r < 3; ++r) {
        m.column[c][r] = (HashKey(i, c, r) >> 11) * 0x1p-53 * 4 - 2;
      }
    }
    // The inverse by cofactors, transposed, times (0, 0, 1): independent of Affine::Normal's sign.
    const Vec3d cofactor = Cross(m.column[0], m.column[1]);
    const double determinant = Dot(m.column[2], cofactor);
    const Vec3d expected = Normalize(cofactor / determinant);
    const Prepared p = PrepareOk(scene);
    ASSERT_EQ(p->triangles().size(), 1u);
    const Vec3d geometric(p->GeometricNormal(0)), shading(p->ShadingNormal(0, 0.2f, 0.2f));
    EXPECT_NEAR(Dot(geometric, expected), 1, 1e-5) << i << " determinant " << determinant;
    EXPECT_NEAR(Dot(shading, expected), 1, 1e-5) << i;
  }
}

TEST(PreparedScene, FlattensSingularTransformsAndDropsWhatVanishes) {
  Scene scene = TriangleScene();
  scene.instances[0].world_from_mesh.column[2] = {0, 0, 0};  // still a triangle in its plane
  EXPECT_EQ(PrepareOk(scene)->triangles().size(), 1u);
  scene.instances[0].world_from_mesh.column[1] = {1, 0, 0};  // a line
  const Prepared p = PrepareOk(scene);
  EXPECT_EQ(p->triangles().size(), 0u);
  EXPECT_EQ(p->objects().size(), 0u);
  EXPECT_EQ(p->dropped_triangles(), 1u);
  EXPECT_EQ(p->diagonal_m(), 0);
}

TEST(PreparedScene, DropsDegenerateTrianglesButKeepsThinOnes) {
  Scene scene;
  Mesh mesh;
  mesh.positions = {{0, 0, 0}, {1, 0, 0}, {0, 1, 0}, {2, 0, 0}, {1, 1e-6f, 0}, {3, 0, 0}};
  mesh.triangles = {{0, 1, 2}, {0, 0, 1}, {1, 1, 1}, {0, 1, 3}, {0, 4, 5}};
  scene.meshes = {mesh};
  scene.instances = {{"a", 0, {}}};
  const Prepared p = PrepareOk(scene);
  EXPECT_EQ(p->triangles().size(), 2u);
  EXPECT_EQ(p->dropped_triangles(), 3u);
  EXPECT_GT(p->TriangleArea(1), 0);
  EXPECT_NEAR(Length(p->GeometricNormal(1)), 1, 1e-6);
}

TEST(PreparedScene, ReplacesBadNormalsByTheTriangles) {
  Scene scene = TriangleScene();
  const float nan = std::numeric_limits<float>::quiet_NaN();
  const float infinity = std::numeric_limits<float>::infinity();
  scene.meshes[0].normals = {{0, 0, 0}, {nan, 1, 0}, {1, 0, infinity}};
  const Prepared p = PrepareOk(scene);
  for (const Vec3f& n : p->normals()) EXPECT_EQ(n, Vec3f(0, 0, 1));
  // Opposite normals that cancel on the way.
  scene.meshes[0].normals = {{1, 0, 0}, {-1, 0, 0}, {0, 0, -1}};
  const Vec3f n = PrepareOk(scene)->ShadingNormal(0, 0.5f, 0.0f);
  EXPECT_EQ(n, Vec3f(0, 0, 1));
  // On the side of the triangle's front, wherever the vertex normals point.
  EXPECT_GE(Dot(PrepareOk(scene)->ShadingNormal(0, 0.0f, 0.9f), Vec3f(0, 0, 1)), 0);
}

TEST(PreparedScene, GivesTheSameBlobForAnyNumberOfThreads) {
  const Scene scene = MakeCity(2, 7);
  const Digest one = PrepareOk(scene, 1)->blob().Hash();
  EXPECT_EQ(PrepareOk(scene, 2)->blob().Hash(), one);
  EXPECT_EQ(PrepareOk(scene, 5)->blob().Hash(), one);
}

TEST(PreparedScene, ScalesExactlyByPowersOfTwo) {
  const Scene scene = MakeCity(1, 3);
  const Prepared base = PrepareOk(scene);
  for (const int exponent : {-20, -3, 1, 20}) {
    const float factor = std::ldexp(1.0f, exponent);
    for (const bool in_mesh : {false, true}) {
      Scene scaled = scene;
      if (in_mesh) {
        for (Mesh& mesh : scaled.meshes) {
          for (Vec3f& p : mesh.positions) p *= factor;
        }
      }
      for (Instance& instance : scaled.instances) {
        Affine& m = instance.world_from_mesh;
        if (!in_mesh) {
          for (Vec3d& column : m.column) column *= factor;
        }
        m.translation *= factor;
      }
      const Prepared p = PrepareOk(scaled);
      EXPECT_EQ(p->origin(), base->origin() * factor);
      ASSERT_EQ(p->vertices().size(), base->vertices().size());
      ASSERT_EQ(p->triangles().size(), base->triangles().size());
      bool same = true;
      for (size_t v = 0; v < p->vertices().size(); ++v) {
        same = same && SameBits(p->vertices()[v], base->vertices()[v] * factor) &&
               SameBits(p->normals()[v], base->normals()[v]);
      }
      EXPECT_TRUE(same);
      for (size_t o = 0; o < p->objects().size(); ++o) {
        EXPECT_EQ(p->objects()[o].content_key, base->objects()[o].content_key);
      }
      for (uint32_t t = 0; t < p->triangles().size(); t += 11) {
        ASSERT_EQ(p->TriangleArea(t), base->TriangleArea(t) * factor * factor);
        ASSERT_TRUE(SameBits(p->GeometricNormal(t), base->GeometricNormal(t)));
        ASSERT_TRUE(SameBits(p->PointOn(t, 0.3f, 0.4f), base->PointOn(t, 0.3f, 0.4f) * factor));
      }
    }
  }
}

TEST(PreparedScene, ContentKeyFollowsGeometryAndLinearTransformOnly) {
  Scene scene = TriangleScene();
  scene.materials = {Material()};
  const uint64_t key = PrepareOk(scene)->objects()[0].content_key;
  Scene moved = scene;
  moved.instances[0].world_from_mesh.translation = {5, 6, 7};
  moved.instances[0].name = "other";
  moved.meshes[0].name = "other";
  moved.meshes[0].material = 0;
  moved.instances.insert(moved.instances.begin(), moved.instances[0]);
  moved.instances[0].world_from_mesh.column[0] = {0, 1, 0};
  moved.instances[0].world_from_mesh.column[1] = {-1, 0, 0};
  const Prepared p = PrepareOk(moved);
  EXPECT_EQ(p->objects()[1].content_key, key);
  EXPECT_NE(p->objects()[0].content_key, key);
  Scene changed = scene;
  changed.meshes[0].positions[1].x = 2.5f;
  EXPECT_NE(PrepareOk(changed)->objects()[0].content_key, key);
  changed = scene;
  changed.meshes[0].triangles[0] = {1, 2, 0};
  EXPECT_NE(PrepareOk(changed)->objects()[0].content_key, key);
}

TEST(PreparedScene, RefusesWhatFloatsCannotHold) {
  Scene scene = TriangleScene();
  scene.instances[0].world_from_mesh.column[0] = {1e19, 0, 0};
  EXPECT_THAT(MessageOf(scene), HasSubstr("2^60 m across"));
  scene.instances[0].world_from_mesh.column[0] = {1e300, 0, 0};
  EXPECT_THAT(MessageOf(scene), HasSubstr("2^60 m across"));
  scene.instances[0].world_from_mesh.column[0] = {std::numeric_limits<double>::infinity(), 0, 0};
  EXPECT_THAT(MessageOf(scene), AllOf(HasSubstr("instance 0 ('a')"), HasSubstr("not finite")));
  scene = TriangleScene();
  for (Vec3d& column : scene.instances[0].world_from_mesh.column) column *= 1e-12;
  EXPECT_THAT(MessageOf(scene), HasSubstr("scale it up"));
  scene = TriangleScene();
  scene.instances[0].world_from_mesh.translation = {0, 0, 2e30};
  EXPECT_THAT(MessageOf(scene), HasSubstr("2^100 m"));
  // Vertices that no triangle uses do not count.
  scene = TriangleScene();
  scene.meshes[0].positions.push_back(Vec3f(std::numeric_limits<float>::infinity()));
  scene.meshes[0].normals.push_back({});
  scene.meshes[0].uv[0].push_back({});
  EXPECT_EQ(PrepareOk(scene)->bounds().max, Vec3f(1, 1, 0));
}

TEST(PreparedScene, RefusesReferencesThatLeadNowhere) {
  Scene scene = TriangleScene();
  scene.meshes[0].triangles.push_back({0, 1, 3});
  EXPECT_THAT(MessageOf(scene), AllOf(HasSubstr("mesh 0 ('triangle')"), HasSubstr("index 3")));
  scene = TriangleScene();
  scene.instances[0].mesh = 1;
  EXPECT_THAT(MessageOf(scene), HasSubstr("mesh 1 does not exist"));
  scene = TriangleScene();
  scene.meshes[0].material = 0;
  EXPECT_THAT(MessageOf(scene), HasSubstr("material 0 does not exist"));
  scene = TriangleScene();
  scene.meshes[0].normals.pop_back();
  EXPECT_THAT(MessageOf(scene), HasSubstr("2 normals for 3 positions"));
  scene = TexturedScene(1, 1, {0, 0, 0, 0});
  scene.materials[0].base_color_texture.texture = 1;
  EXPECT_THAT(MessageOf(scene), HasSubstr("texture 1 does not exist"));
  scene = TexturedScene(1, 1, {0, 0, 0, 0});
  scene.textures[0].encoded = Blob::FromString("nonsense");
  EXPECT_THAT(MessageOf(scene), HasSubstr("image 'texture'"));
  scene = TriangleScene();
  scene.materials = {Material()};
  scene.meshes[0].material = 0;
  scene.materials[0].emission.y = std::numeric_limits<float>::quiet_NaN();
  EXPECT_THAT(MessageOf(scene), HasSubstr("emission outside"));
  scene.materials[0] = Material();
  scene.materials[0].base_color.x = 1.5f;
  EXPECT_THAT(MessageOf(scene), HasSubstr("base colour outside"));
}

TEST(PreparedScene, DecodesOnlyTexturesThatAreSeen) {
  Scene scene = TexturedScene(2, 2, RandomPixels(4, 1));
  // Unused textures are not even decoded; the same image is kept once.
  Texture broken;
  broken.encoded = Blob::FromString("nonsense");
  scene.textures.push_back(broken);
  Texture twin = scene.textures[0];
  twin.wrap_s = WrapMode::kClampToEdge;
  scene.textures.push_back(twin);
  Material unused;
  unused.base_color_texture.texture = 1;
  Material black;
  black.base_color = {0, 0, 0};
  black.base_color_texture.texture = 1;
  Material second;
  second.base_color_texture.texture = 2;
  scene.materials.insert(scene.materials.end(), {unused, black, second});
  scene.meshes.push_back(scene.meshes[0]);
  scene.meshes[1].material = 2;
  scene.meshes.push_back(scene.meshes[0]);
  scene.meshes[2].material = 3;
  scene.instances.push_back({"b", 1, {}});
  scene.instances.push_back({"c", 2, {}});
  const Prepared p = PrepareOk(scene);
  EXPECT_EQ(p->materials().size(), 3u);
  ASSERT_EQ(p->textures().size(), 2u);
  EXPECT_EQ(p->textures()[0].first_texel, p->textures()[1].first_texel);
  EXPECT_EQ(p->Surface(1, 0.1f, 0.1f).albedo, Rgb());
}

// Files of a hundred bytes that say they hold 2^27 texels each.
TEST(PreparedScene, AddsUpTextureSizesBeforeDecoding) {
  Scene scene = TriangleScene();
  for (int i = 0; i < 9; ++i) {
    Texture texture;
    texture.name = "huge";
    texture.encoded = Blob::FromString(MakePng(1, 1, {1, 2, 3, 4}, 16384, 8192));
    scene.textures.push_back(texture);
    Material material;
    material.base_color_texture.texture = i;
    scene.materials.push_back(material);
    scene.meshes.push_back(scene.meshes[0]);
    scene.meshes.back().material = i;
    scene.instances.push_back({"huge", static_cast<uint32_t>(i + 1), {}});
  }
  EXPECT_THAT(MessageOf(scene), HasSubstr("1207959552 texels, more than 2^30"));
}

// The definition of a texture lookup, in double and without any cleverness.
struct TextureOracle {
  int width, height;
  std::vector<uint8_t> rgba;
  WrapMode wrap_s, wrap_t;
  bool nearest;

  static int WrapIndex(long i, int size, WrapMode mode) {
    if (mode == WrapMode::kClampToEdge) return static_cast<int>(std::clamp<long>(i, 0, size - 1));
    const long period = mode == WrapMode::kRepeat ? size : 2 * size;
    const long k = ((i % period) + period) % period;
    return static_cast<int>(k < size ? k : period - 1 - k);
  }
  double Texel(long x, long y, int channel) const {
    const int i = WrapIndex(x, width, wrap_s), j = WrapIndex(y, height, wrap_t);
    const double v = rgba[static_cast<size_t>((j * width + i) * 4 + channel)] / 255.0;
    if (channel == 3) return v;
    return v <= 0.04045 ? v / 12.92 : std::pow((v + 0.055) / 1.055, 2.4);
  }
  double Lookup(double u, double v, int channel) const {
    const double x = u * width - (nearest ? 0 : 0.5), y = v * height - (nearest ? 0 : 0.5);
    const double i = std::floor(x), j = std::floor(y);
    if (nearest) return Texel(static_cast<long>(i), static_cast<long>(j), channel);
    double sum = 0;
    for (int b = 0; b < 2; ++b) {
      for (int a = 0; a < 2; ++a) {
        sum += (a ? x - i : 1 - (x - i)) * (b ? y - j : 1 - (y - j)) *
               Texel(static_cast<long>(i) + a, static_cast<long>(j) + b, channel);
      }
    }
    return sum;
  }
};

TEST(PreparedScene, LooksTexturesUpAsTheirDefinitionSays) {
  constexpr WrapMode kModes[] = {WrapMode::kRepeat, WrapMode::kMirroredRepeat,
                                 WrapMode::kClampToEdge};
  for (const auto& [width, height] : {std::pair<uint32_t, uint32_t>{5, 3}, {1, 1}, {2, 8}}) {
    const auto pixels = RandomPixels(width * height, 99);
    for (const WrapMode wrap_s : kModes) {
      for (const WrapMode wrap_t : kModes) {
        for (const bool nearest : {false, true}) {
          Scene scene = TexturedScene(width, height, pixels);
          scene.textures[0].wrap_s = wrap_s;
          scene.textures[0].wrap_t = wrap_t;
          scene.textures[0].nearest = nearest;
          scene.materials[0].base_color = {0.5f, 1, 0.25f};
          scene.materials[0].base_alpha = 0.75f;
          scene.materials[0].alpha_mode = AlphaMode::kMask;
          scene.materials[0].alpha_cutoff = 2;
          scene.meshes[0].uv[0] = {{-2.3f, 3.1f}, {4.2f, -1.7f}, {0.4f, -3.3f}};
          const Prepared p = PrepareOk(scene);
          const TextureOracle oracle{
              static_cast<int>(width), static_cast<int>(height), pixels, wrap_s, wrap_t, nearest};
          const auto& uv = scene.meshes[0].uv[0];
          for (int i = 0; i < 200; ++i) {
            const Vec2f b =
                UniformTriangle(ToUnitFloat(HashKey(i, 1) >> 32), ToUnitFloat(HashKey(i, 2) >> 32));
            const double b0 = 1.0 - b.x - b.y;
            const double u = b0 * uv[0].x + double{b.x} * uv[1].x + double{b.y} * uv[2].x;
            const double v = b0 * uv[0].y + double{b.x} * uv[1].y + double{b.y} * uv[2].y;
            // At a border between texels, rounding decides which is the nearest.
            const auto at_border = [](double x) { return std::fabs(x - std::nearbyint(x)) < 1e-4; };
            if (nearest && (at_border(u * width) || at_border(v * height))) continue;
            const SurfaceSample s = p->Surface(0, b.x, b.y);
            EXPECT_NEAR(s.albedo.x, 0.5 * oracle.Lookup(u, v, 0), 2e-5) << u << " " << v;
            EXPECT_NEAR(s.albedo.y, oracle.Lookup(u, v, 1), 2e-5);
            EXPECT_NEAR(s.albedo.z, 0.25 * oracle.Lookup(u, v, 2), 2e-5);
            EXPECT_NEAR(s.alpha, 0.75 * oracle.Lookup(u, v, 3), 2e-5);
            EXPECT_EQ(p->Alpha(0, b.x, b.y), s.alpha);
          }
        }
      }
    }
  }
}

// The conformance model of KHR_texture_transform (TextureTransformTest) turns a quad's image by
// pi/8; the arrow whose tip is at uv (0.778, 0.778) must then show at (0.421, 1.016), where it has
// its "correct" marker, and not at (1.016, 0.421), where it has its "error" marker.
TEST(PreparedScene, TurnsTexturesTheWayTheConformanceModelSays) {
  const uint32_t size = 64;
  std::vector<uint8_t> pixels(size * size * 4, 0);
  const size_t tip = (size_t{50} * size + 50) * 4;  // (50.5 / 64) = 0.789
  pixels[tip] = 255;
  Scene scene = TexturedScene(size, size, pixels);
  scene.textures[0].nearest = true;
  scene.materials[0].base_color_texture.transform.rotation_rad = 0.39269908169872414f;
  const double c = std::cos(0.39269908169872414), s = std::sin(0.39269908169872414);
  const double t = 50.5 / size;
  // uv angles: 45 degrees in the image, 67.5 degrees (v down: further clockwise) where it shows.
  const auto u = static_cast<float>(c * t - s * t), v = static_cast<float>(s * t + c * t);
  scene.meshes[0].uv[0] = {{u, v}, {u, v}, {u, v}};
  EXPECT_EQ(PrepareOk(scene)->Surface(0, 0.2f, 0.2f).albedo.x, 1);
  EXPECT_NEAR(v / u, 1.016 / 0.421, 0.01);
  scene.meshes[0].uv[0] = {{v, u}, {v, u}, {v, u}};
  EXPECT_EQ(PrepareOk(scene)->Surface(0, 0.2f, 0.2f).albedo.x, 0);
}

TEST(PreparedScene, AppliesScaleBeforeRotationBeforeOffset) {
  const auto pixels = RandomPixels(16 * 16, 5);
  Scene scene = TexturedScene(16, 16, pixels);
  UvTransform& transform = scene.materials[0].base_color_texture.transform;
  transform = {{0.1f, 0.2f}, {2, 3}, static_cast<float>(kPi / 2)};
  const Prepared p = PrepareOk(scene);
  const TextureOracle oracle{16, 16, pixels, WrapMode::kRepeat, WrapMode::kRepeat, false};
  for (const auto& [b1, b2] : {std::pair{0.3f, 0.1f}, {0.05f, 0.9f}}) {
    // uv = (b1, b2); scaled (2 b1, 3 b2); a quarter turn takes (u, v) to (v, -u).
    const double u = 3.0 * b2 + 0.1f, v = -2.0 * b1 + 0.2f;
    EXPECT_NEAR(p->Surface(0, b1, b2).albedo.x, oracle.Lookup(u, v, 0), 1e-4);
  }
}

TEST(PreparedScene, EmitsThroughItsTextureAndListsEmitters) {
  Scene scene = TexturedScene(1, 1, {255, 0, 188, 0});
  Material lamp;
  lamp.emission = {10, 20, 30};
  lamp.emission_texture.texture = 0;
  scene.materials.push_back(lamp);
  scene.meshes.push_back(scene.meshes[0]);
  scene.meshes[1].material = 1;
  scene.instances.push_back({"lamp", 1, {}});
  const Prepared p = PrepareOk(scene);
  ASSERT_EQ(p->emissive_triangles().size(), 1u);
  EXPECT_EQ(p->emissive_triangles()[0], 1u);
  const Rgb emission = p->Surface(1, 0.1f, 0.1f).emission;
  EXPECT_FLOAT_EQ(emission.x, 10);
  EXPECT_EQ(emission.y, 0);
  EXPECT_NEAR(emission.z, 30 * SrgbToLinear(188 / 255.0), 1e-5);
  EXPECT_EQ(p->Surface(0, 0.1f, 0.1f).emission, Rgb());
}

TEST(PreparedScene, TakesMasksWithoutHolesAsOpaque) {
  Scene scene = TexturedScene(1, 2, {9, 9, 9, 200, 9, 9, 9, 255});
  scene.materials[0].alpha_mode = AlphaMode::kMask;
  scene.materials[0].alpha_cutoff = 0.5f;
  EXPECT_FALSE(PrepareOk(scene)->has_alpha_masks());
  EXPECT_EQ(PrepareOk(scene)->Alpha(0, 0.1f, 0.1f), 1);
  scene.materials[0].alpha_cutoff = 0.9f;
  EXPECT_TRUE(PrepareOk(scene)->has_alpha_masks());
  scene.materials[0].alpha_mode = AlphaMode::kOpaque;
  EXPECT_FALSE(PrepareOk(scene)->has_alpha_masks());
}

TEST(PreparedScene, PlacesLightsAboutTheOrigin) {
  Scene scene = TriangleScene();
  PunctualLight spot;
  spot.kind = PunctualKind::kSpot;
  spot.position = {1, 1, 5};
  spot.direction = {0, 0, -2};
  spot.intensity = {1, 2, 3};
  spot.inner_cone_rad = 0.25;
  spot.outer_cone_rad = 0.5;
  spot.range_m = 7;
  scene.lights = {spot};
  scene.environment.sky = {1, 2, 3};
  const Prepared p = PrepareOk(scene);
  ASSERT_EQ(p->lights().size(), 1u);
  EXPECT_EQ(p->lights()[0].position, Vec3f(0, 0, 5));
  EXPECT_EQ(p->lights()[0].direction, Vec3f(0, 0, -1));
  EXPECT_FLOAT_EQ(p->lights()[0].cos_inner, std::cos(0.25f));
  EXPECT_FLOAT_EQ(p->lights()[0].cos_outer, std::cos(0.5f));
  EXPECT_EQ(p->lights()[0].range_m, 7);
  EXPECT_EQ(p->sky(), Rgb(1, 2, 3));
  scene.lights[0].direction = {};
  EXPECT_THAT(MessageOf(scene), HasSubstr("has no direction"));
  scene.lights[0] = spot;
  scene.lights[0].intensity.x = -1;
  EXPECT_THAT(MessageOf(scene), HasSubstr("intensity"));
  scene.lights[0] = spot;
  scene.lights[0].position.x = 1e30;
  EXPECT_THAT(MessageOf(scene), HasSubstr("2^60 m away"));
}

Scene MapScene(const std::vector<Rgb>& map, uint32_t width) {
  Scene scene = TriangleScene();
  scene.environment.map = map;
  scene.environment.map_width = width;
  scene.environment.map_height = static_cast<uint32_t>(map.size()) / width;
  return scene;
}

TEST(PreparedScene, KeepsTheTexelsOfAnEnvironmentMap) {
  const std::vector<Rgb> halves = {{1, 2, 3}, {0.25f, 65504, 0}, {0, 0, 0x1p-24f}, Rgb(7)};
  std::vector<Rgb> floats = halves;
  floats[3].z = 0.1f;
  const Prepared of_halves = PrepareOk(MapScene(halves, 2));
  const Prepared of_floats = PrepareOk(MapScene(floats, 2));
  for (uint32_t i = 0; i < 4; ++i) {
    EXPECT_EQ(of_halves->MapTexel(i % 2, i / 2), halves[i]);
    EXPECT_EQ(of_floats->MapTexel(i % 2, i / 2), floats[i]);
  }
  EXPECT_TRUE(of_halves->has_environment_map());
  EXPECT_EQ(of_halves->map_width(), 2u);
  EXPECT_EQ(of_halves->map_height(), 2u);
  EXPECT_LT(of_halves->blob().size(), of_floats->blob().size());
}

TEST(PreparedScene, LooksUpAnEnvironmentMapBilinearly) {
  Scene scene = MapScene({Rgb(0), Rgb(4), Rgb(8), Rgb(16)}, 2);
  scene.environment.sky = Rgb(100);
  const Prepared p = PrepareOk(scene);
  EXPECT_EQ(p->sky(), Rgb(100));
  EXPECT_EQ(p->MapAt(0.5, 0.5), Rgb(0));
  EXPECT_EQ(p->MapAt(1.5, 1.5), Rgb(16));
  EXPECT_EQ(p->MapAt(1, 0.5), Rgb(2));
  EXPECT_EQ(p->MapAt(0, 0.5), Rgb(2));  // around
  EXPECT_EQ(p->MapAt(2, 0.5), Rgb(2));
  EXPECT_EQ(p->MapAt(1, 1), Rgb(7));
  EXPECT_EQ(p->MapAt(1.5, 0), Rgb(4));  // held at the edge
  EXPECT_EQ(p->MapAt(0.5, 2), Rgb(8));
  EXPECT_EQ(p->EnvironmentRadiance({0, 0, 1}), Rgb(107));
}

TEST(PreparedScene, AMapOfOneColourIsSky) {
  Scene scene = MapScene(std::vector<Rgb>(6, Rgb(1, 2, 3)), 3);
  scene.environment.sky = {1, 1, 0};
  const Prepared p = PrepareOk(scene);
  EXPECT_FALSE(p->has_environment_map());
  EXPECT_EQ(p->sky(), Rgb(2, 3, 3));
  EXPECT_EQ(p->EnvironmentRadiance({0, 1, 0}), Rgb(2, 3, 3));
  scene.environment.map.assign(6, Rgb());
  EXPECT_EQ(PrepareOk(scene)->sky(), Rgb(1, 1, 0));
}

TEST(PreparedScene, RefusesABadEnvironment) {
  const Scene good = MapScene({Rgb(0), Rgb(4), Rgb(8), Rgb(16)}, 2);
  Scene scene = good;
  scene.environment.sky.y = -1;
  EXPECT_THAT(MessageOf(scene), HasSubstr("sky"));
  scene = good;
  scene.environment.map[2].z = std::numeric_limits<float>::quiet_NaN();
  EXPECT_THAT(MessageOf(scene), HasSubstr("texel (0, 1)"));
  scene = good;
  scene.environment.map_width = 3;
  EXPECT_THAT(MessageOf(scene), HasSubstr("4 texels for 3 x 2"));
  scene = good;
  scene.environment.world_from_map[0] = {-1, 0, 0};
  EXPECT_THAT(MessageOf(scene), HasSubstr("orthonormal"));
  for (int row = 0; row < 3; ++row) {
    for (int c = 0; c < 3; ++c) {
      scene = good;
      scene.environment.world_from_map[static_cast<size_t>(row)][c] =
          std::numeric_limits<double>::quiet_NaN();
      EXPECT_THAT(MessageOf(scene), HasSubstr("orthonormal")) << row << " " << c;
    }
  }
}

TEST(PreparedScene, MeanEmissionIsZeroOnlyForBlackTriangles) {
  // Left half black, right half white: the triangle's uvs decide.
  std::vector<uint8_t> pixels;
  for (int i = 0; i < 16; ++i) {
    for (int c = 0; c < 3; ++c) pixels.push_back(i % 4 < 2 ? 0 : 255);
    pixels.push_back(255);
  }
  const auto mean = [&](const std::array<Vec2f, 3>& uv) {
    Scene scene = TexturedScene(4, 4, pixels);
    scene.textures[0].nearest = true;
    scene.materials[0].emission = {2, 0, 4};
    scene.materials[0].emission_texture.texture = 0;
    scene.meshes[0].positions.resize(3);
    scene.meshes[0].normals.clear();
    scene.meshes[0].uv[0].assign(uv.begin(), uv.end());
    scene.meshes[0].uv[1].clear();
    scene.meshes[0].triangles = {{0, 1, 2}};
    return PrepareOk(scene)->MeanEmission(0);
  };
  const Rgb all = mean({Vec2f{0.8f, 0.1f}, Vec2f{0.9f, 0.1f}, Vec2f{0.8f, 0.9f}});
  EXPECT_FLOAT_EQ(all.x, 2);
  EXPECT_FLOAT_EQ(all.z, 4);
  EXPECT_EQ(mean({Vec2f{0.28f, 0.4f}, Vec2f{0.29f, 0.4f}, Vec2f{0.28f, 0.41f}}), Rgb());
  const Rgb half = mean({Vec2f{0, 0}, Vec2f{1, 0}, Vec2f{0, 1}});
  EXPECT_NEAR(half.x, 0.5, 0.15);  // a quarter of the triangle is white
  EXPECT_EQ(half.y, 0);
  // Beyond the texture it is not looked for black, but never taken for it.
  EXPECT_GT(mean({Vec2f{4.1f, 0.1f}, Vec2f{4.2f, 0.1f}, Vec2f{4.1f, 0.2f}}).x, 0);
}

TEST(PreparedScene, IsEmptyForAnEmptyScene) {
  const Prepared p = PrepareOk(Scene());
  EXPECT_EQ(p->triangles().size(), 0u);
  EXPECT_EQ(p->diagonal_m(), 0);
  EXPECT_TRUE(p->bounds().empty());
}

// --- Blobs ---

Scene BlobScene() {
  Scene scene = TexturedScene(3, 2, RandomPixels(6, 3));
  scene.materials[0].alpha_mode = AlphaMode::kMask;
  scene.materials[0].alpha_cutoff = 0.5f;
  scene.materials[0].emission = {1, 2, 3};
  scene.environment.map = {Rgb(1), Rgb(2), Rgb(3), Rgb(4)};
  scene.environment.map_width = scene.environment.map_height = 2;
  scene.meshes.push_back(scene.meshes[0]);
  scene.meshes[1].normals.clear();
  scene.meshes[1].material = -1;
  scene.instances.push_back({"b", 1, {}});
  scene.instances[1].world_from_mesh.translation = {0, 0, 1};
  PunctualLight sun;
  sun.kind = PunctualKind::kDirectional;
  sun.direction = {0, -1, 0};
  sun.intensity = {1, 1, 1};
  scene.lights = {sun};
  return scene;
}

TEST(PreparedSceneBlob, RoundTrips) {
  const Prepared a = PrepareOk(BlobScene());
  const auto b = PreparedScene::FromBlob(a->blob());
  ASSERT_TRUE(b.ok()) << b.status();
  EXPECT_EQ((*b)->origin(), a->origin());
  EXPECT_EQ((*b)->diagonal_m(), a->diagonal_m());
  EXPECT_EQ((*b)->vertices().size(), a->vertices().size());
  EXPECT_EQ((*b)->has_alpha_masks(), a->has_alpha_masks());
  EXPECT_EQ((*b)->emissive_triangles().size(), a->emissive_triangles().size());
  EXPECT_EQ((*b)->Surface(0, 0.2f, 0.3f).albedo, a->Surface(0, 0.2f, 0.3f).albedo);
  EXPECT_EQ((*b)->blob().Hash(), a->blob().Hash());
  // The blob is viewed in place.
  const auto* begin = a->blob().bytes().data();
  const auto* vertices = reinterpret_cast<const std::byte*>((*b)->vertices().data());
  EXPECT_TRUE(vertices > begin && vertices < begin + a->blob().size());
}

TEST(PreparedSceneBlob, RefusesTruncation) {
  const Blob city = PrepareOk(MakeCity(1, 1))->blob();
  for (size_t size = 0; size < city.size(); size += 97 * 53) {
    const auto bytes = city.bytes().subspan(0, size);
    EXPECT_EQ(
        PreparedScene::FromBlob(Blob::FromVector({bytes.begin(), bytes.end()})).status().code(),
        absl::StatusCode::kDataLoss);
  }
  const Blob small = PrepareOk(BlobScene())->blob();
  for (size_t size = 0; size < small.size(); ++size) {
    const auto bytes = small.bytes().subspan(0, size);
    const auto scene = PreparedScene::FromBlob(Blob::FromVector({bytes.begin(), bytes.end()}));
    ASSERT_FALSE(scene.ok()) << size;
    EXPECT_THAT(std::string(scene.status().message()), HasSubstr("prepared scene"));
  }
  std::vector<std::byte> longer(small.bytes().begin(), small.bytes().end());
  longer.push_back(std::byte{0});
  EXPECT_FALSE(PreparedScene::FromBlob(Blob::FromVector(longer)).ok());
}

TEST(PreparedSceneBlob, RefusesOtherFormatsAndVersions) {
  const Blob blob = PrepareOk(BlobScene())->blob();
  std::vector<std::byte> bytes(blob.bytes().begin(), blob.bytes().end());
  bytes[8] = std::byte{9};
  EXPECT_EQ(PreparedScene::FromBlob(Blob::FromVector(bytes)).status().code(),
            absl::StatusCode::kFailedPrecondition);
  bytes[0] = std::byte{1};
  EXPECT_THAT(std::string(PreparedScene::FromBlob(Blob::FromVector(bytes)).status().message()),
              HasSubstr("not a prepared scene"));
}

// Every bit flipped, alone: refused, or a scene whose every answer is finite and in range.
TEST(PreparedSceneBlob, SurvivesEveryFlippedBit) {
  const Blob blob = PrepareOk(BlobScene())->blob();
  size_t refused = 0, accepted = 0;
  for (size_t bit = 0; bit < blob.size() * 8; ++bit) {
    std::vector<std::byte> bytes(blob.bytes().begin(), blob.bytes().end());
    bytes[bit / 8] ^= std::byte{1} << (bit % 8);
    const auto result = PreparedScene::FromBlob(Blob::FromVector(std::move(bytes)));
    if (!result.ok()) {
      ++refused;
      continue;
    }
    ++accepted;
    const PreparedScene& p = **result;
    ASSERT_TRUE(IsFinite(p.EnvironmentRadiance({0.6f, 0.64f, 0.48f})));
    for (uint32_t t = 0; t < p.triangles().size(); ++t) {
      for (const auto& [b1, b2] : {std::pair{0.0f, 0.0f}, {0.3f, 0.6f}, {1.0f, 0.0f}}) {
        const SurfaceSample s = p.Surface(t, b1, b2);
        ASSERT_TRUE(s.albedo.x >= 0 && s.albedo.x <= 1 && s.alpha >= 0 && s.alpha <= 1);
        ASSERT_TRUE(IsFinite(s.albedo) && IsFinite(s.emission) && MaxComponent(s.emission) >= 0);
        ASSERT_TRUE(IsFinite(p.PointOn(t, b1, b2)));
        ASSERT_NEAR(Length(p.ShadingNormal(t, b1, b2)), 1, 1e-5);
      }
      ASSERT_GT(p.TriangleArea(t), 0);
      ASSERT_NEAR(Length(p.GeometricNormal(t)), 1, 1e-5);
      ASSERT_TRUE(IsFinite(p.MeanEmission(t)));
    }
  }
  EXPECT_GT(refused, 1000u);
  EXPECT_GT(accepted, 1000u);
}

// --- Gloss ---

Prepared PrepareGlossy(const Scene& scene) {
  Executor executor(1);
  PrepareOptions options;
  options.gloss = true;
  auto prepared = PreparedScene::Prepare(scene, executor, options);
  EXPECT_TRUE(prepared.ok()) << prepared.status();
  return prepared.ok() ? *prepared : nullptr;
}

TEST(PreparedGloss, IsThereOnDemandAndWhereThereIsSome) {
  Scene scene = TriangleScene();
  scene.meshes[0].material = 0;
  scene.materials.resize(1);
  scene.materials[0].base_color = {0.5f, 0.25f, 1};
  EXPECT_FALSE(PrepareGlossy(scene)->has_gloss());
  EXPECT_FALSE(PrepareGlossy(scene)->IsGlossy(0));
  EXPECT_EQ(PrepareGlossy(scene)->Surface(0, 0.2f, 0.2f).albedo, Rgb(0.5f, 0.25f, 1));
  scene.materials[0].roughness = 0.5f;
  scene.materials[0].metallic = 0.25f;
  scene.materials[0].dielectric_f0 = 0.1f;
  EXPECT_FALSE(PrepareOk(scene)->has_gloss());
  const Prepared p = PrepareGlossy(scene);
  ASSERT_TRUE(p->IsGlossy(0));
  const MicrofacetMaterial m = p->MicrofacetAt(0, 0.2f, 0.2f);
  EXPECT_EQ(m.base_color, Rgb(0.5f, 0.25f, 1));
  EXPECT_EQ(m.metallic, 0.25f);
  EXPECT_EQ(m.roughness, 0.5f);
  EXPECT_EQ(m.dielectric_f0, 0.1f);
  EXPECT_EQ(p->Surface(0, 0.2f, 0.2f).albedo, MeanReflectance(m));
  const auto read = PreparedScene::FromBlob(p->blob());
  ASSERT_TRUE(read.ok()) << read.status();
  EXPECT_EQ((*read)->MicrofacetAt(0, 0.2f, 0.2f).metallic, 0.25f);
}

TEST(PreparedGloss, RefusesWhatIsOutOfRange) {
  const auto message = [](const auto& change) {
    Scene scene = TriangleScene();
    scene.meshes[0].material = 0;
    scene.materials.resize(1);
    change(scene.materials[0]);
    Executor executor(1);
    PrepareOptions options;
    options.gloss = true;
    return std::string(PreparedScene::Prepare(scene, executor, options).status().message());
  };
  EXPECT_THAT(message([](Material& m) { m.metallic = 1.5f; }), HasSubstr("metallic or roughness"));
  EXPECT_THAT(message([](Material& m) { m.roughness = -1; }), HasSubstr("metallic or roughness"));
  EXPECT_THAT(message([](Material& m) { m.dielectric_f0 = 1; }), HasSubstr("reflectance"));
  EXPECT_THAT(message([](Material& m) { m.normal_scale = 1e20f; }), HasSubstr("normal scale"));
  EXPECT_THAT(message([](Material& m) { m.normal_texture.texture = 3; }),
              HasSubstr("texture 3 does not exist"));
}

// Green is roughness, blue metallic, both as they stand and not as sRGB.
TEST(PreparedGloss, TexturesMultiplyMetalAndRoughness) {
  Scene scene = TexturedScene(1, 1, {255, 51, 204, 255});
  Material& m = scene.materials[0];
  m.base_color_texture = {};
  m.metal_roughness_texture.texture = 0;
  m.metallic = 0.5f;
  m.roughness = 1;
  const MicrofacetMaterial at = PrepareGlossy(scene)->MicrofacetAt(0, 0.3f, 0.3f);
  EXPECT_FLOAT_EQ(at.roughness, 0.2f);
  EXPECT_FLOAT_EQ(at.metallic, 0.4f);
  // A texture alone makes gloss of factors that have none.
  m.metallic = 0;
  const Prepared dielectric = PrepareGlossy(scene);
  ASSERT_TRUE(dielectric->IsGlossy(0));
  EXPECT_FLOAT_EQ(dielectric->MicrofacetAt(0, 0.3f, 0.3f).roughness, 0.2f);
  EXPECT_EQ(dielectric->MicrofacetAt(0, 0.3f, 0.3f).metallic, 0);
  ASSERT_TRUE(PreparedScene::FromBlob(dielectric->blob()).ok());
  // Lambert scenes do not decode it.
  EXPECT_EQ(PrepareOk(scene)->textures().size(), 0u);
}

// (0.6, 0, 0.8) leans to where u grows, (0, 0.6, 0.8) against v.
TEST(PreparedGloss, NormalMapsLeanByTheTextureCoordinates) {
  const auto normal = [](uint8_t x, uint8_t y, uint8_t z, bool mirrored, bool back = false) {
    Scene scene = TexturedScene(1, 1, {x, y, z, 255});
    scene.materials[0].base_color_texture = {};
    scene.materials[0].normal_texture.texture = 0;
    scene.meshes[0].uv[0] = {{0, 1}, {1, 1}, {0, 0}};  // v falls with y
    if (mirrored) scene.meshes[0].uv[0] = {{1, 1}, {0, 1}, {1, 0}};
    if (back) scene.meshes[0].triangles = {{0, 2, 1}};
    EXPECT_EQ(PrepareOk(scene)->ShadingNormal(0, 0.3f, 0.3f), Vec3f(0, 0, back ? -1 : 1));
    return PrepareGlossy(scene)->ShadingNormal(0, 0.3f, 0.3f);
  };
  const auto near = [](const Vec3f& a, const Vec3f& b) { return Length(a - b) < 0.01f; };
  EXPECT_TRUE(near(normal(204, 128, 230, false), {0.6f, 0, 0.8f}));
  EXPECT_TRUE(near(normal(128, 204, 230, false), {0, 0.6f, 0.8f}));
  EXPECT_TRUE(near(normal(204, 128, 230, true), {-0.6f, 0, 0.8f}));
  EXPECT_TRUE(near(normal(128, 204, 230, true), {0, 0.6f, 0.8f}));
  // Seen from its back the relief is the same, with its normals on that side.
  EXPECT_TRUE(near(normal(204, 128, 230, false, true), {0.6f, 0, -0.8f}));
  // Never below the surface, and unit.
  const Vec3f n = normal(255, 128, 0, false);
  EXPECT_GE(n.z, 0.015f);
  EXPECT_NEAR(Length(n), 1, 1e-5f);
}

TEST(PreparedGloss, DegenerateCoordinatesLeaveTheNormal) {
  Scene scene = TexturedScene(1, 1, {204, 128, 230, 255});
  scene.materials[0].normal_texture.texture = 0;
  scene.meshes[0].uv[0] = {{0.5f, 0.5f}, {0.5f, 0.5f}, {0.5f, 0.5f}};
  EXPECT_EQ(PrepareGlossy(scene)->ShadingNormal(0, 0.3f, 0.3f), Vec3f(0, 0, 1));
}

}  // namespace
}  // namespace farpoint

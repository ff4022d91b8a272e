// Animations, morph targets and skins, through the importer.
#include "core/scene/gltf_animation.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cmath>
#include <functional>
#include <limits>
#include <optional>

#include "core/base/executor.h"
#include "core/math/elementary.h"
#include "core/math/sampling.h"
#include "core/scene/prepared_scene.h"
#include "tests/unit/core/scene/scene_test_util.h"

namespace farpoint {
namespace {

using ::testing::AllOf;
using ::testing::HasSubstr;
using Json = nlohmann::json;

void ExpectNear(const Vec3d& a, const Vec3d& b, double tolerance = 1e-6) {
  for (int i = 0; i < 3; ++i) EXPECT_NEAR(a[i], b[i], tolerance);
}

Scene SceneAt(const TinyGltf& gltf, std::optional<double> time_s) {
  ImportOptions options;
  options.time_s = time_s;
  auto imported = gltf.Import(options);
  EXPECT_TRUE(imported.ok()) << imported.status();
  return imported.ok() ? std::move(imported->scene) : Scene();
}

std::string MessageAt(const TinyGltf& gltf, std::optional<double> time_s) {
  ImportOptions options;
  options.time_s = time_s;
  const auto imported = gltf.Import(options);
  return imported.ok() ? "OK" : std::string(imported.status().message());
}

// Adds a channel with a sampler of its own to animation `animation`.
void Animate(TinyGltf& gltf, size_t node, const char* path, const std::vector<float>& times,
             const std::vector<float>& values, const char* interpolation = "LINEAR",
             size_t animation = 0) {
  auto& animations = gltf.json["animations"];
  while (animations.size() <= animation) {
    animations.push_back({{"samplers", Json::array()}, {"channels", Json::array()}});
  }
  const std::string name = path;
  const char* type = name == "rotation" ? "VEC4" : name == "weights" ? "SCALAR" : "VEC3";
  const size_t width = name == "rotation" ? 4 : name == "weights" ? 1 : 3;
  const size_t input = gltf.Accessor<float>(times, 5126, "SCALAR", 1);
  const size_t output = gltf.Accessor<float>(values, 5126, type, width);
  auto& a = animations[animation];
  a["channels"].push_back(
      {{"sampler", a["samplers"].size()}, {"target", {{"node", node}, {"path", path}}}});
  a["samplers"].push_back({{"input", input}, {"output", output}, {"interpolation", interpolation}});
}

Vec3d TranslationAt(const TinyGltf& gltf, double time_s) {
  return SceneAt(gltf, time_s).instances.at(0).world_from_mesh.translation;
}

TEST(GltfAnimation, MovesLinearlyAndStaysAtItsEnds) {
  TinyGltf gltf = TriangleGltf();
  gltf.json["nodes"][0]["translation"] = {9, 9, 9};
  Animate(gltf, 0, "translation", {1, 2, 4}, {0, 0, 0, 2, 0, 0, 2, 4, 0});
  EXPECT_EQ(TranslationAt(gltf, -5), Vec3d(0, 0, 0));
  EXPECT_EQ(TranslationAt(gltf, 1), Vec3d(0, 0, 0));
  EXPECT_EQ(TranslationAt(gltf, 1.25), Vec3d(0.5, 0, 0));
  EXPECT_EQ(TranslationAt(gltf, 2), Vec3d(2, 0, 0));
  EXPECT_EQ(TranslationAt(gltf, 3), Vec3d(2, 2, 0));
  EXPECT_EQ(TranslationAt(gltf, 100), Vec3d(2, 4, 0));
  // The rest pose is that of the node.
  EXPECT_EQ(SceneAt(gltf, std::nullopt).instances.at(0).world_from_mesh.translation,
            Vec3d(9, 9, 9));
}

TEST(GltfAnimation, Steps) {
  TinyGltf gltf = TriangleGltf();
  Animate(gltf, 0, "scale", {0, 1}, {1, 1, 1, 2, 3, 4}, "STEP");
  EXPECT_EQ(SceneAt(gltf, 0.99).instances.at(0).world_from_mesh, Affine());
  const Affine end = SceneAt(gltf, 1).instances.at(0).world_from_mesh;
  EXPECT_EQ(end.column[1], Vec3d(0, 3, 0));
  EXPECT_EQ(end.column[2], Vec3d(0, 0, 4));
}

TEST(GltfAnimation, FollowsCubicSplines) {
  TinyGltf gltf = TriangleGltf();
  // In-tangent, value, out-tangent of keys at 1 s and 3 s: x goes from 0 to 8 with slope 1 to 3.
  Animate(gltf, 0, "translation", {1, 3}, {7, 7, 7, 0, 0, 0, 1, 0, 0, 3, 0, 0, 8, 0, 0, 7, 7, 7},
          "CUBICSPLINE");
  const auto x = [&](double time_s) { return TranslationAt(gltf, time_s).x; };
  EXPECT_EQ(x(1), 0);
  EXPECT_EQ(x(3), 8);
  EXPECT_EQ(x(9), 8);
  EXPECT_NEAR((x(1 + 1e-4) - x(1)) / 1e-4, 1, 1e-3);
  EXPECT_NEAR((x(3) - x(3 - 1e-4)) / 1e-4, 3, 1e-3);
  // Hermite at the middle: (a + b) / 2 + span (m0 - m1) / 8.
  EXPECT_NEAR(x(2), 4 + 2 * (1 - 3) / 8.0, 1e-12);
}

TEST(GltfAnimation, TurnsEvenlyAlongTheShorterArc) {
  TinyGltf gltf = TriangleGltf();
  // From 0 to 120 degrees about z; the second key with the opposite sign is the same rotation.
  const float half = static_cast<float>(kPi / 3);
  for (const float sign : {1.0f, -1.0f}) {
    gltf.json.erase("animations");
    Animate(gltf, 0, "rotation", {0, 1},
            {0, 0, 0, 1, 0, 0, sign * std::sin(half), sign * std::cos(half)});
    for (const double t : {0.0, 0.25, 0.5, 0.75, 1.0}) {
      const Affine m = SceneAt(gltf, t).instances.at(0).world_from_mesh;
      const auto [sine, cosine] = DetSinCos(t * 2 * kPi / 3);
      ExpectNear(m.column[0], {cosine, sine, 0});
      ExpectNear(m.column[2], {0, 0, 1});
    }
  }
  // Keys that are nearly equal.
  gltf.json.erase("animations");
  Animate(gltf, 0, "rotation", {0, 1}, {0, 0, 0, 1, 0, 0, 1e-7f, 1});
  ExpectNear(SceneAt(gltf, 0.5).instances.at(0).world_from_mesh.column[0], {1, 1e-7, 0}, 1e-12);
}

TEST(GltfAnimation, ReadsNormalisedRotations) {
  TinyGltf gltf = TriangleGltf();
  Animate(gltf, 0, "rotation", {0}, {0, 0, 0, 1});
  const auto output = gltf.Accessor<int16_t>({0, 0, 32767, 0}, 5122, "VEC4", 4);
  gltf.json["accessors"][output]["normalized"] = true;
  gltf.json["animations"][0]["samplers"][0]["output"] = output;
  ExpectNear(SceneAt(gltf, 0).instances.at(0).world_from_mesh.column[0], {-1, 0, 0});
  gltf.json["accessors"][output].erase("normalized");
  EXPECT_THAT(MessageAt(gltf, 0), HasSubstr("/animations/0/samplers/0/output"));
}

TEST(GltfAnimation, PlaysAllAnimationsTogetherAndTheLaterOneWins) {
  TinyGltf gltf = TriangleGltf();
  Animate(gltf, 0, "translation", {0, 2}, {0, 0, 0, 2, 0, 0});
  Animate(gltf, 0, "scale", {1, 3}, {1, 1, 1, 3, 3, 3}, "LINEAR", 1);
  Animate(gltf, 0, "translation", {0, 1}, {0, 5, 0, 0, 6, 0}, "LINEAR", 2);
  const Affine m = SceneAt(gltf, 2).instances.at(0).world_from_mesh;
  EXPECT_EQ(m.translation, Vec3d(0, 6, 0));
  EXPECT_EQ(m.column[0], Vec3d(2, 0, 0));
  const auto imported = gltf.Import();
  ASSERT_TRUE(imported.ok());
  EXPECT_EQ(imported->animation, (TimeRange{0, 3}));
  EXPECT_EQ(imported->notes.size(), 1u);
  EXPECT_THAT(imported->notes[0], HasSubstr("3 animations in the file: the rest pose is shown"));
  EXPECT_EQ(FindAnimation(gltf.Asset()).value(), (TimeRange{0, 3}));
}

TEST(GltfAnimation, MovesCamerasAndLightsAndChildren) {
  TinyGltf gltf = TriangleGltf();
  gltf.json["cameras"] = {{{"type", "perspective"}, {"perspective", {{"yfov", 1}, {"znear", 1}}}}};
  gltf.json["extensions"]["KHR_lights_punctual"]["lights"] = {{{"type", "point"}}};
  Json light = {{"translation", {0, 1, 0}}};
  light["extensions"]["KHR_lights_punctual"]["light"] = 0;
  gltf.json["nodes"] = {{{"children", {1, 2, 3}}}, {{"camera", 0}}, light, {{"mesh", 0}}};
  Animate(gltf, 0, "translation", {0, 1}, {0, 0, 0, 4, 0, 0});
  const Scene scene = SceneAt(gltf, 0.5);
  EXPECT_EQ(scene.cameras.at(0).eye, Vec3d(2, 0, 0));
  EXPECT_EQ(scene.lights.at(0).position, Vec3d(2, 1, 0));
  EXPECT_EQ(scene.instances.at(0).world_from_mesh.translation, Vec3d(2, 0, 0));
}

TEST(GltfAnimation, SaysWhetherThereIsOne) {
  EXPECT_EQ(FindAnimation(TriangleGltf().Asset()).value(), std::nullopt);
  EXPECT_EQ(TriangleGltf().Import()->animation, std::nullopt);
  // A channel without a node moves nothing; a pointer is not followed.
  TinyGltf gltf = TriangleGltf();
  Animate(gltf, 0, "translation", {0, 1}, {0, 0, 0, 1, 0, 0});
  gltf.json["animations"][0]["channels"][0]["target"] = {{"path", "pointer"}};
  gltf.json["extensionsUsed"] = {"KHR_animation_pointer"};
  EXPECT_EQ(FindAnimation(gltf.Asset()).value(), std::nullopt);
  EXPECT_EQ(MessageAt(gltf, 0.5), "OK");
  gltf.json["extensionsRequired"] = {"KHR_animation_pointer"};
  EXPECT_THAT(MessageAt(gltf, 0.5), HasSubstr("KHR_animation_pointer"));
  const auto obj = FindAnimation({"a.obj", {{"a.obj", Blob::FromString("v 0 0 0\n")}}});
  EXPECT_EQ(obj.value(), std::nullopt);
}

TEST(GltfAnimation, RefusesWithThePlace) {
  const auto broken = [](const std::function<void(TinyGltf&)>& change) {
    TinyGltf gltf = TriangleGltf();
    Animate(gltf, 0, "translation", {0, 1}, {0, 0, 0, 1, 0, 0});
    change(gltf);
    return MessageAt(gltf, 0.5);
  };
  const auto sampler = [](TinyGltf& gltf) -> Json& {
    return gltf.json["animations"][0]["samplers"][0];
  };
  const auto channel = [](TinyGltf& gltf) -> Json& {
    return gltf.json["animations"][0]["channels"][0];
  };
  EXPECT_EQ(broken([](TinyGltf&) {}), "OK");
  const std::pair<std::function<void(TinyGltf&)>, const char*> cases[] = {
      {[&](TinyGltf& g) {
         sampler(g)["input"] = g.Accessor<float>({1, 1}, 5126, "SCALAR", 1);
       },
       "/animations/0/samplers/0/input: time 1"},
      {[&](TinyGltf& g) {
         const float nan = std::numeric_limits<float>::quiet_NaN();
         sampler(g)["input"] = g.Accessor<float>({0, nan}, 5126, "SCALAR", 1);
       },
       "/animations/0/samplers/0/input: time 1"},
      {[&](TinyGltf& g) { sampler(g)["input"] = g.Accessor<float>({0}, 5126, "SCALAR", 1); },
       "/animations/0/samplers/0/output: has 2 elements for 1 keyframes"},
      {[&](TinyGltf& g) { sampler(g)["input"] = 0; }, "/animations/0/samplers/0/input"},
      {[&](TinyGltf& g) { sampler(g)["input"] = 99; }, "/animations/0/samplers/0/input: index 99"},
      {[&](TinyGltf& g) { sampler(g).erase("output"); },
       "/animations/0/samplers/0: has no 'output'"},
      {[&](TinyGltf& g) { sampler(g)["interpolation"] = "BEZIER"; }, "instead of LINEAR"},
      {[&](TinyGltf& g) { sampler(g)["interpolation"] = "CUBICSPLINE"; }, "keyframes of 3"},
      {[&](TinyGltf& g) { channel(g)["sampler"] = 1; }, "/animations/0/channels/0/sampler"},
      {[&](TinyGltf& g) { channel(g)["target"]["node"] = 5; }, "/channels/0/target/node: index 5"},
      {[&](TinyGltf& g) { channel(g)["target"]["path"] = "rotation"; }, "is not VEC4"},
      {[&](TinyGltf& g) { channel(g)["target"]["path"] = "weights"; }, "no morph targets"},
      {[&](TinyGltf& g) { channel(g).erase("target"); }, "/channels/0: has no 'target'"},
      {[&](TinyGltf& g) {
         g.json["nodes"][0]["matrix"] = {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1};
       },
       "/nodes/0/matrix: an animation moves this node"},
      {[&](TinyGltf& g) {
         const float inf = std::numeric_limits<float>::infinity();
         sampler(g)["output"] = g.Accessor<float>({0, 0, 0, inf, 0, 0}, 5126, "VEC3", 3);
       },
       "not finite"}};
  for (const auto& [change, expected] : cases) {
    EXPECT_THAT(broken(change), AllOf(HasSubstr("scene.gltf: "), HasSubstr(expected)));
  }
  TinyGltf gltf = TriangleGltf();
  EXPECT_THAT(MessageAt(gltf, std::nan("")), HasSubstr("not finite"));
}

TEST(GltfAnimation, RefusesMoreKeyframesThanAnybodyNeeds) {
  TinyGltf gltf = TriangleGltf();
  Animate(gltf, 0, "translation", {0}, {0, 0, 0});
  // 2^24 keyframes that cost the file nothing, used five times.
  gltf.json["accessors"].push_back(
      {{"componentType", 5126}, {"count", 1 << 24}, {"type", "SCALAR"}});
  gltf.json["accessors"].push_back({{"componentType", 5126}, {"count", 1 << 24}, {"type", "VEC3"}});
  const size_t count = gltf.json["accessors"].size();
  gltf.json["animations"][0]["samplers"][0] = {{"input", count - 2}, {"output", count - 1}};
  for (int i = 0; i < 5; ++i) {
    const Json channel = gltf.json["animations"][0]["channels"][0];
    gltf.json["animations"][0]["channels"].push_back(channel);
  }
  EXPECT_THAT(MessageAt(gltf, 0), HasSubstr("more than 67108864 keyframes"));
}

// --- Morph targets ---

TinyGltf MorphGltf() {
  TinyGltf gltf = TriangleGltf();
  Primitive(gltf)["attributes"]["NORMAL"] =
      gltf.Accessor<float>({0, 0, 1, 0, 0, 1, 0, 0, 1}, 5126, "VEC3", 3);
  const auto lift = gltf.Accessor<float>({0, 0, 2, 0, 0, 0, 0, 0, 0}, 5126, "VEC3", 3);
  const auto widen = gltf.Accessor<float>({0, 0, 0, 4, 0, 0, 0, 0, 0}, 5126, "VEC3", 3);
  const auto tilt = gltf.Accessor<float>({0, 1, 0, 0, 0, 0, 0, 0, 0}, 5126, "VEC3", 3);
  Primitive(gltf)["targets"] = {{{"POSITION", lift}, {"NORMAL", tilt}}, {{"POSITION", widen}}};
  return gltf;
}

TEST(GltfMorph, AddsTargetsByTheWeightsOfMeshOrNode) {
  TinyGltf gltf = MorphGltf();
  EXPECT_EQ(SceneAt(gltf, std::nullopt).instances.at(0).mesh, 0u);  // as it is
  gltf.json["meshes"][0]["weights"] = {1, 0.5};
  Scene scene = SceneAt(gltf, std::nullopt);
  const Mesh* mesh = &scene.meshes.at(scene.instances.at(0).mesh);
  EXPECT_EQ(mesh->positions[0], Vec3f(0, 0, 2));
  EXPECT_EQ(mesh->positions[1], Vec3f(3, 0, 0));
  ExpectNear(Vec3d(mesh->normals[0]), {0, std::sqrt(0.5), std::sqrt(0.5)});
  EXPECT_EQ(mesh->normals[1], Vec3f(0, 0, 1));
  gltf.json["nodes"][0]["weights"] = {0, 1};
  scene = SceneAt(gltf, std::nullopt);
  mesh = &scene.meshes.at(scene.instances.at(0).mesh);
  EXPECT_EQ(mesh->positions[0], Vec3f(0, 0, 0));
  EXPECT_EQ(mesh->positions[1], Vec3f(5, 0, 0));
}

TEST(GltfMorph, FollowsAnimatedWeights) {
  TinyGltf gltf = MorphGltf();
  Animate(gltf, 0, "weights", {0, 1}, {0, 0, 1, 0.5});
  Scene scene = SceneAt(gltf, 0.5);
  EXPECT_EQ(scene.meshes.at(scene.instances.at(0).mesh).positions[0], Vec3f(0, 0, 1));
  EXPECT_EQ(scene.meshes.at(scene.instances.at(0).mesh).positions[1], Vec3f(2, 0, 0));
  gltf.json.erase("animations");
  // Value parts 1, 4 of in-tangents, values, out-tangents of both targets.
  Animate(gltf, 0, "weights", {0, 1}, {0, 0, 0, 0, 0, 0, 0, 0, 1, 0.5, 0, 0}, "CUBICSPLINE");
  scene = SceneAt(gltf, 0.5);
  EXPECT_EQ(scene.meshes.at(scene.instances.at(0).mesh).positions[0], Vec3f(0, 0, 1));
  EXPECT_EQ(scene.meshes.at(scene.instances.at(0).mesh).positions[1], Vec3f(2, 0, 0));
}

TEST(GltfMorph, RefusesTargetsThatDoNotFit) {
  TinyGltf gltf = MorphGltf();
  Primitive(gltf)["targets"][1]["POSITION"] = gltf.Accessor<float>({0, 0, 0}, 5126, "VEC3", 3);
  EXPECT_THAT(MessageAt(gltf, std::nullopt),
              HasSubstr("/primitives/0/targets/1/POSITION: has 1 elements for 3 positions"));
  gltf = MorphGltf();
  Primitive(gltf)["targets"][1]["POSITION"] = 99;
  EXPECT_THAT(MessageAt(gltf, std::nullopt), HasSubstr("/targets/1/POSITION: index 99"));
  gltf = MorphGltf();
  gltf.json["meshes"][0]["weights"] = {1e8, 0};
  const float large = 1e38f;
  Primitive(gltf)["targets"][0]["POSITION"] =
      gltf.Accessor<float>({large, 0, 0, 0, 0, 0, 0, 0, 0}, 5126, "VEC3", 3);
  EXPECT_THAT(MessageAt(gltf, std::nullopt), HasSubstr("vertex 0 is moved to a place"));
}

// --- Skins ---

// The triangle bound to two joints, its vertex 2 to the second one, which lies one up.
TinyGltf SkinGltf() {
  TinyGltf gltf = TriangleGltf();
  gltf.json["nodes"] = {{{"mesh", 0}, {"skin", 0}, {"translation", {50, 0, 0}}},
                        {{"children", {2}}},
                        {{"translation", {0, 1, 0}}}};
  gltf.json["scenes"][0]["nodes"] = {0, 1};
  auto& attributes = Primitive(gltf)["attributes"];
  attributes["JOINTS_0"] =
      gltf.Accessor<uint8_t>({0, 1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0}, 5121, "VEC4", 4);
  attributes["WEIGHTS_0"] =
      gltf.Accessor<float>({1, 0, 0, 0, 1, 1, 0, 0, 0, 1, 0, 0}, 5126, "VEC4", 4);
  attributes["NORMAL"] = gltf.Accessor<float>({0, 0, 1, 0, 0, 1, 0, 0, 1}, 5126, "VEC3", 3);
  const auto matrices = gltf.Accessor<float>({1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0,  0, 1,  //
                                              1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, -1, 0, 1},
                                             5126, "MAT4", 16);
  gltf.json["skins"] = {{{"joints", {1, 2}}, {"inverseBindMatrices", matrices}}};
  return gltf;
}

Vec3d WorldVertex(const Scene& scene, size_t v) {
  const Instance& instance = scene.instances.at(0);
  return instance.world_from_mesh.Point(Vec3d(scene.meshes.at(instance.mesh).positions.at(v)));
}

TEST(GltfSkin, RestsWhereItWasBoundWhateverItsNodeSays) {
  const Scene scene = SceneAt(SkinGltf(), std::nullopt);
  ExpectNear(WorldVertex(scene, 0), {0, 0, 0});
  ExpectNear(WorldVertex(scene, 1), {1, 0, 0});
  ExpectNear(WorldVertex(scene, 2), {0, 1, 0});
}

TEST(GltfSkin, FollowsItsJointsAndScalesWeightsToOne) {
  TinyGltf gltf = SkinGltf();
  // The second joint turns by a quarter about z: (1, 0) relative to it at (0, 1) is (1, -1) and
  // goes to (0, 1) + (1, 1).
  const float h = std::sqrt(0.5f);
  Animate(gltf, 2, "rotation", {0, 1}, {0, 0, 0, 1, 0, 0, h, h});
  Animate(gltf, 1, "translation", {0, 1}, {0, 0, 0, 0, 0, 3});
  const Scene scene = SceneAt(gltf, 1);
  ExpectNear(WorldVertex(scene, 0), {0, 0, 3});
  // Weights 1 and 1: the mean of (1, 0, 3) and (1, 2, 3).
  ExpectNear(WorldVertex(scene, 1), {1, 1, 3});
  ExpectNear(WorldVertex(scene, 2), {0, 1, 3});
  const Mesh& mesh = scene.meshes.at(scene.instances.at(0).mesh);
  ExpectNear(Vec3d(mesh.normals[2]), {0, 0, 1});
  Executor executor(1);
  EXPECT_TRUE(PreparedScene::Prepare(scene, executor).ok());
}

TEST(GltfSkin, ReadsEightJointsInQuantisedTypes) {
  TinyGltf gltf = SkinGltf();
  auto& attributes = Primitive(gltf)["attributes"];
  const auto weights = gltf.Accessor<uint8_t>(std::vector<uint8_t>(12, 0), 5121, "VEC4", 4);
  gltf.json["accessors"][weights]["normalized"] = true;
  attributes["WEIGHTS_0"] = weights;
  attributes["JOINTS_1"] =
      gltf.Accessor<uint16_t>({1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0}, 5123, "VEC4", 4);
  const auto more =
      gltf.Accessor<uint16_t>({65535, 0, 0, 0, 65535, 0, 0, 0, 65535, 0, 0, 0}, 5123, "VEC4", 4);
  gltf.json["accessors"][more]["normalized"] = true;
  attributes["WEIGHTS_1"] = more;
  Animate(gltf, 2, "translation", {0}, {0, 1, 7});
  const Scene scene = SceneAt(gltf, 0);
  for (size_t v = 0; v < 3; ++v) EXPECT_NEAR(WorldVertex(scene, v).z, 7, 1e-6);
}

TEST(GltfSkin, WorksWithoutMatricesAndWithMorphTargets) {
  TinyGltf gltf = SkinGltf();
  gltf.json["skins"][0].erase("inverseBindMatrices");
  Primitive(gltf)["targets"] = {
      {{"POSITION", gltf.Accessor<float>({0, 0, 1, 0, 0, 1, 0, 0, 1}, 5126, "VEC3", 3)}}};
  gltf.json["meshes"][0]["weights"] = {1};
  gltf.json["nodes"][1]["scale"] = {1, 1, 5};
  const Scene scene = SceneAt(gltf, std::nullopt);
  ExpectNear(WorldVertex(scene, 0), {0, 0, 5});
  ExpectNear(WorldVertex(scene, 2), {0, 2, 5});
}

TEST(GltfSkin, RefusesWithThePlace) {
  const std::pair<std::function<void(TinyGltf&)>, const char*> cases[] = {
      {[](TinyGltf& g) {
         Primitive(g)["attributes"]["JOINTS_0"] =
             g.Accessor<uint8_t>({9, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0}, 5121, "VEC4", 4);
       },
       "/meshes/0/primitives/0: joint 9 of vertex 0 is beyond the 2 joints"},
      {[](TinyGltf& g) {
         Primitive(g)["attributes"]["WEIGHTS_0"] =
             g.Accessor<float>({-1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0}, 5126, "VEC4", 4);
       },
       "the weight of a joint of vertex 0"},
      {[](TinyGltf& g) {
         g.json["skins"][0]["joints"] = {1, 7};
       },
       "/skins/0/joints/1: index 7"},
      {[](TinyGltf& g) { g.json["skins"][0]["joints"] = Json::array(); },
       "/skins/0/joints: is empty"},
      {[](TinyGltf& g) {
         g.json["skins"][0]["joints"] = {1, 2, 2};
       },
       "/skins/0/inverseBindMatrices: has 2 matrices for 3 joints"},
      {[](TinyGltf& g) { g.json["scenes"][0]["nodes"] = {0}; },
       "/skins/0/joints/0: node 1 is not part of the scene"}};
  for (const auto& [change, expected] : cases) {
    TinyGltf gltf = SkinGltf();
    change(gltf);
    EXPECT_THAT(MessageAt(gltf, std::nullopt), HasSubstr(expected));
  }
}

// --- Hostile input ---

TEST(GltfAnimation, SurvivesEveryValueReplacedAndDamagedBuffers) {
  TinyGltf good = SkinGltf();
  Primitive(good)["targets"] = {
      {{"POSITION", good.Accessor<float>({0, 0, 1, 0, 0, 1, 0, 0, 1}, 5126, "VEC3", 3)}}};
  good.json["meshes"][0]["weights"] = {0.5};
  Animate(good, 2, "rotation", {0, 1}, {0, 0, 0, 1, 0, 0, 1, 0});
  Animate(good, 1, "translation", {0, 1}, {0, 0, 0, 0, 0, 3}, "STEP", 1);
  Animate(good, 0, "weights", {0, 1}, {0, 0, 0, 1, 1, 1}, "CUBICSPLINE", 1);
  ASSERT_EQ(MessageAt(good, 0.5), "OK");
  Executor executor(1);
  size_t refused = 0, total = 0;
  const auto look = [&](const TinyGltf& gltf) {
    ImportOptions options;
    options.time_s = 0.5;
    const auto imported = gltf.Import(options);
    ++total;
    if (!imported.ok()) {
      ++refused;
      EXPECT_THAT(std::string(imported.status().message()), HasSubstr("scene.gltf"));
      return;
    }
    const auto prepared = PreparedScene::Prepare(imported->scene, executor);
    EXPECT_TRUE(prepared.ok() || prepared.status().code() == absl::StatusCode::kInvalidArgument)
        << prepared.status();
  };
  const Json flat = good.json.flatten();
  for (auto it = flat.begin(); it != flat.end(); ++it) {
    Json::json_pointer pointer(it.key());
    for (int level = 0; level < 2 && !pointer.empty(); ++level, pointer.pop_back()) {
      for (const char* value : {"null", "-1", "0", "1", "2", "3", "0.5", "65536", "4294967295",
                                "18446744073709551615", "\"\"", "\"VEC4\"", "[]", "[0]", "{}"}) {
        TinyGltf bad = good;
        bad.json[pointer] = Json::parse(value);
        look(bad);
      }
    }
  }
  EXPECT_GT(refused, total / 2);
  EXPECT_LT(refused, total);
  for (uint64_t i = 0; i < 2000; ++i) {
    TinyGltf bad = good;
    for (uint64_t k = 0; k < 4; ++k) {
      const uint64_t r = HashKey(i, k);
      bad.bin[r % bad.bin.size()] = static_cast<std::byte>(r >> 32);
    }
    look(bad);
  }
}

}  // namespace
}  // namespace farpoint

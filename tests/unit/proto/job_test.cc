#include "proto/job.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cmath>
#include <functional>

namespace farpoint {
namespace {

using ::testing::HasSubstr;

JobSpec SmallJob() {
  JobSpec job;
  job.asset_root = "a.gltf";
  job.asset_files["a.gltf"] = Sha256().Update("a").Finish();
  job.film = {.width = 64, .height = 32, .crop = {0, 0, 64, 32}};
  return job;
}

TEST(Job, ACompleteJobIsValid) { EXPECT_TRUE(ValidateJob(SmallJob()).ok()); }

TEST(Job, WhatIsMissingIsNamed) {
  JobSpec job = SmallJob();
  job.film = {};
  EXPECT_THAT(std::string(ValidateJob(job).message()), HasSubstr("film"));
  job = SmallJob();
  job.asset_root.clear();
  EXPECT_THAT(std::string(ValidateJob(job).message()), HasSubstr("asset.root"));
  job = SmallJob();
  job.asset_files.clear();
  EXPECT_THAT(std::string(ValidateJob(job).message()), HasSubstr("asset.files"));
}

TEST(Job, WrongSchedulesAndOverridesAreNamed) {
  const struct {
    const char* field;
    std::function<void(JobSpec&)> spoil;
  } cases[] = {
      {"frames is 3 twice",
       [](JobSpec& j) {
         j.frames = {3, 4, 3};
       }},
      {"frames", [](JobSpec& j) { j.frames.assign(kMaxFrames + 1, 0); }},
      {"fps", [](JobSpec& j) { j.fps = 0; }},
      {"fps", [](JobSpec& j) { j.fps = NAN; }},
      {"after", [](JobSpec& j) { j.after.assign(kMaxAfter + 1, {"x"}); }},
      {"priority", [](JobSpec& j) { j.priority = 1001; }},
      {"overrides.lights[0].direction",
       [](JobSpec& j) {
         j.overrides.lights = {{.kind = PunctualKind::kSpot, .direction = {0, 0, 2}}};
       }},
      {"overrides.lights[0].intensity",
       [](JobSpec& j) {
         j.overrides.lights = {{.intensity = {-1, 0, 0}}};
       }},
      {"overrides.lights[0].inner_cone_rad",
       [](JobSpec& j) { j.overrides.lights = {{.inner_cone_rad = 0.5, .outer_cone_rad = 0.5}}; }},
      {"overrides.environment.uri 'b.exr' is not among asset.files",
       [](JobSpec& j) { j.overrides.environment = EnvironmentOverride{.uri = "b.exr"}; }},
      {"overrides.environment.up",
       [](JobSpec& j) {
         j.overrides.environment = EnvironmentOverride{.uri = "a.gltf", .up = {0, 0, 0}};
       }},
      {"overrides.materials[0].base_color",
       [](JobSpec& j) { j.overrides.materials = {{.name = "m", .base_color = Rgb(2, 0, 0)}}; }},
      {"overrides.materials[0].name", [](JobSpec& j) { j.overrides.materials.resize(1); }},
  };
  for (const auto& c : cases) {
    JobSpec job = SmallJob();
    c.spoil(job);
    const absl::Status status = ValidateJob(job);
    EXPECT_TRUE(absl::IsInvalidArgument(status)) << c.field;
    EXPECT_THAT(std::string(status.message()), HasSubstr(c.field));
  }
}

TEST(Job, LimitsAreResourceExhausted) {
  JobSpec job = SmallJob();
  job.limits.max_pixels = 64 * 32 - 1;
  EXPECT_TRUE(absl::IsResourceExhausted(ValidateJob(job)));
  job = SmallJob();
  job.settings.points = 1000;
  job.limits.max_surfels = 999;
  EXPECT_TRUE(absl::IsResourceExhausted(ValidateJob(job)));
}

TEST(Job, TheSmallerLimitWins) {
  JobLimits a, b;
  a.max_pixels = 5;
  b.max_triangles = 6;
  b.max_pixels = 7;
  const JobLimits c = Smaller(a, b);
  EXPECT_EQ(c.max_pixels, 5u);
  EXPECT_EQ(c.max_triangles, 6u);
  EXPECT_EQ(c.max_surfels, JobLimits().max_surfels);
}

TEST(Job, CamerasAreFoundByNameOrMadeOfAView) {
  Scene scene;
  scene.cameras.resize(2);
  scene.cameras[0].name = "front";
  scene.cameras[1].name = "back";
  EXPECT_EQ(ResolveCamera({}, scene)->name, "front");
  EXPECT_EQ(ResolveCamera(CameraName{"back"}, scene)->name, "back");
  const auto unknown = ResolveCamera(CameraName{"side"}, scene);
  EXPECT_TRUE(absl::IsNotFound(unknown.status()));
  EXPECT_THAT(std::string(unknown.status().message()), HasSubstr("'front', 'back'"));

  const auto made = ResolveCamera(
      LookAt{.eye = {1, 1, 1}, .target = {1, 1, -9}, .up = {0, 5, 3}, .yfov_deg = 90}, scene);
  ASSERT_TRUE(made.ok());
  EXPECT_NEAR(made->yfov_rad, 1.5707963267948966, 1e-15);
  EXPECT_EQ(made->forward, Vec3d(0, 0, -1));
  EXPECT_NEAR(Length(made->right - Vec3d(1, 0, 0)), 0, 1e-15);
  EXPECT_NEAR(Length(made->up - Vec3d(0, 1, 0)), 0, 1e-15);
}

TEST(Job, ViewsWithoutDirectionAreRefused) {
  const Scene scene;
  EXPECT_TRUE(absl::IsInvalidArgument(
      ResolveCamera(LookAt{.eye = {1, 1, 1}, .target = {1, 1, 1}}, scene).status()));
  EXPECT_TRUE(absl::IsInvalidArgument(
      ResolveCamera(LookAt{.eye = {0, 0, 0}, .target = {0, 7, 0}}, scene).status()));
  EXPECT_TRUE(absl::IsNotFound(ResolveCamera({}, scene).status()));
}

TEST(Job, OverridesReplaceLightSkyAndAlbedo) {
  Scene scene;
  scene.lights.resize(3);
  scene.materials.resize(2);
  scene.materials[0].base_color_texture.texture = 0;
  scene.materials[1].base_color_texture.texture = 0;
  scene.materials[1].alpha_mode = AlphaMode::kMask;
  scene.meshes.resize(2);
  scene.meshes[0].material = 0;
  scene.meshes[1].material = -1;
  SceneOverrides overrides;
  overrides.suns = {{.to_sun = {0, 2, 0}, .irradiance = {1, 2, 3}}};
  overrides.sky = Rgb(4, 5, 6);
  overrides.albedo = Rgb(0.25f, 0.5f, 0.75f);
  ASSERT_TRUE(ApplyOverrides(overrides, {}, scene).ok());
  ASSERT_EQ(scene.lights.size(), 1u);
  EXPECT_EQ(scene.lights[0].kind, PunctualKind::kDirectional);
  EXPECT_EQ(scene.lights[0].direction, Vec3d(-0.0, -1, -0.0));
  EXPECT_EQ(scene.lights[0].intensity, Rgb(1, 2, 3));
  EXPECT_EQ(scene.environment.sky, Rgb(4, 5, 6));
  ASSERT_EQ(scene.materials.size(), 3u);
  EXPECT_EQ(scene.meshes[1].material, 2);
  for (const Material& m : scene.materials) EXPECT_EQ(m.base_color, Rgb(0.25f, 0.5f, 0.75f));
  EXPECT_FALSE(scene.materials[0].base_color_texture.present());
  EXPECT_TRUE(scene.materials[1].base_color_texture.present());  // its alpha is needed
}

TEST(Job, LightsAndSunsTogetherReplaceTheScenesLights) {
  Scene scene;
  scene.lights.resize(3);
  SceneOverrides overrides;
  overrides.lights = {{.name = "lamp", .kind = PunctualKind::kPoint, .position = {1, 2, 3}}};
  ASSERT_TRUE(ApplyOverrides(overrides, {}, scene).ok());
  ASSERT_EQ(scene.lights.size(), 1u);
  EXPECT_EQ(scene.lights[0].position, Vec3d(1, 2, 3));
  overrides.suns = {{.to_sun = {0, 1, 0}, .irradiance = {1, 1, 1}}};
  ASSERT_TRUE(ApplyOverrides(overrides, {}, scene).ok());
  ASSERT_EQ(scene.lights.size(), 2u);
  EXPECT_EQ(scene.lights[0].kind, PunctualKind::kDirectional);
  EXPECT_EQ(scene.lights[1].name, "lamp");
}

TEST(Job, AnEnvironmentReplacesSkyAndMap) {
  // A Radiance picture of 2x1 texels of radiance 1: 2^(129 - 128) * 128 / 256.
  std::string picture = "#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 1 +X 2\n";
  for (int i = 0; i < 2; ++i) picture += "\x80\x80\x80\x81";
  AssetBundle asset;
  asset.files["env/sky.hdr"] = Blob::FromString(picture);
  Scene scene;
  scene.environment.sky = Rgb(9, 9, 9);
  SceneOverrides overrides;
  overrides.environment = EnvironmentOverride{
      .uri = "env/sky.hdr", .scale = {2, 3, 4}, .rotation_deg = 90, .up = {0, 1, 0}};
  ASSERT_TRUE(ApplyOverrides(overrides, asset, scene).ok());
  EXPECT_EQ(scene.environment.sky, Rgb(0, 0, 0));
  ASSERT_EQ(scene.environment.map.size(), 2u);
  EXPECT_EQ(scene.environment.map[1], Rgb(2, 3, 4));
  // Counter-clockwise seen from above: the map's +z turns to +x.
  EXPECT_NEAR(scene.environment.world_from_map[2].x, 1, 1e-12);
  overrides.sky = Rgb(5, 5, 5);
  ASSERT_TRUE(ApplyOverrides(overrides, asset, scene).ok());
  EXPECT_EQ(scene.environment.sky, Rgb(5, 5, 5));
  EXPECT_EQ(scene.environment.map.size(), 2u);

  overrides.environment->uri = "env/other.hdr";
  const absl::Status missing = ApplyOverrides(overrides, asset, scene);
  EXPECT_TRUE(absl::IsNotFound(missing));
  EXPECT_THAT(std::string(missing.message()), HasSubstr("env/other.hdr"));
  asset.files["env/other.hdr"] = Blob::FromString("no picture");
  EXPECT_FALSE(ApplyOverrides(overrides, asset, scene).ok());
}

TEST(Job, MaterialsAreReplacedByTheirName) {
  Scene scene;
  scene.materials.resize(4);
  scene.materials[0].name = scene.materials[1].name = "wall";
  scene.materials[2].name = "lamp";
  scene.materials[3].name = "leaf";
  for (Material& material : scene.materials) {
    material.base_color_texture.texture = material.emission_texture.texture = 0;
  }
  scene.materials[3].alpha_mode = AlphaMode::kMask;
  SceneOverrides overrides;
  overrides.albedo = Rgb(0.5f, 0.5f, 0.5f);
  overrides.materials = {{.name = "wall", .base_color = Rgb(0.1f, 0.2f, 0.3f)},
                         {.name = "lamp", .emission = Rgb(7, 8, 9)},
                         {.name = "leaf", .base_color = Rgb(0, 1, 0)}};
  ASSERT_TRUE(ApplyOverrides(overrides, {}, scene).ok());
  for (int i = 0; i < 2; ++i) {
    EXPECT_EQ(scene.materials[i].base_color, Rgb(0.1f, 0.2f, 0.3f));
    EXPECT_FALSE(scene.materials[i].base_color_texture.present());
    EXPECT_TRUE(scene.materials[i].emission_texture.present());
  }
  EXPECT_EQ(scene.materials[2].emission, Rgb(7, 8, 9));
  EXPECT_FALSE(scene.materials[2].emission_texture.present());
  EXPECT_EQ(scene.materials[2].base_color, Rgb(0.5f, 0.5f, 0.5f));
  EXPECT_TRUE(scene.materials[3].base_color_texture.present());  // its alpha is needed

  overrides.materials = {{.name = "wal"}};
  const absl::Status unknown = ApplyOverrides(overrides, {}, scene);
  EXPECT_TRUE(absl::IsNotFound(unknown));
  EXPECT_THAT(std::string(unknown.message()), HasSubstr("'wal'; the nearest are 'wall'"));
  Scene bare;
  EXPECT_THAT(std::string(ApplyOverrides(overrides, {}, bare).message()), HasSubstr("it has none"));
}

TEST(Job, FramesHaveNumbersAndTimes) {
  JobSpec job;
  EXPECT_EQ(job.frame_count(), 1u);
  EXPECT_EQ(job.frame_number(0), 0);
  EXPECT_FALSE(job.frame_time_s(0).has_value());
  job.frames = {12, -6};
  job.fps = 12;
  EXPECT_EQ(job.frame_count(), 2u);
  EXPECT_EQ(job.frame_number(1), -6);
  EXPECT_EQ(job.frame_time_s(0), 1.0);
  EXPECT_EQ(job.frame_time_s(1), -0.5);
}

TEST(Job, NoOverrideChangesNothing) {
  Scene scene;
  scene.lights.resize(3);
  scene.meshes.resize(1);
  ASSERT_TRUE(ApplyOverrides({}, {}, scene).ok());
  EXPECT_EQ(scene.lights.size(), 3u);
  EXPECT_EQ(scene.meshes[0].material, -1);
  EXPECT_TRUE(scene.materials.empty());
}

TEST(Job, MatricesProjectTheFrameOntoTheUnitSquare) {
  Camera camera;
  camera.eye = {10, 20, 30};
  camera.right = {0, 0, -1};
  camera.up = {0, 1, 0};
  camera.forward = {1, 0, 0};
  camera.yfov_rad = 1.2;
  const FilmSpec film{.width = 200, .height = 100, .crop = {0, 0, 200, 100}};
  const CameraMatrices m = MatricesOf(camera, film);
  const auto apply = [](const std::array<float, 16>& a, const Vec3d& p) {
    std::array<double, 4> r{};
    for (int c = 0; c < 4; ++c) r[c] = p.x * a[c] + p.y * a[4 + c] + p.z * a[8 + c] + a[12 + c];
    return r;
  };
  // The upper right corner of the frame, 7 m away.
  const double t = std::tan(0.6);
  const Vec3d corner = camera.eye + (camera.forward + camera.up * t + camera.right * (2 * t)) * 7.0;
  const auto ndc = apply(m.world_to_ndc, corner);
  EXPECT_NEAR(ndc[0] / ndc[3], 1, 1e-5);
  EXPECT_NEAR(ndc[1] / ndc[3], 1, 1e-5);
  EXPECT_NEAR(ndc[3], 7, 1e-5);
  const auto local = apply(m.world_to_camera, corner);
  EXPECT_NEAR(local[0], 14 * t, 1e-5);
  EXPECT_NEAR(local[1], 7 * t, 1e-5);
  EXPECT_NEAR(local[2], -7, 1e-5);
}

TEST(Job, StatesHaveNamesAndAnEnd) {
  EXPECT_EQ(NameOf(JobState::kRendering), "rendering");
  EXPECT_FALSE(IsFinal(JobState::kRendering));
  EXPECT_TRUE(IsFinal(JobState::kDone));
  EXPECT_TRUE(IsFinal(JobState::kFailed));
  EXPECT_TRUE(IsFinal(JobState::kCancelled));
}

}  // namespace
}  // namespace farpoint

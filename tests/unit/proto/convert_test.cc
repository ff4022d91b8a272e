#include "proto/convert.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cmath>
#include <functional>
#include <limits>

namespace farpoint {
namespace {

using ::testing::HasSubstr;

constexpr float kNan = std::numeric_limits<float>::quiet_NaN();
constexpr double kInf = std::numeric_limits<double>::infinity();

Digest DigestOf(std::string_view text) { return Sha256().Update(text).Finish(); }

JobSpec FullJob() {
  JobSpec job;
  job.asset_root = "scene.gltf";
  job.asset_files = {{"scene.gltf", DigestOf("a")}, {"tex/ä b.png", DigestOf("b")}};
  job.settings.integrator = Integrator::kDpbgi;
  job.settings.spp = 4;
  job.settings.paths = 7;
  job.settings.light_samples = 9;
  job.settings.points = 123456789012 % (1u << 31);
  job.settings.microbuffer = 24;
  job.settings.buffer_map = BufferMap::kCosine;
  job.settings.splat = Splat::kOpaque;
  job.settings.clusters = 100;
  job.settings.epsilon = 0.2f;
  job.settings.cache_error = 0.4f;
  job.settings.cache_samples = 333;
  job.settings.ao_distance_m = 2.5f;
  job.settings.bounces = 5;
  job.settings.materials = Materials::kGltf;
  job.settings.normal_weight = 0.3f;
  job.settings.kmeans_iterations = 6;
  job.settings.seed = 0xffffffffffffffffu;
  job.settings.layers = {Layer::kBeauty, Layer::kIrradiance};
  job.settings.tile_px = 64;
  job.settings.no_skip = true;
  job.film = {.width = 640, .height = 480, .crop = {10, 20, 300, 400}};
  job.camera = LookAt{.eye = {1, 2, 3}, .target = {4, 5, 6}, .up = {0, 0, 2}, .yfov_deg = 33};
  job.overrides.suns = {{.to_sun = {0, 1, 1}, .irradiance = {3, 2, 1}},
                        {.to_sun = {1, 0, 0}, .irradiance = {0, 0, 1}}};
  job.overrides.sky = Rgb(0.1f, 0.2f, 0.3f);
  job.overrides.albedo = Rgb(0.5f, 0.6f, 0.7f);
  job.light_units = LightUnits::kRaw;
  job.limits.max_seconds = 77;
  job.limits.max_pixels = 1000000;
  job.title = "a title";
  job.priority = -5;
  job.overrides.lights = {{.name = "lamp",
                           .kind = PunctualKind::kSpot,
                           .position = {1, 2, 3},
                           .direction = {0, -1, 0},
                           .intensity = {4, 5, 6},
                           .range_m = 7,
                           .inner_cone_rad = 0.1,
                           .outer_cone_rad = 0.3}};
  job.asset_files["env/sky.exr"] = DigestOf("sky");
  job.overrides.environment = EnvironmentOverride{
      .uri = "env/sky.exr", .scale = {2, 3, 4}, .rotation_deg = -30, .up = {0, 0, 1}};
  job.overrides.materials = {{.name = "wall", .base_color = Rgb(0.1f, 0.2f, 0.3f)},
                             {.name = "lamp", .emission = Rgb(7, 8, 9)},
                             {.name = "neither"}};
  job.settings.filter = PixelFilter::kGaussian;
  job.settings.filter_width_px = 2.5f;
  job.frames = {7, 9};
  job.fps = 29.97;
  job.after = {{"00000001"}, {"00000002"}};
  job.start_paused = true;
  return job;
}

TEST(Convert, JobSurvivesTheWire) {
  const JobSpec job = FullJob();
  ASSERT_TRUE(ValidateJob(job).ok()) << ValidateJob(job);
  const v1::RenderJob wire = ToWire(job);
  const absl::StatusOr<JobSpec> back = JobFromWire(wire);
  ASSERT_TRUE(back.ok()) << back.status();
  EXPECT_EQ(ToWire(*back).SerializeAsString(), wire.SerializeAsString());
  EXPECT_EQ(back->settings.seed, job.settings.seed);
  EXPECT_EQ(back->settings.layers, job.settings.layers);
  EXPECT_EQ(back->film.crop, job.film.crop);
  EXPECT_EQ(back->asset_files, job.asset_files);
  EXPECT_EQ(back->limits, job.limits);
  EXPECT_EQ(std::get<LookAt>(back->camera).yfov_deg, 33);
  EXPECT_EQ(back->overrides.suns.size(), 2u);
  EXPECT_EQ(back->overrides.albedo, job.overrides.albedo);
  EXPECT_EQ(back->light_units, LightUnits::kRaw);
  EXPECT_EQ(back->overrides.lights[0].outer_cone_rad, job.overrides.lights[0].outer_cone_rad);
  EXPECT_EQ(back->overrides.environment->up, job.overrides.environment->up);
  EXPECT_EQ(back->overrides.materials[1].emission, job.overrides.materials[1].emission);
  EXPECT_FALSE(back->overrides.materials[1].base_color.has_value());
  EXPECT_EQ(back->frames, job.frames);
  EXPECT_EQ(back->fps, job.fps);
  EXPECT_EQ(back->after, job.after);
  EXPECT_TRUE(back->start_paused);
  EXPECT_EQ(back->settings.filter, PixelFilter::kGaussian);
}

TEST(Convert, JobSurvivesItsFile) {
  const v1::RenderJob wire = ToWire(FullJob());
  const absl::StatusOr<v1::RenderJob> back = RenderJobFromJson(RenderJobToJson(wire), "job.json");
  ASSERT_TRUE(back.ok()) << back.status();
  EXPECT_EQ(back->SerializeAsString(), wire.SerializeAsString());
}

TEST(Convert, AbsentFieldsAreDefaults) {
  const absl::StatusOr<JobSpec> job = JobFromWire(v1::RenderJob());
  ASSERT_TRUE(job.ok()) << job.status();
  const RenderSettings defaults;
  EXPECT_EQ(job->settings.spp, defaults.spp);
  EXPECT_EQ(job->settings.layers, defaults.layers);
  EXPECT_EQ(job->settings.integrator, defaults.integrator);
  EXPECT_EQ(job->film.width, 0);
  EXPECT_TRUE(std::holds_alternative<std::monostate>(job->camera));
  EXPECT_EQ(job->limits, JobLimits());
}

struct BadJob {
  const char* field;  // that the message must name
  std::function<void(v1::RenderJob&)> spoil;
};

TEST(Convert, EveryJobFieldOutOfRangeIsRefused) {
  const std::vector<BadJob> cases = {
      {"asset.root", [](auto& j) { j.mutable_asset()->set_root(std::string(5000, 'x')); }},
      {"asset.files", [](auto& j) { j.mutable_asset()->mutable_files(0)->set_uri(""); }},
      {"sha256", [](auto& j) { j.mutable_asset()->mutable_files(0)->set_sha256("abc"); }},
      {"sha256", [](auto& j) { j.mutable_asset()->mutable_files(0)->set_sha256(""); }},
      {"sha256",
       [](auto& j) { j.mutable_asset()->mutable_files(0)->set_sha256(std::string(64, '0')); }},
      {"twice", [](auto& j) { *j.mutable_asset()->add_files() = j.asset().files(0); }},
      {"integrator",
       [](auto& j) { j.mutable_settings()->set_integrator(static_cast<v1::Integrator>(99)); }},
      {"buffer_map",
       [](auto& j) { j.mutable_settings()->set_buffer_map(static_cast<v1::BufferMap>(99)); }},
      {"splat", [](auto& j) { j.mutable_settings()->set_splat(static_cast<v1::Splat>(99)); }},
      {"settings", [](auto& j) { j.mutable_settings()->set_spp(0); }},
      {"settings", [](auto& j) { j.mutable_settings()->set_spp(257); }},
      {"settings", [](auto& j) { j.mutable_settings()->set_paths(0); }},
      {"settings", [](auto& j) { j.mutable_settings()->set_paths((1u << 20) + 1); }},
      {"settings", [](auto& j) { j.mutable_settings()->set_light_samples(0); }},
      {"settings", [](auto& j) { j.mutable_settings()->set_light_samples(4097); }},
      {"settings", [](auto& j) { j.mutable_settings()->set_points((uint64_t{1} << 31) + 1); }},
      {"settings", [](auto& j) { j.mutable_settings()->set_microbuffer_px(257); }},
      {"settings", [](auto& j) { j.mutable_settings()->set_clusters(1025); }},
      {"settings", [](auto& j) { j.mutable_settings()->set_epsilon(-0.1f); }},
      {"settings", [](auto& j) { j.mutable_settings()->set_epsilon(kNan); }},
      {"settings", [](auto& j) { j.mutable_settings()->set_normal_weight(kNan); }},
      {"settings", [](auto& j) { j.mutable_settings()->set_kmeans_iterations(101); }},
      {"settings", [](auto& j) { j.mutable_settings()->set_tile_px(33); }},
      {"settings", [](auto& j) { j.mutable_settings()->set_tile_px(0); }},
      {"layers", [](auto& j) { j.mutable_settings()->add_layers("irradianze"); }},
      {"layers",
       [](auto& j) {
         for (int i = 0; i < 100; ++i) j.mutable_settings()->add_layers("direct");
       }},
      {"film.width_px", [](auto& j) { j.mutable_film()->set_width_px(0); }},
      {"film.width_px", [](auto& j) { j.mutable_film()->set_width_px(65537); }},
      {"film.height_px", [](auto& j) { j.mutable_film()->set_height_px(0); }},
      {"film.height_px", [](auto& j) { j.mutable_film()->set_height_px(0xffffffffu); }},
      {"film.crop", [](auto& j) { j.mutable_film()->mutable_crop()->set_x0(-1); }},
      {"film.crop", [](auto& j) { j.mutable_film()->mutable_crop()->set_x1(65537); }},
      {"film.crop", [](auto& j) { j.mutable_film()->mutable_crop()->set_y1(0); }},
      {"film", [](auto& j) { j.mutable_film()->mutable_crop()->set_x1(641); }},
      {"camera.name", [](auto& j) { j.mutable_camera()->set_name(std::string(5000, 'x')); }},
      {"camera.look_at.eye",
       [](auto& j) { j.mutable_camera()->mutable_look_at()->mutable_eye()->set_x(kInf); }},
      {"camera.look_at.target",
       [](auto& j) { j.mutable_camera()->mutable_look_at()->mutable_target()->set_y(kNan); }},
      {"camera.look_at.up",
       [](auto& j) { j.mutable_camera()->mutable_look_at()->mutable_up()->set_z(kInf); }},
      {"yfov_deg", [](auto& j) { j.mutable_camera()->mutable_look_at()->set_yfov_deg(0); }},
      {"yfov_deg", [](auto& j) { j.mutable_camera()->mutable_look_at()->set_yfov_deg(180); }},
      {"yfov_deg", [](auto& j) { j.mutable_camera()->mutable_look_at()->set_yfov_deg(kNan); }},
      {"suns.to_sun", [](auto& j) { j.mutable_overrides()->mutable_suns(0)->clear_to_sun(); }},
      {"suns.to_sun",
       [](auto& j) { j.mutable_overrides()->mutable_suns(0)->mutable_to_sun()->set_x(kNan); }},
      {"suns.irradiance",
       [](auto& j) { j.mutable_overrides()->mutable_suns(0)->mutable_irradiance()->set_r(-1); }},
      {"overrides.suns",
       [](auto& j) {
         for (int i = 0; i < 300; ++i) {
           const v1::Sun sun = j.overrides().suns(0);
           *j.mutable_overrides()->add_suns() = sun;
         }
       }},
      {"overrides.sky", [](auto& j) { j.mutable_overrides()->mutable_sky()->set_g(kNan); }},
      {"overrides.albedo", [](auto& j) { j.mutable_overrides()->mutable_albedo()->set_b(1.5f); }},
      {"overrides.albedo", [](auto& j) { j.mutable_overrides()->mutable_albedo()->set_b(-0.1f); }},
      {"overrides.lights[0].kind",
       [](auto& j) {
         j.mutable_overrides()->mutable_lights(0)->set_kind(v1::LIGHT_KIND_UNSPECIFIED);
       }},
      {"overrides.lights[0].kind",
       [](auto& j) {
         j.mutable_overrides()->mutable_lights(0)->set_kind(static_cast<v1::LightKind>(9));
       }},
      {"overrides.lights[0].direction",
       [](auto& j) { j.mutable_overrides()->mutable_lights(0)->clear_direction(); }},
      {"overrides.lights[0].position",
       [](auto& j) { j.mutable_overrides()->mutable_lights(0)->mutable_position()->set_x(kInf); }},
      {"overrides.lights[0].intensity",
       [](auto& j) { j.mutable_overrides()->mutable_lights(0)->mutable_intensity()->set_r(-1); }},
      {"overrides.lights[0].range_m",
       [](auto& j) { j.mutable_overrides()->mutable_lights(0)->set_range_m(-1); }},
      {"overrides.lights[0].inner_cone_rad",
       [](auto& j) { j.mutable_overrides()->mutable_lights(0)->set_inner_cone_rad(0.3); }},
      {"overrides.lights[0].outer_cone_rad",
       [](auto& j) { j.mutable_overrides()->mutable_lights(0)->set_outer_cone_rad(1.6); }},
      {"overrides.lights",
       [](auto& j) {
         for (int i = 0; i < 65537; ++i) j.mutable_overrides()->add_lights();
       }},
      {"overrides.environment.uri",
       [](auto& j) { j.mutable_overrides()->mutable_environment()->clear_uri(); }},
      {"overrides.environment.scale",
       [](auto& j) { j.mutable_overrides()->mutable_environment()->mutable_scale()->set_g(-1); }},
      {"overrides.environment.rotation_deg",
       [](auto& j) { j.mutable_overrides()->mutable_environment()->set_rotation_deg(kInf); }},
      {"overrides.environment.up",
       [](auto& j) { j.mutable_overrides()->mutable_environment()->mutable_up()->set_z(0); }},
      {"overrides.materials[0].name",
       [](auto& j) { j.mutable_overrides()->mutable_materials(0)->clear_name(); }},
      {"overrides.materials[0].base_color",
       [](auto& j) {
         j.mutable_overrides()->mutable_materials(0)->mutable_base_color()->set_r(1.5f);
       }},
      {"overrides.materials[1].emission",
       [](auto& j) {
         j.mutable_overrides()->mutable_materials(1)->mutable_emission()->set_b(kNan);
       }},
      {"filter",
       [](auto& j) { j.mutable_settings()->set_filter(static_cast<v1::PixelFilter>(99)); }},
      {"settings", [](auto& j) { j.mutable_settings()->set_filter_width_px(17); }},
      {"fps", [](auto& j) { j.set_fps(0); }},
      {"fps", [](auto& j) { j.set_fps(1001); }},
      {"fps", [](auto& j) { j.set_fps(kNan); }},
      {"frames",
       [](auto& j) {
         for (int i = 0; i < 100'000; ++i) j.add_frames(i);
       }},
      {"after", [](auto& j) { j.add_after(""); }},
      {"after",
       [](auto& j) {
         for (int i = 0; i < 64; ++i) j.add_after("x");
       }},
      {"light_units", [](auto& j) { j.set_light_units(static_cast<v1::LightUnits>(99)); }},
      {"limits.max_pixels", [](auto& j) { j.mutable_limits()->set_max_pixels(0); }},
      {"limits.max_asset_bytes", [](auto& j) { j.mutable_limits()->set_max_asset_bytes(0); }},
      {"limits.max_triangles", [](auto& j) { j.mutable_limits()->set_max_triangles(0); }},
      {"limits.max_surfels", [](auto& j) { j.mutable_limits()->set_max_surfels(0); }},
      {"limits.max_seconds", [](auto& j) { j.mutable_limits()->set_max_seconds(0); }},
      {"title", [](auto& j) { j.set_title(std::string(201, 'x')); }},
      {"priority", [](auto& j) { j.set_priority(1001); }},
      {"priority", [](auto& j) { j.set_priority(-1001); }},
  };
  for (size_t i = 0; i < cases.size(); ++i) {
    v1::RenderJob wire = ToWire(FullJob());
    cases[i].spoil(wire);
    const absl::StatusOr<JobSpec> job = JobFromWire(wire);
    ASSERT_FALSE(job.ok()) << "case " << i << ": " << cases[i].field;
    EXPECT_TRUE(absl::IsInvalidArgument(job.status())) << job.status();
    EXPECT_THAT(std::string(job.status().message()), HasSubstr(cases[i].field)) << "case " << i;
  }
}

TileWork FullWork() {
  TileWork work;
  work.lease = {"lease"};
  work.attempt = 3;
  work.job = {"0123abcd"};
  work.tile = 17;
  work.rect = {32, 64, 96, 128};
  work.frame.camera.eye = {1, 2, 3};
  work.frame.camera.name = "cam";
  work.frame.film = {.width = 640, .height = 480, .crop = {0, 0, 640, 480}};
  work.blobs = {DigestOf("s"), DigestOf("t"), DigestOf("r")};
  work.lease_time = std::chrono::milliseconds(1234);
  work.frame_index = 6;
  return work;
}

TEST(Convert, TileWorkSurvivesTheWire) {
  const v1::TileWork wire = ToWire(FullWork());
  const absl::StatusOr<TileWork> back = TileWorkFromWire(wire);
  ASSERT_TRUE(back.ok()) << back.status();
  EXPECT_EQ(ToWire(*back).SerializeAsString(), wire.SerializeAsString());
  EXPECT_EQ(back->blobs, FullWork().blobs);
  EXPECT_EQ(back->rect, FullWork().rect);
  EXPECT_EQ(back->frame_index, 6u);
}

TEST(Convert, EveryTileWorkFieldOutOfRangeIsRefused) {
  const std::vector<std::function<void(v1::TileWork&)>> cases = {
      [](auto& w) { w.clear_lease_id(); },
      [](auto& w) { w.set_lease_id(std::string(65, 'x')); },
      [](auto& w) { w.set_attempt(0); },
      [](auto& w) { w.clear_job_id(); },
      [](auto& w) { w.mutable_rect()->set_x1(32); },
      [](auto& w) { w.mutable_rect()->set_x1(672); },  // outside the film
      [](auto& w) { w.clear_rect(); },
      [](auto& w) { w.mutable_frame()->mutable_camera()->mutable_right()->set_x(2); },
      [](auto& w) { w.mutable_frame()->mutable_camera()->mutable_up()->set_x(0.1); },
      [](auto& w) { w.mutable_frame()->mutable_camera()->mutable_eye()->set_x(kNan); },
      [](auto& w) { w.mutable_frame()->mutable_camera()->set_yfov_rad(0); },
      [](auto& w) { w.mutable_frame()->mutable_camera()->set_yfov_rad(3.2); },
      [](auto& w) { w.mutable_frame()->clear_camera(); },
      [](auto& w) { w.mutable_frame()->clear_film(); },
      [](auto& w) { w.mutable_frame()->mutable_settings()->set_spp(0); },
      [](auto& w) { w.mutable_blobs()->clear_prepared_scene(); },
      [](auto& w) { w.mutable_blobs()->set_tree_topology("zz"); },
      [](auto& w) { w.mutable_blobs()->set_tree_radiance(std::string(63, 'a')); },
      [](auto& w) { w.set_lease_ms(0); },
  };
  for (size_t i = 0; i < cases.size(); ++i) {
    v1::TileWork wire = ToWire(FullWork());
    cases[i](wire);
    EXPECT_TRUE(absl::IsInvalidArgument(TileWorkFromWire(wire).status())) << "case " << i;
  }
}

TEST(Convert, StatsSurviveTheWireAndAreBounded) {
  Stats stats;
  stats.seconds[static_cast<size_t>(Stage::kCut)] = 1.5;
  stats.wall_seconds[static_cast<size_t>(Stage::kTrace)] = 0.25;
  stats.counts["surfels"] = 9;
  stats.skipped["blocks"] = 2;
  stats.bytes["tree"] = 1u << 20;
  const absl::StatusOr<Stats> back = StatsFromWire(ToWire(stats));
  ASSERT_TRUE(back.ok()) << back.status();
  EXPECT_EQ(back->seconds, stats.seconds);
  EXPECT_EQ(back->wall_seconds, stats.wall_seconds);
  EXPECT_EQ(back->counts, stats.counts);
  EXPECT_EQ(back->skipped, stats.skipped);
  EXPECT_EQ(back->bytes, stats.bytes);

  const std::vector<std::function<void(v1::Stats&)>> cases = {
      [](auto& s) { (*s.mutable_seconds())["lunch"] = 1; },
      [](auto& s) { (*s.mutable_seconds())["cut"] = -1; },
      [](auto& s) { (*s.mutable_wall_seconds())["cut"] = kNan; },
      [](auto& s) { (*s.mutable_counts())[std::string(65, 'x')] = 1; },
      [](auto& s) {
        for (int i = 0; i < 300; ++i) (*s.mutable_skipped())[std::to_string(i)] = 1;
      },
  };
  for (size_t i = 0; i < cases.size(); ++i) {
    v1::Stats wire = ToWire(stats);
    cases[i](wire);
    EXPECT_TRUE(absl::IsInvalidArgument(StatsFromWire(wire).status())) << "case " << i;
  }
}

TEST(Convert, JobStatusAndEventsSurviveTheWire) {
  JobStatus status;
  status.id = {"0123abcd"};
  status.title = "t";
  status.state = JobState::kFailed;
  status.tiles = {1, 2, 3, 4, 10};
  status.reissued = 5;
  status.refused_results = 6;
  status.eta_s = 7.5;
  status.error = absl::DataLossError("broken");
  status.priority = -3;
  status.progress = 0.5;
  status.submitted_unix_ms = 1234567890123;
  status.frames = {.total = 4, .baked = 3, .done = 2};
  status.after = {{"00000001"}, {"00000002"}};
  const absl::StatusOr<JobStatus> back = JobStatusFromWire(ToWire(status));
  ASSERT_TRUE(back.ok()) << back.status();
  EXPECT_EQ(ToWire(*back).SerializeAsString(), ToWire(status).SerializeAsString());
  EXPECT_EQ(back->error, status.error);
  EXPECT_EQ(back->tiles, status.tiles);
  EXPECT_EQ(back->frames, status.frames);
  EXPECT_EQ(back->after, status.after);
  for (const JobState state : {JobState::kQueued, JobState::kBaking, JobState::kRendering,
                               JobState::kDone, JobState::kCancelled, JobState::kPaused}) {
    JobStatus other = status;
    other.state = state;
    EXPECT_EQ(JobStatusFromWire(ToWire(other))->state, state);
  }

  const JobEventBody bodies[] = {
      std::monostate(), JobState::kDone, TileCommitted{4, DigestOf("x")}, std::string("note"),
      LogLine{.level = LogLevel::kError, .text = "lost", .tile = 0, .attempt = 2, .worker = "w"}};
  for (const JobEventBody& body : bodies) {
    const absl::StatusOr<JobEvent> event = JobEventFromWire(
        ToWire(JobEvent{.sequence = 3, .body = body, .status = status, .unix_ms = 1234567890123}));
    ASSERT_TRUE(event.ok()) << event.status();
    EXPECT_EQ(event->body.index(), body.index());
    EXPECT_EQ(event->sequence, 3u);
    EXPECT_EQ(event->unix_ms, 1234567890123);
    if (const auto* line = std::get_if<LogLine>(&body)) {
      EXPECT_EQ(std::get<LogLine>(event->body), *line);
    }
  }

  v1::JobStatus wire = ToWire(status);
  wire.set_state(static_cast<v1::JobState>(44));
  EXPECT_TRUE(absl::IsInvalidArgument(JobStatusFromWire(wire).status()));
  wire = ToWire(status);
  wire.set_error_code(17);
  EXPECT_TRUE(absl::IsInvalidArgument(JobStatusFromWire(wire).status()));
  wire = ToWire(status);
  wire.set_eta_s(-1);
  EXPECT_TRUE(absl::IsInvalidArgument(JobStatusFromWire(wire).status()));
  wire = ToWire(status);
  wire.set_progress(1.5);
  EXPECT_TRUE(absl::IsInvalidArgument(JobStatusFromWire(wire).status()));
  wire = ToWire(status);
  wire.clear_id();
  EXPECT_TRUE(absl::IsInvalidArgument(JobStatusFromWire(wire).status()));
  wire = ToWire(status);
  wire.add_after(std::string(65, 'x'));
  EXPECT_TRUE(absl::IsInvalidArgument(JobStatusFromWire(wire).status()));
  v1::LogLine line = ToWire(LogLine{});
  line.set_level(v1::LOG_LEVEL_UNSPECIFIED);
  EXPECT_TRUE(absl::IsInvalidArgument(LogLineFromWire(line).status()));
}

TEST(Convert, ExplanationsSurviveTheWireAndAreBounded) {
  const Explanation explanation{.lines = {"one", "two"}};
  v1::ExplainResponse wire = ToWire(explanation);
  EXPECT_EQ(ExplanationFromWire(wire)->lines, explanation.lines);
  for (int i = 0; i < 10000; ++i) wire.add_lines("x");
  EXPECT_TRUE(absl::IsInvalidArgument(ExplanationFromWire(wire).status()));
}

TEST(Convert, JobInfoSurvivesTheWireAndKeepsTilesInsideTheCrop) {
  JobInfo info;
  info.status.id = {"0123abcd"};
  info.spec = FullJob();
  info.tiles = {{.rect = {10, 20, 64, 64}, .sha256 = DigestOf("t")}, {.rect = {64, 20, 128, 64}}};
  info.frames.resize(2);
  info.frames[0] = {.number = 7, .baked = true, .blobs = {DigestOf("s"), {}, {}}};
  info.frames[0].camera.world_to_camera[3] = 4;
  info.frames[1].number = 9;
  info.tiles[1].frame = 1;
  info.notes = {"a note"};
  info.version = "1";
  const v1::FetchInfoResponse wire = ToWire(info);
  const absl::StatusOr<JobInfo> back = JobInfoFromWire(wire);
  ASSERT_TRUE(back.ok()) << back.status();
  EXPECT_EQ(ToWire(*back).SerializeAsString(), wire.SerializeAsString());

  const std::vector<std::function<void(v1::FetchInfoResponse&)>> cases = {
      [](auto& w) { w.mutable_tiles(0)->mutable_rect()->set_x0(9); },
      [](auto& w) { w.mutable_tiles(0)->set_sha256("x"); },
      [](auto& w) { w.mutable_frames(0)->mutable_camera()->add_world_to_ndc(1); },
      [](auto& w) { w.mutable_frames(0)->mutable_camera()->set_world_to_ndc(0, kNan); },
      [](auto& w) { w.mutable_tiles(1)->set_frame(2); },
      [](auto& w) { w.mutable_frames()->RemoveLast(); },
      [](auto& w) { w.add_frames(); },
      [](auto& w) { w.mutable_job()->mutable_asset()->clear_files(); },
      [](auto& w) { w.mutable_job()->clear_film(); },
      [](auto& w) { w.mutable_frames(0)->mutable_blobs()->clear_prepared_scene(); },
  };
  for (size_t i = 0; i < cases.size(); ++i) {
    v1::FetchInfoResponse spoiled = wire;
    cases[i](spoiled);
    EXPECT_TRUE(absl::IsInvalidArgument(JobInfoFromWire(spoiled).status())) << "case " << i;
  }
}

TEST(Convert, HelloAndWelcomeAreChecked) {
  WorkerHello hello;
  hello.version = "1";
  hello.fingerprint = DigestOf("f");
  hello.threads = 3;
  hello.name = "n";
  const v1::RegisterRequest wire = ToWire(hello);
  EXPECT_EQ(wire.protocol_version(), kProtocolVersion);
  const absl::StatusOr<WorkerHello> back = HelloFromWire(wire);
  ASSERT_TRUE(back.ok()) << back.status();
  EXPECT_EQ(back->fingerprint, hello.fingerprint);

  const std::vector<std::function<void(v1::RegisterRequest&)>> cases = {
      [](auto& w) { w.set_threads(0); },
      [](auto& w) { w.clear_fingerprint(); },
      [](auto& w) { w.set_name(std::string(201, 'x')); },
      [](auto& w) { w.set_version(std::string(201, 'x')); },
  };
  for (size_t i = 0; i < cases.size(); ++i) {
    v1::RegisterRequest spoiled = wire;
    cases[i](spoiled);
    EXPECT_TRUE(absl::IsInvalidArgument(HelloFromWire(spoiled).status())) << "case " << i;
  }
  v1::RegisterResponse welcome = ToWire(WorkerWelcome{.id = {"w"}});
  EXPECT_TRUE(WelcomeFromWire(welcome).ok());
  welcome.set_heartbeat_ms(0);
  EXPECT_TRUE(absl::IsInvalidArgument(WelcomeFromWire(welcome).status()));
}

TEST(Convert, ReturnHeaderBoundsTheSize) {
  TileResult result;
  result.lease = {"l"};
  result.attempt = 2;
  result.bytes = Blob::FromString("abc");
  result.sha256 = result.bytes.Hash();
  const v1::ReturnHeader wire = ToWire(WorkerId{"w"}, result);
  const absl::StatusOr<ReturnHead> head = ReturnHeadFromWire(wire, 3);
  ASSERT_TRUE(head.ok()) << head.status();
  EXPECT_EQ(head->size_bytes, 3u);
  EXPECT_EQ(head->result.sha256, result.sha256);
  EXPECT_TRUE(absl::IsInvalidArgument(ReturnHeadFromWire(wire, 2).status()));
  v1::ReturnHeader empty = wire;
  empty.set_size_bytes(0);
  EXPECT_TRUE(absl::IsInvalidArgument(ReturnHeadFromWire(empty, 3).status()));
  v1::ReturnHeader unnamed = wire;
  unnamed.clear_worker_id();
  EXPECT_TRUE(absl::IsInvalidArgument(ReturnHeadFromWire(unnamed, 3).status()));
}

TEST(Convert, WorkerStatusSurvivesTheWire) {
  WorkerStatus status;
  status.id = {"w"};
  status.name = "n";
  status.version = "v";
  status.threads = 2;
  status.fingerprint = DigestOf("f");
  status.leases = 1;
  status.committed = 4;
  status.failures = 5;
  status.set_aside = true;
  status.idle_s = 0.5;
  status.gone = true;
  const absl::StatusOr<WorkerStatus> back = WorkerStatusFromWire(ToWire(status));
  ASSERT_TRUE(back.ok()) << back.status();
  EXPECT_EQ(ToWire(*back).SerializeAsString(), ToWire(status).SerializeAsString());
  EXPECT_TRUE(back->gone);
}

TEST(Convert, NeighbouringProtocolsAgreeOnTheNewestThatBothSpeak) {
  for (uint32_t version = kOldestProtocolVersion; version <= kProtocolVersion; ++version) {
    EXPECT_EQ(*AgreeOnProtocol(0, version, "worker"), version);
  }
  // A newer peer that still speaks ours.
  EXPECT_EQ(*AgreeOnProtocol(kProtocolVersion, kProtocolVersion + 2, "worker"), kProtocolVersion);
  EXPECT_EQ(*AgreeOnProtocol(1, kOldestProtocolVersion, "worker"), kOldestProtocolVersion);
  EXPECT_EQ(*AgreeOnProtocol(1, kProtocolVersion + 5, "worker"), kProtocolVersion);
  // What makes no sense is read as one version.
  EXPECT_EQ(*AgreeOnProtocol(kProtocolVersion + 3, kProtocolVersion, "worker"), kProtocolVersion);
}

TEST(Convert, ProtocolsTooFarApartAreRefusedAndItSaysWhomToUpdate) {
  const absl::Status older = AgreeOnProtocol(0, kOldestProtocolVersion - 1, "worker").status();
  EXPECT_TRUE(absl::IsFailedPrecondition(older));
  EXPECT_THAT(std::string(older.message()), HasSubstr("update the worker"));
  const absl::Status newer =
      AgreeOnProtocol(kProtocolVersion + 1, kProtocolVersion + 4, "client").status();
  EXPECT_TRUE(absl::IsFailedPrecondition(newer));
  EXPECT_THAT(std::string(newer.message()), HasSubstr("update the coordinator"));
}

// What a newer client knows and this coordinator does not would be left out of the image in
// silence.
TEST(Convert, FieldsOfANewerVersionAreFoundAtAnyDepth) {
  const JobSpec spec;
  v1::RenderJob job = ToWire(spec);
  EXPECT_TRUE(CheckFieldsKnown(job, "job").ok());
  job.mutable_overrides()
      ->add_lights()
      ->mutable_position()
      ->GetReflection()
      ->MutableUnknownFields(job.mutable_overrides()->mutable_lights(0)->mutable_position())
      ->AddVarint(77, 1);
  const absl::Status status = CheckFieldsKnown(job, "job");
  EXPECT_TRUE(absl::IsFailedPrecondition(status));
  EXPECT_THAT(std::string(status.message()), HasSubstr("job.overrides.lights[0].position"));
  EXPECT_THAT(std::string(status.message()), HasSubstr("77"));
  EXPECT_THAT(std::string(status.message()), HasSubstr("update the coordinator"));
}

TEST(Convert, ACoordinatorsHealthSurvivesTheWire) {
  CoordinatorHealth health;
  health.version = "1.2";
  health.protocol_version = 7;
  health.oldest_protocol_version = 5;
  health.unix_ms = 1234;
  health.draining = true;
  health.caller_name = "alice";
  health.caller_role = "client";
  health.store_error = "full";
  health.store_free_bytes = 1;
  health.store_total_bytes = 2;
  health.memory_available_bytes = 3;
  health.memory_total_bytes = 4;
  health.open_files = 5;
  health.open_files_limit = 6;
  health.connections = 7;
  health.max_connections = 8;
  health.max_request_bytes = 9;
  health.max_blob_bytes = 10;
  health.limits.max_pixels = 11;
  health.max_jobs = 12;
  health.max_bytes = 13;
  health.jobs = 14;
  health.bytes = 15;
  health.workers.push_back({.id = {"0badcafe"}, .name = "w", .fingerprint = HashBytes({})});
  health.blob_directory = "/shared";
  health.blob_mark = "mark";
  health.certificate_not_after_s = 16;
  const auto back = HealthFromWire(ToWire(health));
  ASSERT_TRUE(back.ok()) << back.status();
  EXPECT_EQ(ToWire(*back).SerializeAsString(), ToWire(health).SerializeAsString());
  EXPECT_EQ(back->limits, health.limits);
  EXPECT_EQ(back->workers.at(0).name, "w");
}

}  // namespace
}  // namespace farpoint

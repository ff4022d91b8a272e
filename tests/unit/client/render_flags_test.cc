#include "client/render_flags.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <set>

namespace farpoint {
namespace {

using testing::AllOf;
using testing::ElementsAre;
using testing::HasSubstr;
using testing::IsEmpty;
using testing::StartsWith;

JobSpec Apply(const std::vector<GivenFlag>& given, JobSpec spec = {}) {
  const absl::Status status = ApplyRenderFlags(given, spec);
  EXPECT_TRUE(status.ok()) << status;
  return spec;
}

std::string Refusal(const std::vector<GivenFlag>& given, JobSpec spec = {}) {
  const absl::Status status = ApplyRenderFlags(given, spec);
  EXPECT_EQ(status.code(), absl::StatusCode::kInvalidArgument);
  EXPECT_EQ(status.message().find('\n'), std::string::npos);
  return std::string(status.message());
}

TEST(RenderFlags, DefaultsAreThoseOfTheSettings) {
  const JobSpec spec = Apply({});
  EXPECT_EQ(spec.film.width, 1280);
  EXPECT_EQ(spec.film.height, 720);
  EXPECT_EQ(spec.film.crop, (PixelRect{0, 0, 1280, 720}));
  EXPECT_EQ(spec.settings.integrator, Integrator::kFpbgi);
  EXPECT_EQ(spec.settings.layers, DefaultLayers());
  EXPECT_TRUE(std::holds_alternative<std::monostate>(spec.camera));
}

TEST(RenderFlags, NamesAreUniqueAndExplained) {
  std::set<std::string_view> names;
  for (const RenderFlag& flag : RenderFlags()) {
    EXPECT_TRUE(names.insert(flag.name).second) << flag.name;
    EXPECT_THAT(std::string(flag.name), StartsWith("--"));
    EXPECT_FALSE(flag.help.empty()) << flag.name;
  }
}

TEST(RenderFlags, SetFilterAndFrames) {
  const JobSpec spec = Apply({{"--filter", "gaussian"},
                              {"--filter-width", "2.5"},
                              {"--frames", "1-10x2,15"},
                              {"--fps", "23.976"}});
  EXPECT_EQ(spec.settings.filter, PixelFilter::kGaussian);
  EXPECT_EQ(spec.settings.filter_width_px, 2.5f);
  EXPECT_THAT(spec.frames, ElementsAre(1, 3, 5, 7, 9, 15));
  EXPECT_EQ(spec.fps, 23.976);
  for (const char* name : {"box", "triangle", "gaussian", "blackman-harris"}) {
    EXPECT_EQ(NameOf(Apply({{"--filter", name}}).settings.filter), name);
  }
  JobSpec file;
  file.frames = {7};
  file.fps = 30;
  EXPECT_THAT(Apply({}, file).frames, ElementsAre(7));
  EXPECT_THAT(Apply({{"--frames", "2"}}, file).frames, ElementsAre(2));
  EXPECT_EQ(Apply({{"--frames", "2"}}, file).fps, 30);
  EXPECT_THAT(Refusal({{"--filter", "mitchell"}}), StartsWith("--filter mitchell: "));
  EXPECT_THAT(Refusal({{"--filter-width", "17"}}), StartsWith("--filter-width 17: "));
  EXPECT_THAT(Refusal({{"--filter-width", "nan"}}), StartsWith("--filter-width nan: "));
  EXPECT_THAT(Refusal({{"--frames", "1-"}}), StartsWith("--frames 1-: "));
  for (const char* fps : {"0", "-24", "1001", "inf", "film"}) {
    EXPECT_THAT(Refusal({{"--fps", fps}}), StartsWith(std::string("--fps ") + fps + ": ")) << fps;
  }
}

TEST(RenderFlags, SetTheEnvironment) {
  const JobSpec spec = Apply({{"--env-up", "0,0,2"},
                              {"--env-scale", "0.5"},
                              {"--env", "maps/a.exr"},
                              {"--env-rotation", "-90"}});
  ASSERT_TRUE(spec.overrides.environment.has_value());
  EXPECT_EQ(spec.overrides.environment->uri, "maps/a.exr");
  EXPECT_EQ(spec.overrides.environment->scale, Rgb(0.5f, 0.5f, 0.5f));
  EXPECT_EQ(spec.overrides.environment->rotation_deg, -90);
  EXPECT_EQ(spec.overrides.environment->up.z, 2);
  EXPECT_EQ(Apply({{"--env", "a.exr"}, {"--env-scale", "1,2,3"}}).overrides.environment->scale,
            Rgb(1, 2, 3));
  for (const auto& [flag, value] : {GivenFlag{"--env-scale", "2"}, GivenFlag{"--env-rotation", "2"},
                                    GivenFlag{"--env-up", "0,1,0"}}) {
    EXPECT_THAT(Refusal({{flag, value}}), AllOf(StartsWith(flag), HasSubstr("--env FILE")));
    EXPECT_TRUE(Apply({{flag, value}}, spec).overrides.environment.has_value());
  }
  const GivenFlag map{"--env", "a.exr"};
  for (const char* scale : {"-1", "1,2", "1,-2,3", "a", "nan", "1e31"}) {
    EXPECT_THAT(Refusal({map, {"--env-scale", scale}}), StartsWith("--env-scale ")) << scale;
  }
  EXPECT_THAT(Refusal({map, {"--env-up", "0,0,0"}}), HasSubstr("zero"));
  EXPECT_THAT(Refusal({map, {"--env-rotation", "east"}}), HasSubstr("degrees"));
  EXPECT_THAT(Refusal({{"--env", ""}}), HasSubstr("file"));
}

TEST(RenderFlags, SetTheImage) {
  const JobSpec spec = Apply({{"--crop", "10,20,300,200"},
                              {"--resolution", "320x240"},
                              {"--spp", "4"},
                              {"--seed", "18446744073709551615"}});
  EXPECT_EQ(spec.film.width, 320);
  EXPECT_EQ(spec.film.height, 240);
  EXPECT_EQ(spec.film.crop, (PixelRect{10, 20, 300, 200}));
  EXPECT_EQ(spec.settings.spp, 4u);
  EXPECT_EQ(spec.settings.seed, 18446744073709551615u);
}

TEST(RenderFlags, SetTheMethod) {
  const RenderSettings s = Apply({{"--integrator", "pbgi"},
                                  {"--paths", "256"},
                                  {"--light-samples", "32"},
                                  {"--points", "100000"},
                                  {"--microbuffer", "48"},
                                  {"--buffer-map", "cosine"},
                                  {"--splat", "opaque"},
                                  {"--clusters", "25"},
                                  {"--cache-error", "0.125"},
                                  {"--ao-distance", "0.75"},
                                  {"--cache-samples", "300"},
                                  {"--epsilon", "0.25"}})
                               .settings;
  EXPECT_EQ(s.integrator, Integrator::kPbgi);
  EXPECT_EQ(s.paths, 256u);
  EXPECT_EQ(s.light_samples, 32u);
  EXPECT_EQ(s.points, 100000u);
  EXPECT_EQ(s.microbuffer, 48u);
  EXPECT_EQ(s.buffer_map, BufferMap::kCosine);
  EXPECT_EQ(s.splat, Splat::kOpaque);
  EXPECT_EQ(s.clusters, 25u);
  EXPECT_EQ(s.cache_error, 0.125f);
  EXPECT_EQ(s.ao_distance_m, 0.75f);
  EXPECT_EQ(s.cache_samples, 300u);
  EXPECT_EQ(s.epsilon, 0.25f);
}

TEST(RenderFlags, KnowEveryIntegrator) {
  for (const Integrator integrator : {Integrator::kFpbgi, Integrator::kPbgi, Integrator::kDpbgi,
                                      Integrator::kPt, Integrator::kIrrcache}) {
    const std::string name(NameOf(integrator));
    EXPECT_EQ(Apply({{"--integrator", name}}).settings.integrator, integrator) << name;
  }
}

TEST(RenderFlags, SetTheSpeed) {
  const RenderSettings s = Apply({{"--tile", "64"}, {"--no-skip", ""}}).settings;
  EXPECT_EQ(s.tile_px, 64u);
  EXPECT_TRUE(s.no_skip);
}

TEST(RenderFlags, AovAddsLayersInTheFixedOrder) {
  std::vector<Layer> expected = DefaultLayers();
  expected.push_back(Layer::kIrradiance);
  expected.push_back(Layer::kCluster);
  EXPECT_EQ(Apply({{"--aov", "cluster,irradiance,direct"}}).settings.layers, expected);
  EXPECT_THAT(Apply({{"--aov", "none,irradiance"}}).settings.layers,
              ElementsAre(Layer::kBeauty, Layer::kIrradiance));
}

TEST(RenderFlags, PresetComesFirstWhereverItStands) {
  RenderSettings paper;
  ApplyPaperPreset(paper);
  EXPECT_EQ(Apply({{"--preset", "paper"}}).settings.splat, paper.splat);
  const RenderSettings s = Apply({{"--clusters", "7"}, {"--preset", "paper"}}).settings;
  EXPECT_EQ(s.clusters, 7u);
  EXPECT_EQ(s.splat, Splat::kOpaque);
}

TEST(RenderFlags, CameraByName) {
  const JobSpec spec = Apply({{"--camera", "front"}});
  EXPECT_EQ(std::get<CameraName>(spec.camera).name, "front");
}

TEST(RenderFlags, FreeCamera) {
  const LookAt look = std::get<LookAt>(
      Apply({{"--eye", "1,2,3"}, {"--target", "-1,0,1e-3"}, {"--up", "0,0,1"}, {"--fov", "60"}})
          .camera);
  EXPECT_EQ(look.eye, Vec3d(1, 2, 3));
  EXPECT_EQ(look.target, Vec3d(-1, 0, 1e-3));
  EXPECT_EQ(look.up, Vec3d(0, 0, 1));
  EXPECT_EQ(look.yfov_deg, 60);
}

TEST(RenderFlags, PartOfAJobFilesFreeCameraCanBeReplaced) {
  JobSpec spec;
  spec.camera = LookAt{.eye = {1, 1, 1}, .target = {0, 0, 0}, .yfov_deg = 30};
  const LookAt look = std::get<LookAt>(Apply({{"--eye", "5,5,6"}}, spec).camera);
  EXPECT_EQ(look.eye, Vec3d(5, 5, 6));
  EXPECT_EQ(look.target, Vec3d(0, 0, 0));
  EXPECT_EQ(look.yfov_deg, 30);
}

TEST(RenderFlags, SetLightsAndMaterials) {
  const JobSpec spec = Apply({{"--sun", "0,1,0:1,2,3"},
                              {"--sun", "1,1,0:4,5,6"},
                              {"--sky", "0.1,0.2,0.3"},
                              {"--albedo", "0.5,0.5,1"},
                              {"--light-units", "raw"}});
  ASSERT_EQ(spec.overrides.suns.size(), 2u);
  EXPECT_EQ(spec.overrides.suns[0].to_sun, Vec3d(0, 1, 0));
  EXPECT_EQ(spec.overrides.suns[1].irradiance, Rgb(4, 5, 6));
  EXPECT_EQ(spec.overrides.sky, Rgb(0.1f, 0.2f, 0.3f));
  EXPECT_EQ(spec.overrides.albedo, Rgb(0.5f, 0.5f, 1));
  EXPECT_EQ(spec.light_units, LightUnits::kRaw);
}

TEST(RenderFlags, SunsReplaceThoseOfTheJobFile) {
  JobSpec spec;
  spec.overrides.suns.resize(3);
  EXPECT_EQ(Apply({{"--sun", "0,1,0:1,1,1"}}, spec).overrides.suns.size(), 1u);
  EXPECT_EQ(Apply({{"--spp", "2"}}, spec).overrides.suns.size(), 3u);
}

TEST(RenderFlags, OverrideTheJobFile) {
  JobSpec spec;
  spec.film = {64, 64, {0, 0, 32, 64}};
  spec.settings.spp = 9;
  spec.settings.clusters = 3;
  const JobSpec out = Apply({{"--spp", "2"}}, spec);
  EXPECT_EQ(out.settings.spp, 2u);
  EXPECT_EQ(out.settings.clusters, 3u);
  EXPECT_EQ(out.film.crop, (PixelRect{0, 0, 32, 64}));
  // A new resolution makes the file's crop meaningless.
  EXPECT_EQ(Apply({{"--resolution", "8x8"}}, spec).film.crop, (PixelRect{0, 0, 8, 8}));
}

TEST(RenderFlags, ALaterFlagMayHealAnEarlierOne) {
  JobSpec spec;
  spec.settings.integrator = Integrator::kPbgi;
  spec.settings.clusters = 64;
  spec.settings.buffer_map = BufferMap::kCosine;
  EXPECT_EQ(
      Apply({{"--integrator", "fpbgi"}, {"--buffer-map", "octahedral"}}, spec).settings.integrator,
      Integrator::kFpbgi);
  EXPECT_THAT(Refusal({{"--integrator", "fpbgi"}}, spec), StartsWith("--integrator fpbgi: "));
}

TEST(RenderFlags, LeaveTheJobAloneWhenTheyAreRefused) {
  JobSpec spec;
  spec.settings.spp = 3;
  EXPECT_FALSE(
      ApplyRenderFlags(std::vector<GivenFlag>{{"--spp", "5"}, {"--tile", "7"}}, spec).ok());
  EXPECT_EQ(spec.settings.spp, 3u);
}

struct BadValue {
  const char* flag;
  const char* value;
  const char* says;
};
void PrintTo(const BadValue& bad, std::ostream* out) { *out << bad.flag << " " << bad.value; }

class RenderFlagsRefuse : public testing::TestWithParam<BadValue> {};

TEST_P(RenderFlagsRefuse, BadValuesByNameAndValue) {
  const BadValue& bad = GetParam();
  EXPECT_THAT(Refusal({{bad.flag, bad.value}}),
              AllOf(StartsWith(std::string(bad.flag) + (*bad.value ? " " : "") + bad.value + ": "),
                    HasSubstr(bad.says)));
}

INSTANTIATE_TEST_SUITE_P(
    Values, RenderFlagsRefuse,
    testing::Values(
        BadValue{"--integrator", "pbgii", "did you mean 'pbgi'?"},
        BadValue{"--integrator", "irrcach", "did you mean 'irrcache'?"},
        BadValue{"--ao-distance", "-1", "inf"}, BadValue{"--ao-distance", "nan", "inf"},
        BadValue{"--cache-error", "0.001", "0.01"}, BadValue{"--cache-error", "x", "0.01"},
        BadValue{"--cache-samples", "-1", "whole number"},
        BadValue{"--cache-samples", "3", "cache-samples"},
        BadValue{"--resolution", "640", "WIDTHxHEIGHT"}, BadValue{"--resolution", "0x10", ""},
        BadValue{"--resolution", "70000x10", ""},
        BadValue{"--resolution", "10x10x10", "WIDTHxHEIGHT"},
        BadValue{"--crop", "0,0,10", "x0,y0,x1,y1"}, BadValue{"--crop", "0,0,1281,10", ""},
        BadValue{"--crop", "5,5,5,9", ""}, BadValue{"--spp", "0", "spp"},
        BadValue{"--spp", "257", "spp"}, BadValue{"--spp", "-1", "whole number"},
        BadValue{"--spp", "2.5", "whole number"}, BadValue{"--spp", "", "whole number"},
        BadValue{"--spp", "4294967297", "whole number"}, BadValue{"--paths", "0", "paths"},
        BadValue{"--light-samples", "5000", "light-samples"},
        BadValue{"--points", "2147483649", "points"}, BadValue{"--microbuffer", "257", ""},
        BadValue{"--buffer-map", "cosin", "did you mean 'cosine'?"},
        BadValue{"--splat", "both", "coverage, opaque"},
        BadValue{"--fill", "x", "auto, rays or cut"}, BadValue{"--quality", "x", "draft, normal"},
        BadValue{"--clusters", "adapt", "adaptive"}, BadValue{"--clusters", "0", "1..1024"},
        BadValue{"--clusters", "1025", "clusters"}, BadValue{"--epsilon", "-0.1", "at least 0"},
        BadValue{"--epsilon", "nan", "finite"}, BadValue{"--epsilon", "inf", "finite"},
        BadValue{"--materials", "phong", "lambert or gltf"}, BadValue{"--bounces", "65", "bounces"},
        BadValue{"--bounces", "0", "bounces"}, BadValue{"--tile", "100", "multiple"},
        BadValue{"--tile", "0", "multiple"}, BadValue{"--aov", "irradience", "irradiance"},
        BadValue{"--aov", "", "unknown layer"}, BadValue{"--aov", "stderr", "pt"},
        BadValue{"--preset", "fast", "paper"}, BadValue{"--camera", "", "name"},
        BadValue{"--eye", "1,2", "three finite numbers"},
        BadValue{"--eye", "1,2,inf", "three finite numbers"},
        BadValue{"--target", "a,b,c", "three finite numbers"},
        BadValue{"--up", "0,0,0", "must not be zero"}, BadValue{"--fov", "180", "less than 180"},
        BadValue{"--fov", "0", "more than 0"}, BadValue{"--sun", "0,1,0", "x,y,z:r,g,b"},
        BadValue{"--sun", "0,0,0:1,1,1", "must not be zero"},
        BadValue{"--sun", "0,1,0:1,1,-1", "irradiance"}, BadValue{"--sky", "1,1", "three"},
        BadValue{"--sky", "1e31,0,0", "[0, 1e30]"}, BadValue{"--albedo", "0,0,1.5", "[0, 1]"},
        BadValue{"--light-units", "lux", "photometric, raw"}));

TEST(RenderFlagsRefuse, PartsOfACameraThatMakeNoCamera) {
  EXPECT_THAT(Refusal({{"--eye", "1,2,3"}}), HasSubstr("--target"));
  EXPECT_THAT(Refusal({{"--target", "1,2,3"}}), HasSubstr("--eye"));
  EXPECT_THAT(Refusal({{"--fov", "30"}}), HasSubstr("--eye and --target"));
  EXPECT_THAT(Refusal({{"--up", "0,1,0"}}), HasSubstr("--eye and --target"));
  EXPECT_THAT(Refusal({{"--camera", "a"}, {"--fov", "30"}}), StartsWith("--camera a: "));
  EXPECT_THAT(Refusal({{"--eye", "1,2,3"}, {"--target", "1,2,3"}}), HasSubstr("same point"));
  EXPECT_THAT(Refusal({{"--eye", "0,5,0"}, {"--target", "0,0,0"}}), HasSubstr("parallel"));
}

TEST(RenderFlags, SetClustersFillAndQuality) {
  RenderSettings s = Apply({{"--clusters", "9"}, {"--fill", "rays"}}).settings;
  EXPECT_EQ(s.clusters, 9u);
  EXPECT_EQ(s.fill, Fill::kRays);
  s = Apply({{"--clusters", "adaptive"}, {"--fill", "cut"}, {"--quality", "fine"}}).settings;
  EXPECT_TRUE(s.adaptive());
  EXPECT_EQ(s.fill, Fill::kCut);
  EXPECT_EQ(s.quality, Quality::kFine);
}

TEST(CheckScenePath, KnowsItsExtensions) {
  EXPECT_TRUE(CheckScenePath("a/b.gltf").ok());
  EXPECT_TRUE(CheckScenePath("B.GLB").ok());
  EXPECT_TRUE(CheckScenePath("job.json").ok());
  EXPECT_THAT(std::string(CheckScenePath("a.xyz").message()),
              AllOf(HasSubstr("a.xyz"), HasSubstr(".gltf"), HasSubstr("job file .json")));
  EXPECT_THAT(std::string(CheckScenePath("a.fbx").message()), HasSubstr(".gltf, .glb"));
  EXPECT_FALSE(CheckScenePath("gltf").ok());
}

TEST(IsJobFile, GoesByTheExtension) {
  EXPECT_TRUE(IsJobFile("x.JSON"));
  EXPECT_FALSE(IsJobFile("x.gltf"));
}

// What a user is warned of.
std::vector<std::string> Ineffective(const std::vector<GivenFlag>& given) {
  const JobSpec spec = Apply(given);
  return IneffectiveFlags(given, spec.settings);
}

TEST(IneffectiveFlags, AreNoneWhereAllCount) {
  EXPECT_THAT(Ineffective({}), IsEmpty());
  EXPECT_THAT(Ineffective({{"--quality", "fine"},
                           {"--points", "5"},
                           {"--light-samples", "8"},
                           {"--fill", "rays"},
                           {"--clusters", "adaptive"},
                           {"--seed", "2"}}),
              IsEmpty());
  EXPECT_THAT(Ineffective({{"--preset", "paper"},
                           {"--epsilon", "0.2"},
                           {"--microbuffer", "16"},
                           {"--splat", "opaque"},
                           {"--buffer-map", "octahedral"}}),
              IsEmpty());
  EXPECT_THAT(Ineffective({{"--fill", "cut"}, {"--microbuffer", "16"}, {"--quality", "draft"}}),
              IsEmpty());
  EXPECT_THAT(Ineffective({{"--integrator", "pbgi"},
                           {"--microbuffer", "16"},
                           {"--buffer-map", "cosine"},
                           {"--preset", "paper"}}),
              IsEmpty());
  EXPECT_THAT(Ineffective({{"--integrator", "pt"},
                           {"--paths", "5"},
                           {"--spp", "4"},
                           {"--filter", "box"},
                           {"--filter-width", "1"}}),
              IsEmpty());
  EXPECT_THAT(
      Ineffective({{"--integrator", "irrcache"}, {"--cache-error", "0.1"}, {"--quality", "fine"}}),
      IsEmpty());
}

TEST(IneffectiveFlags, AreNamedWithTheModeInWhichTheyCount) {
  struct Case {
    GivenFlag flag;
    std::vector<GivenFlag> mode;
    const char *mode_text, *counts;
  };
  const std::vector<GivenFlag> pbgi = {{"--integrator", "pbgi"}}, pt = {{"--integrator", "pt"}},
                               cache = {{"--integrator", "irrcache"}};
  for (const Case& c : {
           Case{{"--cache-error", "0.1"}, {}, "--integrator fpbgi", "--integrator irrcache"},
           Case{{"--cache-samples", "99"}, {}, "--integrator fpbgi", "--integrator irrcache"},
           Case{{"--paths", "9"}, {}, "--integrator fpbgi", "--integrator pt"},
           Case{{"--fill", "rays"}, pbgi, "--integrator pbgi", "--integrator fpbgi"},
           Case{{"--clusters", "9"}, pbgi, "--integrator pbgi", "--integrator fpbgi"},
           Case{{"--epsilon", "0.1"}, pbgi, "--integrator pbgi", "--clusters N"},
           Case{{"--epsilon", "0.1"},
                {{"--clusters", "9"}, {"--fill", "rays"}},
                "filled by rays",
                "filled by cuts"},
           Case{{"--epsilon", "0.1"}, {{"--fill", "cut"}}, "adaptive clusters", "--clusters N"},
           Case{{"--microbuffer", "9"}, {}, "filled by rays", "--fill cut"},
           Case{{"--splat", "opaque"}, {}, "filled by rays", "--fill cut"},
           Case{{"--microbuffer", "9"},
                {{"--clusters", "9"}, {"--fill", "rays"}},
                "--clusters 9",
                "--fill cut"},
           Case{{"--quality", "fine"}, pt, "--integrator pt", "adaptive clusters"},
           Case{{"--quality", "fine"}, {{"--clusters", "9"}}, "--clusters 9", "adaptive clusters"},
           Case{{"--quality", "fine"},
                {{"--integrator", "irrcache"}, {"--cache-error", "1"}, {"--cache-samples", "9"}},
                "--cache-samples",
                "left to it"},
           Case{{"--points", "9"}, cache, "--integrator irrcache", "fpbgi, pbgi or dpbgi"},
           Case{{"--points", "9"}, pt, "--integrator pt", "fpbgi, pbgi or dpbgi"},
           Case{{"--preset", "paper"}, pt, "--integrator pt", "fpbgi, pbgi or dpbgi"},
           Case{{"--filter", "box"}, {}, "--spp 1", "--spp 2"},
       }) {
    std::vector<GivenFlag> given = c.mode;
    given.push_back(c.flag);
    EXPECT_THAT(Ineffective(given),
                ElementsAre(AllOf(StartsWith(c.flag.first + " has no effect with "),
                                  HasSubstr(c.mode_text), HasSubstr(c.counts))))
        << c.flag.first << " " << c.mode_text;
  }
}

}  // namespace
}  // namespace farpoint

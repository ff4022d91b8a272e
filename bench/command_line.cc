#include "bench/command_line.h"

#include <CLI/CLI.hpp>
#include <algorithm>
#include <array>
#include <charconv>
#include <cstdlib>
#include <string_view>

#include "absl/strings/str_join.h"
#include "bench/text.h"

namespace farpoint {

namespace {

// "1280x1000". Sizes are checked by ValidateFilm.
bool ParseResolution(std::string_view text, int& width, int& height) {
  const char* const end = text.data() + text.size();
  const auto [x, x_error] = std::from_chars(text.data(), end, width);
  if (x_error != std::errc() || x == end || *x != 'x') return false;
  const auto [y, y_error] = std::from_chars(x + 1, end, height);
  return y_error == std::errc() && y == end && width > 0 && height > 0;
}

// "1,0.5,2": three finite numbers.
bool ParseVec3(std::string_view text, Vec3d& out) {
  const char* at = text.data();
  const char* const end = at + text.size();
  for (int i = 0; i < 3; ++i) {
    const auto [next, error] = std::from_chars(at, end, out[i]);
    if (error != std::errc() || (i < 2 && (next == end || *next != ','))) return false;
    at = i < 2 ? next + 1 : next;
  }
  return at == end && IsFinite(out);
}

absl::StatusOr<AccuracySun> ParseSun(const std::string& text) {
  const size_t colon = text.find(':');
  Vec3d to_sun, irradiance;
  if (colon == std::string::npos || !ParseVec3(text.substr(0, colon), to_sun) ||
      !ParseVec3(text.substr(colon + 1), irradiance) || MaxAbs(to_sun) == 0) {
    return absl::InvalidArgumentError("--sun " + text + " is not x,y,z:r,g,b");
  }
  return AccuracySun{to_sun, Rgb(irradiance)};
}

absl::StatusOr<Rgb> ParseSky(const std::string& text) {
  Vec3d radiance;
  if (!ParseVec3(text, radiance)) {
    return absl::InvalidArgumentError("--sky " + text + " is not r,g,b");
  }
  return Rgb(radiance);
}

void AddCommonOptions(CLI::App& app, std::string& output_dir, bool& quick) {
  app.add_option("-o,--output", output_dir, "Folder of the results; made if it is not there")
      ->capture_default_str();
  app.add_flag("--quick", quick, "Small and few: a check that all works, not a measurement");
}

}  // namespace

absl::StatusOr<BenchCommandLine> ParseBenchCommandLine(std::vector<std::string> args) {
  BenchCommandLine line;
  line.output_dir = "out/bench";
  CLI::App app("Measures farpoint: docs/benchmarks.md explains what comes out.", "farpoint-bench");
  app.set_version_flag("--version", std::string("farpoint-bench ") + FARPOINT_VERSION);
  app.require_subcommand(1);

  ParetoOptions& p = line.pareto;
  std::string resolution;
  double noise = 0;
  CLI::App* pareto = app.add_subcommand(
      "pareto", "Time against error of all integrators; writes pareto.json and pareto.html");
  AddCommonOptions(*pareto, line.output_dir, p.quick);
  pareto->add_option("--scene", p.scene, "cornell, city, furnace or a glTF file")
      ->capture_default_str();
  CLI::Option* resolution_option =
      pareto->add_option("--resolution", resolution,
                         "WxH in pixels [the reference's; without one 256x256, quick: 64x64]");
  CLI::Option* reference =
      pareto->add_option("--reference", p.reference_path,
                         "EXR with the true irradiance at pixel centres [one is path-traced]");
  pareto->add_option("--ref-layer", p.ref_layer, "Its layer [irradiance, else R, G, B]")
      ->needs(reference);
  CLI::Option* noise_option =
      pareto->add_option("--noise", noise, "Its standard error over its mean [unknown, taken as 0]")
          ->needs(reference)
          ->check(CLI::Range(0.0, 10.0));
  pareto->add_option("--mask", p.mask_path, "EXR or .npy of the pixels that count [all that hit]");
  pareto
      ->add_option("--reference-paths", p.reference_paths,
                   "Paths per pixel of the traced reference, in two halves [8192, quick: 2048]")
      ->excludes(reference)
      ->check(CLI::Range(8u, 1u << 20));
  std::string pareto_sun, pareto_sky, eye, target;
  double fov_deg = 45;
  std::vector<std::string> curves;
  pareto->add_option("--sun", pareto_sun, "x,y,z:r,g,b, as of farpoint render");
  pareto->add_option("--sky", pareto_sky, "r,g,b, as of farpoint render");
  CLI::Option* eye_option = pareto->add_option("--eye", eye, "x,y,z: a free camera, +y up");
  CLI::Option* target_option =
      pareto->add_option("--target", target, "x,y,z that it looks at")->needs(eye_option);
  eye_option->needs(target_option);
  pareto->add_option("--fov", fov_deg, "Its vertical field of view, degrees")
      ->capture_default_str()
      ->needs(eye_option)
      ->check(CLI::Range(1.0, 170.0));
  pareto->add_option("--curves", curves, "Some of adaptive,k,pbgi,dpbgi,pt,irrcache [all]")
      ->delimiter(',');
  pareto->add_option("--points", p.points, "Surfels [by the scene, quick: 20000]")
      ->check(CLI::Range(uint64_t{1}, uint64_t{1} << 31));
  pareto->add_option("--light-samples", p.light_samples, "Shadow rays, as of farpoint render")
      ->capture_default_str()
      ->check(CLI::Range(1, 4096));
  pareto->add_option("--seed", p.seed, "Of every random choice")->capture_default_str();
  pareto->add_option("--repeat", p.repeat, "Renders of each configuration [3, quick: 1]")
      ->check(CLI::Range(1, 1000));
  pareto->add_option("--threads", p.threads, "0: all cores; 1 disturbs the times least")
      ->capture_default_str()
      ->check(CLI::Range(0, 1024));

  CLI::App* micro = app.add_subcommand("micro", "The kernels one by one; writes micro.json");
  AddCommonOptions(*micro, line.output_dir, line.micro.quick);
  micro->add_option("--filter", line.micro.filter, "Only names that match this regular expression");

  RebakeOptions& r = line.rebake;
  std::string sun, sky;
  CLI::App* rebake = app.add_subcommand(
      "rebake", "Bakes after a change of camera, light, material or object; writes rebake.json");
  AddCommonOptions(*rebake, line.output_dir, r.quick);
  rebake->add_option("--scene", r.scene, "cornell, city, furnace or a scene file")
      ->capture_default_str();
  rebake->add_option("--sun", sun, "x,y,z:r,g,b: a sun in place of the scene's punctual lights");
  rebake->add_option("--sky", sky, "r,g,b: a constant sky in place of the scene's");
  rebake->add_option("--points", r.points, "Surfels [by the scene, quick: 20000]")
      ->check(CLI::Range(uint64_t{1}, uint64_t{1} << 31));
  rebake->add_option("--light-samples", r.light_samples, "Shadow rays, as of farpoint render")
      ->capture_default_str()
      ->check(CLI::Range(1, 4096));
  rebake->add_option("--seed", r.seed, "Of every random choice")->capture_default_str();
  rebake->add_option("--object", r.object, "Index of the instance that moves [the last]");
  rebake->add_option("--repeat", r.repeat, "Bakes of each kind; the median counts")
      ->capture_default_str()
      ->check(CLI::Range(1, 1000));
  rebake->add_option("--threads", r.threads, "0: all cores")
      ->capture_default_str()
      ->check(CLI::Range(0, 1024));
  uint64_t cache_mib = r.cache_bytes >> 20;
  rebake->add_option("--cache-mib", cache_mib, "Limit of the cache")
      ->capture_default_str()
      ->check(CLI::Range(uint64_t{0}, uint64_t{1} << 24));

  LightsOptions& l = line.lights;
  CLI::App* lights = app.add_subcommand(
      "lights", "Direct light: time and error by number and kind of lights; writes lights.json");
  AddCommonOptions(*lights, line.output_dir, l.quick);
  lights->add_option("--light-samples", l.light_samples, "Shadow rays, as of farpoint render")
      ->capture_default_str()
      ->check(CLI::Range(1, 4096));
  lights->add_option("--receivers", l.receivers, "Points at which light is measured")
      ->capture_default_str()
      ->check(CLI::Range(1, 1'000'000));
  lights->add_option("--reference-samples", l.reference_samples, "Shadow rays of the reference")
      ->capture_default_str()
      ->check(CLI::Range(1u, 1u << 24));
  lights->add_option("--seed", l.seed, "Of every random choice")->capture_default_str();

  AccuracyOptions& a = line.accuracy;
  std::string quality(NameOf(a.quality)), fill(NameOf(a.fill));
  if (const char* scenes = std::getenv("FARPOINT_SCENES")) a.folders.scenes = scenes;
  CLI::App* accuracy = app.add_subcommand(
      "accuracy", "Error of the default image by scene; writes accuracy.json and accuracy.html");
  AddCommonOptions(*accuracy, line.output_dir, a.quick);
  accuracy->add_option("--case", a.cases, "Only this one; may be given more than once");
  accuracy->add_option(
      "--scenes", a.folders.scenes,
      "Folder of scenes of others [FARPOINT_SCENES; without one they are left out]");
  accuracy->add_option("--references", a.folders.references,
                       "Folder with cornell.gltf and its published reference");
  accuracy->add_option("--reference-dir", a.reference_dir,
                       "Folder that keeps traced references from run to run");
  accuracy->add_option("--reference-pixels", a.reference_pixels, "Pixels of a traced reference")
      ->capture_default_str()
      ->check(CLI::Range(size_t{16}, size_t{1} << 20));
  accuracy
      ->add_option("--reference-budget", a.reference_budget_s,
                   "Thread-seconds for each traced reference")
      ->capture_default_str()
      ->check(CLI::Range(0.0, 1e6));
  accuracy->add_option("--quality", quality, "draft, normal or fine")->capture_default_str();
  accuracy->add_option("--clusters", a.clusters, "k per block [0: adaptive]")
      ->check(CLI::Range(0, 1024));
  accuracy->add_option("--fill", fill, "auto, rays or cut")->capture_default_str();
  accuracy->add_option("--points", a.points, "Surfels [by the scene, quick: 20000]")
      ->check(CLI::Range(uint64_t{1}, uint64_t{1} << 31));
  accuracy->add_option("--light-samples", a.light_samples, "Shadow rays, as of farpoint render")
      ->capture_default_str()
      ->check(CLI::Range(1, 4096));
  accuracy->add_option("--seed", a.seed, "Of every random choice of the measured image")
      ->capture_default_str();
  accuracy->add_option("--threads", a.threads, "0: all cores")
      ->capture_default_str()
      ->check(CLI::Range(0, 1024));

  PaperOptions& w = line.paper;
  std::string paper_resolution;
  if (const char* scenes = std::getenv("FARPOINT_SCENES")) w.scenes_dir = scenes;
  CLI::App* paper = app.add_subcommand(
      "paper", "Table 1 and Figures 2, 4 and 5 of the paper; writes paper.json and paper.html");
  AddCommonOptions(*paper, line.output_dir, w.quick);
  paper->add_option("--scene", w.scene, "cornell, bunny, city or sponza [all that are there]");
  paper->add_option("--scenes", w.scenes_dir,
                    "Folder of scenes of others [FARPOINT_SCENES; without one they are left out]");
  CLI::Option* paper_resolution_option = paper->add_option(
      "--resolution", paper_resolution, "WxH in pixels [the paper's, quick: 96x96]");
  paper->add_option("--points", w.points, "Surfels [the paper's, quick: 4000]")
      ->check(CLI::Range(uint64_t{1}, uint64_t{1} << 31));
  CLI::Option* blocks =
      paper->add_option("--blocks", w.blocks, "Of 8x8 pixels, rendered by pbgi [256, quick: 8]")
          ->check(CLI::Range(2u, 1u << 20));
  paper->add_flag("--full", w.full, "pbgi and dpbgi of whole frames: hours")->excludes(blocks);
  paper
      ->add_option("--reference-budget", w.reference_budget_s,
                   "Thread-seconds for each path-traced reference [120, quick: 2]")
      ->check(CLI::Range(0.01, 1e6));
  std::string splat;
  CLI::Option* splat_option =
      paper->add_option("--splat", splat, "opaque or coverage, in place of the paper's [opaque]")
          ->check(CLI::IsMember({"opaque", "coverage"}));
  paper->add_option("--microbuffer", w.microbuffer, "Side of pbgi's and fpbgi's buffers [64]")
      ->check(CLI::Range(1, 256));
  paper->add_option("--light-samples", w.light_samples, "Shadow rays, as of farpoint render")
      ->capture_default_str()
      ->check(CLI::Range(1, 4096));
  paper->add_option("--seed", w.seed, "Of every random choice")->capture_default_str();
  paper->add_option("--threads", w.threads, "0: all cores")
      ->capture_default_str()
      ->check(CLI::Range(0, 1024));

  StabilityOptions& n = line.stability;
  if (const char* scenes = std::getenv("FARPOINT_SCENES")) n.scenes_dir = scenes;
  CLI::App* stability = app.add_subcommand(
      "stability",
      "Scenes that are moved, damaged or built to break a kernel; writes stability.json and "
      "stability.html; 42 if a figure is above its bar");
  AddCommonOptions(*stability, line.output_dir, n.quick);
  stability->add_option("--case", n.cases, "Only this one; may be given more than once");
  stability->add_option(
      "--scenes", n.scenes_dir,
      "Folder of scenes of others [FARPOINT_SCENES; without one Sponza is left out]");
  stability->add_option("--points", n.points, "Surfels [20000, quick: 2500]")
      ->check(CLI::Range(uint64_t{1}, uint64_t{1} << 31));
  stability->add_option("--light-samples", n.light_samples, "Shadow rays, as of farpoint render")
      ->capture_default_str()
      ->check(CLI::Range(1, 4096));
  stability->add_option("--seed", n.seed, "Of every random choice")->capture_default_str();
  stability->add_option("--threads", n.threads, "0: all cores")
      ->capture_default_str()
      ->check(CLI::Range(0, 1024));

  ScaleOptions& g = line.scale;
  std::string scale_resolution, scale_quality(NameOf(g.quality));
  if (const char* scenes = std::getenv("FARPOINT_SCENES")) g.scenes_dir = scenes;
  CLI::App* scale = app.add_subcommand(
      "scale", "Growth with pixels, surfels and threads; writes scale.json and scale.html");
  AddCommonOptions(*scale, line.output_dir, g.quick);
  scale->add_option("--scene", g.scene,
                    "cornell, bunny, city or sponza [sponza, city where it is not there]");
  scale->add_option("--scenes", g.scenes_dir, "Folder of scenes of others [FARPOINT_SCENES]");
  CLI::Option* scale_resolution_option = scale->add_option(
      "--resolution", scale_resolution,
      "WxH of the largest frame, multiples of 4; half and a quarter are rendered, too "
      "[1280x1000, quick: 64x64]");
  scale
      ->add_option("--points", g.points,
                   "The fewest surfels; 4 and 16 times as many are taken, too "
                   "[1000000, quick: 2000]")
      ->check(CLI::Range(uint64_t{1}, uint64_t{1} << 27));
  scale->add_option("--quality", scale_quality, "draft, normal or fine")->capture_default_str();
  scale->add_option("--clusters", g.clusters, "k per block [0: adaptive]")
      ->check(CLI::Range(0, 1024));
  scale->add_option("--light-samples", g.light_samples, "Shadow rays, as of farpoint render")
      ->capture_default_str()
      ->check(CLI::Range(1, 4096));
  scale->add_option("--seed", g.seed, "Of every random choice")->capture_default_str();
  scale->add_option("--repeat", g.repeat, "Renders of each frame [3, quick: 1]")
      ->check(CLI::Range(1, 1000));
  scale
      ->add_option("--reference-pixels", g.reference_pixels,
                   "Pixels of a traced reference [1500, quick: 16]")
      ->check(CLI::Range(size_t{16}, size_t{1} << 20));
  scale
      ->add_option("--reference-budget", g.reference_budget_s,
                   "Thread-seconds for each traced reference [60, quick: 0.5]")
      ->check(CLI::Range(0.01, 1e6));
  scale->add_option("--reference-dir", g.reference_dir,
                    "Folder that keeps traced references from run to run");
  scale->add_option("--threads", g.threads, "0: all cores; one is measured, too")
      ->capture_default_str()
      ->check(CLI::Range(0, 1024));

  SkipOptions& k = line.skip;
  if (const char* scenes = std::getenv("FARPOINT_SCENES")) k.scenes_dir = scenes;
  CLI::App* skip = app.add_subcommand(
      "skip",
      "What each item that is left out saves, and what asking costs; writes skip.json and "
      "skip.html; 42 if bits or an error are not as promised");
  AddCommonOptions(*skip, line.output_dir, k.quick);
  skip->add_option("--case", k.cases, "Only this one; may be given more than once");
  skip->add_option("--scenes", k.scenes_dir,
                   "Folder of scenes of others [FARPOINT_SCENES; without one Sponza is left out]");
  skip->add_option("--points", k.points, "Surfels [100000, quick: 3000]")
      ->check(CLI::Range(uint64_t{1}, uint64_t{1} << 31));
  skip->add_option("--light-samples", k.light_samples, "Shadow rays, as of farpoint render")
      ->capture_default_str()
      ->check(CLI::Range(1, 4096));
  skip->add_option("--seed", k.seed, "Of every random choice")->capture_default_str();
  skip->add_option("--repeat", k.repeat, "Rounds [7, quick: 1]")->check(CLI::Range(1, 1000));
  skip->add_option("--threads", k.threads, "0: all cores; 1 disturbs the times least")
      ->capture_default_str()
      ->check(CLI::Range(0, 1024));
  CLI::App* service =
      app.add_subcommand("service",
                         "Kills, cuts, lies and load on real processes; writes service.json and "
                         "service.html");
  AddCommonOptions(*service, line.output_dir, line.service.quick);
  service->add_option("--case", line.service.cases, "Some of the cases, may be repeated [all]");
  service->add_option("--seed", line.service.seed, "Of every random choice")->capture_default_str();
  service->add_option("--bin", line.service.bin_dir,
                      "Folder of farpoint-server, farpoint-worker and farpoint [this program's]");

  CLI::App* figures = app.add_subcommand(
      "figures",
      "The pictures of the manual, and the error and time of what they show; writes PNG files, "
      "figures.json and figures.md");
  AddCommonOptions(*figures, line.output_dir, line.figures.quick);
  figures->add_option("--side", line.figures.side_px, "Pixels of a frame's side")
      ->capture_default_str()
      ->check(CLI::IsMember({64, 128, 256, 512}));
  figures->add_option("--paths", line.figures.paths, "Of the reference, per pixel")
      ->capture_default_str()
      ->check(CLI::Range(16, 1 << 20));
  figures->add_option("--seed", line.figures.seed, "Of every random choice")->capture_default_str();
  figures->add_option("--threads", line.figures.threads, "0: all cores")
      ->capture_default_str()
      ->check(CLI::Range(0, 1024));

  AntialiasingOptions& aa = line.antialiasing;
  if (const char* scenes = std::getenv("FARPOINT_SCENES")) aa.folders.scenes = scenes;
  std::string aa_quality = "normal";
  CLI::App* antialiasing = app.add_subcommand(
      "antialiasing",
      "What more samples per pixel cost, their error, and pictures of edges; writes "
      "antialiasing.json and NAME-edges.png");
  AddCommonOptions(*antialiasing, line.output_dir, aa.quick);
  antialiasing->add_option("--case", aa.cases,
                           "A frame of the accuracy report, may be repeated [cornell, sponza-sun, "
                           "coffee, city]");
  antialiasing->add_option(
      "--scenes", aa.folders.scenes,
      "Folder of scenes of others [FARPOINT_SCENES; without one the own scenes only]");
  antialiasing
      ->add_option("--spp", aa.spp, "Samples per pixel, several [1,4,16,64, quick: 1,4]; 1 always")
      ->delimiter(',')
      ->check(CLI::Range(1, 256));
  antialiasing->add_option("--scale", aa.scale, "Of the frames' width and height")
      ->capture_default_str()
      ->check(CLI::Range(0.01, 4.0));
  antialiasing->add_option("--quality", aa_quality, "draft, normal or fine")->capture_default_str();
  antialiasing->add_option("--points", aa.points, "Surfels [by the scene, quick: 20000]")
      ->check(CLI::Range(uint64_t{1}, uint64_t{1} << 31));
  antialiasing
      ->add_option("--light-samples", aa.light_samples, "Shadow rays, as of farpoint render")
      ->capture_default_str()
      ->check(CLI::Range(1, 4096));
  antialiasing->add_option("--seed", aa.seed, "Of every random choice")->capture_default_str();
  antialiasing->add_option("--reference-pixels", aa.reference_pixels, "Pixels of the truth, about")
      ->capture_default_str()
      ->check(CLI::Range(size_t{16}, size_t{1} << 20));
  antialiasing->add_option("--paths", aa.paths, "Of the truth, per pixel")
      ->capture_default_str()
      ->check(CLI::Range(16u, 1u << 20));
  antialiasing->add_option("--repeat", aa.repeat, "Rounds")
      ->capture_default_str()
      ->check(CLI::Range(1, 1000));
  antialiasing->add_flag("--occlusion", aa.occlusion,
                         "Ambient occlusion, too: its error and cost, with light and alone");
  antialiasing->add_flag("!--no-pictures", aa.pictures, "Tables only");
  antialiasing->add_option("--threads", aa.threads, "0: all cores")
      ->capture_default_str()
      ->check(CLI::Range(0, 1024));

  // CLI11 takes the arguments from the back.
  std::reverse(args.begin(), args.end());
  try {
    app.parse(args);
  } catch (const CLI::CallForHelp&) {
    const CLI::App* asked = pareto->parsed()         ? pareto
                            : micro->parsed()        ? micro
                            : rebake->parsed()       ? rebake
                            : lights->parsed()       ? lights
                            : paper->parsed()        ? paper
                            : stability->parsed()    ? stability
                            : scale->parsed()        ? scale
                            : skip->parsed()         ? skip
                            : service->parsed()      ? service
                            : figures->parsed()      ? figures
                            : antialiasing->parsed() ? antialiasing
                                                     : &app;
    line.print = asked->help(asked == &app ? "" : "farpoint-bench");
    return line;
  } catch (const CLI::CallForVersion& version) {
    line.print = std::string(version.what()) + "\n";
    return line;
  } catch (const CLI::ParseError& error) {
    return absl::InvalidArgumentError(std::string(error.what()) + "; see farpoint-bench --help");
  }
  line.verb = pareto->parsed()         ? BenchVerb::kPareto
              : rebake->parsed()       ? BenchVerb::kRebake
              : lights->parsed()       ? BenchVerb::kLights
              : accuracy->parsed()     ? BenchVerb::kAccuracy
              : paper->parsed()        ? BenchVerb::kPaper
              : stability->parsed()    ? BenchVerb::kStability
              : scale->parsed()        ? BenchVerb::kScale
              : skip->parsed()         ? BenchVerb::kSkip
              : service->parsed()      ? BenchVerb::kService
              : figures->parsed()      ? BenchVerb::kFigures
              : antialiasing->parsed() ? BenchVerb::kAntialiasing
                                       : BenchVerb::kMicro;
  const absl::StatusOr<Quality> asked_quality = QualityFromName(quality);
  if (!asked_quality.ok()) return Annotate(asked_quality.status(), "--quality");
  a.quality = *asked_quality;
  const absl::StatusOr<Quality> aa_asked = QualityFromName(aa_quality);
  if (!aa_asked.ok()) return Annotate(aa_asked.status(), "--quality");
  aa.quality = *aa_asked;
  const absl::StatusOr<Quality> scale_asked = QualityFromName(scale_quality);
  if (!scale_asked.ok()) return Annotate(scale_asked.status(), "--quality");
  g.quality = *scale_asked;
  const absl::StatusOr<Fill> asked_fill = FillFromName(fill);
  if (!asked_fill.ok()) return Annotate(asked_fill.status(), "--fill");
  a.fill = *asked_fill;
  const std::vector<std::string> known_cases = AccuracyNames(a.quick);
  for (const std::string& name : a.cases) {
    if (std::find(known_cases.begin(), known_cases.end(), name) == known_cases.end()) {
      return absl::InvalidArgumentError(
          Concat({"--case ", name, " is none of ", absl::StrJoin(known_cases, ", "),
                  a.quick ? " (those of --quick)" : ""}));
    }
  }
  if (!w.scene.empty()) FP_RETURN_IF_ERROR(FindPaperScene(w.scene).status());
  if (!g.scene.empty()) FP_RETURN_IF_ERROR(FindPaperScene(g.scene).status());
  r.cache_bytes = cache_mib << 20;
  if (!sun.empty()) {
    FP_ASSIGN_OR_RETURN(r.changes.sun, ParseSun(sun));
  }
  if (!sky.empty()) {
    FP_ASSIGN_OR_RETURN(r.changes.sky, ParseSky(sky));
  }
  if (!pareto_sun.empty()) {
    FP_ASSIGN_OR_RETURN(p.changes.sun, ParseSun(pareto_sun));
  }
  if (!pareto_sky.empty()) {
    FP_ASSIGN_OR_RETURN(p.changes.sky, ParseSky(pareto_sky));
  }
  if (!eye.empty()) {
    AccuracyView view;
    view.yfov_deg = fov_deg;
    if (!ParseVec3(eye, view.eye)) {
      return absl::InvalidArgumentError("--eye " + eye + " is not x,y,z");
    }
    if (!ParseVec3(target, view.target)) {
      return absl::InvalidArgumentError("--target " + target + " is not x,y,z");
    }
    p.changes.view = view;
  }
  for (const std::string& curve : curves) {
    const absl::StatusOr<ParetoCurve> parsed = ParetoCurveFromName(curve);
    if (!parsed.ok()) return Annotate(parsed.status(), "--curves");
    p.curves.push_back(*parsed);
  }
  if (resolution_option->count() > 0 && !ParseResolution(resolution, p.width, p.height)) {
    return absl::InvalidArgumentError("--resolution " + resolution +
                                      " is not WIDTHxHEIGHT in pixels, such as 640x480");
  }
  if (splat_option->count() > 0) {
    w.splat = splat == "coverage" ? Splat::kCoverage : Splat::kOpaque;
  }
  if (paper_resolution_option->count() > 0 &&
      !ParseResolution(paper_resolution, w.width, w.height)) {
    return absl::InvalidArgumentError("--resolution " + paper_resolution +
                                      " is not WIDTHxHEIGHT in pixels, such as 640x480");
  }
  if (scale_resolution_option->count() > 0 &&
      !ParseResolution(scale_resolution, g.width, g.height)) {
    return absl::InvalidArgumentError("--resolution " + scale_resolution +
                                      " is not WIDTHxHEIGHT in pixels, such as 640x480");
  }
  if (noise_option->count() > 0) p.noise = noise;
  const std::vector<std::string> known_stability = StabilityNames();
  for (const std::string& name : n.cases) {
    if (std::find(known_stability.begin(), known_stability.end(), name) == known_stability.end()) {
      return absl::InvalidArgumentError(
          Concat({"--case ", name, " is none of ", absl::StrJoin(known_stability, ", ")}));
    }
  }
  const std::vector<std::string> known_skips = SkipNames();
  for (const std::string& name : k.cases) {
    if (std::find(known_skips.begin(), known_skips.end(), name) == known_skips.end()) {
      return absl::InvalidArgumentError(
          Concat({"--case ", name, " is none of ", absl::StrJoin(known_skips, ", ")}));
    }
  }
  for (const std::string& name : line.service.cases) {
    if (std::find(kServiceNames.begin(), kServiceNames.end(), name) == kServiceNames.end()) {
      return absl::InvalidArgumentError(
          Concat({"--case ", name, " is none of ", absl::StrJoin(ServiceNames(), ", ")}));
    }
  }
  if (line.output_dir.empty()) return absl::InvalidArgumentError("-o needs the name of a folder");
  return line;
}

}  // namespace farpoint

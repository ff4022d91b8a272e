#include "bench/accuracy_scenes.h"

#include <filesystem>
#include <utility>

#include "absl/strings/str_format.h"
#include "bench/text.h"

namespace farpoint {

namespace {

std::string TripleText(double x, double y, double z) {
  return absl::StrFormat("%g,%g,%g", x, y, z);
}
// Decimal as it was meant: 0.1f is 0.10000000149.
std::string RgbText(const Rgb& c) { return absl::StrFormat("%g,%g,%g", c.x, c.y, c.z); }

bool IsOwn(const std::string& scene) { return scene.find('.') == std::string::npos; }

AccuracyCase Sponza(const char* name, int width, int height, bool sky, double bar) {
  AccuracyCase c;
  c.name = name;
  c.scene = "sponza/Sponza.gltf";
  c.width = width;
  c.height = height;
  c.sun = AccuracySun{{0.3, 1, 0.1}, Rgb(10, 10, 10)};
  if (sky) c.sky = Rgb(0.5f, 0.6f, 0.8f);
  c.view = AccuracyView{{9, 0.8, -0.3}, {-8, 4, -0.3}, 57};
  c.rr_bar = bar;
  c.rr_aim = 0.04;
  c.bias_bar = 0.015;
  return c;
}

AccuracyCase Plain(const char* name, const char* scene, double rr_bar, double bias_bar) {
  AccuracyCase c;
  c.name = name;
  c.scene = scene;
  c.rr_bar = rr_bar;
  c.bias_bar = bias_bar;
  return c;
}

}  // namespace

std::vector<AccuracyCase> AccuracyCases(bool quick) {
  std::vector<AccuracyCase> cases;
  if (quick) {
    cases = {Plain("cornell", "cornell", 0.2, 0.05), Plain("city", "city", 0.3, 0.1),
             Plain("furnace", "furnace", 0.05, 0.02)};
    for (AccuracyCase& c : cases) {
      c.width = 64;
      c.height = 48;
    }
    cases.back().truth = TruthKind::kFurnace;
    return cases;
  }
  AccuracyCase cornell = Plain("cornell", "cornell.gltf", 0.025, 0.005);
  cornell.truth = TruthKind::kPublished;
  cornell.width = cornell.height = 256;
  cornell.rr_aim = 0.015;
  cases.push_back(cornell);
  cases.push_back(Sponza("sponza-sun", 640, 500, false, 0.08));
  cases.push_back(Sponza("sponza-sun-1280", 1280, 1000, false, 0.06));
  cases.push_back(Sponza("sponza-sky", 640, 500, true, 0.08));
  cases.push_back(Sponza("sponza-sky-1280", 1280, 1000, true, 0.06));
  AccuracyCase dabrovic = Plain("dabrovic", "dabrovic_sponza/dabrovic_sponza.gltf", 0.07, 0.015);
  dabrovic.sun = AccuracySun{{0.2, 1, 0.3}, Rgb(10, 10, 9)};
  cases.push_back(dabrovic);
  cases.push_back(Plain("kitchen", "lux_kitchen/lux_kitchen.gltf", 0.06, 0.015));
  cases.push_back(Plain("coffee", "coffee/coffee.gltf", 0.06, 0.015));
  AccuracyCase macross = Plain("macross", "macross_city/macross_city.gltf", 0.06, 0.015);
  macross.sun = AccuracySun{{0.5, 1, 0.4}, Rgb(8, 8, 7)};
  macross.sky = Rgb(0.4f, 0.5f, 0.7f);
  // Along the street towards the houses, figures near and far.
  macross.view = AccuracyView{{2.4, 0.5, 2.6}, {0, -0.25, -0.2}, 40};
  cases.push_back(macross);
  cases.push_back(Plain("city", "city", 0.05, 0.01));
  cases.push_back(Plain("furnace", "furnace", 0.01, 0.003));
  cases.back().truth = TruthKind::kFurnace;
  return cases;
}

absl::StatusOr<AccuracyCase> FindAccuracyCase(std::string_view name, bool quick) {
  std::string known;
  for (AccuracyCase& c : AccuracyCases(quick)) {
    if (c.name == name) return std::move(c);
    Append(known, {known.empty() ? "" : ", ", c.name});
  }
  return absl::InvalidArgumentError(
      Concat({"--case ", name, " is none of ", known, quick ? " (those of --quick)" : ""}));
}

std::string CommandOf(const AccuracyCase& c) {
  std::string text = Concat({c.scene, absl::StrFormat(" --resolution %dx%d", c.width, c.height)});
  if (c.view) {
    const AccuracyView& v = *c.view;
    Append(text, {" --eye ", TripleText(v.eye.x, v.eye.y, v.eye.z), " --target ",
                  TripleText(v.target.x, v.target.y, v.target.z),
                  absl::StrFormat(" --fov %g", v.yfov_deg)});
  }
  if (c.sun) {
    Append(text, {" --sun ", TripleText(c.sun->to_sun.x, c.sun->to_sun.y, c.sun->to_sun.z), ":",
                  RgbText(c.sun->irradiance)});
  }
  if (c.sky) Append(text, {" --sky ", RgbText(*c.sky)});
  return text;
}

absl::StatusOr<std::optional<AccuracyScene>> LoadAccuracyScene(const AccuracyCase& c,
                                                               const AccuracyFolders& folders,
                                                               bool quick, std::string& missing) {
  std::string source = c.scene;
  if (!IsOwn(c.scene)) {
    const bool published = c.truth == TruthKind::kPublished;
    const std::string& folder = published ? folders.references : folders.scenes;
    if (folder.empty()) {
      missing = Concat({c.scene, ": no folder of ", published ? "references" : "scenes", ", give ",
                        published ? "--references" : "--scenes"});
      return std::nullopt;
    }
    source = (std::filesystem::path(folder) / c.scene).string();
    std::error_code error;
    if (!std::filesystem::exists(source, error)) {
      missing = source + " is not there";
      return std::nullopt;
    }
  }
  FP_ASSIGN_OR_RETURN(BenchScene made,
                      MakeBenchScene(source, quick, {.sun = c.sun, .sky = c.sky, .view = c.view}));
  AccuracyScene loaded{std::move(made.scene), {}, std::move(made.notes)};
  loaded.camera = loaded.scene.cameras.front();
  return std::optional<AccuracyScene>(std::move(loaded));
}

}  // namespace farpoint

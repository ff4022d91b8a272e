// The frames whose error is held to a bar: scene, light, camera, size, bars.
#pragma once

#include <optional>
#include <string>
#include <string_view>
#include <vector>

#include "bench/bench_scene.h"
#include "core/base/status.h"
#include "core/scene/scene.h"

namespace farpoint {

// Where the truth comes from.
enum class TruthKind {
  kTraced,     // by pt, at some of the pixels
  kPublished,  // an EXR and a mask beside the scene file, whole frame
  kFurnace,    // closed form: direct irradiance pi L, indirect pi rho L
};

struct AccuracyCase {
  std::string name;
  // An own scene ("cornell", "city", "furnace"), or the path of a file within the folder of scenes
  // or, for kPublished, within that of references.
  std::string scene;
  TruthKind truth = TruthKind::kTraced;
  int width = 640, height = 500;
  std::optional<AccuracySun> sun;    // in place of the scene's punctual lights
  std::optional<Rgb> sky;            // in place of the scene's constant sky, W/(m² sr)
  std::optional<AccuracyView> view;  // none: the scene's first camera
  // Of indirect irradiance: rr and |bias| may not be larger. aim: what is hoped for; 0: no more
  // than the bar.
  double rr_bar = 0, rr_aim = 0, bias_bar = 0;
};

// All cases, in the order of the report. `quick`: the own scenes only, at 64x48 pixels, with bars
// that a tiny run is not expected to hold.
std::vector<AccuracyCase> AccuracyCases(bool quick);
// kInvalidArgument lists the known names.
absl::StatusOr<AccuracyCase> FindAccuracyCase(std::string_view name, bool quick);

// The flags of `farpoint render` that make the same frame.
std::string CommandOf(const AccuracyCase& c);

struct AccuracyFolders {
  std::string scenes;      // of others; empty: none
  std::string references;  // with cornell.gltf and what is published for it; empty: none
};

struct AccuracyScene {
  Scene scene;  // with the case's lights
  Camera camera;
  std::vector<std::string> notes;  // of the importer
};
// Nothing if the folder was not given or has no such file: `missing` then says which. Errors are
// those of the importer.
absl::StatusOr<std::optional<AccuracyScene>> LoadAccuracyScene(const AccuracyCase& c,
                                                               const AccuracyFolders& folders,
                                                               bool quick, std::string& missing);

}  // namespace farpoint

// The four scenes of Wang et al. 2013, Table 1, and what the table says of them.
#pragma once

#include <cstdint>
#include <optional>
#include <span>
#include <string>
#include <string_view>
#include <vector>

#include "core/base/status.h"
#include "core/scene/scene.h"

namespace farpoint {

// Table 1. Seconds are by the clock, on eight cores of an Intel i7 at 2.67 GHz.
struct PublishedRow {
  double points = 0;
  double cluster_s = 0;
  double cut_pbgi_s = 0, cut_fpbgi_s = 0;
  double raster_pbgi_s = 0, raster_fpbgi_s = 0;
  double total_pbgi_s = 0, total_fpbgi_s = 0;
  int64_t pdp = 0;
  double mse = 0;
};

struct PaperScene {
  std::string_view name;   // of --scene
  std::string_view title;  // as in the table
  std::string_view what;   // what stands for it here, one sentence
  std::string_view file;   // within the folder of scenes; empty: made by code
  int width = 0, height = 0;
  uint64_t points = 0;
  PublishedRow published;
};

// In the order of the table.
std::span<const PaperScene> PaperScenes();
// kInvalidArgument lists the known names.
absl::StatusOr<const PaperScene*> FindPaperScene(std::string_view name);

struct PaperView {
  Scene scene;
  Camera camera;
  std::vector<std::string> notes;  // of the importer
};
// Nothing if it is a file and `scenes_dir` is empty or has no such file: `missing` then says which.
// `quick`: the small city. Errors are those of the importer.
absl::StatusOr<std::optional<PaperView>> LoadPaperScene(const PaperScene& scene,
                                                        const std::string& scenes_dir, bool quick,
                                                        std::string& missing);

}  // namespace farpoint

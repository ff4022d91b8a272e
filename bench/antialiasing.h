// What more samples per pixel cost, and what they look like: docs/accuracy.md, "Anti-aliasing".
#pragma once

#include <cstdint>
#include <functional>
#include <string>
#include <string_view>
#include <vector>

#include "bench/accuracy.h"
#include "bench/accuracy_pictures.h"
#include "core/base/status.h"

namespace farpoint {

struct AntialiasingOptions {
  std::vector<std::string> cases;  // of the accuracy report; empty: AntialiasingNames
  AccuracyFolders folders;
  std::vector<uint32_t> spp;  // each 1..256; empty: 1, 4, 16, 64 (quick: 1, 4). 1 is always first
  double scale = 1;           // of the cases' width and height, (0, 4]
  Quality quality = Quality::kNormal;
  uint64_t points = 0;
  uint32_t light_samples = 32;
  uint64_t seed = 0;
  size_t reference_pixels = 4000;  // about
  uint32_t paths = 8192;           // of the truth, per pixel
  bool occlusion = false;          // the layer ambient_occlusion, too
  uint32_t repeat = 1;             // rounds; in each all numbers of samples take their turn
  unsigned threads = 0;
  bool quick = false;  // own scenes, 64x48, few paths: that all works, not how well
  bool pictures = true;
};

// One number of samples of one scene.
struct AntialiasingRow {
  uint32_t spp = 1;
  uint64_t receivers = 0;
  uint64_t records = 0;         // of the hierarchy
  uint64_t sample_records = 0;  // made for samples that those do not serve
  uint64_t gather_rays = 0;
  // Thread-seconds, medians of the rounds: of all that is neither primary rays nor direct light; of
  // the rays of records within it; of direct light; of primary rays.
  double gather_s = 0, trace_s = 0, direct_s = 0, primary_s = 0;
  double ratio = 1;  // gather_s over that of one sample, median of the rounds
  // Of the indirect irradiance, against the truth at the same samples: over all pixels, and over
  // those that show an edge (relative to the same mean).
  ErrorFigures all, edges;
  // With options.occlusion: of ambient occlusion against rays, as the records for light carry it
  // and as it comes alone; gather seconds with it over those without, and of it alone over those
  // without it, medians of the rounds.
  ErrorFigures carried, alone;
  double carried_ratio = 0, alone_ratio = 0;
};

struct AntialiasingScene {
  std::string name, command;
  int width = 0, height = 0;
  uint64_t surfels = 0;
  std::vector<AntialiasingRow> rows;
};

struct AntialiasingReport {
  AntialiasingOptions options;
  std::string date_utc, cpu;
  unsigned threads = 0;
  double load_average_start = 0, load_average_end = 0;
  std::vector<AntialiasingScene> scenes;
  std::vector<LeftOut> left_out;
  std::vector<std::string> files;  // pictures, names without folder
};

// The cases that are taken where none is named.
std::vector<std::string> AntialiasingNames(bool quick);

// Bakes each case once, renders it by fpbgi with each number of samples, compares, and writes for
// each case NAME-edges.png into `folder`, which exists: the part of the frame with most edges, each
// pixel three times as wide and high, of 1, 4 and 16 samples (or what is asked for of them) and of
// path tracing with 16, from left to right. kInvalidArgument: an unknown case, settings that do not
// fit.
absl::StatusOr<AntialiasingReport> RunAntialiasing(
    const AntialiasingOptions& options, const std::string& folder,
    const std::function<void(std::string_view)>& progress);

std::string AntialiasingTable(const AntialiasingReport& report);
std::string AntialiasingJson(const AntialiasingReport& report);

}  // namespace farpoint

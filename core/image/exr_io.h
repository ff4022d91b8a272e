// OpenEXR files and PNG previews. The only includes of OpenEXR and of the PNG writer are in the
// .cc files.
#pragma once

#include <map>
#include <string>
#include <vector>

#include "core/base/status.h"
#include "core/image/film.h"

namespace farpoint {

struct ExrMetadata {
  std::map<std::string, std::string> strings;       // e.g. "farpoint:version"
  std::map<std::string, std::array<float, 16>> matrices;  // row-major: worldToCamera, worldToNDC
};

enum class ExrCompression { kNone, kZip, kPiz };

// displayWindow: the whole frame; dataWindow: the film's rectangle (inclusive). Channels as in
// layers.h, Rec. 709 chromaticities, ZIP scanlines unless told. Written to `path`.part, flushed,
// renamed.
absl::Status WriteExr(const std::string& path, const Film& film, int frame_width, int frame_height,
                      const ExrMetadata& metadata, ExrCompression compression);

// One channel of a file, in float.
struct ExrChannel {
  std::string name;
  bool half = false;
  std::vector<float> values;  // height x width of the dataWindow
};
struct ExrImage {
  PixelRect data_window;  // half-open
  int frame_width = 0, frame_height = 0;
  std::vector<ExrChannel> channels;
  ExrMetadata metadata;
  const ExrChannel* Find(const std::string& name) const;
};
// Any scanline or tiled single-part file. kInvalidArgument, kNotFound or kDataLoss name the file.
absl::StatusOr<ExrImage> ReadExr(const std::string& path);

// The film that a file of ours holds: every known layer whose channels are all there.
absl::StatusOr<Film> FilmFromExr(const ExrImage& image);

// 8-bit sRGB of the beauty, each value times 2^exposure_stops, clamped to [0, 1].
absl::Status WritePngPreview(const std::string& path, const Film& film, float exposure_stops);

}  // namespace farpoint

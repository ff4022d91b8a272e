// OpenEXR files and PNG previews. The only includes of OpenEXR and of the PNG writer are in the
// .cc files.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <map>
#include <optional>
#include <span>
#include <string>
#include <string_view>
#include <vector>

#include "core/base/status.h"
#include "core/image/film.h"
#include "core/math/vec.h"

namespace farpoint {

struct ExrMetadata {
  std::map<std::string, std::string> strings;  // e.g. "farpoint:version"
  // worldToCamera, worldToNDC: row-major, as the file stores them. OpenEXR multiplies row vectors
  // from the left (p_camera = p_world * M), so the translation stands in elements 12 to 14.
  std::map<std::string, std::array<float, 16>> matrices;
  std::map<std::string, int32_t> ints;
  // framesPerSecond, the rate at which a sequence is played; stored as a fraction. The rates of
  // film and television get their exact one: 23.976 is 24000/1001.
  std::optional<double> frames_per_second;
};

// As OpenEXR names them; zip is the usual choice, zips decodes single lines faster, piz is smaller
// on noise. dwaa is lossy: half R, G, B are quantised at the library's default level, about a tenth
// of zip's size; the other channels stay exact.
enum class ExrCompression { kNone, kRle, kZips, kZip, kPiz, kDwaa };
bool IsLossless(ExrCompression compression);
std::string_view NameOf(ExrCompression compression);
// kInvalidArgument lists the known names.
absl::StatusOr<ExrCompression> ExrCompressionFromName(std::string_view name);

// displayWindow: the whole frame; dataWindow: the film's rectangle (inclusive). Channels as in
// layers.h, Rec. 709 chromaticities, scanlines from the top down. Halves and floats are stored as
// Film::RoundToStorage() leaves them, bit by bit unless the compression is lossy. Equal arguments
// give equal bytes. Written to `path`.part, flushed, renamed. kInvalidArgument for a film that
// leaves the frame or has no layer.
absl::Status WriteExr(const std::string& path, const Film& film, int frame_width, int frame_height,
                      const ExrMetadata& metadata, ExrCompression compression);

// One channel of a file, in float.
struct ExrChannel {
  std::string name;
  bool half = false;
  std::vector<float> values;  // height x width of the dataWindow
};
struct ExrImage {
  PixelRect data_window;  // half-open; (0, 0) is the upper left pixel of the displayWindow
  int frame_width = 0, frame_height = 0;
  std::vector<ExrChannel> channels;
  ExrMetadata metadata;
  // By the full name ("irradiance.R"); null if the file has no such channel.
  const ExrChannel* Find(const std::string& name) const;
};
// Any scanline or tiled single-part file without subsampled channels. Damaged and incomplete files
// are refused as a whole. kInvalidArgument, kNotFound, kDataLoss or kResourceExhausted name the
// file and the cause. Thread-safe.
absl::StatusOr<ExrImage> ReadExr(const std::string& path);
// The same from bytes; `name` is for messages.
absl::StatusOr<ExrImage> ReadExr(std::span<const std::byte> bytes, const std::string& name);

// The colours of a file, whatever its windows.
struct ExrRgbImage {
  uint32_t width = 0, height = 0;  // of the dataWindow
  std::vector<Rgb> pixels;         // rows from the top, as in the file: of any sign, maybe NaN
  bool cube_map = false;           // the attribute `envmap` says so
};
// R, G and B, half or float, converted to Rec. 709 if the file names other primaries (its white
// stays white), or Y alone. The size is checked against `max_pixels` before anything is allocated.
// kInvalidArgument, kDataLoss or kResourceExhausted name the file and the cause. Thread-safe.
absl::StatusOr<ExrRgbImage> ReadExrRgb(std::span<const std::byte> bytes, const std::string& name,
                                       int64_t max_pixels);

// The film that a file of ours holds: every known layer whose channels are all there.
// kInvalidArgument if there is none, or if a channel is stored in another precision than ours.
// ImageHash(FilmFromExr(ReadExr(f))) is the hash of the film that was written to f.
absl::StatusOr<Film> FilmFromExr(const ExrImage& image);

// 8-bit sRGB of the beauty, each value times 2^exposure_stops, clamped to [0, 1].
absl::Status WritePngPreview(const std::string& path, const Film& film, float exposure_stops);

}  // namespace farpoint

// How far an image is from a reference: what `farpoint compare` reports.
#pragma once

#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include "core/base/status.h"
#include "core/image/exr_io.h"
#include "core/image/tile_rect.h"

namespace farpoint {

// Which pixels count.
struct PixelMask {
  PixelRect rect;           // in frame coordinates
  std::vector<uint8_t> on;  // height x width of rect, 0 or 1
  // Of the frame that it was made for; 0: any that holds rect.
  int frame_width = 0, frame_height = 0;
};
// A .npy array (height x width; see npy_io.h) or the first channel of an EXR: on where the value is
// above 0.5. An array's first pixel is the frame's, its size the frame's. Told apart by the file's
// first bytes.
absl::StatusOr<PixelMask> ReadMask(const std::string& path);

struct CompareOptions {
  // A layer of layers.h, or any prefix of the file's channels ("x" means "x.*"), or one channel.
  // Empty: R, G and B.
  std::string layer;
  // The same in the reference. Empty: `layer`; if the reference does not have that, R, G and B.
  std::string ref_layer;
  // Must be of the images' frame and cover the compared rectangle, or have that rectangle's size,
  // or that of the reference's data window.
  std::optional<PixelMask> mask;
  // The reference's own relative RMSE: standard error over mean.
  double noise = 0.0;
  // What errors call the two.
  std::string image_name = "the image", ref_name = "the reference";
  // `pdp` and `flip` take seconds per megapixel.
  bool perceptual = true;
};

// Sums run in double, in raster order per channel. The means run over the counted pixels and all
// channels. Values that are not finite in either image (the depth of a background) are left out.
struct CompareResult {
  PixelRect rect;        // what was compared: the common part of the data windows
  int64_t pixels = 0;    // counted pixels, >= 1
  int64_t left_out = 0;  // of those, pixels with a value that is not finite
  double mean = 0;       // of the image
  double ref_mean = 0;   // of the reference
  double mse = 0;        // mean((a - b)^2)
  double max_abs = 0;    // max |a - b|
  // Relative to the reference's mean; none if that is not positive and the images differ.
  std::optional<double> rel_rmse;  // sqrt(mse) / mean(b)
  std::optional<double> rr;        // sqrt(max(0, rel_rmse^2 - noise^2))
  double noise = 0;                // CompareOptions::noise
  // rel_rmse is below the noise: rr is 0 and says nothing, or the noise is overstated.
  bool noise_above_error = false;
  std::optional<double> bias;  // mean(a - b) / mean(b)
  // Counted pixels that differ perceptibly (yee_metric.h). Both images are divided by the 99th
  // percentile of the reference's luminance over the counted pixels and clamped to [0, 1]; the
  // frame's width spans 45 degrees. None unless asked for.
  std::optional<int64_t> pdp;
  // Mean HDR-FLIP over the counted pixels (flip_metric.h), exposures from the reference's counted
  // pixels. None unless asked for.
  std::optional<double> flip;
  // Without a layer: whether both images are farpoint's and their image hashes over the common
  // rectangle are the same; with one: whether its stored values are the same, bit by bit. For files
  // that are not farpoint's: whether the compared channels are the same, bit by bit. The mask does
  // not enter.
  bool hash_equal = false;
  // Image or layer hashes over the common rectangle, 64 hex digits; empty for files not farpoint's.
  std::string hash_a, hash_b;
};

// kInvalidArgument: unknown layers (the message names the image and the layers that it has), frames
// or masks of other sizes, nothing in common, nothing counted or nothing finite.
absl::StatusOr<CompareResult> CompareImages(const ExrImage& a, const ExrImage& b,
                                            const CompareOptions& options);

// Absolute difference, largest channel, in false colour: black at 0, over purple, red and yellow,
// to white at `full_scale`; dark green where the mask is off. full_scale 0: the 99.9th percentile
// of the difference.
absl::Status WriteDiffPng(const std::string& path, const ExrImage& a, const ExrImage& b,
                          const CompareOptions& options, double full_scale);

}  // namespace farpoint

// What a mean error does not show: seams, leaks and flicker, each as figures with bars.
#pragma once

#include <functional>
#include <string_view>

#include "bench/accuracy.h"
#include "core/base/executor.h"
#include "core/image/film.h"
#include "core/render/bake_cache.h"

namespace farpoint {

// What a check runs with. All must outlive the call.
struct AccuracyContext {
  const AccuracyOptions& options;
  Executor& executor;
  BakeCache& cache;
  const std::function<void(std::string_view)>& progress;
};

// --- Seams ---

// Pairs of neighbouring pixels, in x and in y.
struct PixelPair {
  int x = 0, y = 0;       // the right or lower one
  bool vertical = false;  // the other is above, else to the left
  bool operator==(const PixelPair&) const = default;
};

// Both pixels and the next one on either side lie on one smooth surface (normals within 2.5
// degrees, each on the others' tangent plane within a twentieth of their distance, depth within
// 10 %) and all four have irradiance. Needs the layers kNormal, kPosition, kDepth, kIrradiance.
// The jump of such a pair, as part of the local value: |E1 - E0 - the mean of the steps beside|, by
// luminance. A smooth image has next to none, whatever its gradient.
std::vector<PixelPair> SmoothPairs(const Film& film);
double JumpOf(const Film& film, const PixelPair& pair);

// Jumps across the multiples of `period_px`, and across the lines 3, 4 and 5 pixels to either side
// of each of those pairs, so that both see the same surfaces. Pairs without a smooth one beside
// them do not count. The standard error is that of the means of runs of 32 pairs along a border, as
// pairs within a run are not independent.
struct JumpFigures {
  size_t pairs = 0;
  double jump = 0, jump_beside = 0;  // means
  double excess_error = 0;           // standard error of jump - jump_beside
};
JumpFigures GridJumps(const Film& film, std::span<const PixelPair> pairs, int period_px);

// "seams-cornell" (the box, 256x256) or "seams-sponza" (its floor and walls, 640x500, sun):
// - jumps across the borders of 8 (groups of pixels that are blended together), 32 (blocks) and
//   128 pixels (tiles) over those beside them, whole frame;
// - |step - pt's step| across borders of clusters over that elsewhere, as parts of the true local
//   value (at least a twentieth of the mean), means over pairs. pt's noise is in both.
// Nothing, with `missing` set, if the scene is not there.
absl::StatusOr<std::optional<AccuracyCheck>> CheckSeams(std::string_view name,
                                                        const AccuracyContext& context,
                                                        std::string& missing);

// --- Leaks ---

// A closed room of 4 x 3 x 4 m beside another building under sun and sky; its walls are quads
// without thickness, or boxes of `thickness_m`. Two cameras: "inside" and "outside".
Scene MakeDarkRoom(double thickness_m);
// A closed box of 8 x 3 x 4 m, halved by a wall of `thickness_m` (0: one quad), with an emitter in
// one half. Cameras: "dark" and "lit".
Scene MakeSplitRoom(double thickness_m);

// "leak-room", "leak-wall": the largest and the mean irradiance of the dark side over the mean of
// the lit one. The truth is 0.
absl::StatusOr<AccuracyCheck> CheckLeak(std::string_view name, const AccuracyContext& context);

// --- Flicker ---

// One frame at the measured pixels.
struct FlickerFrame {
  std::vector<uint8_t> hit;             // all else does not count where it is 0
  std::vector<Rgb> truth, truth_error;  // see SparseReference::IndirectError
};
struct Flicker {
  double change = 0;  // negative: -sqrt of what is below zero, as the truth's noise is taken out
  double error = 0;   // its standard error from the choice of pixels and the truth's noise
};
// Root mean square of (image(t+1) - image(t)) - (truth(t+1) - truth(t)) over the truth's mean, at
// the same pixels, the truth's noise taken out. A pixel that hits nothing in one of two frames does
// not count for the two. All arrays are equally long; the errors are independent between frames.
Flicker FlickerOf(std::span<const std::vector<Rgb>> image, std::span<const FlickerFrame> frames);

// "flicker-pan": 24 frames, the camera turns by 0.25 degrees each; "flicker-light": the sun turns
// by 0.25 degrees each. In Sponza, or in the own city where that is missing; 320x250 pixels.
// Against pt with as much gather time, once with one seed as farpoint renders animations, once with
// a seed for each frame.
absl::StatusOr<AccuracyCheck> CheckFlicker(std::string_view name, const AccuracyContext& context);

}  // namespace farpoint

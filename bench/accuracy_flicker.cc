#include <algorithm>
#include <cmath>
#include <utility>

#include "absl/strings/str_format.h"
#include "bench/accuracy_checks.h"
#include "bench/accuracy_frame.h"
#include "bench/text.h"
#include "core/math/elementary.h"
#include "core/math/sampling.h"

namespace farpoint {

namespace {

constexpr double kBar = 0.1;       // of pt's change
constexpr double kTurnDeg = 0.25;  // by frame: 6 degrees a second at 24 frames a second
constexpr int kFrames = 24, kQuickFrames = 3;
constexpr size_t kPixels = 300, kQuickPixels = 40;
constexpr double kReferenceNoise = 0.012;
constexpr uint64_t kPixelSeed = 24;
constexpr uint64_t kReferenceSeed = 0xf11c8e4ull;

Vec3d TurnedAboutY(const Vec3d& v, double angle_rad) {
  const double c = std::cos(angle_rad), s = std::sin(angle_rad);
  return {c * v.x + s * v.z, v.y, -s * v.x + c * v.z};
}

Camera Turned(Camera camera, double angle_rad) {
  for (Vec3d* axis : {&camera.right, &camera.up, &camera.forward}) {
    *axis = TurnedAboutY(*axis, angle_rad);
  }
  return camera;
}

void TurnSun(Scene& scene, double angle_rad) {
  for (PunctualLight& light : scene.lights) {
    if (light.kind != PunctualKind::kDirectional) continue;
    light.direction = Normalize(TurnedAboutY(light.direction, angle_rad));
  }
}

// pt at the pixels, tile by tile of one pixel: as many paths as are asked for.
absl::StatusOr<std::vector<Rgb>> TraceAt(const SparseFrame& frame,
                                         std::span<const PixelPosition> pixels, uint32_t paths,
                                         uint64_t seed, Executor& executor) {
  RenderSettings settings;
  settings.integrator = Integrator::kPt;
  settings.paths = paths;
  settings.seed = seed;
  settings.layers = {Layer::kIrradiance};
  FP_ASSIGN_OR_RETURN(
      const auto renderer,
      FrameRenderer::Create(frame.scene, FrameSpec{frame.camera, frame.film, settings}));
  std::vector<Rgb> values(pixels.size());
  std::vector<absl::Status> failed(pixels.size());
  Executor alone(1);
  executor.ForEach(pixels.size(), 1, [&](size_t i) {
    const PixelPosition& p = pixels[i];
    const auto out = renderer->RenderTile({p.x, p.y, p.x + 1, p.y + 1}, alone, {}, nullptr);
    if (!out.ok()) {
      failed[i] = out.status();
      return;
    }
    values[i] = ValuesAt(out->film, Layer::kIrradiance, pixels.subspan(i, 1)).front();
  });
  for (const absl::Status& status : failed) FP_RETURN_IF_ERROR(status);
  return values;
}

}  // namespace

Flicker FlickerOf(std::span<const std::vector<Rgb>> image, std::span<const FlickerFrame> frames) {
  if (frames.empty()) return {};
  double sum = 0, count = 0;
  double square = 0, square2 = 0, n = 0;  // over pixels: their means over frames
  for (size_t i = 0; i < frames[0].hit.size(); ++i) {
    double pixel = 0, changes = 0;
    for (size_t t = 0; t < frames.size(); ++t) {
      const FlickerFrame& now = frames[t];
      for (int c = 0; c < 3 && now.hit[i]; ++c) {
        sum += static_cast<double>(now.truth[i][c]);
        count += 1;
        if (t == 0 || !frames[t - 1].hit[i]) continue;
        const FlickerFrame& before = frames[t - 1];
        const double d = static_cast<double>(image[t][i][c] - image[t - 1][i][c]) -
                         static_cast<double>(now.truth[i][c] - before.truth[i][c]);
        const double e1 = static_cast<double>(now.truth_error[i][c]);
        const double e0 = static_cast<double>(before.truth_error[i][c]);
        pixel += d * d - e1 * e1 - e0 * e0;
        changes += 1;
      }
    }
    if (changes == 0) continue;
    square += pixel / changes;
    square2 += (pixel / changes) * (pixel / changes);
    n += 1;
  }
  if (!(sum > 0) || n < 2) return {};
  const double scale = count / sum;
  const double mean = square / n;
  const double error = std::sqrt(std::max(0.0, square2 / n - mean * mean) / (n - 1));
  Flicker flicker;
  flicker.change = std::copysign(std::sqrt(std::fabs(mean)), mean) * scale;
  flicker.error = scale * (std::fabs(mean) > error ? error / (2 * std::sqrt(std::fabs(mean)))
                                                   : std::sqrt(error));
  return flicker;
}

absl::StatusOr<AccuracyCheck> CheckFlicker(std::string_view name, const AccuracyContext& context) {
  const AccuracyOptions& options = context.options;
  const bool pan = name == "flicker-pan";
  AccuracyCase c;
  std::string missing;
  std::optional<AccuracyScene> source;
  if (!options.quick) {
    FP_ASSIGN_OR_RETURN(c, FindAccuracyCase("sponza-sun", false));
    FP_ASSIGN_OR_RETURN(source, LoadAccuracyScene(c, options.folders, false, missing));
  }
  if (!source) {
    c = {};
    c.scene = "city";
    FP_ASSIGN_OR_RETURN(source, LoadAccuracyScene(c, options.folders, options.quick, missing));
  }
  c.width = options.quick ? 48 : 320;
  c.height = options.quick ? 32 : 250;
  const int frames = options.quick ? kQuickFrames : kFrames;
  const std::vector<PixelPosition> pixels = StratifiedPixels(
      {0, 0, c.width, c.height}, options.quick ? kQuickPixels : kPixels, kPixelSeed);

  RenderSettings settings = MeasuredSettings(options);
  settings.layers = {Layer::kIrradiance};
  std::vector<std::vector<Rgb>> image, fixed, fresh;
  std::vector<FlickerFrame> truth;
  uint32_t paths = 0;  // of pt in the time of the gather, decided by the first frame
  double us = 0, truth_noise = 0;
  LoadedFrame loaded;
  for (int t = 0; t < frames; ++t) {
    context.progress(absl::StrFormat("%s: frame %d of %d", name, t + 1, frames));
    const double angle = kTurnDeg * kPi / 180 * t;
    if (t == 0 || !pan) {
      Scene scene = source->scene;
      if (!pan) TurnSun(scene, angle);
      FP_ASSIGN_OR_RETURN(loaded, LoadFrame(scene, source->camera, c.width, c.height, settings,
                                            &context.cache, context.executor));
    }
    if (pan) loaded.frame.camera = Turned(source->camera, angle);
    FP_ASSIGN_OR_RETURN(RenderedFrame rendered,
                        RenderByTiles(loaded.frame, settings, context.executor));
    image.push_back(ValuesAt(rendered.film, Layer::kIrradiance, pixels));
    const double receivers = static_cast<double>(rendered.stats.counts["receivers"]);
    const double frame_us = receivers > 0 ? 1e6 * GatherSeconds(rendered.stats) / receivers : 0;
    us += frame_us / frames;

    SparseReferenceOptions reference;
    reference.noise = options.quick ? 0.1 : kReferenceNoise;
    reference.budget_s = options.reference_budget_s / frames;
    reference.direct_samples = 0;
    // Independent from frame to frame, so that its noise can be taken out.
    reference.seed = HashKey(kReferenceSeed, static_cast<uint64_t>(t));
    reference.cache_dir = options.reference_dir;
    reference.label = absl::StrFormat("%s-%02d", name, t);
    FP_ASSIGN_OR_RETURN(const SparseReference traced,
                        TraceSparseReference(loaded.frame, pixels, reference, context.executor,
                                             [](std::string_view) {}));
    FlickerFrame& now = truth.emplace_back();
    now.hit = traced.hit;
    for (size_t i = 0; i < pixels.size(); ++i) {
      now.truth.push_back(traced.Indirect(i));
      now.truth_error.push_back(traced.IndirectError(i));
    }
    truth_noise = std::max(truth_noise, traced.IndirectNoise());
    if (t == 0) {
      const double n = static_cast<double>(
          std::max<ptrdiff_t>(1, std::count(traced.hit.begin(), traced.hit.end(), 1)));
      const double us_per_path = 1e6 * traced.seconds / (2 * n * traced.paths * traced.rounds);
      paths = us_per_path > 0
                  ? static_cast<uint32_t>(std::clamp(frame_us / us_per_path, 1.0, 1048576.0))
                  : 1;
    }
    FP_ASSIGN_OR_RETURN(fixed.emplace_back(),
                        TraceAt(loaded.frame, pixels, paths, options.seed, context.executor));
    FP_ASSIGN_OR_RETURN(fresh.emplace_back(),
                        TraceAt(loaded.frame, pixels, paths,
                                HashKey(options.seed, static_cast<uint64_t>(t)), context.executor));
  }

  const Flicker ours = FlickerOf(image, truth);
  const Flicker pt_fixed = FlickerOf(fixed, truth);
  const Flicker pt_fresh = FlickerOf(fresh, truth);
  AccuracyCheck check;
  check.name = name;
  const std::string instead =
      missing.empty() ? "" : Concat({" (in place of Sponza: ", missing, ")"});
  check.setup = Concat(
      {CommandOf(c), instead,
       absl::StrFormat("; %d frames, %s by %g degrees each; %d pixels; truth: pt, noise up to "
                       "%.4f, taken out; %.1f us/receiver, in which pt has %d paths",
                       frames, pan ? "the camera turns" : "the sun turns", kTurnDeg, pixels.size(),
                       truth_noise, us, paths)});
  check.values = {{"change that the truth does not have, over the mean", ours.change, ours.error},
                  {"the same of pt, one seed", pt_fixed.change, pt_fixed.error},
                  {"the same of pt, a seed for each frame", pt_fresh.change, pt_fresh.error}};
  const auto compare = [&](const char* what, const Flicker& pt) {
    if (!(pt.change > 0)) return;
    const double ratio = ours.change / pt.change;
    check.values.push_back(
        {what, ratio, std::hypot(ours.error, ratio * pt.error) / pt.change, kBar});
  };
  compare("ours over pt's, one seed", pt_fixed);
  compare("ours over pt's, a seed for each frame", pt_fresh);
  return check;
}

}  // namespace farpoint

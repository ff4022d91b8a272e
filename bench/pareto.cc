#include "bench/pareto.h"

#include <algorithm>
#include <chrono>
#include <cmath>
#include <memory>
#include <utility>

#include "absl/strings/str_format.h"
#include "bench/accuracy_frame.h"
#include "bench/bench_scene.h"
#include "bench/machine.h"
#include "bench/sparse_reference.h"
#include "bench/text.h"
#include "core/base/clock.h"
#include "core/base/executor.h"
#include "core/image/compare.h"
#include "core/image/exr_io.h"
#include "core/math/sampling.h"
#include "core/render/bake.h"
#include "core/render/frame_renderer.h"

namespace farpoint {

namespace {

// Any other number would do: see RunPareto.
constexpr uint64_t kReferenceSeedOffset = 0x9e3779b97f4a7c15ull;
constexpr double kLimitedByNoise = 2.0;

// What is varied.
struct Sweep {
  std::vector<uint32_t> clusters, fpbgi_buffers, pbgi_buffers, dpbgi_buffers, paths;
  std::vector<float> epsilons;
  std::vector<Quality> qualities;
  std::vector<double> cache_errors;
  std::vector<uint32_t> cache_samples;
};

Sweep SweepOf(bool quick) {
  const std::vector<Quality> qualities = {Quality::kDraft, Quality::kNormal, Quality::kFine};
  if (quick) {
    return {.clusters = {8, 32},
            .fpbgi_buffers = {8, 16},
            .pbgi_buffers = {16, 24},
            .dpbgi_buffers = {6, 8},
            .paths = {4, 32, 256},
            .epsilons = {0.1f, 0.2f},
            .qualities = qualities,
            .cache_errors = {0.2, 0.4},
            .cache_samples = {64, 256}};
  }
  return {.clusters = {25, 100, 200},
          .fpbgi_buffers = {16, 24, 32},
          .pbgi_buffers = {24, 32, 48},
          .dpbgi_buffers = {6, 8, 12, 16, 20},
          .paths = {16, 64, 256, 1024},
          .epsilons = {0.05f, 0.1f, 0.2f},
          .qualities = qualities,
          .cache_errors = {0.08, 0.12, 0.2, 0.3, 0.45},
          .cache_samples = {256, 512, 1024, 2048}};
}

double SecondsSince(std::chrono::steady_clock::time_point start) {
  return std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count();
}

// The defaults put in, but for the resolution, which the reference may decide.
ParetoOptions InForce(ParetoOptions o) {
  if (o.repeat == 0) o.repeat = o.quick ? 1 : 3;
  if (o.points == 0 && o.quick) o.points = 20'000;
  if (o.reference_path.empty() && o.reference_paths == 0) o.reference_paths = o.quick ? 2048 : 8192;
  return o;
}

// A film as the file that it would be written to.
ExrImage ImageOf(const Film& film, const FilmSpec& spec) {
  ExrImage image;
  image.data_window = film.rect();
  image.frame_width = spec.width;
  image.frame_height = spec.height;
  for (const Layer layer : film.layers()) {
    const LayerInfo& info = InfoOf(layer);
    for (size_t c = 0; c < info.channels.size(); ++c) {
      const std::span<const float> plane = film.Plane(layer, static_cast<int>(c));
      image.channels.push_back({std::string(info.channels[c]), info.half,
                                std::vector<float>(plane.begin(), plane.end())});
    }
  }
  return image;
}

struct FrameSetup {
  std::shared_ptr<const LoadedScene> scene;
  Camera camera;
  FilmSpec film;
  Executor* executor;
};

absl::StatusOr<std::unique_ptr<FrameRenderer>> MakeRenderer(const FrameSetup& frame,
                                                            const RenderSettings& settings) {
  return FrameRenderer::Create(frame.scene, FrameSpec{frame.camera, frame.film, settings});
}

absl::StatusOr<TileOutput> RenderFrame(const FrameSetup& frame, const FrameRenderer& renderer) {
  return renderer.RenderTile(frame.film.crop, *frame.executor, {}, nullptr);
}

CompareOptions ErrorOptions(const ParetoOptions& options, const std::optional<PixelMask>& mask,
                            double noise) {
  CompareOptions compare;
  compare.layer = InfoOf(Layer::kIrradiance).name;
  compare.ref_layer = options.ref_layer;
  compare.mask = mask;
  compare.noise = noise;
  compare.perceptual = false;
  return compare;
}

struct Reference {
  ExrImage image;
  PixelMask mask;
  std::optional<double> noise;
  uint32_t paths = 0;  // of all halves
  double seconds = 0;
};

// Pixels whose primary ray hits a surface.
PixelMask HitMask(const Film& film) {
  PixelMask mask{film.rect(), {}};
  for (const float z : film.Plane(Layer::kDepth, 0)) mask.on.push_back(std::isfinite(z));
  return mask;
}

// Whether each of the film's pixels counts. The mask holds the film.
std::vector<uint8_t> OnFilm(const PixelMask& mask, const PixelRect& rect) {
  std::vector<uint8_t> on;
  for (int y = rect.y0; y < rect.y1; ++y) {
    for (int x = rect.x0; x < rect.x1; ++x) {
      const int64_t at = int64_t{y - mask.rect.y0} * mask.rect.width() + (x - mask.rect.x0);
      on.push_back(mask.on[static_cast<size_t>(at)]);
    }
  }
  return on;
}

std::vector<Rgb> IrradianceOf(const Film& film) {
  std::vector<Rgb> values;
  for (int y = film.rect().y0; y < film.rect().y1; ++y) {
    for (int x = film.rect().x0; x < film.rect().x1; ++x) {
      values.push_back({film.Get(Layer::kIrradiance, 0, x, y),
                        film.Get(Layer::kIrradiance, 1, x, y),
                        film.Get(Layer::kIrradiance, 2, x, y)});
    }
  }
  return values;
}

absl::StatusOr<Reference> TraceReference(const FrameSetup& frame, const ParetoOptions& options,
                                         std::optional<PixelMask> mask) {
  RenderSettings settings;
  settings.integrator = Integrator::kPt;
  settings.paths = options.reference_paths / 2;
  settings.layers = {Layer::kIrradiance, Layer::kDepth};
  Reference reference;
  std::vector<Film> films;
  std::vector<Rgb> half[2];
  for (uint64_t h = 0; h < 2; ++h) {
    settings.seed = HashKey(options.seed + kReferenceSeedOffset, h);
    FP_ASSIGN_OR_RETURN(const auto renderer, MakeRenderer(frame, settings));
    FP_ASSIGN_OR_RETURN(TileOutput out, RenderFrame(frame, *renderer));
    reference.paths += settings.paths;
    reference.seconds += GatherSeconds(out.stats);
    half[h] = IrradianceOf(out.film);
    films.push_back(std::move(out.film));
  }
  reference.mask = mask ? *std::move(mask) : HitMask(films[0]);
  const std::vector<uint8_t> on = OnFilm(reference.mask, films[0].rect());
  reference.noise = NoiseOfHalves(on, half[0], half[1]);
  for (int c = 0; c < 3; ++c) {
    const std::span<float> mean = films[0].Plane(Layer::kIrradiance, c);
    const std::span<const float> other = films[1].Plane(Layer::kIrradiance, c);
    for (size_t i = 0; i < mean.size(); ++i) mean[i] = 0.5f * (mean[i] + other[i]);
  }
  reference.image = ImageOf(films[0], frame.film);
  return reference;
}

// The mask of a reference that came without one: from the primary rays of a render of one path.
absl::StatusOr<PixelMask> TraceMask(const FrameSetup& frame) {
  RenderSettings settings;
  settings.integrator = Integrator::kPt;
  settings.paths = 1;
  settings.layers = {Layer::kDepth};
  FP_ASSIGN_OR_RETURN(const auto renderer, MakeRenderer(frame, settings));
  FP_ASSIGN_OR_RETURN(const TileOutput out, RenderFrame(frame, *renderer));
  return HitMask(out.film);
}

RenderSettings SettingsOf(const ParetoPoint& point, const ParetoOptions& options) {
  RenderSettings s;
  s.integrator = point.integrator;
  s.seed = options.seed;
  s.light_samples = options.light_samples;
  if (point.integrator == Integrator::kIrrcache) {
    s.cache_error = static_cast<float>(point.cache_error);
    s.cache_samples = point.paths;
  } else if (point.paths != 0) {
    s.paths = point.paths;
  }
  if (point.quality) s.quality = *point.quality;
  s.clusters = point.clusters;
  s.microbuffer = point.microbuffer;
  if (point.clusters != 0) s.epsilon = static_cast<float>(point.epsilon);
  // Irradiance alone: no direct light is computed, and black receivers are gathered like others.
  s.layers = {Layer::kIrradiance};
  return s;
}

std::vector<ParetoPoint> Configurations(const Sweep& sweep) {
  std::vector<ParetoPoint> points;
  const auto add = [&](Integrator integrator) -> ParetoPoint& {
    points.emplace_back().integrator = integrator;
    return points.back();
  };
  for (const Quality quality : sweep.qualities) add(Integrator::kFpbgi).quality = quality;
  for (const uint32_t k : sweep.clusters) {
    for (const float epsilon : sweep.epsilons) {
      for (const uint32_t side : sweep.fpbgi_buffers) {
        ParetoPoint& p = add(Integrator::kFpbgi);
        p.clusters = k;
        // Decimal, as it was meant: 0.1f is 0.10000000149.
        p.epsilon = std::round(static_cast<double>(epsilon) * 1e6) / 1e6;
        p.microbuffer = side;
      }
    }
  }
  for (const uint32_t side : sweep.pbgi_buffers) add(Integrator::kPbgi).microbuffer = side;
  for (const uint32_t side : sweep.dpbgi_buffers) add(Integrator::kDpbgi).microbuffer = side;
  for (const uint32_t paths : sweep.paths) add(Integrator::kPt).paths = paths;
  for (const double error : sweep.cache_errors) {
    for (const uint32_t samples : sweep.cache_samples) {
      ParetoPoint& p = add(Integrator::kIrrcache);
      p.cache_error = error;
      p.paths = samples;
    }
  }
  return points;
}

// Collects a value per repeat and stage.
class StageSamples {
 public:
  void Add(const std::array<double, kStageCount>& seconds) {
    for (int i = 0; i < kStageCount; ++i) samples_[i].push_back(seconds[i]);
  }
  std::array<Spread, kStageCount> Spreads() const {
    std::array<Spread, kStageCount> spreads;
    for (int i = 0; i < kStageCount; ++i) spreads[i] = SpreadOf(samples_[i]);
    return spreads;
  }

 private:
  std::array<std::vector<double>, kStageCount> samples_;
};

struct Baked {
  BakedScene blobs;
  Stats stats;
  PreparationTimes times;
};

absl::StatusOr<Baked> BakeRepeatedly(const Scene& scene, const RenderSettings& settings,
                                     unsigned repeat, Executor& executor) {
  Baked baked;
  StageSamples samples;
  std::vector<double> totals;
  for (unsigned i = 0; i < repeat; ++i) {
    Stats stats;
    FP_ASSIGN_OR_RETURN(BakedScene blobs, Bake(scene, settings, executor, stats));
    if (i > 0 && (blobs.tree_topology.Hash() != baked.blobs.tree_topology.Hash() ||
                  blobs.tree_radiance.Hash() != baked.blobs.tree_radiance.Hash())) {
      return absl::InternalError("two bakes of one scene differ; this is a defect of farpoint");
    }
    samples.Add(stats.seconds);
    totals.push_back(BakeSeconds(stats));
    baked.blobs = std::move(blobs);
    baked.stats = std::move(stats);
  }
  baked.times = {samples.Spreads(), SpreadOf(totals)};
  return baked;
}

// Where the curve through the points, straight between them in logarithms, has error `rr`.
std::optional<double> SecondsAt(const std::vector<const ParetoPoint*>& by_time, double rr) {
  for (size_t i = 0; i + 1 < by_time.size(); ++i) {
    const ParetoPoint &a = *by_time[i], &b = *by_time[i + 1];
    if (rr > a.rr || rr < b.rr) continue;
    const double t = a.rr > b.rr ? std::log(a.rr / rr) / std::log(a.rr / b.rr) : 0.0;
    return a.gather.median * std::pow(b.gather.median / a.gather.median, t);
  }
  return std::nullopt;
}

}  // namespace

Spread SpreadOf(std::vector<double> values) {
  std::sort(values.begin(), values.end());
  const size_t n = values.size();
  return {0.5 * (values[(n - 1) / 2] + values[n / 2]), values.front(), values.back()};
}

ParetoCurve ParetoPoint::curve() const {
  switch (integrator) {
    case Integrator::kFpbgi:
      return clusters == 0 ? ParetoCurve::kAdaptive : ParetoCurve::kKMeans;
    case Integrator::kPbgi:
      return ParetoCurve::kPbgi;
    case Integrator::kDpbgi:
      return ParetoCurve::kDpbgi;
    case Integrator::kPt:
      return ParetoCurve::kPt;
    case Integrator::kIrrcache:
      break;
  }
  return ParetoCurve::kIrrcache;
}

std::string_view NameOf(ParetoCurve curve) {
  static constexpr std::array<std::string_view, kParetoCurveCount> kNames = {
      "fpbgi adaptive", "fpbgi k", "pbgi", "dpbgi", "pt", "irrcache"};
  return kNames[static_cast<size_t>(curve)];
}

absl::StatusOr<ParetoCurve> ParetoCurveFromName(std::string_view name) {
  static constexpr std::array<std::string_view, kParetoCurveCount> kFlagNames = {
      "adaptive", "k", "pbgi", "dpbgi", "pt", "irrcache"};
  for (size_t i = 0; i < kFlagNames.size(); ++i) {
    if (kFlagNames[i] == name) return static_cast<ParetoCurve>(i);
  }
  return absl::InvalidArgumentError(
      Concat({"unknown curve '", name, "'; use some of adaptive, k, pbgi, dpbgi, pt, irrcache"}));
}

std::string LabelOf(const ParetoPoint& p) {
  switch (p.integrator) {
    case Integrator::kFpbgi:
      if (p.clusters == 0) return std::string(NameOf(p.quality.value_or(Quality::kNormal)));
      return absl::StrFormat("k=%d ε=%g %d²", p.clusters, p.epsilon, p.microbuffer);
    case Integrator::kPbgi:
    case Integrator::kDpbgi:
      return absl::StrFormat("%d²", p.microbuffer);
    case Integrator::kIrrcache:
      return absl::StrFormat("a=%g %d rays", p.cache_error, p.paths);
    case Integrator::kPt:
      break;
  }
  return absl::StrFormat("%d paths", p.paths);
}

std::optional<std::string> NoiseWarning(const ParetoReport& report) {
  std::string labels;
  for (const ParetoPoint& p : report.points) {
    if (!p.noise_above_error) continue;
    Append(labels, {labels.empty() ? "" : ", ", NameOf(p.curve()), " ", LabelOf(p)});
  }
  if (labels.empty()) return std::nullopt;
  return absl::StrFormat(
      "the reference's noise of %.4g is above the error of %s: their rr is 0 and says only that "
      "the error is below what the reference can show; take one with less noise",
      report.reference_noise, labels);
}

void AnalysePoints(std::span<ParetoPoint> points) {
  for (ParetoPoint& p : points) {
    p.on_front = std::none_of(points.begin(), points.end(), [&](const ParetoPoint& q) {
      return q.curve() == p.curve() && q.gather.median <= p.gather.median && q.rr <= p.rr &&
             (q.gather.median < p.gather.median || q.rr < p.rr);
    });
  }
  const auto front_of = [&](Integrator integrator) {
    std::vector<const ParetoPoint*> front;
    for (const ParetoPoint& p : points) {
      if (p.integrator != integrator || p.reference_limited || !p.on_front) continue;
      if (p.rr > 0 && p.gather.median > 0) front.push_back(&p);
    }
    std::sort(front.begin(), front.end(), [](const ParetoPoint* a, const ParetoPoint* b) {
      return a->gather.median < b->gather.median;
    });
    return front;
  };
  const auto pt = front_of(Integrator::kPt), cache = front_of(Integrator::kIrrcache);
  for (ParetoPoint& p : points) {
    p.pt_seconds_at_rr.reset();
    p.irrcache_seconds_at_rr.reset();
    if (p.reference_limited || !(p.rr > 0)) continue;
    if (p.integrator != Integrator::kPt) p.pt_seconds_at_rr = SecondsAt(pt, p.rr);
    if (p.integrator != Integrator::kIrrcache && p.integrator != Integrator::kPt) {
      p.irrcache_seconds_at_rr = SecondsAt(cache, p.rr);
    }
  }
}

absl::StatusOr<ParetoReport> RunPareto(const ParetoOptions& asked,
                                       const std::function<void(std::string_view)>& progress) {
  ParetoReport report;
  report.options = InForce(asked);
  ParetoOptions& options = report.options;
  report.date_utc = DateUtc();
  report.cpu = CpuModel();
  report.load_average_start = LoadAverage();
  Executor executor(options.threads);
  options.threads = executor.threads();

  // What the files say is read first: a mistake should not cost the time of a bake.
  std::optional<ExrImage> reference_file;
  std::optional<PixelMask> mask;
  if (!options.reference_path.empty()) {
    FP_ASSIGN_OR_RETURN(reference_file, ReadExr(options.reference_path));
  }
  if (!options.mask_path.empty()) {
    FP_ASSIGN_OR_RETURN(mask, ReadMask(options.mask_path));
  }
  if (options.width == 0) {
    const int side = options.quick ? 64 : 256;
    options.width = reference_file ? reference_file->frame_width : side;
    options.height = reference_file ? reference_file->frame_height : side;
  }
  const PixelRect frame_rect{0, 0, options.width, options.height};
  FrameSetup frame{nullptr, {}, {options.width, options.height, frame_rect}, &executor};
  FP_RETURN_IF_ERROR(ValidateFilm(frame.film));
  if (reference_file && (reference_file->frame_width != options.width ||
                         reference_file->frame_height != options.height)) {
    return absl::InvalidArgumentError(absl::StrFormat(
        "%s has a frame of %dx%d pixels and cannot be the reference of %dx%d; leave --resolution "
        "out",
        options.reference_path, reference_file->frame_width, reference_file->frame_height,
        options.width, options.height));
  }
  if (reference_file) {
    // A black film in place of a render: the comparison says whether file and layer will do.
    const Film black(frame_rect, {Layer::kIrradiance});
    const auto tried = CompareImages(ImageOf(black, frame.film), *reference_file,
                                     ErrorOptions(options, std::nullopt, 0.0));
    if (!tried.ok()) return Annotate(tried.status(), options.reference_path);
  }
  if (mask && (mask->frame_width != options.width || mask->frame_height != options.height ||
               !mask->rect.Contains(frame_rect))) {
    return absl::InvalidArgumentError(absl::StrFormat(
        "%s has %dx%d pixels of a frame of %dx%d and is no mask of the frame of %dx%d",
        options.mask_path, mask->rect.width(), mask->rect.height(), mask->frame_width,
        mask->frame_height, options.width, options.height));
  }

  FP_ASSIGN_OR_RETURN(BenchScene source,
                      MakeBenchScene(options.scene, options.quick, options.changes));
  report.notes = std::move(source.notes);
  frame.camera = source.scene.cameras.front();

  progress("baking the scene");
  RenderSettings bake_settings;
  bake_settings.points = options.points;
  bake_settings.light_samples = options.light_samples;
  bake_settings.seed = options.seed;
  FP_ASSIGN_OR_RETURN(Baked baked,
                      BakeRepeatedly(source.scene, bake_settings, options.repeat, executor));
  report.point_based = baked.times;
  bake_settings.integrator = Integrator::kPt;
  FP_ASSIGN_OR_RETURN(const Baked baked_pt,
                      BakeRepeatedly(source.scene, bake_settings, options.repeat, executor));
  report.path_traced = baked_pt.times;
  source = {};
  std::vector<double> load;
  for (unsigned i = 0; i < options.repeat; ++i) {
    const double cpu = ProcessCpuSeconds();
    FP_ASSIGN_OR_RETURN(frame.scene, LoadedScene::Load(baked.blobs, executor));
    load.push_back(ProcessCpuSeconds() - cpu);
  }
  report.load = SpreadOf(load);
  {
    // The first renderer of a scene that reads surfels makes the atlas, which the scene keeps.
    const double cpu = ProcessCpuSeconds();
    FP_RETURN_IF_ERROR(MakeRenderer(frame, RenderSettings()).status());
    report.atlas = SpreadOf({ProcessCpuSeconds() - cpu});
  }
  report.triangles = baked.stats.counts["triangles"];
  report.surfels = baked.stats.counts["surfels"];
  report.nodes = baked.stats.counts["nodes"];
  report.scene_bytes = baked.stats.bytes["scene"];
  report.tree_bytes = baked.stats.bytes["tree"];
  report.scene_hash = baked.blobs.prepared_scene.Hash().Hex();
  report.tree_hash = baked.blobs.tree_topology.Hash().Hex();

  Reference reference;
  if (reference_file) {
    if (!mask) {
      FP_ASSIGN_OR_RETURN(mask, TraceMask(frame));
    }
    reference.image = *std::move(reference_file);
    reference.mask = *std::move(mask);
    reference.noise = options.noise;
  } else {
    progress(absl::StrFormat("tracing the reference, %d paths", options.reference_paths));
    FP_ASSIGN_OR_RETURN(reference, TraceReference(frame, options, std::move(mask)));
  }
  report.reference_noise = reference.noise.value_or(0.0);
  report.reference_noise_known = reference.noise.has_value();
  report.reference_seconds = reference.seconds;
  if (!reference_file) options.reference_paths = reference.paths;

  report.points = Configurations(SweepOf(options.quick));
  if (!options.curves.empty()) {
    std::erase_if(report.points, [&](const ParetoPoint& p) {
      return std::find(options.curves.begin(), options.curves.end(), p.curve()) ==
             options.curves.end();
    });
  }
  const size_t count = report.points.size();
  std::vector<StageSamples> stages(count);
  std::vector<std::vector<double>> gather(count), wall(count);
  for (unsigned round = 0; round < options.repeat; ++round) {
    for (size_t i = 0; i < count; ++i) {
      ParetoPoint& point = report.points[i];
      progress(absl::StrFormat("round %d of %d, %d of %d: %s %s", round + 1, options.repeat, i + 1,
                               count, NameOf(point.integrator), LabelOf(point)));
      // A new one each time: a renderer keeps records and caches from tile to tile.
      FP_ASSIGN_OR_RETURN(const auto renderer, MakeRenderer(frame, SettingsOf(point, options)));
      const auto start = std::chrono::steady_clock::now();
      FP_ASSIGN_OR_RETURN(const TileOutput out, RenderFrame(frame, *renderer));
      wall[i].push_back(SecondsSince(start));
      stages[i].Add(out.stats.seconds);
      gather[i].push_back(GatherSeconds(out.stats));
      const std::string hash = LayerHash(out.film, Layer::kIrradiance).Hex();
      if (round > 0) {
        // The same work, too: a renderer that kept something would be fast for nothing.
        if (hash == point.hash && out.stats.counts == point.counts) continue;
        return absl::InternalError(Concat({NameOf(point.curve()), " ", LabelOf(point),
                                           ": two renders differ; a defect of farpoint"}));
      }
      point.hash = hash;
      point.counts = out.stats.counts;
      const absl::StatusOr<CompareResult> result =
          CompareImages(ImageOf(out.film, frame.film), reference.image,
                        ErrorOptions(options, reference.mask, report.reference_noise));
      if (!result.ok()) return Annotate(result.status(), "comparing with the reference");
      if (!result->rr || !(result->ref_mean > 0)) {
        return absl::InvalidArgumentError(
            "the reference has no irradiance on the compared pixels, so errors have no scale; use "
            "a lit scene and a mask that holds lit pixels");
      }
      point.rel_rmse = *result->rel_rmse;
      point.rr = *result->rr;
      point.bias = *result->bias;
      point.reference_limited = point.rel_rmse < kLimitedByNoise * report.reference_noise;
      point.noise_above_error = result->noise_above_error;
      report.compared_pixels = static_cast<uint64_t>(result->pixels - result->left_out);
      report.reference_mean = result->ref_mean;
    }
  }
  for (size_t i = 0; i < count; ++i) {
    ParetoPoint& point = report.points[i];
    point.gather = SpreadOf(gather[i]);
    point.stage = stages[i].Spreads();
    point.wall = SpreadOf(wall[i]);
    report.receivers = point.counts["receivers"];
    point.us_per_receiver = report.receivers == 0
                                ? 0
                                : 1e6 * point.gather.median / static_cast<double>(report.receivers);
  }
  AnalysePoints(report.points);
  report.load_average_end = LoadAverage();
  return report;
}

}  // namespace farpoint

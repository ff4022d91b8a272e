#include "bench/paper.h"

#include <sys/resource.h>

#include <algorithm>
#include <cmath>
#include <memory>
#include <mutex>
#include <set>
#include <utility>

#include "absl/strings/str_format.h"
#include "bench/accuracy_frame.h"
#include "bench/machine.h"
#include "bench/sparse_reference.h"
#include "bench/text.h"
#include "core/base/clock.h"
#include "core/base/executor.h"
#include "core/image/film.h"
#include "core/image/rgb_image.h"
#include "core/image/yee_metric.h"
#include "core/math/elementary.h"
#include "core/math/sampling.h"
#include "core/render/bake.h"
#include "core/render/frame_renderer.h"

namespace farpoint {

namespace {

constexpr int kSampleSide = 8;           // pixels of a sampled block
constexpr int kCellSide = 4;             // pixels of a cell with one pixel of the reference
constexpr float kDifferenceScale = 16;   // of difference images
constexpr double kWhiteQuantile = 0.99;  // of the indirect layer, as CompareOptions has it
// Of renders that are only looked at: the lesser of a quantile and so many times the median.
constexpr double kFrameWhiteQuantile = 0.98, kFrameWhiteMedians = 6;
constexpr double kReferenceNoise = 0.01;
// Any other number would do: the reference's paths must not be those of a render.
constexpr uint64_t kReferenceSeedOffset = 0x9e3779b97f4a7c15ull;
enum : uint64_t { kKeyBlocks = 0x626c6f636b73ull, kKeyPixels = 0x706978656c73ull };

struct Sweep {
  std::vector<uint32_t> clusters;
  std::vector<float> epsilons;
};
Sweep SweepOf(bool quick) {
  if (quick) return {{16, 100}, {0.1f, 0.4f}};
  return {{10, 25, 50, 100, 200}, {0.05f, 0.1f, 0.2f, 0.4f}};
}

// Decimal, as it was meant: 0.1f is 0.10000000149.
double Decimal(float v) { return std::round(static_cast<double>(v) * 1e6) / 1e6; }

uint64_t PeakRssBytes() {
  rusage usage{};
  if (getrusage(RUSAGE_SELF, &usage) != 0) return 0;
  return static_cast<uint64_t>(usage.ru_maxrss) * 1024;  // Linux counts KiB
}

PaperOptions InForce(PaperOptions o) {
  if (o.blocks == 0) o.blocks = o.quick ? 8 : 256;
  if (o.reference_budget_s == 0) o.reference_budget_s = o.quick ? 2 : 120;
  if (o.quick && o.points == 0) o.points = 4000;
  if (o.quick && o.width == 0) o.width = o.height = 96;
  return o;
}

double SecondsOf(const Stats& stats, Stage stage) {
  return stats.seconds[static_cast<size_t>(stage)];
}
PaperTimes TimesOf(const Stats& stats) {
  PaperTimes times;
  for (const Stage s : kGatherStages) {
    times.seconds[static_cast<size_t>(s)] = SecondsOf(stats, s);
  }
  times.gather = GatherSeconds(stats);
  return times;
}

Rgb ValueAt(const Film& film, Layer layer, int x, int y) {
  return {film.Get(layer, 0, x, y), film.Get(layer, 1, x, y), film.Get(layer, 2, x, y)};
}

// The q-quantile; 0 of nothing.
double Quantile(std::vector<float> values, double q) {
  if (values.empty()) return 0;
  const auto at =
      values.begin() +
      static_cast<ptrdiff_t>(
          std::min(values.size() - 1, static_cast<size_t>(q * static_cast<double>(values.size()))));
  std::nth_element(values.begin(), at, values.end());
  return *at;
}

// --- Pictures -----------------------------------------------------------------------------------

// A layer over `white`, clamped: what a display shows, linear in its light.
RgbImage Displayed(const Film& film, Layer layer, const PixelRect& rect, double white) {
  RgbImage image;
  for (size_t c = 0; c < 3; ++c) {
    image[c] = ImagePlane(rect.width(), rect.height());
    for (int y = rect.y0; y < rect.y1; ++y) {
      for (int x = rect.x0; x < rect.x1; ++x) {
        const double v = film.Get(layer, static_cast<int>(c), x, y);
        image[c].Row(y - rect.y0)[x - rect.x0] =
            static_cast<float>(std::clamp(v / white, 0.0, 1.0));
      }
    }
  }
  return image;
}

PaperPicture PictureOf(const RgbImage& image, std::string name, std::string caption) {
  PaperPicture picture{std::move(name), std::move(caption), image[0].width, image[0].height, {}};
  const size_t n = image[0].values.size();
  picture.rgb.resize(3 * n);
  for (size_t c = 0; c < 3; ++c) {
    for (size_t i = 0; i < n; ++i) {
      const double v = std::clamp(static_cast<double>(image[c].values[i]), 0.0, 1.0);
      picture.rgb[3 * i + c] = static_cast<uint8_t>(255.0 * LinearToSrgb(v) + 0.5);
    }
  }
  return picture;
}

// |a - b| times kDifferenceScale, linear: a byte of 255 is a difference of 1 / kDifferenceScale.
PaperPicture DifferencePicture(const RgbImage& a, const RgbImage& b, std::string name,
                               std::string caption) {
  PaperPicture picture{std::move(name), std::move(caption), a[0].width, a[0].height, {}};
  const size_t n = a[0].values.size();
  picture.rgb.resize(3 * n);
  for (size_t c = 0; c < 3; ++c) {
    for (size_t i = 0; i < n; ++i) {
      const float v = kDifferenceScale * std::fabs(a[c].values[i] - b[c].values[i]);
      picture.rgb[3 * i + c] = static_cast<uint8_t>(255.0f * std::min(1.0f, v) + 0.5f);
    }
  }
  return picture;
}

// Black, and blue where a difference is seen, as in the paper's figures.
PaperPicture SeenPicture(const RgbImage& like, std::span<const uint8_t> differs, std::string name,
                         std::string caption) {
  PaperPicture picture{std::move(name), std::move(caption), like[0].width, like[0].height, {}};
  picture.rgb.resize(3 * differs.size());
  for (size_t i = 0; i < differs.size(); ++i) {
    if (differs[i] == 0) continue;
    picture.rgb[3 * i] = 60;
    picture.rgb[3 * i + 1] = 110;
    picture.rgb[3 * i + 2] = 255;
  }
  return picture;
}

double MeanSquare(const RgbImage& a, const RgbImage& b) {
  double sum = 0;
  size_t n = 0;
  for (size_t c = 0; c < 3; ++c) {
    for (size_t i = 0; i < a[c].values.size(); ++i, ++n) {
      const double d = double{a[c].values[i]} - double{b[c].values[i]};
      sum += d * d;
    }
  }
  return n == 0 ? 0 : sum / static_cast<double>(n);
}

std::vector<uint8_t> Seen(const RgbImage& a, const RgbImage& b, int frame_width) {
  const std::vector<uint8_t> all(a[0].values.size(), 1);
  YeeViewing viewing;
  viewing.view_width = frame_width;
  return PerceptiblyDifferent(a, b, all, viewing);
}
int64_t CountOf(const std::vector<uint8_t>& differs) {
  return std::count(differs.begin(), differs.end(), 1);
}

// --- One scene ----------------------------------------------------------------------------------

// Of an integrator at the sampled blocks.
struct BlockRender {
  Film film;  // of the whole frame; filled where it was rendered
  PaperTimes times;
};

class SceneRun {
 public:
  SceneRun(const PaperOptions& options, const PaperScene& scene, Executor& executor,
           const std::function<void(std::string_view)>& progress)
      : options_(options), executor_(executor), progress_(progress) {
    report_.scene = scene;
  }

  absl::StatusOr<PaperSceneReport> Run(PaperView view) {
    report_.load_average_start = LoadAverage();
    report_.notes = std::move(view.notes);
    report_.width = options_.width > 0 ? options_.width : report_.scene.width;
    report_.height = options_.height > 0 ? options_.height : report_.scene.height;
    frame_rect_ = {0, 0, report_.width, report_.height};
    frame_.camera = view.camera;
    frame_.film = {report_.width, report_.height, frame_rect_};
    FP_RETURN_IF_ERROR(ValidateFilm(frame_.film));
    report_.crop = MiddleCrop(report_.width, report_.height);
    report_.compared = options_.full ? frame_rect_ : report_.crop;
    blocks_ = SampleBlocks(report_.width, report_.height, options_.blocks,
                           HashKey(options_.seed, kKeyBlocks));
    FP_RETURN_IF_ERROR(Prepare(std::move(view.scene)));
    FP_RETURN_IF_ERROR(RenderFpbgi());
    FP_RETURN_IF_ERROR(RenderPbgi());
    FP_RETURN_IF_ERROR(RenderDpbgi());
    FP_RETURN_IF_ERROR(CompareWithPbgi());
    FP_RETURN_IF_ERROR(CompareWithTruth());
    // The sweep may take as long again: what stands is said now.
    Say(absl::StrFormat(
        "gather %.4g and %.4g thread-seconds by pbgi and fpbgi, MSE %.3g, rr %.4f and %.4f",
        report_.pbgi.times.gather, report_.fpbgi.times.gather, report_.fpbgi.difference->mse,
        report_.pbgi.truth.rr, report_.fpbgi.truth.rr));
    FP_RETURN_IF_ERROR(RunSweep());
    report_.load_average_end = LoadAverage();
    return std::move(report_);
  }

 private:
  void Say(std::string_view text) const { progress_(Concat({report_.scene.name, ": ", text})); }

  // Says how far a render of the whole frame is, three times.
  std::function<void(int, int)> Quarters() const {
    return [this](int done, int total) {
      const int quarter = 4 * done / total;
      if (quarter > 0 && quarter < 4 && 4 * (done - 1) / total < quarter) {
        Say(absl::StrFormat("%d %%", 25 * quarter));
      }
    };
  }

  // The paper's parameters, unless others were asked for.
  RenderSettings Settings(Integrator integrator, std::vector<Layer> layers) const {
    RenderSettings s;
    ApplyPaperPreset(s);
    if (options_.splat) s.splat = *options_.splat;
    if (options_.microbuffer > 0) s.microbuffer = options_.microbuffer;
    s.integrator = integrator;
    s.points = options_.points > 0 ? options_.points : report_.scene.points;
    s.light_samples = options_.light_samples;
    s.seed = options_.seed;
    s.layers = std::move(layers);
    return s;
  }

  absl::StatusOr<std::unique_ptr<FrameRenderer>> Renderer(const RenderSettings& settings) const {
    return FrameRenderer::Create(loaded_, FrameSpec{frame_.camera, frame_.film, settings});
  }

  absl::Status Prepare(Scene scene) {
    const RenderSettings settings = Settings(Integrator::kFpbgi, {Layer::kIrradiance});
    Say(absl::StrFormat("baking about %d surfels", settings.points));
    Stats stats;
    FP_ASSIGN_OR_RETURN(const BakedScene baked, Bake(scene, settings, executor_, stats));
    scene = {};
    frame_.prepared_scene = baked.prepared_scene.Hash();
    report_.preparation = stats.seconds;
    report_.triangles = stats.counts["triangles"];
    report_.surfels = stats.counts["surfels"];
    report_.nodes = stats.counts["nodes"];
    report_.tree_bytes = stats.bytes["tree"];
    const double cpu = ProcessCpuSeconds();
    FP_ASSIGN_OR_RETURN(loaded_, LoadedScene::Load(baked, executor_));
    report_.load_s = ProcessCpuSeconds() - cpu;
    frame_.scene = loaded_;
    return absl::OkStatus();
  }

  // The whole frame, which is cheap enough.
  absl::Status RenderFpbgi() {
    Say("fpbgi, the whole frame");
    const RenderSettings settings = Settings(
        Integrator::kFpbgi, {Layer::kBeauty, Layer::kIndirect, Layer::kIrradiance, Layer::kDepth});
    FP_ASSIGN_OR_RETURN(const auto renderer, Renderer(settings));
    FP_ASSIGN_OR_RETURN(TileOutput out,
                        renderer->RenderTile(frame_rect_, executor_, Quarters(), nullptr));
    report_.receivers = out.stats.counts["receivers"];
    report_.primary_s = SecondsOf(out.stats, Stage::kPrimary);
    report_.direct_s = SecondsOf(out.stats, Stage::kDirect);
    PaperIntegrator& r = report_.fpbgi;
    r.integrator = Integrator::kFpbgi;
    r.clusters = settings.clusters;
    r.epsilon = Decimal(settings.epsilon);
    r.microbuffer = settings.microbuffer;
    r.times = TimesOf(out.stats);
    if (options_.full) r.crop_gather = r.times.gather;
    fpbgi_ = std::move(out.film);
    if (report_.receivers == 0) {
      return absl::InvalidArgumentError(
          Concat({report_.scene.name, ": no pixel sees a surface; use a larger --resolution"}));
    }
    return absl::OkStatus();
  }

  static std::vector<Layer> GatherLayers() {
    return {Layer::kIndirect, Layer::kIrradiance, Layer::kDepth};
  }

  // The sampled blocks, or the whole frame if all is asked for.
  absl::StatusOr<BlockRender> RenderSample(const RenderSettings& settings) const {
    FP_ASSIGN_OR_RETURN(const auto renderer, Renderer(settings));
    BlockRender render;
    if (options_.full) {
      FP_ASSIGN_OR_RETURN(TileOutput out,
                          renderer->RenderTile(frame_rect_, executor_, Quarters(), nullptr));
      render.times = TimesOf(out.stats);
      render.film = std::move(out.film);
      return render;
    }
    render.film = Film(frame_rect_, settings.layers);
    FP_ASSIGN_OR_RETURN(render.times, RenderBlocks(*renderer, &render.film));
    return render;
  }

  // Times extrapolated to the frame from the sampled blocks; their pixels go into `film` unless it
  // is null.
  absl::StatusOr<PaperTimes> RenderBlocks(const FrameRenderer& renderer, Film* film) const {
    std::vector<std::optional<TileOutput>> outputs(blocks_.size());
    std::mutex mutex;
    absl::Status failed;
    Executor alone(1);
    // A sampled block is one block of the renderer: the parallel loop is this one.
    executor_.ForEach(blocks_.size(), 1, [&](size_t i) {
      absl::StatusOr<TileOutput> out = renderer.RenderTile(blocks_[i], alone, {}, nullptr);
      if (out.ok()) {
        outputs[i] = *std::move(out);
        return;
      }
      const std::lock_guard lock(mutex);
      failed = out.status();
    });
    FP_RETURN_IF_ERROR(failed);
    Stats sum;
    std::vector<double> gather, receivers;
    for (const std::optional<TileOutput>& out : outputs) {
      sum += out->stats;
      gather.push_back(GatherSeconds(out->stats));
      receivers.push_back(static_cast<double>(out->stats.counts.at("receivers")));
      if (film != nullptr) film->Paste(out->film);
    }
    const double sampled = static_cast<double>(sum.counts["receivers"]);
    if (sampled == 0) {
      return absl::InvalidArgumentError(Concat(
          {report_.scene.name, ": no sampled block sees a surface; give more with --blocks"}));
    }
    PaperTimes times = TimesOf(sum);
    const double frame = static_cast<double>(report_.receivers);
    for (double& s : times.seconds) s *= frame / sampled;
    const TotalEstimate total = EstimateTotal(gather, receivers, frame);
    times.gather = total.total;
    times.gather_error = total.error;
    return times;
  }

  // The crop alone, and its time.
  absl::StatusOr<Film> RenderCrop(const RenderSettings& settings, double& gather) const {
    FP_ASSIGN_OR_RETURN(const auto renderer, Renderer(settings));
    FP_ASSIGN_OR_RETURN(TileOutput out, renderer->RenderTile(report_.crop, executor_, {}, nullptr));
    gather = GatherSeconds(out.stats);
    return std::move(out.film);
  }

  absl::Status RenderPbgi() {
    const RenderSettings settings = Settings(Integrator::kPbgi, GatherLayers());
    Say(options_.full ? std::string("pbgi, the whole frame")
                      : absl::StrFormat("pbgi, %d blocks of 8x8 pixels", blocks_.size()));
    FP_ASSIGN_OR_RETURN(BlockRender sample, RenderSample(settings));
    PaperIntegrator& r = report_.pbgi;
    r.integrator = Integrator::kPbgi;
    r.microbuffer = settings.microbuffer;
    r.times = sample.times;
    pbgi_ = std::move(sample.film);
    for (const PixelRect& block : blocks_) {
      ++report_.blocks;
      report_.block_pixels += static_cast<uint64_t>(block.area());
      for (int y = block.y0; y < block.y1; ++y) {
        for (int x = block.x0; x < block.x1; ++x) {
          report_.block_receivers += std::isfinite(fpbgi_.Get(Layer::kDepth, 0, x, y));
        }
      }
    }
    report_.white = White();
    if (!(report_.white > 0)) {
      return absl::InvalidArgumentError(
          Concat({report_.scene.name, ": no indirect light in the frame, errors have no scale"}));
    }
    Say(absl::StrFormat("pbgi, the crop of %dx%d pixels", report_.crop.width(),
                        report_.crop.height()));
    FP_ASSIGN_OR_RETURN(pbgi_crop_, RenderCrop(settings, report_.pbgi_crop_gather));
    r.crop_gather = options_.full ? r.times.gather : report_.pbgi_crop_gather;
    if (!options_.full) pbgi_.Paste(pbgi_crop_);
    return absl::OkStatus();
  }

  // Over all pixels that pbgi rendered.
  double White() const {
    std::vector<float> luminance;
    const auto add = [&](const PixelRect& rect) {
      for (int y = rect.y0; y < rect.y1; ++y) {
        for (int x = rect.x0; x < rect.x1; ++x) {
          luminance.push_back(Luminance(ValueAt(pbgi_, Layer::kIndirect, x, y)));
        }
      }
    };
    if (options_.full) {
      add(frame_rect_);
    } else {
      for (const PixelRect& block : blocks_) add(block);
    }
    return Quantile(std::move(luminance), kWhiteQuantile);
  }

  absl::Status RenderDpbgi() {
    const double target = report_.fpbgi.times.gather;
    RenderSettings settings = Settings(Integrator::kDpbgi, GatherLayers());
    FP_ASSIGN_OR_RETURN(
        report_.trials,
        SearchMicrobuffer(
            report_.pbgi.microbuffer, target, [&](uint32_t side) -> absl::StatusOr<double> {
              Say(absl::StrFormat("dpbgi, %dx%d buffers", side, side));
              settings.microbuffer = side;
              FP_ASSIGN_OR_RETURN(const auto renderer, Renderer(settings));
              FP_ASSIGN_OR_RETURN(const PaperTimes times, RenderBlocks(*renderer, nullptr));
              return times.gather;
            }));
    settings.microbuffer = NearestTrial(report_.trials, target).microbuffer;
    FP_ASSIGN_OR_RETURN(BlockRender sample, RenderSample(settings));
    PaperIntegrator& r = report_.dpbgi;
    r.integrator = Integrator::kDpbgi;
    r.microbuffer = settings.microbuffer;
    r.times = sample.times;
    r.crop_gather = r.times.gather;
    dpbgi_ = std::move(sample.film);
    if (options_.full) return absl::OkStatus();
    FP_ASSIGN_OR_RETURN(const Film crop, RenderCrop(settings, r.crop_gather));
    dpbgi_.Paste(crop);
    return absl::OkStatus();
  }

  double DisplaySquare(const Film& film, int x, int y) const {
    double sum = 0;
    for (int c = 0; c < 3; ++c) {
      const double a = film.Get(Layer::kIndirect, c, x, y),
                   b = pbgi_.Get(Layer::kIndirect, c, x, y);
      const double d =
          std::clamp(a / report_.white, 0.0, 1.0) - std::clamp(b / report_.white, 0.0, 1.0);
      sum += d * d;
    }
    return sum / 3;
  }

  PaperDifference DifferenceOf(const Film& film, const RgbImage& shown, const RgbImage& pbgi_shown,
                               const std::vector<uint8_t>& seen) const {
    PaperDifference d;
    d.crop_mse = MeanSquare(shown, pbgi_shown);
    d.crop_pdp = CountOf(seen);
    if (options_.full) {
      d.mse = d.crop_mse;
      return d;
    }
    std::vector<double> squares, pixels;
    for (const PixelRect& block : blocks_) {
      double sum = 0;
      for (int y = block.y0; y < block.y1; ++y) {
        for (int x = block.x0; x < block.x1; ++x) sum += DisplaySquare(film, x, y);
      }
      squares.push_back(sum);
      pixels.push_back(static_cast<double>(block.area()));
    }
    const TotalEstimate mean = EstimateTotal(squares, pixels, 1.0);
    d.mse = mean.total;
    d.mse_error = mean.error;
    return d;
  }

  absl::Status CompareWithPbgi() {
    Say("differences from pbgi");
    const PixelRect& rect = report_.compared;
    const RgbImage pbgi = Displayed(pbgi_, Layer::kIndirect, rect, report_.white);
    const std::string where = rect == frame_rect_
                                  ? std::string("the whole frame")
                                  : absl::StrFormat("pixels %d,%d to %d,%d of the frame", rect.x0,
                                                    rect.y0, rect.x1, rect.y1);
    std::vector<float> luminance;
    for (int y = 0; y < report_.height; ++y) {
      for (int x = 0; x < report_.width; ++x) {
        luminance.push_back(Luminance(ValueAt(fpbgi_, Layer::kBeauty, x, y)));
      }
    }
    double white = Quantile(luminance, kFrameWhiteQuantile);
    const double median = Quantile(std::move(luminance), 0.5);
    if (median > 0) white = std::min(white, kFrameWhiteMedians * median);
    report_.pictures.push_back(
        PictureOf(Displayed(fpbgi_, Layer::kBeauty, frame_rect_, white > 0 ? white : 1.0),
                  "fpbgi-frame", "fpbgi, the whole frame, direct and indirect light"));
    report_.pictures.push_back(PictureOf(
        pbgi, "pbgi", Concat({"pbgi, indirect light, ", where, "; white is its 99th percentile"})));
    const auto compare = [&](const Film& film, PaperIntegrator& r) {
      const std::string name(NameOf(r.integrator));
      const RgbImage shown = Displayed(film, Layer::kIndirect, rect, report_.white);
      const std::vector<uint8_t> seen = Seen(shown, pbgi, report_.width);
      r.difference = DifferenceOf(film, shown, pbgi, seen);
      const std::string figures =
          absl::StrFormat("MSE %.3g, PDP %d of %d pixels", r.difference->crop_mse,
                          r.difference->crop_pdp, rect.area());
      report_.pictures.push_back(PictureOf(
          shown, name, absl::StrFormat("%s, %d² buffers, the same pixels", name, r.microbuffer)));
      report_.pictures.push_back(
          DifferencePicture(shown, pbgi, name + "-difference",
                            absl::StrFormat("|%s − pbgi| × %g, linear; %s", name,
                                            static_cast<double>(kDifferenceScale), figures)));
      report_.pictures.push_back(SeenPicture(
          shown, seen, name + "-seen",
          Concat({name, ": perceptible differences from pbgi in blue (Yee 2004); ", figures})));
    };
    compare(fpbgi_, report_.fpbgi);
    compare(dpbgi_, report_.dpbgi);
    return absl::OkStatus();
  }

  // One pixel in each cell of 4x4 of each sampled block.
  std::vector<PixelPosition> ReferencePixels() const {
    std::vector<PixelPosition> pixels;
    for (const PixelRect& block : blocks_) {
      for (int y = block.y0; y < block.y1; y += kCellSide) {
        for (int x = block.x0; x < block.x1; x += kCellSide) {
          const int w = std::min(kCellSide, block.x1 - x), h = std::min(kCellSide, block.y1 - y);
          const uint64_t bits = HashKey(options_.seed, kKeyPixels, static_cast<uint64_t>(x),
                                        static_cast<uint64_t>(y));
          pixels.push_back({x + static_cast<int>(bits % static_cast<uint64_t>(w)),
                            y + static_cast<int>((bits >> 32) % static_cast<uint64_t>(h))});
        }
      }
    }
    return pixels;
  }

  absl::Status CompareWithTruth() {
    const std::vector<PixelPosition> pixels = ReferencePixels();
    Say(absl::StrFormat("pt at %d pixels", pixels.size()));
    SparseReferenceOptions options;
    options.noise = kReferenceNoise;
    options.budget_s = options_.reference_budget_s;
    options.direct_samples = 0;
    options.seed = options_.seed + kReferenceSeedOffset;
    FP_ASSIGN_OR_RETURN(const SparseReference truth,
                        TraceSparseReference(frame_, pixels, options, executor_, progress_));
    std::vector<Rgb> expected;
    for (size_t i = 0; i < pixels.size(); ++i) {
      if (truth.hit[i] != 0) expected.push_back(truth.Indirect(i));
    }
    report_.reference_pixels = expected.size();
    report_.reference_paths = uint64_t{truth.paths} * truth.rounds;
    report_.reference_seconds = truth.seconds;
    const double noise = truth.IndirectNoise();
    const auto compare = [&](const Film& film, PaperIntegrator& r) {
      std::vector<Rgb> values;
      for (size_t i = 0; i < pixels.size(); ++i) {
        if (truth.hit[i] != 0) {
          values.push_back(ValueAt(film, Layer::kIrradiance, pixels[i].x, pixels[i].y));
        }
      }
      r.truth = CompareSparse(values, expected, noise);
    };
    compare(pbgi_, report_.pbgi);
    compare(fpbgi_, report_.fpbgi);
    compare(dpbgi_, report_.dpbgi);
    return absl::OkStatus();
  }

  absl::Status RunSweep() {
    const RgbImage pbgi = Displayed(pbgi_crop_, Layer::kIndirect, report_.crop, report_.white);
    const Sweep sweep = SweepOf(options_.quick);
    for (const uint32_t k : sweep.clusters) {
      for (const float epsilon : sweep.epsilons) {
        Say(absl::StrFormat("fpbgi on the crop, k=%d ε=%g", k, Decimal(epsilon)));
        RenderSettings settings = Settings(Integrator::kFpbgi, GatherLayers());
        settings.clusters = k;
        settings.epsilon = epsilon;
        PaperSweepPoint point;
        point.clusters = k;
        point.epsilon = Decimal(epsilon);
        FP_ASSIGN_OR_RETURN(const Film film, RenderCrop(settings, point.gather));
        point.speed_up = point.gather > 0 ? report_.pbgi_crop_gather / point.gather : 0;
        const RgbImage shown = Displayed(film, Layer::kIndirect, report_.crop, report_.white);
        point.mse = MeanSquare(shown, pbgi);
        const std::vector<uint8_t> seen = Seen(shown, pbgi, report_.width);
        point.pdp = CountOf(seen);
        const bool is_default =
            k == report_.fpbgi.clusters && point.epsilon == report_.fpbgi.epsilon;
        if (is_default && !options_.full) report_.fpbgi.crop_gather = point.gather;
        const bool corner = (k == sweep.clusters.front() || k == sweep.clusters.back()) &&
                            (epsilon == sweep.epsilons.front() || epsilon == sweep.epsilons.back());
        if (corner) {
          report_.pictures.push_back(
              PictureOf(shown, absl::StrFormat("sweep-k%d-e%g", k, point.epsilon),
                        absl::StrFormat("fpbgi, k=%d ε=%g: MSE %.3g, PDP %d, speed-up %.3g", k,
                                        point.epsilon, point.mse, point.pdp, point.speed_up)));
        }
        report_.sweep.push_back(point);
      }
    }
    return absl::OkStatus();
  }

  const PaperOptions& options_;
  Executor& executor_;
  const std::function<void(std::string_view)>& progress_;
  PaperSceneReport report_;
  PixelRect frame_rect_;
  SparseFrame frame_;
  std::shared_ptr<const LoadedScene> loaded_;
  std::vector<PixelRect> blocks_;
  // Of the frame; pbgi's and dpbgi's are filled where they were rendered.
  Film fpbgi_, pbgi_, dpbgi_;
  Film pbgi_crop_;
};

}  // namespace

std::vector<PixelRect> SampleBlocks(int width, int height, unsigned count, uint64_t seed) {
  const int across = (width + kSampleSide - 1) / kSampleSide;
  const int down = (height + kSampleSide - 1) / kSampleSide;
  const uint64_t all = static_cast<uint64_t>(across) * static_cast<uint64_t>(down);
  std::set<uint64_t> chosen;  // ordered row by row
  if (count >= all) {
    for (uint64_t i = 0; i < all; ++i) chosen.insert(i);
  } else {
    const uint32_t scramble = static_cast<uint32_t>(HashKey(seed));
    for (uint32_t i = 0; chosen.size() < count; ++i) {
      const auto x = static_cast<uint64_t>(OwenSobol(i, 0, scramble) * static_cast<float>(across));
      const auto y = static_cast<uint64_t>(OwenSobol(i, 1, scramble) * static_cast<float>(down));
      chosen.insert(std::min<uint64_t>(y, static_cast<uint64_t>(down) - 1) *
                        static_cast<uint64_t>(across) +
                    std::min<uint64_t>(x, static_cast<uint64_t>(across) - 1));
    }
  }
  std::vector<PixelRect> blocks;
  for (const uint64_t i : chosen) {
    const int x = kSampleSide * static_cast<int>(i % static_cast<uint64_t>(across));
    const int y = kSampleSide * static_cast<int>(i / static_cast<uint64_t>(across));
    blocks.push_back({x, y, std::min(width, x + kSampleSide), std::min(height, y + kSampleSide)});
  }
  return blocks;
}

PixelRect MiddleCrop(int width, int height) {
  const auto whole = [](int first, int last, int limit) {
    return std::pair(first / kBlockSize * kBlockSize,
                     std::min(limit, (last + kBlockSize - 1) / kBlockSize * kBlockSize));
  };
  const auto [x0, x1] = whole(width * 3 / 8, std::max(width * 5 / 8, 1), width);
  const auto [y0, y1] = whole(height * 3 / 8, std::max(height * 5 / 8, 1), height);
  return {x0, y0, x1, y1};
}

TotalEstimate EstimateTotal(std::span<const double> value, std::span<const double> size,
                            double frame_size) {
  double values = 0, sizes = 0;
  for (size_t i = 0; i < value.size(); ++i) {
    values += value[i];
    sizes += size[i];
  }
  if (!(sizes > 0)) return {};
  const double ratio = values / sizes;
  const double n = static_cast<double>(value.size());
  if (value.size() < 2) return {ratio * frame_size, 0};
  double squares = 0;
  for (size_t i = 0; i < value.size(); ++i) {
    const double residual = value[i] - ratio * size[i];
    squares += residual * residual;
  }
  const double error = std::sqrt(squares * n / (n - 1)) / sizes;
  return {ratio * frame_size, error * frame_size};
}

absl::StatusOr<std::vector<DegradedTrial>> SearchMicrobuffer(
    uint32_t largest, double target, const std::function<absl::StatusOr<double>(uint32_t)>& time) {
  std::vector<DegradedTrial> trials;
  uint32_t low = 1, high = std::max<uint32_t>(1, largest);
  while (low <= high) {
    const uint32_t side = (low + high) / 2;
    FP_ASSIGN_OR_RETURN(const double gather, time(side));
    trials.push_back({side, gather});
    if (gather < target) {
      low = side + 1;
    } else {
      high = side - 1;
    }
  }
  std::sort(trials.begin(), trials.end(), [](const DegradedTrial& a, const DegradedTrial& b) {
    return a.microbuffer < b.microbuffer;
  });
  return trials;
}

const DegradedTrial& NearestTrial(std::span<const DegradedTrial> trials, double target) {
  const auto distance = [&](const DegradedTrial& t) {
    return t.gather > 0 && target > 0 ? std::fabs(std::log(t.gather / target))
                                      : std::fabs(t.gather - target);
  };
  return *std::min_element(
      trials.begin(), trials.end(),
      [&](const DegradedTrial& a, const DegradedTrial& b) { return distance(a) < distance(b); });
}

absl::StatusOr<PaperReport> RunPaper(const PaperOptions& asked,
                                     const std::function<void(std::string_view)>& progress) {
  PaperReport report;
  report.options = InForce(asked);
  const PaperOptions& options = report.options;
  report.date_utc = DateUtc();
  report.cpu = CpuModel();
  Executor executor(options.threads);
  report.threads = executor.threads();
  std::vector<const PaperScene*> scenes;
  if (options.scene.empty()) {
    for (const PaperScene& scene : PaperScenes()) scenes.push_back(&scene);
  } else {
    FP_ASSIGN_OR_RETURN(const PaperScene* scene, FindPaperScene(options.scene));
    scenes.push_back(scene);
  }
  for (const PaperScene* scene : scenes) {
    std::string missing;
    FP_ASSIGN_OR_RETURN(std::optional<PaperView> view,
                        LoadPaperScene(*scene, options.scenes_dir, options.quick, missing));
    if (!view) {
      if (!options.scene.empty()) return absl::NotFoundError(missing);
      progress(Concat({scene->name, " is left out: ", missing}));
      report.left_out.push_back({std::string(scene->name), missing});
      continue;
    }
    FP_ASSIGN_OR_RETURN(PaperSceneReport result,
                        SceneRun(options, *scene, executor, progress).Run(*std::move(view)));
    report.scenes.push_back(std::move(result));
  }
  report.peak_rss_bytes = PeakRssBytes();
  return report;
}

}  // namespace farpoint

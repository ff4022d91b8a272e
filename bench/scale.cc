#include "bench/scale.h"

#include <algorithm>
#include <array>
#include <chrono>
#include <cstdio>
#include <fstream>
#include <map>
#include <utility>

#include "absl/strings/str_format.h"
#include "bench/accuracy_frame.h"
#include "bench/machine.h"
#include "bench/paper_scenes.h"
#include "bench/sparse_reference.h"
#include "bench/text.h"
#include "core/base/executor.h"
#include "core/image/film.h"
#include "core/render/bake.h"
#include "core/render/frame_renderer.h"

namespace farpoint {

namespace {

constexpr uint64_t kPixelSeed = 0x7363616c65ull;
constexpr uint64_t kReferenceSeed = 0x747275746880ull;
constexpr double kReferenceNoise = 0.01;
constexpr std::array kClusterStages = {Stage::kCluster, Stage::kCut, Stage::kRaster, Stage::kTrace};
constexpr std::array kPreparationStages = {Stage::kSample, Stage::kShade, Stage::kTree};

ScaleOptions InForce(ScaleOptions o) {
  const bool quick = o.quick;
  if (o.width == 0) {
    o.width = quick ? 64 : 1280;
    o.height = quick ? 64 : 1000;
  }
  if (o.points == 0) o.points = quick ? 2'000 : 1'000'000;
  if (o.reference_pixels == 0) o.reference_pixels = quick ? 16 : 1500;
  if (!(o.reference_budget_s > 0)) o.reference_budget_s = quick ? 0.5 : 60;
  if (o.repeat == 0) o.repeat = quick ? 1 : 3;
  return o;
}

// Bytes after "Name:" in /proc/self/status, which counts KiB.
std::optional<uint64_t> StatusBytes(std::string_view name) {
  std::ifstream file("/proc/self/status");
  for (std::string line; std::getline(file, line);) {
    unsigned long long kib = 0;
    if (line.starts_with(name) && std::sscanf(line.c_str() + name.size(), ": %llu", &kib) == 1) {
      return static_cast<uint64_t>(kib) * 1024;
    }
  }
  return std::nullopt;
}

// How much more than now the process holds at most, until it is asked.
class PeakMemory {
 public:
  PeakMemory() {
    std::ofstream reset("/proc/self/clear_refs");
    reset << "5" << std::flush;  // proc(5): resets the peak to what is held now
    if (reset) start_ = StatusBytes("VmRSS");
  }
  std::optional<uint64_t> Bytes() const {
    const std::optional<uint64_t> peak = StatusBytes("VmHWM");
    if (!start_ || !peak) return std::nullopt;
    return *peak - std::min(*peak, *start_);
  }

 private:
  std::optional<uint64_t> start_;
};

// A scene as the files say, or the error that says which is missing.
absl::StatusOr<PaperView> LoadScene(ScaleOptions& options, std::vector<std::string>& notes) {
  std::vector<std::string> names = {options.scene};
  if (options.scene.empty()) {
    names = options.quick ? std::vector<std::string>{"city"}
                          : std::vector<std::string>{"sponza", "city"};
  }
  std::string missing;
  for (const std::string& name : names) {
    FP_ASSIGN_OR_RETURN(const PaperScene* scene, FindPaperScene(name));
    FP_ASSIGN_OR_RETURN(std::optional<PaperView> view,
                        LoadPaperScene(*scene, options.scenes_dir, options.quick, missing));
    if (view) {
      options.scene = name;
      notes.insert(notes.end(), view->notes.begin(), view->notes.end());
      return *std::move(view);
    }
    notes.push_back(missing);
  }
  return absl::InvalidArgumentError(missing + "; name its folder with --scenes");
}

class ScaleRun {
 public:
  ScaleRun(ScaleReport& report, const PaperView& view,
           const std::function<void(std::string_view)>& progress)
      : report_(report), options_(report.options), view_(view), progress_(progress) {
    for (const int part : {4, 2, 1}) {
      const int w = options_.width / part, h = options_.height / part;
      films_.push_back({w, h, {0, 0, w, h}});
    }
  }

  absl::Status Run(Executor& all, Executor& one) {
    for (const uint64_t factor : {1u, 4u, 16u}) {
      FP_ASSIGN_OR_RETURN(const BakedScene baked, BakeOnce(factor * options_.points, all));
      const bool fewest = factor == 1;
      for (size_t f = 0; f < films_.size(); ++f) {
        if (fewest || f == kMiddle) {
          FP_RETURN_IF_ERROR(Render(baked, films_[f], factor * options_.points, all));
        }
      }
      if (!fewest || all.threads() == 1) continue;
      FP_RETURN_IF_ERROR(BakeOnce(options_.points, one).status());
      FP_RETURN_IF_ERROR(Render(baked, films_[kMiddle], options_.points, one));
    }
    return CheckBits();
  }

 private:
  static constexpr size_t kMiddle = 1;

  RenderSettings Settings(uint64_t points) const {
    RenderSettings s;
    s.points = points;
    s.quality = options_.quality;
    s.clusters = options_.clusters;
    s.light_samples = options_.light_samples;
    s.seed = options_.seed;
    s.layers = {Layer::kIrradiance};
    return s;
  }

  absl::StatusOr<BakedScene> BakeOnce(uint64_t points, Executor& executor) {
    progress_(absl::StrFormat("baking %d surfels, %d threads", points, executor.threads()));
    ScaleBake& row = report_.bakes.emplace_back();
    row.points = points;
    row.threads = executor.threads();
    Stats stats;
    const PeakMemory memory;
    FP_ASSIGN_OR_RETURN(BakedScene baked, Bake(view_.scene, Settings(points), executor, stats));
    row.peak_bytes = memory.Bytes();
    row.triangles = stats.counts["triangles"];
    row.surfels = stats.counts["surfels"];
    row.nodes = stats.counts["nodes"];
    row.seconds = stats.seconds;
    row.wall_seconds = stats.wall_seconds;
    row.scene_bytes = stats.bytes["scene"];
    row.tree_bytes = stats.bytes["tree"];
    row.tree_hash = baked.tree_topology.Hash().Hex() + baked.tree_radiance.Hash().Hex();
    return baked;
  }

  absl::Status Render(const BakedScene& baked, const FilmSpec& film, uint64_t points,
                      Executor& executor) {
    ScaleFrame row;
    row.width = film.width;
    row.height = film.height;
    row.points = points;
    row.threads = executor.threads();
    const RenderSettings settings = Settings(points);
    std::vector<double> gather, per_cluster, wall;
    std::array<std::vector<double>, kStageCount> stage;
    for (unsigned repeat = 0; repeat < options_.repeat; ++repeat) {
      progress_(absl::StrFormat("%dx%d, %d surfels, %d threads: render %d of %d", film.width,
                                film.height, points, executor.threads(), repeat + 1,
                                options_.repeat));
      SparseFrame frame;
      frame.prepared_scene = baked.prepared_scene.Hash();
      FP_ASSIGN_OR_RETURN(frame.scene, LoadedScene::Load(baked, executor));
      frame.camera = view_.camera;
      frame.film = film;
      {
        // What is made for the first tile of a scene is made: where the surfels lie.
        FP_ASSIGN_OR_RETURN(
            const auto first,
            FrameRenderer::Create(frame.scene, FrameSpec{frame.camera, film, settings}));
        FP_RETURN_IF_ERROR(first->RenderTile({0, 0, 1, 1}, executor, {}, nullptr).status());
      }
      const auto start = std::chrono::steady_clock::now();
      FP_ASSIGN_OR_RETURN(RenderedFrame rendered, RenderByTiles(frame, settings, executor));
      wall.push_back(
          std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count());
      gather.push_back(GatherSeconds(rendered.stats));
      per_cluster.push_back(SumOf(rendered.stats.seconds, kClusterStages));
      for (size_t i = 0; i < stage.size(); ++i) stage[i].push_back(rendered.stats.seconds[i]);
      const std::string hash = LayerHash(rendered.film, Layer::kIrradiance).Hex();
      if (repeat > 0 && hash != row.hash) {
        return absl::InternalError("two renders of one frame differ; this is a defect of farpoint");
      }
      row.hash = hash;
      if (repeat > 0) continue;
      row.receivers = rendered.stats.counts["receivers"];
      row.clusters = rendered.stats.counts["clusters"];
      row.rays = rendered.stats.counts["rays"];
      row.node_visits = rendered.stats.counts["node_visits"];
      FP_RETURN_IF_ERROR(Measure(frame, rendered.film, executor, row));
    }
    row.gather = SpreadOf(gather);
    row.per_cluster = SpreadOf(per_cluster);
    row.wall = SpreadOf(wall);
    for (size_t i = 0; i < stage.size(); ++i) row.stage[i] = SpreadOf(stage[i]);
    report_.frames.push_back(std::move(row));
    return absl::OkStatus();
  }

  struct Truth {
    std::vector<PixelPosition> pixels;
    SparseReference reference;
  };
  // The truth of a frame does not depend on surfels.
  absl::Status Measure(const SparseFrame& frame, const Film& film, Executor& executor,
                       ScaleFrame& row) {
    Truth& truth = truths_[frame.film.width];
    if (truth.pixels.empty()) {
      truth.pixels = StratifiedPixels(frame.film.crop, options_.reference_pixels, kPixelSeed);
      SparseReferenceOptions reference;
      reference.noise = kReferenceNoise;
      reference.budget_s = options_.reference_budget_s;
      reference.direct_samples = 0;
      reference.seed = kReferenceSeed;
      reference.cache_dir = options_.reference_dir;
      reference.label = absl::StrFormat("scale-%s-%d", options_.scene, frame.film.width);
      FP_ASSIGN_OR_RETURN(truth.reference, TraceSparseReference(frame, truth.pixels, reference,
                                                                executor, progress_));
    }
    std::vector<Rgb> image, expected;
    const std::vector<Rgb> all = ValuesAt(film, Layer::kIrradiance, truth.pixels);
    for (size_t i = 0; i < all.size(); ++i) {
      if (truth.reference.hit[i] == 0) continue;
      image.push_back(all[i]);
      expected.push_back(truth.reference.Indirect(i));
    }
    row.error = CompareSparse(image, expected, truth.reference.IndirectNoise());
    return absl::OkStatus();
  }

  // Threads must change nothing.
  absl::Status CheckBits() const {
    for (const ScaleBake& a : report_.bakes) {
      for (const ScaleBake& b : report_.bakes) {
        if (a.points == b.points && a.tree_hash != b.tree_hash) {
          return absl::InternalError(
              "bakes by different numbers of threads differ; this is a defect of farpoint");
        }
      }
    }
    for (const ScaleFrame& a : report_.frames) {
      for (const ScaleFrame& b : report_.frames) {
        if (a.points == b.points && a.width == b.width && a.hash != b.hash) {
          return absl::InternalError(
              "renders by different numbers of threads differ; this is a defect of farpoint");
        }
      }
    }
    return absl::OkStatus();
  }

  ScaleReport& report_;
  const ScaleOptions& options_;
  const PaperView& view_;
  const std::function<void(std::string_view)>& progress_;
  std::vector<FilmSpec> films_;  // from small to large
  std::map<int, Truth> truths_;  // by width
};

double Ratio(double to, double from) { return from > 0 ? to / from : 0; }

}  // namespace

double ScaleBake::thread_s() const { return SumOf(seconds, kPreparationStages); }
double ScaleBake::wall_s() const { return SumOf(wall_seconds, kPreparationStages); }
double ScaleBake::bytes_per_surfel() const {
  return surfels > 0 ? static_cast<double>(tree_bytes) / static_cast<double>(surfels) : 0;
}

std::vector<ScaleGrowth> GrowthOf(const ScaleReport& report) {
  std::vector<ScaleGrowth> growth;
  if (report.frames.empty() || report.bakes.empty()) return growth;
  const unsigned threads = report.bakes.front().threads;
  const uint64_t points = report.bakes.front().points;
  const auto frame_ratios = [](const ScaleFrame& from, const ScaleFrame& to, ScaleGrowth& g) {
    g.per_cluster = Ratio(to.per_cluster.median, from.per_cluster.median);
    g.gather = Ratio(to.gather.median, from.gather.median);
  };
  // Pixels: frames of the fewest surfels, in their order.
  std::vector<const ScaleFrame*> sizes, counts;
  for (const ScaleFrame& f : report.frames) {
    if (f.threads == threads && f.points == points) sizes.push_back(&f);
  }
  const auto name = [](const ScaleFrame& f) { return absl::StrFormat("%dx%d", f.width, f.height); };
  for (size_t i = 0; i + 1 < sizes.size(); ++i) {
    ScaleGrowth& g = growth.emplace_back();
    g.axis = "pixels";
    g.from = name(*sizes[i]);
    g.to = name(*sizes[i + 1]);
    g.factor = Ratio(static_cast<double>(sizes[i + 1]->width) * sizes[i + 1]->height,
                     static_cast<double>(sizes[i]->width) * sizes[i]->height);
    frame_ratios(*sizes[i], *sizes[i + 1], g);
  }
  if (sizes.size() < 2) return growth;
  const ScaleFrame& middle = *sizes[1];
  const auto bake_of = [&](uint64_t n, unsigned t) -> const ScaleBake* {
    for (const ScaleBake& b : report.bakes) {
      if (b.points == n && b.threads == t) return &b;
    }
    return nullptr;
  };
  const ScaleBake& fewest = report.bakes.front();
  for (const ScaleFrame& f : report.frames) {
    if (f.width != middle.width || &f == &middle) continue;
    const ScaleBake* bake = bake_of(f.points, f.threads);
    if (f.threads == threads && f.points != points) {
      ScaleGrowth& g = growth.emplace_back();
      g.axis = "surfels";
      g.from = std::to_string(points);
      g.to = std::to_string(f.points);
      g.factor = Ratio(static_cast<double>(f.points), static_cast<double>(points));
      frame_ratios(middle, f, g);
      if (bake != nullptr) g.preparation = Ratio(bake->thread_s(), fewest.thread_s());
    } else if (f.threads == 1 && f.points == points) {
      ScaleGrowth& g = growth.emplace_back();
      g.axis = "threads";
      g.from = "1";
      g.to = std::to_string(threads);
      g.factor = threads;
      frame_ratios(f, middle, g);
      if (bake != nullptr) g.preparation = Ratio(fewest.thread_s(), bake->thread_s());
    }
  }
  return growth;
}

absl::StatusOr<ScaleReport> RunScale(const ScaleOptions& asked,
                                     const std::function<void(std::string_view)>& progress) {
  ScaleReport report;
  report.options = InForce(asked);
  ScaleOptions& options = report.options;
  if (options.width % 4 != 0 || options.height % 4 != 0) {
    return absl::InvalidArgumentError(
        absl::StrFormat("--resolution %dx%d: width and height must be multiples of 4, as frames "
                        "of half and a quarter of them are rendered, too",
                        options.width, options.height));
  }
  FP_RETURN_IF_ERROR(
      ValidateFilm({options.width, options.height, {0, 0, options.width, options.height}}));
  Executor all(options.threads), one(1);
  options.threads = all.threads();
  report.date_utc = DateUtc();
  report.cpu = CpuModel();
  report.load_average_start = LoadAverage();
  progress("reading the scene");
  FP_ASSIGN_OR_RETURN(const PaperView view, LoadScene(options, report.notes));
  FP_RETURN_IF_ERROR(ScaleRun(report, view, progress).Run(all, one));
  report.growth = GrowthOf(report);
  report.load_average_end = LoadAverage();
  return report;
}

}  // namespace farpoint

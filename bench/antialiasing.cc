#include "bench/antialiasing.h"

#include <algorithm>
#include <cmath>
#include <filesystem>
#include <map>
#include <nlohmann/json.hpp>
#include <utility>

#include "absl/strings/str_format.h"
#include "bench/accuracy_frame.h"
#include "bench/machine.h"
#include "bench/sample_truth.h"
#include "bench/text.h"
#include "core/image/png_io.h"

namespace farpoint {

namespace {

using Json = nlohmann::ordered_json;

constexpr uint64_t kPixelSeed = 20130715;
constexpr uint64_t kTruthSeed = 0x9e3779b97f4a7c15ull;
constexpr int kPartWidth = 96, kPartHeight = 72, kTimes = 3;
constexpr uint32_t kPictureSpp = 16;

double Median(std::vector<double> values) {
  if (values.empty()) return 0;
  std::sort(values.begin(), values.end());
  const size_t middle = values.size() / 2;
  return values.size() % 2 == 1 ? values[middle] : 0.5 * (values[middle - 1] + values[middle]);
}

// Of all pixels that hit, or of those that show an edge relative to the mean of all.
ErrorFigures Compare(std::span<const Rgb> image, const SampleTruth& truth,
                     const std::array<std::vector<Rgb>, 2>& halves, bool edges_only) {
  std::vector<Rgb> a, t, half[2];
  double mean = 0, part_mean = 0;
  size_t hits = 0;
  for (size_t i = 0; i < image.size(); ++i) {
    if (truth.hit[i] == 0) continue;
    const Rgb m = (halves[0][i] + halves[1][i]) * 0.5f;
    const double grey =
        (static_cast<double>(m.x) + static_cast<double>(m.y) + static_cast<double>(m.z)) / 3;
    mean += grey;
    ++hits;
    if (edges_only && truth.edge[i] == 0) continue;
    part_mean += grey;
    a.push_back(image[i]);
    t.push_back(m);
    for (size_t h = 0; h < 2; ++h) half[h].push_back(halves[h][i]);
  }
  const std::vector<uint8_t> on(a.size(), 1);
  ErrorFigures figures = CompareSparse(a, t, NoiseOfHalves(on, half[0], half[1]));
  // Below the truth's noise the error of the difference says nothing.
  if (!(figures.rr > 0)) figures.rr_error = 0;
  if (!edges_only || hits == 0 || !(mean > 0)) return figures;
  const double scale =
      part_mean / static_cast<double>(a.size()) / (mean / static_cast<double>(hits));
  for (double* v : {&figures.rel_rmse, &figures.rr, &figures.rr_error, &figures.bias,
                    &figures.bias_error, &figures.max, &figures.noise}) {
    *v *= scale;
  }
  return figures;
}

// The window of the frame with most pixels that show an edge, from all windows of a grid.
PixelRect PartWithEdges(const SparseFrame& frame, const RenderSettings& settings,
                        Executor& executor) {
  const PixelRect& all = frame.film.crop;
  const int width = std::min(kPartWidth, all.width()), height = std::min(kPartHeight, all.height());
  std::vector<PixelPosition> pixels;
  for (int y = all.y0; y < all.y1; ++y) {
    for (int x = all.x0; x < all.x1; ++x) pixels.push_back({x, y});
  }
  const std::vector<uint8_t> edge = EdgePixels(frame, settings, pixels, executor);
  PixelRect best{all.x0, all.y0, all.x0 + width, all.y0 + height};
  size_t most = 0;
  for (int y0 = all.y0; y0 + height <= all.y1; y0 += 16) {
    for (int x0 = all.x0; x0 + width <= all.x1; x0 += 16) {
      size_t count = 0;
      for (int y = y0; y < y0 + height; ++y) {
        for (int x = x0; x < x0 + width; ++x) {
          count += edge[static_cast<size_t>(y - all.y0) * static_cast<size_t>(all.width()) +
                        static_cast<size_t>(x - all.x0)];
        }
      }
      // Of a window that is nothing but edges, no edge is seen.
      if (count > static_cast<size_t>(width) * static_cast<size_t>(height) / 2) continue;
      if (count > most) {
        most = count;
        best = {x0, y0, x0 + width, y0 + height};
      }
    }
  }
  return best;
}

class Runner {
 public:
  Runner(const AntialiasingOptions& options, std::string folder,
         const std::function<void(std::string_view)>& progress, AntialiasingReport& report)
      : options_(options),
        folder_(std::move(folder)),
        progress_(progress),
        report_(report),
        executor_(options.threads) {
    report_.threads = executor_.threads();
  }

  absl::Status Run(const AccuracyCase& c) {
    progress_(Concat({c.name, ": loading and baking"}));
    std::string missing;
    FP_ASSIGN_OR_RETURN(std::optional<AccuracyScene> source,
                        LoadAccuracyScene(c, options_.folders, options_.quick, missing));
    if (!source) {
      report_.left_out.push_back({c.name, missing});
      return absl::OkStatus();
    }
    AccuracyCase scaled = c;
    scaled.width = std::max(1, static_cast<int>(std::lround(c.width * options_.scale)));
    scaled.height = std::max(1, static_cast<int>(std::lround(c.height * options_.scale)));
    RenderSettings settings;
    settings.quality = options_.quality;
    settings.points = options_.points;
    settings.light_samples = options_.light_samples;
    settings.seed = options_.seed;
    settings.layers = {Layer::kBeauty, Layer::kDepth, Layer::kIrradiance};
    FP_ASSIGN_OR_RETURN(LoadedFrame loaded, LoadFrame(source->scene, source->camera, scaled.width,
                                                      scaled.height, settings, nullptr, executor_));
    AntialiasingScene scene;
    scene.name = c.name;
    scene.command = CommandOf(scaled);
    scene.width = scaled.width;
    scene.height = scaled.height;
    scene.surfels = loaded.bake.counts["surfels"];
    const std::vector<PixelPosition> pixels =
        StratifiedPixels(loaded.frame.film.crop, options_.reference_pixels, kPixelSeed);

    std::vector<std::vector<double>> gather(options_.spp.size()), ratio(options_.spp.size());
    std::vector<std::vector<double>> trace(options_.spp.size()), direct(options_.spp.size());
    std::vector<std::vector<double>> primary(options_.spp.size());
    std::vector<std::vector<double>> carried(options_.spp.size()), alone(options_.spp.size());
    std::map<uint32_t, Film> films;
    // What a scene's first image makes for all: the surfels' texels. Not measured.
    settings.spp = std::min(4u, options_.spp.back());
    progress_(c.name + ": warming up");
    FP_RETURN_IF_ERROR(RenderByTiles(loaded.frame, settings, executor_).status());
    for (uint32_t round = 0; round < options_.repeat; ++round) {
      for (size_t k = 0; k < options_.spp.size(); ++k) {
        settings.spp = options_.spp[k];
        progress_(absl::StrFormat("%s: %d samples, round %d", c.name, settings.spp, round + 1));
        FP_ASSIGN_OR_RETURN(RenderedFrame rendered,
                            RenderByTiles(loaded.frame, settings, executor_));
        const auto seconds = [&](Stage stage) {
          return rendered.stats.seconds[static_cast<size_t>(stage)];
        };
        gather[k].push_back(GatherSeconds(rendered.stats));
        trace[k].push_back(seconds(Stage::kTrace));
        direct[k].push_back(seconds(Stage::kDirect));
        primary[k].push_back(seconds(Stage::kPrimary));
        if (gather[0].back() > 0) ratio[k].push_back(gather[k].back() / gather[0].back());
        Film occlusion[2];
        for (size_t i = 0; i < 2 && options_.occlusion; ++i) {
          RenderSettings asked = settings;
          if (i == 1) asked.layers.clear();
          asked.layers.push_back(Layer::kAmbientOcclusion);
          FP_ASSIGN_OR_RETURN(RenderedFrame with, RenderByTiles(loaded.frame, asked, executor_));
          if (gather[k].back() > 0) {
            (i == 0 ? carried : alone)[k].push_back(GatherSeconds(with.stats) / gather[k].back());
          }
          occlusion[i] = std::move(with.film);
        }
        if (round > 0) continue;
        AntialiasingRow row;
        row.spp = settings.spp;
        row.receivers = rendered.stats.counts["receivers"];
        row.sample_records = rendered.stats.counts["clusters_of_samples"];
        row.records = rendered.stats.counts["clusters"] - row.sample_records;
        row.gather_rays = rendered.stats.counts["gather_rays"];
        FP_ASSIGN_OR_RETURN(const SampleTruth truth,
                            TraceSampleTruth(loaded.frame, settings, pixels, options_.paths,
                                             kTruthSeed, executor_, options_.occlusion));
        const std::vector<Rgb> image = ValuesAt(rendered.film, Layer::kIrradiance, pixels);
        row.all = Compare(image, truth, truth.half, false);
        row.edges = Compare(image, truth, truth.half, true);
        const auto grey = [&](const Film& film) {
          std::vector<Rgb> values;
          for (const PixelPosition& p : pixels) {
            values.emplace_back(film.Get(Layer::kAmbientOcclusion, 0, p.x, p.y));
          }
          return values;
        };
        if (options_.occlusion) {
          row.carried = Compare(grey(occlusion[0]), truth, truth.occlusion_half, false);
          row.alone = Compare(grey(occlusion[1]), truth, truth.occlusion_half, false);
        }
        scene.rows.push_back(std::move(row));
        films.emplace(settings.spp, std::move(rendered.film));
      }
    }
    for (size_t k = 0; k < scene.rows.size(); ++k) {
      scene.rows[k].gather_s = Median(gather[k]);
      scene.rows[k].trace_s = Median(trace[k]);
      scene.rows[k].direct_s = Median(direct[k]);
      scene.rows[k].primary_s = Median(primary[k]);
      scene.rows[k].ratio = Median(ratio[k]);
      scene.rows[k].carried_ratio = Median(carried[k]);
      scene.rows[k].alone_ratio = Median(alone[k]);
    }
    if (options_.pictures) FP_RETURN_IF_ERROR(Draw(scene, loaded.frame, settings, films));
    report_.scenes.push_back(std::move(scene));
    return absl::OkStatus();
  }

 private:
  absl::Status Draw(const AntialiasingScene& scene, const SparseFrame& frame,
                    RenderSettings settings, const std::map<uint32_t, Film>& films) {
    settings.spp = 1;
    const PixelRect part = PartWithEdges(frame, settings, executor_);
    progress_(Concat({scene.name, ": path tracing the part that is shown"}));
    settings.integrator = Integrator::kPt;
    settings.spp = options_.quick ? 4 : kPictureSpp;
    settings.paths = std::max(8u, options_.paths / settings.spp);
    SparseFrame cropped = frame;
    cropped.film.crop = part;
    FP_ASSIGN_OR_RETURN(const RenderedFrame traced, RenderByTiles(cropped, settings, executor_));
    const float white = LuminanceQuantile(traced.film, Layer::kBeauty, 0.9);
    if (!(white > 0)) return absl::OkStatus();
    std::vector<Picture> pictures;
    for (const auto& [spp, film] : films) {
      if (spp > kPictureSpp) continue;
      pictures.push_back(Enlarged(ColourPicture(film, Layer::kBeauty, white), part, kTimes));
    }
    pictures.push_back(Enlarged(ColourPicture(traced.film, Layer::kBeauty, white),
                                {0, 0, part.width(), part.height()}, kTimes));
    const Picture row = SideBySide(pictures);
    report_.files.push_back(scene.name + "-edges.png");
    return WritePng((std::filesystem::path(folder_) / report_.files.back()).string(), row.width,
                    row.height, row.rgb);
  }

  const AntialiasingOptions& options_;
  const std::string folder_;
  const std::function<void(std::string_view)>& progress_;
  AntialiasingReport& report_;
  Executor executor_;
};

Json FiguresJson(const ErrorFigures& f) {
  return {{"pixels", f.pixels},     {"mean", f.mean},  {"rr", f.rr},
          {"rr_error", f.rr_error}, {"bias", f.bias},  {"bias_error", f.bias_error},
          {"max", f.max},           {"noise", f.noise}};
}

}  // namespace

std::vector<std::string> AntialiasingNames(bool quick) {
  if (quick) return {"cornell", "city"};
  return {"cornell", "sponza-sun", "coffee", "city"};
}

absl::StatusOr<AntialiasingReport> RunAntialiasing(
    const AntialiasingOptions& options, const std::string& folder,
    const std::function<void(std::string_view)>& progress) {
  AntialiasingReport report;
  report.options = options;
  AntialiasingOptions& o = report.options;
  if (o.cases.empty()) o.cases = AntialiasingNames(o.quick);
  if (o.spp.empty())
    o.spp = o.quick ? std::vector<uint32_t>{1, 4} : std::vector<uint32_t>{1, 4, 16, 64};
  if (o.quick) {
    o.reference_pixels = std::min<size_t>(o.reference_pixels, 64);
    o.paths = std::min(o.paths, 256u);
    if (o.points == 0) o.points = 20000;
  }
  std::sort(o.spp.begin(), o.spp.end());
  o.spp.erase(std::unique(o.spp.begin(), o.spp.end()), o.spp.end());
  if (o.spp.front() != 1) o.spp.insert(o.spp.begin(), 1);
  if (!(o.scale > 0) || o.scale > 4 || o.repeat == 0 || o.spp.back() > 256) {
    return absl::InvalidArgumentError(
        "antialiasing: the scale lies in (0, 4], samples in 1..256, and there is one round at "
        "least");
  }
  std::vector<AccuracyCase> cases;
  for (const std::string& name : o.cases) {
    FP_ASSIGN_OR_RETURN(AccuracyCase c, FindAccuracyCase(name, o.quick));
    // Its published truth is of one sample; the own scene is the same box.
    if (c.truth == TruthKind::kPublished) c.scene = "cornell";
    c.truth = TruthKind::kTraced;
    cases.push_back(std::move(c));
  }
  report.date_utc = DateUtc();
  report.cpu = CpuModel();
  report.load_average_start = LoadAverage();
  Runner runner(o, folder, progress, report);
  for (const AccuracyCase& c : cases) FP_RETURN_IF_ERROR(runner.Run(c));
  report.load_average_end = LoadAverage();
  return report;
}

std::string AntialiasingTable(const AntialiasingReport& r) {
  std::string text =
      Concat({MachineText(r.cpu, r.threads, r.load_average_start, r.load_average_end), "\n\n"});
  text += absl::StrFormat("%-16s%5s %8s %8s %9s %10s %11s %8s %16s %8s %8s %16s %8s\n", "scene",
                          "spp", "gather,s", "trace,s", "ratio", "records", "of samples", "rays/px",
                          "rr", "bias", "noise", "rr at edges", "pixels");
  for (const AntialiasingScene& s : r.scenes) {
    const double pixels = static_cast<double>(s.width) * s.height;
    for (const AntialiasingRow& row : s.rows) {
      text += absl::StrFormat(
          "%-16s%5d %8.2f %8.2f %9.2f %10d %11d %8.0f %8.4f ±%6.4f %+8.4f %8.4f %8.4f ±%6.4f %8d\n",
          s.name, row.spp, row.gather_s, row.trace_s, row.ratio, row.records, row.sample_records,
          static_cast<double>(row.gather_rays) / pixels, row.all.rr, row.all.rr_error, row.all.bias,
          row.all.noise, row.edges.rr, row.edges.rr_error, row.edges.pixels);
    }
  }
  if (r.options.occlusion) {
    text +=
        absl::StrFormat("\nambient occlusion\n%-16s%5s %8s %18s %8s %8s %18s %8s %8s\n", "scene",
                        "spp", "mean", "carried: rr", "bias", "time", "alone: rr", "bias", "time");
    for (const AntialiasingScene& s : r.scenes) {
      for (const AntialiasingRow& row : s.rows) {
        text += absl::StrFormat(
            "%-16s%5d %8.4f %9.4f ±%7.4f %+8.4f %8.2f %9.4f ±%7.4f %+8.4f %8.2f  (noise %.4f)\n",
            s.name, row.spp, row.carried.mean, row.carried.rr, row.carried.rr_error,
            row.carried.bias, row.carried_ratio, row.alone.rr, row.alone.rr_error, row.alone.bias,
            row.alone_ratio, row.alone.noise);
      }
    }
  }
  for (const LeftOut& out : r.left_out) Append(text, {"left out: ", out.name, ": ", out.why, "\n"});
  return text;
}

std::string AntialiasingJson(const AntialiasingReport& r) {
  Json scenes = Json::array();
  for (const AntialiasingScene& s : r.scenes) {
    Json rows = Json::array();
    for (const AntialiasingRow& row : s.rows) {
      rows.push_back({{"spp", row.spp},
                      {"receivers", row.receivers},
                      {"clusters", row.records},
                      {"clusters_of_samples", row.sample_records},
                      {"gather_rays", row.gather_rays},
                      {"seconds",
                       {{"gather", row.gather_s},
                        {"trace", row.trace_s},
                        {"direct", row.direct_s},
                        {"primary", row.primary_s}}},
                      {"ratio", row.ratio},
                      {"irradiance", FiguresJson(row.all)},
                      {"irradiance_at_edges", FiguresJson(row.edges)}});
      if (!r.options.occlusion) continue;
      rows.back()["occlusion_carried"] = FiguresJson(row.carried);
      rows.back()["occlusion_alone"] = FiguresJson(row.alone);
      rows.back()["occlusion_ratio"] = {{"carried", row.carried_ratio}, {"alone", row.alone_ratio}};
    }
    scenes.push_back(
        {{"name", s.name}, {"command", s.command}, {"surfels", s.surfels}, {"rows", rows}});
  }
  Json left_out = Json::array();
  for (const LeftOut& out : r.left_out) left_out.push_back({{"name", out.name}, {"why", out.why}});
  const Json json = {
      {"benchmark", "antialiasing"},
      {"version", FARPOINT_VERSION},
      {"date_utc", r.date_utc},
      {"quick", r.options.quick},
      {"machine",
       {{"cpu", r.cpu},
        {"threads", r.threads},
        {"load_average", {{"start", r.load_average_start}, {"end", r.load_average_end}}}}},
      {"settings",
       {{"quality", std::string(NameOf(r.options.quality))},
        {"points", r.options.points},
        {"light_samples", r.options.light_samples},
        {"seed", r.options.seed},
        {"paths", r.options.paths},
        {"reference_pixels", r.options.reference_pixels},
        {"repeat", r.options.repeat}}},
      {"scenes", scenes},
      {"left_out", left_out},
      {"files", r.files},
  };
  return json.dump(2) + "\n";
}

}  // namespace farpoint

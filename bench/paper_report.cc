#include "bench/paper_report.h"

#include <array>
#include <nlohmann/json.hpp>
#include <utility>
#include <vector>

#include "absl/strings/str_format.h"
#include "bench/accuracy_frame.h"
#include "bench/html_page.h"
#include "bench/svg_plot.h"
#include "bench/text.h"

namespace farpoint {

namespace {

using Json = nlohmann::ordered_json;

// Told apart in most kinds of colour blindness (Okabe and Ito).
constexpr std::array kColors = {"#0072b2", "#e69f00", "#009e73", "#cc79a7", "#d55e00", "#56b4e9"};

double At(const PaperTimes& times, Stage stage) {
  return times.seconds[static_cast<size_t>(stage)];
}
double Ratio(double a, double b) { return b > 0 ? a / b : 0; }

double Shared(const PaperSceneReport& s) { return s.primary_s + s.direct_s; }
double Total(const PaperSceneReport& s, const PaperIntegrator& r) {
  return Shared(s) + r.times.gather;
}
double Preparation(const PaperSceneReport& s) { return SumOf(s.preparation, kBakeStages); }
double PerMillion(int64_t count, double of) { return Ratio(1e6 * static_cast<double>(count), of); }
double Compared(const PaperSceneReport& s) { return static_cast<double>(s.compared.area()); }
double PaperPixels(const PaperSceneReport& s) {
  return static_cast<double>(s.scene.width) * s.scene.height;
}

std::string Seconds(double s) { return absl::StrFormat("%.4g", s); }
std::string Times(double r) { return absl::StrFormat("%.2f×", r); }
std::string WithError(double value, double error) {
  return error > 0 ? absl::StrFormat("%.3g ± %.1g", value, error) : absl::StrFormat("%.3g", value);
}
std::string SecondsWithError(const PaperTimes& t) {
  return t.gather_error > 0 ? absl::StrFormat("%.4g ± %.2g", t.gather, t.gather_error)
                            : Seconds(t.gather);
}
std::string PdpText(int64_t count, double pixels) {
  return absl::StrFormat("%d (%.0f)", count, PerMillion(count, pixels));
}

std::array<const PaperIntegrator*, 3> Integrators(const PaperSceneReport& s) {
  return {&s.pbgi, &s.fpbgi, &s.dpbgi};
}

std::string LabelOf(const PaperIntegrator& r) {
  if (r.integrator == Integrator::kFpbgi) {
    return absl::StrFormat("fpbgi k=%d ε=%g %d²", r.clusters, r.epsilon, r.microbuffer);
  }
  return absl::StrFormat("%s %d²", NameOf(r.integrator), r.microbuffer);
}

std::string SampleText(const PaperReport& report, const PaperSceneReport& s) {
  if (report.options.full) return "pbgi and dpbgi rendered the whole frame";
  return absl::StrFormat(
      "pbgi and dpbgi ran on %d blocks of 8x8 pixels (%d pixels, %d of them receivers) of the "
      "frame's %d receivers and on a crop of %dx%d pixels",
      s.blocks, s.block_pixels, s.block_receivers, s.receivers, s.crop.width(), s.crop.height());
}

std::string MachineText(const PaperReport& r) {
  return absl::StrFormat("%s, %d threads; peak memory %.1f GB", r.cpu, r.threads,
                         static_cast<double>(r.peak_rss_bytes) * 1e-9);
}

std::string TruthText(const PaperSceneReport& s) {
  return absl::StrFormat(
      "pt, %d paths at each of %d pixels, noise %.4f of the mean, %.3g thread-seconds",
      s.reference_paths, s.reference_pixels, s.fpbgi.truth.noise, s.reference_seconds);
}

Splat SplatInForce(const PaperReport& r) {
  RenderSettings paper;
  ApplyPaperPreset(paper);
  return r.options.splat.value_or(paper.splat);
}
std::string NameOfSplat(const PaperReport& r) {
  return SplatInForce(r) == Splat::kOpaque ? "opaque" : "coverage";
}
// What is not the paper's; empty if all is.
std::string OtherThanPaper(const PaperReport& r) {
  std::string text;
  if (r.options.splat) text = Concat({"splats are ", NameOfSplat(r)});
  if (r.options.microbuffer > 0) {
    Append(text, {text.empty() ? "" : ", ",
                  absl::StrFormat("buffers have %d² pixels", r.options.microbuffer)});
  }
  return text;
}

// How near dpbgi's time is to fpbgi's.
std::string MatchText(const PaperSceneReport& s) {
  return absl::StrFormat("%.3f", Ratio(s.dpbgi.times.gather, s.fpbgi.times.gather));
}

// --- The tables of the page ---------------------------------------------------------------------

HtmlTable TableOne(const PaperReport& report) {
  HtmlTable table;
  table.left_columns = 2;
  table.head = {"scene",
                "whose",
                "points",
                "clustering",
                "cut pbgi",
                "cut fpbgi",
                "×",
                "raster pbgi",
                "raster fpbgi",
                "×",
                "gather pbgi",
                "gather fpbgi",
                "×",
                "full pbgi",
                "full fpbgi",
                "×",
                "PDP (per million pixels)",
                "MSE"};
  for (const PaperSceneReport& s : report.scenes) {
    const PaperTimes &a = s.pbgi.times, &b = s.fpbgi.times;
    table.rows.push_back(
        {std::string(s.scene.title), "farpoint", absl::StrFormat("%.2f M", 1e-6 * s.surfels),
         Seconds(At(b, Stage::kCluster)), Seconds(At(a, Stage::kCut)), Seconds(At(b, Stage::kCut)),
         Times(Ratio(At(a, Stage::kCut), At(b, Stage::kCut))), Seconds(At(a, Stage::kRaster)),
         Seconds(At(b, Stage::kRaster)), Times(Ratio(At(a, Stage::kRaster), At(b, Stage::kRaster))),
         SecondsWithError(a), Seconds(b.gather), Times(Ratio(a.gather, b.gather)),
         Seconds(Total(s, s.pbgi)), Seconds(Total(s, s.fpbgi)),
         Times(Ratio(Total(s, s.pbgi), Total(s, s.fpbgi))),
         PdpText(s.fpbgi.difference->crop_pdp, Compared(s)),
         WithError(s.fpbgi.difference->mse, s.fpbgi.difference->mse_error)});
    const PublishedRow& p = s.scene.published;
    table.rows.push_back(
        {std::string(s.scene.title), "paper", absl::StrFormat("%.2f M", 1e-6 * p.points),
         Seconds(p.cluster_s), Seconds(p.cut_pbgi_s), Seconds(p.cut_fpbgi_s),
         Times(p.cut_pbgi_s / p.cut_fpbgi_s), Seconds(p.raster_pbgi_s), Seconds(p.raster_fpbgi_s),
         Times(p.raster_pbgi_s / p.raster_fpbgi_s), "", "", "", Seconds(p.total_pbgi_s),
         Seconds(p.total_fpbgi_s), Times(p.total_pbgi_s / p.total_fpbgi_s),
         PdpText(p.pdp, PaperPixels(s)), absl::StrFormat("%.3g", p.mse)});
  }
  return table;
}

HtmlTable ErrorTable(const PaperReport& report) {
  HtmlTable table;
  table.left_columns = 2;
  table.head = {"scene",
                "integrator",
                "gather, thread-s",
                "over fpbgi's",
                "MSE to pbgi",
                "MSE to pbgi in the crop",
                "PDP to pbgi in the crop (per million)",
                "rr to pt",
                "bias to pt"};
  for (const PaperSceneReport& s : report.scenes) {
    for (const PaperIntegrator* r : Integrators(s)) {
      std::vector<std::string> row = {std::string(s.scene.title), LabelOf(*r),
                                      SecondsWithError(r->times),
                                      Times(Ratio(r->times.gather, s.fpbgi.times.gather))};
      if (r->difference) {
        row.push_back(WithError(r->difference->mse, r->difference->mse_error));
        row.push_back(absl::StrFormat("%.3g", r->difference->crop_mse));
        row.push_back(PdpText(r->difference->crop_pdp, Compared(s)));
      } else {
        row.insert(row.end(), {"", "", ""});
      }
      row.push_back(absl::StrFormat("%.4f ± %.4f", r->truth.rr, r->truth.rr_error));
      row.push_back(absl::StrFormat("%+.4f ± %.4f", r->truth.bias, r->truth.bias_error));
      table.rows.push_back(std::move(row));
    }
  }
  return table;
}

HtmlTable CropTable(const PaperReport& report) {
  HtmlTable table;
  table.head = {"scene", "pbgi, crop", "fpbgi, crop", "×, crop", "×, frame"};
  for (const PaperSceneReport& s : report.scenes) {
    table.rows.push_back({std::string(s.scene.title), Seconds(s.pbgi.crop_gather),
                          Seconds(s.fpbgi.crop_gather),
                          Times(Ratio(s.pbgi.crop_gather, s.fpbgi.crop_gather)),
                          Times(Ratio(s.pbgi.times.gather, s.fpbgi.times.gather))});
  }
  return table;
}

HtmlTable StageTable(const PaperSceneReport& s) {
  HtmlTable table;
  table.head = {"integrator", "cluster", "cut", "raster", "composite", "convolve", "trace"};
  for (const PaperIntegrator* r : Integrators(s)) {
    std::vector<std::string> row = {LabelOf(*r)};
    for (const Stage stage : {Stage::kCluster, Stage::kCut, Stage::kRaster, Stage::kComposite,
                              Stage::kConvolve, Stage::kTrace}) {
      row.push_back(Seconds(At(r->times, stage)));
    }
    table.rows.push_back(std::move(row));
  }
  return table;
}

HtmlTable TrialTable(const PaperSceneReport& s) {
  HtmlTable table;
  table.head = {"dpbgi's buffer", "gather, thread-s", "over fpbgi's"};
  for (const DegradedTrial& t : s.trials) {
    table.rows.push_back({absl::StrFormat("%d²", t.microbuffer), Seconds(t.gather),
                          Times(Ratio(t.gather, s.fpbgi.times.gather))});
  }
  return table;
}

HtmlTable SweepTable(const PaperSceneReport& s) {
  HtmlTable table;
  table.head = {"k", "ε", "gather, thread-s", "speed-up", "MSE", "PDP (per million)"};
  table.left_columns = 0;
  for (const PaperSweepPoint& p : s.sweep) {
    table.rows.push_back({absl::StrFormat("%d", p.clusters), absl::StrFormat("%g", p.epsilon),
                          Seconds(p.gather), Times(p.speed_up), absl::StrFormat("%.3g", p.mse),
                          PdpText(p.pdp, static_cast<double>(s.crop.area()))});
  }
  return table;
}

enum class Over { kClusters, kEpsilon };

// One line for each value of the other parameter.
LogLogPlot SweepPlot(const PaperSceneReport& s, Over over, const char* y_label,
                     double (*y)(const PaperSweepPoint&)) {
  LogLogPlot plot;
  const bool by_k = over == Over::kClusters;
  plot.x_label = by_k ? "clusters per block, k" : "ε";
  plot.y_label = y_label;
  for (const PaperSweepPoint& p : s.sweep) {
    const std::string name =
        by_k ? absl::StrFormat("ε = %g", p.epsilon) : absl::StrFormat("k = %d", p.clusters);
    PlotSeries* series = nullptr;
    for (PlotSeries& known : plot.series) {
      if (known.name == name) series = &known;
    }
    if (series == nullptr) {
      plot.series.push_back({name, kColors[plot.series.size() % kColors.size()], {}});
      series = &plot.series.back();
    }
    PlotPoint point;
    point.x = by_k ? p.clusters : p.epsilon;
    point.y = y(p);
    point.on_line = true;
    point.title = absl::StrFormat("k=%d ε=%g: MSE %.3g, PDP %d, speed-up %.3g", p.clusters,
                                  p.epsilon, p.mse, p.pdp, p.speed_up);
    series->points.push_back(std::move(point));
  }
  return plot;
}

absl::Status AddFigures(HtmlPage& page, const PaperSceneReport& s, bool sweep) {
  std::vector<HtmlFigure> figures;
  for (const PaperPicture& p : s.pictures) {
    if (p.name.starts_with("sweep") != sweep) continue;
    figures.push_back({p.width, p.height, p.rgb, p.caption});
  }
  return page.Figures(figures);
}

absl::Status AddScene(HtmlPage& page, const PaperReport& report, const PaperSceneReport& s) {
  page.Heading(s.scene.title);
  std::vector<HtmlFact> facts = {
      {"Scene", Concat({s.scene.what,
                        absl::StrFormat("; %d triangles, %d surfels, tree %.1f MB", s.triangles,
                                        s.surfels, static_cast<double>(s.tree_bytes) * 1e-6)})},
      {"Film", absl::StrFormat("%dx%d", s.width, s.height)},
      {"Sample", SampleText(report, s)},
      {"Shared by all, thread-seconds",
       absl::StrFormat("preparation %.4g (sampling %.3g, shading %.3g, tree %.3g), loading %.3g, "
                       "primary rays %.3g, direct light %.3g",
                       Preparation(s), s.preparation[static_cast<size_t>(Stage::kSample)],
                       s.preparation[static_cast<size_t>(Stage::kShade)],
                       s.preparation[static_cast<size_t>(Stage::kTree)], s.load_s, s.primary_s,
                       s.direct_s)},
      {"Truth", TruthText(s)},
      {"Load of the machine", absl::StrFormat("%.1f at the scene's start, %.1f at its end",
                                              s.load_average_start, s.load_average_end)}};
  for (const std::string& note : s.notes) facts.push_back({"Note", note});
  page.Facts(facts);
  page.Subheading("Stages of the frame, thread-seconds");
  page.Table(StageTable(s));
  page.Subheading("Figure 2: fpbgi, and dpbgi at its time, against pbgi");
  page.Paragraph(absl::StrFormat(
      "The microbuffer with which dpbgi comes nearest to fpbgi's time has %d² pixels: %s of it. "
      "The paper gives the errors of its Figure 2 within the pictures only; those of fpbgi are "
      "the table's: MSE %.3g, PDP %d.",
      s.dpbgi.microbuffer, MatchText(s), s.scene.published.mse, s.scene.published.pdp));
  FP_RETURN_IF_ERROR(AddFigures(page, s, /*sweep=*/false));
  page.Table(TrialTable(s));
  page.Subheading("Figures 4 and 5: the influence of k and ε, on the crop");
  page.Paragraph(
      "The paper's figures hold their numbers in pictures (Figure 4 for Sponza only); its text "
      "says: k clearly dominates the quality, very small k with large ε causes large visible "
      "artifacts, and k = 100 with ε = 0.1 is a good default.");
  FP_RETURN_IF_ERROR(AddFigures(page, s, /*sweep=*/true));
  const auto mse = [](const PaperSweepPoint& p) { return p.mse; };
  const auto speed_up = [](const PaperSweepPoint& p) { return p.speed_up; };
  page.Plot(SweepPlot(s, Over::kClusters, "MSE to pbgi", mse), "Error over k.");
  page.Plot(SweepPlot(s, Over::kEpsilon, "MSE to pbgi", mse), "Error over ε.");
  page.Plot(SweepPlot(s, Over::kClusters, "speed-up of the gather", speed_up),
            "Speed-up over pbgi, by k.");
  page.Plot(SweepPlot(s, Over::kEpsilon, "speed-up of the gather", speed_up),
            "Speed-up over pbgi, by ε.");
  page.Table(SweepTable(s));
  return absl::OkStatus();
}

// --- JSON ---------------------------------------------------------------------------------------

Json ToJson(const PixelRect& r) { return Json::array({r.x0, r.y0, r.x1, r.y1}); }

Json ToJson(const PaperSceneReport& s, const PaperIntegrator& r) {
  Json seconds;
  for (const Stage stage : kGatherStages) {
    seconds[kStageNames[static_cast<size_t>(stage)]] = At(r.times, stage);
  }
  seconds["gather"] = r.times.gather;
  seconds["gather_error"] = r.times.gather_error;
  seconds["gather_of_compared"] = r.crop_gather;
  seconds["full"] = Total(s, r);
  Json json = {{"integrator", NameOf(r.integrator)},
               {"clusters", r.clusters == 0 ? Json() : Json(r.clusters)},
               {"epsilon", r.clusters == 0 ? Json() : Json(r.epsilon)},
               {"microbuffer", r.microbuffer},
               {"seconds", seconds}};
  json["to_pbgi"] = r.difference ? Json{{"mse", r.difference->mse},
                                        {"mse_error", r.difference->mse_error},
                                        {"mse_of_compared", r.difference->crop_mse},
                                        {"pdp_of_compared", r.difference->crop_pdp}}
                                 : Json();
  json["to_pt"] = {{"pixels", r.truth.pixels},         {"mean", r.truth.mean},
                   {"rel_rmse", r.truth.rel_rmse},     {"rr", r.truth.rr},
                   {"rr_error", r.truth.rr_error},     {"bias", r.truth.bias},
                   {"bias_error", r.truth.bias_error}, {"noise", r.truth.noise}};
  return json;
}

Json ToJson(const PaperSceneReport& s) {
  const PublishedRow& p = s.scene.published;
  Json preparation;
  for (const Stage stage : kBakeStages) {
    preparation[kStageNames[static_cast<size_t>(stage)]] =
        s.preparation[static_cast<size_t>(stage)];
  }
  Json trials = Json::array(), sweep = Json::array();
  for (const DegradedTrial& t : s.trials) {
    trials.push_back({{"microbuffer", t.microbuffer}, {"gather", t.gather}});
  }
  for (const PaperSweepPoint& x : s.sweep) {
    sweep.push_back({{"clusters", x.clusters},
                     {"epsilon", x.epsilon},
                     {"gather", x.gather},
                     {"speed_up", x.speed_up},
                     {"mse", x.mse},
                     {"pdp", x.pdp}});
  }
  return {
      {"name", s.scene.name},
      {"notes", s.notes},
      {"film", {{"width", s.width}, {"height", s.height}, {"receivers", s.receivers}}},
      {"triangles", s.triangles},
      {"surfels", s.surfels},
      {"nodes", s.nodes},
      {"tree_bytes", s.tree_bytes},
      {"preparation_seconds", preparation},
      {"load_seconds", s.load_s},
      {"primary_seconds", s.primary_s},
      {"direct_seconds", s.direct_s},
      {"white", s.white},
      {"sample",
       {{"blocks", s.blocks}, {"pixels", s.block_pixels}, {"receivers", s.block_receivers}}},
      {"crop", ToJson(s.crop)},
      {"compared", ToJson(s.compared)},
      {"reference",
       {{"pixels", s.reference_pixels},
        {"paths", s.reference_paths},
        {"seconds", s.reference_seconds}}},
      {"integrators", Json::array({ToJson(s, s.pbgi), ToJson(s, s.fpbgi), ToJson(s, s.dpbgi)})},
      {"pbgi_gather_of_crop", s.pbgi_crop_gather},
      {"dpbgi_trials", trials},
      {"sweep", sweep},
      {"published",
       {{"points", p.points},
        {"cluster_s", p.cluster_s},
        {"cut_s", {{"pbgi", p.cut_pbgi_s}, {"fpbgi", p.cut_fpbgi_s}}},
        {"raster_s", {{"pbgi", p.raster_pbgi_s}, {"fpbgi", p.raster_fpbgi_s}}},
        {"full_s", {{"pbgi", p.total_pbgi_s}, {"fpbgi", p.total_fpbgi_s}}},
        {"pdp", p.pdp},
        {"mse", p.mse}}},
      {"load_average", {{"start", s.load_average_start}, {"end", s.load_average_end}}},
  };
}

}  // namespace

std::string PaperJson(const PaperReport& r) {
  const PaperOptions& o = r.options;
  Json json = {
      {"benchmark", "paper"},
      {"version", FARPOINT_VERSION},
      {"date_utc", r.date_utc},
      {"quick", o.quick},
      {"full", o.full},
      {"machine", {{"cpu", r.cpu}, {"threads", r.threads}, {"peak_rss_bytes", r.peak_rss_bytes}}},
      {"settings",
       {{"seed", o.seed},
        {"light_samples", o.light_samples},
        {"blocks", o.blocks},
        {"reference_budget_s", o.reference_budget_s}}}};
  json["scenes"] = Json::array();
  for (const PaperSceneReport& s : r.scenes) json["scenes"].push_back(ToJson(s));
  json["left_out"] = Json::array();
  for (const LeftOut& l : r.left_out)
    json["left_out"].push_back({{"name", l.name}, {"why", l.why}});
  // A file name may be anything but UTF-8.
  return json.dump(2, ' ', false, Json::error_handler_t::replace) + "\n";
}

absl::StatusOr<std::string> PaperHtml(const PaperReport& r) {
  HtmlPage page("Factorized Point Based Global Illumination: the paper's experiments");
  std::vector<HtmlFact> facts = {
      {"Paper", "Wang, Huang, Buchholz, Meng, Boubekeur, 2013"},
      {"Machine", MachineText(r)},
      {"Run",
       absl::StrFormat("farpoint %s, %s%s", FARPOINT_VERSION, r.date_utc,
                       r.options.quick ? ", quick: a check that all works, no measurement" : "")}};
  if (const std::string other = OtherThanPaper(r); !other.empty()) {
    facts.push_back({"Not as in --preset paper", other});
  }
  for (const LeftOut& l : r.left_out) facts.push_back({"Left out: " + l.name, l.why});
  page.Facts(facts);
  page.Paragraph(
      "All integrators share scene, surfels, lights, receivers (pixel centres) and kernels, with "
      "the paper's parameters (--preset paper: 32x32 blocks, opaque splats, 64² buffers, k = 100, "
      "ε = 0.1). Our times are processor seconds summed over threads; the paper's are seconds by "
      "the clock on eight cores of 2010. Compare ratios, not seconds. \"gather\" is clustering, "
      "cut, rasterization, composite and convolution; \"full\" adds primary rays and direct light, "
      "not the preparation.");
  page.Paragraph(
      r.options.full
          ? "pbgi and dpbgi rendered whole frames (--full)."
          : "fpbgi rendered whole frames. pbgi and dpbgi did not: their times and the MSE are "
            "extrapolated from blocks of 8x8 pixels spread over the frame, ± one standard error; "
            "PDP, which needs an image, was counted on a crop in the middle of the frame. The "
            "figure per million pixels is what can be compared with the paper's whole frames. A "
            "crop is another part of the image than the frame: where it is harder or easier, so "
            "are its figures.");
  page.Paragraph(
      "MSE and PDP are of the indirect layer, divided by the 99th percentile of pbgi's luminance "
      "and clamped to [0, 1]; the frame's width spans 45°. The paper does not say how it "
      "normalised its images. rr and bias are of irradiance against path-traced pixels, relative "
      "to the mean; the reference's noise is taken out of rr in quadrature.");
  page.Heading("Table 1");
  page.Table(TableOne(r));
  if (!r.options.full) {
    page.Paragraph(
        "A check of the extrapolated speed-ups: on the crop both were rendered in full. Where the "
        "two ratios differ, the crop is another sort of pixels.");
    page.Table(CropTable(r));
  }
  page.Heading("Errors against pbgi and against the truth");
  page.Table(ErrorTable(r));
  for (const PaperSceneReport& s : r.scenes) FP_RETURN_IF_ERROR(AddScene(page, r, s));
  return std::move(page).Finish();
}

std::string PaperTable(const PaperReport& r) {
  std::string table = Concat({"machine    ", MachineText(r), "\n"});
  if (const std::string other = OtherThanPaper(r); !other.empty()) {
    Append(table, {"not as in --preset paper: ", other, "\n"});
  }
  table += "\n";
  absl::StrAppendFormat(&table, "%-8s%-9s%9s%9s%10s%10s%7s%10s%10s%7s%10s%10s%7s%9s%10s\n", "scene",
                        "", "points", "cluster", "cut p", "cut f", "x", "raster p", "raster f", "x",
                        "full p", "full f", "x", "PDP/M", "MSE");
  for (const PaperSceneReport& s : r.scenes) {
    const auto row = [&](const char* whose, double points, double cluster, double cut_p,
                         double cut_f, double raster_p, double raster_f, double full_p,
                         double full_f, double pdp, double mse) {
      absl::StrAppendFormat(
          &table,
          "%-8s%-9s%8.2fM%9.3g%10.4g%10.4g%7.2f%10.4g%10.4g%7.2f%10.4g%10.4g%7.2f%9.0f%10.3g\n",
          s.scene.name, whose, 1e-6 * points, cluster, cut_p, cut_f, Ratio(cut_p, cut_f), raster_p,
          raster_f, Ratio(raster_p, raster_f), full_p, full_f, Ratio(full_p, full_f), pdp, mse);
    };
    const PaperTimes &a = s.pbgi.times, &b = s.fpbgi.times;
    row("farpoint", static_cast<double>(s.surfels), At(b, Stage::kCluster), At(a, Stage::kCut),
        At(b, Stage::kCut), At(a, Stage::kRaster), At(b, Stage::kRaster), Total(s, s.pbgi),
        Total(s, s.fpbgi), PerMillion(s.fpbgi.difference->crop_pdp, Compared(s)),
        s.fpbgi.difference->mse);
    const PublishedRow& p = s.scene.published;
    row("paper", p.points, p.cluster_s, p.cut_pbgi_s, p.cut_fpbgi_s, p.raster_pbgi_s,
        p.raster_fpbgi_s, p.total_pbgi_s, p.total_fpbgi_s, PerMillion(p.pdp, PaperPixels(s)),
        p.mse);
  }
  absl::StrAppendFormat(&table, "\n%-8s%-26s%12s%9s%11s%9s%18s%19s\n", "scene", "integrator",
                        "gather s", "/ fpbgi", "MSE", "PDP/M", "rr to pt", "bias to pt");
  for (const PaperSceneReport& s : r.scenes) {
    for (const PaperIntegrator* i : Integrators(s)) {
      // Widths count bytes: no signs beyond ASCII here.
      const std::string label =
          i->clusters != 0
              ? absl::StrFormat("fpbgi k=%d eps=%g %dpx", i->clusters, i->epsilon, i->microbuffer)
              : absl::StrFormat("%s %dpx", NameOf(i->integrator), i->microbuffer);
      absl::StrAppendFormat(
          &table, "%-8s%-26s%12.4g%9.2f%11s%9s%9.4f +- %.4f%+10.4f +- %.4f\n", s.scene.name, label,
          i->times.gather, Ratio(i->times.gather, s.fpbgi.times.gather),
          i->difference ? absl::StrFormat("%.3g", i->difference->mse) : "",
          i->difference ? absl::StrFormat("%.0f", PerMillion(i->difference->crop_pdp, Compared(s)))
                        : "",
          i->truth.rr, i->truth.rr_error, i->truth.bias, i->truth.bias_error);
    }
    Append(table, {"        ", SampleText(r, s), "\n        ", TruthText(s), "\n"});
  }
  for (const LeftOut& l : r.left_out) Append(table, {l.name, " left out: ", l.why, "\n"});
  return table;
}

}  // namespace farpoint

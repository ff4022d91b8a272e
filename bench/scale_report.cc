#include "bench/scale_report.h"

#include <algorithm>
#include <array>
#include <nlohmann/json.hpp>
#include <optional>
#include <utility>
#include <vector>

#include "absl/strings/str_format.h"
#include "bench/html_page.h"
#include "bench/machine.h"
#include "bench/svg_plot.h"
#include "bench/text.h"

namespace farpoint {

namespace {

using Json = nlohmann::ordered_json;

constexpr double kMiB = 1024.0 * 1024.0;
constexpr std::array kBakeStageList = {Stage::kImport, Stage::kSample, Stage::kShade, Stage::kTree};
constexpr std::array kFrameStageList = {Stage::kPrimary, Stage::kCluster,   Stage::kCut,
                                        Stage::kRaster,  Stage::kComposite, Stage::kConvolve,
                                        Stage::kTrace};

const char* NameOf(Stage stage) { return kStageNames[static_cast<size_t>(stage)]; }

std::string MachineText(const ScaleReport& r) {
  return ::farpoint::MachineText(r.cpu, r.options.threads, r.load_average_start,
                                 r.load_average_end);
}

std::string SettingsText(const ScaleOptions& o) {
  const std::string clusters = o.clusters == 0
                                   ? Concat({"adaptive clusters, --quality ", NameOf(o.quality)})
                                   : absl::StrFormat("--clusters %d", o.clusters);
  return absl::StrFormat("%s, %s, --light-samples %d --seed %d, %d repeats", o.scene, clusters,
                         o.light_samples, o.seed, o.repeat);
}

std::string MiB(const std::optional<uint64_t>& bytes) {
  return bytes ? absl::StrFormat("%.0f", static_cast<double>(*bytes) / kMiB) : std::string("?");
}

std::string SpreadText(const Spread& s) {
  return absl::StrFormat("%.4g [%.4g, %.4g]", s.median, s.min, s.max);
}

std::string RatioText(double ratio) { return ratio > 0 ? absl::StrFormat("%.3f", ratio) : ""; }

double MicrosecondsPerReceiver(const ScaleFrame& f) {
  return f.receivers > 0 ? f.gather.median * 1e6 / static_cast<double>(f.receivers) : 0;
}

Json ToJson(const Spread& s) { return {{"median", s.median}, {"min", s.min}, {"max", s.max}}; }

Json ToJson(const ScaleBake& b) {
  Json seconds, wall;
  for (const Stage stage : kBakeStageList) {
    seconds[NameOf(stage)] = b.seconds[static_cast<size_t>(stage)];
    wall[NameOf(stage)] = b.wall_seconds[static_cast<size_t>(stage)];
  }
  return {{"points", b.points},
          {"threads", b.threads},
          {"triangles", b.triangles},
          {"surfels", b.surfels},
          {"nodes", b.nodes},
          {"seconds", seconds},
          {"wall_seconds", wall},
          {"preparation_seconds", b.thread_s()},
          {"preparation_wall_seconds", b.wall_s()},
          {"peak_bytes", b.peak_bytes ? Json(*b.peak_bytes) : Json()},
          {"scene_bytes", b.scene_bytes},
          {"tree_bytes", b.tree_bytes},
          {"bytes_per_surfel", b.bytes_per_surfel()},
          {"tree_hash", b.tree_hash}};
}

Json ToJson(const ScaleFrame& f) {
  Json seconds;
  for (const Stage stage : kFrameStageList) {
    seconds[NameOf(stage)] = ToJson(f.stage[static_cast<size_t>(stage)]);
  }
  return {{"width", f.width},
          {"height", f.height},
          {"points", f.points},
          {"threads", f.threads},
          {"receivers", f.receivers},
          {"clusters", f.clusters},
          {"rays", f.rays},
          {"node_visits", f.node_visits},
          {"gather_seconds", ToJson(f.gather)},
          {"per_cluster_seconds", ToJson(f.per_cluster)},
          {"wall_seconds", ToJson(f.wall)},
          {"us_per_receiver", MicrosecondsPerReceiver(f)},
          {"seconds", seconds},
          {"rr", f.error.rr},
          {"rr_error", f.error.rr_error},
          {"rel_rmse", f.error.rel_rmse},
          {"bias", f.error.bias},
          {"bias_error", f.error.bias_error},
          {"reference_noise", f.error.noise},
          {"compared_pixels", f.error.pixels},
          {"hash", f.hash}};
}

LogLogPlot PlotOf(const ScaleReport& r) {
  LogLogPlot plot;
  plot.x_label = "thousands of pixels, or of surfels";
  plot.y_label = "thread-seconds";
  PlotSeries pixels{"gather over pixels", "#0072b2", {}};
  PlotSeries clusters{"per cluster over pixels", "#56b4e9", {}};
  PlotSeries surfels{"gather over surfels", "#e69f00", {}};
  PlotSeries preparation{"preparation over surfels", "#009e73", {}};
  for (const ScaleFrame& f : r.frames) {
    if (f.threads != r.options.threads) continue;
    const std::string title = absl::StrFormat("%dx%d, %d surfels: %s s, rr %.4f", f.width, f.height,
                                              f.points, SpreadText(f.gather), f.error.rr);
    const double k = static_cast<double>(f.width) * f.height * 1e-3;
    if (f.points == r.options.points) {
      pixels.points.push_back({k, f.gather.median, 0, 0, title, false, true});
      clusters.points.push_back({k, f.per_cluster.median, 0, 0, title, false, true});
    }
    if (f.width == r.options.width / 2) {
      surfels.points.push_back(
          {static_cast<double>(f.points) * 1e-3, f.gather.median, 0, 0, title, false, true});
    }
  }
  for (const ScaleBake& b : r.bakes) {
    if (b.threads != r.options.threads) continue;
    preparation.points.push_back({static_cast<double>(b.surfels) * 1e-3, b.thread_s(), 0, 0,
                                  absl::StrFormat("%d surfels: %.3g s", b.surfels, b.thread_s()),
                                  false, true});
  }
  plot.series = {std::move(pixels), std::move(clusters), std::move(surfels),
                 std::move(preparation)};
  return plot;
}

// Rows of texts with their head, for the console and for the page.
HtmlTable BakeTable(const ScaleReport& r) {
  HtmlTable table;
  table.head = {"surfels", "threads", "sample s", "shade s",  "tree s",
                "sum s",   "wall s",  "peak MiB", "tree MiB", "bytes/surfel"};
  for (const ScaleBake& b : r.bakes) {
    const auto seconds = [&](Stage stage) {
      return absl::StrFormat("%.3f", b.seconds[static_cast<size_t>(stage)]);
    };
    table.rows.push_back({std::to_string(b.surfels), std::to_string(b.threads),
                          seconds(Stage::kSample), seconds(Stage::kShade), seconds(Stage::kTree),
                          absl::StrFormat("%.3f", b.thread_s()),
                          absl::StrFormat("%.3f", b.wall_s()), MiB(b.peak_bytes), MiB(b.tree_bytes),
                          absl::StrFormat("%.2f", b.bytes_per_surfel())});
  }
  return table;
}

HtmlTable FrameTable(const ScaleReport& r) {
  HtmlTable table;
  table.head = {"frame",    "surfels",     "threads", "clusters", "per cluster s",
                "gather s", "us/receiver", "wall s",  "rr",       "bias"};
  for (const ScaleFrame& f : r.frames) {
    table.rows.push_back({absl::StrFormat("%dx%d", f.width, f.height), std::to_string(f.points),
                          std::to_string(f.threads), std::to_string(f.clusters),
                          SpreadText(f.per_cluster), SpreadText(f.gather),
                          absl::StrFormat("%.3g", MicrosecondsPerReceiver(f)),
                          absl::StrFormat("%.3g", f.wall.median),
                          absl::StrFormat("%.4f+-%.4f", f.error.rr, f.error.rr_error),
                          absl::StrFormat("%+.4f", f.error.bias)});
  }
  return table;
}

HtmlTable GrowthTable(const ScaleReport& r) {
  HtmlTable table;
  table.head = {"axis", "from", "to", "x", "per cluster", "gather", "preparation"};
  for (const ScaleGrowth& g : r.growth) {
    table.rows.push_back({g.axis, g.from, g.to, absl::StrFormat("%.3g", g.factor),
                          RatioText(g.per_cluster), RatioText(g.gather), RatioText(g.preparation)});
  }
  return table;
}

std::string TextOf(const HtmlTable& table) {
  std::vector<size_t> width(table.head.size());
  const auto widen = [&](const std::vector<std::string>& row) {
    for (size_t i = 0; i < row.size(); ++i) width[i] = std::max(width[i], row[i].size());
  };
  widen(table.head);
  for (const auto& row : table.rows) widen(row);
  std::string text;
  const auto add = [&](const std::vector<std::string>& row) {
    for (size_t i = 0; i < row.size(); ++i) {
      text += absl::StrFormat("%*s%s", static_cast<int>(width[i]), row[i],
                              i + 1 < row.size() ? "  " : "\n");
    }
  };
  add(table.head);
  for (const auto& row : table.rows) add(row);
  return text;
}

}  // namespace

std::string ScaleTable(const ScaleReport& r) {
  return Concat({"scene    ", SettingsText(r.options), "\nmachine  ", MachineText(r), "\n\n",
                 TextOf(BakeTable(r)), "\n", TextOf(FrameTable(r)), "\n", TextOf(GrowthTable(r))});
}

std::string ScaleJson(const ScaleReport& r) {
  const ScaleOptions& o = r.options;
  Json bakes = Json::array(), frames = Json::array(), growth = Json::array();
  for (const ScaleBake& b : r.bakes) bakes.push_back(ToJson(b));
  for (const ScaleFrame& f : r.frames) frames.push_back(ToJson(f));
  for (const ScaleGrowth& g : r.growth) {
    const auto or_null = [](double ratio) { return ratio > 0 ? Json(ratio) : Json(); };
    growth.push_back({{"axis", g.axis},
                      {"from", g.from},
                      {"to", g.to},
                      {"factor", g.factor},
                      {"per_cluster", or_null(g.per_cluster)},
                      {"gather", or_null(g.gather)},
                      {"preparation", or_null(g.preparation)}});
  }
  const Json json = {
      {"benchmark", "scale"},
      {"version", FARPOINT_VERSION},
      {"date_utc", r.date_utc},
      {"quick", o.quick},
      {"machine",
       {{"cpu", r.cpu},
        {"threads", o.threads},
        {"load_average", {{"start", r.load_average_start}, {"end", r.load_average_end}}}}},
      {"settings",
       {{"scene", o.scene},
        {"quality", o.clusters == 0 ? Json(NameOf(o.quality)) : Json()},
        {"clusters", o.clusters},
        {"light_samples", o.light_samples},
        {"seed", o.seed},
        {"repeat", o.repeat},
        {"reference_pixels", o.reference_pixels},
        {"reference_budget_s", o.reference_budget_s}}},
      {"notes", r.notes},
      {"bakes", bakes},
      {"frames", frames},
      {"growth", growth},
  };
  return json.dump(2) + "\n";
}

std::string ScaleHtml(const ScaleReport& r) {
  HtmlPage page("farpoint: how cost grows");
  const std::vector<HtmlFact> facts = {{"Version", Concat({FARPOINT_VERSION, ", ", r.date_utc})},
                                       {"Scene", SettingsText(r.options)},
                                       {"Machine", MachineText(r)}};
  page.Facts(facts);
  for (const std::string& note : r.notes) page.Paragraph(note);
  page.Heading("Growth");
  page.Paragraph(
      "Ratios of thread-seconds. Pixels: frames of one view. Surfels and threads: the middle "
      "frame. Per cluster: the stages cluster, cut, raster and trace. Preparation: sampling, "
      "shading and the tree.");
  page.Table(GrowthTable(r));
  page.Plot(PlotOf(r), "Thread-seconds over pixels and surfels");
  page.Heading("Frames");
  page.Paragraph(
      "Thread-seconds: median [fastest, slowest]. rr and bias are those of indirect irradiance "
      "against a path tracer at some pixels of the frame, rr with its standard error.");
  page.Table(FrameTable(r));
  page.Heading("Preparation");
  page.Paragraph(
      "Peak: the most that the process held beyond the scene's files, while it baked. The tree is "
      "what is kept and sent.");
  page.Table(BakeTable(r));
  return std::move(page).Finish();
}

}  // namespace farpoint

#include "bench/pareto_report.h"

#include <algorithm>
#include <array>
#include <nlohmann/json.hpp>
#include <optional>
#include <span>
#include <utility>
#include <vector>

#include "absl/strings/str_format.h"
#include "bench/accuracy_frame.h"
#include "bench/html_page.h"
#include "bench/machine.h"
#include "bench/svg_plot.h"
#include "bench/text.h"

namespace farpoint {

namespace {

using Json = nlohmann::ordered_json;

// By curve; told apart in most kinds of colour blindness (Okabe and Ito).
constexpr std::array<const char*, kParetoCurveCount> kColors = {"#0072b2", "#56b4e9", "#e69f00",
                                                                "#cc79a7", "#009e73", "#d55e00"};

constexpr std::array kCurves = {ParetoCurve::kAdaptive, ParetoCurve::kKMeans,
                                ParetoCurve::kPbgi,     ParetoCurve::kDpbgi,
                                ParetoCurve::kPt,       ParetoCurve::kIrrcache};
static_assert(kCurves.size() == kParetoCurveCount);

Json ToJson(const Spread& s) { return {{"median", s.median}, {"min", s.min}, {"max", s.max}}; }

Json ToJson(const Vec3d& v) { return {v.x, v.y, v.z}; }

// As the flags say it; null where the scene's own is in force.
Json ToJson(const SceneChanges& c) {
  Json json = {{"sun", nullptr}, {"sky", nullptr}, {"view", nullptr}};
  if (c.sun) {
    json["sun"] = {{"to_sun", ToJson(c.sun->to_sun)},
                   {"irradiance", ToJson(Vec3d(c.sun->irradiance))}};
  }
  if (c.sky) json["sky"] = ToJson(Vec3d(*c.sky));
  if (c.view) {
    json["view"] = {{"eye", ToJson(c.view->eye)},
                    {"target", ToJson(c.view->target)},
                    {"yfov_deg", c.view->yfov_deg}};
  }
  return json;
}

template <typename T>
Json OrNull(const std::optional<T>& value) {
  return value ? Json(*value) : Json();
}
template <typename T>
Json OrNull(bool present, const T& value) {
  return present ? Json(value) : Json();
}

bool IsPreparation(int stage) { return stage < static_cast<int>(Stage::kPrimary); }

Json ToJson(const PreparationTimes& times) {
  Json json;
  for (int i = 0; i < kStageCount; ++i) {
    // A bake has no broadcast.
    if (!IsPreparation(i) || i == static_cast<int>(Stage::kBroadcast)) continue;
    json[kStageNames[static_cast<size_t>(i)]] = ToJson(times.stage[static_cast<size_t>(i)]);
  }
  json["total"] = ToJson(times.total);
  return json;
}

Json ToJson(const ParetoPoint& p) {
  Json seconds;
  seconds["gather"] = ToJson(p.gather);
  for (int i = 0; i < kStageCount; ++i) {
    if (!IsPreparation(i)) {
      seconds[kStageNames[static_cast<size_t>(i)]] = ToJson(p.stage[static_cast<size_t>(i)]);
    }
  }
  return {
      {"label", LabelOf(p)},
      {"quality", p.quality ? Json(NameOf(*p.quality)) : Json()},
      {"clusters", OrNull(p.clusters != 0, p.clusters)},
      {"epsilon", OrNull(p.clusters != 0, p.epsilon)},
      {"microbuffer", OrNull(p.microbuffer != 0, p.microbuffer)},
      {"paths", OrNull(p.paths != 0, p.paths)},
      {"cache_error", OrNull(p.cache_error != 0, p.cache_error)},
      {"seconds", seconds},
      {"wall_seconds", ToJson(p.wall)},
      {"us_per_receiver", p.us_per_receiver},
      {"rr", p.rr},
      {"rel_rmse", p.rel_rmse},
      {"bias", p.bias},
      {"reference_limited", p.reference_limited},
      {"noise_above_error", p.noise_above_error},
      {"on_front", p.on_front},
      {"pt_seconds_at_rr", OrNull(p.pt_seconds_at_rr)},
      {"irrcache_seconds_at_rr", OrNull(p.irrcache_seconds_at_rr)},
      {"counts", p.counts},
      {"hash", p.hash},
  };
}

std::vector<const ParetoPoint*> ByTime(const ParetoReport& report, ParetoCurve curve) {
  std::vector<const ParetoPoint*> points;
  for (const ParetoPoint& p : report.points) {
    if (p.curve() == curve) points.push_back(&p);
  }
  std::stable_sort(points.begin(), points.end(), [](const ParetoPoint* a, const ParetoPoint* b) {
    return a->gather.median < b->gather.median;
  });
  return points;
}

std::string ReferenceText(const ParetoReport& r) {
  std::string text;
  if (r.options.reference_path.empty()) {
    text = absl::StrFormat("path tracer, %d paths per pixel, %.3g thread-seconds",
                           r.options.reference_paths, r.reference_seconds);
  } else {
    text = r.options.reference_path;
  }
  if (r.reference_noise_known) {
    return Concat({text, absl::StrFormat("; noise %.4f of its mean", r.reference_noise)});
  }
  return text + "; noise unknown, taken as 0: errors hold the reference's own";
}

std::string SceneText(const ParetoReport& r) {
  return absl::StrFormat("%s, %d triangles, %d surfels, tree %.1f MB", r.options.scene, r.triangles,
                         r.surfels, static_cast<double>(r.tree_bytes) * 1e-6);
}

std::string FilmText(const ParetoReport& r) {
  return absl::StrFormat("%dx%d, %d receivers, %d pixels compared", r.options.width,
                         r.options.height, r.receivers, r.compared_pixels);
}

std::string MachineText(const ParetoReport& r) {
  return ::farpoint::MachineText(r.cpu, r.options.threads, r.load_average_start,
                                 r.load_average_end);
}

std::string SpreadText(const Spread& s) {
  return absl::StrFormat("%.4g [%.4g, %.4g]", s.median, s.min, s.max);
}

// How many times the point's own time a peer needs; empty where it cannot be told.
std::string SpeedupText(const ParetoPoint& p, const std::optional<double>& peer_seconds) {
  if (!peer_seconds || !(p.gather.median > 0)) return "";
  return absl::StrFormat("%.3g", *peer_seconds / p.gather.median);
}

std::string FlagsText(const ParetoPoint& p) {
  std::string flags;
  if (p.on_front) flags += "front";
  if (p.noise_above_error) {
    Append(flags, {flags.empty() ? "" : ", ", "noise above error"});
  } else if (p.reference_limited) {
    Append(flags, {flags.empty() ? "" : ", ", "reference-limited"});
  }
  return flags;
}

LogLogPlot PlotOf(const ParetoReport& report) {
  LogLogPlot plot;
  plot.x_label = "gather, thread-seconds for the frame (median; bar: fastest to slowest repeat)";
  plot.y_label = "error rr of irradiance";
  for (const ParetoCurve curve : kCurves) {
    PlotSeries series{std::string(NameOf(curve)), kColors[static_cast<size_t>(curve)], {}};
    for (const ParetoPoint* p : ByTime(report, curve)) {
      series.points.push_back({p->gather.median, p->rr, p->gather.min, p->gather.max,
                               absl::StrFormat("%s %s: %s s, rr %.4f, bias %+.4f", series.name,
                                               LabelOf(*p), SpreadText(p->gather), p->rr, p->bias),
                               p->reference_limited, p->on_front});
    }
    plot.series.push_back(std::move(series));
  }
  if (report.reference_noise_known) plot.level = {report.reference_noise, "noise of the reference"};
  return plot;
}

}  // namespace

std::string ParetoJson(const ParetoReport& r) {
  const ParetoOptions& o = r.options;
  const bool from_file = !o.reference_path.empty();
  const RenderSettings defaults;  // the defaults, which the points use
  Json json = {
      {"benchmark", "pareto"},
      {"version", FARPOINT_VERSION},
      {"date_utc", r.date_utc},
      {"quick", o.quick},
      {"machine",
       {{"cpu", r.cpu},
        {"threads", o.threads},
        {"load_average", {{"start", r.load_average_start}, {"end", r.load_average_end}}}}},
      {"scene",
       {{"name", o.scene},
        {"changes", ToJson(o.changes)},
        {"notes", r.notes},
        {"triangles", r.triangles},
        {"surfels", r.surfels},
        {"nodes", r.nodes},
        {"bytes", {{"scene", r.scene_bytes}, {"tree", r.tree_bytes}}},
        {"hash", {{"scene", r.scene_hash}, {"tree", r.tree_hash}}}}},
      {"film",
       {{"width", o.width},
        {"height", o.height},
        {"spp", 1},
        {"receivers", r.receivers},
        {"compared_pixels", r.compared_pixels}}},
      {"settings",
       {{"seed", o.seed},
        {"light_samples", o.light_samples},
        {"repeat", o.repeat},
        {"buffer_map", defaults.buffer_map == BufferMap::kOctahedral ? "octahedral" : "cosine"},
        {"splat", defaults.splat == Splat::kCoverage ? "coverage" : "opaque"}}},
      {"reference",
       {{"kind", from_file ? "file" : "pt"},
        {"file", OrNull(from_file, o.reference_path)},
        {"layer", OrNull(!o.ref_layer.empty(), o.ref_layer)},
        {"mask", OrNull(!o.mask_path.empty(), o.mask_path)},
        {"paths", OrNull(!from_file, o.reference_paths)},
        {"seconds", OrNull(!from_file, r.reference_seconds)},
        {"mean", r.reference_mean},
        {"noise", OrNull(r.reference_noise_known, r.reference_noise)}}},
      {"preparation",
       {{"point_based", ToJson(r.point_based)},
        {"pt", ToJson(r.path_traced)},
        {"load", ToJson(r.load)},
        {"atlas", ToJson(r.atlas)}}},
  };
  json["curves"] = Json::array();
  for (const ParetoCurve curve : kCurves) {
    Json points = Json::array();
    for (const ParetoPoint* p : ByTime(r, curve)) points.push_back(ToJson(*p));
    json["curves"].push_back({{"curve", NameOf(curve)}, {"points", points}});
  }
  // A file name may be anything but UTF-8.
  return json.dump(2, ' ', false, Json::error_handler_t::replace) + "\n";
}

std::string ParetoHtml(const ParetoReport& r) {
  HtmlPage page(Concat({"Time against error: ", r.options.scene}));
  std::vector<HtmlFact> facts = {
      {"Scene", SceneText(r)},
      {"Film", FilmText(r)},
      {"Reference", ReferenceText(r)},
      {"Machine", MachineText(r)},
      {"Run", absl::StrFormat("farpoint %s, %s, median of %d%s", FARPOINT_VERSION, r.date_utc,
                              r.options.repeat, r.options.quick ? ", quick" : "")}};
  for (const std::string& note : r.notes) facts.push_back({"Note", note});
  if (const std::optional<std::string> warning = NoiseWarning(r)) {
    facts.push_back({"Warning", *warning});
  }
  page.Facts(facts);
  page.Plot(PlotOf(r),
            "Lower left is better: less time, less error. Lines join the points of a curve that "
            "none of its other points beats in both; points off the line are faint. Rings: the "
            "reference's noise is more than half of the error.");
  page.Heading("Points");
  HtmlTable points;
  points.left_columns = 2;
  points.head = {"curve",
                 "setting",
                 "gather, thread-s [min, max]",
                 "µs/receiver",
                 "rr",
                 "rel. RMSE",
                 "bias",
                 "× pt at equal rr",
                 "× irrcache at equal rr",
                 "wall s [min, max]",
                 "remarks"};
  for (const ParetoCurve curve : kCurves) {
    for (const ParetoPoint* p : ByTime(r, curve)) {
      points.rows.push_back(
          {std::string(NameOf(curve)), LabelOf(*p), SpreadText(p->gather),
           absl::StrFormat("%.3g", p->us_per_receiver), absl::StrFormat("%.4f", p->rr),
           absl::StrFormat("%.4f", p->rel_rmse), absl::StrFormat("%+.4f", p->bias),
           SpeedupText(*p, p->pt_seconds_at_rr), SpeedupText(*p, p->irrcache_seconds_at_rr),
           SpreadText(p->wall), FlagsText(*p)});
    }
  }
  page.Table(points);
  page.Heading("Preparation");
  page.Paragraph("Thread-seconds once per scene, not in the times above: median [min, max].");
  HtmlTable preparation;
  preparation.head = {"for", "import", "sample", "shade", "tree", "total"};
  const auto add = [&](const char* name, const PreparationTimes& times) {
    std::vector<std::string>& cells = preparation.rows.emplace_back();
    cells.emplace_back(name);
    for (const Stage s : kBakeStages) {
      cells.push_back(SpreadText(times.stage[static_cast<size_t>(s)]));
    }
    cells.push_back(SpreadText(times.total));
  };
  add("fpbgi, pbgi, dpbgi", r.point_based);
  add("pt, irrcache", r.path_traced);
  page.Table(preparation);
  page.Paragraph(Concat({"Loading (ray acceleration structure, light tables; everyone needs it): ",
                         SpreadText(r.load),
                         " thread-seconds. The surfels about a hit, for adaptive clusters: ",
                         SpreadText(r.atlas), "."}));
  return std::move(page).Finish();
}

std::string ParetoTable(const ParetoReport& r) {
  std::string table =
      Concat({"scene      ", SceneText(r), "\nfilm       ", FilmText(r), "\nreference  ",
              ReferenceText(r), "\nmachine    ", MachineText(r), "\n\n"});
  absl::StrAppendFormat(&table, "%-15s%-18s%33s%12s%9s%9s%9s%9s%11s  %s\n", "", "setting",
                        "gather s [min, max]", "us/receiver", "rr", "relRMSE", "bias", "x pt",
                        "x irrcache", "remarks");
  for (const ParetoCurve curve : kCurves) {
    for (const ParetoPoint* p : ByTime(r, curve)) {
      // Widths count bytes: the few signs beyond ASCII are written without them here.
      std::string label;
      if (curve == ParetoCurve::kKMeans) {
        label = absl::StrFormat("k=%d eps=%g %dpx", p->clusters, p->epsilon, p->microbuffer);
      } else if (curve == ParetoCurve::kPbgi || curve == ParetoCurve::kDpbgi) {
        label = absl::StrFormat("%dpx", p->microbuffer);
      } else {
        label = LabelOf(*p);
      }
      absl::StrAppendFormat(&table, "%-15s%-18s%33s%12.3g%9.4f%9.4f%+9.4f%9s%11s  %s\n",
                            NameOf(curve), label, SpreadText(p->gather), p->us_per_receiver, p->rr,
                            p->rel_rmse, p->bias, SpeedupText(*p, p->pt_seconds_at_rr),
                            SpeedupText(*p, p->irrcache_seconds_at_rr), FlagsText(*p));
    }
  }
  Append(table,
         {"\npreparation, thread-seconds once per scene: ", SpreadText(r.point_based.total),
          " (fpbgi, pbgi, dpbgi), ", SpreadText(r.path_traced.total), " (pt, irrcache), loading ",
          SpreadText(r.load), ", surfels about hits ", SpreadText(r.atlas), "\n"});
  return table;
}

}  // namespace farpoint

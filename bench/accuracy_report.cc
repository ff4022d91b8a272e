#include "bench/accuracy_report.h"

#include <algorithm>
#include <nlohmann/json.hpp>
#include <string_view>
#include <utility>
#include <vector>

#include "absl/strings/str_format.h"
#include "bench/html_page.h"
#include "bench/machine.h"
#include "bench/text.h"

namespace farpoint {

namespace {

using Json = nlohmann::ordered_json;

using Row = std::vector<std::string>;

std::string Percent(double part) { return absl::StrFormat("%+.2f %%", 100 * part); }

std::string SettingsText(const AccuracyOptions& o) {
  std::string text = o.clusters == 0 ? Concat({"--quality ", NameOf(o.quality)})
                                     : absl::StrFormat("--clusters %d", o.clusters);
  Append(text, {" --fill ", NameOf(o.fill)});
  text += absl::StrFormat(" --light-samples %d", o.light_samples);
  if (o.points != 0) text += absl::StrFormat(" --points %d", o.points);
  if (o.seed != 0) text += absl::StrFormat(" --seed %d", o.seed);
  return text;
}

std::string MachineText(const AccuracyReport& r) {
  return ::farpoint::MachineText(r.cpu, r.threads, r.load_average_start, r.load_average_end);
}

const Row kHeader = {"case",      "size",     "rr",          "± pixels",      "bar",
                     "bias",      "± pixels", "bar",         "max/mean",      "noise",
                     "beauty rr", "noise",    "us/receiver", "samples/pixel", "verdict"};

Row RowOf(const AccuracyResult& r) {
  const ErrorFigures& e = r.indirect;
  return {r.c.name,
          absl::StrFormat("%dx%d", r.c.width, r.c.height),
          absl::StrFormat("%.4f", e.rr),
          absl::StrFormat("%.4f", e.rr_error),
          absl::StrFormat("%.3f", r.c.rr_bar),
          Percent(e.bias),
          absl::StrFormat("%.2f %%", 100 * e.bias_error),
          absl::StrFormat("%.1f %%", 100 * r.c.bias_bar),
          absl::StrFormat("%.2f", e.max),
          absl::StrFormat("%.4f", e.noise),
          absl::StrFormat("%.4f", r.beauty.rr),
          absl::StrFormat("%.4f", r.beauty.noise),
          absl::StrFormat("%.1f", r.us_per_receiver),
          absl::StrFormat("%.1f", r.samples_per_pixel),
          std::string(NameOf(r.verdict))};
}

const Row kCheckHeader = {"check", "figure", "value", "±", "bar", "verdict"};

std::vector<Row> RowsOf(const AccuracyCheck& check) {
  std::vector<Row> rows;
  for (const CheckValue& v : check.values) {
    const bool barred = v.bar > 0;
    rows.push_back(
        {check.name, v.what, absl::StrFormat("%.5f", v.value),
         v.error > 0 ? absl::StrFormat("%.5f", v.error) : "",
         barred ? absl::StrFormat("%g", v.bar) : "",
         barred ? std::string(NameOf(v.value <= v.bar ? Verdict::kHolds : Verdict::kFails)) : ""});
  }
  return rows;
}

// Columns of the same width; what is not ASCII counts as one.
size_t WidthOf(std::string_view text) {
  size_t n = 0;
  for (const char c : text) n += (static_cast<unsigned char>(c) & 0xc0) != 0x80;
  return n;
}

std::string TextTable(const std::vector<Row>& rows, size_t left_columns) {
  std::vector<size_t> width;
  for (const Row& row : rows) {
    width.resize(std::max(width.size(), row.size()));
    for (size_t i = 0; i < row.size(); ++i) width[i] = std::max(width[i], WidthOf(row[i]));
  }
  std::string text;
  for (const Row& row : rows) {
    for (size_t i = 0; i < row.size(); ++i) {
      const std::string pad(width[i] - WidthOf(row[i]), ' ');
      if (i > 0) text += "  ";
      text += i < left_columns ? row[i] + pad : pad + row[i];
    }
    text += "\n";
  }
  return text;
}

Json ToJson(const ErrorFigures& e) {
  return {{"pixels", e.pixels},         {"mean", e.mean},         {"rr", e.rr},
          {"rr_error", e.rr_error},     {"rel_rmse", e.rel_rmse}, {"bias", e.bias},
          {"bias_error", e.bias_error}, {"max_over_mean", e.max}, {"noise", e.noise}};
}

absl::Status AddFigures(const std::vector<AccuracyPicture>& pictures, HtmlPage& page) {
  std::vector<HtmlFigure> figures;
  for (const AccuracyPicture& p : pictures) {
    figures.push_back({p.width, p.height, p.rgb, Concat({p.title, ": ", p.caption})});
  }
  return figures.empty() ? absl::OkStatus() : page.Figures(figures);
}

}  // namespace

std::string AccuracyTable(const AccuracyReport& r) {
  std::string text = Concat({"fpbgi ", SettingsText(r.options), "\n", MachineText(r), "\n\n"});
  std::vector<Row> rows = {kHeader};
  for (const AccuracyResult& result : r.results) rows.push_back(RowOf(result));
  if (!r.results.empty()) text += TextTable(rows, 1);
  rows = {kCheckHeader};
  for (const AccuracyCheck& check : r.checks) {
    for (Row& row : RowsOf(check)) rows.push_back(std::move(row));
  }
  if (!r.checks.empty()) Append(text, {r.results.empty() ? "" : "\n", TextTable(rows, 2)});
  for (const AccuracyCheck& check : r.checks) Append(text, {check.name, ": ", check.setup, "\n"});
  for (const LeftOut& out : r.left_out) Append(text, {"left out: ", out.name, ": ", out.why, "\n"});
  return text;
}

std::string AccuracyJson(const AccuracyReport& r) {
  Json cases = Json::array();
  for (const AccuracyResult& result : r.results) {
    const AccuracyCase& c = result.c;
    cases.push_back({{"name", c.name},
                     {"command", CommandOf(c)},
                     {"notes", result.notes},
                     {"width", c.width},
                     {"height", c.height},
                     {"triangles", result.triangles},
                     {"surfels", result.surfels},
                     {"receivers", result.receivers},
                     {"records", result.records},
                     {"bars", {{"rr", c.rr_bar}, {"rr_aim", c.rr_aim}, {"bias", c.bias_bar}}},
                     {"irradiance", ToJson(result.indirect)},
                     {"beauty", ToJson(result.beauty)},
                     {"us_per_receiver", result.us_per_receiver},
                     {"samples_per_pixel", result.samples_per_pixel},
                     {"bake_seconds", result.bake_s},
                     {"truth", result.truth},
                     {"truth_seconds", result.truth_seconds},
                     {"verdict", NameOf(result.verdict)}});
  }
  Json checks = Json::array();
  for (const AccuracyCheck& check : r.checks) {
    Json values = Json::array();
    for (const CheckValue& v : check.values) {
      values.push_back({{"what", v.what},
                        {"value", v.value},
                        {"error", v.error > 0 ? Json(v.error) : Json()},
                        {"bar", v.bar > 0 ? Json(v.bar) : Json()}});
    }
    checks.push_back({{"name", check.name},
                      {"setup", check.setup},
                      {"values", values},
                      {"verdict", NameOf(check.verdict())}});
  }
  Json left_out = Json::array();
  for (const LeftOut& out : r.left_out) left_out.push_back({{"name", out.name}, {"why", out.why}});
  const Json json = {
      {"benchmark", "accuracy"},
      {"version", FARPOINT_VERSION},
      {"date_utc", r.date_utc},
      {"quick", r.options.quick},
      {"machine",
       {{"cpu", r.cpu},
        {"threads", r.threads},
        {"load_average", {{"start", r.load_average_start}, {"end", r.load_average_end}}}}},
      {"settings",
       {{"text", SettingsText(r.options)},
        {"quality", NameOf(r.options.quality)},
        {"clusters", r.options.clusters},
        {"fill", NameOf(r.options.fill)},
        {"points", r.options.points},
        {"light_samples", r.options.light_samples},
        {"seed", r.options.seed}}},
      {"cases", cases},
      {"checks", checks},
      {"left_out", left_out},
  };
  return json.dump(2) + "\n";
}

absl::StatusOr<std::string> AccuracyHtml(const AccuracyReport& r) {
  HtmlPage page("farpoint: error against ground truth");
  std::vector<HtmlFact> facts = {{"Version", Concat({FARPOINT_VERSION, ", ", r.date_utc})},
                                 {"Measured", "fpbgi " + SettingsText(r.options)},
                                 {"Machine", MachineText(r)}};
  if (r.options.quick) facts.push_back({"Quick run", "it shows that all works, not how well"});
  page.Facts(facts);
  page.Paragraph(
      "rr is √mean((a−b)²)/mean(b) of the indirect irradiance a against the truth b, over pixels "
      "and channels, with the truth's own noise taken out in quadrature; bias is "
      "mean(a−b)/mean(b). ± is the standard error from the choice of pixels. Beauty is direct and "
      "indirect light reflected, without what emits. The verdict is on rr and bias of the "
      "irradiance.");
  HtmlTable table{kHeader, {}, 2};
  for (const AccuracyResult& result : r.results) table.rows.push_back(RowOf(result));
  if (!table.rows.empty()) page.Table(table);
  HtmlTable checks{kCheckHeader, {}, 2};
  for (const AccuracyCheck& check : r.checks) {
    for (Row& row : RowsOf(check)) checks.rows.push_back(std::move(row));
  }
  if (!checks.rows.empty()) page.Table(checks);
  if (!r.left_out.empty()) {
    std::vector<HtmlFact> left_out;
    for (const LeftOut& out : r.left_out) left_out.push_back({"Left out: " + out.name, out.why});
    page.Facts(left_out);
  }
  for (const AccuracyResult& result : r.results) {
    page.Heading(result.c.name);
    facts = {
        {"Command", "farpoint render " + CommandOf(result.c)},
        {"Truth", absl::StrFormat("%s; %.0f thread-seconds", result.truth, result.truth_seconds)},
        {"Scene",
         absl::StrFormat("%d triangles, %d surfels; %d records for %d receivers", result.triangles,
                         result.surfels, result.records, result.receivers)}};
    page.Facts(facts);
    FP_RETURN_IF_ERROR(AddFigures(result.pictures, page));
  }
  for (const AccuracyCheck& check : r.checks) {
    page.Heading(check.name);
    page.Paragraph(check.setup);
    FP_RETURN_IF_ERROR(AddFigures(check.pictures, page));
  }
  return std::move(page).Finish();
}

}  // namespace farpoint

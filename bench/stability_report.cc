#include "bench/stability_report.h"

#include <algorithm>
#include <cmath>
#include <map>
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

constexpr const char* kIntegrators[] = {"fpbgi", "pbgi", "pt", "scene"};

std::string MachineText(const StabilityReport& r) {
  return ::farpoint::MachineText(r.cpu, r.threads, r.load_average_start, r.load_average_end);
}

std::string SettingsText(const StabilityOptions& o) {
  return absl::StrFormat("--points %d --light-samples %d --seed %d", o.points, o.light_samples,
                         o.seed);
}

std::string SummaryText(const StabilityReport& r) {
  size_t figures = 0, failing = 0;
  for (const StabilityResult& result : r.results) {
    figures += result.values.size();
    failing += result.failures() > 0;
  }
  return absl::StrFormat("%d figures in %d cases and scenes; %d figures above their bar, in %d",
                         figures, r.results.size(), r.failures(), failing);
}

// "3 hold", "2 of 5 FAIL" or "": of one integrator.
std::string Held(const StabilityResult& result, std::string_view integrator) {
  size_t all = 0, failing = 0;
  for (const StabilityValue& v : result.values) {
    if (v.integrator != integrator) continue;
    ++all;
    failing += !v.holds();
  }
  if (all == 0) return "";
  return failing == 0 ? absl::StrFormat("%d hold", all)
                      : absl::StrFormat("%d of %d FAIL", failing, all);
}

std::string Number(double value) { return absl::StrFormat("%.3g", value); }

Json Finite(double value) { return std::isfinite(value) ? Json(value) : Json(); }

}  // namespace

std::string StabilityTable(const StabilityReport& r) {
  std::string text = Concat({SettingsText(r.options), "\n", MachineText(r), "\n\n"});
  text += absl::StrFormat("%-22s%-30s", "case", "scene");
  for (const char* name : kIntegrators) text += absl::StrFormat("%-14s", name);
  text += "seconds\n";
  for (const StabilityResult& result : r.results) {
    text += absl::StrFormat("%-22s%-30s", result.name, result.scene);
    for (const char* name : kIntegrators) text += absl::StrFormat("%-14s", Held(result, name));
    text += absl::StrFormat("%7.1f\n", result.seconds);
  }
  for (const LeftOut& out : r.left_out) Append(text, {"left out: ", out.name, ": ", out.why, "\n"});
  if (r.failures() > 0) text += "\nabove their bar:\n";
  for (const StabilityResult& result : r.results) {
    for (const StabilityValue& v : result.values) {
      if (v.holds()) continue;
      Append(text, {"  ", result.name, ", ", result.scene, ", ", v.integrator, ", ", v.what, ": ",
                    Number(v.value), " > ", Number(v.bar), "\n"});
    }
  }
  Append(text, {"\n", SummaryText(r), "\n"});
  return text;
}

std::string StabilityJson(const StabilityReport& r) {
  Json cases = Json::array();
  for (const StabilityResult& result : r.results) {
    Json values = Json::array();
    for (const StabilityValue& v : result.values) {
      values.push_back({{"integrator", v.integrator},
                        {"what", v.what},
                        {"value", Finite(v.value)},
                        {"reference_noise", v.noise > 0 ? Json(v.noise) : Json()},
                        {"bar", v.bar},
                        {"holds", v.holds()}});
    }
    cases.push_back({{"name", result.name},
                     {"group", result.group},
                     {"scene", result.scene},
                     {"check", result.check},
                     {"values", values},
                     {"failures", result.failures()},
                     {"seconds", result.seconds}});
  }
  Json left_out = Json::array();
  for (const LeftOut& out : r.left_out) left_out.push_back({{"name", out.name}, {"why", out.why}});
  const Json json = {
      {"benchmark", "stability"},
      {"version", FARPOINT_VERSION},
      {"date_utc", r.date_utc},
      {"quick", r.options.quick},
      {"machine",
       {{"cpu", r.cpu},
        {"threads", r.threads},
        {"load_average", {{"start", r.load_average_start}, {"end", r.load_average_end}}}}},
      {"settings",
       {{"points", r.options.points},
        {"light_samples", r.options.light_samples},
        {"seed", r.options.seed}}},
      {"failures", r.failures()},
      {"cases", cases},
      {"left_out", left_out},
  };
  return json.dump(2) + "\n";
}

std::string StabilityHtml(const StabilityReport& r) {
  HtmlPage page("farpoint: numerical stability");
  std::vector<HtmlFact> facts = {{"Version", Concat({FARPOINT_VERSION, ", ", r.date_utc})},
                                 {"Settings", SettingsText(r.options)},
                                 {"Machine", MachineText(r)},
                                 {"Result", SummaryText(r)}};
  if (r.options.quick) facts.push_back({"Quick run", "the Cornell box only, small"});
  for (const LeftOut& out : r.left_out) facts.push_back({"Left out: " + out.name, out.why});
  page.Facts(facts);
  page.Paragraph(
      "Each case changes a scene, or is one, and holds what fpbgi, pbgi and pt make of it against "
      "what must come out. rr is the root mean square difference of indirect irradiance over its "
      "mean, the noise of a path-traced reference taken out in quadrature.");
  HtmlTable overview{
      {"case", "group", "scene", "fpbgi", "pbgi", "pt", "scene itself", "seconds"}, {}, 3};
  for (const StabilityResult& result : r.results) {
    std::vector<std::string> row = {result.name, result.group, result.scene};
    for (const char* name : kIntegrators) row.push_back(Held(result, name));
    row.push_back(absl::StrFormat("%.1f", result.seconds));
    overview.rows.push_back(std::move(row));
  }
  if (!overview.rows.empty()) page.Table(overview);
  for (const StabilityResult& result : r.results) {
    page.Heading(Concat({result.name, ", ", result.scene}));
    page.Paragraph(result.check);
    HtmlTable table{
        {"integrator", "figure", "value", "reference's noise", "bar", "verdict"}, {}, 2};
    for (const StabilityValue& v : result.values) {
      table.rows.push_back({v.integrator, v.what, Number(v.value),
                            v.noise > 0 ? Number(v.noise) : "", Number(v.bar),
                            v.holds() ? "holds" : "FAILS"});
    }
    if (!table.rows.empty()) page.Table(table);
  }
  return std::move(page).Finish();
}

}  // namespace farpoint

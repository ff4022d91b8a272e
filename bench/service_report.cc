#include "bench/service_report.h"

#include <cmath>
#include <nlohmann/json.hpp>
#include <utility>

#include "absl/strings/str_format.h"
#include "bench/html_page.h"
#include "bench/text.h"

namespace farpoint {

namespace {

using Json = nlohmann::ordered_json;

std::string Number(double value) {
  if (value == std::floor(value) && std::abs(value) < 1e15) return absl::StrFormat("%.0f", value);
  return absl::StrFormat("%.4g", value);
}

std::string BoundText(const ServiceCheck& check) {
  if (check.kind == ServiceCheck::Kind::kFigure) return "";
  return (check.at_least ? ">= " : "<= ") + Number(check.bound);
}

std::string_view KindName(ServiceCheck::Kind kind) {
  switch (kind) {
    case ServiceCheck::Kind::kCount:
      return "count";
    case ServiceCheck::Kind::kTime:
      return "time";
    case ServiceCheck::Kind::kFigure:
      break;
  }
  return "figure";
}

std::string Verdict(const ServiceCheck& check) {
  if (check.kind == ServiceCheck::Kind::kFigure) return "";
  if (check.holds()) return "holds";
  return check.kind == ServiceCheck::Kind::kTime ? "late" : "FAILS";
}

std::string MachineText(const ServiceReport& r) {
  return absl::StrFormat("%s, %d cores, load %.1f at the start and %.1f at the end", r.cpu, r.cores,
                         r.load_average_start, r.load_average_end);
}

std::string SummaryText(const ServiceReport& r) {
  size_t checks = 0;
  for (const ServiceResult& result : r.results) checks += result.checks.size();
  return absl::StrFormat("%d checks in %d cases; %d fail, %d times are over their bound", checks,
                         r.results.size(), r.failures(), r.late());
}

}  // namespace

std::string ServiceTable(const ServiceReport& r) {
  std::string text = Concat({MachineText(r), "\n"});
  for (const ServiceResult& result : r.results) {
    text += absl::StrFormat("\n%s  (%.0f s, load %.1f)\n", result.name, result.seconds,
                            result.load_average);
    for (const ServiceCheck& check : result.checks) {
      text += absl::StrFormat("  %-66s %12s  %-12s %s\n", check.what, Number(check.value),
                              BoundText(check), Verdict(check));
    }
    for (const std::string& note : result.notes) Append(text, {"  note: ", note, "\n"});
    if (!result.error.empty()) Append(text, {"  FAILS: ", result.error, "\n"});
  }
  Append(text, {"\n", SummaryText(r), "\n"});
  return text;
}

std::string ServiceJson(const ServiceReport& r) {
  Json cases = Json::array();
  for (const ServiceResult& result : r.results) {
    Json checks = Json::array();
    for (const ServiceCheck& check : result.checks) {
      const bool bounded = check.kind != ServiceCheck::Kind::kFigure;
      checks.push_back({{"what", check.what},
                        {"kind", KindName(check.kind)},
                        {"value", std::isfinite(check.value) ? Json(check.value) : Json()},
                        {"bound", bounded ? Json(check.bound) : Json()},
                        {"at_least", check.at_least},
                        {"holds", check.holds()}});
    }
    cases.push_back({{"name", result.name},
                     {"check", result.check},
                     {"checks", checks},
                     {"notes", result.notes},
                     {"error", result.error},
                     {"failures", result.failures()},
                     {"late", result.late()},
                     {"seconds", result.seconds},
                     {"load_average", result.load_average}});
  }
  const Json json = {
      {"benchmark", "service"},
      {"version", FARPOINT_VERSION},
      {"date_utc", r.date_utc},
      {"quick", r.options.quick},
      {"seed", r.options.seed},
      {"machine",
       {{"cpu", r.cpu},
        {"cores", r.cores},
        {"load_average", {{"start", r.load_average_start}, {"end", r.load_average_end}}}}},
      {"failures", r.failures()},
      {"late", r.late()},
      {"cases", cases},
  };
  return json.dump(2) + "\n";
}

std::string ServiceHtml(const ServiceReport& r) {
  HtmlPage page("farpoint: the service under fire");
  std::vector<HtmlFact> facts = {{"Version", Concat({FARPOINT_VERSION, ", ", r.date_utc})},
                                 {"Machine", MachineText(r)},
                                 {"Result", SummaryText(r)}};
  if (r.options.quick) facts.push_back({"Quick run", "few of everything"});
  page.Facts(facts);
  page.Paragraph(
      "Counts must hold on any machine. Times are bounds for an idle one and only told otherwise.");
  for (const ServiceResult& result : r.results) {
    page.Heading(result.name);
    page.Paragraph(result.check);
    if (!result.error.empty()) page.Paragraph("Not run to its end: " + result.error);
    HtmlTable table{{"check", "value", "bound", "verdict"}, {}, 1};
    for (const ServiceCheck& check : result.checks) {
      table.rows.push_back({check.what, Number(check.value), BoundText(check), Verdict(check)});
    }
    if (!table.rows.empty()) page.Table(table);
    for (const std::string& note : result.notes) page.Paragraph("Note: " + note);
  }
  return std::move(page).Finish();
}

}  // namespace farpoint

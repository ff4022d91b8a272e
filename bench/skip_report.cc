#include "bench/skip_report.h"

#include <nlohmann/json.hpp>
#include <utility>
#include <vector>

#include "absl/strings/str_format.h"
#include "bench/html_page.h"
#include "bench/machine.h"
#include "bench/text.h"

namespace farpoint {

namespace {

using Json = nlohmann::ordered_json;

std::string MachineText(const SkipReport& r) {
  return ::farpoint::MachineText(r.cpu, r.threads, r.load_average_start, r.load_average_end);
}

std::string SettingsText(const SkipOptions& o) {
  return absl::StrFormat("--points %d --light-samples %d --seed %d --repeat %d", o.points,
                         o.light_samples, o.seed, o.repeat);
}

// "saves 63 %", "costs 0.4 %".
std::string EffectText(const SkipSide& side) {
  const double percent = 100 * (side.ratio - 1);
  return absl::StrFormat("%s %.1f %%", percent < 0 ? "saves" : "costs", std::abs(percent));
}

std::string SpreadText(const SkipSide& side) {
  return absl::StrFormat("%+.1f … %+.1f %%", 100 * (side.ratio_low - 1),
                         100 * (side.ratio_high - 1));
}

std::string ImageText(const SkipSide& side) {
  return side.bits_equal ? "same bits" : absl::StrFormat("rr %.2g, bias %+.2g", side.rr, side.bias);
}

}  // namespace

std::string SkipTable(const SkipReport& r) {
  std::string text = Concat({SettingsText(r.options), "\n", MachineText(r), "\n\n"});
  text += absl::StrFormat("%-17s%-58s%12s %10s %10s  %-14s%-20s%s\n", "item", "scene", "skipped",
                          "with, s", "without", "effect", "quartiles", "image");
  for (const SkipRow& row : r.rows) {
    for (const SkipSide& side : row.sides) {
      text += absl::StrFormat("%-17s%-58s%12d %10.4f %10.4f  %-14s%-20s %s\n", row.name, side.scene,
                              side.skipped, side.with_s, side.without_s, EffectText(side),
                              SpreadText(side), ImageText(side));
    }
  }
  for (const LeftOut& out : r.left_out) Append(text, {"left out: ", out.name, ": ", out.why, "\n"});
  for (const SkipRow& row : r.rows) {
    for (const std::string& failure : row.failures()) {
      Append(text, {"FAILS: ", row.name, ": ", failure, "\n"});
    }
  }
  return text;
}

std::string SkipJson(const SkipReport& r) {
  Json rows = Json::array();
  for (const SkipRow& row : r.rows) {
    Json sides = Json::array();
    for (const SkipSide& side : row.sides) {
      sides.push_back({{"profits", side.profits},
                       {"scene", side.scene},
                       {"skipped", side.skipped},
                       {"seconds_with", side.with_s},
                       {"seconds_without", side.without_s},
                       {"ratio",
                        {{"median", side.ratio},
                         {"lower_quartile", side.ratio_low},
                         {"upper_quartile", side.ratio_high}}},
                       {"bits_equal", side.bits_equal},
                       {"rr", side.rr},
                       {"bias", side.bias}});
    }
    rows.push_back({{"name", row.name},
                    {"counter", row.counter},
                    {"what", row.what},
                    {"exact", row.exact},
                    {"rr_bar", row.exact ? Json() : Json(row.rr_bar)},
                    {"sides", sides},
                    {"failures", row.failures()}});
  }
  Json left_out = Json::array();
  for (const LeftOut& out : r.left_out) left_out.push_back({{"name", out.name}, {"why", out.why}});
  const Json json = {
      {"benchmark", "skip"},
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
        {"seed", r.options.seed},
        {"repeat", r.options.repeat}}},
      {"failures", r.failures()},
      {"rows", rows},
      {"left_out", left_out},
  };
  return json.dump(2) + "\n";
}

std::string SkipHtml(const SkipReport& r) {
  HtmlPage page("farpoint: what is not computed");
  std::vector<HtmlFact> facts = {{"Version", Concat({FARPOINT_VERSION, ", ", r.date_utc})},
                                 {"Settings", SettingsText(r.options)},
                                 {"Machine", MachineText(r)},
                                 {"Failures", absl::StrFormat("%d", r.failures())}};
  if (r.options.quick) facts.push_back({"Quick run", "small frames, one round: times say nothing"});
  for (const LeftOut& out : r.left_out) facts.push_back({"Left out: " + out.name, out.why});
  page.Facts(facts);
  page.Paragraph(
      "Each item is left out and computed all the same, in turn, on the same scene. Seconds are "
      "processor seconds, medians of the rounds; effect and quartiles are of the ratio within each "
      "round. Where there is nothing to leave out, the effect is what it costs to ask.");
  HtmlTable table{{"item", "what", "scene", "there is", "image", "skipped", "with, s", "without, s",
                   "effect", "quartiles"},
                  {},
                  5};
  for (const SkipRow& row : r.rows) {
    for (const SkipSide& side : row.sides) {
      table.rows.push_back(
          {row.name, row.what, side.scene, side.profits ? "much of it" : "nothing", ImageText(side),
           absl::StrFormat("%d", side.skipped), absl::StrFormat("%.4f", side.with_s),
           absl::StrFormat("%.4f", side.without_s), EffectText(side), SpreadText(side)});
    }
  }
  if (!table.rows.empty()) page.Table(table);
  for (const SkipRow& row : r.rows) {
    for (const std::string& failure : row.failures()) {
      page.Paragraph(Concat({"FAILS: ", row.name, ": ", failure}));
    }
  }
  return std::move(page).Finish();
}

}  // namespace farpoint

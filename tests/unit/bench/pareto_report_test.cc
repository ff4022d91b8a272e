#include "bench/pareto_report.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <algorithm>
#include <nlohmann/json.hpp>

#include "tests/unit/bench/pareto_testing.h"

namespace farpoint {
namespace {

using ::testing::HasSubstr;
using ::testing::Not;
using Json = nlohmann::json;

void ExpectKeys(const Json& object, const std::vector<std::string>& keys) {
  for (const std::string& key : keys) EXPECT_TRUE(object.contains(key)) << key;
  EXPECT_EQ(object.size(), keys.size());
}

TEST(ParetoJson, HasEveryKey) {
  ASSERT_TRUE(TinyReport().ok()) << TinyReport().status();
  const Json json = Json::parse(ParetoJson(*TinyReport()));
  ExpectKeys(json, {"benchmark", "version", "date_utc", "quick", "machine", "scene", "film",
                    "settings", "reference", "preparation", "curves"});
  ExpectKeys(json["machine"], {"cpu", "threads", "load_average"});
  ExpectKeys(json["scene"],
             {"name", "changes", "notes", "triangles", "surfels", "nodes", "bytes", "hash"});
  ExpectKeys(json["film"], {"width", "height", "spp", "receivers", "compared_pixels"});
  ExpectKeys(json["settings"], {"seed", "light_samples", "repeat", "buffer_map", "splat"});
  ExpectKeys(json["reference"],
             {"kind", "file", "layer", "mask", "paths", "seconds", "mean", "noise"});
  ExpectKeys(json["preparation"], {"point_based", "pt", "load", "atlas"});
  ExpectKeys(json["preparation"]["point_based"], {"import", "sample", "shade", "tree", "total"});
  ASSERT_EQ(json["curves"].size(), 6u);
  for (const Json& curve : json["curves"]) {
    ExpectKeys(curve, {"curve", "points"});
    for (const Json& p : curve["points"]) {
      ExpectKeys(p, {"label",
                     "quality",
                     "clusters",
                     "epsilon",
                     "microbuffer",
                     "paths",
                     "cache_error",
                     "seconds",
                     "wall_seconds",
                     "us_per_receiver",
                     "rr",
                     "rel_rmse",
                     "bias",
                     "reference_limited",
                     "noise_above_error",
                     "on_front",
                     "pt_seconds_at_rr",
                     "irrcache_seconds_at_rr",
                     "counts",
                     "hash"});
      ExpectKeys(p["seconds"], {"gather", "primary", "direct", "cluster", "cut", "raster",
                                "composite", "convolve", "trace"});
      ExpectKeys(p["seconds"]["gather"], {"median", "min", "max"});
    }
  }
}

TEST(ParetoJson, GatherIsTheSumOfItsStages) {
  ASSERT_TRUE(TinyReport().ok()) << TinyReport().status();
  ParetoReport report = *TinyReport();
  const Json json = Json::parse(ParetoJson(report));
  for (const Json& curve : json["curves"]) {
    for (const Json& p : curve["points"]) {
      // Of two repeats the median is the mean, and means add up.
      double sum = 0;
      for (const char* stage : {"cluster", "cut", "raster", "composite", "convolve", "trace"}) {
        sum += p["seconds"][stage]["median"].get<double>();
      }
      EXPECT_NEAR(p["seconds"]["gather"]["median"].get<double>(), sum, 1e-9 + 1e-6 * sum);
    }
  }
}

TEST(ParetoJson, SettingsThatDoNotExistAreNull) {
  ASSERT_TRUE(TinyReport().ok()) << TinyReport().status();
  const Json json = Json::parse(ParetoJson(*TinyReport()));
  struct Case {
    size_t curve;
    const char* name;
    std::vector<const char*> numbers;
  };
  for (const Case& c :
       {Case{0, "fpbgi adaptive", {}}, Case{1, "fpbgi k", {"clusters", "epsilon", "microbuffer"}},
        Case{2, "pbgi", {"microbuffer"}}, Case{3, "dpbgi", {"microbuffer"}},
        Case{4, "pt", {"paths"}}, Case{5, "irrcache", {"paths", "cache_error"}}}) {
    EXPECT_EQ(json["curves"][c.curve]["curve"], c.name);
    const Json& point = json["curves"][c.curve]["points"][0];
    EXPECT_EQ(point["quality"].is_string(), c.curve == 0);
    for (const char* key : {"clusters", "epsilon", "microbuffer", "paths", "cache_error"}) {
      const bool has = std::find_if(c.numbers.begin(), c.numbers.end(), [&](const char* number) {
                         return std::string_view(number) == key;
                       }) != c.numbers.end();
      EXPECT_EQ(point[key].is_number(), has) << c.name << " " << key;
      EXPECT_EQ(point[key].is_null(), !has) << c.name << " " << key;
    }
  }
  EXPECT_TRUE(json["scene"]["changes"]["sun"].is_null());
  EXPECT_EQ(json["reference"]["kind"], "pt");
  EXPECT_TRUE(json["reference"]["file"].is_null());
}

TEST(ParetoJson, CurvesRunFromFastToSlow) {
  ASSERT_TRUE(TinyReport().ok()) << TinyReport().status();
  const Json json = Json::parse(ParetoJson(*TinyReport()));
  for (const Json& curve : json["curves"]) {
    double last = 0;
    for (const Json& p : curve["points"]) {
      const double seconds = p["seconds"]["gather"]["median"];
      EXPECT_GE(seconds, last);
      last = seconds;
    }
  }
}

TEST(ParetoJson, NameThatIsNoUtf8StaysJson) {
  ParetoReport report;
  report.options.scene = "a\xff.gltf";
  EXPECT_TRUE(Json::accept(ParetoJson(report)));
}

TEST(ParetoHtml, IsSelfContained) {
  ASSERT_TRUE(TinyReport().ok()) << TinyReport().status();
  const std::string html = ParetoHtml(*TinyReport());
  EXPECT_THAT(html, HasSubstr("<svg"));
  EXPECT_THAT(html, HasSubstr("</html>"));
  for (const char* loads : {"<script", "src=", "href=", "url(", "@import", "<link", "<iframe"}) {
    EXPECT_THAT(html, Not(HasSubstr(loads)));
  }
  // The only address is the name of SVG's namespace.
  size_t at = 0, addresses = 0;
  while ((at = html.find("http", at)) != std::string::npos) ++addresses, ++at;
  EXPECT_EQ(addresses, 1u);
}

TEST(ParetoHtml, EveryPointIsInPlotAndTable) {
  ASSERT_TRUE(TinyReport().ok()) << TinyReport().status();
  const std::string html = ParetoHtml(*TinyReport());
  for (const ParetoPoint& p : TinyReport()->points) {
    EXPECT_THAT(html, HasSubstr("'>" + LabelOf(p) + "</td>"));
    if (p.rr > 0) {
      EXPECT_THAT(html,
                  HasSubstr("<title>" + std::string(NameOf(p.curve())) + " " + LabelOf(p) + ": "));
    }
  }
}

TEST(ParetoHtml, NamesAreEscaped) {
  ParetoReport report;
  report.options.scene = "<script>alert(1)</script>.gltf";
  report.notes = {"<b>"};
  const std::string html = ParetoHtml(report);
  EXPECT_THAT(html, Not(HasSubstr("<script>")));
  EXPECT_THAT(html, Not(HasSubstr("<b>")));
}

TEST(ParetoHtml, PointsWithoutPlaceAreSaid) {
  ParetoReport report;
  report.points.resize(2);
  report.points[0].integrator = Integrator::kPt;
  report.points[0].gather = {1, 1, 1};
  report.points[0].rr = 0.1;
  report.points[1] = report.points[0];
  report.points[1].rr = 0;
  EXPECT_THAT(ParetoHtml(report), HasSubstr(" 1 points are zero in one of the two"));
}

TEST(ParetoTable, SaysTimeAndErrorOfEveryPoint) {
  ASSERT_TRUE(TinyReport().ok()) << TinyReport().status();
  const std::string table = ParetoTable(*TinyReport());
  for (const char* word : {"gather s", "rr", "bias", "reference", "preparation", "4 paths",
                           "k=8 eps=0.1 16px", "draft", "a=0.2 64 rays", "x irrcache"}) {
    EXPECT_THAT(table, HasSubstr(word));
  }
  const auto lines = std::count(table.begin(), table.end(), '\n');
  EXPECT_GE(lines, static_cast<std::ptrdiff_t>(TinyReport()->points.size()) + 6);
}

TEST(ParetoTable, NoiseAboveAnErrorIsSaid) {
  ParetoReport report;
  report.points.resize(2);
  report.points[0].integrator = report.points[1].integrator = Integrator::kPt;
  report.points[0].paths = 64;
  report.points[1].paths = 256;
  report.reference_noise = 0.03;
  EXPECT_FALSE(NoiseWarning(report).has_value());
  EXPECT_THAT(ParetoHtml(report), Not(HasSubstr("Warning")));
  report.points[1].noise_above_error = report.points[1].reference_limited = true;
  ASSERT_TRUE(NoiseWarning(report).has_value());
  EXPECT_THAT(*NoiseWarning(report), HasSubstr("0.03"));
  EXPECT_THAT(*NoiseWarning(report), HasSubstr("pt 256 paths"));
  EXPECT_THAT(*NoiseWarning(report), Not(HasSubstr("64 paths")));
  EXPECT_THAT(ParetoTable(report), HasSubstr("noise above error"));
  EXPECT_THAT(ParetoHtml(report), HasSubstr("Warning"));
  const Json json = Json::parse(ParetoJson(report));
  EXPECT_EQ(json["curves"][4]["points"][0]["noise_above_error"], false);
  EXPECT_EQ(json["curves"][4]["points"][1]["noise_above_error"], true);
}

TEST(ParetoTable, UnknownNoiseIsSaid) {
  ParetoReport report;
  report.options.reference_path = "r.exr";
  EXPECT_THAT(ParetoTable(report), HasSubstr("noise unknown"));
  report.reference_noise_known = true;
  report.reference_noise = 0.0052;
  EXPECT_THAT(ParetoTable(report), HasSubstr("0.0052"));
}

}  // namespace
}  // namespace farpoint

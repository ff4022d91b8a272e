#include "bench/pareto.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cmath>
#include <set>

#include "core/image/exr_io.h"
#include "tests/unit/bench/pareto_testing.h"
#include "tests/unit/bench/temp_folder.h"

namespace farpoint {
namespace {

using ::testing::HasSubstr;

std::vector<const ParetoPoint*> PointsOf(const ParetoReport& report, ParetoCurve curve) {
  std::vector<const ParetoPoint*> points;
  for (const ParetoPoint& p : report.points) {
    if (p.curve() == curve) points.push_back(&p);
  }
  return points;
}

TEST(Pareto, SpreadIsMedianMinMax) {
  const Spread odd = SpreadOf({3, 1, 2});
  EXPECT_EQ(odd.median, 2);
  EXPECT_EQ(odd.min, 1);
  EXPECT_EQ(odd.max, 3);
  EXPECT_EQ(SpreadOf({4, 1, 2, 3}).median, 2.5);
  EXPECT_EQ(SpreadOf({7}).median, 7);
}

TEST(Pareto, EveryCurveHasItsPoints) {
  ASSERT_TRUE(TinyReport().ok()) << TinyReport().status();
  const ParetoReport& r = *TinyReport();
  std::set<uint32_t> k, buffers;
  std::set<double> epsilons;
  for (const ParetoPoint* p : PointsOf(r, ParetoCurve::kKMeans)) {
    k.insert(p->clusters);
    epsilons.insert(p->epsilon);
    buffers.insert(p->microbuffer);
  }
  EXPECT_GE(k.size(), 2u);
  EXPECT_GE(epsilons.size(), 2u);
  EXPECT_GE(buffers.size(), 2u);
  EXPECT_GE(PointsOf(r, ParetoCurve::kPbgi).size(), 2u);
  EXPECT_GE(PointsOf(r, ParetoCurve::kDpbgi).size(), 2u);
  EXPECT_GE(PointsOf(r, ParetoCurve::kPt).size(), 3u);
  std::set<Quality> qualities;
  for (const ParetoPoint* p : PointsOf(r, ParetoCurve::kAdaptive)) qualities.insert(*p->quality);
  EXPECT_EQ(qualities.size(), 3u);
  std::set<double> errors;
  std::set<uint32_t> rays;
  for (const ParetoPoint* p : PointsOf(r, ParetoCurve::kIrrcache)) {
    errors.insert(p->cache_error);
    rays.insert(p->paths);
  }
  EXPECT_GE(errors.size(), 2u);
  EXPECT_GE(rays.size(), 2u);
}

TEST(Pareto, TimesArePositiveAndErrorsFinite) {
  ASSERT_TRUE(TinyReport().ok()) << TinyReport().status();
  const ParetoReport& r = *TinyReport();
  for (const ParetoPoint& p : r.points) {
    SCOPED_TRACE(LabelOf(p));
    EXPECT_GT(p.gather.min, 0);
    EXPECT_LE(p.gather.min, p.gather.median);
    EXPECT_LE(p.gather.median, p.gather.max);
    EXPECT_GT(p.wall.min, 0);
    EXPECT_GT(p.us_per_receiver, 0);
    EXPECT_TRUE(std::isfinite(p.rel_rmse) && p.rel_rmse > 0);
    EXPECT_TRUE(std::isfinite(p.rr) && p.rr >= 0);
    EXPECT_TRUE(std::isfinite(p.bias));
    EXPECT_LE(p.rr, p.rel_rmse);
    EXPECT_EQ(p.hash.size(), 64u);
    // Irradiance alone is rendered: no time may hide in other stages.
    EXPECT_LT(p.stage[static_cast<int>(Stage::kDirect)].max, p.gather.max);
    const ParetoCurve curve = p.curve();
    const bool by_rays = curve == ParetoCurve::kPt || curve == ParetoCurve::kIrrcache ||
                         curve == ParetoCurve::kAdaptive;
    EXPECT_EQ(p.stage[static_cast<int>(Stage::kTrace)].median > 0, by_rays);
    EXPECT_EQ(p.stage[static_cast<int>(Stage::kRaster)].median > 0, !by_rays);
  }
  EXPECT_GT(r.point_based.total.min, r.path_traced.total.min);
  EXPECT_GT(r.point_based.stage[static_cast<int>(Stage::kTree)].min, 0);
  EXPECT_EQ(r.path_traced.stage[static_cast<int>(Stage::kTree)].max, 0);
  EXPECT_GT(r.load.min, 0);
}

TEST(Pareto, PathTracersErrorFallsWithPaths) {
  ASSERT_TRUE(TinyReport().ok()) << TinyReport().status();
  const auto points = PointsOf(*TinyReport(), ParetoCurve::kPt);
  for (size_t i = 0; i + 1 < points.size(); ++i) {
    EXPECT_LT(points[i]->paths, points[i + 1]->paths);
    EXPECT_GT(points[i]->rel_rmse, points[i + 1]->rel_rmse);
  }
}

TEST(Pareto, AllSeeTheSameReceiversAndSurfels) {
  ASSERT_TRUE(TinyReport().ok()) << TinyReport().status();
  const ParetoReport& r = *TinyReport();
  EXPECT_GT(r.receivers, 0u);
  EXPECT_LE(r.receivers, 32u * 32u);
  // Without a mask the pixels that hit are compared.
  EXPECT_EQ(r.compared_pixels, r.receivers);
  EXPECT_NEAR(static_cast<double>(r.surfels), 4000.0, 400.0);
  for (const ParetoPoint& p : r.points) EXPECT_EQ(p.counts.at("receivers"), r.receivers);
  EXPECT_TRUE(r.reference_noise_known);
  EXPECT_GT(r.reference_noise, 0);
  EXPECT_GT(r.reference_mean, 0);
  EXPECT_GT(r.reference_seconds, 0);
}

TEST(Pareto, AnotherRunHasTheSameErrors) {
  ASSERT_TRUE(TinyReport().ok()) << TinyReport().status();
  ParetoOptions options = TinyOptions();
  options.threads = 1;
  const auto again = RunPareto(options, [](std::string_view) {});
  ASSERT_TRUE(again.ok()) << again.status();
  ASSERT_EQ(again->points.size(), TinyReport()->points.size());
  for (size_t i = 0; i < again->points.size(); ++i) {
    EXPECT_EQ(again->points[i].hash, TinyReport()->points[i].hash);
    EXPECT_EQ(again->points[i].rr, TinyReport()->points[i].rr);
  }
  EXPECT_EQ(again->tree_hash, TinyReport()->tree_hash);
}

ParetoPoint Made(Integrator integrator, double seconds, double rr) {
  ParetoPoint p;
  p.integrator = integrator;
  p.gather = {seconds, seconds, seconds};
  p.rr = p.rel_rmse = rr;
  return p;
}

TEST(Pareto, FrontHoldsWhatNothingBeats) {
  std::vector<ParetoPoint> points = {
      Made(Integrator::kFpbgi, 1, 0.4), Made(Integrator::kFpbgi, 2, 0.5),
      Made(Integrator::kFpbgi, 3, 0.2), Made(Integrator::kFpbgi, 3, 0.3),
      Made(Integrator::kPt, 0.5, 0.1)};  // beats all, but is of another integrator
  AnalysePoints(points);
  EXPECT_TRUE(points[0].on_front);
  EXPECT_FALSE(points[1].on_front);
  EXPECT_TRUE(points[2].on_front);
  EXPECT_FALSE(points[3].on_front);
  EXPECT_TRUE(points[4].on_front);
}

TEST(Pareto, KindsOfClustersAreCurvesOfTheirOwn) {
  std::vector<ParetoPoint> points = {Made(Integrator::kFpbgi, 1, 0.1),
                                     Made(Integrator::kFpbgi, 2, 0.2)};
  points[1].clusters = 16;
  AnalysePoints(points);
  EXPECT_TRUE(points[0].on_front);
  EXPECT_TRUE(points[1].on_front);  // beaten by another curve only
}

TEST(Pareto, CachesTimeIsThatOfItsFront) {
  std::vector<ParetoPoint> points = {
      Made(Integrator::kIrrcache, 1, 0.4), Made(Integrator::kIrrcache, 4, 0.1),
      Made(Integrator::kIrrcache, 9, 0.3),  // beaten, counts for nothing
      Made(Integrator::kFpbgi, 1, 0.2), Made(Integrator::kPt, 1, 0.2)};
  AnalysePoints(points);
  EXPECT_NEAR(points[3].irrcache_seconds_at_rr.value_or(0), 2.0, 1e-12);
  EXPECT_FALSE(points[0].irrcache_seconds_at_rr.has_value());
  EXPECT_FALSE(points[4].irrcache_seconds_at_rr.has_value());  // pt is measured by pt alone
}

TEST(Pareto, CurvesHaveNames) {
  const char* names[] = {"adaptive", "k", "pbgi", "dpbgi", "pt", "irrcache"};
  for (int i = 0; i < kParetoCurveCount; ++i) {
    const auto curve = ParetoCurveFromName(names[i]);
    ASSERT_TRUE(curve.ok()) << curve.status();
    EXPECT_EQ(*curve, static_cast<ParetoCurve>(i));
  }
  EXPECT_THAT(std::string(ParetoCurveFromName("fpbgi").status().message()),
              HasSubstr("adaptive, k, pbgi, dpbgi, pt, irrcache"));
}

TEST(Pareto, ChangedSceneAndChosenCurves) {
  ParetoOptions options = TinyOptions();
  options.curves = {ParetoCurve::kIrrcache};
  const auto plain = RunPareto(options, [](std::string_view) {});
  ASSERT_TRUE(plain.ok()) << plain.status();
  for (const ParetoPoint& p : plain->points) EXPECT_EQ(p.curve(), ParetoCurve::kIrrcache);
  ASSERT_FALSE(plain->points.empty());
  // Another light and another camera are another picture.
  options.changes.sun = AccuracySun{{0.1, 0.2, -1}, Rgb(20, 20, 20)};
  options.changes.view = AccuracyView{{2.7, 2.7, -4}, {2.7, 2.5, 5}, 40};
  const auto changed = RunPareto(options, [](std::string_view) {});
  ASSERT_TRUE(changed.ok()) << changed.status();
  EXPECT_NE(changed->points[0].hash, plain->points[0].hash);
  EXPECT_NE(changed->scene_hash, plain->scene_hash);
  // Straight down is no camera whose up is +y.
  options.changes.view = AccuracyView{{0, 3, 0}, {0, 0, 0}, 40};
  EXPECT_FALSE(RunPareto(options, [](std::string_view) {}).ok());
}

TEST(Pareto, PathTracersTimeIsInterpolatedInLogarithms) {
  std::vector<ParetoPoint> points = {
      Made(Integrator::kPt, 16, 0.1),    Made(Integrator::kPt, 1, 0.4),
      Made(Integrator::kFpbgi, 1, 0.2),  Made(Integrator::kFpbgi, 1, 0.4),
      Made(Integrator::kFpbgi, 1, 0.05), Made(Integrator::kFpbgi, 1, 0.5),
      Made(Integrator::kFpbgi, 1, 0.2)};
  points[6].reference_limited = true;
  AnalysePoints(points);
  ASSERT_TRUE(points[2].pt_seconds_at_rr.has_value());
  EXPECT_NEAR(*points[2].pt_seconds_at_rr, 4.0, 1e-12);
  EXPECT_NEAR(points[3].pt_seconds_at_rr.value_or(0), 1.0, 1e-12);
  EXPECT_FALSE(points[4].pt_seconds_at_rr.has_value());  // beyond the range
  EXPECT_FALSE(points[5].pt_seconds_at_rr.has_value());
  EXPECT_FALSE(points[6].pt_seconds_at_rr.has_value());
  EXPECT_FALSE(points[0].pt_seconds_at_rr.has_value());  // pt itself
}

TEST(Pareto, NoSpeedUpWithoutPathTracer) {
  std::vector<ParetoPoint> points = {Made(Integrator::kFpbgi, 1, 0.2)};
  AnalysePoints(points);
  EXPECT_FALSE(points[0].pt_seconds_at_rr.has_value());
}

class ParetoReference : public ::testing::Test {
 protected:
  void SetUp() override {
    // The furnace has a closed form: E = pi * 0.5 * 1.
    Film film({0, 0, 32, 32}, {Layer::kIrradiance});
    for (int c = 0; c < 3; ++c) {
      for (float& v : film.Plane(Layer::kIrradiance, c)) v = 1.57079633f;
    }
    path_ = folder_ / "furnace.exr";
    ASSERT_TRUE(WriteExr(path_, film, 32, 32, {}, ExrCompression::kZip).ok());
    options_ = TinyOptions();
    options_.scene = "furnace";
    options_.width = options_.height = 0;
    options_.reference_path = path_;
  }
  absl::StatusOr<ParetoReport> RunTiny() {
    return RunPareto(options_, [](std::string_view) {});
  }

  TempFolder folder_;
  std::string path_;
  ParetoOptions options_;
};

TEST_F(ParetoReference, FileGivesResolutionAndErrors) {
  const auto r = RunTiny();
  ASSERT_TRUE(r.ok()) << r.status();
  EXPECT_EQ(r->options.width, 32);
  EXPECT_EQ(r->compared_pixels, 1024u);
  EXPECT_FALSE(r->reference_noise_known);
  EXPECT_EQ(r->reference_seconds, 0);
  EXPECT_NEAR(r->reference_mean, 1.57079633, 1e-6);
  for (const ParetoPoint& p : r->points) {
    EXPECT_EQ(p.rr, p.rel_rmse) << LabelOf(p);
    if (p.integrator == Integrator::kPt && p.paths == 256) {
      EXPECT_LT(p.rr, 0.1);
      EXPECT_LT(std::fabs(p.bias), 0.02);
    }
  }
}

TEST_F(ParetoReference, NoiseIsTakenOutAndMarksWhatItLimits) {
  options_.noise = 10.0;
  const auto r = RunTiny();
  ASSERT_TRUE(r.ok()) << r.status();
  EXPECT_TRUE(r->reference_noise_known);
  for (const ParetoPoint& p : r->points) {
    EXPECT_EQ(p.rr, 0.0);
    EXPECT_GT(p.rel_rmse, 0.0);
    EXPECT_TRUE(p.reference_limited);
    EXPECT_TRUE(p.noise_above_error);
    EXPECT_FALSE(p.pt_seconds_at_rr.has_value());
  }
  EXPECT_TRUE(NoiseWarning(*r).has_value());
}

TEST_F(ParetoReference, MaskChoosesPixels) {
  Film film({0, 0, 32, 32}, {Layer::kDepth});
  for (int x = 0; x < 32; ++x) film.Plane(Layer::kDepth, 0)[static_cast<size_t>(x)] = 1.0f;
  options_.mask_path = folder_ / "mask.exr";
  ASSERT_TRUE(WriteExr(options_.mask_path, film, 32, 32, {}, ExrCompression::kZip).ok());
  const auto r = RunTiny();
  ASSERT_TRUE(r.ok()) << r.status();
  EXPECT_EQ(r->compared_pixels, 32u);
}

TEST_F(ParetoReference, AnotherSizeIsRefused) {
  options_.width = options_.height = 64;
  const auto r = RunTiny();
  EXPECT_EQ(r.status().code(), absl::StatusCode::kInvalidArgument);
  EXPECT_THAT(std::string(r.status().message()), HasSubstr("32x32"));
}

TEST_F(ParetoReference, UnknownLayerIsRefusedBeforeTheBake) {
  options_.ref_layer = "no-such-layer";
  std::vector<std::string> lines;
  const auto r = RunPareto(options_, [&](std::string_view line) { lines.emplace_back(line); });
  EXPECT_EQ(r.status().code(), absl::StatusCode::kInvalidArgument);
  EXPECT_THAT(std::string(r.status().message()), HasSubstr("no-such-layer"));
  EXPECT_TRUE(lines.empty());
}

TEST_F(ParetoReference, MaskThatIsTooSmallIsRefused) {
  const Film film({0, 0, 16, 16}, {Layer::kDepth});
  options_.mask_path = folder_ / "mask.exr";
  ASSERT_TRUE(WriteExr(options_.mask_path, film, 16, 16, {}, ExrCompression::kZip).ok());
  const auto r = RunTiny();
  EXPECT_EQ(r.status().code(), absl::StatusCode::kInvalidArgument);
  EXPECT_THAT(std::string(r.status().message()), HasSubstr("mask.exr"));
}

TEST_F(ParetoReference, MaskThatIsTooLargeIsRefused) {
  const Film film({0, 0, 48, 48}, {Layer::kDepth});
  options_.mask_path = folder_ / "mask.exr";
  ASSERT_TRUE(WriteExr(options_.mask_path, film, 48, 48, {}, ExrCompression::kZip).ok());
  const auto r = RunTiny();
  EXPECT_EQ(r.status().code(), absl::StatusCode::kInvalidArgument);
  EXPECT_THAT(std::string(r.status().message()), HasSubstr("48x48"));
}

TEST_F(ParetoReference, MissingFileIsNamed) {
  options_.reference_path = folder_ / "none.exr";
  const auto r = RunTiny();
  EXPECT_EQ(r.status().code(), absl::StatusCode::kNotFound);
  EXPECT_THAT(std::string(r.status().message()), HasSubstr("none.exr"));
}

TEST_F(ParetoReference, DarkReferenceHasNoScale) {
  const Film black({0, 0, 32, 32}, {Layer::kIrradiance});
  ASSERT_TRUE(WriteExr(path_, black, 32, 32, {}, ExrCompression::kZip).ok());
  const auto r = RunTiny();
  EXPECT_EQ(r.status().code(), absl::StatusCode::kInvalidArgument);
  EXPECT_THAT(std::string(r.status().message()), HasSubstr("no scale"));
}

}  // namespace
}  // namespace farpoint

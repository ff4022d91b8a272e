#include "bench/antialiasing.h"

#include <gtest/gtest.h>

#include <filesystem>
#include <nlohmann/json.hpp>

#include "bench/accuracy_frame.h"
#include "bench/sample_truth.h"
#include "core/scene/procedural.h"
#include "tests/unit/bench/temp_folder.h"

namespace farpoint {
namespace {

TEST(AntialiasingBench, AQuickRunMeasuresCostAndErrorAndDrawsEdges) {
  const TempFolder folder;
  AntialiasingOptions options;
  options.quick = true;
  options.threads = 2;
  const auto report = RunAntialiasing(options, folder.path().string(), [](std::string_view) {});
  ASSERT_TRUE(report.ok()) << report.status();
  ASSERT_EQ(report->scenes.size(), 2u);
  for (const AntialiasingScene& scene : report->scenes) {
    ASSERT_EQ(scene.rows.size(), 2u) << scene.name;
    EXPECT_EQ(scene.rows[0].spp, 1u);
    EXPECT_EQ(scene.rows[0].ratio, 1);
    EXPECT_EQ(scene.rows[0].sample_records, 0u);
    EXPECT_EQ(scene.rows[1].spp, 4u);
    EXPECT_GT(scene.rows[1].receivers, 3 * scene.rows[0].receivers);
    EXPECT_EQ(scene.rows[1].records, scene.rows[0].records);
    for (const AntialiasingRow& row : scene.rows) {
      EXPECT_GT(row.gather_s, 0);
      EXPECT_GT(row.all.pixels, 30u);
      EXPECT_GT(row.edges.pixels, 0u);
      EXPECT_LT(row.edges.pixels, row.all.pixels);
      EXPECT_LT(row.all.rr, 0.5);
      EXPECT_LT(std::abs(row.all.bias), 0.2);
    }
  }
  ASSERT_EQ(report->files.size(), 2u);
  for (const std::string& file : report->files) {
    EXPECT_GT(std::filesystem::file_size(folder.path() / file), 500u) << file;
  }
  const auto json = nlohmann::json::parse(AntialiasingJson(*report));
  EXPECT_EQ(json["scenes"].size(), 2u);
  EXPECT_EQ(json["scenes"][0]["rows"][1]["spp"], 4);
  EXPECT_NE(AntialiasingTable(*report).find("cornell"), std::string::npos);
}

TEST(AntialiasingBench, RefusesWhatItCannotMeasure) {
  AntialiasingOptions options;
  options.cases = {"no such case"};
  EXPECT_TRUE(
      absl::IsInvalidArgument(RunAntialiasing(options, ".", [](std::string_view) {}).status()));
  options.cases = {"city"};
  options.spp = {300};
  EXPECT_TRUE(
      absl::IsInvalidArgument(RunAntialiasing(options, ".", [](std::string_view) {}).status()));
}

// The truth at samples is the image that path tracing makes of them.
TEST(SampleTruth, IsThatOfTheSamplesThatARenderHas) {
  const Scene scene = MakeCornellBox();
  Executor executor(2);
  RenderSettings settings;
  settings.integrator = Integrator::kPt;
  settings.spp = 4;
  settings.paths = 512;
  settings.points = 1000;
  settings.layers = {Layer::kIrradiance, Layer::kDepth};
  const auto loaded =
      LoadFrame(scene, scene.cameras[0], 24, 24, settings, nullptr, executor).value();
  const Film film = RenderByTiles(loaded.frame, settings, executor).value().film;
  const auto pixels = StratifiedPixels(loaded.frame.film.crop, 100, 1);
  const SampleTruth truth =
      TraceSampleTruth(loaded.frame, settings, pixels, 4096, 3, executor).value();
  std::vector<Rgb> image = ValuesAt(film, Layer::kIrradiance, pixels), mean;
  for (size_t i = 0; i < pixels.size(); ++i) {
    EXPECT_EQ(truth.hit[i] != 0,
              std::isfinite(film.Get(Layer::kDepth, 0, pixels[i].x, pixels[i].y)));
    mean.push_back(truth.Mean(i));
  }
  const ErrorFigures figures = CompareSparse(image, mean, 0);
  EXPECT_LT(figures.rel_rmse, 0.05);
  EXPECT_LT(NoiseOfHalves(truth.hit, truth.half[0], truth.half[1]), 0.04);
  size_t edges = 0;
  for (const uint8_t e : truth.edge) edges += e;
  EXPECT_GT(edges, 5u);
  EXPECT_LT(edges, 80u);
}

}  // namespace
}  // namespace farpoint

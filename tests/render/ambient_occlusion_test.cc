// The layer ambient_occlusion: closed forms, and what it may and may not depend on.
#include <limits>

#include "tests/render/render_helpers.h"

namespace farpoint {
namespace {

struct Way {
  const char* name;
  Integrator integrator;
  uint32_t clusters = 0;  // 0: adaptive
  Fill fill = Fill::kAuto;
  double largest = 0;  // error against a closed form
  double rr = 0;       // root mean square error against rays, over the mean, 64x64 pixels
};

// Of those that have the layer.
const Way kWays[] = {{"pt", Integrator::kPt, 0, Fill::kAuto, 0.02, 0.02},
                     {"fpbgi_adaptive_rays", Integrator::kFpbgi, 0, Fill::kAuto, 0.06, 0.03},
                     {"fpbgi_k_rays", Integrator::kFpbgi, 60, Fill::kRays, 0.15, 0.1},
                     {"irrcache", Integrator::kIrrcache, 0, Fill::kAuto, 0.08, 0.04}};

RenderSettings Small(const Way& way) {
  RenderSettings s;
  s.integrator = way.integrator;
  s.clusters = way.clusters;
  s.fill = way.fill;
  s.points = 3000;
  s.paths = 1024;
  s.light_samples = 4;
  s.layers = {Layer::kAmbientOcclusion, Layer::kPosition, Layer::kDepth};
  return s;
}

class OcclusionOf : public testing::TestWithParam<Way> {};

// 1/π of the part of the unit disc (Nusselt) that directions have which no wall hides within D: a
// wall at distance x hides those with more than x / D along its normal.
double BesideWalls(double x, double y, double distance) {
  const double cx = x / distance, cy = y / distance;
  constexpr int kSteps = 400;
  int open = 0, all = 0;
  for (int i = 0; i < kSteps; ++i) {
    for (int j = 0; j < kSteps; ++j) {
      const double u = 2 * (i + 0.5) / kSteps - 1, v = 2 * (j + 0.5) / kSteps - 1;
      if (u * u + v * v > 1) continue;
      ++all;
      open += !(u > cx) && !(v > cy);
    }
  }
  return static_cast<double>(open) / all;
}

// A floor z = 0 within x, y < 0 and walls at x = 0 and, if asked for, y = 0, higher than D. Nothing
// gives light.
Scene Corner(bool two_walls) {
  Scene scene;
  AddLambert(scene, QuadMesh({-8, -8, 0}, {0, -8, 0}, {0, 8, 0}, {-8, 8, 0}), 0.0f);
  AddLambert(scene, QuadMesh({0, -8, 0}, {0, 8, 0}, {0, 8, 4}, {0, -8, 4}), 0.5f);
  if (two_walls) AddLambert(scene, QuadMesh({-8, 0, 0}, {0, 0, 0}, {0, 0, 4}, {-8, 0, 4}), 0.5f);
  return scene;
}

TEST_P(OcclusionOf, IsThatOfAWallAndOfACornerWithoutAnyLight) {
  constexpr double kDistance = 1.5;
  for (const bool corner : {false, true}) {
    const Scene scene = Corner(corner);
    const Camera camera = LookAt({-1.2, -1.25, 3.5}, {-1.2, -1.2, 0}, {0, 1, 0}, 34);
    RenderSettings s = Small(GetParam());
    s.ao_distance_m = kDistance;
    const Film film = RenderScene(scene, camera, Whole(48, 48), s).film;
    double sum = 0, square = 0, largest = 0, least = 1;
    for (int y = 0; y < 48; ++y) {
      for (int x = 0; x < 48; ++x) {
        ASSERT_EQ(film.Get(Layer::kPosition, 2, x, y), 0.0f);
        const double truth = BesideWalls(
            -static_cast<double>(film.Get(Layer::kPosition, 0, x, y)),
            corner ? -static_cast<double>(film.Get(Layer::kPosition, 1, x, y)) : 10.0, kDistance);
        const double d = static_cast<double>(film.Get(Layer::kAmbientOcclusion, 0, x, y)) - truth;
        sum += d;
        square += d * d;
        largest = std::max(largest, std::fabs(d));
        least = std::min(least, truth);
      }
    }
    const double n = 48 * 48;
    EXPECT_LT(least, corner ? 0.4 : 0.6);
    EXPECT_LT(largest, GetParam().largest) << corner;
    EXPECT_LT(std::sqrt(square / n), GetParam().largest / 3) << corner;
    EXPECT_LT(std::fabs(sum / n), 0.01) << corner;
  }
}

TEST_P(OcclusionOf, ReachesFromNothingToTheOpenSkyAndShrinksWithTheDistance) {
  // A floor alone is open; under a roof that ends far away it is not, unless the roof is too high.
  Scene scene;
  AddLambert(scene, QuadMesh({-50, -50, 0}, {50, -50, 0}, {50, 50, 0}, {-50, 50, 0}), 0.5f);
  const Camera camera = LookAt({0, 0.05, 1.5}, {0, 0, 0}, {0, 1, 0}, 40);
  RenderSettings s = Small(GetParam());
  s.paths = 64;
  s.ao_distance_m = std::numeric_limits<float>::infinity();
  const auto mean = [&](const Scene& of) {
    const Film film = RenderScene(of, camera, Whole(16, 16), s).film;
    double sum = 0;
    for (const float v : film.Plane(Layer::kAmbientOcclusion, 0)) {
      EXPECT_GE(v, 0.0f);
      EXPECT_LE(v, 1.0f);
      sum += static_cast<double>(v) / 256;
    }
    return sum;
  };
  EXPECT_NEAR(mean(scene), 1, 1e-3);
  AddLambert(scene, QuadMesh({-50, -50, 2}, {-50, 50, 2}, {50, 50, 2}, {50, -50, 2}), 0.5f);
  EXPECT_LT(mean(scene), 0.01);
  s.ao_distance_m = 1.9f;
  EXPECT_NEAR(mean(scene), 1, 1e-3);
  // Directions whose cosine is above 2 / D.
  s.ao_distance_m = 4;
  EXPECT_NEAR(mean(scene), 0.25, 0.01) << "sin² of the angle beyond which the roof is too far";
}

TEST_P(OcclusionOf, KeepsTheBitsOfOtherLayersAndItsOwnInTilesAndCrops) {
  Scene scene = MakeCornellBox();
  scene.environment.sky = Rgb(0.2f, 0.3f, 0.4f);
  RenderSettings s = Small(GetParam());
  s.paths = 16;
  s.spp = 4;
  s.quality = Quality::kDraft;
  s.layers = {Layer::kBeauty, Layer::kDirect, Layer::kIrradiance};
  const FilmSpec whole = Whole(64, 40);
  const Film without = RenderScene(scene, scene.cameras[0], whole, s).film;
  s.layers.push_back(Layer::kAmbientOcclusion);
  const Film with = RenderScene(scene, scene.cameras[0], whole, s, 1).film;
  for (const Layer layer : without.layers()) {
    EXPECT_EQ(LayerHash(with, layer), LayerHash(without, layer)) << InfoOf(layer).name;
  }
  Executor executor(3);
  Stats stats;
  for (const bool alone : {false, true}) {
    if (alone) s.layers = {Layer::kAmbientOcclusion};
    const Film expected = alone ? RenderScene(scene, scene.cameras[0], whole, s, 2).film : with;
    const auto loaded =
        LoadedScene::Load(Bake(scene, s, executor, stats).value(), executor).value();
    const auto renderer = FrameRenderer::Create(loaded, {scene.cameras[0], whole, s}).value();
    Film film(whole.crop, s.layers);
    std::vector<PixelRect> tiles = TilesOf(whole, 32);
    std::reverse(tiles.begin(), tiles.end());
    for (const PixelRect& tile : tiles) {
      film.Paste(renderer->RenderTile(tile, executor, {}, nullptr).value().film);
    }
    EXPECT_EQ(ImageHash(film), ImageHash(expected)) << alone;
    FilmSpec cropped = whole;
    cropped.crop = {13, 9, 50, 31};
    const Film part = RenderScene(scene, scene.cameras[0], cropped, s, 2).film;
    Film cut(cropped.crop, s.layers);
    cut.Paste(expected);
    EXPECT_EQ(ImageHash(part), ImageHash(cut)) << alone;
    // What is asked for alone is shaded nowhere, and as near the truth.
    s.no_skip = true;
    const Film unskipped = RenderScene(scene, scene.cameras[0], whole, s).film;
    s.no_skip = false;
    EXPECT_EQ(LayerHash(unskipped, Layer::kAmbientOcclusion),
              LayerHash(expected, Layer::kAmbientOcclusion));
  }
}

TEST_P(OcclusionOf, AgreesWithRaysAndScalesWithTheScene) {
  const Scene scene = MakeCornellBox();
  RenderSettings s = Small(GetParam());
  const auto render = [&](const Scene& of, RenderSettings settings) {
    return RenderScene(of, of.cameras[0], Whole(64, 64), settings).film;
  };
  RenderSettings rays = Small(kWays[0]);
  rays.seed = 1;
  const Film truth = render(scene, rays);
  for (const bool alone : {true, false}) {
    if (!alone) s.layers.push_back(Layer::kIndirect);
    const Film film = render(scene, s);
    double square = 0, sum = 0;
    const auto a = film.Plane(Layer::kAmbientOcclusion, 0);
    const auto b = truth.Plane(Layer::kAmbientOcclusion, 0);
    for (size_t i = 0; i < a.size(); ++i) {
      square += static_cast<double>((a[i] - b[i]) * (a[i] - b[i]));
      sum += static_cast<double>(b[i]);
    }
    const double mean = sum / static_cast<double>(a.size());
    EXPECT_GT(mean, 0.5);
    EXPECT_LT(mean, 0.95);
    EXPECT_LT(std::sqrt(square / static_cast<double>(a.size())) / mean, GetParam().rr) << alone;
  }
  // The default distance grows with the scene.
  s.layers = {Layer::kAmbientOcclusion};
  s.paths = 16;
  Scene large = scene;
  Affine world;
  for (int i = 0; i < 3; ++i) world.column[i] = world.column[i] * 1024.0;
  for (Instance& instance : large.instances) {
    instance.world_from_mesh = world * instance.world_from_mesh;
  }
  large.cameras[0].eye = large.cameras[0].eye * 1024.0;
  EXPECT_EQ(ImageHash(render(large, s)), ImageHash(render(scene, s)));
}

INSTANTIATE_TEST_SUITE_P(Integrators, OcclusionOf, testing::ValuesIn(kWays),
                         [](const auto& info) { return std::string(info.param.name); });

}  // namespace
}  // namespace farpoint

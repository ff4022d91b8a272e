// Several samples per pixel: what edges show, and that they cost no pixel its bits.
#include <array>

#include "tests/render/render_helpers.h"

namespace farpoint {
namespace {

constexpr std::array kSurfaceLayers = {Layer::kEmission, Layer::kAlbedo, Layer::kNormal,
                                       Layer::kPosition, Layer::kDepth};

RenderSettings Few(Integrator integrator, uint32_t clusters = 0, Fill fill = Fill::kAuto) {
  RenderSettings s;
  s.integrator = integrator;
  s.clusters = clusters;
  s.fill = fill;
  s.quality = Quality::kDraft;
  s.points = 3000;
  s.paths = 8;
  s.light_samples = 4;
  s.spp = 4;
  return s;
}

// A lit sheet that covers what lies left of `edge_px` in an image 32 pixels wide, one metre a
// pixel, `depth_m` before the camera, and ends in mid-air.
Scene Sheet(double edge_px, float depth_m) {
  Scene scene;
  const float x = static_cast<float>(edge_px) - 16;
  AddLambert(scene,
             QuadMesh({-100, -100, -depth_m}, {x, -100, -depth_m}, {x, 100, -depth_m},
                      {-100, 100, -depth_m}),
             0.5f);
  PunctualLight sun;
  sun.kind = PunctualKind::kDirectional;
  sun.direction = {0, 0, -1};
  sun.intensity = Rgb(1);
  scene.lights.push_back(sun);
  return scene;
}

TEST(Antialiasing, AlphaIsWhatTheFilterSeesAndDepthThatOfWhatIsHit) {
  constexpr double kEdge = 20.3;
  constexpr float kDepth = 40;
  const Scene scene = Sheet(kEdge, kDepth);
  const Camera camera = LookAt({0, 0, 0}, {0, 0, -1}, {0, 1, 0},
                               2 * std::atan2(16.0, static_cast<double>(kDepth)) * 180 / kPi);
  for (const Integrator integrator :
       {Integrator::kFpbgi, Integrator::kPbgi, Integrator::kPt, Integrator::kIrrcache}) {
    RenderSettings s = Few(integrator);
    s.spp = 64;
    s.filter = PixelFilter::kBox;
    s.layers = {Layer::kBeauty, Layer::kDirect, Layer::kNormal, Layer::kDepth};
    const Film film = RenderScene(scene, camera, Whole(32, 32), s).film;
    for (int y = 0; y < 32; y += 7) {
      for (int x = 0; x < 32; ++x) {
        const double covered = std::clamp(kEdge - x, 0.0, 1.0);
        // 64 samples of a (0, 2)-sequence: at most one of eight columns is cut.
        EXPECT_NEAR(film.Get(Layer::kBeauty, 3, x, y), covered, 0.03) << x;
        // Light is that of the covered part; what is of the surface is a mean over hits.
        EXPECT_NEAR(film.Get(Layer::kDirect, 0, x, y), covered * 0.5 / kPi, 0.03 * 0.5 / kPi + 1e-4)
            << x;
        if (film.Get(Layer::kBeauty, 3, x, y) > 0) {
          EXPECT_NEAR(film.Get(Layer::kDepth, 0, x, y), kDepth, 1e-3) << x;
          EXPECT_EQ(film.Get(Layer::kNormal, 2, x, y), 1.0f) << x;
        } else {
          EXPECT_TRUE(std::isinf(film.Get(Layer::kDepth, 0, x, y))) << x;
          EXPECT_EQ(film.Get(Layer::kNormal, 2, x, y), 0.0f) << x;
        }
      }
    }
  }
}

TEST(Antialiasing, AllIntegratorsSeeTheSameSamples) {
  const Scene scene = MakeCornellBox();
  const auto render = [&](RenderSettings s) {
    s.layers = {Layer::kBeauty, Layer::kDirect};
    s.layers.insert(s.layers.end(), kSurfaceLayers.begin(), kSurfaceLayers.end());
    return RenderScene(scene, scene.cameras[0], Whole(40, 40), s).film;
  };
  const Film truth = render(Few(Integrator::kPt));
  for (const RenderSettings& s :
       {Few(Integrator::kFpbgi), Few(Integrator::kFpbgi, 0, Fill::kCut), Few(Integrator::kFpbgi, 8),
        Few(Integrator::kPbgi), Few(Integrator::kDpbgi), Few(Integrator::kIrrcache)}) {
    const Film film = render(s);
    for (const Layer layer : kSurfaceLayers) {
      EXPECT_EQ(LayerHash(film, layer), LayerHash(truth, layer))
          << NameOf(s.integrator) << " " << InfoOf(layer).name;
    }
    EXPECT_EQ(LayerHash(film, Layer::kDirect), LayerHash(truth, Layer::kDirect))
        << NameOf(s.integrator);
    const auto alpha = film.Plane(Layer::kBeauty, 3), expected = truth.Plane(Layer::kBeauty, 3);
    EXPECT_TRUE(std::equal(alpha.begin(), alpha.end(), expected.begin()));
  }
}

// Poles half a pixel wide before a wall, between floor and ceiling: samples hit what no pixel's
// centre does.
Scene Poles() {
  Scene scene = MakeCornellBox();
  for (int i = 0; i < 40; ++i) {
    const float x = 0.3f + 0.123f * static_cast<float>(i), w = 0.03f;
    const float z = -0.5f - 0.04f * static_cast<float>(i % 7);
    AddLambert(scene, QuadMesh({x, 0, z}, {x + w, 0, z}, {x + w, 5, z}, {x, 5, z}), 0.6f);
  }
  return scene;
}

TEST(Antialiasing, SamplesWithRecordsOfTheirOwnKeepTheirBitsInTilesAndCrops) {
  const Scene scene = Poles();
  for (RenderSettings s : {Few(Integrator::kFpbgi), Few(Integrator::kIrrcache)}) {
    for (const uint32_t spp : {4u, 9u}) {
      s.spp = spp;
      s.layers = {Layer::kBeauty, Layer::kIrradiance, Layer::kDepth};
      const FilmSpec whole = Whole(64, 48);
      const Rendered expected = RenderScene(scene, scene.cameras[0], whole, s, 1);
      const char* const count =
          s.integrator == Integrator::kFpbgi ? "clusters_of_samples" : "cache_records";
      EXPECT_GT(expected.stats.counts.at(count), 100u);
      Executor executor(3);
      Stats stats;
      const auto baked = Bake(scene, s, executor, stats).value();
      const auto loaded = LoadedScene::Load(baked, executor).value();
      const auto renderer = FrameRenderer::Create(loaded, {scene.cameras[0], whole, s}).value();
      Film film(whole.crop, s.layers);
      std::vector<PixelRect> tiles = TilesOf(whole, 32);
      std::reverse(tiles.begin(), tiles.end());
      for (const PixelRect& tile : tiles) {
        film.Paste(renderer->RenderTile(tile, executor, {}, nullptr).value().film);
      }
      EXPECT_EQ(ImageHash(film), ImageHash(expected.film)) << spp;
      FilmSpec cropped = whole;
      cropped.crop = {13, 9, 50, 31};
      const Film part = RenderScene(scene, scene.cameras[0], cropped, s, 2).film;
      Film cut(cropped.crop, s.layers);
      cut.Paste(expected.film);
      EXPECT_EQ(ImageHash(part), ImageHash(cut)) << spp;
    }
  }
}

// Against path tracing at the very same samples: fewer strata for what serves one sample of many
// must not show.
TEST(Antialiasing, MoreSamplesHaveNoMoreError) {
  const Scene scene = Poles();
  const FilmSpec film = Whole(48, 36);
  const auto error = [&](uint32_t spp) {
    RenderSettings s = Few(Integrator::kFpbgi);
    s.quality = Quality::kNormal;
    s.points = 50000;
    s.layers = {Layer::kIrradiance};
    s.spp = spp;
    const Film measured = RenderScene(scene, scene.cameras[0], film, s).film;
    s.integrator = Integrator::kPt;
    s.paths = 4096 / spp;
    const Film truth = RenderScene(scene, scene.cameras[0], film, s).film;
    return Compare(measured, truth, Layer::kIrradiance);
  };
  const ErrorOfLayer one = error(1), four = error(4), sixteen = error(16);
  EXPECT_LT(one.rr, 0.12);
  EXPECT_LT(four.rr, one.rr);
  EXPECT_LT(sixteen.rr, one.rr);
  EXPECT_LT(std::fabs(four.bias), 0.02);
  EXPECT_LT(std::fabs(sixteen.bias), 0.02);
}

}  // namespace
}  // namespace farpoint

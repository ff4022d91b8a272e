// What a frame's pixels may and may not depend on (docs/decisions/0001-determinism.md).
#include "tests/render/render_helpers.h"

namespace farpoint {
namespace {

RenderSettings Small(Integrator integrator) {
  RenderSettings s;
  s.integrator = integrator;
  s.points = 5000;
  s.paths = 16;
  s.clusters = 12;
  s.light_samples = 4;
  s.layers = {Layer::kBeauty, Layer::kDirect,   Layer::kIndirect, Layer::kEmission,  Layer::kAlbedo,
              Layer::kNormal, Layer::kPosition, Layer::kDepth,    Layer::kIrradiance};
  return s;
}

// An integrator in one of its ways.
struct Way {
  const char* name;
  Integrator integrator;
  uint32_t clusters = 12;  // 0: adaptive
  Fill fill = Fill::kAuto;
};
RenderSettings Small(const Way& way) {
  RenderSettings s = Small(way.integrator);
  s.clusters = way.clusters;
  s.fill = way.fill;
  s.quality = Quality::kDraft;
  return s;
}

class FrameOf : public testing::TestWithParam<Way> {};

TEST_P(FrameOf, IsIndependentOfThreadsTilesOrderAndCrops) {
  const Scene scene = MakeCornellBox();
  const RenderSettings s = Small(GetParam());
  const FilmSpec whole = Whole(100, 75);
  const Film expected = RenderScene(scene, scene.cameras[0], whole, s, 1).film;
  const Digest hash = ImageHash(expected);

  Executor one(1), three(3);
  Stats stats;
  const auto baked = Bake(scene, s, three, stats).value();
  const auto loaded = LoadedScene::Load(baked, three).value();
  const auto renderer = FrameRenderer::Create(loaded, {scene.cameras[0], whole, s}).value();
  for (const int tile_px : {32, 64, 128}) {
    for (const bool backwards : {false, true}) {
      std::vector<PixelRect> tiles = TilesOf(whole, tile_px);
      if (backwards) std::reverse(tiles.begin(), tiles.end());
      Film film(whole.crop, s.layers);
      for (size_t i = 0; i < tiles.size(); ++i) {
        const auto tile = renderer->RenderTile(tiles[i], i % 2 ? one : three, {}, nullptr);
        ASSERT_TRUE(tile.ok()) << tile.status();
        film.Paste(tile->film);
      }
      EXPECT_EQ(ImageHash(film), hash) << "tile " << tile_px;
    }
  }
  // A crop equals the same pixels of the whole frame.
  for (const PixelRect crop : {PixelRect{10, 7, 77, 50}, PixelRect{33, 40, 34, 41}}) {
    FilmSpec film = whole;
    film.crop = crop;
    const Film part = RenderScene(scene, scene.cameras[0], film, s, 2).film;
    Film cut(crop, s.layers);
    cut.Paste(expected);
    EXPECT_EQ(ImageHash(part), ImageHash(cut));
  }
}

// All that is skipped but nodes below horizons, which reach into the pixels that a horizon cuts.
constexpr uint32_t kExactSkips = ~uint32_t{kSkipBelowHorizon};

bool FillsByCuts(const RenderSettings& s) {
  return s.point_based() &&
         !(s.integrator == Integrator::kFpbgi && s.fill_in_force() == Fill::kRays);
}

TEST_P(FrameOf, SkippingChangesNoBit) {
  const Scene scene = MakeCornellBox();
  RenderSettings s = Small(GetParam());
  const Rendered skipped = RenderScene(scene, scene.cameras[0], Whole(64, 64), s);
  s.computed = kExactSkips;
  EXPECT_EQ(ImageHash(RenderScene(scene, scene.cameras[0], Whole(64, 64), s).film),
            ImageHash(skipped.film));
  s.computed = 0;
  s.no_skip = true;
  const Rendered all = RenderScene(scene, scene.cameras[0], Whole(64, 64), s);
  if (!FillsByCuts(s)) {
    EXPECT_EQ(ImageHash(all.film), ImageHash(skipped.film));
    return;
  }
  // docs/skipping.md
  const ErrorOfLayer e = Compare(skipped.film, all.film, Layer::kIrradiance);
  EXPECT_GT(e.rr, 0);
  EXPECT_LT(e.rr, 0.03);
  EXPECT_LT(std::fabs(e.bias), 0.01);
  // Nothing is left out any more but what an algorithm is made of.
  for (const char* item :
       {"nodes_below_horizon", "nodes_invisible_side", "nodes_hidden", "subtrees_hidden",
        "shadow_rays", "environment_terms", "black_receivers", "textures"}) {
    const auto at = all.stats.skipped.find(item);
    EXPECT_TRUE(at == all.stats.skipped.end() || at->second == 0) << item;
  }
}

// Thin strips, black and white in turn, so that samples of a pixel lie on several.
Scene Strips() {
  Scene scene;
  for (int i = 0; i < 60; ++i) {
    const float x = 0.05f * static_cast<float>(i) - 1.5f, z = 0.3f * static_cast<float>(i % 3);
    AddLambert(scene, QuadMesh({x, -1, z}, {x + 0.04f, -1, z}, {x + 0.04f, 1, z}, {x, 1, z}),
               i % 2 == 0 ? 0.0f : 0.8f);
  }
  AddLambert(scene, QuadMesh({-3, -1.2f, 3}, {3, -1.2f, 3}, {3, -1.2f, -3}, {-3, -1.2f, -3}), 0.6f);
  scene.environment.sky = Rgb(1, 0.8f, 0.6f);
  scene.cameras = {LookAt({0.3, 0.4, 5}, {0, 0, 0}, {0, 1, 0}, 40)};
  return scene;
}

// Nor which layers are asked for, nor skipping, where black samples share a pixel with others.
TEST_P(FrameOf, LayersAndSkippingChangeNoBitUnderASky) {
  const Scene scene = Strips();
  RenderSettings s = Small(GetParam());
  s.spp = 4;
  const FilmSpec film = Whole(48, 32);
  const auto hash = [&](std::vector<Layer> layers, Layer of, bool skip_nothing) {
    RenderSettings asked = s;
    asked.layers = std::move(layers);
    if (skip_nothing) asked.computed = kExactSkips;
    const Film all = RenderScene(scene, scene.cameras[0], film, asked).film;
    Film one(film.crop, {of});
    for (int y = 0; y < film.height; ++y) {
      for (int x = 0; x < film.width; ++x) {
        const float v[4] = {all.Get(of, 0, x, y), all.Get(of, 1, x, y), all.Get(of, 2, x, y), 1};
        one.Set(of, x, y, std::span(v, of == Layer::kBeauty ? 4 : 3));
      }
    }
    return ImageHash(one);
  };
  const Digest beauty = hash({Layer::kBeauty}, Layer::kBeauty, false);
  EXPECT_EQ(hash({Layer::kBeauty}, Layer::kBeauty, true), beauty);
  EXPECT_EQ(
      hash({Layer::kBeauty, Layer::kIrradiance, Layer::kDirectIrradiance}, Layer::kBeauty, false),
      beauty);
  EXPECT_EQ(hash({Layer::kIrradiance}, Layer::kIrradiance, false),
            hash({Layer::kBeauty, Layer::kIrradiance}, Layer::kIrradiance, false));
  EXPECT_EQ(hash({Layer::kDirect}, Layer::kDirect, false),
            hash({Layer::kDirect, Layer::kIndirect}, Layer::kDirect, false));
}

TEST_P(FrameOf, PowerOfTwoScaleKeepsTheBits) {
  Scene scene = MakeCornellBox();
  RenderSettings s = Small(GetParam());
  s.layers = {Layer::kBeauty, Layer::kIrradiance};
  const Digest expected = ImageHash(RenderScene(scene, scene.cameras[0], Whole(64, 64), s).film);
  for (const double scale : {1024.0, 1.0 / 4096.0}) {
    Scene scaled = scene;
    Affine world;
    for (int i = 0; i < 3; ++i) world.column[i] = world.column[i] * scale;
    for (Instance& instance : scaled.instances) {
      instance.world_from_mesh = world * instance.world_from_mesh;
    }
    scaled.cameras[0].eye = scaled.cameras[0].eye * scale;
    const Film film = RenderScene(scaled, scaled.cameras[0], Whole(64, 64), s).film;
    EXPECT_EQ(ImageHash(film), expected) << "scale " << scale;
  }
}

TEST_P(FrameOf, SeveralSamplesPerPixelAverage) {
  const Scene scene = MakeCornellBox();
  RenderSettings s = Small(GetParam());
  s.paths = 64;
  const Film one = RenderScene(scene, scene.cameras[0], Whole(48, 48), s).film;
  s.spp = 4;
  const Film four = RenderScene(scene, scene.cameras[0], Whole(48, 48), s).film;
  const ErrorOfLayer albedo = Compare(four, one, Layer::kAlbedo);
  EXPECT_LT(std::fabs(albedo.bias), 0.02);
  EXPECT_GT(albedo.rr, 0.001);  // edges are smoothed
  EXPECT_LT(std::fabs(Compare(four, one, Layer::kIrradiance).bias), 0.08);
}

INSTANTIATE_TEST_SUITE_P(
    Integrators, FrameOf,
    testing::Values(Way{"fpbgi_adaptive_rays", Integrator::kFpbgi, 0},
                    Way{"fpbgi_adaptive_cut", Integrator::kFpbgi, 0, Fill::kCut},
                    Way{"fpbgi_k_cut", Integrator::kFpbgi},
                    Way{"fpbgi_k_rays", Integrator::kFpbgi, 12, Fill::kRays},
                    Way{"pbgi", Integrator::kPbgi}, Way{"dpbgi", Integrator::kDpbgi},
                    Way{"pt", Integrator::kPt}, Way{"irrcache", Integrator::kIrrcache}),
    [](const auto& info) { return std::string(info.param.name); });

TEST(Frame, BeautyIsTheSumOfItsLayers) {
  const Scene scene = MakeCornellBox();
  const Film film =
      RenderScene(scene, scene.cameras[0], Whole(48, 48), Small(Integrator::kFpbgi)).film;
  for (int c = 0; c < 3; ++c) {
    const auto beauty = film.Plane(Layer::kBeauty, c), direct = film.Plane(Layer::kDirect, c);
    const auto indirect = film.Plane(Layer::kIndirect, c),
               emission = film.Plane(Layer::kEmission, c);
    const auto albedo = film.Plane(Layer::kAlbedo, c), e = film.Plane(Layer::kIrradiance, c);
    for (size_t i = 0; i < beauty.size(); ++i) {
      // Half precision: 2^-11 of each.
      const float sum = direct[i] + indirect[i] + emission[i];
      EXPECT_NEAR(beauty[i], sum, 2e-3f * sum + 1e-6f);
      EXPECT_NEAR(indirect[i], albedo[i] * e[i] * kInvPif, 2e-3f * indirect[i] + 1e-6f);
    }
  }
}

TEST(Frame, WithoutLightIsBlackAndCostsNoGather) {
  Scene scene = MakeCornellBox();
  for (Material& m : scene.materials) m.emission = Rgb();
  const Rendered r = RenderScene(scene, scene.cameras[0], Whole(32, 32), Small(Integrator::kFpbgi));
  for (int c = 0; c < 3; ++c) {
    for (const float v : r.film.Plane(Layer::kBeauty, c)) EXPECT_EQ(v, 0.0f);
  }
  EXPECT_GT(r.stats.skipped.at("unlit_receivers"), 0u);
  EXPECT_EQ(r.stats.counts.at("clusters"), 0u);
  RenderSettings adaptive = Small(Integrator::kFpbgi);
  adaptive.clusters = 0;
  const Rendered a = RenderScene(scene, scene.cameras[0], Whole(32, 32), adaptive);
  EXPECT_EQ(ImageHash(a.film), ImageHash(r.film));
  EXPECT_EQ(a.stats.counts.at("clusters"), 0u);
}

TEST(Frame, BackgroundOnlyBlocksCostNothing) {
  Scene scene = MakeCornellBox();
  Camera away = LookAt({2.78, 2.73, -8}, {2.78, 2.73, -80}, {0, 1, 0}, 40);
  const Rendered r = RenderScene(scene, away, Whole(64, 64), Small(Integrator::kFpbgi));
  EXPECT_EQ(r.stats.skipped.at("blocks_without_receivers"), 4u);
  EXPECT_EQ(r.stats.counts.at("receivers"), 0u);
  for (const float z : r.film.Plane(Layer::kDepth, 0)) EXPECT_TRUE(std::isinf(z));
}

// A lamp fills the upper half of the frame: no records there, and none at all where the lamp is all
// that is seen.
TEST(Frame, BlocksThatSeeOnlyWhatIsBlackAreNotGathered) {
  Scene scene = MakeCornellBox();
  AddLambert(scene, QuadMesh({-2, 2.7f, -3}, {8, 2.7f, -3}, {8, 9, -3}, {-2, 9, -3}), 0);
  scene.materials.back().emission = Rgb(3, 2, 1);
  RenderSettings s = Small(Integrator::kFpbgi);
  s.clusters = 0;
  s.layers = {Layer::kBeauty};
  const FilmSpec film = Whole(128, 128);
  const Rendered part = RenderScene(scene, scene.cameras[0], film, s);
  EXPECT_GE(part.stats.skipped.at("blocks_without_gather"), 6u);
  EXPECT_GT(part.stats.counts.at("clusters"), 0u);
  s.computed = kExactSkips;
  const Rendered whole = RenderScene(scene, scene.cameras[0], film, s);
  EXPECT_EQ(ImageHash(part.film), ImageHash(whole.film));
  EXPECT_LT(part.stats.counts.at("clusters"), whole.stats.counts.at("clusters"));
  s.computed = 0;
  FilmSpec lamp = film;
  lamp.crop = {0, 0, 128, 32};
  const Rendered dark = RenderScene(scene, scene.cameras[0], lamp, s);
  EXPECT_EQ(dark.stats.skipped.at("blocks_without_gather"), 4u);
  EXPECT_EQ(dark.stats.counts.count("clusters") == 0 || dark.stats.counts.at("clusters") == 0,
            true);
  s.layers = {Layer::kBeauty, Layer::kIrradiance};  // now it is asked for
  EXPECT_EQ(RenderScene(scene, scene.cameras[0], lamp, s).stats.skipped.at("blocks_without_gather"),
            0u);
}

TEST(Frame, TinyImagesWork) {
  const Scene scene = MakeCornellBox();
  for (const auto& [w, h] : {std::pair(1, 1), std::pair(1, 70), std::pair(33, 32)}) {
    const Rendered r = RenderScene(scene, scene.cameras[0], Whole(w, h), Small(Integrator::kFpbgi));
    for (const float v : r.film.Plane(Layer::kIrradiance, 0)) EXPECT_TRUE(std::isfinite(v));
  }
}

TEST(Frame, SmallestAndLargestBuffersWork) {
  const Scene scene = MakeCornellBox();
  for (const uint32_t side : {1u, 2u, 3u, 256u}) {
    RenderSettings s = Small(Integrator::kFpbgi);
    s.microbuffer = side;
    const Rendered r = RenderScene(scene, scene.cameras[0], Whole(8, 8), s);
    double sum = 0;
    for (const float v : r.film.Plane(Layer::kIrradiance, 0)) {
      EXPECT_TRUE(std::isfinite(v) && v >= 0);
      sum += v;
    }
    EXPECT_GT(sum, 0);
  }
}

TEST(Frame, CancelStopsATile) {
  const Scene scene = MakeCornellBox();
  const RenderSettings s = Small(Integrator::kFpbgi);
  Executor executor(1);
  Stats stats;
  const auto loaded = LoadedScene::Load(Bake(scene, s, executor, stats).value(), executor).value();
  const auto renderer =
      FrameRenderer::Create(loaded, {scene.cameras[0], Whole(128, 128), s}).value();
  std::atomic<bool> cancel{false};
  int blocks = 0;
  const auto tile = renderer->RenderTile(
      {0, 0, 128, 128}, executor,
      [&](int done, int total) {
        EXPECT_EQ(total, 16);
        blocks = done;
        if (done == 3) cancel = true;
      },
      &cancel);
  EXPECT_EQ(tile.status().code(), absl::StatusCode::kCancelled);
  EXPECT_EQ(blocks, 3);
}

TEST(Frame, RefusesWhatCannotBeRendered) {
  const Scene scene = MakeCornellBox();
  RenderSettings s = Small(Integrator::kPt);
  Executor executor(1);
  Stats stats;
  const auto loaded = LoadedScene::Load(Bake(scene, s, executor, stats).value(), executor).value();
  s.integrator = Integrator::kFpbgi;  // baked without a tree
  EXPECT_EQ(FrameRenderer::Create(loaded, {scene.cameras[0], Whole(8, 8), s}).status().code(),
            absl::StatusCode::kFailedPrecondition);
  s.integrator = Integrator::kPt;
  Camera bad = scene.cameras[0];
  bad.yfov_rad = 0;
  EXPECT_FALSE(FrameRenderer::Create(loaded, {bad, Whole(8, 8), s}).ok());
  bad = scene.cameras[0];
  bad.eye.y = 1e19;
  EXPECT_FALSE(FrameRenderer::Create(loaded, {bad, Whole(8, 8), s}).ok());
  bad = scene.cameras[0];
  bad.up = bad.forward;
  EXPECT_FALSE(FrameRenderer::Create(loaded, {bad, Whole(8, 8), s}).ok());
  EXPECT_FALSE(FrameRenderer::Create(loaded, {scene.cameras[0], Whole(0, 8), s}).ok());
  const auto renderer = FrameRenderer::Create(loaded, {scene.cameras[0], Whole(64, 64), s}).value();
  EXPECT_FALSE(renderer->RenderTile({0, 0, 65, 64}, executor, {}, nullptr).ok());
}

}  // namespace
}  // namespace farpoint

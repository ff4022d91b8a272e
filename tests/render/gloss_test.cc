// Frames with glTF's metal and gloss (docs/decisions/0032-gloss.md).
#include <algorithm>
#include <array>

#include "core/base/hash.h"
#include "tests/render/render_helpers.h"

namespace farpoint {
namespace {

RenderSettings Glossy(Integrator integrator, uint32_t clusters = 0, Fill fill = Fill::kAuto) {
  RenderSettings s;
  s.materials = Materials::kGltf;
  s.integrator = integrator;
  s.clusters = clusters;
  s.fill = fill;
  s.points = 5000;
  s.paths = 64;
  s.light_samples = 4;
  s.quality = Quality::kDraft;
  s.layers = {Layer::kBeauty,   Layer::kDirect,          Layer::kIndirect,
              Layer::kEmission, Layer::kDiffuseIndirect, Layer::kGlossyIndirect};
  return s;
}

double MeanOf(const Film& film, Layer layer) {
  double sum = 0;
  size_t n = 0;
  for (int c = 0; c < 3; ++c) {
    for (const float v : film.Plane(layer, c)) {
      sum += static_cast<double>(v);
      ++n;
    }
  }
  return sum / static_cast<double>(n);
}

// A closed box of white metal: whatever its roughness, all light comes back, so what arrives of the
// walls' emission is reflected once as itself, and so is what arrives of that.
TEST(GlossyFrame, AFurnaceOfWhiteMetalReflectsAllLight) {
  for (const float roughness : {0.1f, 0.4f, 0.9f}) {
    Scene scene = MakeFurnace(1, 2);
    scene.materials[0].metallic = 1;
    scene.materials[0].roughness = roughness;
    for (const Integrator integrator : {Integrator::kPt, Integrator::kFpbgi}) {
      RenderSettings s = Glossy(integrator);
      s.light_samples = 32;
      const Film film = RenderScene(scene, scene.cameras[0], Whole(24, 24), s).film;
      EXPECT_NEAR(MeanOf(film, Layer::kDirect), 2, 0.02) << NameOf(integrator) << roughness;
      EXPECT_NEAR(MeanOf(film, Layer::kIndirect), 2, 0.03) << NameOf(integrator) << roughness;
      EXPECT_EQ(MeanOf(film, Layer::kDiffuseIndirect), 0);
    }
  }
}

// The same of white plastic, of which the diffuse base brings most.
TEST(GlossyFrame, AFurnaceOfWhitePlasticReflectsAllLight) {
  Scene scene = MakeFurnace(1, 2);
  scene.materials[0].roughness = 0.3f;
  for (const Integrator integrator : {Integrator::kPt, Integrator::kFpbgi}) {
    RenderSettings s = Glossy(integrator);
    s.light_samples = 32;
    const Film film = RenderScene(scene, scene.cameras[0], Whole(24, 24), s).film;
    EXPECT_NEAR(MeanOf(film, Layer::kDirect), 2, 0.03) << NameOf(integrator);
    EXPECT_NEAR(MeanOf(film, Layer::kIndirect), 2, 0.04) << NameOf(integrator);
    EXPECT_GT(MeanOf(film, Layer::kGlossyIndirect), 0.05);
    EXPECT_LT(MeanOf(film, Layer::kGlossyIndirect), 0.4);
  }
}

// Further bounces in the furnace: each brings as much again.
TEST(GlossyFrame, EachBounceOfAWhiteMetalBringsAsMuch) {
  Scene scene = MakeFurnace(1, 2);
  scene.materials[0].metallic = 1;
  scene.materials[0].roughness = 0.5f;
  for (const Integrator integrator : {Integrator::kPt, Integrator::kFpbgi}) {
    RenderSettings s = Glossy(integrator);
    s.bounces = 3;
    s.light_samples = 32;
    const Film film = RenderScene(scene, scene.cameras[0], Whole(16, 16), s).film;
    EXPECT_NEAR(MeanOf(film, Layer::kIndirect), 6, 0.12) << NameOf(integrator);
  }
}

// A mirror shows an emitter as it is, and a sky: by one ray or a thousand lights' samples.
TEST(GlossyFrame, AMirrorShowsTheSky) {
  Scene scene;
  AddLambert(scene, QuadMesh({-1, -1, 0}, {1, -1, 0}, {1, 1, 0}, {-1, 1, 0}), 1);
  scene.materials[0].metallic = 1;
  scene.materials[0].roughness = 0;
  scene.environment.sky = {0.5f, 1, 2};
  for (const Integrator integrator : {Integrator::kPt, Integrator::kFpbgi, Integrator::kPbgi}) {
    const Film film = RenderScene(scene, LookAt({0, 0, 1}, {0, 0, 0}, {0, 1, 0}, 20), Whole(8, 8),
                                  Glossy(integrator))
                          .film;
    EXPECT_NEAR(MeanOf(film, Layer::kDirect), 3.5 / 3, 0.01);
    for (int c = 0; c < 3; ++c) {
      for (const float v : film.Plane(Layer::kDirect, c)) {
        EXPECT_NEAR(v, scene.environment.sky[c], 0.05f * scene.environment.sky[c]);
      }
    }
  }
}

struct Way {
  const char* name;
  Integrator integrator;
  uint32_t clusters = 0;
  Fill fill = Fill::kAuto;
  // Of drafts, the reference's own noise of 0.1 in it. What is read from a tree's surfels has lost
  // the direction in which copper reflects the lamp.
  double most_rr = 0.2;
};
class GlossyFrameOf : public testing::TestWithParam<Way> {};

TEST_P(GlossyFrameOf, IsIndependentOfThreadsTilesAndOrder) {
  const Scene scene = MakeGlossyCornellBox(0.4f);
  const RenderSettings s = Glossy(GetParam().integrator, GetParam().clusters, GetParam().fill);
  const FilmSpec whole = Whole(72, 60);
  Executor one(1), three(3);
  Stats stats;
  const auto baked = Bake(scene, s, three, stats).value();
  const auto loaded = LoadedScene::Load(baked, three).value();
  Digest hash;
  for (const int tile_px : {128, 32}) {
    const auto renderer = FrameRenderer::Create(loaded, {scene.cameras[0], whole, s}).value();
    std::vector<PixelRect> tiles = TilesOf(whole, tile_px);
    if (tile_px == 32) std::reverse(tiles.begin(), tiles.end());
    Film film(whole.crop, s.layers);
    for (size_t i = 0; i < tiles.size(); ++i) {
      const auto tile = renderer->RenderTile(tiles[i], i % 2 ? three : one, {}, nullptr);
      ASSERT_TRUE(tile.ok()) << tile.status();
      film.Paste(tile->film);
    }
    if (tile_px == 128) {
      hash = ImageHash(film);
    } else {
      EXPECT_EQ(ImageHash(film), hash);
    }
  }
}

// A power of two in the unit of length changes no bit.
TEST_P(GlossyFrameOf, ScaledByAPowerOfTwoIsTheSame) {
  const Scene scene = MakeGlossyCornellBox(0.4f);
  RenderSettings s = Glossy(GetParam().integrator, GetParam().clusters, GetParam().fill);
  Scene large = scene;
  for (Instance& i : large.instances) {
    for (Vec3d& column : i.world_from_mesh.column) column = column * 1024.0;
    i.world_from_mesh.translation = i.world_from_mesh.translation * 1024.0;
  }
  large.cameras[0].eye = large.cameras[0].eye * 1024.0;
  const FilmSpec film = Whole(48, 48);
  EXPECT_EQ(ImageHash(RenderScene(large, large.cameras[0], film, s).film),
            ImageHash(RenderScene(scene, scene.cameras[0], film, s).film));
}

TEST_P(GlossyFrameOf, AgreesWithThePathTracer) {
  const Scene scene = MakeGlossyCornellBox(0.5f);
  RenderSettings s = Glossy(GetParam().integrator, GetParam().clusters, GetParam().fill);
  s.points = 20000;
  s.light_samples = 16;
  RenderSettings truth = s;
  truth.integrator = Integrator::kPt;
  truth.paths = 512;
  const FilmSpec film = Whole(48, 48);
  const Film a = RenderScene(scene, scene.cameras[0], film, s).film;
  const Film b = RenderScene(scene, scene.cameras[0], film, truth).film;
  const ErrorOfLayer all = Compare(a, b, Layer::kIndirect);
  EXPECT_LT(all.rr, GetParam().most_rr);
  EXPECT_LT(std::fabs(all.bias), 0.04);
  const ErrorOfLayer glossy = Compare(a, b, Layer::kGlossyIndirect);
  EXPECT_LT(glossy.rr, 0.5);  // of the mean over matte pixels, too
  EXPECT_LT(std::fabs(glossy.bias), 0.04);
  EXPECT_LT(std::fabs(Compare(a, b, Layer::kDirect).bias), 0.005);
  // indirect = diffuse + glossy, beauty = direct + indirect + emission, to their rounding.
  for (int c = 0; c < 3; ++c) {
    for (int y = 0; y < film.height; ++y) {
      for (int x = 0; x < film.width; ++x) {
        const auto at = [&](Layer l) { return a.Get(l, c, x, y); };
        EXPECT_NEAR(at(Layer::kIndirect), at(Layer::kDiffuseIndirect) + at(Layer::kGlossyIndirect),
                    2e-3f * at(Layer::kIndirect) + 1e-6f);
        EXPECT_NEAR(at(Layer::kBeauty),
                    at(Layer::kDirect) + at(Layer::kIndirect) + at(Layer::kEmission),
                    2e-3f * at(Layer::kBeauty) + 1e-6f);
      }
    }
  }
}

INSTANTIATE_TEST_SUITE_P(
    Ways, GlossyFrameOf,
    testing::Values(Way{"adaptive", Integrator::kFpbgi},
                    Way{"adaptive_cut", Integrator::kFpbgi, 0, Fill::kCut, 0.5},
                    Way{"clusters", Integrator::kFpbgi, 12, Fill::kCut, 0.5},
                    Way{"pbgi", Integrator::kPbgi, 0, Fill::kAuto, 0.5},
                    Way{"irrcache", Integrator::kIrrcache, 0, Fill::kAuto, 0.3}),
    [](const auto& param) { return std::string(param.param.name); });

// Where nothing is glossy, nothing is paid, and no bit changes.
TEST(GlossyFrame, OfLambertIsTheLambertFrame) {
  const Scene scene = MakeCornellBox();
  for (const Integrator integrator : {Integrator::kPt, Integrator::kFpbgi}) {
    RenderSettings s = Glossy(integrator);
    const Rendered gltf = RenderScene(scene, scene.cameras[0], Whole(48, 48), s);
    s.materials = Materials::kLambert;
    const Rendered lambert = RenderScene(scene, scene.cameras[0], Whole(48, 48), s);
    EXPECT_EQ(ImageHash(gltf.film), ImageHash(lambert.film));
    EXPECT_EQ(gltf.stats.counts.at("rays"), lambert.stats.counts.at("rays"));
    EXPECT_EQ(gltf.stats.counts.count("glossy_receivers"), 0u);
  }
  // And gloss that nobody asked for is none.
  RenderSettings s = Glossy(Integrator::kFpbgi);
  s.materials = Materials::kLambert;
  const Scene glossy = MakeGlossyCornellBox(0.2f), rough = [] {
    Scene plain = MakeGlossyCornellBox(1);
    for (Material& m : plain.materials) m.metallic = 0;
    return plain;
  }();
  EXPECT_EQ(ImageHash(RenderScene(glossy, glossy.cameras[0], Whole(48, 48), s).film),
            ImageHash(RenderScene(rough, rough.cameras[0], Whole(48, 48), s).film));
}

TEST(GlossyFrame, CountsItsReceivers) {
  const Scene scene = MakeGlossyCornellBox(0.4f);
  const Rendered r =
      RenderScene(scene, scene.cameras[0], Whole(48, 48), Glossy(Integrator::kFpbgi));
  EXPECT_GT(r.stats.counts.at("glossy_receivers"), 100u);
  EXPECT_EQ(r.stats.counts.at("glossy_receivers") + r.stats.skipped.at("matte_receivers"),
            r.stats.counts.at("receivers"));
}

}  // namespace
}  // namespace farpoint

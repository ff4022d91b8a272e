#include "core/render/glossy_convolution.h"

#include <gtest/gtest.h>

#include "core/accel/ray_accel.h"
#include "core/math/elementary.h"
#include "core/math/sampling.h"
#include "core/scene/procedural.h"

namespace farpoint {
namespace {

// A point of the copper block's front, seen from the camera's side.
struct Block {
  std::shared_ptr<const RayAccel> accel;
  RayHit hit;
  Vec3f w;

  explicit Block(float roughness) {
    Executor executor(1);
    PrepareOptions options;
    options.gloss = true;
    accel = RayAccel::Build(
                PreparedScene::Prepare(MakeGlossyCornellBox(roughness), executor, options).value())
                .value();
    const Vec3f from(Vec3d(3.6, 1.6, -8) - accel->scene().origin());
    w = Normalize(Vec3f(0.02f, 0.01f, 1));
    hit = accel->Intersect(from, w).value();
    EXPECT_TRUE(accel->scene().IsGlossy(hit.triangle));
  }
  GlossyPoint Point() const { return GlossyPoint(*accel, hit, w); }
};

void Fill(Microbuffer& buffer, const auto& radiance) {
  for (uint32_t p = 0; p < buffer.map().pixels(); ++p) {
    const Rgb l =
        radiance(Vec3f(buffer.map().dir(0)[p], buffer.map().dir(1)[p], buffer.map().dir(2)[p]));
    for (int c = 0; c < 3; ++c) buffer.radiance(c)[p] = l[c];
    buffer.coverage()[p] = 1;
    buffer.depth()[p] = 1;
  }
  buffer.MarkTouched();
}

TEST(GlossyConvolution, OfConstantRadianceIsTheAlbedo) {
  for (const BufferMap kind : {BufferMap::kOctahedral, BufferMap::kCosine}) {
    const MicrobufferMap map(kind, 24);
    Microbuffer buffer(map);
    Fill(buffer, [](const Vec3f&) { return Rgb(1, 2, 3); });
    const Block block(0.6f);
    const GlossyPoint point = block.Point();
    GlossyConvolution convolution(map);
    const Rgb l = convolution.Reflect(buffer, nullptr, point, Splat::kCoverage);
    for (int c = 0; c < 3; ++c) {
      const float expected = point.brdf().glossy_albedo()[c] * static_cast<float>(c + 1);
      EXPECT_NEAR(l[c], expected, 1e-4f * expected);
    }
  }
}

// Against rays of the lobe itself that read the same smooth radiance.
TEST(GlossyConvolution, IsTheIntegralOverTheLobe) {
  const auto radiance = [](const Vec3f& w) {
    return Rgb(1 + 0.9f * w.x, 1 + 0.9f * w.y, 1.5f + w.z * w.x);
  };
  const MicrobufferMap map(BufferMap::kOctahedral, 32);
  Microbuffer buffer(map);
  Fill(buffer, radiance);
  for (const float roughness : {0.45f, 0.7f, 1.0f}) {
    const Block block(roughness);
    const GlossyPoint point = block.Point();
    ASSERT_TRUE(CarriesLobe(map, point.brdf().alpha()));
    GlossyConvolution convolution(map);
    const Rgb l = convolution.Reflect(buffer, nullptr, point, Splat::kCoverage);
    Vec3d expected;
    constexpr uint32_t kRays = 1 << 14;
    for (uint32_t i = 0; i < kRays; ++i) {
      const Vec3f local = point.brdf().SampleGlossy(OwenSobol(i, 0, 3), OwenSobol(i, 1, 3));
      if (!(local.z > 0)) continue;
      const Rgb f = point.brdf().Evaluate(local).glossy;
      expected +=
          Vec3d(f * radiance(point.ToWorld(local)) * (local.z / point.brdf().GlossyPdf(local))) /
          double{kRays};
    }
    for (int c = 0; c < 3; ++c) EXPECT_NEAR(l[c], expected[c], 0.02 * expected[c]) << roughness;
  }
}

TEST(GlossyConvolution, NarrowLobesAreForRays) {
  const MicrobufferMap coarse(BufferMap::kOctahedral, 16), fine(BufferMap::kOctahedral, 32);
  EXPECT_FALSE(CarriesLobe(fine, AlphaOf(0.3f)));
  EXPECT_TRUE(CarriesLobe(fine, AlphaOf(0.43f)));
  EXPECT_FALSE(CarriesLobe(coarse, AlphaOf(0.5f)));
  EXPECT_TRUE(CarriesLobe(coarse, AlphaOf(0.61f)));
}

}  // namespace
}  // namespace farpoint

#include "core/render/record_gatherer.h"

#include <gtest/gtest.h>

#include <cmath>

#include "core/render/bake.h"
#include "core/render/frame_renderer.h"
#include "core/scene/procedural.h"

namespace farpoint {
namespace {

struct Moments {
  Vec3d mean, variance;
  double rays = 0;  // per gather
};

class RecordGathererTest : public testing::Test {
 protected:
  void SetUp() override {
    scene_ = MakeCornellBox();
    settings_.points = 20000;
    Stats stats;
    const auto baked = Bake(scene_, settings_, executor_, stats);
    ASSERT_TRUE(baked.ok()) << baked.status();
    const auto loaded = LoadedScene::Load(*baked, executor_);
    ASSERT_TRUE(loaded.ok()) << loaded.status();
    loaded_ = *loaded;
    ASSERT_TRUE(data().accel->PrepareBundles().ok());
    rays_.emplace(scene_.cameras[0], kFilm, data().scene->origin());
    map_.emplace(settings_.buffer_map, settings_.microbuffer_px());
  }

  const LoadedSceneData& data() const { return static_cast<const LoadedSceneData&>(*loaded_); }
  RecordGatherer MakeGatherer() const { return {data(), *rays_, settings_, *map_, cut_params_}; }

  // Of the irradiance at pixel (x, y) over `count` keys.
  Moments MomentsAt(int x, int y, const RecordGatherer& gatherer, uint64_t count) const {
    Receiver receiver;
    float footprint_m;
    EXPECT_TRUE(gatherer.ReceiverAt(x, y, receiver, footprint_m));
    (void)gatherer.TakeStats();
    const HemisphereGrid grid(128);
    Vec3d sum, squares;
    for (uint64_t key = 0; key < count; ++key) {
      const Rgb e = gatherer.Gather(receiver, grid, key).irradiance;
      for (int c = 0; c < 3; ++c) {
        const double value = static_cast<double>(e[c]);
        sum[c] += value;
        squares[c] += value * value;
      }
    }
    const double n = static_cast<double>(count);
    Moments out;
    for (int c = 0; c < 3; ++c) {
      out.mean[c] = sum[c] / n;
      out.variance[c] = (squares[c] / n - out.mean[c] * out.mean[c]) * n / (n - 1);
    }
    out.rays = static_cast<double>(gatherer.TakeStats().counts["gather_rays"]) / n;
    return out;
  }

  static constexpr FilmSpec kFilm{64, 64, {0, 0, 64, 64}};
  Executor executor_{2};
  Scene scene_;
  RenderSettings settings_;
  CutParams cut_params_;
  std::shared_ptr<const LoadedScene> loaded_;
  std::optional<CameraRays> rays_;
  std::optional<MicrobufferMap> map_;
};

TEST_F(RecordGathererTest, RefiningKeepsTheMeanAndLowersTheVariance) {
  const RecordGatherer plain = MakeGatherer();
  RecordGatherer refined = MakeGatherer();
  refined.Refine({0.002f * refined.MeanOf(kFilm.frame(), executor_).irradiance});
  constexpr uint64_t kCount = 600;
  for (const auto& [x, y] : {std::pair{32, 58}, std::pair{8, 30}, std::pair{40, 12}}) {
    const Moments a = MomentsAt(x, y, plain, kCount), b = MomentsAt(x, y, refined, kCount);
    EXPECT_GT(b.rays, 1.2 * a.rays);
    for (int c = 0; c < 3; ++c) {
      const double error = std::sqrt((a.variance[c] + b.variance[c]) / kCount);
      EXPECT_NEAR(a.mean[c], b.mean[c], 4 * error) << x << " " << y << " " << c;
      EXPECT_LT(b.variance[c], 0.7 * a.variance[c]) << x << " " << y << " " << c;
    }
  }
}

TEST_F(RecordGathererTest, RefiningFollowsTheNoiseThatIsAllowed) {
  double before = 1e9;
  for (const float noise : {0.0005f, 0.002f, 0.01f, 0.1f}) {
    RecordGatherer gatherer = MakeGatherer();
    gatherer.Refine({noise * gatherer.MeanOf(kFilm.frame(), executor_).irradiance});
    const double rays = MomentsAt(32, 58, gatherer, 20).rays;
    EXPECT_LT(rays, before);
    before = rays;
  }
  RecordGatherer plain = MakeGatherer();
  plain.Refine({});
  EXPECT_EQ(MomentsAt(32, 58, plain, 20).rays, before);
}

// The scale is the frame's, whatever the threads.
TEST_F(RecordGathererTest, RefiningDoesNotDependOnThreads) {
  RecordGatherer a = MakeGatherer(), b = MakeGatherer();
  Executor one(1);
  a.Refine({0.003f * a.MeanOf(kFilm.frame(), one).irradiance});
  b.Refine({0.003f * b.MeanOf(kFilm.frame(), executor_).irradiance});
  const Moments ma = MomentsAt(20, 50, a, 5), mb = MomentsAt(20, 50, b, 5);
  EXPECT_EQ(ma.mean, mb.mean);
  EXPECT_EQ(ma.rays, mb.rays);
}

}  // namespace
}  // namespace farpoint

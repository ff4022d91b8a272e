#include "core/irrcache/irradiance_cache.h"

#include <gtest/gtest.h>

#include <cmath>
#include <mutex>

#include "core/math/elementary.h"
#include "core/math/sampling.h"
#include "tests/render/render_helpers.h"

namespace farpoint {
namespace {

constexpr PixelRect kFrame{0, 0, 100, 75};

// The floor z = 0 of a tent whose roof is the plane z = h(x, y) = kHeight + kSlope x, seen from
// above through it, a pixel being 1/50 m wide: everything is seen in every direction. Irradiance
// linear in x, with the true gradient and the distance of the roof overhead.
class Floor final : public RecordSource {
 public:
  static constexpr float kPixel_m = 0.02f, kSlope = 0.5f;

  bool ReceiverAt(int x, int y, Receiver& receiver, float& footprint_m) const override {
    if (x < 5) return false;  // background
    receiver = {};
    receiver.position = {static_cast<float>(x) * kPixel_m, static_cast<float>(y) * kPixel_m, 0};
    receiver.normal = receiver.geometric_normal = {0, 0, 1};
    footprint_m = kPixel_m;
    return true;
  }
  GatherRecord Gather(const Receiver& receiver, const HemisphereGrid&,
                      uint64_t key) const override {
    GatherRecord r;
    r.position = receiver.position;
    r.normal = receiver.normal;
    const float e = Irradiance(receiver.position);
    r.irradiance = {e, 2 * e, 0};
    r.gradient = {Vec3f(kSlope, 0, 0), Vec3f(2 * kSlope, 0, 0), Vec3f()};
    r.vector = {Vec3f(0, 0, e), Vec3f(0, 0, 2 * e), Vec3f()};
    r.harmonic_distance_m = Height(receiver.position);
    const std::lock_guard lock(mutex_);
    keys_.push_back(key);
    return r;
  }
  static float Irradiance(const Vec3f& p) { return 1 + kSlope * p.x; }
  static float Height(const Vec3f& p) { return 0.25f + 0.5f * std::fabs(p.x - 1); }

  std::vector<uint64_t> TakeKeys() const { return std::move(keys_); }

 private:
  mutable std::mutex mutex_;
  mutable std::vector<uint64_t> keys_;
};

const Box3f kFloorBounds{Vec3f(0, 0, 0), Vec3f(2, 1.5f, 1)};

std::unique_ptr<const IrradianceCache> BuildFloor(const Floor& floor,
                                                  const IrradianceCacheParams& params,
                                                  unsigned threads,
                                                  IrradianceCache::Counts& counts) {
  Executor executor(threads);
  return IrradianceCache::Build(params, kFrame, kFloorBounds, {1, 1, 5}, floor, executor, {},
                                counts);
}

TEST(CacheWeight, IsOneAtTheRecordFallsContinuouslyAndEndsAtItsReach) {
  GatherRecord r;
  r.position = {1, 2, 3};
  r.normal = {0, 0, 1};
  r.reach_m = 0.5f;
  EXPECT_EQ(CacheWeight(r, r.position, r.normal), 1.0f);
  float last = 1;
  for (int i = 1; i <= 60; ++i) {
    const float w =
        CacheWeight(r, r.position + Vec3f(0.01f * static_cast<float>(i), 0, 0), r.normal);
    EXPECT_LE(w, last);
    EXPECT_LT(last - w, 0.05f);
    EXPECT_EQ(w > 0, i < 50) << i;
    last = w;
  }
  // By normal: ends at its tolerance.
  for (const double cosine : {0.99, 0.95, 0.901, 0.899, 0.0, -1.0}) {
    const float c = static_cast<float>(cosine);
    const Vec3f n(std::sqrt(1 - c * c), 0, c);
    EXPECT_EQ(CacheWeight(r, r.position, n) > 0, cosine > 0.9) << cosine;
  }
}

TEST(CacheWeight, DoesNotReachBehindTheRecord) {
  GatherRecord r;
  r.normal = {0, 0, 1};
  r.reach_m = 1;
  // In front (a step up, from which the record lies behind) is served, behind is not.
  EXPECT_GT(CacheWeight(r, {0.1f, 0, 0.2f}, r.normal), 0.0f);
  EXPECT_EQ(CacheWeight(r, {0.1f, 0, -0.2f}, r.normal), 0.0f);
  EXPECT_GT(CacheWeight(r, {0.1f, 0, -0.04f}, r.normal), 0.0f);
}

TEST(IrradianceCache, ServesEveryPixelAndReproducesALinearField) {
  const Floor floor;
  IrradianceCache::Counts counts;
  IrradianceCacheParams params;
  params.least_px = 1.5f;
  const auto cache = BuildFloor(floor, params, 2, counts);
  EXPECT_EQ(counts.candidates, 7500u);
  EXPECT_EQ(counts.records, cache->records().size());
  EXPECT_EQ(counts.records, floor.TakeKeys().size());
  EXPECT_LT(counts.records, 7500u / 4);
  EXPECT_GT(counts.records, 30u);
  for (int y = 0; y < kFrame.y1; ++y) {
    for (int x = 5; x < kFrame.x1; ++x) {
      const Vec3f p(static_cast<float>(x) * Floor::kPixel_m,
                    static_cast<float>(y) * Floor::kPixel_m, 0);
      const CachedIrradiance e = cache->Interpolate(p, {0, 0, 1});
      ASSERT_GT(e.weight, 0) << x << " " << y;
      // Where the least reach is in force the gradient is reduced: not so here.
      EXPECT_NEAR(e.irradiance.x, Floor::Irradiance(p), 2e-5f) << x << " " << y;
      EXPECT_NEAR(e.irradiance.y, 2 * Floor::Irradiance(p), 4e-5f) << x << " " << y;
      // The tree leaves nothing out.
      const CachedIrradiance all = InterpolateAll(cache->records(), p, {0, 0, 1});
      EXPECT_NEAR(e.weight, all.weight, 1e-5f * all.weight);
      EXPECT_NEAR(e.irradiance.x, all.irradiance.x, 1e-5f);
    }
  }
  EXPECT_EQ(cache->Interpolate({1, 1, 0}, {0, 0, -1}).weight, 0.0f);
}

TEST(IrradianceCache, DoesNotDependOnThreads) {
  IrradianceCache::Counts counts;
  const Floor floor;
  const auto one = BuildFloor(floor, {}, 1, counts);
  std::vector<uint64_t> keys = floor.TakeKeys();
  const auto three = BuildFloor(floor, {}, 3, counts);
  std::vector<uint64_t> again = floor.TakeKeys();
  std::sort(keys.begin(), keys.end());
  std::sort(again.begin(), again.end());
  EXPECT_EQ(keys, again);
  ASSERT_EQ(one->records().size(), three->records().size());
  for (size_t i = 0; i < one->records().size(); ++i) {
    EXPECT_EQ(one->records()[i].position, three->records()[i].position);
    EXPECT_EQ(one->records()[i].reach_m, three->records()[i].reach_m);
  }
}

TEST(IrradianceCache, ReachesKeepToTheirBounds) {
  const Floor floor;
  IrradianceCache::Counts counts;
  IrradianceCacheParams params;
  params.error = 0.4f;
  params.least_px = 3;
  params.most_px = 9;
  params.spread = 1;
  const auto cache = BuildFloor(floor, params, 2, counts);
  const std::span<const GatherRecord> records = cache->records();
  bool least = false, most = false;
  for (const GatherRecord& r : records) {
    // The camera looks down nearly straight: a projected pixel is hardly larger than its footprint.
    EXPECT_GE(r.reach_m, 3 * Floor::kPixel_m * 0.999f);
    EXPECT_LE(r.reach_m, 9 * Floor::kPixel_m * 1.05f);
    least = least || r.reach_m < 3 * Floor::kPixel_m * 1.05f;
    most = most || r.reach_m > 9 * Floor::kPixel_m * 0.99f;
    EXPECT_LE(r.reach_m, std::max(3 * Floor::kPixel_m * 1.05f,
                                  params.error * Floor::Height(r.position) * 1.001f));
  }
  EXPECT_TRUE(most);
  EXPECT_FALSE(least);  // 0.4 of 0.25 m is 5 pixels

  // A smaller error asks for more records, a larger one for fewer.
  IrradianceCache::Counts fewer, more;
  params.error = 0.8f;
  BuildFloor(floor, params, 2, fewer);
  params.error = 0.2f;
  BuildFloor(floor, params, 2, more);
  EXPECT_LT(fewer.records, counts.records);
  EXPECT_LT(counts.records, more.records);
}

TEST(IrradianceCache, NeighboursClampEachOther) {
  // Overhead it is far but for one spot, which only few records see as near.
  class Spot final : public RecordSource {
   public:
    bool ReceiverAt(int x, int y, Receiver& receiver, float& footprint_m) const override {
      return floor_.ReceiverAt(x, y, receiver, footprint_m);
    }
    GatherRecord Gather(const Receiver& receiver, const HemisphereGrid& grid,
                        uint64_t key) const override {
      GatherRecord r = floor_.Gather(receiver, grid, key);
      r.harmonic_distance_m = Length(receiver.position - Vec3f(1, 0.75f, 0)) < 0.3f ? 0.1f : 10.0f;
      r.gradient = {};
      return r;
    }

   private:
    Floor floor_;
  };
  const Spot spot;
  Executor executor(2);
  IrradianceCache::Counts counts;
  IrradianceCacheParams params;
  params.error = 0.5f;
  params.least_px = 2;
  params.most_px = 12;
  params.spread = 1;
  const auto cache =
      IrradianceCache::Build(params, kFrame, kFloorBounds, {1, 1, 5}, spot, executor, {}, counts);
  ASSERT_NE(cache, nullptr);
  bool any_near = false;
  for (const GatherRecord& a : cache->records()) {
    any_near = any_near || a.harmonic_distance_m < 1;
    for (const GatherRecord& b : cache->records()) {
      const float distance = Length(a.position - b.position);
      if (distance >= a.reach_m || b.harmonic_distance_m > 1) continue;
      // R_a <= R_b + |a - b|; a = 0.5, R_b <= 0.1; the least reach of two pixels may be larger.
      EXPECT_LE(a.reach_m, std::max(0.5f * (0.1f + distance), 2.1f * Floor::kPixel_m) * 1.001f);
    }
  }
  EXPECT_TRUE(any_near);
}

TEST(IrradianceCache, StopsWhenItIsTold) {
  const Floor floor;
  Executor executor(2);
  IrradianceCache::Counts counts;
  int calls = 0;
  const auto stopped = IrradianceCache::Build(
      {}, kFrame, kFloorBounds, {1, 1, 5}, floor, executor, [&](double) { return ++calls < 5; },
      counts);
  EXPECT_EQ(stopped, nullptr);
  EXPECT_EQ(calls, 5);
  double last = -1;
  const auto cache = IrradianceCache::Build(
      {}, kFrame, kFloorBounds, {1, 1, 5}, floor, executor,
      [&](double part) {
        EXPECT_GE(part, last);
        EXPECT_LE(part, 1);
        last = part;
        return true;
      },
      counts);
  EXPECT_NE(cache, nullptr);
  EXPECT_GT(last, 0.9);
}

// --- With rays ---------------------------------------------------------------------------------

RenderSettings CacheSettings(uint32_t samples, float error) {
  RenderSettings s;
  s.integrator = Integrator::kIrrcache;
  s.cache_samples = samples;
  s.cache_error = error;
  s.layers = {Layer::kIrradiance};
  return s;
}

// Every ray of a closed furnace meets the same radiance (1/2 of pi times 1, over pi), but for the
// noise of the one shadow ray at each hit.
TEST(IrradianceCache, FurnaceGivesItsClosedForm) {
  const Scene scene = MakeFurnace(0.5f, 1.0f);
  for (const auto& [samples, most, most_bias] :
       {std::tuple(64u, 0.15, 0.01), std::tuple(4096u, 0.02, 0.003)}) {
    RenderSettings s = CacheSettings(samples, 0.2f);
    s.spp = 2;
    const Rendered r = RenderScene(scene, scene.cameras[0], Whole(40, 30), s);
    double sum = 0;
    for (int c = 0; c < 3; ++c) {
      for (const float e : r.film.Plane(Layer::kIrradiance, c)) {
        EXPECT_NEAR(e, 0.5 * kPi, most * 0.5 * kPi) << samples;
        sum += static_cast<double>(e) / (3 * 40 * 30);
      }
    }
    EXPECT_NEAR(sum, 0.5 * kPi, most_bias * 0.5 * kPi) << samples;
    EXPECT_GT(r.stats.counts.at("cache_records"), 0u);
  }
}

TEST(IrradianceCache, ErrorFallsWithSamplesAndWithAccuracy) {
  const Scene scene = MakeCornellBox();
  RenderSettings pt;
  pt.integrator = Integrator::kPt;
  pt.paths = 2048;
  pt.seed = 5;
  pt.layers = {Layer::kIrradiance};
  const FilmSpec film = Whole(48, 48);
  const Film truth = RenderScene(scene, scene.cameras[0], film, pt).film;
  const auto error = [&](uint32_t samples, float a) {
    const Film image = RenderScene(scene, scene.cameras[0], film, CacheSettings(samples, a)).film;
    const ErrorOfLayer e = Compare(image, truth, Layer::kIrradiance);
    EXPECT_LT(std::fabs(e.bias), a < 1 ? 0.03 : 1.0) << samples;
    return e.rr;
  };
  const double few = error(32, 0.08f), many = error(2048, 0.08f);
  EXPECT_LT(many, 0.6 * few);
  EXPECT_LT(many, 0.05);
  EXPECT_GT(error(2048, 3.0f), 1.5 * many);
}

}  // namespace
}  // namespace farpoint

#include "core/render/settings.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <functional>
#include <limits>
#include <string>
#include <vector>

namespace farpoint {
namespace {

using testing::HasSubstr;

using Change = std::function<void(RenderSettings&)>;

absl::Status Validated(const Change& change) {
  RenderSettings s;
  change(s);
  return ValidateSettings(s);
}

// An invalid argument whose message has every one of `parts`.
void ExpectRefused(const absl::Status& status, const std::vector<std::string>& parts) {
  EXPECT_EQ(status.code(), absl::StatusCode::kInvalidArgument);
  for (const std::string& part : parts) {
    EXPECT_THAT(std::string(status.message()), HasSubstr(part));
  }
}

TEST(RenderSettings, DefaultsAreValidForEveryIntegrator) {
  for (const Integrator integrator : {Integrator::kFpbgi, Integrator::kPbgi, Integrator::kDpbgi,
                                      Integrator::kPt, Integrator::kIrrcache}) {
    const absl::Status status = Validated([&](RenderSettings& s) { s.integrator = integrator; });
    EXPECT_TRUE(status.ok()) << NameOf(integrator) << ": " << status;
  }
}

struct Range {
  const char* name;
  uint64_t low, high;
  std::function<void(RenderSettings&, uint64_t)> set;
};

TEST(RenderSettings, RangesHoldAtBothEnds) {
  const auto u32 = [](uint64_t v) { return static_cast<uint32_t>(v); };
  const Range ranges[] = {
      {"spp", 1, 256, [&](RenderSettings& s, uint64_t v) { s.spp = u32(v); }},
      {"paths", 1, 1u << 20, [&](RenderSettings& s, uint64_t v) { s.paths = u32(v); }},
      {"light-samples", 1, 4096, [&](RenderSettings& s, uint64_t v) { s.light_samples = u32(v); }},
      {"points", 0, uint64_t{1} << 31, [&](RenderSettings& s, uint64_t v) { s.points = v; }},
      {"microbuffer", 0, 256, [&](RenderSettings& s, uint64_t v) { s.microbuffer = u32(v); }},
      {"clusters", 0, 1024, [&](RenderSettings& s, uint64_t v) { s.clusters = u32(v); }},
      {"kmeans-iterations", 0, 100,
       [&](RenderSettings& s, uint64_t v) { s.kmeans_iterations = u32(v); }},
  };
  for (const Range& r : ranges) {
    SCOPED_TRACE(r.name);
    for (const uint64_t good : {r.low, r.low + 1, (r.low + r.high) / 2, r.high}) {
      EXPECT_TRUE(Validated([&](RenderSettings& s) { r.set(s, good); }).ok()) << good;
    }
    std::vector<uint64_t> bad = {r.high + 1, std::numeric_limits<uint32_t>::max()};
    if (r.low > 0) bad.push_back(r.low - 1);
    for (const uint64_t value : bad) {
      ExpectRefused(Validated([&](RenderSettings& s) { r.set(s, value); }),
                    {std::string(r.name) + " is " + std::to_string(value),
                     std::to_string(r.low) + " to " + std::to_string(r.high)});
    }
  }
}

TEST(RenderSettings, RealNumbersAreFiniteAndNotNegative) {
  const float good[] = {0.0f, 1e-30f, 0.2f, 1e30f};
  const float bad[] = {-1e-6f, std::numeric_limits<float>::infinity(),
                       -std::numeric_limits<float>::infinity(),
                       std::numeric_limits<float>::quiet_NaN()};
  for (const float v : good) {
    EXPECT_TRUE(Validated([&](RenderSettings& s) { s.epsilon = v; }).ok()) << v;
    EXPECT_TRUE(Validated([&](RenderSettings& s) { s.normal_weight = v; }).ok()) << v;
  }
  for (const float v : bad) {
    ExpectRefused(Validated([&](RenderSettings& s) { s.epsilon = v; }), {"epsilon"});
    ExpectRefused(Validated([&](RenderSettings& s) { s.normal_weight = v; }), {"normal-weight"});
  }
}

TEST(RenderSettings, FiltersHaveAWidthOfTheirOwnOrTheUsers) {
  RenderSettings s;
  s.filter = PixelFilter::kBox;
  EXPECT_EQ(s.filter_width(), 1.0f);
  s.filter_width_px = 2.5f;
  EXPECT_EQ(s.filter_width(), 2.5f);
  for (const float v : {0.0f, 0.01f, 16.0f}) {
    EXPECT_TRUE(Validated([&](RenderSettings& r) { r.filter_width_px = v; }).ok()) << v;
  }
  for (const float v : {-1.0f, 0.009f, 16.1f, std::numeric_limits<float>::quiet_NaN()}) {
    ExpectRefused(Validated([&](RenderSettings& r) { r.filter_width_px = v; }),
                  {"filter-width", "0.01", "16"});
  }
  for (const char* name : {"box", "triangle", "gaussian", "blackman-harris"}) {
    const auto filter = PixelFilterFromName(name);
    ASSERT_TRUE(filter.ok()) << filter.status();
    EXPECT_EQ(NameOf(*filter), name);
  }
  ExpectRefused(PixelFilterFromName("lanczos").status(), {"lanczos", "blackman-harris"});
}

TEST(RenderSettings, TilesAreWholeBlocks) {
  for (const uint32_t v : {32u, 64u, 96u, 128u, 65536u}) {
    EXPECT_TRUE(Validated([&](RenderSettings& s) { s.tile_px = v; }).ok()) << v;
  }
  for (const uint32_t v : {0u, 1u, 31u, 33u, 100u, 65568u}) {
    ExpectRefused(Validated([&](RenderSettings& s) { s.tile_px = v; }),
                  {"tile is " + std::to_string(v), "multiple of 32"});
  }
}

TEST(RenderSettings, AmbientOcclusionNeedsRaysAndADistance) {
  const auto asked = [](Integrator integrator, uint32_t clusters, Fill fill) {
    return Validated([&](RenderSettings& s) {
      s.layers = {Layer::kAmbientOcclusion};
      s.integrator = integrator;
      s.clusters = clusters;
      s.fill = fill;
    });
  };
  EXPECT_TRUE(asked(Integrator::kFpbgi, 0, Fill::kAuto).ok());
  EXPECT_TRUE(asked(Integrator::kFpbgi, 20, Fill::kRays).ok());
  EXPECT_TRUE(asked(Integrator::kPt, 0, Fill::kAuto).ok());
  EXPECT_TRUE(asked(Integrator::kIrrcache, 0, Fill::kAuto).ok());
  for (const absl::Status& refused :
       {asked(Integrator::kFpbgi, 20, Fill::kAuto), asked(Integrator::kFpbgi, 0, Fill::kCut),
        asked(Integrator::kPbgi, 0, Fill::kAuto), asked(Integrator::kDpbgi, 0, Fill::kRays)}) {
    ExpectRefused(refused, {"ambient_occlusion", "--fill rays", "pt"});
  }
  for (const float v : {0.0f, 1e-6f, 3.0f, std::numeric_limits<float>::infinity()}) {
    EXPECT_TRUE(Validated([&](RenderSettings& s) { s.ao_distance_m = v; }).ok()) << v;
  }
  for (const float v : {-1.0f, std::numeric_limits<float>::quiet_NaN()}) {
    ExpectRefused(Validated([&](RenderSettings& s) { s.ao_distance_m = v; }), {"ao-distance"});
  }
}

TEST(RenderSettings, UnknownEnumeratorsAreRefused) {
  ExpectRefused(Validated([](RenderSettings& s) { s.integrator = static_cast<Integrator>(5); }),
                {"integrator", "fpbgi, pbgi, dpbgi, pt or irrcache"});
  ExpectRefused(Validated([](RenderSettings& s) { s.buffer_map = static_cast<BufferMap>(2); }),
                {"buffer-map", "octahedral or cosine"});
  ExpectRefused(Validated([](RenderSettings& s) { s.splat = static_cast<Splat>(2); }),
                {"splat", "coverage or opaque"});
  ExpectRefused(Validated([](RenderSettings& s) { s.layers = {static_cast<Layer>(kLayerCount)}; }),
                {"aov", "unknown layer"});
  ExpectRefused(Validated([](RenderSettings& s) { s.layers.clear(); }), {"aov", "no layer"});
}

// The hemisphere of one receiver: enough for a record, which is one receiver's, but not for k
// clusters, whose members share a buffer.
TEST(RenderSettings, AClusterCannotShareACosineBuffer) {
  EXPECT_TRUE(Validated([](RenderSettings& s) { s.buffer_map = BufferMap::kCosine; }).ok());
  for (const Integrator integrator : {Integrator::kFpbgi, Integrator::kPbgi, Integrator::kDpbgi,
                                      Integrator::kPt, Integrator::kIrrcache}) {
    const absl::Status status = Validated([&](RenderSettings& s) {
      s.integrator = integrator;
      s.clusters = 64;
      s.buffer_map = BufferMap::kCosine;
    });
    if (integrator == Integrator::kFpbgi) {
      ExpectRefused(status, {"buffer-map cosine", "octahedral"});
    } else {
      EXPECT_TRUE(status.ok()) << status;
    }
  }
}

TEST(RenderSettings, LayersBelongToTheirIntegrators) {
  struct Case {
    Layer layer;
    Integrator integrator;
    bool good;
  };
  std::vector<Case> cases;
  for (const Integrator i : {Integrator::kFpbgi, Integrator::kPbgi, Integrator::kDpbgi,
                             Integrator::kPt, Integrator::kIrrcache}) {
    cases.push_back({Layer::kStdError, i, i == Integrator::kPt});
    cases.push_back({Layer::kCluster, i, i == Integrator::kFpbgi});
    cases.push_back({Layer::kCutSize, i, i != Integrator::kPt && i != Integrator::kIrrcache});
    cases.push_back({Layer::kIrradiance, i, true});
    cases.push_back({Layer::kDirectIrradiance, i, true});
  }
  for (const Case& c : cases) {
    const absl::Status status = Validated([&](RenderSettings& s) {
      s.integrator = c.integrator;
      s.layers = {Layer::kBeauty, c.layer};
    });
    if (c.good) {
      EXPECT_TRUE(status.ok()) << NameOf(c.integrator) << ": " << status;
    } else {
      ExpectRefused(status, {std::string(InfoOf(c.layer).name)});
    }
  }
}

TEST(RenderSettings, NamesAndIntegratorsMatch) {
  const std::pair<const char*, Integrator> names[] = {{"fpbgi", Integrator::kFpbgi},
                                                      {"pbgi", Integrator::kPbgi},
                                                      {"dpbgi", Integrator::kDpbgi},
                                                      {"pt", Integrator::kPt},
                                                      {"irrcache", Integrator::kIrrcache}};
  for (const auto& [name, integrator] : names) {
    EXPECT_EQ(NameOf(integrator), name);
    const auto parsed = IntegratorFromName(name);
    ASSERT_TRUE(parsed.ok()) << parsed.status();
    EXPECT_EQ(*parsed, integrator);
  }
  for (const char* unknown : {"", "PT", "fpbgi ", "irr"}) {
    ExpectRefused(IntegratorFromName(unknown).status(),
                  {"'" + std::string(unknown) + "'", "fpbgi, pbgi, dpbgi, pt or irrcache"});
  }
}

TEST(RenderSettings, ZeroMeansTheDefaultInForce) {
  RenderSettings s;
  EXPECT_EQ(s.microbuffer_px(), 32u);
  EXPECT_TRUE(s.adaptive());
  EXPECT_EQ(s.fill_in_force(), Fill::kRays);
  // dpbgi is pbgi with a smaller buffer.
  s.integrator = Integrator::kPbgi;
  const uint32_t full = s.microbuffer_px();
  s.integrator = Integrator::kDpbgi;
  EXPECT_LT(s.microbuffer_px(), full);
  // What is asked for is what is used.
  s.microbuffer = 77;
  s.clusters = 5;
  EXPECT_EQ(s.microbuffer_px(), 77u);
  s.integrator = Integrator::kFpbgi;
  EXPECT_FALSE(s.adaptive());
  EXPECT_EQ(s.fill_in_force(), Fill::kCut);
  s.fill = Fill::kRays;
  EXPECT_EQ(s.fill_in_force(), Fill::kRays);
}

TEST(RenderSettings, TheCacheFollowsTheQualityUnlessItsOwnSettingsSay) {
  RenderSettings s;
  s.integrator = Integrator::kIrrcache;
  EXPECT_FALSE(s.point_based());
  EXPECT_EQ(s.fill_in_force(), Fill::kRays);
  s.fill = Fill::kCut;  // fpbgi's
  EXPECT_EQ(s.fill_in_force(), Fill::kRays);
  float error = 100;
  uint32_t samples = 0;
  for (const Quality quality : {Quality::kDraft, Quality::kNormal, Quality::kFine}) {
    s.quality = quality;
    EXPECT_LT(s.cache_error_in_force(), error);
    EXPECT_GT(s.cache_samples_in_force(), samples);
    error = s.cache_error_in_force();
    samples = s.cache_samples_in_force();
  }
  s.cache_error = 0.07f;
  s.cache_samples = 99;
  EXPECT_EQ(s.cache_error_in_force(), 0.07f);
  EXPECT_EQ(s.cache_samples_in_force(), 99u);
  EXPECT_TRUE(ValidateSettings(s).ok());
  for (const float bad : {-1.0f, 0.001f, 11.0f, std::numeric_limits<float>::quiet_NaN()}) {
    s.cache_error = bad;
    ExpectRefused(ValidateSettings(s), {"cache-error"});
  }
  s.cache_error = 0;
  for (const uint32_t bad : {1u, 3u, (1u << 20) + 1}) {
    s.cache_samples = bad;
    ExpectRefused(ValidateSettings(s), {"cache-samples", std::to_string(bad)});
  }
}

TEST(RenderSettings, FillsAndQualitiesHaveNames) {
  for (const char* name : {"auto", "rays", "cut"}) EXPECT_EQ(NameOf(*FillFromName(name)), name);
  for (const char* name : {"draft", "normal", "fine"}) {
    EXPECT_EQ(NameOf(*QualityFromName(name)), name);
  }
  ExpectRefused(FillFromName("points").status(), {"points", "auto, rays or cut"});
  ExpectRefused(QualityFromName("best").status(), {"best", "draft, normal or fine"});
  ExpectRefused(Validated([](RenderSettings& s) { s.fill = static_cast<Fill>(3); }), {"fill"});
  ExpectRefused(Validated([](RenderSettings& s) { s.quality = static_cast<Quality>(3); }),
                {"quality"});
}

TEST(RenderSettings, PaperPresetIsThePapers) {
  RenderSettings s;
  s.integrator = Integrator::kPbgi;
  s.spp = 4;
  s.seed = 9;
  s.points = 1234;
  s.buffer_map = BufferMap::kCosine;
  ApplyPaperPreset(s);
  EXPECT_EQ(s.clusters, 100u);
  EXPECT_EQ(s.fill_in_force(), Fill::kCut);
  EXPECT_EQ(s.epsilon, 0.1f);
  EXPECT_EQ(s.splat, Splat::kOpaque);
  EXPECT_EQ(s.normal_weight, 1.0f);
  EXPECT_EQ(s.kmeans_iterations, 5u);
  EXPECT_EQ(s.microbuffer_px(), 64u);
  EXPECT_EQ(s.buffer_map, BufferMap::kOctahedral);
  // It leaves alone what is the user's.
  EXPECT_EQ(s.integrator, Integrator::kPbgi);
  EXPECT_EQ(s.spp, 4u);
  EXPECT_EQ(s.seed, 9u);
  EXPECT_EQ(s.points, 1234u);
  for (const Integrator i : {Integrator::kFpbgi, Integrator::kPbgi, Integrator::kDpbgi}) {
    s.integrator = i;
    EXPECT_TRUE(ValidateSettings(s).ok());
  }
}

}  // namespace
}  // namespace farpoint

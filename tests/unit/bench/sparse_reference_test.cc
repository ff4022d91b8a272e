#include "bench/sparse_reference.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cmath>
#include <numbers>
#include <set>
#include <utility>

#include "bench/accuracy_frame.h"
#include "core/base/byte_io.h"
#include "core/scene/procedural.h"
#include "tests/unit/bench/temp_folder.h"

namespace farpoint {
namespace {

using ::testing::HasSubstr;

const LoadedFrame& Furnace() {
  static const LoadedFrame loaded = [] {
    Executor executor(1);
    RenderSettings settings;
    settings.integrator = Integrator::kPt;
    const Scene scene = MakeFurnace(0.5f, 1.0f);
    return LoadFrame(scene, scene.cameras.front(), 32, 24, settings, nullptr, executor).value();
  }();
  return loaded;
}

absl::StatusOr<SparseReference> Trace(const SparseReferenceOptions& options,
                                      std::span<const PixelPosition> pixels) {
  Executor executor(2);
  return TraceSparseReference(Furnace().frame, pixels, options, executor, [](std::string_view) {});
}

TEST(StratifiedPixels, HaveOneInEachCell) {
  const PixelRect rect{10, 20, 110, 95};
  const std::vector<PixelPosition> pixels = StratifiedPixels(rect, 75, 3);
  // Cells of 10 px: ten columns, seven and a half rows.
  ASSERT_EQ(pixels.size(), 80u);
  std::set<std::pair<int, int>> cells;
  for (const PixelPosition& p : pixels) {
    ASSERT_TRUE(rect.Contains(p.x, p.y));
    cells.insert({(p.x - 10) / 10, (p.y - 20) / 10});
  }
  EXPECT_EQ(cells.size(), pixels.size());
}

TEST(StratifiedPixels, FollowTheSeed) {
  const PixelRect rect{0, 0, 64, 64};
  EXPECT_EQ(StratifiedPixels(rect, 16, 1), StratifiedPixels(rect, 16, 1));
  EXPECT_NE(StratifiedPixels(rect, 16, 1), StratifiedPixels(rect, 16, 2));
}

TEST(StratifiedPixels, AreAllWhereMoreAreAskedForThanThereAre) {
  EXPECT_EQ(StratifiedPixels({0, 0, 5, 4}, 1000, 1).size(), 20u);
  EXPECT_TRUE(StratifiedPixels({3, 3, 3, 9}, 10, 1).empty());
}

TEST(SparseReference, FindsTheFurnacesLight) {
  SparseReferenceOptions options;
  options.noise = 0.01;
  options.direct_samples = 256;
  const std::vector<PixelPosition> pixels = StratifiedPixels({0, 0, 32, 24}, 24, 1);
  const auto reference = Trace(options, pixels);
  ASSERT_TRUE(reference.ok()) << reference.status();
  EXPECT_LE(reference->IndirectNoise(), 0.01);
  EXPECT_FALSE(reference->from_cache);
  for (size_t i = 0; i < pixels.size(); ++i) {
    EXPECT_EQ(reference->hit[i], 1);
    EXPECT_NEAR(reference->Indirect(i).x, 0.5 * std::numbers::pi, 0.06);
    EXPECT_NEAR(reference->Direct(i).y, std::numbers::pi, 0.1);
    EXPECT_NEAR(reference->albedo[i].z, 0.5f, 1e-3f);
    EXPECT_NEAR(
        reference->IndirectError(i).x,
        0.5f * std::fabs(reference->indirect_half[0][i].x - reference->indirect_half[1][i].x),
        1e-6f);
  }
  // The halves are independent: none of them is a copy of the other.
  EXPECT_NE(reference->indirect_half[0], reference->indirect_half[1]);
}

TEST(SparseReference, StopsAtItsBudget) {
  SparseReferenceOptions options;
  options.noise = 1e-6;  // cannot be reached
  options.budget_s = 0;
  options.direct_samples = 0;
  const std::vector<PixelPosition> pixels = {{4, 4}, {20, 10}};
  const auto reference = Trace(options, pixels);
  ASSERT_TRUE(reference.ok()) << reference.status();
  EXPECT_EQ(reference->rounds, 1u);
  EXPECT_EQ(reference->paths, 64u);
  EXPECT_GT(reference->IndirectNoise(), 1e-6);
  EXPECT_TRUE(reference->direct_half[0].empty());
}

TEST(SparseReference, ComesFromTheCacheAndGoesOnFromThere) {
  const TempFolder folder;
  SparseReferenceOptions options;
  options.noise = 1;
  options.direct_samples = 16;
  options.cache_dir = folder / "deep/refs";
  const std::vector<PixelPosition> pixels = {{4, 4}, {20, 10}, {30, 2}};
  const auto first = Trace(options, pixels);
  ASSERT_TRUE(first.ok()) << first.status();
  const auto again = Trace(options, pixels);
  ASSERT_TRUE(again.ok()) << again.status();
  EXPECT_TRUE(again->from_cache);
  EXPECT_EQ(again->indirect_half, first->indirect_half);
  EXPECT_EQ(again->direct_half, first->direct_half);
  EXPECT_EQ(again->seconds, first->seconds);

  options.noise = first->IndirectNoise() / 2;
  const auto better = Trace(options, pixels);
  ASSERT_TRUE(better.ok()) << better.status();
  EXPECT_FALSE(better->from_cache);
  EXPECT_GT(better->rounds, 1u);
  EXPECT_LE(better->IndirectNoise(), options.noise);
  EXPECT_EQ(better->direct_half, first->direct_half);

  // Other pixels, another seed: another file.
  options.noise = 1;
  options.seed = 1;
  ASSERT_TRUE(Trace(options, pixels).ok());
  ASSERT_TRUE(Trace(options, std::vector<PixelPosition>{{4, 4}}).ok());
  size_t files = 0;
  for (const auto& entry : std::filesystem::directory_iterator(options.cache_dir)) {
    files += entry.path().extension() == ".ref";
  }
  EXPECT_EQ(files, 3u);
}

TEST(SparseReference, NamesADamagedFile) {
  const TempFolder folder;
  SparseReferenceOptions options;
  options.noise = 1;
  options.direct_samples = 0;
  options.cache_dir = folder.path().string();
  const std::vector<PixelPosition> pixels = {{4, 4}};
  ASSERT_TRUE(Trace(options, pixels).ok());
  const std::filesystem::path path = std::filesystem::directory_iterator(folder.path())->path();
  std::string bytes = ReadText(path.string());
  bytes[bytes.size() / 2] ^= 1;
  std::ofstream(path, std::ios::binary) << bytes;
  const auto damaged = Trace(options, pixels);
  EXPECT_EQ(damaged.status().code(), absl::StatusCode::kDataLoss);
  EXPECT_THAT(std::string(damaged.status().message()), HasSubstr(path.string()));
}

TEST(SparseReference, RefusesWhatLiesOutside) {
  EXPECT_EQ(Trace({}, {}).status().code(), absl::StatusCode::kInvalidArgument);
  const auto outside = Trace({}, std::vector<PixelPosition>{{32, 0}});
  EXPECT_EQ(outside.status().code(), absl::StatusCode::kInvalidArgument);
  EXPECT_THAT(std::string(outside.status().message()), HasSubstr("(32, 0)"));
}

SparseReference Small() {
  SparseReference r;
  r.hit = {1, 0};
  r.indirect_half = {std::vector<Rgb>{Rgb(1, 2, 3), Rgb()}, {Rgb(1, 2, 4), Rgb()}};
  r.albedo = {Rgb(0.5f), Rgb()};
  r.paths = 64;
  r.rounds = 1;
  r.seconds = 0.5;
  return r;
}

TEST(SparseReference, SurvivesItsBytes) {
  const Digest key = HashBytes({});
  SparseReference r = Small();
  for (const bool direct : {false, true}) {
    if (direct) r.direct_half = r.indirect_half;
    const auto back = DecodeSparseReference(EncodeSparseReference(r, key), key, 2);
    ASSERT_TRUE(back.ok()) << back.status();
    EXPECT_EQ(back->hit, r.hit);
    EXPECT_EQ(back->indirect_half, r.indirect_half);
    EXPECT_EQ(back->direct_half, r.direct_half);
    EXPECT_EQ(back->albedo, r.albedo);
    EXPECT_EQ(back->paths, 64u);
    EXPECT_EQ(back->seconds, 0.5);
  }
}

TEST(SparseReference, RefusesEveryPartOfItsBytesAndOtherKeys) {
  const Digest key = HashBytes({});
  const std::vector<std::byte> bytes = EncodeSparseReference(Small(), key);
  for (size_t n = 0; n < bytes.size(); ++n) {
    EXPECT_EQ(DecodeSparseReference(std::span(bytes).first(n), key, 2).status().code(),
              absl::StatusCode::kDataLoss)
        << n;
  }
  EXPECT_FALSE(DecodeSparseReference(bytes, Digest(), 2).ok());
  EXPECT_FALSE(DecodeSparseReference(bytes, key, 3).ok());
}

// A right checksum does not make a record right.
std::vector<std::byte> Resealed(std::vector<std::byte> bytes) {
  const size_t body = bytes.size() - 32;
  const Digest checksum = HashBytes(std::span(bytes).first(body));
  std::memcpy(bytes.data() + body, checksum.bytes.data(), 32);
  return bytes;
}

TEST(SparseReference, RefusesSizesAndValuesThatMakeNoSense) {
  const Digest key = HashBytes({});
  const std::vector<std::byte> bytes = EncodeSparseReference(Small(), key);
  ASSERT_TRUE(DecodeSparseReference(Resealed(bytes), key, 2).ok());
  const size_t header = 8 + 32;  // magic, key
  std::vector<std::byte> bad = bytes;
  std::memset(bad.data() + header, 0, 4);  // paths
  EXPECT_FALSE(DecodeSparseReference(Resealed(bad), key, 2).ok());
  bad = bytes;
  std::memset(bad.data() + header + 4 + 4 + 8 + 4, 0xff, 8);  // number of pixels
  EXPECT_FALSE(DecodeSparseReference(Resealed(bad), key, 2).ok());
  SparseReference nan = Small();
  nan.indirect_half[1][0].y = std::numeric_limits<float>::quiet_NaN();
  EXPECT_FALSE(DecodeSparseReference(EncodeSparseReference(nan, key), key, 2).ok());
}

TEST(SparseReference, NoiseIsHalfOfWhatHalvesDifferByOverTheirMean) {
  const std::vector<uint8_t> on = {1, 0, 1};
  // Differences of 0.4 and 0.8 about means of 1 and 3; the pixel between does not count.
  const std::vector<Rgb> a = {Rgb(1.2f), Rgb(9), Rgb(2.6f)}, b = {Rgb(0.8f), Rgb(1), Rgb(3.4f)};
  EXPECT_NEAR(NoiseOfHalves(on, a, b), std::sqrt((0.2 * 0.2 + 0.4 * 0.4) / 2) / 2, 1e-6);
  EXPECT_EQ(NoiseOfHalves(on, a, a), 0);
  EXPECT_EQ(NoiseOfHalves(std::vector<uint8_t>(3, 0), a, b), 0);
  EXPECT_EQ(NoiseOfHalves({}, {}, {}), 0);
}

}  // namespace
}  // namespace farpoint

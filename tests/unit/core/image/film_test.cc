#include "core/image/film.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <bit>
#include <cmath>
#include <cstring>
#include <limits>
#include <random>

#include "core/math/half.h"
#include "tests/unit/core/image/image_testing.h"

namespace farpoint {
namespace {

constexpr PixelRect kOddRect{37, 5, 110, 71};

TEST(Film, StartsAtZeroWithSortedLayers) {
  const Film film({0, 0, 3, 2}, {Layer::kDepth, Layer::kBeauty, Layer::kDepth});
  ASSERT_EQ(film.layers().size(), 2u);
  EXPECT_EQ(film.layers()[0], Layer::kBeauty);
  EXPECT_EQ(film.layers()[1], Layer::kDepth);
  EXPECT_TRUE(film.Has(Layer::kDepth));
  EXPECT_FALSE(film.Has(Layer::kAlbedo));
  EXPECT_TRUE(film.Plane(Layer::kAlbedo, 0).empty());
  ASSERT_EQ(film.Plane(Layer::kBeauty, 3).size(), 6u);
  for (const float v : film.Plane(Layer::kBeauty, 3)) EXPECT_EQ(v, 0.0f);
}

TEST(Film, SetGetAndPlaneAgreeOnFrameCoordinates) {
  Film film(kOddRect, {Layer::kAlbedo, Layer::kDepth});
  const float color[3] = {1, 2, 3};
  film.Set(Layer::kAlbedo, 40, 6, color);
  for (int c = 0; c < 3; ++c) {
    EXPECT_EQ(film.Get(Layer::kAlbedo, c, 40, 6), color[c]);
    EXPECT_EQ(film.Plane(Layer::kAlbedo, c)[1 * kOddRect.width() + 3], color[c]);
  }
  EXPECT_EQ(film.Get(Layer::kDepth, 0, 40, 6), 0.0f);
}

TEST(Film, PasteCopiesTheCommonPixelsOnly) {
  const std::vector<Layer> layers = {Layer::kBeauty, Layer::kPosition};
  Film film({0, 0, 64, 64}, layers);
  film.Paste(TestFilm({50, 60, 90, 90}, layers));
  film.Paste(TestFilm({70, 0, 90, 20}, layers));  // nothing in common
  const Film whole = TestFilm({0, 0, 64, 64}, layers);
  for (int y = 0; y < 64; ++y) {
    for (int x = 0; x < 64; ++x) {
      const float expected = x >= 50 && y >= 60 ? whole.Get(Layer::kPosition, 1, x, y) : 0.0f;
      ASSERT_EQ(film.Get(Layer::kPosition, 1, x, y), expected) << x << "," << y;
    }
  }
}

TEST(RoundToStorage, RoundsHalvesOnlyAndIsIdempotent) {
  Film film({0, 0, 1, 1}, {Layer::kIndirect, Layer::kIrradiance});
  const float values[3] = {0.1f, -0.0f, 1e9f};
  film.Set(Layer::kIndirect, 0, 0, values);
  film.Set(Layer::kIrradiance, 0, 0, values);
  film.RoundToStorage();
  EXPECT_EQ(film.Get(Layer::kIndirect, 0, 0, 0), HalfToFloat(FloatToHalf(0.1f)));
  EXPECT_NE(film.Get(Layer::kIndirect, 0, 0, 0), 0.1f);
  EXPECT_EQ(film.Get(Layer::kIndirect, 2, 0, 0), kMaxHalf);
  EXPECT_EQ(film.Get(Layer::kIrradiance, 0, 0, 0), 0.1f);
  EXPECT_EQ(film.Get(Layer::kIrradiance, 2, 0, 0), 1e9f);
  for (const Layer layer : {Layer::kIndirect, Layer::kIrradiance}) {
    EXPECT_FALSE(std::signbit(film.Get(layer, 1, 0, 0)));
  }
  const Film once = film;
  film.RoundToStorage();
  EXPECT_TRUE(SameFilm(film, once));
}

TEST(RoundToStorage, HidesNeitherNanNorInfinity) {
  Film film({0, 0, 1, 1}, {Layer::kIndirect, Layer::kIrradiance});
  const float values[3] = {NAN, INFINITY, -INFINITY};
  for (const Layer layer : {Layer::kIndirect, Layer::kIrradiance}) {
    film.Set(layer, 0, 0, values);
    film.RoundToStorage();
    EXPECT_TRUE(std::isnan(film.Get(layer, 0, 0, 0)));
    EXPECT_EQ(film.Get(layer, 1, 0, 0), INFINITY);
    EXPECT_EQ(film.Get(layer, 2, 0, 0), -INFINITY);
  }
}

TEST(EncodeFilm, RoundTripsEveryLayerBitByBit) {
  for (const PixelRect rect : {PixelRect{0, 0, 1, 1}, PixelRect{0, 0, 64, 64}, kOddRect}) {
    const Film film = TestFilm(rect, EveryLayer());
    const std::vector<std::byte> bytes = EncodeFilm(film);
    const absl::StatusOr<Film> back = DecodeFilm(bytes);
    ASSERT_TRUE(back.ok()) << back.status();
    EXPECT_TRUE(SameFilm(*back, film));
    EXPECT_EQ(EncodeFilm(*back), bytes);
  }
}

// The layout that docs/protocol.md describes, by hand.
TEST(EncodeFilm, HasTheDocumentedBytes) {
  Film film({31, 0, 33, 1}, {Layer::kDepth, Layer::kAlbedo});
  const float a[3] = {1, 0.5f, 0}, b[3] = {2, 0.25f, -0.0f}, z0[1] = {1}, z1[1] = {INFINITY};
  film.Set(Layer::kAlbedo, 31, 0, a);
  film.Set(Layer::kAlbedo, 32, 0, b);
  film.Set(Layer::kDepth, 31, 0, z0);
  film.Set(Layer::kDepth, 32, 0, z1);
  const uint8_t expected[] = {
      'F', 'I',  'L',  'M',  1, 0, 0, 0,                           // magic, version
      31,  0,    0,    0,    0, 0, 0, 0, 33, 0, 0, 0, 1, 0, 0, 0,  // x0, y0, x1, y1
      2,   0,    0,    0,    4, 0, 0, 0, 7,  0, 0, 0,              // two layers: albedo, depth
      0,   0x3c, 0,    0x38, 0, 0,  // albedo, block of x < 32: R, G, B
      0,   0x40, 0,    0x34, 0, 0,  // albedo, the next block
      0,   0,    0x80, 0x3f,        // depth
      0,   0,    0x80, 0x7f};
  const std::vector<std::byte> bytes = EncodeFilm(film);
  ASSERT_EQ(bytes.size(), sizeof(expected));
  EXPECT_EQ(std::memcmp(bytes.data(), expected, sizeof(expected)), 0);
}

TEST(DecodeFilm, RefusesEveryTruncationAndWhatFollows) {
  const std::vector<std::byte> bytes =
      EncodeFilm(TestFilm({30, 30, 35, 34}, {Layer::kBeauty, Layer::kDepth}));
  for (size_t size = 0; size < bytes.size(); ++size) {
    const std::vector<std::byte> cut(bytes.begin(), bytes.begin() + size);
    EXPECT_EQ(DecodeFilm(cut).status().code(), absl::StatusCode::kDataLoss) << size;
  }
  std::vector<std::byte> longer = bytes;
  longer.push_back(std::byte{0});
  EXPECT_EQ(DecodeFilm(longer).status().code(), absl::StatusCode::kDataLoss);
}

TEST(DecodeFilm, RefusesSizesBeforeAllocatingThem) {
  const std::vector<std::byte> good = EncodeFilm(TestFilm({0, 0, 2, 2}, {Layer::kBeauty}));
  const auto with = [&](size_t offset, int32_t value) {
    std::vector<std::byte> bytes = good;
    std::memcpy(bytes.data() + offset, &value, sizeof(value));
    return DecodeFilm(bytes).status();
  };
  EXPECT_TRUE(with(16, 2).ok());  // x1 as it is
  for (const int32_t x1 : {65536, 0x7fffffff, -1, 0, 1, 3}) EXPECT_FALSE(with(16, x1).ok()) << x1;
  for (const int32_t x0 : {-1, 2, 3, INT32_MIN}) EXPECT_FALSE(with(8, x0).ok()) << x0;
  for (const int32_t count : {0, 2, 14, -1}) EXPECT_FALSE(with(24, count).ok()) << count;
  for (const int32_t layer : {7, 13, -1}) EXPECT_FALSE(with(28, layer).ok()) << layer;
  EXPECT_FALSE(with(4, 2).ok());  // another version
  EXPECT_NE(with(4, 2).message().find("version 2"), absl::string_view::npos);
}

TEST(DecodeFilm, RefusesLayersOutOfOrderOrTwice) {
  std::vector<std::byte> bytes =
      EncodeFilm(TestFilm({0, 0, 2, 2}, {Layer::kDirect, Layer::kIndirect}));
  ASSERT_TRUE(DecodeFilm(bytes).ok());
  std::swap(bytes[28], bytes[32]);
  EXPECT_FALSE(DecodeFilm(bytes).ok());
  bytes[28] = bytes[32];
  EXPECT_FALSE(DecodeFilm(bytes).ok());
}

TEST(DecodeFilm, RefusesWhatNoKernelMayProduce) {
  const auto decode = [](Layer layer, float value) {
    Film film({40, 50, 41, 51}, {layer});
    const std::vector<float> values(InfoOf(layer).channels.size(), value);
    film.Set(layer, 40, 50, values);
    return DecodeFilm(EncodeFilm(film)).status();
  };
  for (const LayerInfo& info : AllLayers()) {
    EXPECT_TRUE(decode(info.layer, 1.0f).ok()) << info.name;
    EXPECT_EQ(decode(info.layer, NAN).code(), absl::StatusCode::kDataLoss) << info.name;
    EXPECT_EQ(decode(info.layer, -INFINITY).code(), absl::StatusCode::kDataLoss) << info.name;
    EXPECT_EQ(decode(info.layer, INFINITY).ok(), info.layer == Layer::kDepth) << info.name;
  }
  const absl::Status status = decode(Layer::kDirect, NAN);
  EXPECT_NE(status.message().find("direct.R"), absl::string_view::npos) << status;
  EXPECT_NE(status.message().find("40,50"), absl::string_view::npos) << status;
}

TEST(DecodeFilm, AcceptsDamageOnlyIfItIsAnotherExactRecord) {
  const std::vector<std::byte> good =
      EncodeFilm(TestFilm({28, 60, 45, 70}, {Layer::kBeauty, Layer::kDepth, Layer::kCutSize}));
  std::mt19937 random(7);
  int accepted = 0, refused = 0;
  for (int i = 0; i < 20000; ++i) {
    std::vector<std::byte> bytes = good;
    const int damages = 1 + static_cast<int>(random() % 4);
    for (int k = 0; k < damages; ++k) {
      // Half of the damage goes into the header.
      const size_t range = random() % 2 ? bytes.size() : 44;
      bytes[random() % range] = static_cast<std::byte>(random());
    }
    if (random() % 8 == 0) bytes.resize(random() % (bytes.size() + 1));
    const absl::StatusOr<Film> film = DecodeFilm(bytes);
    if (film.ok()) {
      ++accepted;
      ASSERT_EQ(EncodeFilm(*film), bytes) << i;
    } else {
      ++refused;
      ASSERT_EQ(film.status().code(), absl::StatusCode::kDataLoss) << film.status();
    }
  }
  EXPECT_GT(accepted, 100);
  EXPECT_GT(refused, 100);
}

// SHA-256 over the stored values per block, then over the blocks, then over the layers.
TEST(LayerHash, IsTheDocumentedConstruction) {
  const PixelRect rect{31, 0, 33, 1};
  Film film(rect, {Layer::kDepth});
  const float z0[1] = {1.5f}, z1[1] = {INFINITY};
  film.Set(Layer::kDepth, 31, 0, z0);
  film.Set(Layer::kDepth, 32, 0, z1);
  Sha256 layer;
  layer.Update("farpoint layer 1").UpdateU32(1).Update("Z");
  for (const uint32_t v : {31u, 0u, 33u, 1u}) layer.UpdateU32(v);
  for (const float* z : {z0, z1}) {
    const Digest block = Sha256().UpdateU32(std::bit_cast<uint32_t>(*z)).Finish();
    layer.Update(std::as_bytes(std::span(block.bytes)));
  }
  const Digest expected = layer.Finish();
  EXPECT_EQ(LayerHash(film, Layer::kDepth), expected);
  Sha256 image;
  image.Update("farpoint image 1").UpdateU32(1).Update(std::as_bytes(std::span(expected.bytes)));
  EXPECT_EQ(ImageHash(film), image.Finish());
}

TEST(ImageHash, IsIndependentOfTileSizeAndOrder) {
  const std::vector<Layer> layers = {Layer::kBeauty, Layer::kDepth, Layer::kIrradiance};
  for (const PixelRect crop : {PixelRect{0, 0, 200, 150}, PixelRect{33, 31, 190, 149}}) {
    const FilmSpec spec{200, 150, crop};
    const Digest whole = ImageHash(TestFilm(crop, layers));
    for (const int tile : {32, 64, 128}) {
      for (unsigned seed = 0; seed < 3; ++seed) {
        std::vector<PixelRect> tiles = TilesOf(spec, tile);
        std::shuffle(tiles.begin(), tiles.end(), std::mt19937(seed));
        Film stitched(crop, layers);
        for (const PixelRect& rect : tiles) {
          const absl::StatusOr<Film> part = DecodeFilm(EncodeFilm(TestFilm(rect, layers)));
          ASSERT_TRUE(part.ok()) << part.status();
          stitched.Paste(*part);
        }
        EXPECT_EQ(ImageHash(stitched), whole) << tile << " " << seed;
      }
    }
  }
}

TEST(ImageHash, SeesEveryPixelLayerAndPlace) {
  const std::vector<Layer> layers = {Layer::kBeauty, Layer::kAlbedo};
  const Film film = TestFilm({0, 0, 40, 40}, layers);
  const Digest hash = ImageHash(film);
  for (const Layer layer : layers) {
    Film changed = film;
    float& v = changed.Plane(layer, 2)[40 * 40 - 1];
    v = HalfToFloat(static_cast<uint16_t>(FloatToHalf(v) ^ 1));
    EXPECT_NE(ImageHash(changed), hash);
    for (const Layer other : layers) {
      EXPECT_EQ(LayerHash(changed, other) == LayerHash(film, other), other != layer);
    }
  }
  Film moved({8, 0, 48, 40}, layers);
  for (const Layer layer : layers) {
    for (size_t c = 0; c < InfoOf(layer).channels.size(); ++c) {
      std::ranges::copy(film.Plane(layer, static_cast<int>(c)),
                        moved.Plane(layer, static_cast<int>(c)).begin());
    }
  }
  EXPECT_NE(ImageHash(moved), hash);
  EXPECT_NE(ImageHash(TestFilm({0, 0, 40, 40}, {Layer::kBeauty})), hash);
}

}  // namespace
}  // namespace farpoint

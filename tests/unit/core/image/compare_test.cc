#include "core/image/compare.h"

#include <gtest/gtest.h>

#include <cmath>
#include <limits>

#include "core/base/blob.h"
#include "tests/unit/core/image/image_testing.h"

namespace farpoint {
namespace {

// An image of constant channels.
ExrImage Flat(const PixelRect& window, int frame_width, int frame_height,
              const std::vector<std::pair<std::string, float>>& channels) {
  ExrImage image;
  image.data_window = window;
  image.frame_width = frame_width;
  image.frame_height = frame_height;
  for (const auto& [name, value] : channels) {
    image.channels.push_back(
        {name, false, std::vector<float>(static_cast<size_t>(window.area()), value)});
  }
  return image;
}

ExrImage Rgb16(float r, float g, float b) {
  return Flat({0, 0, 16, 16}, 16, 16, {{"B", b}, {"G", g}, {"R", r}});
}

CompareOptions NumericOnly() {
  CompareOptions options;
  options.perceptual = false;
  return options;
}

TEST(Compare, ConstantsHaveTheClosedForm) {
  CompareOptions options = NumericOnly();
  options.noise = 0.1;
  const absl::StatusOr<CompareResult> r =
      CompareImages(Rgb16(1.5f, 2.0f, 3.0f), Rgb16(1.0f, 2.0f, 5.0f), options);
  ASSERT_TRUE(r.ok()) << r.status();
  const double mse = (0.25 + 0.0 + 4.0) / 3, mean = 8.0 / 3;
  EXPECT_DOUBLE_EQ(r->mse, mse);
  EXPECT_DOUBLE_EQ(r->ref_mean, mean);
  EXPECT_DOUBLE_EQ(r->mean, 6.5 / 3);
  EXPECT_DOUBLE_EQ(*r->rel_rmse, std::sqrt(mse) / mean);
  EXPECT_DOUBLE_EQ(*r->rr, std::sqrt(mse / (mean * mean) - 0.01));
  EXPECT_DOUBLE_EQ(*r->bias, -0.5 / mean);
  EXPECT_EQ(r->max_abs, 2.0);
  EXPECT_EQ(r->pixels, 256);
  EXPECT_FALSE(r->hash_equal);
  EXPECT_FALSE(r->pdp.has_value());
  EXPECT_FALSE(r->flip.has_value());
}

TEST(Compare, NoiseBeyondTheErrorLeavesZero) {
  CompareOptions options = NumericOnly();
  options.noise = 10;
  EXPECT_EQ(*CompareImages(Rgb16(1, 1, 1), Rgb16(2, 2, 2), options)->rr, 0.0);
  EXPECT_TRUE(CompareImages(Rgb16(1, 1, 1), Rgb16(2, 2, 2), options)->noise_above_error);
  options.noise = 0.25;  // of an error of 0.5
  EXPECT_FALSE(CompareImages(Rgb16(1, 1, 1), Rgb16(2, 2, 2), options)->noise_above_error);
  EXPECT_EQ(CompareImages(Rgb16(1, 1, 1), Rgb16(2, 2, 2), options)->noise, 0.25);
  options.noise = -1;
  EXPECT_FALSE(CompareImages(Rgb16(1, 1, 1), Rgb16(2, 2, 2), options).ok());
  options.noise = NAN;
  EXPECT_FALSE(CompareImages(Rgb16(1, 1, 1), Rgb16(2, 2, 2), options).ok());
}

TEST(Compare, IdenticalImagesHaveNoError) {
  const absl::StatusOr<CompareResult> r = CompareImages(Rgb16(1, 2, 3), Rgb16(1, 2, 3), {});
  ASSERT_TRUE(r.ok()) << r.status();
  EXPECT_EQ(r->mse, 0.0);
  EXPECT_EQ(*r->rr, 0.0);
  EXPECT_EQ(*r->bias, 0.0);
  EXPECT_EQ(*r->pdp, 0);
  EXPECT_EQ(*r->flip, 0.0);
  EXPECT_TRUE(r->hash_equal);
}

TEST(Compare, PerceptualMetricsSeeABigDifference) {
  const absl::StatusOr<CompareResult> r = CompareImages(Rgb16(1, 1, 1), Rgb16(5, 5, 5), {});
  ASSERT_TRUE(r.ok()) << r.status();
  EXPECT_EQ(*r->pdp, 256);
  EXPECT_GT(*r->flip, 0.3);
}

// HDR: the reference's scale is divided out.
TEST(Compare, PerceptualMetricsDoNotChangeWithTheUnitOfRadiance) {
  const auto a = CompareImages(Rgb16(0.9f, 1, 1), Rgb16(1, 1, 1), {});
  const auto b = CompareImages(Rgb16(900, 1000, 1000), Rgb16(1000, 1000, 1000), {});
  EXPECT_EQ(*a->pdp, *b->pdp);
  EXPECT_NEAR(*a->flip, *b->flip, 1e-5);
}

TEST(Compare, ABlackReferenceHasNoRelativeError) {
  const auto differs = CompareImages(Rgb16(1, 1, 1), Rgb16(0, 0, 0), {});
  ASSERT_TRUE(differs.ok()) << differs.status();
  EXPECT_FALSE(differs->rel_rmse || differs->rr || differs->bias);
  EXPECT_EQ(differs->mse, 1.0);
  const auto equal = CompareImages(Rgb16(0, 0, 0), Rgb16(0, 0, 0), {});
  EXPECT_EQ(*equal->rr, 0.0);
}

TEST(Compare, FindsLayersByName) {
  const PixelRect w{0, 0, 4, 4};
  const ExrImage a = Flat(w, 4, 4,
                          {{"R", 1},
                           {"G", 1},
                           {"B", 1},
                           {"Z", 7},
                           {"irradiance.R", 2},
                           {"irradiance.G", 2},
                           {"irradiance.B", 2},
                           {"custom.X", 5},
                           {"custom.Y", 5},
                           {"custom.Z", 5}});
  const auto mean = [&](const std::string& layer) {
    CompareOptions options = NumericOnly();
    options.layer = layer;
    const auto r = CompareImages(a, a, options);
    return r.ok() ? r->mean : -1.0;
  };
  EXPECT_EQ(mean(""), 1.0);
  EXPECT_EQ(mean("beauty"), 1.0);
  EXPECT_EQ(mean("irradiance"), 2.0);
  EXPECT_EQ(mean("Z"), 7.0);
  EXPECT_EQ(mean("custom"), 5.0);
  EXPECT_EQ(mean("custom.Y"), 5.0);
  EXPECT_EQ(mean("nothing"), -1.0);
}

TEST(Compare, APlainReferenceServesAnyLayer) {
  const PixelRect w{0, 0, 4, 4};
  const ExrImage a = Flat(w, 4, 4,
                          {{"R", 9},
                           {"G", 9},
                           {"B", 9},
                           {"irradiance.R", 2},
                           {"irradiance.G", 2},
                           {"irradiance.B", 2}});
  const ExrImage plain = Flat(w, 4, 4, {{"R", 1}, {"G", 1}, {"B", 1}});
  CompareOptions options = NumericOnly();
  options.layer = "irradiance";
  EXPECT_EQ(CompareImages(a, plain, options)->mse, 1.0);
  // A reference that has the layer is asked for it.
  EXPECT_EQ(CompareImages(a, a, options)->mse, 0.0);
  options.ref_layer = "beauty";
  EXPECT_EQ(CompareImages(a, a, options)->mse, 49.0);
  options.ref_layer = "irradiance";  // asked for by name, it must be there
  const absl::Status status = CompareImages(a, plain, options).status();
  EXPECT_EQ(status.code(), absl::StatusCode::kInvalidArgument);
  EXPECT_NE(status.message().find("it has beauty"), absl::string_view::npos) << status;
}

TEST(Compare, RefusesWhatDoesNotFit) {
  const ExrImage a = Rgb16(1, 1, 1);
  const ExrImage larger = Flat({0, 0, 17, 16}, 17, 16, {{"R", 1}, {"G", 1}, {"B", 1}});
  const absl::Status sizes = CompareImages(a, larger, NumericOnly()).status();
  EXPECT_EQ(sizes.code(), absl::StatusCode::kInvalidArgument);
  EXPECT_NE(sizes.message().find("16x16"), absl::string_view::npos) << sizes;
  EXPECT_NE(sizes.message().find("17x16"), absl::string_view::npos) << sizes;
  CompareOptions depth = NumericOnly();
  depth.layer = "Z";
  const ExrImage z = Flat({0, 0, 16, 16}, 16, 16, {{"Z", 1}});
  EXPECT_FALSE(CompareImages(z, a, depth).ok());  // one channel against three
  ExrImage broken = a;
  broken.channels[0].values.pop_back();
  EXPECT_FALSE(CompareImages(broken, a, NumericOnly()).ok());
  const ExrImage left = Flat({0, 0, 8, 16}, 16, 16, {{"R", 1}, {"G", 1}, {"B", 1}});
  const ExrImage right = Flat({8, 0, 16, 16}, 16, 16, {{"R", 1}, {"G", 1}, {"B", 1}});
  EXPECT_FALSE(CompareImages(left, right, NumericOnly()).ok());
}

TEST(Compare, ACropIsComparedWithTheSamePixelsOfTheFrame) {
  ExrImage whole = Rgb16(1, 1, 1);
  for (ExrChannel& channel : whole.channels) {
    for (size_t i = 0; i < 256; ++i) channel.values[i] = static_cast<float>(i);
  }
  ExrImage crop = Flat({5, 3, 9, 11}, 16, 16, {{"R", 0}, {"G", 0}, {"B", 0}});
  for (ExrChannel& channel : crop.channels) {
    for (int y = 3; y < 11; ++y) {
      for (int x = 5; x < 9; ++x) {
        channel.values[static_cast<size_t>((y - 3) * 4 + x - 5)] = static_cast<float>(y * 16 + x);
      }
    }
  }
  for (const auto& r : {CompareImages(crop, whole, {}), CompareImages(whole, crop, {})}) {
    ASSERT_TRUE(r.ok()) << r.status();
    EXPECT_EQ(r->rect, (PixelRect{5, 3, 9, 11}));
    EXPECT_EQ(r->pixels, 32);
    EXPECT_EQ(r->mse, 0.0);
    EXPECT_TRUE(r->hash_equal);
  }
}

TEST(Compare, OnlyMaskedPixelsCount) {
  ExrImage a = Rgb16(1, 1, 1);
  const ExrImage b = Rgb16(2, 2, 2);
  for (ExrChannel& channel : a.channels) {
    for (size_t i = 0; i < 128; ++i) channel.values[i] = 100.0f;  // the upper half
  }
  CompareOptions options;
  options.mask = PixelMask{{0, 0, 16, 16}, std::vector<uint8_t>(256, 1)};
  std::fill_n(options.mask->on.begin(), 128, 0);
  const auto r = CompareImages(a, b, options);
  ASSERT_TRUE(r.ok()) << r.status();
  EXPECT_EQ(r->pixels, 128);
  EXPECT_EQ(r->mse, 1.0);
  EXPECT_EQ(r->max_abs, 1.0);
  EXPECT_LE(*r->pdp, 128);
  std::ranges::fill(options.mask->on, 0);
  EXPECT_FALSE(CompareImages(a, b, options).ok());
  options.mask = PixelMask{{0, 0, 15, 16}, std::vector<uint8_t>(240, 1)};
  EXPECT_FALSE(CompareImages(a, b, options).ok());
  options.mask = PixelMask{{0, 0, 16, 16}, std::vector<uint8_t>(255, 1)};
  EXPECT_FALSE(CompareImages(a, b, options).ok());
}

TEST(Compare, AMaskOfAnotherFrameIsRefused) {
  const ExrImage a = Rgb16(1, 1, 1);
  CompareOptions options = NumericOnly();
  // It would cover the image, but its pixels are those of another one.
  options.mask = PixelMask{{0, 0, 32, 20}, std::vector<uint8_t>(640, 1), 32, 20};
  const absl::Status larger = CompareImages(a, a, options).status();
  EXPECT_EQ(larger.code(), absl::StatusCode::kInvalidArgument);
  EXPECT_NE(larger.message().find("32x20"), absl::string_view::npos) << larger;
  EXPECT_NE(larger.message().find("16x16"), absl::string_view::npos) << larger;
  // The part of a larger frame that lies on the image, too.
  options.mask = PixelMask{{0, 0, 20, 18}, std::vector<uint8_t>(360, 1), 32, 20};
  const absl::Status part = CompareImages(a, a, options).status();
  EXPECT_NE(part.message().find("32x20"), absl::string_view::npos) << part;
  options.mask = PixelMask{{0, 0, 16, 16}, std::vector<uint8_t>(256, 1), 16, 16};
  EXPECT_TRUE(CompareImages(a, a, options).ok());
  // One of the crop's size is laid over the crop, whatever frame it says.
  const ExrImage crop = Flat({4, 4, 8, 6}, 16, 16, {{"R", 1}, {"G", 1}, {"B", 1}});
  options.mask = PixelMask{{0, 0, 4, 2}, std::vector<uint8_t>(8, 1), 4, 2};
  EXPECT_EQ(CompareImages(crop, crop, options)->pixels, 8);
}

TEST(Compare, AnUnknownLayerIsRefusedWithTheLayersThatAreThere) {
  const ExrImage a = Flat({0, 0, 2, 2}, 2, 2,
                          {{"R", 1}, {"G", 1}, {"B", 1}, {"Z", 1}, {"mine.u", 1}, {"mine.v", 1}});
  CompareOptions options = NumericOnly();
  options.layer = "nope";
  options.image_name = "a.exr";
  options.ref_name = "b.exr";
  EXPECT_EQ(CompareImages(a, a, options).status().message(),
            "a.exr has no layer 'nope'; it has beauty, Z, mine");
  options.layer = "beauty";
  options.ref_layer = "gone";
  EXPECT_EQ(CompareImages(a, a, options).status().message(),
            "b.exr has no layer 'gone'; it has beauty, Z, mine");
}

TEST(Compare, AMaskOfTheCropsSizeIsLaidOverTheCrop) {
  const ExrImage a = Flat({4, 4, 8, 6}, 16, 16, {{"R", 1}, {"G", 1}, {"B", 1}});
  CompareOptions options = NumericOnly();
  options.mask = PixelMask{{0, 0, 4, 2}, {1, 0, 0, 0, 0, 0, 0, 1}};
  EXPECT_EQ(CompareImages(a, a, options)->pixels, 2);
}

TEST(Compare, PixelsThatAreNotFiniteAreLeftOutAndCounted) {
  ExrImage a = Flat({0, 0, 4, 1}, 4, 1, {{"Z", 3}}), b = Flat({0, 0, 4, 1}, 4, 1, {{"Z", 2}});
  a.channels[0].values[0] = b.channels[0].values[0] = INFINITY;
  b.channels[0].values[1] = NAN;
  CompareOptions options;
  options.layer = "Z";
  const auto r = CompareImages(a, b, options);
  ASSERT_TRUE(r.ok()) << r.status();
  EXPECT_EQ(r->pixels, 4);
  EXPECT_EQ(r->left_out, 2);
  EXPECT_EQ(r->mse, 1.0);
  EXPECT_TRUE(std::isfinite(*r->flip));
  for (float& v : a.channels[0].values) v = INFINITY;
  EXPECT_FALSE(CompareImages(a, b, options).ok());
}

class CompareFiles : public ImageFiles {
 protected:
  ExrImage Write(const Film& film) {
    EXPECT_TRUE(WriteExr(Path("f.exr"), film, 100, 80, {}, ExrCompression::kZip).ok());
    absl::StatusOr<ExrImage> image = ReadExr(Path("f.exr"));
    EXPECT_TRUE(image.ok()) << image.status();
    return *std::move(image);
  }
};

TEST_F(CompareFiles, HashesAreThoseOfTheFilms) {
  const std::vector<Layer> layers = {Layer::kBeauty, Layer::kAlbedo};
  Film film = TestFilm({0, 0, 100, 80}, layers);
  const ExrImage a = Write(film);
  const auto same = CompareImages(a, a, NumericOnly());
  ASSERT_TRUE(same.ok()) << same.status();
  EXPECT_TRUE(same->hash_equal);
  EXPECT_EQ(same->hash_a, ImageHash(film).Hex());

  film.Plane(Layer::kAlbedo, 0)[17] += 1.0f;
  film.RoundToStorage();
  const ExrImage b = Write(film);
  // Without a layer the whole image counts, though the beauty is the same.
  const auto changed = CompareImages(a, b, NumericOnly());
  EXPECT_EQ(changed->mse, 0.0);
  EXPECT_FALSE(changed->hash_equal);
  CompareOptions one = NumericOnly();
  one.layer = "beauty";
  EXPECT_TRUE(CompareImages(a, b, one)->hash_equal);
  EXPECT_EQ(CompareImages(a, b, one)->hash_b, LayerHash(film, Layer::kBeauty).Hex());
  one.layer = "albedo";
  EXPECT_FALSE(CompareImages(a, b, one)->hash_equal);
}

TEST_F(CompareFiles, TheHashOfACropEqualsThatOfTheSamePixels) {
  const ExrImage whole = Write(TestFilm({0, 0, 100, 80}, DefaultLayers()));
  const ExrImage crop = Write(TestFilm({33, 7, 71, 66}, DefaultLayers()));
  const auto r = CompareImages(crop, whole, NumericOnly());
  ASSERT_TRUE(r.ok()) << r.status();
  EXPECT_TRUE(r->hash_equal);
  EXPECT_FALSE(r->hash_a.empty());
}

TEST_F(CompareFiles, MasksComeFromNpyAndExr) {
  const std::string dict = "{'descr': '|b1', 'fortran_order': False, 'shape': (2, 3), }\n";
  std::string npy = std::string("\x93NUMPY\x01") + '\0' + static_cast<char>(dict.size()) + '\0' +
                    dict + std::string("\0\1\1\0\0\1", 6);
  ASSERT_TRUE(
      WriteFileAtomically(Path("m.npy"), std::as_bytes(std::span(npy.data(), npy.size()))).ok());
  const absl::StatusOr<PixelMask> from_npy = ReadMask(Path("m.npy"));
  ASSERT_TRUE(from_npy.ok()) << from_npy.status();
  EXPECT_EQ(from_npy->rect, (PixelRect{0, 0, 3, 2}));
  EXPECT_EQ(from_npy->on, (std::vector<uint8_t>{0, 1, 1, 0, 0, 1}));

  Film film({10, 20, 13, 22}, {Layer::kDepth});
  for (int i = 0; i < 6; ++i) {
    film.Plane(Layer::kDepth, 0)[static_cast<size_t>(i)] = from_npy->on[static_cast<size_t>(i)];
  }
  Write(film);
  const absl::StatusOr<PixelMask> from_exr = ReadMask(Path("f.exr"));
  ASSERT_TRUE(from_exr.ok()) << from_exr.status();
  EXPECT_EQ(from_exr->rect, film.rect());
  EXPECT_EQ(from_exr->on, from_npy->on);

  EXPECT_EQ(ReadMask(Path("none")).status().code(), absl::StatusCode::kNotFound);
  ASSERT_TRUE(WriteFileAtomically(Path("m.txt"), {}).ok());
  EXPECT_FALSE(ReadMask(Path("m.txt")).ok());
}

TEST_F(CompareFiles, ADifferenceImageIsWritten) {
  CompareOptions options;
  EXPECT_TRUE(WriteDiffPng(Path("d.png"), Rgb16(1, 2, 3), Rgb16(1, 2, 2), options, 0).ok());
  EXPECT_GT(std::filesystem::file_size(Path("d.png")), 60u);
  options.layer = "nothing";
  EXPECT_FALSE(WriteDiffPng(Path("d.png"), Rgb16(1, 2, 3), Rgb16(1, 2, 2), options, 0).ok());
}

}  // namespace
}  // namespace farpoint

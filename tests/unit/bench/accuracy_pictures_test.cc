#include "bench/accuracy_pictures.h"

#include <gtest/gtest.h>

namespace farpoint {
namespace {

Film Grey(int width, int height, const std::function<float(int)>& value) {
  Film film({0, 0, width, height}, {Layer::kIrradiance});
  for (int y = 0; y < height; ++y) {
    for (int x = 0; x < width; ++x) {
      const float e = value(x);
      const float rgb[] = {e, e, e};
      film.Set(Layer::kIrradiance, x, y, rgb);
    }
  }
  return film;
}

TEST(AccuracyPictures, QuantilesAreOfWhatIsLit) {
  const Film film = Grey(101, 1, [](int x) { return static_cast<float>(x); });
  EXPECT_NEAR(LuminanceQuantile(film, Layer::kIrradiance, 0.5), 51, 1e-3);
  EXPECT_NEAR(LuminanceQuantile(film, Layer::kIrradiance, 1.0), 100, 1e-3);
  EXPECT_EQ(LuminanceQuantile(Grey(4, 4, [](int) { return 0.0f; }), Layer::kIrradiance, 0.5), 0);
}

TEST(AccuracyPictures, WhiteIsWhiteAndContrastSpreads) {
  const Film film = Grey(2, 1, [](int x) { return x == 0 ? 1.0f : 2.0f; });
  const Picture picture = ColourPicture(film, Layer::kIrradiance, 2.0f);
  EXPECT_EQ(picture.rgb[3], 255);
  EXPECT_EQ(picture.rgb[0], 188);  // sRGB of one half
  const Film flat = Grey(2, 1, [](int x) { return x == 0 ? 0.5f : 0.52f; });
  const Picture once = ContrastPicture(flat, Layer::kIrradiance, 1, 0.5f, 1);
  const Picture thrice = ContrastPicture(flat, Layer::kIrradiance, 1, 0.5f, 3);
  EXPECT_EQ(thrice.rgb[0], 128);
  EXPECT_NEAR(thrice.rgb[3] - 128, 3 * (once.rgb[3] - 128), 3);
  EXPECT_GT(thrice.rgb[3], once.rgb[3]);
}

TEST(AccuracyPictures, ErrorsHaveTheirColours) {
  const Film film = Grey(40, 20, [](int) { return 0.0f; });
  const std::vector<PixelPosition> pixels = {{5, 5}, {20, 5}, {35, 5}};
  const std::vector<float> errors = {-1, 0, 1};
  const Picture picture = ErrorPicture(film, Layer::kIrradiance, 1, pixels, errors, 1);
  const auto at = [&](int x, int c) {
    return picture.rgb[static_cast<size_t>(3 * (5 * 40 + x) + c)];
  };
  EXPECT_LT(at(5, 0), at(5, 2));
  EXPECT_EQ(at(20, 1), 255);
  EXPECT_GT(at(35, 0), at(35, 2));
  EXPECT_EQ(at(12, 1), 0) << "between the dots";
}

TEST(AccuracyPictures, ShrinkAndEnlarge) {
  Picture picture{4, 2, std::vector<uint8_t>(24, 100)};
  picture.rgb[0] = 200;
  const Picture half = ShrunkTo(picture, 3);
  ASSERT_EQ(half.width, 2);
  ASSERT_EQ(half.height, 1);
  EXPECT_EQ(half.rgb[0], 125);
  EXPECT_EQ(half.rgb[3], 100);
  const Picture large = Enlarged(picture, {0, 0, 2, 1}, 3);
  ASSERT_EQ(large.width, 6);
  ASSERT_EQ(large.height, 3);
  EXPECT_EQ(large.rgb.size(), 54u);
  EXPECT_EQ(large.rgb[6], 200);
  EXPECT_EQ(large.rgb[9], 100);
}

}  // namespace
}  // namespace farpoint

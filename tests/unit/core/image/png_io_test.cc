#include "core/image/png_io.h"

#include <gtest/gtest.h>
#include <png.h>

#include <cstring>
#include <filesystem>
#include <fstream>
#include <iterator>
#include <string>
#include <vector>

#include "core/image/exr_io.h"
#include "tests/unit/core/image/image_testing.h"

namespace farpoint {
namespace {

// Decoded by libpng itself: width, height and RGB.
struct Decoded {
  int width = 0, height = 0;
  std::vector<uint8_t> rgb;
};
Decoded Decode(const std::string& path) {
  png_image image;
  std::memset(&image, 0, sizeof(image));
  image.version = PNG_IMAGE_VERSION;
  EXPECT_TRUE(png_image_begin_read_from_file(&image, path.c_str())) << image.message;
  image.format = PNG_FORMAT_RGB;
  Decoded d{static_cast<int>(image.width), static_cast<int>(image.height), {}};
  d.rgb.resize(PNG_IMAGE_SIZE(image));
  EXPECT_TRUE(png_image_finish_read(&image, nullptr, d.rgb.data(), 0, nullptr)) << image.message;
  return d;
}

class PngIo : public ImageFiles {};

TEST_F(PngIo, RoundTrips) {
  std::vector<uint8_t> rgb;
  for (int i = 0; i < 3 * 5 * 4; ++i) rgb.push_back(static_cast<uint8_t>(i * 41));
  ASSERT_TRUE(WritePng(Path("f.png"), 5, 4, rgb).ok());
  EXPECT_FALSE(std::filesystem::exists(Path("f.png.part")));
  const Decoded d = Decode(Path("f.png"));
  EXPECT_EQ(d.width, 5);
  EXPECT_EQ(d.height, 4);
  EXPECT_EQ(d.rgb, rgb);
}

TEST_F(PngIo, EncodedBytesAreThoseOfTheFile) {
  const std::vector<uint8_t> rgb(size_t{3} * 7 * 2, 0x5a);
  const auto bytes = EncodePng(7, 2, rgb);
  ASSERT_TRUE(bytes.ok()) << bytes.status();
  ASSERT_TRUE(WritePng(Path("f.png"), 7, 2, rgb).ok());
  std::ifstream file(Path("f.png"), std::ios::binary);
  const std::string text{std::istreambuf_iterator<char>(file), std::istreambuf_iterator<char>()};
  ASSERT_EQ(text.size(), bytes->size());
  EXPECT_EQ(std::memcmp(text.data(), bytes->data(), text.size()), 0);
}

TEST_F(PngIo, RefusesWrongSizes) {
  const std::vector<uint8_t> rgb(12);
  EXPECT_FALSE(EncodePng(3, 2, rgb).ok());
  EXPECT_FALSE(EncodePng(0, 0, {}).ok());
  EXPECT_FALSE(WritePng(Path("f.png"), 3, 2, rgb).ok());
  EXPECT_FALSE(WritePng(Path("f.png"), 0, 0, {}).ok());
  EXPECT_EQ(WritePng(Path("no/f.png"), 2, 2, rgb).code(), absl::StatusCode::kNotFound);
}

TEST_F(PngIo, PreviewsAreSrgbOfTheExposedBeauty) {
  Film film({10, 20, 14, 21}, {Layer::kBeauty});
  const float linear[4] = {0.0f, 0.21404114f, 1.0f, -3.0f};  // sRGB 0, 0.5, 1 and nonsense
  for (int i = 0; i < 4; ++i) {
    const float color[4] = {linear[i], linear[i] / 4, 100.0f, 1.0f};
    film.Set(Layer::kBeauty, 10 + i, 20, color);
  }
  ASSERT_TRUE(WritePngPreview(Path("f.png"), film, 0.0f).ok());
  const std::vector<uint8_t> plain = Decode(Path("f.png")).rgb;
  EXPECT_EQ(plain[0], 0);
  EXPECT_EQ(plain[3], 128);
  EXPECT_EQ(plain[6], 255);
  EXPECT_EQ(plain[9], 0);
  EXPECT_EQ(plain[2], 255);
  ASSERT_TRUE(WritePngPreview(Path("f.png"), film, 2.0f).ok());
  EXPECT_EQ(Decode(Path("f.png")).rgb[4], 128);  // a quarter, two stops up
  EXPECT_EQ(WritePngPreview(Path("f.png"), Film({0, 0, 1, 1}, {Layer::kDepth}), 0).code(),
            absl::StatusCode::kInvalidArgument);
}

}  // namespace
}  // namespace farpoint

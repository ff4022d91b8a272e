#include "core/scene/image_decode.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "tests/unit/core/scene/scene_test_util.h"

namespace farpoint {
namespace {

using ::testing::HasSubstr;

absl::StatusOr<DecodedImage> Decode(const std::string& bytes) {
  return DecodeImage("test.png", std::as_bytes(std::span(bytes)));
}

TEST(DecodeImage, GivesThePixelsInRowsFromTheTopWithRedLowest) {
  const auto image = Decode(MakePng(2, 2, {1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16}));
  ASSERT_TRUE(image.ok()) << image.status();
  EXPECT_EQ(image->width, 2u);
  EXPECT_EQ(image->height, 2u);
  EXPECT_EQ(image->texels, (std::vector<uint32_t>{0x04030201, 0x08070605, 0x0c0b0a09, 0x100f0e0d}));
}

TEST(DecodeImage, RefusesWhatIsNoImageAndNamesIt) {
  for (const std::string& bytes :
       {std::string(), std::string("not an image"), std::string(1, 'x')}) {
    const auto image = Decode(bytes);
    ASSERT_FALSE(image.ok());
    EXPECT_EQ(image.status().code(), absl::StatusCode::kInvalidArgument);
    EXPECT_THAT(std::string(image.status().message()), HasSubstr("test.png"));
  }
}

TEST(DecodeImage, SurvivesEveryTruncationAndFlip) {
  std::vector<uint8_t> pixels(16 * 16 * 4);
  for (size_t i = 0; i < pixels.size(); ++i) pixels[i] = static_cast<uint8_t>(i * 37);
  const std::string png = MakePng(16, 16, pixels);
  // What the pixels need ends with the data's chunk; only the checksum and IEND follow.
  const size_t needed = png.size() - 16;
  for (size_t size = 0; size < needed; ++size) EXPECT_FALSE(Decode(png.substr(0, size)).ok());
  for (size_t i = 0; i < png.size(); ++i) {
    std::string flipped = png;
    flipped[i] = static_cast<char>(flipped[i] ^ (1 << (i % 8)));
    const auto image = Decode(flipped);
    if (image.ok()) {
      EXPECT_EQ(image->texels.size(), size_t{image->width} * image->height);
    }
  }
}

TEST(DecodeImage, RefusesSizesBeyondItsLimitBeforeDecoding) {
  const std::vector<uint8_t> pixel(4);
  const auto wide = Decode(MakePng(1, 1, pixel, 20000, 1));
  ASSERT_FALSE(wide.ok());
  EXPECT_THAT(std::string(wide.status().message()), HasSubstr("20000 x 1"));
  const auto large = Decode(MakePng(1, 1, pixel, 16384, 16384));
  ASSERT_FALSE(large.ok());
  EXPECT_THAT(std::string(large.status().message()), HasSubstr("2^27"));
}

TEST(DecodeImage, IsNotBlownUpByDataThatInflatesBeyondTheHeader) {
  // 16 MiB of rows behind a header of one pixel.
  const std::vector<uint8_t> rows(size_t{2048} * 2048 * 4);
  const auto image = Decode(MakePng(2048, 2048, rows, 1, 1));
  EXPECT_FALSE(image.ok());
}

}  // namespace
}  // namespace farpoint

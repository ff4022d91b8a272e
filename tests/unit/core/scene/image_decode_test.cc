#include "core/scene/image_decode.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "tests/unit/core/scene/scene_test_util.h"

namespace farpoint {
namespace {

using ::testing::HasSubstr;
using ::testing::Not;

absl::StatusOr<DecodedImage> Decode(const std::string& bytes) {
  return DecodeImage("test.png", std::as_bytes(std::span(bytes)));
}

std::string FromBase64(const std::string& text) {
  std::string bytes;
  uint32_t group = 0, bits = 0;
  for (const char c : text) {
    const uint32_t digit = c >= 'A' && c <= 'Z'   ? static_cast<uint32_t>(c - 'A')
                           : c >= 'a' && c <= 'z' ? static_cast<uint32_t>(c - 'a' + 26)
                           : c >= '0' && c <= '9' ? static_cast<uint32_t>(c - '0' + 52)
                           : c == '+'             ? 62
                                                  : 63;
    if (c == '=') break;
    group = group << 6 | digit;
    bits += 6;
    if (bits < 8) continue;
    bits -= 8;
    bytes += static_cast<char>(group >> bits & 255);
  }
  return bytes;
}

TEST(DecodeImage, GivesThePixelsInRowsFromTheTopWithRedLowest) {
  const auto image = Decode(MakePng(2, 2, {1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16}));
  ASSERT_TRUE(image.ok()) << image.status();
  EXPECT_EQ(image->width, 2u);
  EXPECT_EQ(image->height, 2u);
  EXPECT_EQ(image->texels, (std::vector<uint32_t>{0x04030201, 0x08070605, 0x0c0b0a09, 0x100f0e0d}));
}

// 2 x 2 texels, made with Python's zlib; expected is what was put in, from 16 bits the upper 8.
TEST(DecodeImage, ReadsEveryKindOfPng) {
  struct Case {
    const char *name, *base64;
    std::vector<uint32_t> texels;
  };
  const Case cases[] = {
      {"8-bit RGB",
       "iVBORw0KGgoAAAANSUhEUgAAAAIAAAACCAIAAAD91JpzAAAAE0lEQVR42mP4z8DAAMIM/xsaGgAc9AR+"
       "nXGMPQAAAABJRU5ErkJggg==",
       {0xff0000ff, 0xff00ff00, 0xffff0000, 0xff808080}},
      {"16-bit RGB",
       "iVBORw0KGgoAAAANSUhEUgAAAAIAAAACEAIAAACtREYwAAAAE0lEQVR42mP4/58BDGA0kNEABgBrOQj7"
       "tvkCBQAAAABJRU5ErkJggg==",
       {0xff0000ff, 0xff00ff00, 0xffff0000, 0xff808080}},
      {"16-bit RGBA",
       "iVBORw0KGgoAAAANSUhEUgAAAAIAAAACEAYAAAAiJtFnAAAAGklEQVR42mP4/58BCEAkCDc0MMC4DWDw"
       "/z8A32UN93Ikh3kAAAAASUVORK5CYII=",
       {0xff0000ff, 0x8000ff00, 0x00ff0000, 0xff808080}},
      {"2-bit palette with tRNS",
       "iVBORw0KGgoAAAANSUhEUgAAAAIAAAACAgMAAAAP2OW3AAAADFBMVEX/AAAA/wAAAP+AgIDMsEYPAAAA"
       "A3RSTlP/gAB/bWh4AAAADElEQVR42mMQYNgAAADkAMEZVTv7AAAAAElFTkSuQmCC",
       {0xff0000ff, 0x8000ff00, 0x00ff0000, 0xff808080}},
      {"1-bit grey",
       "iVBORw0KGgoAAAANSUhEUgAAAAIAAAACAQAAAABazTCJAAAADElEQVR42mNwYGgAAAFEAMEEh8/6AAAA"
       "AElFTkSuQmCC",
       {0xff000000, 0xffffffff, 0xffffffff, 0xff000000}},
      {"16-bit grey",
       "iVBORw0KGgoAAAANSUhEUgAAAAIAAAACEAAAAAAHTY67AAAAEklEQVR42mNgYPj/n6GhgZERABCAAwF1"
       "wfYPAAAAAElFTkSuQmCC",
       {0xff000000, 0xffffffff, 0xff808080, 0xff010101}},
      {"8-bit grey with alpha",
       "iVBORw0KGgoAAAANSUhEUgAAAAIAAAACCAQAAADYv8WvAAAAEklEQVR42mNg+P+/gaGBgfE/ABT8A/+u"
       "pBaqAAAAAElFTkSuQmCC",
       {0xff000000, 0x80ffffff, 0x00808080, 0xff010101}},
      {"RGB with a transparent colour",
       "iVBORw0KGgoAAAANSUhEUgAAAAIAAAACCAIAAAD91JpzAAAABnRSTlMAAAD/AADQPjN8AAAAE0lEQVR4"
       "2mP4z8DAAMIM/xsaGgAc9AR+nXGMPQAAAABJRU5ErkJggg==",
       {0xff0000ff, 0x0000ff00, 0xffff0000, 0xff808080}},
      {"interlaced RGB",
       "iVBORw0KGgoAAAANSUhEUgAAAAIAAAACCAIAAAGK06rlAAAAEUlEQVR42mP4zwAEEKKhoQEAHfQEfnK7"
       "tRwAAAAASUVORK5CYII=",
       {0xff0000ff, 0xff00ff00, 0xffff0000, 0xff808080}},
  };
  for (const Case& c : cases) {
    const auto image = Decode(FromBase64(c.base64));
    ASSERT_TRUE(image.ok()) << c.name << ": " << image.status();
    EXPECT_EQ(image->texels, c.texels) << c.name;
  }
}

// stb_image would write them beyond its arrays.
TEST(DecodeImage, RefusesHuffmanTablesOfMoreThan256Codes) {
  const auto jpeg = [](const std::vector<int>& counts, size_t before) {
    std::string text("\xff\xff\xd8", before > 0 ? 3 : 0);
    if (before == 0) text = std::string("\xff\xd8", 2);
    text += std::string("\xff\xe0\x00\x04\x01\x02", 6);  // a segment to be passed over
    text += std::string(before, '\0');
    const size_t length = 2 + 17 * counts.size();
    text += std::string("\xff\xff\xc4", 3);  // markers may be padded
    text += static_cast<char>(length >> 8);
    text += static_cast<char>(length & 255);
    for (const int count : counts) {
      text += '\0';
      text += std::string(16, static_cast<char>(count));
    }
    return text + std::string(100, '\x01');
  };
  const auto message = [](const std::string& text) {
    const auto bytes = std::as_bytes(std::span(text));
    return std::string(DecodeImage("bad.jpg", bytes).status().message());
  };
  for (const size_t before : {0u, 3u}) {
    EXPECT_THAT(message(jpeg({255}, before)), HasSubstr("Huffman table"));
    EXPECT_THAT(message(jpeg({17}, before)), HasSubstr("Huffman table"));
    EXPECT_THAT(message(jpeg({0, 17}, before)), HasSubstr("Huffman table"));
    EXPECT_THAT(message(jpeg({16}, before)), Not(HasSubstr("Huffman table")));
  }
}

// 8 x 8 texels of one colour, written by libjpeg at quality 90.
TEST(DecodeImage, ReadsEveryKindOfJpeg) {
  struct Case {
    const char *name, *base64;
    uint8_t rgb[3];
  };
  const Case cases[] = {
      {"baseline",
       "/9j/4AAQSkZJRgABAQAAAQABAAD/2wBDAAMCAgMCAgMDAwMEAwMEBQgFBQQEBQoHBwYIDAoMDAsKCwsN"
       "DhIQDQ4RDgsLEBYQERMUFRUVDA8XGBYUGBIUFRT/2wBDAQMEBAUEBQkFBQkUDQsNFBQUFBQUFBQUFBQU"
       "FBQUFBQUFBQUFBQUFBQUFBQUFBQUFBQUFBQUFBQUFBQUFBQUFBT/wAARCAAIAAgDASIAAhEBAxEB/8QA"
       "FQABAQAAAAAAAAAAAAAAAAAAAAT/xAAUEAEAAAAAAAAAAAAAAAAAAAAA/8QAFQEBAQAAAAAAAAAAAAAA"
       "AAAABwj/xAAUEQEAAAAAAAAAAAAAAAAAAAAA/9oADAMBAAIRAxEAPwCQAHqQf//Z",
       {200, 100, 50}},
      {"progressive",
       "/9j/4AAQSkZJRgABAQAAAQABAAD/2wBDAAMCAgMCAgMDAwMEAwMEBQgFBQQEBQoHBwYIDAoMDAsKCwsN"
       "DhIQDQ4RDgsLEBYQERMUFRUVDA8XGBYUGBIUFRT/2wBDAQMEBAUEBQkFBQkUDQsNFBQUFBQUFBQUFBQU"
       "FBQUFBQUFBQUFBQUFBQUFBQUFBQUFBQUFBQUFBQUFBQUFBQUFBT/wgARCAAIAAgDASIAAhEBAxEB/8QA"
       "FQABAQAAAAAAAAAAAAAAAAAAAAP/xAAVAQEBAAAAAAAAAAAAAAAAAAAGB//aAAwDAQACEAMQAAABiA9I"
       "/8QAFBABAAAAAAAAAAAAAAAAAAAAAP/aAAgBAQABBQJ//8QAFBEBAAAAAAAAAAAAAAAAAAAAAP/aAAgB"
       "AwEBPwF//8QAFBEBAAAAAAAAAAAAAAAAAAAAAP/aAAgBAgEBPwF//8QAFBABAAAAAAAAAAAAAAAAAAAA"
       "AP/aAAgBAQAGPwJ//8QAFBABAAAAAAAAAAAAAAAAAAAAAP/aAAgBAQABPyF//9oADAMBAAIAAwAAABDz"
       "/8QAFBEBAAAAAAAAAAAAAAAAAAAAAP/aAAgBAwEBPxB//8QAFBEBAAAAAAAAAAAAAAAAAAAAAP/aAAgB"
       "AgEBPxB//8QAFBABAAAAAAAAAAAAAAAAAAAAAP/aAAgBAQABPxB//9k=",
       {200, 100, 50}},
      {"grey",
       "/9j/4AAQSkZJRgABAQAAAQABAAD/2wBDAAMCAgMCAgMDAwMEAwMEBQgFBQQEBQoHBwYIDAoMDAsKCwsN"
       "DhIQDQ4RDgsLEBYQERMUFRUVDA8XGBYUGBIUFRT/wAALCAAIAAgBAREA/8QAFAABAAAAAAAAAAAAAAAA"
       "AAAAB//EABQQAQAAAAAAAAAAAAAAAAAAAAD/2gAIAQEAAD8AGn//2Q==",
       {90, 90, 90}},
      {"CMYK, inverted as Adobe writes it",
       "/9j/7gAOQWRvYmUAZAAAAAAA/9sAQwADAgIDAgIDAwMDBAMDBAUIBQUEBAUKBwcGCAwKDAwLCgsLDQ4S"
       "EA0OEQ4LCxAWEBETFBUVFQwPFxgWFBgSFBUU/8AAFAgACAAIBEMRAE0RAFkRAEsRAP/EABYAAQEBAAAA"
       "AAAAAAAAAAAAAAgHCf/EABQQAQAAAAAAAAAAAAAAAAAAAAD/2gAOBEMATQBZAEsAAD8AYCaBe1Tf/9k=",
       {200, 100, 50}},
  };
  for (const Case& c : cases) {
    const auto image = Decode(FromBase64(c.base64));
    ASSERT_TRUE(image.ok()) << c.name << ": " << image.status();
    ASSERT_EQ(image->texels.size(), 64u) << c.name;
    for (int k = 0; k < 3; ++k) {
      EXPECT_NEAR(static_cast<int>(image->texels[9] >> (8 * k) & 255), c.rgb[k], 3) << c.name;
    }
    EXPECT_EQ(image->texels[9] >> 24, 255u) << c.name;
  }
}

TEST(EncodePng, IsReadBackAsItWas) {
  // Wide enough for rows of two stored blocks.
  for (const uint32_t width : {1u, 3u, 16384u}) {
    DecodedImage image{width, 3, {}};
    for (uint32_t i = 0; i < width * 3; ++i) image.texels.push_back(i * 2654435761u);
    const Blob png = EncodePng(image);
    const auto decoded = DecodeImage("again.png", png.bytes());
    ASSERT_TRUE(decoded.ok()) << decoded.status();
    EXPECT_EQ(decoded->texels, image.texels);
  }
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

#include "tests/unit/core/scene/scene_test_util.h"

#include <algorithm>

namespace farpoint {

namespace {

uint32_t Crc32(const std::string& data) {
  uint32_t crc = 0xffffffff;
  for (const char c : data) {
    crc ^= static_cast<uint8_t>(c);
    for (int k = 0; k < 8; ++k) crc = (crc >> 1) ^ (0xedb88320u & (0u - (crc & 1)));
  }
  return ~crc;
}

std::string BigEndian(uint32_t v) {
  return {static_cast<char>(v >> 24), static_cast<char>(v >> 16), static_cast<char>(v >> 8),
          static_cast<char>(v)};
}

std::string Chunk(const std::string& type, const std::string& data) {
  return BigEndian(static_cast<uint32_t>(data.size())) + type + data +
         BigEndian(Crc32(type + data));
}

}  // namespace

std::string MakePng(uint32_t width, uint32_t height, const std::vector<uint8_t>& rgba,
                    uint32_t declared_width, uint32_t declared_height) {
  std::string rows;
  for (uint32_t y = 0; y < height; ++y) {
    rows += '\0';
    rows.append(reinterpret_cast<const char*>(rgba.data()) + size_t{y} * width * 4, width * 4);
  }
  std::string zlib("\x78\x01", 2);
  uint32_t a = 1, b = 0;
  for (size_t at = 0; at < rows.size();) {
    const size_t size = std::min<size_t>(65535, rows.size() - at);
    zlib += at + size == rows.size() ? '\1' : '\0';
    zlib += static_cast<char>(size & 255);
    zlib += static_cast<char>(size >> 8);
    zlib += static_cast<char>(~size & 255);
    zlib += static_cast<char>((~size >> 8) & 255);
    zlib += rows.substr(at, size);
    at += size;
  }
  for (const char c : rows) {
    a = (a + static_cast<uint8_t>(c)) % 65521;
    b = (b + a) % 65521;
  }
  zlib += BigEndian(b << 16 | a);
  const std::string header = BigEndian(declared_width == 0 ? width : declared_width) +
                             BigEndian(declared_height == 0 ? height : declared_height) +
                             std::string("\x08\x06\0\0\0", 5);
  return std::string("\x89PNG\r\n\x1a\n", 8) + Chunk("IHDR", header) + Chunk("IDAT", zlib) +
         Chunk("IEND", "");
}

std::string Base64(const std::string& bytes) {
  constexpr char kDigits[] = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
  std::string text;
  for (size_t i = 0; i < bytes.size(); i += 3) {
    uint32_t group = 0;
    const size_t count = std::min<size_t>(3, bytes.size() - i);
    for (size_t k = 0; k < 3; ++k) {
      group = group << 8 | (k < count ? static_cast<uint8_t>(bytes[i + k]) : 0);
    }
    for (size_t k = 0; k < 4; ++k) {
      text += k <= count ? kDigits[group >> (18 - 6 * k) & 63] : '=';
    }
  }
  return text;
}

}  // namespace farpoint

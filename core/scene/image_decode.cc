#include "core/scene/image_decode.h"

#include <algorithm>
#include <array>
#include <cstdlib>
#include <cstring>
#include <utility>

namespace {

// The largest block that the decoder may ask for. A compressed stream can inflate to a thousand
// times its size, whatever the image's header says.
thread_local size_t block_limit = 0;

// Zeros: stb_image 2.27 decodes by Huffman tables that a file does not define. Of what the memory
// held before, that reads anywhere and paints it; of zeros it reads symbol 0.
void* LimitedAlloc(size_t size) { return size > block_limit ? nullptr : std::calloc(1, size); }
void* LimitedRealloc(void* block, size_t size) {
  return size > block_limit ? nullptr : std::realloc(block, size);
}

}  // namespace

#define STB_IMAGE_IMPLEMENTATION
#define STB_IMAGE_STATIC
#define STBI_ONLY_PNG
#define STBI_ONLY_JPEG
#define STBI_NO_STDIO
#define STBI_NO_LINEAR
#define STBI_NO_HDR
#define STBI_MALLOC(size) LimitedAlloc(size)
#define STBI_REALLOC(block, size) LimitedRealloc(block, size)
#define STBI_FREE(block) std::free(block)
#pragma GCC diagnostic push
#pragma GCC diagnostic ignored "-Wunused-function"
#pragma GCC diagnostic ignored "-Wmissing-field-initializers"
#include <stb/stb_image.h>
#pragma GCC diagnostic pop

namespace farpoint {

namespace {

constexpr uint64_t kMaxTexels = uint64_t{1} << 27;
constexpr size_t kHeaderBlockLimit = size_t{1} << 20;

absl::Status Fail(const std::string& name, const std::string& text) {
  return absl::InvalidArgumentError("image '" + name + "': " + text);
}

const stbi_uc* DataOf(std::span<const std::byte> bytes) {
  return reinterpret_cast<const stbi_uc*>(bytes.data());
}

// False for a JPEG with a Huffman table of more than 256 codes, which stb_image 2.27 writes beyond
// its arrays. Reads the markers as stb_image does, so that it sees every table that that will see.
bool HuffmanTablesFit(std::span<const std::byte> bytes) {
  const auto at = [&](size_t i) {
    return i < bytes.size() ? std::to_integer<unsigned>(bytes[i]) : 0u;
  };
  constexpr unsigned kMark = 0xff, kStart = 0xd8, kEnd = 0xd9, kHuffman = 0xc4;
  size_t start = 0;
  while (start < bytes.size() && at(start) == kMark) ++start;
  if (start == 0 || at(start) != kStart) return true;  // no JPEG
  constexpr size_t kCounts = 16, kMaxCodes = 256;
  for (size_t i = start + 1; i < bytes.size();) {
    if (at(i) != kMark) {  // padding, or the data of a scan
      ++i;
      continue;
    }
    while (i < bytes.size() && at(i) == kMark) ++i;
    const unsigned marker = at(i++);
    if (marker == kEnd) return true;
    // What stands alone: a stuffed byte, restarts.
    if (marker == 0 || marker == 1 || (marker >= 0xd0 && marker < kEnd)) continue;
    const size_t length = at(i) << 8 | at(i + 1);
    if (length < 2) return true;  // stb_image gives up here
    if (marker == kHuffman) {
      size_t table = i + 2;
      for (auto left = static_cast<int64_t>(length) - 2; left > 0 && table < bytes.size();) {
        size_t codes = 0;
        for (size_t k = 1; k <= kCounts; ++k) codes += at(table + k);
        if (codes > kMaxCodes) return false;
        table += 1 + kCounts + codes;
        left -= static_cast<int64_t>(1 + kCounts + codes);
      }
      // The last table may reach beyond its segment: reading goes on behind it.
      i = std::max(i + length, table);
      continue;
    }
    i += length;
  }
  return true;
}

constexpr size_t kMaxStoredBlock = 65535;

std::array<uint32_t, 256> MakeCrcTable() {
  std::array<uint32_t, 256> table{};
  for (uint32_t i = 0; i < 256; ++i) {
    uint32_t crc = i;
    for (int k = 0; k < 8; ++k) crc = (crc >> 1) ^ (0xedb88320u & (0u - (crc & 1)));
    table[i] = crc;
  }
  return table;
}

// Chunks with their CRC (PNG specification, section 5.3).
class PngWriter {
 public:
  PngWriter() {
    for (const int byte :
         std::array<int, 8>{0x89, 80, 78, 71, 13, 10, 26, 10}) {  // "\x89PNG\r\n\x1a\n"
      Push(static_cast<uint8_t>(byte));
    }
  }
  void BeginChunk(const char* type, size_t size) {
    bytes_.reserve(bytes_.size() + size + 12);
    BigEndian(static_cast<uint32_t>(size));
    crc_ = 0xffffffff;
    for (int i = 0; i < 4; ++i) Byte(static_cast<uint8_t>(type[i]));
  }
  void EndChunk() { BigEndian(~crc_); }
  void Byte(uint8_t byte) {
    static const std::array<uint32_t, 256> kCrc = MakeCrcTable();
    crc_ = (crc_ >> 8) ^ kCrc[(crc_ ^ byte) & 255];
    Push(byte);
  }
  void BigEndian(uint32_t v) {
    for (const int shift : {24, 16, 8, 0}) Byte(static_cast<uint8_t>(v >> shift));
  }
  std::vector<std::byte> TakeBytes() { return std::move(bytes_); }

 private:
  void Push(uint8_t byte) { bytes_.push_back(std::byte{byte}); }

  std::vector<std::byte> bytes_;
  uint32_t crc_ = 0;
};

class Adler32 {
 public:
  void Add(std::span<const uint8_t> bytes) {
    for (const uint8_t byte : bytes) {
      a_ = (a_ + byte) % 65521;
      b_ = (b_ + a_) % 65521;
    }
  }
  uint32_t value() const { return b_ << 16 | a_; }

 private:
  uint32_t a_ = 1, b_ = 0;
};

}  // namespace

absl::StatusOr<ImageSize> ReadImageSize(const std::string& name, std::span<const std::byte> bytes) {
  if (bytes.empty()) return Fail(name, "is empty; export it again");
  if (bytes.size() > (size_t{1} << 30)) return Fail(name, "has more than 1 GiB; make it smaller");
  if (!HuffmanTablesFit(bytes)) {
    return Fail(name, "has a Huffman table of more than 256 codes; export it again");
  }
  int width = 0, height = 0, channels = 0;
  block_limit = kHeaderBlockLimit;
  if (stbi_info_from_memory(DataOf(bytes), static_cast<int>(bytes.size()), &width, &height,
                            &channels) == 0) {
    return Fail(name, std::string("cannot be read (") + stbi_failure_reason() +
                          "); PNG and JPEG are supported");
  }
  if (width < 1 || height < 1 || width > static_cast<int>(kMaxImageSide) ||
      height > static_cast<int>(kMaxImageSide) ||
      static_cast<uint64_t>(width) * static_cast<uint64_t>(height) > kMaxTexels) {
    return Fail(name, "is " + std::to_string(width) + " x " + std::to_string(height) +
                          " texels; at most " + std::to_string(kMaxImageSide) +
                          " on a side and 2^27 in all are read: make it smaller");
  }
  return ImageSize{static_cast<uint32_t>(width), static_cast<uint32_t>(height)};
}

absl::StatusOr<DecodedImage> DecodeImage(const std::string& name,
                                         std::span<const std::byte> bytes) {
  FP_ASSIGN_OR_RETURN(const ImageSize size, ReadImageSize(name, bytes));
  // Four channels of 16 bits, blocks padded to 64 texels, and a factor of two for growing buffers.
  block_limit = kHeaderBlockLimit + 16 * (size_t{size.width} + 64) * (size_t{size.height} + 64);
  int width = 0, height = 0, channels = 0;
  stbi_uc* decoded = stbi_load_from_memory(DataOf(bytes), static_cast<int>(bytes.size()), &width,
                                           &height, &channels, 4);
  if (decoded == nullptr) {
    return Fail(name,
                std::string("cannot be decoded (") + stbi_failure_reason() + "); export it again");
  }
  DecodedImage image;
  image.width = static_cast<uint32_t>(width);
  image.height = static_cast<uint32_t>(height);
  image.texels.resize(static_cast<size_t>(width) * static_cast<size_t>(height));
  std::memcpy(image.texels.data(), decoded, image.texels.size() * sizeof(uint32_t));
  stbi_image_free(decoded);
  return image;
}

Blob EncodePng(const DecodedImage& image) {
  PngWriter png;
  png.BeginChunk("IHDR", 13);
  png.BigEndian(image.width);
  png.BigEndian(image.height);
  for (const int byte : {8, 6, 0, 0, 0})
    png.Byte(static_cast<uint8_t>(byte));  // 8-bit RGBA, not interlaced
  png.EndChunk();
  // Stored blocks of deflate (RFC 1951, 3.2.4), one for each row; a row of the largest image has
  // 65,537 bytes, so it may take two.
  const size_t row_bytes = 1 + size_t{image.width} * 4;
  const size_t blocks_per_row = (row_bytes + kMaxStoredBlock - 1) / kMaxStoredBlock;
  png.BeginChunk("IDAT", 2 + image.height * (row_bytes + 5 * blocks_per_row) + 4);
  png.Byte(0x78);
  png.Byte(0x01);
  Adler32 adler;
  std::vector<uint8_t> row(row_bytes);
  for (uint32_t y = 0; y < image.height; ++y) {
    std::memcpy(row.data() + 1, &image.texels[size_t{y} * image.width], row_bytes - 1);
    adler.Add(row);
    for (size_t at = 0; at < row_bytes; at += kMaxStoredBlock) {
      const size_t size = std::min(kMaxStoredBlock, row_bytes - at);
      png.Byte(y + 1 == image.height && at + size == row_bytes ? 1 : 0);
      png.Byte(static_cast<uint8_t>(size & 255));
      png.Byte(static_cast<uint8_t>(size >> 8));
      png.Byte(static_cast<uint8_t>(~size & 255));
      png.Byte(static_cast<uint8_t>(~size >> 8 & 255));
      for (size_t i = at; i < at + size; ++i) png.Byte(row[i]);
    }
  }
  png.BigEndian(adler.value());
  png.EndChunk();
  png.BeginChunk("IEND", 0);
  png.EndChunk();
  return Blob::FromVector(png.TakeBytes());
}

}  // namespace farpoint

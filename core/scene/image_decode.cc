#include "core/scene/image_decode.h"

#include <cstdlib>
#include <cstring>

namespace {

// The largest block that the decoder may ask for. A compressed stream can inflate to a thousand
// times its size, whatever the image's header says.
thread_local size_t block_limit = 0;

void* LimitedAlloc(size_t size) { return size > block_limit ? nullptr : std::malloc(size); }
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

}  // namespace

absl::StatusOr<ImageSize> ReadImageSize(const std::string& name, std::span<const std::byte> bytes) {
  if (bytes.empty()) return Fail(name, "is empty; export it again");
  if (bytes.size() > (size_t{1} << 30)) return Fail(name, "has more than 1 GiB; make it smaller");
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

}  // namespace farpoint

#include "core/image/png_io.h"

#include <png.h>

#include <cstring>
#include <vector>

#include "core/base/blob.h"

namespace farpoint {

absl::StatusOr<std::vector<std::byte>> EncodePng(int width, int height,
                                                 std::span<const uint8_t> rgb) {
  if (width <= 0 || height <= 0 || rgb.size() != size_t{3} * width * height) {
    return absl::InvalidArgumentError(std::to_string(rgb.size()) + " bytes are no RGB image of " +
                                      std::to_string(width) + "x" + std::to_string(height) +
                                      " pixels");
  }
  // libpng's simplified interface: errors are values, no longjmp.
  png_image image;
  std::memset(&image, 0, sizeof(image));
  image.version = PNG_IMAGE_VERSION;
  image.width = static_cast<png_uint_32>(width);
  image.height = static_cast<png_uint_32>(height);
  image.format = PNG_FORMAT_RGB;
  std::vector<std::byte> bytes(PNG_IMAGE_PNG_SIZE_MAX(image));
  png_alloc_size_t size = bytes.size();
  if (!png_image_write_to_memory(&image, bytes.data(), &size, 0, rgb.data(), 0, nullptr)) {
    return absl::InvalidArgumentError(std::string("cannot encode PNG: ") + image.message);
  }
  bytes.resize(size);
  return bytes;
}

absl::Status WritePng(const std::string& path, int width, int height,
                      std::span<const uint8_t> rgb) {
  const absl::StatusOr<std::vector<std::byte>> bytes = EncodePng(width, height, rgb);
  if (!bytes.ok()) return Annotate(bytes.status(), "'" + path + "'");
  return WriteFileAtomically(path, *bytes);
}

}  // namespace farpoint

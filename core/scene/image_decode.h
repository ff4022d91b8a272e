// Encoded images to texels, and back.
#pragma once

#include <cstddef>
#include <cstdint>
#include <span>
#include <string>
#include <vector>

#include "core/base/blob.h"
#include "core/base/status.h"

namespace farpoint {

inline constexpr uint32_t kMaxImageSide = 16384;

struct DecodedImage {
  uint32_t width = 0, height = 0;
  std::vector<uint32_t> texels;  // rows from the top, RGBA8 with R in the lowest byte
};

struct ImageSize {
  uint32_t width = 0, height = 0;
};

// What the image's header says, with the checks of DecodeImage and without decoding.
absl::StatusOr<ImageSize> ReadImageSize(const std::string& name, std::span<const std::byte> bytes);

// PNG and JPEG; 16-bit and grey images become RGBA8. kInvalidArgument names the image and says why
// it cannot be read, or that it is larger than kMaxImageSide on a side or 2^27 texels. Memory is
// bounded by the size that the image's header declares, whatever its data inflates to.
absl::StatusOr<DecodedImage> DecodeImage(const std::string& name, std::span<const std::byte> bytes);

// An RGBA PNG of the same texels, not compressed: for images that exist only for a short while.
Blob EncodePng(const DecodedImage& image);

}  // namespace farpoint

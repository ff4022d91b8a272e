// The packets of tev, the image viewer to which pbrt and Mitsuba stream their images: u32 length of
// the whole packet, u8 operation, payload; little-endian; texts end in a zero byte, a bool is a
// byte. There is no handshake and no answer. Source: tev's src/Ipc.cpp.
//
// Names must not hold a zero byte. Packets are smaller than 4 GiB for every film that ValidateFilm
// takes: UpdateImagePackets() cuts what is larger than kTevPacketBytes.
#pragma once

#include <cstddef>
#include <functional>
#include <span>
#include <string>
#include <string_view>
#include <vector>

#include "core/base/status.h"
#include "core/image/tile_rect.h"

namespace farpoint {

enum class TevOperation : unsigned char { kCloseImage = 2, kCreateImage = 4, kUpdateImageV3 = 6 };

// About as large as the values of one packet become; one row of pixels may be larger.
inline constexpr size_t kTevPacketBytes = size_t{1} << 20;

// An image of zeros; one of the same name is replaced. Does not take the keyboard's focus.
std::vector<std::byte> CreateImagePacket(std::string_view name, int width, int height,
                                         std::span<const std::string_view> channels);

// Hands on packets that set the pixels `rect` of the image, from the top row down; `values` holds
// rect's pixels channel by channel, rows top down. The first error of `send` ends it.
absl::Status UpdateImagePackets(
    std::string_view name, std::span<const std::string_view> channels, const PixelRect& rect,
    std::span<const float> values,
    const std::function<absl::Status(std::span<const std::byte>)>& send);

std::vector<std::byte> CloseImagePacket(std::string_view name);

}  // namespace farpoint

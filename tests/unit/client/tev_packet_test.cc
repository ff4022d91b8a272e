#include "client/tev_packet.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <bit>
#include <cstring>

namespace farpoint {
namespace {

using Bytes = std::vector<unsigned char>;

Bytes BytesOf(std::span<const std::byte> packet) {
  Bytes bytes;
  for (const std::byte byte : packet) bytes.push_back(static_cast<unsigned char>(byte));
  return bytes;
}
constexpr std::string_view kTwo[] = {"R", "Z"};

TEST(TevPacket, ACreatedImageIsTheseBytes) {
  EXPECT_EQ(BytesOf(CreateImagePacket("a.exr", 258, 2, kTwo)),
            (Bytes{28, 0, 0, 0, 4, 0, 'a', '.', 'e', 'x', 'r', 0, 2,   1,
                   0,  0, 2, 0, 0, 0, 2,   0,   0,   0,   'R', 0, 'Z', 0}));
}

TEST(TevPacket, AClosedImageIsTheseBytes) {
  EXPECT_EQ(BytesOf(CloseImagePacket("ab")), (Bytes{8, 0, 0, 0, 2, 'a', 'b', 0}));
}

TEST(TevPacket, AnUpdateIsTheseBytes) {
  const std::vector<float> values = {1, 2, 3, 4};
  std::vector<Bytes> packets;
  ASSERT_TRUE(UpdateImagePackets("i", kTwo, {3, 5, 5, 6}, values, [&](auto packet) {
                packets.push_back(BytesOf(packet));
                return absl::OkStatus();
              }).ok());
  ASSERT_EQ(packets.size(), 1u);
  Bytes expected = {80, 0, 0, 0, 6, 0, 'i', 0, 2, 0, 0, 0, 'R', 0, 'Z', 0,
                    3,  0, 0, 0, 5, 0, 0,   0, 2, 0, 0, 0, 1,   0, 0,   0};
  for (const unsigned char number : {0, 2, 1, 1}) {  // offsets, strides
    expected.push_back(number);
    expected.insert(expected.end(), 7, 0);
  }
  for (const float value : values) {
    const auto bits = std::bit_cast<std::array<unsigned char, 4>>(value);
    expected.insert(expected.end(), bits.begin(), bits.end());
  }
  EXPECT_EQ(packets[0], expected);
}

TEST(TevPacket, ALargeTileIsCutBetweenRows) {
  // 600 x 1000 pixels of two channels: 4800 bytes a row, 218 rows a packet.
  const PixelRect rect{10, 20, 610, 1020};
  std::vector<float> values(2 * 600 * 1000);
  for (size_t i = 0; i < values.size(); ++i) values[i] = static_cast<float>(i);
  int next_row = 20;
  ASSERT_TRUE(UpdateImagePackets("i", kTwo, rect, values, [&](auto packet) {
                EXPECT_LT(packet.size(), kTevPacketBytes + 200);
                int32_t place[4];
                std::memcpy(place, packet.data() + 16, sizeof(place));
                EXPECT_EQ(place[0], 10);
                EXPECT_EQ(place[1], next_row);
                EXPECT_EQ(place[2], 600);
                next_row += place[3];
                // The second channel's first value, behind the first channel's rows.
                float value = 0;
                std::memcpy(&value,
                            packet.data() + 32 + 32 + 4 * 600 * static_cast<size_t>(place[3]), 4);
                EXPECT_EQ(value, static_cast<float>(600'000 + (place[1] - 20) * 600));
                return absl::OkStatus();
              }).ok());
  EXPECT_EQ(next_row, 1020);
}

TEST(TevPacket, TheFirstErrorEndsAnUpdate) {
  int calls = 0;
  const std::vector<float> values(2 * 600 * 1000);
  EXPECT_EQ(UpdateImagePackets("i", kTwo, {0, 0, 600, 1000}, values,
                               [&](auto) {
                                 ++calls;
                                 return absl::UnavailableError("gone");
                               }),
            absl::UnavailableError("gone"));
  EXPECT_EQ(calls, 1);
}

}  // namespace
}  // namespace farpoint

#include "client/tev_packet.h"

#include <algorithm>
#include <bit>
#include <cstdint>
#include <cstring>
#include <type_traits>

#include "core/base/check.h"

namespace farpoint {
namespace {

static_assert(std::endian::native == std::endian::little,
              "values are copied as they lie in memory");

class Packet {
 public:
  explicit Packet(TevOperation operation) {
    Put(uint32_t{0});  // the length, known at the end
    Put(operation);
  }
  template <typename T>
  void Put(T value) {
    static_assert(std::is_trivially_copyable_v<T> && !std::is_same_v<T, bool>);
    Append(&value, sizeof(value));
  }
  void PutBool(bool value) { Put(static_cast<unsigned char>(value)); }
  void PutText(std::string_view text) {
    Append(text.data(), text.size());
    Put('\0');
  }
  void PutChannels(std::span<const std::string_view> channels) {
    Put(static_cast<int32_t>(channels.size()));
    for (const std::string_view channel : channels) PutText(channel);
  }
  void PutFloats(std::span<const float> values) { Append(values.data(), values.size_bytes()); }

  std::vector<std::byte> Finish() && {
    FP_CHECK(bytes_.size() <= UINT32_MAX);
    const auto length = static_cast<uint32_t>(bytes_.size());
    std::memcpy(bytes_.data(), &length, sizeof(length));
    return std::move(bytes_);
  }

 private:
  void Append(const void* data, size_t size) {
    const auto* begin = static_cast<const std::byte*>(data);
    bytes_.insert(bytes_.end(), begin, begin + size);
  }
  std::vector<std::byte> bytes_;
};

}  // namespace

std::vector<std::byte> CreateImagePacket(std::string_view name, int width, int height,
                                         std::span<const std::string_view> channels) {
  Packet packet(TevOperation::kCreateImage);
  packet.PutBool(false);
  packet.PutText(name);
  packet.Put(static_cast<int32_t>(width));
  packet.Put(static_cast<int32_t>(height));
  packet.PutChannels(channels);
  return std::move(packet).Finish();
}

absl::Status UpdateImagePackets(
    std::string_view name, std::span<const std::string_view> channels, const PixelRect& rect,
    std::span<const float> values,
    const std::function<absl::Status(std::span<const std::byte>)>& send) {
  const auto width = static_cast<size_t>(rect.width());
  const auto height = static_cast<size_t>(rect.height());
  FP_CHECK(values.size() == channels.size() * width * height);
  const size_t row_bytes = channels.size() * width * sizeof(float);
  const size_t rows_at_once = std::max<size_t>(1, kTevPacketBytes / std::max<size_t>(1, row_bytes));
  for (size_t y = 0; y < height; y += rows_at_once) {
    const size_t rows = std::min(rows_at_once, height - y);
    const size_t area = rows * width;
    Packet packet(TevOperation::kUpdateImageV3);
    packet.PutBool(false);
    packet.PutText(name);
    packet.PutChannels(channels);
    packet.Put(static_cast<int32_t>(rect.x0));
    packet.Put(static_cast<int32_t>(rect.y0 + static_cast<int>(y)));
    packet.Put(static_cast<int32_t>(width));
    packet.Put(static_cast<int32_t>(rows));
    for (size_t c = 0; c < channels.size(); ++c) packet.Put(static_cast<int64_t>(c * area));
    for (size_t c = 0; c < channels.size(); ++c) packet.Put(int64_t{1});
    for (size_t c = 0; c < channels.size(); ++c) {
      packet.PutFloats(values.subspan(c * width * height + y * width, area));
    }
    FP_RETURN_IF_ERROR(send(std::move(packet).Finish()));
  }
  return absl::OkStatus();
}

std::vector<std::byte> CloseImagePacket(std::string_view name) {
  Packet packet(TevOperation::kCloseImage);
  packet.PutText(name);
  return std::move(packet).Finish();
}

}  // namespace farpoint

#include "core/scene/hdr_decode.h"

#include <array>
#include <charconv>
#include <cmath>
#include <optional>
#include <string_view>
#include <system_error>
#include <utility>

namespace farpoint {

namespace {

constexpr uint32_t kMaxSide = 65536;

absl::Status Fail(const std::string& name, const std::string& text) {
  return absl::InvalidArgumentError("image '" + name + "': " + text);
}

// Reads the bytes from the front; `good` turns false beyond the end, and zeros follow.
struct Reader {
  std::span<const std::byte> bytes;
  size_t at = 0;
  bool good = true;

  uint8_t Byte() {
    if (at >= bytes.size()) {
      good = false;
      return 0;
    }
    return static_cast<uint8_t>(bytes[at++]);
  }
  std::string_view Line() {
    const size_t first = at;
    while (at < bytes.size() && bytes[at] != std::byte{'\n'}) ++at;
    const std::string_view line(reinterpret_cast<const char*>(bytes.data()) + first, at - first);
    if (at < bytes.size()) {
      ++at;
    } else {
      good = false;
    }
    return line;
  }
};

// "-Y 512 +X 1024": rows from the top, columns from the left.
std::optional<std::pair<uint32_t, uint32_t>> WidthAndHeight(std::string_view line) {
  const auto number = [&](std::string_view prefix, uint32_t& value) {
    if (!line.starts_with(prefix)) return false;
    line.remove_prefix(prefix.size());
    const auto [end, error] = std::from_chars(line.data(), line.data() + line.size(), value);
    line.remove_prefix(static_cast<size_t>(end - line.data()));
    return error == std::errc() && value >= 1 && value <= kMaxSide;
  };
  uint32_t width = 0, height = 0;
  if (!number("-Y ", height) || !number(" +X ", width) || !line.empty()) return std::nullopt;
  return std::pair(width, height);
}

using Rgbe = std::array<uint8_t, 4>;

// One row: run-length encoded by channel, or pixel by pixel with (1, 1, 1, n) for a run.
void ReadRow(Reader& r, std::vector<Rgbe>& row) {
  const size_t width = row.size();
  Rgbe first;
  for (uint8_t& b : first) b = r.Byte();
  if (first[0] == 2 && first[1] == 2 && first[2] < 128 && width >= 8 &&
      width == size_t{first[2]} * 256 + first[3]) {
    for (size_t channel = 0; channel < 4; ++channel) {
      for (size_t x = 0; x < width && r.good;) {
        size_t count = r.Byte();
        const bool run = count > 128;
        if (run) count -= 128;
        if (count == 0 || count > width - x) {
          r.good = false;
          return;
        }
        uint8_t value = run ? r.Byte() : 0;
        for (size_t i = 0; i < count; ++i) {
          if (!run) value = r.Byte();
          row[x++][channel] = value;
        }
      }
    }
    return;
  }
  Rgbe pixel = first;
  unsigned shift = 0;
  for (size_t x = 0; r.good;) {
    if (pixel[0] == 1 && pixel[1] == 1 && pixel[2] == 1) {
      const size_t count = size_t{pixel[3]} << shift;
      if (x == 0 || shift > 24 || count > width - x) {
        r.good = false;
        return;
      }
      for (size_t i = 0; i < count; ++i, ++x) row[x] = row[x - 1];
      shift += 8;
    } else {
      row[x++] = pixel;
      shift = 0;
    }
    if (x == width) return;
    for (uint8_t& b : pixel) b = r.Byte();
  }
}

}  // namespace

absl::StatusOr<HdrImage> DecodeHdr(const std::string& name, std::span<const std::byte> bytes,
                                   int64_t max_pixels) {
  Reader r{bytes};
  double exposure = 1;
  bool rgbe = false;
  std::string_view line = r.Line();
  if (!line.starts_with("#?")) return Fail(name, "is not a Radiance picture");
  for (line = r.Line(); r.good && !line.empty() && line != "\r"; line = r.Line()) {
    if (line.starts_with("FORMAT=32-bit_rle_rgbe")) rgbe = true;
    constexpr std::string_view kExposure = "EXPOSURE=";
    if (line.starts_with(kExposure)) {
      line.remove_prefix(kExposure.size());
      while (line.starts_with(' ')) line.remove_prefix(1);
      double factor = 0;
      std::from_chars(line.data(), line.data() + line.size(), factor);
      if (!(factor >= 1e-30 && factor <= 1e30)) {
        return Fail(name, "its EXPOSURE is no number from 1e-30 to 1e30; correct it");
      }
      exposure *= factor;
    }
  }
  if (!r.good) return Fail(name, "ends within its header; it is damaged");
  if (!rgbe) return Fail(name, "is not in the format 32-bit_rle_rgbe; convert it");
  if (!(exposure >= 1e-30 && exposure <= 1e30)) {
    return Fail(name, "its EXPOSUREs multiply to " + std::to_string(exposure) + "; correct them");
  }
  const auto size = WidthAndHeight(r.Line());
  if (!size) {
    return Fail(name,
                "its resolution is not '-Y <height> +X <width>' with sides up to 65536; "
                "write it in standard orientation");
  }
  const auto [width, height] = *size;
  const int64_t pixels = int64_t{width} * height;
  if (pixels > max_pixels) {
    return Fail(name, "is " + std::to_string(width) + " x " + std::to_string(height) +
                          " pixels; at most " + std::to_string(max_pixels) +
                          " in all are read: make it smaller");
  }
  HdrImage image;
  image.width = width;
  image.height = height;
  // Rows are appended as they are read, so memory follows what the file really holds.
  std::vector<Rgbe> row(width);
  const float scale = static_cast<float>(1.0 / exposure);
  for (uint32_t y = 0; y < height; ++y) {
    ReadRow(r, row);
    if (!r.good) {
      return Fail(name, "row " + std::to_string(y) + " of " + std::to_string(height) +
                            " is cut off or damaged; export it again");
    }
    for (const Rgbe& p : row) {
      // Mantissas of 8 bits and a common exponent; 0 is black (Ward 1991).
      const float unit = p[3] == 0 ? 0.0f : std::ldexp(scale, int{p[3]} - 136);
      image.pixels.push_back(Rgb(p[0], p[1], p[2]) * unit);
    }
  }
  return image;
}

}  // namespace farpoint

// What the tests of this folder share: films with known content and a folder for files.
#pragma once

#include <gtest/gtest.h>
#include <unistd.h>

#include <cmath>
#include <cstring>
#include <filesystem>
#include <fstream>
#include <string>
#include <string_view>
#include <vector>

#include "core/image/film.h"
#include "core/math/sampling.h"

namespace farpoint {

inline std::vector<Layer> EveryLayer() {
  std::vector<Layer> layers;
  for (const LayerInfo& info : AllLayers()) layers.push_back(info.layer);
  return layers;
}

// A value that depends on pixel, layer and channel only; some are zeros, negative, tiny, huge, and
// in the depth layer infinite.
inline float TestValue(Layer layer, int channel, int x, int y) {
  const uint64_t h = HashKey(static_cast<uint64_t>(layer), static_cast<uint64_t>(channel),
                             static_cast<uint64_t>(x), static_cast<uint64_t>(y));
  const float unit = ToUnitFloat(static_cast<uint32_t>(h));
  switch (h >> 60) {
    case 0:
      return 0.0f;
    case 1:
      return -0.0f;
    case 2:
      return -unit;
    case 3:
      return unit * 1e-7f;  // a subnormal half
    case 4:
      return unit * 1e7f;  // beyond the halves
    case 5:
      return layer == Layer::kDepth ? INFINITY : 1.0f;
    default:
      return unit * 3.0f;
  }
}

// Rounded to storage.
inline Film TestFilm(const PixelRect& rect, const std::vector<Layer>& layers) {
  Film film(rect, layers);
  for (const Layer layer : film.layers()) {
    for (int y = rect.y0; y < rect.y1; ++y) {
      for (int x = rect.x0; x < rect.x1; ++x) {
        float values[4];
        const size_t channels = InfoOf(layer).channels.size();
        for (size_t c = 0; c < channels; ++c) {
          values[c] = TestValue(layer, static_cast<int>(c), x, y);
        }
        film.Set(layer, x, y, std::span(values, channels));
      }
    }
  }
  film.RoundToStorage();
  return film;
}

// The same pixels, bit by bit.
inline bool SameFilm(const Film& a, const Film& b) {
  if (a.rect() != b.rect() || a.layers().size() != b.layers().size()) return false;
  for (const Layer layer : a.layers()) {
    for (size_t c = 0; c < InfoOf(layer).channels.size(); ++c) {
      const auto pa = a.Plane(layer, static_cast<int>(c)), pb = b.Plane(layer, static_cast<int>(c));
      if (pa.size() != pb.size() || std::memcmp(pa.data(), pb.data(), pa.size_bytes()) != 0) {
        return false;
      }
    }
  }
  return true;
}

// A fresh folder, removed at the end.
class ImageFiles : public testing::Test {
 protected:
  ImageFiles() {
    folder_ = std::filesystem::path(testing::TempDir()) /
              ("farpoint_image_" + std::to_string(::getpid()));
    std::filesystem::create_directories(folder_);
  }
  ~ImageFiles() override { std::filesystem::remove_all(folder_); }
  std::string Path(const std::string& name) const { return folder_ / name; }
  // Not flushed to the disk, so that thousands of damaged files cost little.
  void WriteRaw(const std::string& name, std::string_view bytes) const {
    std::ofstream file(Path(name), std::ios::binary);
    file.write(bytes.data(), static_cast<std::streamsize>(bytes.size()));
    ASSERT_TRUE(file.good());
  }
  std::filesystem::path folder_;
};

}  // namespace farpoint

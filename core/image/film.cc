#include "core/image/film.h"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <string>

#include "core/base/byte_io.h"
#include "core/base/check.h"
#include "core/image/storage.h"
#include "core/math/half.h"

namespace farpoint {

namespace {

constexpr uint32_t kFilmMagic = 0x4d4c4946;  // "FILM"
constexpr uint32_t kFilmVersion = 1;
constexpr int kMaxCoordinate = 65536;
constexpr int64_t kMaxPixels = int64_t{1} << 30;

// Blocks of the frame's grid clipped to `rect`, in raster order. The frame's right and lower
// border need not be known: the film lies inside it.
std::vector<PixelRect> ClippedBlocks(const PixelRect& rect) {
  const auto floor_to_grid = [](int v) {
    return (v >= 0 ? v / kBlockSize : -((-v + kBlockSize - 1) / kBlockSize)) * kBlockSize;
  };
  std::vector<PixelRect> blocks;
  for (int y = floor_to_grid(rect.y0); y < rect.y1; y += kBlockSize) {
    for (int x = floor_to_grid(rect.x0); x < rect.x1; x += kBlockSize) {
      blocks.push_back(PixelRect{x, y, x + kBlockSize, y + kBlockSize}.Intersect(rect));
    }
  }
  return blocks;
}

// Appends the stored bytes of one block of a layer: channels in order, rows top down.
void AppendBlock(const Film& film, const LayerInfo& info, const PixelRect& block,
                 std::vector<std::byte>& out) {
  const size_t value_size = info.half ? 2 : 4;
  const size_t at = out.size();
  out.resize(at + static_cast<size_t>(block.area()) * info.channels.size() * value_size);
  std::byte* to = out.data() + at;
  for (size_t c = 0; c < info.channels.size(); ++c) {
    const float* plane = film.Plane(info.layer, static_cast<int>(c)).data();
    for (int y = block.y0; y < block.y1; ++y) {
      const float* row = plane + static_cast<size_t>(y - film.rect().y0) * film.rect().width() +
                         (block.x0 - film.rect().x0);
      for (int x = 0; x < block.width(); ++x, to += value_size) {
        if (info.half) {
          const uint16_t h = StoredHalf(row[x]);
          std::memcpy(to, &h, sizeof(h));
        } else {
          const float f = StoredFloat(row[x]);
          std::memcpy(to, &f, sizeof(f));
        }
      }
    }
  }
}

void AddDigest(Sha256& hash, const Digest& digest) {
  hash.Update(std::as_bytes(std::span(digest.bytes)));
}

absl::Status BadValue(const LayerInfo& info, size_t channel, int x, int y, const char* what) {
  return absl::DataLossError("film record: channel " + std::string(info.channels[channel]) +
                             " holds " + what + " at pixel " + std::to_string(x) + "," +
                             std::to_string(y));
}

}  // namespace

Film::Film(const PixelRect& rect, std::vector<Layer> layers)
    : rect_(rect), layers_(std::move(layers)) {
  std::sort(layers_.begin(), layers_.end());
  layers_.erase(std::unique(layers_.begin(), layers_.end()), layers_.end());
  size_t size = 0;
  for (const Layer layer : layers_) {
    first_.push_back(size);
    size += InfoOf(layer).channels.size() * static_cast<size_t>(rect_.area());
  }
  values_.assign(size, 0.0f);
}

bool Film::Has(Layer layer) const {
  return std::binary_search(layers_.begin(), layers_.end(), layer);
}

std::span<const float> Film::Plane(Layer layer, int channel) const {
  const auto it = std::lower_bound(layers_.begin(), layers_.end(), layer);
  if (it == layers_.end() || *it != layer) return {};
  FP_CHECK(channel >= 0 && static_cast<size_t>(channel) < InfoOf(layer).channels.size());
  const size_t area = static_cast<size_t>(rect_.area());
  const size_t first = first_[static_cast<size_t>(it - layers_.begin())];
  return std::span(values_).subspan(first + static_cast<size_t>(channel) * area, area);
}

std::span<float> Film::Plane(Layer layer, int channel) {
  const std::span<const float> plane = std::as_const(*this).Plane(layer, channel);
  return {const_cast<float*>(plane.data()), plane.size()};
}

void Film::Set(Layer layer, int x, int y, std::span<const float> channels) {
  FP_DCHECK(rect_.Contains(x, y));
  FP_DCHECK(channels.size() == InfoOf(layer).channels.size());
  const size_t at = static_cast<size_t>(y - rect_.y0) * rect_.width() + (x - rect_.x0);
  for (size_t c = 0; c < channels.size(); ++c) {
    const std::span<float> plane = Plane(layer, static_cast<int>(c));
    FP_CHECK(at < plane.size());
    plane[at] = channels[c];
  }
}

float Film::Get(Layer layer, int channel, int x, int y) const {
  FP_CHECK(rect_.Contains(x, y));
  const std::span<const float> plane = Plane(layer, channel);
  FP_CHECK(!plane.empty());
  return plane[static_cast<size_t>(y - rect_.y0) * rect_.width() + (x - rect_.x0)];
}

void Film::Paste(const Film& other) {
  FP_CHECK(other.layers_ == layers_);
  const PixelRect common = rect_.Intersect(other.rect_);
  if (common.empty()) return;
  for (const Layer layer : layers_) {
    for (size_t c = 0; c < InfoOf(layer).channels.size(); ++c) {
      const std::span<const float> from = other.Plane(layer, static_cast<int>(c));
      const std::span<float> to = Plane(layer, static_cast<int>(c));
      for (int y = common.y0; y < common.y1; ++y) {
        const size_t from_at = static_cast<size_t>(y - other.rect_.y0) * other.rect_.width() +
                               (common.x0 - other.rect_.x0);
        const size_t to_at =
            static_cast<size_t>(y - rect_.y0) * rect_.width() + (common.x0 - rect_.x0);
        std::copy_n(from.data() + from_at, common.width(), to.data() + to_at);
      }
    }
  }
}

void Film::RoundToStorage() {
  for (const Layer layer : layers_) {
    const LayerInfo& info = InfoOf(layer);
    for (size_t c = 0; c < info.channels.size(); ++c) {
      for (float& v : Plane(layer, static_cast<int>(c))) {
        v = info.half ? HalfToFloat(StoredHalf(v)) : StoredFloat(v);
      }
    }
  }
}

std::vector<std::byte> EncodeFilm(const Film& film) {
  ByteWriter header;
  header.Put(kFilmMagic);
  header.Put(kFilmVersion);
  for (const int v : {film.rect().x0, film.rect().y0, film.rect().x1, film.rect().y1}) {
    header.Put<int32_t>(v);
  }
  header.Put<uint32_t>(static_cast<uint32_t>(film.layers().size()));
  size_t payload = 0;
  for (const Layer layer : film.layers()) {
    header.Put<uint32_t>(static_cast<uint32_t>(layer));
    const LayerInfo& info = InfoOf(layer);
    payload += info.channels.size() * (info.half ? 2 : 4) * static_cast<size_t>(film.rect().area());
  }
  std::vector<std::byte> bytes = header.Take();
  bytes.reserve(bytes.size() + payload);
  const std::vector<PixelRect> blocks = ClippedBlocks(film.rect());
  for (const Layer layer : film.layers()) {
    for (const PixelRect& block : blocks) AppendBlock(film, InfoOf(layer), block, bytes);
  }
  return bytes;
}

absl::StatusOr<Film> DecodeFilm(std::span<const std::byte> bytes) {
  ByteReader reader(bytes);
  uint32_t magic = 0, version = 0, layer_count = 0;
  FP_RETURN_IF_ERROR(Annotate(reader.Get(magic, "magic"), "film record"));
  if (magic != kFilmMagic) {
    return absl::DataLossError("film record: it does not start with the magic number 'FILM'");
  }
  FP_RETURN_IF_ERROR(Annotate(reader.Get(version, "version"), "film record"));
  if (version != kFilmVersion) {
    return absl::DataLossError("film record: version " + std::to_string(version) +
                               " is not known, this program reads version " +
                               std::to_string(kFilmVersion) + "; use one release everywhere");
  }
  int32_t v[4] = {};
  for (int i = 0; i < 4; ++i) {
    FP_RETURN_IF_ERROR(Annotate(reader.Get(v[i], "rect"), "film record"));
  }
  const PixelRect rect{v[0], v[1], v[2], v[3]};
  if (rect.x0 < 0 || rect.y0 < 0 || rect.x1 <= rect.x0 || rect.y1 <= rect.y0 ||
      rect.x1 > kMaxCoordinate || rect.y1 > kMaxCoordinate || rect.area() > kMaxPixels) {
    return absl::DataLossError("film record: the rectangle is empty or out of range");
  }
  FP_RETURN_IF_ERROR(Annotate(reader.Get(layer_count, "layer count"), "film record"));
  if (layer_count > static_cast<uint32_t>(kLayerCount)) {
    return absl::DataLossError("film record: " + std::to_string(layer_count) +
                               " layers, there are only " + std::to_string(kLayerCount));
  }
  std::vector<Layer> layers;
  uint64_t payload = 0;
  for (uint32_t i = 0; i < layer_count; ++i) {
    uint32_t id = 0;
    FP_RETURN_IF_ERROR(Annotate(reader.Get(id, "layer"), "film record"));
    if (id >= static_cast<uint32_t>(kLayerCount) ||
        (!layers.empty() && id <= static_cast<uint32_t>(layers.back()))) {
      return absl::DataLossError("film record: layer " + std::to_string(id) +
                                 " is unknown or out of order");
    }
    layers.push_back(static_cast<Layer>(id));
    const LayerInfo& info = InfoOf(layers.back());
    payload += info.channels.size() * (info.half ? 2 : 4) * static_cast<uint64_t>(rect.area());
  }
  if (payload != reader.remaining()) {
    return absl::DataLossError("film record: " + std::to_string(reader.remaining()) +
                               " bytes of pixels instead of " + std::to_string(payload));
  }

  Film film(rect, layers);
  const std::byte* from = bytes.data() + (bytes.size() - reader.remaining());
  const std::vector<PixelRect> blocks = ClippedBlocks(rect);
  for (const Layer layer : layers) {
    const LayerInfo& info = InfoOf(layer);
    for (const PixelRect& block : blocks) {
      for (size_t c = 0; c < info.channels.size(); ++c) {
        float* plane = film.Plane(layer, static_cast<int>(c)).data();
        for (int y = block.y0; y < block.y1; ++y) {
          float* row =
              plane + static_cast<size_t>(y - rect.y0) * rect.width() + (block.x0 - rect.x0);
          for (int x = 0; x < block.width(); ++x) {
            float f;
            if (info.half) {
              uint16_t h;
              std::memcpy(&h, from, sizeof(h));
              from += sizeof(h);
              f = HalfToFloat(h);
            } else {
              std::memcpy(&f, from, sizeof(f));
              from += sizeof(f);
            }
            const int px = block.x0 + x;
            if (std::isnan(f)) return BadValue(info, c, px, y, "a NaN");
            if (std::isinf(f) && !(f > 0 && layer == Layer::kDepth)) {
              return BadValue(info, c, px, y, "an infinity");
            }
            if (f == 0.0f && std::signbit(f)) return BadValue(info, c, px, y, "a negative zero");
            row[x] = f;
          }
        }
      }
    }
  }
  return film;
}

Digest LayerHash(const Film& film, Layer layer) {
  FP_CHECK(film.Has(layer));
  const LayerInfo& info = InfoOf(layer);
  Sha256 hash;
  hash.Update("farpoint layer 1").UpdateU32(static_cast<uint32_t>(info.name.size()));
  hash.Update(info.name);
  for (const int v : {film.rect().x0, film.rect().y0, film.rect().x1, film.rect().y1}) {
    hash.UpdateU32(static_cast<uint32_t>(v));
  }
  std::vector<std::byte> bytes;
  for (const PixelRect& block : ClippedBlocks(film.rect())) {
    bytes.clear();
    AppendBlock(film, info, block, bytes);
    AddDigest(hash, HashBytes(bytes));
  }
  return hash.Finish();
}

Digest ImageHash(const Film& film) {
  Sha256 hash;
  hash.Update("farpoint image 1").UpdateU32(static_cast<uint32_t>(film.layers().size()));
  for (const Layer layer : film.layers()) {
    AddDigest(hash, LayerHash(film, layer));
  }
  return hash.Finish();
}

}  // namespace farpoint

#include "core/image/exr_io.h"

#include <ImathBox.h>
#include <ImathMatrix.h>
#include <ImfChannelList.h>
#include <ImfChromaticities.h>
#include <ImfEnvmap.h>
#include <ImfFrameBuffer.h>
#include <ImfFramesPerSecond.h>
#include <ImfHeader.h>
#include <ImfIO.h>
#include <ImfInputFile.h>
#include <ImfIntAttribute.h>
#include <ImfMatrixAttribute.h>
#include <ImfOutputFile.h>
#include <ImfStandardAttributes.h>
#include <ImfStringAttribute.h>

#include <algorithm>
#include <cmath>
#include <cstring>
#include <exception>
#include <new>
#include <stdexcept>

#include "core/base/blob.h"
#include "core/image/storage.h"

namespace farpoint {

namespace {

constexpr int kMaxSide = 65536;
constexpr int64_t kMaxPixels = int64_t{1} << 30;
constexpr int64_t kMaxValues = int64_t{1} << 33;
constexpr int kMaxChannels = 1024;
constexpr int kRowsPerWrite = 32;  // a multiple of every compressor's scanlines per chunk

struct CompressionInfo {
  ExrCompression compression;
  std::string_view name;
  Imf::Compression library_value;
  bool lossless;
};
constexpr CompressionInfo kCompressions[] = {
    {ExrCompression::kNone, "none", Imf::NO_COMPRESSION, true},
    {ExrCompression::kRle, "rle", Imf::RLE_COMPRESSION, true},
    {ExrCompression::kZips, "zips", Imf::ZIPS_COMPRESSION, true},
    {ExrCompression::kZip, "zip", Imf::ZIP_COMPRESSION, true},
    {ExrCompression::kPiz, "piz", Imf::PIZ_COMPRESSION, true},
    {ExrCompression::kDwaa, "dwaa", Imf::DWAA_COMPRESSION, false},
};

const CompressionInfo& InfoOf(ExrCompression compression) {
  return kCompressions[static_cast<size_t>(compression)];
}

class MemoryOutput final : public Imf::OStream {
 public:
  MemoryOutput() : Imf::OStream("memory") {}
  void write(const char c[], int n) override {
    if (at_ + static_cast<size_t>(n) > bytes_.size()) bytes_.resize(at_ + static_cast<size_t>(n));
    std::memcpy(bytes_.data() + at_, c, static_cast<size_t>(n));
    at_ += static_cast<size_t>(n);
  }
  uint64_t tellp() override { return at_; }
  void seekp(uint64_t pos) override { at_ = pos; }
  std::span<const std::byte> bytes() const { return bytes_; }

 private:
  std::vector<std::byte> bytes_;
  size_t at_ = 0;
};

class MemoryInput final : public Imf::IStream {
 public:
  explicit MemoryInput(std::span<const std::byte> bytes) : Imf::IStream("memory"), bytes_(bytes) {}
  bool isMemoryMapped() const override { return true; }
  char* readMemoryMapped(int n) override {
    const char* at = Take(n);
    return const_cast<char*>(at);  // the library's interface; it only reads
  }
  bool read(char c[], int n) override {
    const char* at = Take(n);
    std::memcpy(c, at, static_cast<size_t>(n));
    return at_ < bytes_.size();
  }
  uint64_t tellg() override { return at_; }
  void seekg(uint64_t pos) override { at_ = pos; }

 private:
  const char* Take(int n) {
    if (n < 0 || at_ > bytes_.size() || static_cast<size_t>(n) > bytes_.size() - at_) {
      throw std::runtime_error("the file ends too early, at byte " + std::to_string(bytes_.size()));
    }
    const char* p = reinterpret_cast<const char*>(bytes_.data()) + at_;
    at_ += static_cast<size_t>(n);
    return p;
  }
  std::span<const std::byte> bytes_;
  uint64_t at_ = 0;
};

absl::Status Damaged(const std::string& path, const std::string& cause) {
  return absl::DataLossError("'" + path + "': " + cause +
                             "; the file is damaged or was not written completely");
}

// Walks the header's attributes before the library does, because it allocates what they announce.
absl::Status CheckHeaderSizes(const std::string& path, std::span<const std::byte> bytes) {
  size_t at = 0;
  const auto u32 = [&](uint32_t& value) {
    if (bytes.size() - at < sizeof(value)) return false;
    std::memcpy(&value, bytes.data() + at, sizeof(value));
    at += sizeof(value);
    return true;
  };
  // Null-terminated, at most 255 characters.
  const auto name = [&](size_t& length) {
    const size_t limit = std::min(bytes.size(), at + 256);
    for (size_t i = at; i < limit; ++i) {
      if (bytes[i] == std::byte{0}) {
        length = i - at;
        at = i + 1;
        return true;
      }
    }
    return false;
  };
  uint32_t magic = 0, version = 0;
  if (!u32(magic) || magic != 20000630u) {
    return absl::InvalidArgumentError("'" + path + "' is not an OpenEXR file");
  }
  if (!u32(version)) return Damaged(path, "the header is cut off");
  if ((version & 0xffu) != 2u) {
    return absl::InvalidArgumentError("'" + path + "': OpenEXR format version " +
                                      std::to_string(version & 0xffu) +
                                      " is not supported, only 2");
  }
  if ((version & 0x1800u) != 0) {
    return absl::InvalidArgumentError(
        "'" + path + "' has several parts or deep pixels; write it as one flat part");
  }
  for (;;) {
    const size_t attribute_at = at;
    size_t length = 0;
    if (!name(length)) return Damaged(path, "the header is cut off");
    if (length == 0) return absl::OkStatus();
    uint32_t size = 0;
    if (!name(length) || !u32(size) || size > bytes.size() - at) {
      return Damaged(path, "the attribute at byte " + std::to_string(attribute_at) +
                               " does not fit into the file");
    }
    at += size;
  }
}

// Settings of the library, which is used in this file only.
void LimitLibrary() {
  static const bool limited = [] {
    Imf::Header::setMaxImageSize(kMaxSide, kMaxSide);
    Imf::Header::setMaxTileSize(4096, 4096);
    return true;
  }();
  static_cast<void>(limited);
}

// A bound on how much a chunk can grow when it is decompressed; 0: none is known.
int64_t MaxExpansion(Imf::Compression compression) {
  switch (compression) {
    case Imf::NO_COMPRESSION:
      return 1;
    case Imf::RLE_COMPRESSION:
      return 64;
    case Imf::ZIPS_COMPRESSION:
    case Imf::ZIP_COMPRESSION:
    case Imf::PXR24_COMPRESSION:
      return 1032 * 2;  // deflate's limit; PXR24 drops a quarter of a float before it
    default:
      return 0;
  }
}

absl::StatusOr<ExrImage> Read(const std::string& path, std::span<const std::byte> bytes) {
  MemoryInput stream(bytes);
  Imf::InputFile file(stream, 0);
  const Imf::Header& header = file.header();
  const Imath::Box2i data = header.dataWindow();
  const Imath::Box2i display = header.displayWindow();

  const int64_t width = int64_t{data.max.x} - data.min.x + 1;
  const int64_t height = int64_t{data.max.y} - data.min.y + 1;
  const int64_t frame_width = int64_t{display.max.x} - display.min.x + 1;
  const int64_t frame_height = int64_t{display.max.y} - display.min.y + 1;
  int64_t channel_count = 0, stored_bytes_per_pixel = 0;
  for (auto it = header.channels().begin(); it != header.channels().end(); ++it) {
    ++channel_count;
    stored_bytes_per_pixel += it.channel().type == Imf::HALF ? 2 : 4;
    if (it.channel().xSampling != 1 || it.channel().ySampling != 1) {
      return absl::InvalidArgumentError("'" + path + "': channel " + it.name() +
                                        " is subsampled; write it at full resolution");
    }
  }
  if (width < 1 || height < 1 || width > kMaxSide || height > kMaxSide ||
      width * height > kMaxPixels || frame_width < 1 || frame_height < 1 ||
      frame_width > kMaxSide || frame_height > kMaxSide || channel_count > kMaxChannels ||
      width * height * channel_count > kMaxValues ||
      std::abs(int64_t{data.min.x} - display.min.x) > (1 << 30) ||
      std::abs(int64_t{data.min.y} - display.min.y) > (1 << 30)) {
    return absl::InvalidArgumentError(
        "'" + path + "': " + std::to_string(width) + "x" + std::to_string(height) + " pixels of " +
        std::to_string(channel_count) + " channels are more than this program accepts");
  }
  const int64_t expansion = MaxExpansion(header.compression());
  const int64_t pixel_bytes = width * height * stored_bytes_per_pixel;
  if (expansion > 0 && pixel_bytes / expansion > static_cast<int64_t>(bytes.size())) {
    return Damaged(path, std::to_string(bytes.size()) + " bytes cannot hold " +
                             std::to_string(pixel_bytes) + " bytes of pixels");
  }
  if (!file.isComplete()) return Damaged(path, "pixels are missing");

  ExrImage image;
  const int x0 = data.min.x - display.min.x, y0 = data.min.y - display.min.y;
  image.data_window = {x0, y0, x0 + static_cast<int>(width), y0 + static_cast<int>(height)};
  image.frame_width = static_cast<int>(frame_width);
  image.frame_height = static_cast<int>(frame_height);
  image.channels.reserve(static_cast<size_t>(channel_count));
  Imf::FrameBuffer target;
  for (auto it = header.channels().begin(); it != header.channels().end(); ++it) {
    ExrChannel& channel = image.channels.emplace_back();
    channel.name = it.name();
    channel.half = it.channel().type == Imf::HALF;
    channel.values.resize(static_cast<size_t>(width * height));
    target.insert(it.name(), Imf::Slice::Make(Imf::FLOAT, channel.values.data(), data));
  }
  file.setFrameBuffer(target);
  file.readPixels(data.min.y, data.max.y);

  for (auto it = header.begin(); it != header.end(); ++it) {
    if (const auto* text = dynamic_cast<const Imf::StringAttribute*>(&it.attribute())) {
      image.metadata.strings[it.name()] = text->value();
    } else if (const auto* m = dynamic_cast<const Imf::M44fAttribute*>(&it.attribute())) {
      std::array<float, 16>& values = image.metadata.matrices[it.name()];
      for (int i = 0; i < 16; ++i) values[static_cast<size_t>(i)] = m->value()[i / 4][i % 4];
    } else if (const auto* number = dynamic_cast<const Imf::IntAttribute*>(&it.attribute())) {
      image.metadata.ints[it.name()] = number->value();
    }
  }
  if (Imf::hasFramesPerSecond(header)) {
    const Imf::Rational& rate = Imf::framesPerSecond(header);
    if (rate.d != 0) image.metadata.frames_per_second = static_cast<double>(rate);
  }
  return image;
}

// Columns of the matrix from the file's RGB to Rec. 709, white to white; the identity if the file
// does not say what its primaries are. Nothing if they span no colours.
std::optional<std::array<Vec3f, 3>> Rec709FromFile(const Imf::Header& header) {
  std::array<Vec3f, 3> columns{Vec3f(1, 0, 0), Vec3f(0, 1, 0), Vec3f(0, 0, 1)};
  if (!Imf::hasChromaticities(header)) return columns;
  const Imf::Chromaticities& file = Imf::chromaticities(header);
  const Imf::Chromaticities rec709;
  if (file == rec709) return columns;
  // Row vectors are multiplied from the left.
  const Imath::M44f m = Imf::RGBtoXYZ(file, 1.0f) * Imf::XYZtoRGB(rec709, 1.0f);
  const Imath::V3f white = Imath::V3f(1.0f, 1.0f, 1.0f) * m;
  for (int from = 0; from < 3; ++from) {
    for (int to = 0; to < 3; ++to) {
      if (!(std::fabs(white[to]) > 0.0f)) return std::nullopt;
      columns[static_cast<size_t>(from)][to] = m[from][to] / white[to];
    }
    if (!IsFinite(columns[static_cast<size_t>(from)])) return std::nullopt;
  }
  return columns;
}

absl::StatusOr<ExrRgbImage> ReadRgb(std::span<const std::byte> bytes, const std::string& name,
                                    int64_t max_pixels) {
  MemoryInput stream(bytes);
  Imf::InputFile file(stream, 0);
  const Imf::Header& header = file.header();
  const Imath::Box2i data = header.dataWindow();
  const int64_t width = int64_t{data.max.x} - data.min.x + 1;
  const int64_t height = int64_t{data.max.y} - data.min.y + 1;
  if (width < 1 || height < 1 || width > kMaxSide || height > kMaxSide ||
      width * height > max_pixels) {
    return absl::InvalidArgumentError("'" + name + "': " + std::to_string(width) + "x" +
                                      std::to_string(height) +
                                      " pixels; from 1x1 up to 65536 on a side and " +
                                      std::to_string(max_pixels) + " in all can be read");
  }
  const bool grey = header.channels().findChannel("Y") != nullptr &&
                    header.channels().findChannel("R") == nullptr;
  int64_t stored_bytes_per_pixel = 0;
  for (auto it = header.channels().begin(); it != header.channels().end(); ++it) {
    stored_bytes_per_pixel += it.channel().type == Imf::HALF ? 2 : 4;
  }
  for (const char* channel : {"R", "G", "B"}) {
    const Imf::Channel* found = header.channels().findChannel(grey ? "Y" : channel);
    if (found == nullptr) {
      return absl::InvalidArgumentError("'" + name + "' has no channel " + channel +
                                        " and no Y; write R, G and B, or Y alone");
    }
    if (found->xSampling != 1 || found->ySampling != 1 || found->type == Imf::UINT) {
      return absl::InvalidArgumentError("'" + name + "': channel " + (grey ? "Y" : channel) +
                                        " is subsampled or holds integers; write it as half or "
                                        "float at full resolution");
    }
  }
  if (grey && (header.channels().findChannel("RY") != nullptr ||
               header.channels().findChannel("BY") != nullptr)) {
    return absl::InvalidArgumentError("'" + name +
                                      "' stores luminance and chroma; write R, G and B");
  }
  const int64_t expansion = MaxExpansion(header.compression());
  const int64_t pixel_bytes = width * height * stored_bytes_per_pixel;
  if (expansion > 0 && pixel_bytes / expansion > static_cast<int64_t>(bytes.size())) {
    return Damaged(name, std::to_string(bytes.size()) + " bytes cannot hold " +
                             std::to_string(pixel_bytes) + " bytes of pixels");
  }
  if (!file.isComplete()) return Damaged(name, "pixels are missing");

  ExrRgbImage image;
  image.width = static_cast<uint32_t>(width);
  image.height = static_cast<uint32_t>(height);
  image.cube_map = Imf::hasEnvmap(header) && Imf::envmap(header) == Imf::ENVMAP_CUBE;
  image.pixels.resize(static_cast<size_t>(width * height));
  const auto slice = [&](float& first) {
    return Imf::Slice::Make(Imf::FLOAT, &first, data, sizeof(Rgb),
                            sizeof(Rgb) * static_cast<size_t>(width));
  };
  Imf::FrameBuffer target;
  target.insert(grey ? "Y" : "R", slice(image.pixels[0].x));
  if (!grey) {
    target.insert("G", slice(image.pixels[0].y));
    target.insert("B", slice(image.pixels[0].z));
  }
  file.setFrameBuffer(target);
  file.readPixels(data.min.y, data.max.y);
  if (grey) {
    for (Rgb& pixel : image.pixels) pixel = Rgb(pixel.x);
    return image;
  }
  const std::optional<std::array<Vec3f, 3>> columns = Rec709FromFile(header);
  if (!columns) {
    return absl::InvalidArgumentError("'" + name +
                                      "': its chromaticities span no colours; correct or remove "
                                      "that attribute");
  }
  const std::array<Vec3f, 3>& m = *columns;
  if (m[0] != Vec3f(1, 0, 0) || m[1] != Vec3f(0, 1, 0) || m[2] != Vec3f(0, 0, 1)) {
    for (Rgb& p : image.pixels) p = m[0] * p.x + m[1] * p.y + m[2] * p.z;
  }
  return image;
}

void Write(MemoryOutput& stream, const Film& film, int frame_width, int frame_height,
           const ExrMetadata& metadata, ExrCompression compression) {
  const PixelRect& rect = film.rect();
  const Imath::Box2i display({0, 0}, {frame_width - 1, frame_height - 1});
  const Imath::Box2i data({rect.x0, rect.y0}, {rect.x1 - 1, rect.y1 - 1});
  Imf::Header header(display, data, 1.0f, Imath::V2f(0, 0), 1.0f, Imf::INCREASING_Y,
                     InfoOf(compression).library_value);
  Imf::addChromaticities(header, Imf::Chromaticities());  // the default is Rec. 709, D65
  for (const auto& [name, text] : metadata.strings) {
    header.insert(name, Imf::StringAttribute(text));
  }
  for (const auto& [name, values] : metadata.matrices) {
    Imath::M44f m;
    for (int i = 0; i < 16; ++i) m[i / 4][i % 4] = values[static_cast<size_t>(i)];
    header.insert(name, Imf::M44fAttribute(m));
  }
  for (const auto& [name, value] : metadata.ints) header.insert(name, Imf::IntAttribute(value));
  if (metadata.frames_per_second) {
    Imf::addFramesPerSecond(header, Imf::guessExactFps(*metadata.frames_per_second));
  }

  const size_t width = static_cast<size_t>(rect.width());
  std::vector<std::vector<uint16_t>> halves;  // one band of each half channel
  for (const Layer layer : film.layers()) {
    const LayerInfo& info = InfoOf(layer);
    for (const std::string_view name : info.channels) {
      header.channels().insert(std::string(name), Imf::Channel(info.half ? Imf::HALF : Imf::FLOAT));
      if (info.half) halves.emplace_back(width * kRowsPerWrite);
    }
  }

  Imf::OutputFile file(stream, header, 0);
  for (int y = rect.y0; y < rect.y1; y += kRowsPerWrite) {
    const int rows = std::min(kRowsPerWrite, rect.y1 - y);
    const Imath::Box2i band({rect.x0, y}, {rect.x1 - 1, y + rows - 1});
    Imf::FrameBuffer source;
    size_t next_half = 0;
    for (const Layer layer : film.layers()) {
      const LayerInfo& info = InfoOf(layer);
      for (size_t c = 0; c < info.channels.size(); ++c) {
        const float* from = film.Plane(layer, static_cast<int>(c)).data() +
                            static_cast<size_t>(y - rect.y0) * width;
        const std::string name(info.channels[c]);
        if (info.half) {
          std::vector<uint16_t>& to = halves[next_half++];
          for (size_t i = 0; i < width * static_cast<size_t>(rows); ++i) {
            to[i] = StoredHalf(from[i]);
          }
          source.insert(name, Imf::Slice::Make(Imf::HALF, to.data(), band));
        } else {
          source.insert(name, Imf::Slice::Make(Imf::FLOAT, from, band));
        }
      }
    }
    file.setFrameBuffer(source);
    file.writePixels(rows);
  }
}

}  // namespace

bool IsLossless(ExrCompression compression) { return InfoOf(compression).lossless; }

std::string_view NameOf(ExrCompression compression) { return InfoOf(compression).name; }

absl::StatusOr<ExrCompression> ExrCompressionFromName(std::string_view name) {
  std::string known;
  for (const CompressionInfo& info : kCompressions) {
    if (name == info.name) return info.compression;
    known.append(known.empty() ? "" : ", ").append(info.name);
  }
  return absl::InvalidArgumentError("expected one of " + known);
}

const ExrChannel* ExrImage::Find(const std::string& name) const {
  for (const ExrChannel& channel : channels) {
    if (channel.name == name) return &channel;
  }
  return nullptr;
}

absl::Status WriteExr(const std::string& path, const Film& film, int frame_width, int frame_height,
                      const ExrMetadata& metadata, ExrCompression compression) {
  const FilmSpec spec{frame_width, frame_height, film.rect()};
  FP_RETURN_IF_ERROR(Annotate(ValidateFilm(spec), "'" + path + "'"));
  if (film.layers().empty()) {
    return absl::InvalidArgumentError("'" + path + "': an image without layers cannot be written");
  }
  MemoryOutput stream;
  try {
    Write(stream, film, frame_width, frame_height, metadata, compression);
  } catch (const std::bad_alloc&) {
    return absl::ResourceExhaustedError("'" + path + "': not enough memory to encode the image");
  } catch (const std::exception& e) {
    return absl::InvalidArgumentError("cannot encode '" + path + "': " + e.what());
  }
  return WriteFileAtomically(path, stream.bytes());
}

absl::StatusOr<ExrImage> ReadExr(const std::string& path) {
  FP_ASSIGN_OR_RETURN(const Blob blob, Blob::MapFile(path));
  return ReadExr(blob.bytes(), path);
}

absl::StatusOr<ExrImage> ReadExr(std::span<const std::byte> bytes, const std::string& name) {
  LimitLibrary();
  FP_RETURN_IF_ERROR(CheckHeaderSizes(name, bytes));
  try {
    return Read(name, bytes);
  } catch (const std::bad_alloc&) {
    return absl::ResourceExhaustedError("'" + name + "': not enough memory to decode the image");
  } catch (const std::exception& e) {
    return Damaged(name, e.what());
  }
}

absl::StatusOr<ExrRgbImage> ReadExrRgb(std::span<const std::byte> bytes, const std::string& name,
                                       int64_t max_pixels) {
  LimitLibrary();
  FP_RETURN_IF_ERROR(CheckHeaderSizes(name, bytes));
  try {
    return ReadRgb(bytes, name, max_pixels);
  } catch (const std::bad_alloc&) {
    return absl::ResourceExhaustedError("'" + name + "': not enough memory to decode the image");
  } catch (const std::exception& e) {
    return Damaged(name, e.what());
  }
}

absl::StatusOr<Film> FilmFromExr(const ExrImage& image) {
  std::vector<Layer> layers;
  for (const LayerInfo& info : AllLayers()) {
    const bool complete =
        std::all_of(info.channels.begin(), info.channels.end(),
                    [&](std::string_view name) { return image.Find(std::string(name)); });
    if (complete) layers.push_back(info.layer);
  }
  if (layers.empty()) {
    return absl::InvalidArgumentError("the image has none of the layers that farpoint writes");
  }
  Film film(image.data_window, layers);
  for (const Layer layer : layers) {
    const LayerInfo& info = InfoOf(layer);
    for (size_t c = 0; c < info.channels.size(); ++c) {
      const ExrChannel& channel = *image.Find(std::string(info.channels[c]));
      if (channel.half != info.half) {
        return absl::InvalidArgumentError("channel " + channel.name + " is stored in " +
                                          (channel.half ? "16" : "32") + " bits, farpoint stores " +
                                          (info.half ? "16" : "32"));
      }
      const std::span<float> plane = film.Plane(layer, static_cast<int>(c));
      if (channel.values.size() != plane.size()) {
        return absl::InvalidArgumentError("channel " + channel.name + " has " +
                                          std::to_string(channel.values.size()) + " values for " +
                                          std::to_string(plane.size()) + " pixels");
      }
      std::copy(channel.values.begin(), channel.values.end(), plane.begin());
    }
  }
  return film;
}

}  // namespace farpoint

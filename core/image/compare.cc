#include "core/image/compare.h"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <limits>
#include <set>

#include "core/base/blob.h"
#include "core/image/flip_metric.h"
#include "core/image/npy_io.h"
#include "core/image/png_io.h"
#include "core/image/rgb_image.h"
#include "core/image/yee_metric.h"

namespace farpoint {

namespace {

using Channels = std::vector<const ExrChannel*>;

std::string RectText(const PixelRect& r) {
  return std::to_string(r.x0) + "," + std::to_string(r.y0) + "," + std::to_string(r.x1) + "," +
         std::to_string(r.y1);
}

// Empty unless all are there.
Channels FindAll(const ExrImage& image, std::span<const std::string_view> names) {
  Channels found;
  for (const std::string_view name : names) {
    const ExrChannel* channel = image.Find(std::string(name));
    if (channel == nullptr) return {};
    found.push_back(channel);
  }
  return found;
}

constexpr std::string_view kRgb[3] = {"R", "G", "B"};

bool IsBeauty(const std::string& layer) { return layer.empty() || layer == "beauty"; }

// Empty if the image has no such layer.
Channels FindLayer(const ExrImage& image, const std::string& layer) {
  if (IsBeauty(layer)) return FindAll(image, kRgb);
  if (const absl::StatusOr<Layer> known = LayerFromName(layer); known.ok()) {
    if (Channels found = FindAll(image, InfoOf(*known).channels); !found.empty()) return found;
  }
  for (const char* last : {"RGB", "XYZ"}) {
    Channels found;
    for (int c = 0; c < 3; ++c) {
      const ExrChannel* channel = image.Find(layer + "." + last[c]);
      if (channel != nullptr) found.push_back(channel);
    }
    if (found.size() == 3) return found;
  }
  Channels found;
  for (const ExrChannel& channel : image.channels) {
    if (channel.name == layer) return {&channel};
    if (channel.name.starts_with(layer + ".")) found.push_back(&channel);
  }
  return found;
}

// What --layer takes of an image: the layers of layers.h that it has, then prefixes of its other
// channels, then channels without one.
std::vector<std::string> LayersOf(const ExrImage& image) {
  std::vector<std::string> names;
  std::set<std::string_view> taken;
  for (const LayerInfo& info : AllLayers()) {
    // The beauty's fourth channel may be missing.
    const Channels found =
        FindAll(image, info.layer == Layer::kBeauty ? std::span(kRgb) : info.channels);
    if (found.empty()) continue;
    names.emplace_back(info.name);
    taken.insert(info.channels.begin(), info.channels.end());
  }
  for (const ExrChannel& channel : image.channels) {
    if (taken.contains(channel.name)) continue;
    const std::string name = channel.name.substr(0, channel.name.rfind('.'));
    if (std::find(names.begin(), names.end(), name) == names.end()) names.push_back(name);
  }
  return names;
}

absl::Status NoSuchLayer(const ExrImage& image, const std::string& layer,
                         const std::string& which) {
  std::string names;
  for (const std::string& name : LayersOf(image)) {
    if (names.size() > 400) {
      names += ", …";
      break;
    }
    names += (names.empty() ? "" : ", ") + name;
  }
  return absl::InvalidArgumentError(which + " has no layer '" +
                                    (IsBeauty(layer) ? "beauty' (R, G, B)" : layer + "'") +
                                    (names.empty() ? "; it has none" : "; it has " + names));
}

// What CompareImages and WriteDiffPng work on.
struct Pair {
  PixelRect rect;
  Channels a, b;
  std::vector<uint8_t> counted;  // per pixel of rect, 0 or 1
  int64_t pixels = 0;
};

absl::Status CheckChannelSizes(const ExrImage& image, const Channels& channels) {
  for (const ExrChannel* channel : channels) {
    if (channel->values.size() != static_cast<size_t>(image.data_window.area())) {
      return absl::InvalidArgumentError("channel " + channel->name +
                                        " does not have one value for each pixel");
    }
  }
  return absl::OkStatus();
}

absl::StatusOr<Pair> MakePair(const ExrImage& a, const ExrImage& b, const CompareOptions& options) {
  if (a.frame_width != b.frame_width || a.frame_height != b.frame_height) {
    return absl::InvalidArgumentError(
        "the images have different sizes: " + std::to_string(a.frame_width) + "x" +
        std::to_string(a.frame_height) + " and, the reference, " + std::to_string(b.frame_width) +
        "x" + std::to_string(b.frame_height) + "; render one at the other's resolution");
  }
  Pair pair;
  pair.rect = a.data_window.Intersect(b.data_window);
  if (pair.rect.empty()) {
    return absl::InvalidArgumentError("the images have no pixels in common: one holds " +
                                      RectText(a.data_window) + ", the reference " +
                                      RectText(b.data_window));
  }
  pair.a = FindLayer(a, options.layer);
  if (pair.a.empty()) return NoSuchLayer(a, options.layer, options.image_name);
  if (!options.ref_layer.empty()) {
    pair.b = FindLayer(b, options.ref_layer);
    if (pair.b.empty()) return NoSuchLayer(b, options.ref_layer, options.ref_name);
  } else {
    pair.b = FindLayer(b, options.layer);
    if (pair.b.empty()) pair.b = FindAll(b, kRgb);
    if (pair.b.empty()) return NoSuchLayer(b, options.layer, options.ref_name);
  }
  if (pair.a.size() != pair.b.size()) {
    return absl::InvalidArgumentError(
        "the layers have " + std::to_string(pair.a.size()) + " channels and, in the reference, " +
        std::to_string(pair.b.size()) + "; name a layer of the same kind with --ref-layer");
  }
  FP_RETURN_IF_ERROR(CheckChannelSizes(a, pair.a));
  FP_RETURN_IF_ERROR(CheckChannelSizes(b, pair.b));

  pair.counted.assign(static_cast<size_t>(pair.rect.area()), 1);
  if (options.mask) {
    const PixelMask& mask = *options.mask;
    const auto same_size = [&](const PixelRect& r) {
      return mask.rect.width() == r.width() && mask.rect.height() == r.height();
    };
    PixelRect at = mask.rect;
    const bool of_frame = mask.frame_width == 0 || (mask.frame_width == b.frame_width &&
                                                    mask.frame_height == b.frame_height);
    if (!of_frame || !at.Contains(pair.rect)) {
      if (same_size(b.data_window)) {
        at = b.data_window;
      } else if (same_size(pair.rect)) {
        at = pair.rect;
      } else {
        std::string what = "the mask of " + std::to_string(at.width()) + "x" +
                           std::to_string(at.height()) + " pixels";
        if (!of_frame && (mask.frame_width != at.width() || mask.frame_height != at.height())) {
          what += " of a frame of " + std::to_string(mask.frame_width) + "x" +
                  std::to_string(mask.frame_height);
        }
        return absl::InvalidArgumentError(
            what +
            (of_frame ? " does not cover the compared pixels " + RectText(pair.rect)
                      : " is not of the images' frame") +
            "; give one of the frame's size, " + std::to_string(b.frame_width) + "x" +
            std::to_string(b.frame_height));
      }
    }
    if (mask.on.size() != static_cast<size_t>(mask.rect.area())) {
      return absl::InvalidArgumentError("the mask does not have one value for each pixel");
    }
    size_t i = 0;
    for (int y = pair.rect.y0; y < pair.rect.y1; ++y) {
      for (int x = pair.rect.x0; x < pair.rect.x1; ++x, ++i) {
        pair.counted[i] = mask.on[static_cast<size_t>(y - at.y0) * static_cast<size_t>(at.width()) +
                                  static_cast<size_t>(x - at.x0)];
      }
    }
  }
  for (const uint8_t on : pair.counted) pair.pixels += on;
  if (pair.pixels == 0) {
    return absl::InvalidArgumentError("the mask is off at every compared pixel");
  }
  return pair;
}

// The part of a channel inside `rect`, rows top down.
std::vector<float> Cut(const ExrImage& image, const ExrChannel& channel, const PixelRect& rect) {
  std::vector<float> values;
  values.reserve(static_cast<size_t>(rect.area()));
  for (int y = rect.y0; y < rect.y1; ++y) {
    const auto row =
        channel.values.begin() +
        static_cast<std::ptrdiff_t>(y - image.data_window.y0) * image.data_window.width() +
        (rect.x0 - image.data_window.x0);
    values.insert(values.end(), row, row + rect.width());
  }
  return values;
}

// Three planes; one or two channels are shown as grey by the first. What is not finite is 0.
RgbImage ToRgb(const std::vector<std::vector<float>>& planes, const PixelRect& rect) {
  RgbImage image;
  for (size_t c = 0; c < 3; ++c) {
    image[c].width = rect.width();
    image[c].height = rect.height();
    image[c].values = planes[planes.size() >= 3 ? c : 0];
    for (float& v : image[c].values) {
      if (!std::isfinite(v)) v = 0.0f;
    }
  }
  return image;
}

// The q-quantile of `values`, the nearest rank. Not empty.
double Quantile(std::vector<double> values, double q) {
  const size_t rank =
      static_cast<size_t>(std::max(0.0, std::ceil(q * static_cast<double>(values.size())) - 1.0));
  const auto at = values.begin() + static_cast<std::ptrdiff_t>(std::min(rank, values.size() - 1));
  std::nth_element(values.begin(), at, values.end());
  return *at;
}

// Divided by `white` and clamped to [0, 1].
RgbImage DisplayReferred(const RgbImage& image, double white) {
  RgbImage r = image;
  for (ImagePlane& plane : r) {
    for (float& v : plane.values) v = static_cast<float>(std::clamp(v / white, 0.0, 1.0));
  }
  return r;
}

double DisplayWhite(const RgbImage& reference, const std::vector<uint8_t>& counted) {
  std::vector<double> luminance;
  for (size_t p = 0; p < counted.size(); ++p) {
    if (counted[p] == 0) continue;
    luminance.push_back(0.2126 * reference[0].values[p] + 0.7152 * reference[1].values[p] +
                        0.0722 * reference[2].values[p]);
  }
  double white = Quantile(luminance, 0.99);
  if (!(white > 0.0)) white = *std::max_element(luminance.begin(), luminance.end());
  return white > 0.0 ? white : 1.0;
}

Film CutFilm(const Film& film, const PixelRect& rect) {
  Film part(rect, {film.layers().begin(), film.layers().end()});
  part.Paste(film);
  return part;
}

bool SameBits(const std::vector<float>& a, const std::vector<float>& b) {
  return a.size() == b.size() && std::memcmp(a.data(), b.data(), a.size() * sizeof(float)) == 0;
}

void CompareHashes(const ExrImage& a, const ExrImage& b, const CompareOptions& options,
                   const Pair& pair, bool same_values, CompareResult& result) {
  result.hash_equal = same_values;
  const absl::StatusOr<Film> film_a = FilmFromExr(a), film_b = FilmFromExr(b);
  if (!film_a.ok() || !film_b.ok()) return;
  const Film part_a = CutFilm(*film_a, pair.rect), part_b = CutFilm(*film_b, pair.rect);
  if (options.layer.empty() && options.ref_layer.empty()) {
    result.hash_a = ImageHash(part_a).Hex();
    result.hash_b = ImageHash(part_b).Hex();
    result.hash_equal = result.hash_a == result.hash_b;
    return;
  }
  const absl::StatusOr<Layer> layer =
      LayerFromName(IsBeauty(options.layer) ? "beauty" : options.layer);
  const bool one_layer = options.ref_layer.empty() || options.ref_layer == options.layer;
  if (!layer.ok() || !one_layer || !part_a.Has(*layer) || !part_b.Has(*layer)) return;
  result.hash_a = LayerHash(part_a, *layer).Hex();
  result.hash_b = LayerHash(part_b, *layer).Hex();
  result.hash_equal = result.hash_a == result.hash_b;
}

// Black, purple, red, yellow, white; monotone in luminance.
void FalseColor(double t, uint8_t* rgb) {
  constexpr double kAnchors[5][3] = {
      {0, 0, 0}, {88, 18, 110}, {200, 45, 60}, {250, 185, 40}, {255, 255, 255}};
  t = 4.0 * std::clamp(t, 0.0, 1.0);
  const int i = std::min(3, static_cast<int>(t));
  for (int c = 0; c < 3; ++c) {
    rgb[c] = static_cast<uint8_t>(kAnchors[i][c] + (t - i) * (kAnchors[i + 1][c] - kAnchors[i][c]) +
                                  0.5);
  }
}

}  // namespace

absl::StatusOr<PixelMask> ReadMask(const std::string& path) {
  FP_ASSIGN_OR_RETURN(const Blob blob, Blob::MapFile(path));
  constexpr unsigned char kExrMagic[4] = {0x76, 0x2f, 0x31, 0x01};
  PixelMask mask;
  if (blob.size() >= 4 && std::memcmp(blob.bytes().data(), kExrMagic, 4) == 0) {
    FP_ASSIGN_OR_RETURN(const ExrImage image, ReadExr(path));
    if (image.channels.empty()) {
      return absl::InvalidArgumentError("the mask '" + path + "' has no channel");
    }
    mask.rect = image.data_window;
    mask.frame_width = image.frame_width;
    mask.frame_height = image.frame_height;
    for (const float v : image.channels.front().values) mask.on.push_back(v > 0.5f);
    return mask;
  }
  const absl::StatusOr<NpyArray2d> array = ReadNpy2d(path);
  if (!array.ok()) return Annotate(array.status(), "mask (.npy or .exr)");
  mask.rect = {0, 0, array->cols, array->rows};
  mask.frame_width = array->cols;
  mask.frame_height = array->rows;
  for (const double v : array->values) mask.on.push_back(v > 0.5);
  return mask;
}

absl::StatusOr<CompareResult> CompareImages(const ExrImage& a, const ExrImage& b,
                                            const CompareOptions& options) {
  if (!(options.noise >= 0.0) || !std::isfinite(options.noise)) {
    return absl::InvalidArgumentError("noise must be a finite number of at least 0");
  }
  FP_ASSIGN_OR_RETURN(const Pair pair, MakePair(a, b, options));
  std::vector<std::vector<float>> planes_a, planes_b;
  for (size_t c = 0; c < pair.a.size(); ++c) {
    planes_a.push_back(Cut(a, *pair.a[c], pair.rect));
    planes_b.push_back(Cut(b, *pair.b[c], pair.rect));
  }

  // A pixel with one value that is not finite is left out in all its channels.
  std::vector<uint8_t> used = pair.counted;
  CompareResult result;
  result.rect = pair.rect;
  result.pixels = pair.pixels;
  result.noise = options.noise;
  bool same_values = true;
  for (size_t c = 0; c < planes_a.size(); ++c) {
    same_values =
        same_values && pair.a[c]->half == pair.b[c]->half && SameBits(planes_a[c], planes_b[c]);
    for (size_t p = 0; p < used.size(); ++p) {
      if (used[p] != 0 && !(std::isfinite(planes_a[c][p]) && std::isfinite(planes_b[c][p]))) {
        used[p] = 0;
        ++result.left_out;
      }
    }
  }

  if (result.left_out == result.pixels) {
    return absl::InvalidArgumentError("no compared pixel is finite in both images");
  }

  double sum_a = 0.0, sum_b = 0.0, sum_difference = 0.0, sum_square = 0.0;
  for (size_t c = 0; c < planes_a.size(); ++c) {
    for (size_t p = 0; p < used.size(); ++p) {
      if (used[p] == 0) continue;
      const double va = planes_a[c][p], vb = planes_b[c][p];
      const double difference = va - vb;
      sum_a += va;
      sum_b += vb;
      sum_difference += difference;
      sum_square += difference * difference;
      result.max_abs = std::max(result.max_abs, std::abs(difference));
    }
  }
  const double count =
      static_cast<double>(result.pixels - result.left_out) * static_cast<double>(planes_a.size());
  result.mean = sum_a / count;
  result.ref_mean = sum_b / count;
  result.mse = sum_square / count;
  if (result.ref_mean > 0.0) {
    result.rel_rmse = std::sqrt(result.mse) / result.ref_mean;
    result.bias = sum_difference / count / result.ref_mean;
  } else if (sum_square == 0.0) {
    result.rel_rmse = 0.0;
    result.bias = 0.0;
  }
  if (result.rel_rmse) {
    result.rr = std::sqrt(
        std::max(0.0, *result.rel_rmse * *result.rel_rmse - options.noise * options.noise));
    result.noise_above_error = *result.rel_rmse < options.noise;
  }

  if (options.perceptual) {
    const RgbImage rgb_a = ToRgb(planes_a, pair.rect), rgb_b = ToRgb(planes_b, pair.rect);
    const double white = DisplayWhite(rgb_b, pair.counted);
    YeeViewing viewing;
    viewing.view_width = b.frame_width;
    result.pdp = CountPerceptiblyDifferent(DisplayReferred(rgb_a, white),
                                           DisplayReferred(rgb_b, white), pair.counted, viewing);
    const ImagePlane flip =
        HdrFlip(rgb_a, rgb_b, FlipExposures(rgb_b, pair.counted), kFlipPixelsPerDegree);
    double sum = 0.0;
    for (size_t p = 0; p < pair.counted.size(); ++p) {
      if (pair.counted[p] != 0) sum += flip.values[p];
    }
    result.flip = sum / static_cast<double>(pair.pixels);
  }
  CompareHashes(a, b, options, pair, same_values, result);
  return result;
}

absl::Status WriteDiffPng(const std::string& path, const ExrImage& a, const ExrImage& b,
                          const CompareOptions& options, double full_scale) {
  FP_ASSIGN_OR_RETURN(const Pair pair, MakePair(a, b, options));
  std::vector<double> difference(pair.counted.size());
  for (size_t c = 0; c < pair.a.size(); ++c) {
    const std::vector<float> va = Cut(a, *pair.a[c], pair.rect);
    const std::vector<float> vb = Cut(b, *pair.b[c], pair.rect);
    for (size_t p = 0; p < difference.size(); ++p) {
      double d = std::abs(double{va[p]} - double{vb[p]});
      // Infinite in both is no difference; in one, or a NaN, is the largest.
      if (std::isnan(d)) d = va[p] == vb[p] ? 0.0 : std::numeric_limits<double>::infinity();
      difference[p] = std::max(difference[p], d);
    }
  }
  if (!(full_scale > 0.0)) {
    std::vector<double> finite;
    for (size_t p = 0; p < difference.size(); ++p) {
      if (pair.counted[p] != 0 && std::isfinite(difference[p])) finite.push_back(difference[p]);
    }
    full_scale = finite.empty() ? 1.0 : Quantile(finite, 0.999);
    if (!(full_scale > 0.0)) full_scale = 1.0;
  }
  std::vector<uint8_t> rgb(3 * difference.size());
  for (size_t p = 0; p < difference.size(); ++p) {
    if (pair.counted[p] != 0) {
      FalseColor(difference[p] / full_scale, &rgb[3 * p]);
    } else {
      rgb[3 * p + 1] = 40;
    }
  }
  return WritePng(path, pair.rect.width(), pair.rect.height(), rgb);
}

}  // namespace farpoint

#include "core/light/environment_sampler.h"

#include <algorithm>
#include <bit>
#include <cmath>
#include <span>

#include "core/math/elementary.h"
#include "core/math/simd8.h"

namespace farpoint {

namespace {

constexpr double kCounts = 0x1p31;
constexpr double kBelowOne = 1.0 - 0x1p-53;
// The sun's cells are this much brighter than the mean, and this wide at most in all.
constexpr double kSunContrast = 16;
constexpr double kSunSolidAngle = 0.02;
constexpr uint32_t kMinWidth = 96, kMinHeight = 48;
constexpr uint64_t kMaxRefined = uint64_t{1} << 26;

// Latitude and longitude of a place on the map, in texels, radians.
double LatitudeAt(double y, uint32_t height) { return kPi * (0.5 - y / height); }
double LongitudeAt(double x, uint32_t width) { return 2 * kPi * (0.5 - x / width); }

// Counts for `weights` (any scale, >= 0, some positive): item i takes [begin[i], begin[i + 1]) of
// [0, 2^31), at least one count if it has any weight.
void FillCounts(std::span<const float> weights, std::span<uint32_t> begin) {
  double total = 0;
  size_t last = 0;
  for (size_t i = 0; i < weights.size(); ++i) {
    total += static_cast<double>(weights[i]);
    if (weights[i] > 0) last = i;
  }
  const double scale = (kCounts - static_cast<double>(weights.size())) / total;
  double below = 0;
  uint32_t positive = 0;
  for (size_t i = 0; i < weights.size(); ++i) {
    begin[i] = i > last ? uint32_t{1} << 31 : static_cast<uint32_t>(below * scale) + positive;
    below += static_cast<double>(weights[i]);
    positive += weights[i] > 0 ? 1u : 0u;
  }
}

// The item that `u` falls into; u becomes its place within, `probability` is multiplied by the
// item's.
uint32_t FindItem(std::span<const uint32_t> begin, double& u, double& probability) {
  const double x = u * kCounts;
  const auto it = std::upper_bound(begin.begin(), begin.end(), static_cast<uint32_t>(x));
  const double first = *(it - 1);
  const double end = it == begin.end() ? kCounts : static_cast<double>(*it);
  u = std::clamp((x - first) / (end - first), 0.0, kBelowOne);
  probability *= (end - first) / kCounts;
  return static_cast<uint32_t>(it - 1 - begin.begin());
}

// [0, 1) -> [-1, 1] by the density 1 - |t|.
double Tent(double u) {
  return u < 0.5 ? std::sqrt(2.0 * u) - 1.0 : 1.0 - std::sqrt(2.0 * (1.0 - u));
}

}  // namespace

EnvironmentSampler::EnvironmentSampler(const PreparedScene& scene)
    : scene_(scene), width_(scene.map_width()), height_(scene.map_height()) {
  while (width_ < kMinWidth && uint64_t{width_} * height_ * 3 <= kMaxRefined) {
    width_ *= 3;
    refine_x_ *= 3;
  }
  while (height_ < kMinHeight && uint64_t{width_} * height_ * 3 <= kMaxRefined) {
    height_ *= 3;
    refine_y_ *= 3;
  }
  // Luminance times solid angle, brought near 1 by a power of two.
  std::vector<float> power(size_t{width_} * height_);
  double total = 0;
  for (uint32_t y = 0; y < height_; ++y) {
    double row = 0;
    for (uint32_t x = 0; x < width_; ++x) {
      const double luminance = static_cast<double>(Luminance(Radiance(x, y)));
      power[size_t{y} * width_ + x] = static_cast<float>(luminance);
      row += luminance;
    }
    total += row;
  }
  int exponent = 0;
  std::frexp(total / static_cast<double>(power.size()), &exponent);
  for (uint32_t y = 0; y < height_; ++y) {
    const double band =
        DetSinCos(LatitudeAt(y, height_)).sin - DetSinCos(LatitudeAt(y + 1.0, height_)).sin;
    const double factor = std::ldexp(band / width_, -exponent);
    for (uint32_t x = 0; x < width_; ++x) {
      float& p = power[size_t{y} * width_ + x];
      p = static_cast<float>(static_cast<double>(p) * factor);
    }
  }
  BuildCells(power);
  FindSun(power);
  texel_begin_.resize(power.size());
  for (uint32_t cell = 0; cell < kCells; ++cell) BuildDistribution(cell, power);
}

Rgb EnvironmentSampler::Radiance(uint32_t x, uint32_t y) const {
  if (refine_x_ == 1 && refine_y_ == 1) return scene_.MapTexel(x, y) + scene_.sky();
  return scene_.MapAt((x + 0.5) / refine_x_, (y + 0.5) / refine_y_) + scene_.sky();
}

// Splits the map eight times, each part where half of its light and solid angle, which count
// alike, lies on either side.
void EnvironmentSampler::BuildCells(const std::vector<float>& power) {
  double total = 0;
  std::vector<double> row_cosine(height_);
  for (uint32_t y = 0; y < height_; ++y) {
    row_cosine[y] = DetSinCos(LatitudeAt(y + 0.5, height_)).cos;
    double row = 0;
    for (uint32_t x = 0; x < width_; ++x) row += static_cast<double>(power[size_t{y} * width_ + x]);
    total += row;
  }
  double total_cosine = 0;
  for (const double c : row_cosine) total_cosine += c;
  const double angle_weight = total / (total_cosine * width_);

  std::vector<Rect> rects(2 * kCells, Rect{0, 0, 0, 0});
  rects[1] = {0, 0, width_, height_};
  std::vector<double> profile;
  for (uint32_t node = 1; node < kCells; ++node) {
    const Rect r = rects[node];
    const uint32_t columns = r.x1 - r.x0, rows = r.y1 - r.y0;
    if (columns == 0 || rows == 0) continue;  // its children are empty, too
    const double tall = kPi * rows / height_;
    const double wide = 2 * kPi * columns / width_ * row_cosine[(r.y0 + r.y1) / 2];
    const bool by_rows = columns == 1 || (rows > 1 && tall > wide);
    splits_rows_[node] = by_rows;
    const uint32_t count = by_rows ? rows : columns;
    profile.assign(count, 0.0);
    for (uint32_t y = r.y0; y < r.y1; ++y) {
      const double angle = angle_weight * row_cosine[y];
      for (uint32_t x = r.x0; x < r.x1; ++x) {
        profile[by_rows ? y - r.y0 : x - r.x0] +=
            static_cast<double>(power[size_t{y} * width_ + x]) + angle;
      }
    }
    double whole = 0;
    for (const double p : profile) whole += p;
    // The border nearest to the half, with something on either side where there is anything.
    uint32_t cut = count > 1 ? 1 : count;
    double below = profile[0], best = std::fabs(2 * below - whole);
    for (uint32_t i = 1; i + 1 < count; ++i) {
      below += profile[i];
      if (std::fabs(2 * below - whole) < best) {
        best = std::fabs(2 * below - whole);
        cut = i + 1;
      }
    }
    rects[2 * node] = rects[2 * node + 1] = r;
    if (by_rows) {
      rects[2 * node].y1 = rects[2 * node + 1].y0 = r.y0 + cut;
    } else {
      rects[2 * node].x1 = rects[2 * node + 1].x0 = r.x0 + cut;
    }
  }
  std::copy(rects.begin() + kCells, rects.end(), rect_.begin());
}

void EnvironmentSampler::FindSun(const std::vector<float>& power) {
  std::array<double, kCells> cell_power{}, solid_angle{};
  double total = 0;
  for (uint32_t cell = 0; cell < kCells; ++cell) {
    const Rect& r = rect_[cell];
    for (uint32_t y = r.y0; y < r.y1; ++y) {
      for (uint32_t x = r.x0; x < r.x1; ++x) {
        cell_power[cell] += static_cast<double>(power[size_t{y} * width_ + x]);
      }
    }
    solid_angle[cell] =
        2 * kPi * (r.x1 - r.x0) / width_ *
        (DetSinCos(LatitudeAt(r.y0, height_)).sin - DetSinCos(LatitudeAt(r.y1, height_)).sin);
    total += cell_power[cell];
  }
  double sun = 0;
  for (uint32_t cell = 0; cell < kCells; ++cell) {
    const bool bright = cell_power[cell] * 4 * kPi > kSunContrast * total * solid_angle[cell];
    is_sun_[cell] = bright ? ~0u : 0u;
    if (bright) sun += solid_angle[cell];
  }
  has_sun_ = sun > 0 && sun < kSunSolidAngle;
  if (!has_sun_) is_sun_.fill(0);
}

void EnvironmentSampler::BuildDistribution(uint32_t cell, std::vector<float>& power) {
  const Rect& r = rect_[cell];
  const uint32_t rows = r.y1 - r.y0;
  first_row_[cell] = static_cast<uint32_t>(row_begin_.size());
  std::vector<SinCos> longitude(r.x1 - r.x0);
  for (uint32_t x = r.x0; x < r.x1; ++x) {
    longitude[x - r.x0] = DetSinCos(LongitudeAt(x + 0.5, width_));
  }
  const auto direction = [&](uint32_t x, const SinCos& latitude) {
    const SinCos& l = longitude[x - r.x0];
    return Vec3d(l.sin * latitude.cos, latitude.sin, l.cos * latitude.cos);
  };
  const auto row_of = [&](uint32_t y) {
    return std::span<float>(power).subspan(size_t{y} * width_ + r.x0, r.x1 - r.x0);
  };
  Vec3d sum;
  double total = 0;
  std::vector<float> row_power(rows);
  for (uint32_t y = r.y0; y < r.y1; ++y) {
    const SinCos latitude = DetSinCos(LatitudeAt(y + 0.5, height_));
    Vec3d row_sum;
    double row_total = 0;
    for (uint32_t x = r.x0; x < r.x1; ++x) {
      const auto p = static_cast<double>(row_of(y)[x - r.x0]);
      row_sum += direction(x, latitude) * p;
      row_total += p;
    }
    sum += row_sum;
    total += row_total;
    row_power[y - r.y0] = static_cast<float>(row_total);
  }
  row_begin_.resize(row_begin_.size() + rows);
  if (!(total > 0)) return;  // is never chosen

  // How far from the mean direction the tents reach.
  const Vec3d mean = NormalizeOr(sum, Vec3d());
  double least = 1;
  for (uint32_t y = r.y0; y < r.y1; ++y) {
    if (!(row_power[y - r.y0] > 0)) continue;
    const SinCos latitude = DetSinCos(LatitudeAt(y + 0.5, height_));
    for (uint32_t x = r.x0; x < r.x1; ++x) {
      if (row_of(y)[x - r.x0] > 0) least = std::min(least, Dot(direction(x, latitude), mean));
    }
  }
  const double texel_x = 2 * kPi / width_, texel_y = kPi / height_;
  const double reach = DetAcos(least) + 1.2 * std::sqrt(texel_x * texel_x + texel_y * texel_y);
  if (mean != Vec3d() && reach < 1.4) {
    x_[cell] = static_cast<float>(sum.x);
    y_[cell] = static_cast<float>(sum.y);
    z_[cell] = static_cast<float>(sum.z);
    spread_[cell] = static_cast<float>(Length(sum) * std::min(1.0, DetSinCos(reach).sin * 1.001));
  } else {
    // All around: the cosine says nothing. LookAlong() makes a quarter of it.
    spread_[cell] = static_cast<float>(2 * total);
  }
  FillCounts(row_power, std::span<uint32_t>(row_begin_).last(rows));
  for (uint32_t y = r.y0; y < r.y1; ++y) {
    if (!(row_power[y - r.y0] > 0)) continue;
    FillCounts(row_of(y),
               std::span<uint32_t>(texel_begin_).subspan(size_t{y} * width_ + r.x0, r.x1 - r.x0));
  }
}

// The clamped cosine integrated over a cell: n·m where the cell lies above the horizon by its
// spread s, 0 where below it, between them the parabola (n·m + s)² / 4s that joins both smoothly.
void EnvironmentSampler::LookAlong(const Vec3f& normal, View& view) const {
  const Vec3d n(normal);
  const auto& axis = scene_.world_from_map();
  view.n_map = {Dot(n, axis[0]), Dot(n, axis[1]), Dot(n, axis[2])};
  const F8 nx = Set8(static_cast<float>(view.n_map.x)), ny = Set8(static_cast<float>(view.n_map.y)),
           nz = Set8(static_cast<float>(view.n_map.z));
  const F8 zero = Set8(0), least = Set8(std::numeric_limits<float>::min());
  for (uint32_t i = 0; i < kCells; i += 8) {
    const F8 a = nx * Load8(&x_[i]) + ny * Load8(&y_[i]) + nz * Load8(&z_[i]);
    const F8 s = Load8(&spread_[i]);
    const F8 above = Max8(a + s, zero);
    const F8 parabola = above * above / Max8(Set8(4) * s, least);
    const F8 weight = Select8(a >= s, a, parabola);
    const M8 sun = reinterpret_cast<M8>(Load8(reinterpret_cast<const float*>(&is_sun_[i])));
    Store8(&view.weight[0][kCells + i], Select8(sun, weight, zero));
    Store8(&view.weight[1][kCells + i], Select8(sun, zero, weight));
  }
  for (unsigned group = has_sun_ ? 0 : 1; group < 2; ++group) {
    auto& w = view.weight[group];
    for (uint32_t i = kCells - 1; i > 0; --i) w[i] = w[2 * i] + w[2 * i + 1];
  }
  const double sun = has_sun_ ? static_cast<double>(view.weight[0][1]) : 0.0;
  const auto rest = static_cast<double>(view.weight[1][1]);
  view.sun_share = 0;
  if (sun > 0) {
    const double eighths = static_cast<double>(static_cast<int>(8.0 * sun / (sun + rest) + 0.5));
    view.sun_share = rest > 0 ? std::clamp(eighths, 1.0, 4.0) / 8.0 : 1.0;
  }
}

std::optional<EnvironmentSampler::Draw> EnvironmentSampler::Sample(const View& view, double u,
                                                                   double v) const {
  const bool to_sun = u < view.sun_share;
  const auto& weight = view.weight[to_sun ? 0 : 1];
  double probability = to_sun ? view.sun_share : 1.0 - view.sun_share;
  u = std::clamp((to_sun ? u : u - view.sun_share) / probability, 0.0, kBelowOne);
  if (!(weight[1] > 0)) return std::nullopt;
  uint32_t node = 1;
  while (node < kCells) {
    const auto left = static_cast<double>(weight[2 * node]);
    const auto right = static_cast<double>(weight[2 * node + 1]);
    const double part = left / (left + right);
    double& x = splits_rows_[node] ? v : u;
    if (x < part) {
      x = std::min(x / part, kBelowOne);
      probability *= part;
      node = 2 * node;
    } else {
      x = std::min((x - part) / (1.0 - part), kBelowOne);
      probability *= 1.0 - part;
      node = 2 * node + 1;
    }
  }
  const uint32_t cell = node - kCells;
  const Rect& r = rect_[cell];
  const uint32_t row =
      r.y0 + FindItem(std::span<const uint32_t>(row_begin_).subspan(first_row_[cell], r.y1 - r.y0),
                      v, probability);
  const uint32_t column =
      r.x0 +
      FindItem(
          std::span<const uint32_t>(texel_begin_).subspan(size_t{row} * width_ + r.x0, r.x1 - r.x0),
          u, probability);
  // The tents of the first and last row are folded at the map's edge, as the lookup holds it.
  const double x = column + 0.5 + Tent(u);
  double y = std::fabs(row + 0.5 + Tent(v));
  if (y > height_) y = 2.0 * height_ - y;
  const SinCos latitude = DetSinCos(LatitudeAt(y, height_));
  const SinCos longitude = DetSinCos(LongitudeAt(x, width_));
  const Vec3d w_map(longitude.sin * latitude.cos, latitude.sin, longitude.cos * latitude.cos);
  const double cosine = Dot(view.n_map, w_map);
  const double solid_angle = 2 * kPi * kPi * latitude.cos / width_ / height_;
  const double factor = cosine * solid_angle / probability;
  if (!(factor > 0) || !std::isfinite(factor)) return std::nullopt;
  const auto& axis = scene_.world_from_map();
  return Draw{Vec3f(axis[0] * w_map.x + axis[1] * w_map.y + axis[2] * w_map.z),
              Radiance(column, row) * static_cast<float>(factor)};
}

}  // namespace farpoint

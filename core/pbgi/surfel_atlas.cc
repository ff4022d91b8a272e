#include "core/pbgi/surfel_atlas.h"

#include <algorithm>
#include <array>
#include <atomic>
#include <bit>
#include <cmath>
#include <cstdlib>
#include <limits>

#include "core/base/pulse.h"
#include "core/math/elementary.h"
#include "core/math/sampling.h"

namespace farpoint {

namespace {

constexpr float kSameSurfaceCosine = 0.5f;
// A point this many spacings off a surfel's plane lies on another surface, such as the paint on a
// road, the tile on a floor (or on a strong bend). docs/decisions/0034-unbiased-reading.md.
constexpr float kSamePlane = 0.01f;
constexpr float kFarthest = 1.5f * 1.5f;  // squared spacings

uint64_t KeyOf(int64_t x, int64_t y, int64_t z) {
  return static_cast<uint64_t>(x) << 42 | static_cast<uint64_t>(y) << 21 | static_cast<uint64_t>(z);
}

// A worker builds grids while it renders, and who gives no sign of life for seconds loses its tile.
constexpr size_t kPulsePiece = size_t{1} << 17;

template <typename T>
void SortInPieces(std::vector<T>& values) {
  const auto at = [&](size_t i) {
    return values.begin() + static_cast<std::ptrdiff_t>(std::min(i, values.size()));
  };
  for (size_t i = 0; i < values.size(); i += kPulsePiece) {
    std::sort(at(i), at(i + kPulsePiece));
    Pulse();
  }
  for (size_t width = kPulsePiece; width < values.size(); width *= 2) {
    for (size_t i = 0; i + width < values.size(); i += 2 * width) {
      std::inplace_merge(at(i), at(i + width), at(i + 2 * width));
      Pulse();
    }
  }
}

}  // namespace

SurfelGrid::SurfelGrid(const PointTree& tree) : tree_(tree) {
  if (tree.empty()) return;
  const uint64_t n = tree.surfel_count();
  double area = 0;
  Box3f box;
  for (uint64_t i = 0; i < n; ++i) {
    const Surfel s = tree.surfel(static_cast<uint32_t>(i));
    area += kPi * static_cast<double>(s.radius_m) * static_cast<double>(s.radius_m);
    box.Extend(s.position);
    if (i % kPulsePiece == 0) Pulse();
  }
  spacing_m_ = static_cast<float>(std::sqrt(area / static_cast<double>(n)));
  // At most 2^20 cells along an axis, so that keys fit.
  const float cell = std::max(2.0f * spacing_m_, MaxAbs(box.max - box.min) * (1.0f / 1000000.0f));
  inverse_cell_ = 1.0f / cell;
  low_ = box.min - Vec3f(cell);
  struct Keyed {
    uint64_t key;
    uint32_t slot;
    bool operator<(const Keyed& o) const { return key != o.key ? key < o.key : slot < o.slot; }
  };
  std::vector<Keyed> order(n);
  for (uint64_t i = 0; i < n; ++i) {
    const Vec3f q = (tree.surfel(static_cast<uint32_t>(i)).position - low_) * inverse_cell_;
    order[i] = {
        KeyOf(static_cast<int64_t>(q.x), static_cast<int64_t>(q.y), static_cast<int64_t>(q.z)),
        static_cast<uint32_t>(i)};
  }
  SortInPieces(order);
  uint64_t different = 0;
  for (uint64_t i = 0; i < n; ++i) different += i == 0 || order[i].key != order[i - 1].key;
  size_t size = 16;
  while (size < 2 * different) size *= 2;
  cells_.resize(size);
  entries_.resize(n);
  for (uint64_t i = 0; i < n;) {
    uint64_t end = i;
    while (end < n && order[end].key == order[i].key) {
      const uint32_t slot = order[end].slot;
      const Surfel s = tree.surfel(slot);
      entries_[end] = {s.position, slot, s.normal};
      ++end;
    }
    size_t at = Mix64(order[i].key) & (size - 1);
    while (cells_[at].key != kEmpty) at = (at + 1) & (size - 1);
    cells_[at] = {order[i].key, static_cast<uint32_t>(i), static_cast<uint32_t>(end - i)};
    i = end;
    Pulse();
  }
}

const SurfelGrid::Cell* SurfelGrid::FindCell(uint64_t key) const {
  size_t at = Mix64(key) & (cells_.size() - 1);
  while (cells_[at].key != key) {
    if (cells_[at].key == kEmpty) return nullptr;
    at = (at + 1) & (cells_.size() - 1);
  }
  return &cells_[at];
}

template <typename See>
void SurfelGrid::ForEachNear(const Vec3f& p, const Vec3f& n, const See& see) const {
  if (entries_.empty()) return;
  const Vec3f q = (p - low_) * inverse_cell_ - Vec3f(0.5f);
  const int64_t x0 = static_cast<int64_t>(std::floor(q.x));
  const int64_t y0 = static_cast<int64_t>(std::floor(q.y));
  const int64_t z0 = static_cast<int64_t>(std::floor(q.z));
  if (x0 < 0 || y0 < 0 || z0 < 0 || x0 >= 1 << 20 || y0 >= 1 << 20 || z0 >= 1 << 20) return;
  // The fetches from memory overlap.
  std::array<uint64_t, 8> keys;
  std::array<const Cell*, 8> cells;
  for (size_t i = 0; i < 8; ++i) {
    keys[i] = KeyOf(x0 + static_cast<int64_t>(i & 1), y0 + static_cast<int64_t>(i >> 1 & 1),
                    z0 + static_cast<int64_t>(i >> 2));
    __builtin_prefetch(&cells_[Mix64(keys[i]) & (cells_.size() - 1)]);
  }
  for (size_t i = 0; i < 8; ++i) {
    cells[i] = FindCell(keys[i]);
    if (cells[i] == nullptr) continue;
    const char* entries = reinterpret_cast<const char*>(&entries_[cells[i]->first]);
    for (size_t at = 0; at < cells[i]->count * sizeof(Entry); at += 64) {
      __builtin_prefetch(entries + at);
    }
  }
  const float farthest = kFarthest * spacing_m_ * spacing_m_;
  for (const Cell* cell : cells) {
    if (cell == nullptr) continue;
    for (uint32_t e = cell->first; e < cell->first + cell->count; ++e) {
      const Entry& entry = entries_[e];
      const Vec3f d = p - entry.position;
      const float d2 = Length2(d);
      if (!(d2 < farthest)) continue;
      const float cosine = Dot(entry.normal, n);
      if (!(std::fabs(cosine) > kSameSurfaceCosine)) continue;
      if (!(std::fabs(Dot(entry.normal, d)) <= kSamePlane * spacing_m_)) continue;
      see(entry, d2, cosine > 0.0f ? 0 : 1);
    }
  }
}

// Surfels that are wound as the surface is come first: on the far side of a thin board, and where
// two objects touch, there are others as near, whose backs are inside.
struct SurfelGrid::Nearest {
  static constexpr float kNone = std::numeric_limits<float>::infinity();
  // Of each winding; squared.
  float distance2[2] = {kNone, kNone};
  const Entry* entry[2] = {nullptr, nullptr};

  void See(const Entry& other, float d2, int turned) {
    if (!(d2 < distance2[turned])) return;
    distance2[turned] = d2;
    entry[turned] = &other;
  }
  int turned() const { return entry[0] != nullptr ? 0 : 1; }
  // Null: none was seen.
  const Entry* found() const { return entry[turned()]; }
};

std::optional<Rgb> SurfelGrid::Find(const Vec3f& p, const Vec3f& n, bool front,
                                    Vec3f* where) const {
  Nearest nearest;
  ForEachNear(p, n,
              [&](const Entry& entry, float d2, int turned) { nearest.See(entry, d2, turned); });
  const Entry* const found = nearest.found();
  if (found == nullptr) return std::nullopt;
  if (where != nullptr) *where = found->position;
  const bool found_front = front == (nearest.turned() == 0);
  const unsigned side = found_front ? kFrontVisible : kBackVisible;
  if ((tree_.visible_sides(found->slot) & side) == 0) return std::nullopt;
  return tree_.radiance_of(found->slot, found_front);
}

std::optional<SurfelGrid::Side> SurfelGrid::FindVisible(const Vec3f& p, const Vec3f& n, bool front,
                                                        Vec3f* where) const {
  Nearest nearest;
  ForEachNear(p, n, [&](const Entry& entry, float d2, int turned) {
    if (!(d2 < nearest.distance2[turned])) return;
    const unsigned side = front == (turned == 0) ? kFrontVisible : kBackVisible;
    if ((tree_.visible_sides(entry.slot) & side) != 0) nearest.See(entry, d2, turned);
  });
  const Entry* const found = nearest.found();
  if (found == nullptr) return std::nullopt;
  if (where != nullptr) *where = found->position;
  return Side{found->slot, front == (nearest.turned() == 0)};
}

namespace {

// A resolved word: bit 63 set; bit 62: no surfel near. Else three mantissas of 17 bits (R lowest)
// and from bit 51 on an exponent e, biased by 512 (11 bits): channel = mantissa * 2^(e - 16).
constexpr uint64_t kResolved = uint64_t{1} << 63;
constexpr uint64_t kNone = uint64_t{1} << 62;
constexpr int kMantissaBits = 17;
constexpr uint64_t kMantissaMask = (uint64_t{1} << kMantissaBits) - 1;

// Of what may stand between a texel and its surfel unseen, in spacings.
constexpr float kLift = 0.1f;
// Surfaces this near to each other, in spacings, are a crack.
constexpr float kCrack = 0.5f;

uint64_t Encode(const Rgb& c) {
  const float most = MaxComponent(c);
  if (!(most > 0.0f)) return kResolved;
  int exponent = 0;
  std::frexp(most, &exponent);  // most < 2^exponent
  const float scale = std::ldexp(1.0f, 16 - exponent);
  uint64_t word = kResolved | static_cast<uint64_t>(exponent + 512) << (3 * kMantissaBits);
  for (int i = 0; i < 3; ++i) {
    const uint64_t m = static_cast<uint64_t>(c[i] * scale + 0.5f);
    word |= std::min(m, kMantissaMask) << (i * kMantissaBits);
  }
  return word;
}

Rgb Decode(uint64_t word) {
  const int exponent = static_cast<int>(word >> (3 * kMantissaBits) & 0x7ff) - 512;
  // 2^(exponent - 16), a normal double.
  const double scale = std::bit_cast<double>(static_cast<uint64_t>(exponent - 16 + 1023) << 52);
  const auto channel = [&](int i) {
    return static_cast<float>(static_cast<double>(word >> (i * kMantissaBits) & kMantissaMask) *
                              scale);
  };
  return {channel(0), channel(1), channel(2)};
}

}  // namespace

void SurfelAtlas::FreeDeleter::operator()(void* p) const { std::free(p); }

SurfelAtlas::SurfelAtlas(const RayAccel& accel, const PointTree& tree, const SurfelAtlas* radiance)
    : accel_(accel),
      scene_(accel.scene()),
      tree_(tree),
      radiance_(radiance),
      grid_(radiance == nullptr ? std::make_shared<const SurfelGrid>(tree) : radiance->grid_) {
  const PreparedScene& scene = scene_;
  const size_t count = scene.triangles().size();
  patches_.resize(count);
  if (!(grid_->spacing_m() > 0.0f)) return;
  float texel = grid_->spacing_m();
  uint64_t total = 0;
  for (;; texel *= 1.5f) {
    total = 0;
    for (size_t t = 0; t < count; ++t) {
      const auto& v = scene.triangles()[t].vertex;
      const Vec3f a = scene.vertices()[v[0]], b = scene.vertices()[v[1]],
                  c = scene.vertices()[v[2]];
      const float longest = std::sqrt(std::max({Length2(b - a), Length2(c - b), Length2(a - c)}));
      const uint64_t side = std::clamp<uint64_t>(
          static_cast<uint64_t>(std::min(longest / texel, 16000.0f) + 0.5f), 1, 16000);
      patches_[t] = {total, side};
      total += side * side;
    }
    if (total <= kMaxTexels || total <= count) break;
  }
  // calloc: pages that are never read are never touched.
  words_.reset(static_cast<uint64_t*>(std::calloc(2 * total, sizeof(uint64_t))));
}

uint64_t SurfelAtlas::Resolve(const Point& point, const Texel& texel, uint32_t side) const {
  const auto [column, row, word] = texel;
  const uint32_t triangle = point.triangle;
  const bool front = point.front;
  // Column + row < side: the texel's lower half lies in the triangle; else the texel is the mirror
  // image of one that does (see TexelOf), whose upper half it is.
  const bool upper = column + row >= side;
  const float inverse = 1.0f / static_cast<float>(side);
  const float u = static_cast<float>(upper ? side - 1 - column : column);
  const float v = static_cast<float>(upper ? side - 1 - row : row);
  const auto at = [&](float du, float dv) {
    return scene_.PointOn(triangle, (u + du) * inverse, (v + dv) * inverse);
  };
  const float middle = upper ? 2.0f / 3 : 1.0f / 3;
  const Vec3f n = scene_.GeometricNormal(triangle), out = front ? n : -n;
  const Vec3f p = at(middle, middle);
  Vec3f surfel;
  const Vec3f lift = out * (kLift * grid_->spacing_m());
  if (radiance_ != nullptr) {
    // In a crack it is darker than a surfel outside of it knows.
    const Vec3f leaving = accel_.LeaveSurface(triangle, p, out);
    const auto found = grid_->FindVisible(p, n, front, &surfel);
    const bool usable = found && !CutOff(p + lift, surfel + lift) &&
                        !accel_.Occluded(leaving, out, kCrack * grid_->spacing_m());
    return Encode(usable ? tree_.indirect_of(found->slot, found->front)
                         : Gathered(point, p, out, word));
  }
  const std::optional<Rgb> found = grid_->Find(p, n, front, &surfel);
  if (!found) return kResolved | kNone;
  const Vec3f lifted = accel_.LeaveSurface(triangle, p, out);
  // What cuts through the half cuts two of its sides, so two of them tell. A little within them:
  // there another surface may begin.
  constexpr float kInside = 0.9f;
  Vec3f corner[3];
  for (int i = 0; i < 3; ++i) {
    const float a = i == 1 ? 1.0f : 0.0f, b = i == 2 ? 1.0f : 0.0f;
    const Vec3f end = upper ? at(1 - a, 1 - b) : at(a, b);
    corner[i] = lifted + (end - p) * kInside;
  }
  if (CutOff(corner[1], corner[0]) || CutOff(corner[0], corner[2])) return kResolved | kNone;
  // The surfel may lie on another triangle: over the edge between them, if it is not too sharp.
  if (CutOff(p + lift, surfel + lift)) return kResolved | kNone;
  return Encode(*found);
}

bool SurfelAtlas::CutOff(const Vec3f& from, const Vec3f& to) const {
  const Vec3f d = to - from;
  const float length = Length(d);
  return length > 0.0f && accel_.Occluded(from, d / length, length);
}

Rgb SurfelAtlas::Gathered(const Point& point, const Vec3f& p, const Vec3f& out,
                          uint64_t key) const {
  const Vec3f origin = accel_.LeaveSurface(point.triangle, p, out);
  const Frame frame(out);
  const auto seed = static_cast<uint32_t>(HashKey(key, kTexelRays));
  Rgb sum;
  for (uint32_t i = 0; i < kTexelRays; ++i) {
    const Vec3f w = frame.ToWorld(CosineHemisphere(OwenSobol(i, 0, seed), OwenSobol(i, 1, seed)));
    const std::optional<RayHit> hit = accel_.Intersect(origin, w);
    if (!hit) continue;
    const std::optional<Rgb> l = radiance_->Radiance({hit->triangle, hit->b1, hit->b2, hit->front});
    if (l) sum += *l;
  }
  return sum * (kPif / static_cast<float>(kTexelRays));
}

SurfelAtlas::Texel SurfelAtlas::TexelOf(const Point& point, const Patch& patch) const {
  const uint32_t side = static_cast<uint32_t>(patch.side);
  const float scale = static_cast<float>(side);
  const float u = std::max(point.b1, 0.0f) * scale, v = std::max(point.b2, 0.0f) * scale;
  uint32_t column = std::min(static_cast<uint32_t>(u), side - 1);
  uint32_t row = std::min(static_cast<uint32_t>(v), side - 1);
  // Micro-triangles: the lower left half of cell (column, row) keeps the cell's place, the upper
  // right half goes to the mirrored cell, which lies outside of the triangle.
  const bool upper = column + row < side - 1 &&
                     (u - static_cast<float>(column)) + (v - static_cast<float>(row)) > 1.0f;
  if (column + row >= side) {  // by rounding at the hypotenuse
    row = side - 1 - column;
  }
  if (upper) {
    column = side - 1 - column;
    row = side - 1 - row;
  }
  return {column, row, 2 * (patch.first + uint64_t{row} * side + column) + (point.front ? 0u : 1u)};
}

uint64_t SurfelAtlas::Value(const Point& point, const Texel& texel, uint32_t side) const {
  const std::atomic_ref<uint64_t> cell(words_[texel.word]);
  uint64_t value = cell.load(std::memory_order_relaxed);
  if (value == 0) {
    value = Resolve(point, texel, side);
    cell.store(value, std::memory_order_relaxed);
  }
  return value;
}

std::optional<Rgb> SurfelAtlas::Radiance(const Point& point) const {
  Rgb radiance;
  if (Radiances({&point, 1}, {&radiance, 1}) == 0) return std::nullopt;
  return radiance;
}

uint64_t SurfelAtlas::Radiances(std::span<const Point> points, std::span<Rgb> radiance) const {
  if (!words_) return 0;
  for (const Point& point : points) __builtin_prefetch(&patches_[point.triangle]);
  std::array<Texel, kTogether> texels;
  for (size_t i = 0; i < points.size(); ++i) {
    texels[i] = TexelOf(points[i], patches_[points[i].triangle]);
    __builtin_prefetch(&words_[texels[i].word]);
  }
  uint64_t found = 0;
  for (size_t i = 0; i < points.size(); ++i) {
    const auto side = static_cast<uint32_t>(patches_[points[i].triangle].side);
    const uint64_t value = Value(points[i], texels[i], side);
    if ((value & kNone) != 0) continue;
    radiance[i] = Decode(value);
    found |= uint64_t{1} << i;
  }
  return found;
}

}  // namespace farpoint

#include "core/irrcache/irradiance_cache.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <utility>

#include "core/math/sampling.h"

namespace farpoint {

namespace {

constexpr int kCoarsest = 64, kCell = 16;
// A pixel seen at a slant projects to more than its footprint; at most by this much.
constexpr float kLeastSlantCosine = 0.1f;
enum : uint64_t { kKeyGather = 41, kKeyOwn = 42 };

// The pixels (x0 + i step, y0 + j step).
struct Phase {
  int x0, y0, step;
};

// Coarse to fine; each pixel in one phase.
std::vector<Phase> Phases() {
  std::vector<Phase> phases = {{0, 0, kCoarsest}};
  for (int s = kCoarsest; s > kCell; s /= 2) {
    const int half = s / 2;
    for (const auto& [dx, dy] : {std::pair{half, half}, {half, 0}, {0, half}}) {
      phases.push_back({dx, dy, s});
    }
  }
  // The others by Bayer's order of a cell: of the halving that places them, then recursively.
  std::array<std::pair<uint32_t, int>, kCell * kCell> order;
  for (int y = 0; y < kCell; ++y) {
    for (int x = 0; x < kCell; ++x) {
      uint32_t rank = 0;
      for (int bit = 1; bit < kCell; bit *= 2) {
        const uint32_t bx = (x & bit) != 0, by = (y & bit) != 0;
        rank = rank << 2 | (bx ^ by) << 1 | by;
      }
      order[static_cast<size_t>(y * kCell + x)] = {rank, y * kCell + x};
    }
  }
  std::sort(order.begin(), order.end());
  for (size_t i = 1; i < order.size(); ++i) {
    phases.push_back({order[i].second % kCell, order[i].second / kCell, kCell});
  }
  return phases;
}

void Accumulate(const GatherRecord& record, const Vec3f& x, const Vec3f& n, CachedIrradiance& out) {
  const float w = CacheWeight(record, x, n);
  if (!(w > 0.0f)) return;
  out.weight += w;
  out.irradiance += IrradianceAt(record, x, n) * w;
  out.unhidden += UnhiddenAt(record, x, n) * w;
}

void Finish(CachedIrradiance& out) {
  if (!(out.weight > 0.0f)) return;
  out.irradiance = out.irradiance * (1.0f / out.weight);
  out.unhidden = out.unhidden * (1.0f / out.weight);
}

}  // namespace

float CacheWeight(const GatherRecord& record, const Vec3f& x, const Vec3f& n) {
  const Vec3f d = x - record.position;
  const float r = record.reach_m;
  const float distance2 = Length2(d);
  if (!(distance2 < r * r)) return 0.0f;
  const float turned = (1.0f - Dot(n, record.normal)) * (1.0f / kCacheNormalTolerance);
  if (!(turned < 1.0f)) return 0.0f;
  if (0.5f * Dot(d, n + record.normal) < -kBehind * r) return 0.0f;
  const float w = 1.0f - std::max(std::sqrt(distance2) / r, std::sqrt(std::max(turned, 0.0f)));
  return w * w;
}

CachedIrradiance InterpolateAll(std::span<const GatherRecord> records, const Vec3f& x,
                                const Vec3f& n) {
  CachedIrradiance out;
  for (const GatherRecord& record : records) Accumulate(record, x, n, out);
  Finish(out);
  return out;
}

IrradianceCache::IrradianceCache(const IrradianceCacheParams& params, const Box3f& bounds,
                                 const Vec3f& eye, const RecordSource& source)
    : params_(params),
      bounds_(bounds),
      eye_(eye),
      source_(source),
      grid_(params.samples),
      octree_(bounds) {}

IrradianceCache::Radius IrradianceCache::RadiusOf(const GatherRecord& record,
                                                  float footprint_m) const {
  Radius out;
  out.full_m = record.harmonic_distance_m;
  for (int c = 0; c < 3; ++c) {
    const float slope = Length(record.gradient[c]);
    if (slope > 0.0f) out.full_m = std::min(out.full_m, record.irradiance[c] / slope);
  }
  // The side of the square of the pixel's projected area.
  const Vec3f to_eye = NormalizeOr(eye_ - record.position, record.normal);
  const float cosine = std::max(std::fabs(Dot(to_eye, record.normal)), kLeastSlantCosine);
  const float side = footprint_m / std::sqrt(cosine);
  out.least_m = std::max(params_.least_px * side, std::numeric_limits<float>::min());
  out.most_m = std::max(params_.most_px * side, out.least_m);
  return out;
}

void IrradianceCache::SetReach(const Radius& radius, GatherRecord& record) const {
  float reach = std::min(params_.error * radius.full_m, radius.most_m);
  if (!(reach >= radius.least_m)) {
    const float scale = std::max(reach, 0.0f) / radius.least_m;
    for (Vec3f& slope : record.gradient) slope *= scale;
    reach = radius.least_m;
  }
  record.reach_m = reach;
}

void IrradianceCache::Insert(GatherRecord record, const Radius& measured) {
  const uint32_t id = static_cast<uint32_t>(records_.size());
  Radius radius = measured;
  // Neighbour clamping, both ways, among those whose influence can meet.
  const float near_m =
      2.0f * std::clamp(params_.error * radius.full_m, radius.least_m, radius.most_m);
  octree_.Near(record.position, near_m, [&](uint32_t j) {
    radius.full_m =
        std::min(radius.full_m, radii_[j].full_m + Length(records_[j].position - record.position));
  });
  gradients_.push_back(record.gradient);
  SetReach(radius, record);
  const auto clamp_other = [&](uint32_t j) {
    const float most = radius.full_m + Length(records_[j].position - record.position);
    if (!(radii_[j].full_m > most)) return;
    radii_[j].full_m = most;
    records_[j].gradient = gradients_[j];
    SetReach(radii_[j], records_[j]);
  };
  octree_.Near(record.position, near_m, clamp_other);
  octree_.AtPoint(record.position, clamp_other);
  octree_.Insert(id, record.position, record.reach_m);
  records_.push_back(record);
  radii_.push_back(radius);
}

std::unique_ptr<const IrradianceCache> IrradianceCache::Build(
    const IrradianceCacheParams& params, const PixelRect& frame, const Box3f& bounds,
    const Vec3f& eye, const RecordSource& source, Executor& executor,
    const std::function<bool(double)>& go_on, Counts& counts) {
  std::unique_ptr<IrradianceCache> cache(new IrradianceCache(params, bounds, eye, source));
  struct Candidate {
    bool chosen = false;
    uint64_t key = 0;
    Receiver receiver;
    float footprint_m = 0;
    GatherRecord record;
  };
  std::vector<Candidate> candidates;
  std::vector<uint32_t> chosen;
  const std::vector<Phase> phases = Phases();
  for (size_t at = 0; at < phases.size(); ++at) {
    if (go_on && !go_on(static_cast<double>(at) / static_cast<double>(phases.size()))) {
      return nullptr;
    }
    const Phase& phase = phases[at];
    const int columns = (frame.width() - phase.x0 + phase.step - 1) / phase.step;
    const int rows = (frame.height() - phase.y0 + phase.step - 1) / phase.step;
    if (columns <= 0 || rows <= 0) continue;
    const size_t count = static_cast<size_t>(columns) * static_cast<size_t>(rows);
    candidates.assign(count, {});
    executor.ForEachPiece(count, 64, [&](size_t begin, size_t end) {
      for (size_t i = begin; i < end; ++i) {
        const int x =
            frame.x0 + phase.x0 + static_cast<int>(i % static_cast<size_t>(columns)) * phase.step;
        const int y =
            frame.y0 + phase.y0 + static_cast<int>(i / static_cast<size_t>(columns)) * phase.step;
        Candidate& c = candidates[i];
        if (!source.ReceiverAt(x, y, c.receiver, c.footprint_m)) continue;
        c.key = static_cast<uint64_t>(y) << 32 | static_cast<uint64_t>(x);
        float weight = 0;
        cache->octree_.AtPoint(c.receiver.position, [&](uint32_t id) {
          weight += CacheWeight(cache->records_[id], c.receiver.position, c.receiver.normal);
        });
        c.chosen = !(weight >= params.enough);
      }
    });
    counts.candidates += count;
    chosen.clear();
    for (uint32_t i = 0; i < count; ++i) {
      if (candidates[i].chosen) chosen.push_back(i);
    }
    executor.ForEach(chosen.size(), 1, [&](size_t i) {
      Candidate& c = candidates[chosen[i]];
      c.record = source.Gather(c.receiver, cache->grid_, HashKey(params.seed, kKeyGather, c.key));
    });
    for (const uint32_t i : chosen) {
      const Candidate& c = candidates[i];
      cache->Insert(c.record, cache->RadiusOf(c.record, c.footprint_m));
    }
    counts.records += chosen.size();
    counts.samples += chosen.size() * uint64_t{cache->grid_.size()};
  }
  // Clamping has made spheres smaller: the tree for the receivers is made of what they became.
  CacheOctree octree(bounds);
  for (GatherRecord& record : cache->records_) record.reach_m *= params.spread;
  for (uint32_t id = 0; id < cache->records_.size(); ++id) {
    octree.Insert(id, cache->records_[id].position, cache->records_[id].reach_m);
  }
  cache->octree_ = std::move(octree);
  cache->gradients_ = {};
  return cache;
}

CachedIrradiance IrradianceCache::Interpolate(const Vec3f& x, const Vec3f& n) const {
  CachedIrradiance out;
  octree_.AtPoint(x, [&](uint32_t id) { Accumulate(records_[id], x, n, out); });
  Finish(out);
  return out;
}

GatherRecord IrradianceCache::MakeOwnRecord(const Receiver& receiver, float footprint_m,
                                            uint64_t key) const {
  GatherRecord record = source_.Gather(receiver, grid_, HashKey(params_.seed, kKeyOwn, key));
  SetReach(RadiusOf(record, footprint_m), record);
  return record;
}

}  // namespace farpoint

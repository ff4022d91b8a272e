#include "core/pbgi/receiver_hierarchy.h"

#include <algorithm>
#include <cmath>
#include <limits>

#include "core/math/elementary.h"
#include "core/math/sampling.h"
#include "core/math/simd8.h"

namespace farpoint {

namespace {

// A surface seen at a slant spans more than a pixel's footprint from pixel to pixel.
constexpr float kSlantedFootprints = 4.0f;
// Of the bound that a record's place above a receiver's plane sets. Of 1 and 2, rr: macross 0.102,
// 0.084, Sponza 0.055, 0.057 (none: 0.106, 0.061), records +6 %, +15 %.
constexpr float kAboveScale = 2.0f;
// Keys of independent random choices.
enum : uint64_t { kKeyJitter = 21, kKeyGather = 22 };

struct alignas(32) Lanes {
  float x[8], y[8], z[8], nx[8], ny[8], nz[8], px[8], py[8];
};

}  // namespace

void BlendRecords(std::span<const ScreenRecord* const> records,
                  std::span<const ServedReceiver> receivers, std::span<Rgb> irradiance,
                  std::span<float> weight, std::span<std::array<float, 8>> shares) {
  Lanes lanes;
  const size_t count = receivers.size();
  for (size_t i = 0; i < 8; ++i) {
    const ServedReceiver& r = receivers[std::min(i, count - 1)];
    lanes.x[i] = r.receiver->position.x;
    lanes.y[i] = r.receiver->position.y;
    lanes.z[i] = r.receiver->position.z;
    lanes.nx[i] = r.receiver->normal.x;
    lanes.ny[i] = r.receiver->normal.y;
    lanes.nz[i] = r.receiver->normal.z;
    lanes.px[i] = r.x_px;
    lanes.py[i] = r.y_px;
  }
  const F8 x = Load8(lanes.x), y = Load8(lanes.y), z = Load8(lanes.z);
  const F8 nx = Load8(lanes.nx), ny = Load8(lanes.ny), nz = Load8(lanes.nz);
  const F8 px = Load8(lanes.px), py = Load8(lanes.py);
  const F8 zero = Set8(0.0f), one = Set8(1.0f);

  // What reaches the receivers, and the finest scale that it tells of.
  struct Term {
    F8 away;    // |x - c| + |(x - c)·(n + n_c)|, metres
    F8 rest;    // 1 - sqrt((1 - n·n_c) / kNormalTolerance)
    F8 screen;  // 1 - |p - p_c|² / ρ²
    size_t record;
  };
  thread_local AlignedVector<Term> terms;
  terms.clear();
  F8 finest = zero;
  for (size_t k = 0; k < records.size(); ++k) {
    const GatherRecord& g = records[k]->gather;
    const F8 du = px - Set8(records[k]->x_px), dv = py - Set8(records[k]->y_px);
    const float inverse_screen = 1.0f / (records[k]->screen_reach_px * records[k]->screen_reach_px);
    const F8 screen = one - (du * du + dv * dv) * Set8(inverse_screen);
    if (Bits8(screen > zero) == 0) continue;
    const F8 dx = x - Set8(g.position.x), dy = y - Set8(g.position.y), dz = z - Set8(g.position.z);
    const F8 distance = Sqrt8(dx * dx + dy * dy + dz * dz);
    const F8 cosine = nx * Set8(g.normal.x) + ny * Set8(g.normal.y) + nz * Set8(g.normal.z);
    const F8 turned = Sqrt8(Max8(one - cosine, zero) * Set8(1.0f / kNormalTolerance));
    // How far off the mean tangent plane: what lies before or behind another surface sees
    // something else.
    const F8 off = Abs8(dx * (nx + Set8(g.normal.x)) + dy * (ny + Set8(g.normal.y)) +
                        dz * (nz + Set8(g.normal.z)));
    // The record's own place is a surface: how far above the receiver's plane, over the distance²
    // (both underflow only where they mean nothing).
    const F8 above = Max8(zero - (dx * nx + dy * ny + dz * nz), zero);
    const F8 apart = Max8(distance * distance, Set8(std::numeric_limits<float>::min()));
    finest = Max8(finest, Set8(kAboveScale) * above / apart * Max8(screen, zero));
    const F8 inverse_reach = Set8(1.0f / g.reach_m);
    const F8 away = distance + off;
    const F8 w = one - away * inverse_reach - turned;
    if (Bits8((w > zero) & (screen > zero)) == 0) continue;
    finest = Max8(finest, Max8(w, zero) * Max8(screen, zero) * inverse_reach);
    terms.push_back({away, one - turned, screen, k});
  }

  for (auto& share : shares) share.fill(0.0f);
  // Where the bound leaves nothing, it is lifted.
  F8 left = zero;
  for (const Term& term : terms) {
    const F8 inverse_reach = Set8(1.0f / records[term.record]->gather.reach_m);
    const F8 w = term.rest - term.away * Max8(inverse_reach, finest);
    left = Max8(left, Select8(term.screen > zero, w, zero));
  }
  finest = Select8(left > zero, finest, zero);
  F8 sum[3] = {zero, zero, zero}, weights = zero;
  for (const Term& term : terms) {
    const GatherRecord& g = records[term.record]->gather;
    F8 w = term.rest - term.away * Max8(Set8(1.0f / g.reach_m), finest);
    const M8 in = (w > zero) & (term.screen > zero);
    if (Bits8(in) == 0) continue;
    w = Select8(in, w * w * term.screen * term.screen, zero);
    if (!shares.empty()) {
      for (size_t i = 0; i < 8; ++i) shares[term.record][i] = w[i];
    }
    const F8 dx = x - Set8(g.position.x), dy = y - Set8(g.position.y), dz = z - Set8(g.position.z);
    const F8 tx = nx - Set8(g.normal.x), ty = ny - Set8(g.normal.y), tz = nz - Set8(g.normal.z);
    weights += w;
    for (int c = 0; c < 3; ++c) {
      const float e = g.irradiance[c];
      const F8 low = Set8(-0.5f * e), high = Set8(e);
      F8 carried =
          dx * Set8(g.gradient[c].x) + dy * Set8(g.gradient[c].y) + dz * Set8(g.gradient[c].z);
      carried = Min8(Max8(carried, low), high);
      const F8 turn =
          tx * Set8(g.vector[c].x) + ty * Set8(g.vector[c].y) + tz * Set8(g.vector[c].z);
      carried += Min8(Max8(turn, low), high);
      sum[c] += w * Max8(Set8(e) + carried, zero);
    }
  }
  for (size_t i = 0; i < count; ++i) {
    weight[i] = left[i] > 0.0f ? weights[i] : 0.0f;
    const float inverse = weights[i] > 0.0f ? 1.0f / weights[i] : 0.0f;
    irradiance[i] = Rgb(sum[0][i], sum[1][i], sum[2][i]) * inverse;
  }
}

ReceiverHierarchy::ReceiverHierarchy(const HierarchyParams& params, const PixelRect& frame,
                                     const RecordSource& source)
    : params_(params), frame_(frame), source_(source) {
  for (uint32_t s = params.coarsest_px; s >= 1; s /= 2) {
    const double share =
        DetPow(static_cast<double>(s) / params.coarsest_px, static_cast<double>(params.fall_off));
    levels_.push_back(std::make_unique<Level>(
        static_cast<int>(s),
        std::max(params.least_samples, static_cast<uint32_t>(share * params.coarsest_samples))));
  }
}

std::shared_ptr<const ReceiverHierarchy::View> ReceiverHierarchy::Prepare(
    const PixelRect& rect, Executor& executor, const std::function<bool(double)>& go_on,
    Counts& counts) const {
  auto view = std::make_shared<View>();
  // How far beyond `rect` records matter: their own influence, and that of all finer levels, whose
  // records depend on them.
  std::vector<int> margin(levels_.size());
  float sum = 1;
  for (size_t l = levels_.size(); l-- > 0;) {
    sum += kScreenReach * static_cast<float>(levels_[l]->spacing);
    margin[l] = static_cast<int>(sum) + 1;
  }
  for (size_t l = 0; l < levels_.size(); ++l) {
    Level& level = *levels_[l];
    const int s = level.spacing;
    const int m = margin[l];
    const PixelRect region =
        PixelRect{rect.x0 - m, rect.y0 - m, rect.x1 + m, rect.y1 + m}.Intersect(frame_);
    View::Grid grid;
    grid.spacing = s;
    grid.x0 = region.x0 / s;
    grid.y0 = region.y0 / s;
    grid.columns = (region.x1 - 1) / s - grid.x0 + 1;
    grid.rows = (region.y1 - 1) / s - grid.y0 + 1;
    const size_t cells = static_cast<size_t>(grid.columns) * static_cast<size_t>(grid.rows);
    grid.records.resize(cells);
    const auto key_of = [&](size_t cell) {
      const uint64_t x = static_cast<uint64_t>(grid.x0) + cell % static_cast<size_t>(grid.columns);
      const uint64_t y = static_cast<uint64_t>(grid.y0) + cell / static_cast<size_t>(grid.columns);
      return y << 32 | x;
    };
    std::vector<uint32_t> missing;
    {
      const std::lock_guard lock(level.mutex);
      for (uint32_t c = 0; c < cells; ++c) {
        const auto it = level.records.find(key_of(c));
        if (it != level.records.end()) {
          grid.records[c] = it->second;
        } else {
          missing.push_back(c);
        }
      }
    }

    // Who needs a record …
    struct Candidate {
      bool chosen = false;
      Receiver receiver;
      float x_px = 0, y_px = 0;
      float footprint_m = 0;
      float most_reach_m = std::numeric_limits<float>::infinity();  // by coarser neighbours
    };
    std::vector<Candidate> candidates(missing.size());
    executor.ForEachPiece(missing.size(), 64, [&](size_t begin, size_t end) {
      std::vector<const ScreenRecord*> near;
      for (size_t i = begin; i < end; ++i) {
        const uint64_t key = key_of(missing[i]);
        const uint64_t jitter = HashKey(params_.seed, kKeyJitter, key, static_cast<uint64_t>(s));
        const uint64_t side = static_cast<uint64_t>(s);
        const int x = static_cast<int>((key & 0xffffffffu) * side + jitter % side);
        const int y = static_cast<int>((key >> 32) * side + (jitter >> 32) % side);
        if (!frame_.Contains(x, y)) continue;
        Candidate& c = candidates[i];
        if (!source_.ReceiverAt(x, y, c.receiver, c.footprint_m)) continue;
        c.x_px = static_cast<float>(x) + 0.5f;
        c.y_px = static_cast<float>(y) + 0.5f;
        c.chosen = true;
        if (l == 0) continue;
        near.clear();
        view->Collect({x, y, x + 1, y + 1}, near);
        const ServedReceiver served{&c.receiver, c.x_px, c.y_px};
        Rgb irradiance;
        float weight;
        BlendRecords(near, {&served, 1}, {&irradiance, 1}, {&weight, 1});
        c.chosen = !(weight >= params_.enough);
        for (const ScreenRecord* r : near) {
          c.most_reach_m = std::min(
              c.most_reach_m, r->gather.reach_m + Length(r->gather.position - c.receiver.position));
        }
      }
    });
    counts.candidates += missing.size();

    // … gets one.
    std::vector<uint32_t> made;
    for (uint32_t i = 0; i < missing.size(); ++i) {
      if (candidates[i].chosen) made.push_back(i);
    }
    std::atomic<bool> stopped{false};
    std::atomic<size_t> done{0};
    executor.ForEach(made.size(), 1, [&](size_t i) {
      if (stopped.load(std::memory_order_relaxed)) return;
      const Candidate& c = candidates[made[i]];
      const uint32_t cell = missing[made[i]];
      auto record = std::make_shared<ScreenRecord>();
      record->x_px = c.x_px;
      record->y_px = c.y_px;
      record->screen_reach_px = kScreenReach * static_cast<float>(s);
      GatherRecord& g = record->gather;
      g = source_.Gather(c.receiver, level.grid,
                         HashKey(params_.seed, kKeyGather, key_of(cell), static_cast<uint64_t>(s)));
      SetReach(c.footprint_m, c.most_reach_m, *record);
      grid.records[cell] = std::move(record);
      const double part = static_cast<double>(++done) / static_cast<double>(made.size());
      if (go_on && !go_on((static_cast<double>(l) + part) / static_cast<double>(levels_.size()))) {
        stopped = true;
      }
    });
    if (stopped) return nullptr;
    counts.records += made.size();
    counts.samples += made.size() * uint64_t{level.grid.size()};
    {
      const std::lock_guard lock(level.mutex);
      if (level.records.size() + made.size() > kKeptRecords) level.records.clear();
      for (const uint32_t i : made) {
        level.records.try_emplace(key_of(missing[i]), grid.records[missing[i]]);
      }
    }
    view->grids_.push_back(std::move(grid));
  }
  return view;
}

ScreenRecord ReceiverHierarchy::MakeOwnRecord(const ServedReceiver& receiver, float footprint_m,
                                              uint64_t key) const {
  ScreenRecord record;
  record.x_px = receiver.x_px;
  record.y_px = receiver.y_px;
  record.screen_reach_px = kScreenReach;
  record.gather = source_.Gather(*receiver.receiver, levels_.back()->grid,
                                 HashKey(params_.seed, kKeyGather, key, 0));
  SetReach(footprint_m, std::numeric_limits<float>::infinity(), record);
  return record;
}

void ReceiverHierarchy::SetReach(float footprint_m, float most_reach_m,
                                 ScreenRecord& record) const {
  GatherRecord& g = record.gather;
  // Beyond its reach in the image a record weighs nothing; the bound keeps reaches finite.
  float reach = std::min(params_.reach * g.harmonic_distance_m,
                         kSlantedFootprints * record.screen_reach_px * footprint_m);
  for (int c = 0; c < 3; ++c) {
    const float slope = Length(g.gradient[c]);
    if (slope > 0.0f) reach = std::min(reach, 0.5f * g.irradiance[c] / slope);
  }
  reach = std::min(reach, most_reach_m);
  // Where something is nearer than the floor, a floor that high would carry the dark of a crevice
  // out of it.
  const float floor =
      std::min(params_.floor_px * footprint_m, std::max(footprint_m, g.harmonic_distance_m));
  if (!(reach >= floor)) {
    const float scale = floor > 0.0f ? std::max(reach, 0.0f) / floor : 0.0f;
    for (Vec3f& slope : g.gradient) slope *= scale;
    reach = floor;
  }
  g.reach_m = std::max(reach, std::numeric_limits<float>::min());  // of a camera on a surface
}

void ReceiverHierarchy::View::Collect(const PixelRect& rect,
                                      std::vector<const ScreenRecord*>& out) const {
  for (const Grid& grid : grids_) {
    const float s = static_cast<float>(grid.spacing);
    const float reach = kScreenReach * s;
    const int x0 =
        std::max(grid.x0, static_cast<int>(std::floor((static_cast<float>(rect.x0) - reach) / s)));
    const int y0 =
        std::max(grid.y0, static_cast<int>(std::floor((static_cast<float>(rect.y0) - reach) / s)));
    const int x1 =
        std::min(grid.x0 + grid.columns - 1,
                 static_cast<int>(std::floor((static_cast<float>(rect.x1) + reach) / s)));
    const int y1 =
        std::min(grid.y0 + grid.rows - 1,
                 static_cast<int>(std::floor((static_cast<float>(rect.y1) + reach) / s)));
    for (int y = y0; y <= y1; ++y) {
      for (int x = x0; x <= x1; ++x) {
        const auto& record =
            grid.records[static_cast<size_t>(y - grid.y0) * static_cast<size_t>(grid.columns) +
                         static_cast<size_t>(x - grid.x0)];
        if (!record) continue;
        // Distance from the record to the rectangle.
        const float dx = std::max({static_cast<float>(rect.x0) - record->x_px, 0.0f,
                                   record->x_px - static_cast<float>(rect.x1)});
        const float dy = std::max({static_cast<float>(rect.y0) - record->y_px, 0.0f,
                                   record->y_px - static_cast<float>(rect.y1)});
        if (dx * dx + dy * dy < record->screen_reach_px * record->screen_reach_px) {
          out.push_back(record.get());
        }
      }
    }
  }
}

}  // namespace farpoint

#include "core/pbgi/receiver_hierarchy.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <utility>

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
// Of a world cell, at most, in a spacing's footprints.
constexpr float kCellSide = 1.2f;
// Levels of the pixels themselves: the records of the first tell the second where light changes.
constexpr int kPixelLevels = 2;
// Receivers within a square of so many pixels look through the same records.
constexpr int kSquare = 8;

PixelRect Grown(const PixelRect& r, int by) { return {r.x0 - by, r.y0 - by, r.x1 + by, r.y1 + by}; }
float ReachOf(int spacing) {
  return std::max(kLeastScreenReach, kScreenReach * static_cast<float>(spacing));
}
int FloorDiv(int a, int b) { return a >= 0 ? a / b : -((b - 1 - a) / b); }

struct alignas(32) Lanes {
  float x[8], y[8], z[8], nx[8], ny[8], nz[8], px[8], py[8];
};

}  // namespace

void BlendRecords(std::span<const ScreenRecord* const> records,
                  std::span<const ServedReceiver> receivers, std::span<Rgb> irradiance,
                  std::span<float> weight, std::span<BlendSpread> spread,
                  std::span<std::array<float, 8>> shares, std::span<float> openness) {
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
  F8 sum[3] = {zero, zero, zero}, weights = zero, grey = zero, squares = zero;
  F8 open = zero, open_squares = zero;
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
    F8 own = zero;
    for (int c = 0; c < 3; ++c) {
      const float e = g.irradiance[c];
      const F8 low = Set8(-0.5f * e), high = Set8(e);
      F8 carried =
          dx * Set8(g.gradient[c].x) + dy * Set8(g.gradient[c].y) + dz * Set8(g.gradient[c].z);
      carried = Min8(Max8(carried, low), high);
      const F8 turn =
          tx * Set8(g.vector[c].x) + ty * Set8(g.vector[c].y) + tz * Set8(g.vector[c].z);
      carried += Min8(Max8(turn, low), high);
      const F8 at = Max8(Set8(e) + carried, zero);
      own += at;
      sum[c] += w * at;
    }
    grey += w * own;
    squares += w * own * own;
    if (!openness.empty()) {
      const F8 low = Set8(-0.5f * g.openness), high = Set8(g.openness);
      const F8 moved = dx * Set8(g.open_gradient.x) + dy * Set8(g.open_gradient.y) +
                       dz * Set8(g.open_gradient.z);
      // What the turn reveals beyond the record's horizon is as open as the rest: so a sphere under
      // nothing but sky is as bright everywhere.
      const F8 cosine = nx * Set8(g.normal.x) + ny * Set8(g.normal.y) + nz * Set8(g.normal.z);
      const F8 turn = tx * Set8(g.open_vector.x) + ty * Set8(g.open_vector.y) +
                      tz * Set8(g.open_vector.z) + Set8(g.openness) * (one - cosine);
      const F8 at = Set8(g.openness) + Min8(Max8(moved, low), high) + Min8(Max8(turn, low), high);
      const F8 bounded = Min8(Max8(at, zero), Set8(kPif));
      open += w * bounded;
      open_squares += w * bounded * bounded;
    }
  }
  for (size_t i = 0; i < count; ++i) {
    weight[i] = left[i] > 0.0f ? weights[i] : 0.0f;
    const float inverse = weights[i] > 0.0f ? 1.0f / weights[i] : 0.0f;
    irradiance[i] = Rgb(sum[0][i], sum[1][i], sum[2][i]) * inverse;
    if (!openness.empty()) openness[i] = open[i] * inverse;
    if (!spread.empty()) {
      const auto deviation = [&](float sum_of, float squares_of) {
        const float m = sum_of * inverse;
        return std::sqrt(std::max(0.0f, squares_of * inverse - m * m));
      };
      spread[i] = {deviation(grey[i], squares[i]) / 3, deviation(open[i], open_squares[i])};
    }
  }
}

ReceiverHierarchy::ReceiverHierarchy(const HierarchyParams& params, const PixelRect& frame,
                                     const PlaceSource& source)
    : params_(params), frame_(frame), source_(source) {
  const auto samples = [&](uint32_t s) {
    const double share =
        DetPow(static_cast<double>(s) / params.coarsest_px, static_cast<double>(params.fall_off));
    return std::max(params.least_samples, static_cast<uint32_t>(share * params.coarsest_samples));
  };
  for (uint32_t s = params.coarsest_px; s > 1; s /= 2) {
    levels_.push_back(std::make_unique<Level>(static_cast<int>(s), true, samples(s)));
  }
  for (int i = 0; i < kPixelLevels; ++i) {
    levels_.push_back(std::make_unique<Level>(1, false, samples(1)));
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
    sum += ReachOf(levels_[l]->spacing);
    margin[l] = static_cast<int>(sum) + 1;
  }
  // Every pixel is a candidate on the last levels.
  struct PixelReceivers {
    PixelRect rect;
    std::vector<ReceiverPlace> places;  // row by row; footprint_m < 0: background
  } pixels;
  const auto pixel_receiver = [&](int x, int y, ReceiverPlace& place) {
    if (pixels.rect.Contains(x, y)) {
      place = pixels.places[static_cast<size_t>(y - pixels.rect.y0) *
                                static_cast<size_t>(pixels.rect.width()) +
                            static_cast<size_t>(x - pixels.rect.x0)];
      return place.footprint_m >= 0;
    }
    return source_.ReceiverAt(x, y, place.receiver, place.footprint_m);
  };
  for (size_t l = 0; l < levels_.size(); ++l) {
    Level& level = *levels_[l];
    const int s = level.spacing;
    const PixelRect region = Grown(rect, margin[l]);
    const auto in_region = [&](float x, float y) {
      return x >= static_cast<float>(region.x0) && x < static_cast<float>(region.x1) &&
             y >= static_cast<float>(region.y0) && y < static_cast<float>(region.y1);
    };

    // The cells that candidates lie in, and who proposes them.
    struct Item {
      WorldCell cell;
      ReceiverPlace place;  // of the candidate first, of the cell's own place then
      bool known = false, wanted = false, chosen = false, decided = false;
      uint32_t first = 0, end = 0;  // its proposers
      std::shared_ptr<const ScreenRecord> record;
    };
    const int c = level.anchored ? std::max(1, s / 2) : 1;  // spacing of candidates
    const int shift = level.anchored ? static_cast<int>(kMostShift * static_cast<float>(s)) + 1 : 0;
    const PixelRect asked = Grown(region, shift).Intersect(frame_);
    const int x0 = asked.x0 / c, y0 = asked.y0 / c;
    const int columns = (asked.x1 - 1) / c - x0 + 1, rows = (asked.y1 - 1) / c - y0 + 1;
    struct Candidate {
      WorldCell cell;
      ReceiverPlace place;
      bool seen = false;
    };
    std::vector<Candidate> candidates(static_cast<size_t>(columns) * static_cast<size_t>(rows));
    // The first of the levels that look at every pixel looks at the largest part of the frame.
    const bool keep = c == 1 && pixels.places.empty();
    std::vector<ReceiverPlace> kept_pixels(keep ? candidates.size() : 0);
    executor.ForEachPiece(candidates.size(), 64, [&](size_t begin, size_t end) {
      for (size_t i = begin; i < end; ++i) {
        const uint64_t column = static_cast<uint64_t>(x0) + i % static_cast<size_t>(columns);
        const uint64_t row = static_cast<uint64_t>(y0) + i / static_cast<size_t>(columns);
        const uint64_t side = static_cast<uint64_t>(c);
        const uint64_t jitter = HashKey(params_.seed, kKeyJitter, row << 32 | column, side);
        const int x = static_cast<int>(column * side + jitter % side);
        const int y = static_cast<int>(row * side + (jitter >> 32) % side);
        if (!frame_.Contains(x, y)) continue;
        Candidate& candidate = candidates[i];
        ReceiverPlace& place = candidate.place;
        const bool hit = pixel_receiver(x, y, place);
        if (keep) {
          ReceiverPlace& kept = kept_pixels[i];
          if (hit) {
            kept = place;
          } else {
            kept.footprint_m = -1;
          }
        }
        if (!hit) continue;
        place.x_px = static_cast<float>(x) + 0.5f;
        place.y_px = static_cast<float>(y) + 0.5f;
        candidate.seen = true;
        if (level.anchored) {
          candidate.cell = CellOf(
              place.receiver, kCellSide * static_cast<float>(s) * place.footprint_m, params_.seed);
        } else {
          candidate.cell.i = x;
          candidate.cell.j = y;
        }
      }
    });
    counts.candidates += candidates.size();
    if (keep) pixels = {asked, std::move(kept_pixels)};
    std::erase_if(candidates, [](const Candidate& candidate) { return !candidate.seen; });
    std::stable_sort(candidates.begin(), candidates.end(),
                     [](const Candidate& a, const Candidate& b) { return a.cell < b.cell; });
    std::vector<Item> items;
    for (uint32_t i = 0; i < candidates.size(); ++i) {
      if (i == 0 || !(candidates[i].cell == candidates[i - 1].cell)) {
        Item& item = items.emplace_back();
        item.cell = candidates[i].cell;
        item.place = candidates[i].place;
        item.first = i;
      }
      items.back().end = i + 1;
    }
    {
      const std::lock_guard lock(level.mutex);
      for (Item& item : items) {
        const auto it = level.records.find(item.cell);
        if (it == level.records.end()) continue;
        item.known = true;
        item.record = it->second;
      }
    }

    // Whose place counts …
    executor.ForEachPiece(items.size(), 16, [&](size_t begin, size_t end) {
      for (size_t i = begin; i < end; ++i) {
        Item& item = items[i];
        ReceiverPlace& place = item.place;
        if (item.known) {
          if (!item.record) continue;
          place.x_px = item.record->x_px;
          place.y_px = item.record->y_px;
        } else if (level.anchored &&
                   !source_.ReceiverAlong(ProbeOf(item.cell, params_.seed), place)) {
          item.decided = true;
          continue;
        }
        if (!in_region(place.x_px, place.y_px)) continue;
        if (level.anchored) {
          const float most = kMostShift * static_cast<float>(s);
          const bool close = std::any_of(candidates.begin() + item.first,
                                         candidates.begin() + item.end, [&](const Candidate& by) {
                                           const float dx = by.place.x_px - place.x_px,
                                                       dy = by.place.y_px - place.y_px;
                                           return dx * dx + dy * dy <= most * most;
                                         });
          if (!close) continue;
        }
        item.wanted = true;
        item.chosen = !item.known && l == 0;
      }
    });

    // … and is served too badly …
    struct Doubtful {
      uint64_t square;
      uint32_t item;
    };
    std::vector<Doubtful> doubtful;
    const auto pixel_of = [](float at) { return static_cast<int>(std::floor(at)); };
    const auto square_of = [&](float at, int first) {
      return static_cast<uint32_t>((pixel_of(at) - first) / kSquare);
    };
    for (uint32_t i = 0; i < items.size() && l > 0; ++i) {
      const ReceiverPlace& place = items[i].place;
      if (!items[i].wanted || items[i].known) continue;
      doubtful.push_back(
          {uint64_t{square_of(place.y_px, region.y0)} << 32 | square_of(place.x_px, region.x0), i});
    }
    std::sort(doubtful.begin(), doubtful.end(), [](const Doubtful& a, const Doubtful& b) {
      return a.square != b.square ? a.square < b.square : a.item < b.item;
    });
    std::vector<uint32_t> squares;  // their first
    for (uint32_t i = 0; i < doubtful.size(); ++i) {
      if (i == 0 || doubtful[i].square != doubtful[i - 1].square) squares.push_back(i);
    }
    squares.push_back(static_cast<uint32_t>(doubtful.size()));
    executor.ForEachPiece(squares.size() - 1, 1, [&](size_t begin, size_t end) {
      std::vector<const ScreenRecord*> near;
      for (size_t q = begin; q < end; ++q) {
        near.clear();
        const uint64_t square = doubtful[squares[q]].square;
        const int x = region.x0 + kSquare * static_cast<int>(square & 0xffffffffu);
        const int y = region.y0 + kSquare * static_cast<int>(square >> 32);
        view->Collect({x, y, x + kSquare, y + kSquare}, near);
        for (uint32_t at = squares[q]; at < squares[q + 1]; at += 8) {
          const size_t count = std::min<size_t>(8, squares[q + 1] - at);
          ServedReceiver served[8];
          for (size_t i = 0; i < count; ++i) {
            const ReceiverPlace& place = items[doubtful[at + i].item].place;
            served[i] = {&place.receiver, place.x_px, place.y_px};
          }
          Rgb irradiance[8];
          float weight[8], openness[8];
          BlendSpread spread[8];
          BlendRecords(near, {served, count}, {irradiance, count}, {weight, count}, {spread, count},
                       {}, {openness, params_.spread_open > 0 ? count : 0});
          const auto above = [](float value, float most) { return most > 0 && value > most; };
          for (size_t i = 0; i < count; ++i) {
            Item& item = items[doubtful[at + i].item];
            item.chosen = !(weight[i] >= params_.enough) ||
                          above(spread[i].irradiance, params_.spread_wm2) ||
                          above(spread[i].openness, params_.spread_open);
            item.decided = !item.chosen && level.anchored;
          }
        }
      }
    });

    // … gets one.
    std::vector<uint32_t> made;
    for (uint32_t i = 0; i < items.size(); ++i) {
      if (items[i].chosen) made.push_back(i);
    }
    std::atomic<bool> stopped{false};
    std::atomic<size_t> done{0};
    executor.ForEach(made.size(), 1, [&](size_t i) {
      if (stopped.load(std::memory_order_relaxed)) return;
      Item& item = items[made[i]];
      // By coarser neighbours.
      float most_reach_m = std::numeric_limits<float>::infinity();
      std::vector<const ScreenRecord*> near;
      const int x = pixel_of(item.place.x_px), y = pixel_of(item.place.y_px);
      view->Collect({x, y, x + 1, y + 1}, near);
      for (const ScreenRecord* r : near) {
        most_reach_m =
            std::min(most_reach_m,
                     r->gather.reach_m + Length(r->gather.position - item.place.receiver.position));
      }
      auto record = std::make_shared<ScreenRecord>();
      record->x_px = item.place.x_px;
      record->y_px = item.place.y_px;
      record->screen_reach_px = ReachOf(s);
      GatherRecord& g = record->gather;
      // A pixel's record has the key of its place, too.
      const WorldCell cell =
          level.anchored ? item.cell
                         : CellOf(item.place.receiver, item.place.footprint_m, params_.seed);
      g = source_.Gather(item.place.receiver, level.grid,
                         HashKey(HashOf(cell, params_.seed), kKeyGather, static_cast<uint64_t>(l)));
      SetReach(item.place.footprint_m, most_reach_m, *record);
      item.record = std::move(record);
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
      if (level.records.size() + items.size() > kKeptRecords) level.records.clear();
      for (const Item& item : items) {
        if (item.chosen || item.decided) level.records.try_emplace(item.cell, item.record);
      }
    }

    // In bins; within a bin in the order of the cells.
    View::Grid grid;
    grid.spacing = s;
    grid.x0 = FloorDiv(region.x0, s);
    grid.y0 = FloorDiv(region.y0, s);
    grid.columns = FloorDiv(region.x1 - 1, s) - grid.x0 + 1;
    grid.rows = FloorDiv(region.y1 - 1, s) - grid.y0 + 1;
    const auto bin_of = [&](const ScreenRecord& r) {
      const int x = FloorDiv(static_cast<int>(std::floor(r.x_px)), s) - grid.x0;
      const int y = FloorDiv(static_cast<int>(std::floor(r.y_px)), s) - grid.y0;
      return static_cast<size_t>(y) * static_cast<size_t>(grid.columns) + static_cast<size_t>(x);
    };
    grid.first.assign(static_cast<size_t>(grid.columns) * static_cast<size_t>(grid.rows) + 1, 0);
    uint32_t records = 0;
    for (const Item& item : items) {
      if (!item.wanted || !item.record) continue;
      ++grid.first[bin_of(*item.record) + 1];
      ++records;
    }
    for (size_t i = 1; i < grid.first.size(); ++i) grid.first[i] += grid.first[i - 1];
    grid.records.resize(records);
    std::vector<uint32_t> at(grid.first.begin(), grid.first.end() - 1);
    for (const Item& item : items) {
      if (item.wanted && item.record) grid.records[at[bin_of(*item.record)]++] = item.record;
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
  record.screen_reach_px = ReachOf(1);
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
  if (const float slope = Length(g.open_gradient); slope > 0.0f) {
    reach = std::min(reach, 0.5f * g.openness / slope);
  }
  reach = std::min(reach, most_reach_m);
  // Where something is nearer than the floor, a floor that high would carry the dark of a crevice
  // out of it.
  const float floor =
      std::min(params_.floor_px * footprint_m, std::max(footprint_m, g.harmonic_distance_m));
  if (!(reach >= floor)) {
    const float scale = floor > 0.0f ? std::max(reach, 0.0f) / floor : 0.0f;
    for (Vec3f& slope : g.gradient) slope *= scale;
    g.open_gradient *= scale;
    reach = floor;
  }
  g.reach_m = std::max(reach, std::numeric_limits<float>::min());  // of a camera on a surface
}

void ReceiverHierarchy::View::Collect(const PixelRect& rect,
                                      std::vector<const ScreenRecord*>& out) const {
  for (const Grid& grid : grids_) {
    const float s = static_cast<float>(grid.spacing);
    const float reach = ReachOf(grid.spacing);
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
    for (int y = y0; y <= y1 && x0 <= x1; ++y) {
      const size_t row = static_cast<size_t>(y - grid.y0) * static_cast<size_t>(grid.columns);
      const uint32_t end = grid.first[row + static_cast<size_t>(x1 - grid.x0) + 1];
      for (uint32_t i = grid.first[row + static_cast<size_t>(x0 - grid.x0)]; i < end; ++i) {
        const auto& record = grid.records[i];
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

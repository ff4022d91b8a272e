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
int PixelOf(float at) { return static_cast<int>(std::floor(at)); }

// Indices 0 … count - 1 by bin, ascending within one: those of bin b are order[first[b]] …
// order[first[b + 1] - 1].
template <typename BinOf>
void CountingSort(size_t count, size_t bins, const BinOf& bin_of, std::vector<uint32_t>& first,
                  std::vector<uint32_t>& order) {
  first.assign(bins + 1, 0);
  for (size_t i = 0; i < count; ++i) ++first[bin_of(i) + 1];
  for (size_t b = 0; b < bins; ++b) first[b + 1] += first[b];
  order.resize(count);
  std::vector<uint32_t> at(first.begin(), first.end() - 1);
  for (size_t i = 0; i < count; ++i) order[at[bin_of(i)]++] = static_cast<uint32_t>(i);
}

struct alignas(32) Lanes {
  float x[8], y[8], z[8], nx[8], ny[8], nz[8], px[8], py[8];
};

}  // namespace

void BlendRecords(std::span<const ScreenRecord* const> records,
                  std::span<const ServedReceiver> receivers, std::span<Rgb> irradiance,
                  std::span<float> weight, std::span<BlendSpread> spread,
                  std::span<std::array<float, 8>> shares, std::span<float> openness,
                  std::span<float> unhidden) {
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
  F8 open = zero, open_squares = zero, clear = zero;
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
    const auto carried = [&](float value, const Vec3f& gradient, const Vec3f& vector) {
      const F8 low = Set8(-0.5f * value), high = Set8(value);
      const F8 moved = dx * Set8(gradient.x) + dy * Set8(gradient.y) + dz * Set8(gradient.z);
      // What the turn reveals beyond the record's horizon is as open as the rest: so a sphere under
      // nothing but sky is as bright everywhere.
      const F8 cosine = nx * Set8(g.normal.x) + ny * Set8(g.normal.y) + nz * Set8(g.normal.z);
      const F8 turn = tx * Set8(vector.x) + ty * Set8(vector.y) + tz * Set8(vector.z) +
                      Set8(value) * (one - cosine);
      const F8 at = Set8(value) + Min8(Max8(moved, low), high) + Min8(Max8(turn, low), high);
      return Min8(Max8(at, zero), Set8(kPif));
    };
    if (!openness.empty()) {
      const F8 bounded = carried(g.openness, g.open_gradient, g.open_vector);
      open += w * bounded;
      open_squares += w * bounded * bounded;
    }
    if (!unhidden.empty()) {
      clear += w * carried(g.unhidden, g.unhidden_gradient, g.unhidden_vector);
    }
  }
  for (size_t i = 0; i < count; ++i) {
    weight[i] = left[i] > 0.0f ? weights[i] : 0.0f;
    const float inverse = weights[i] > 0.0f ? 1.0f / weights[i] : 0.0f;
    irradiance[i] = Rgb(sum[0][i], sum[1][i], sum[2][i]) * inverse;
    if (!openness.empty()) openness[i] = open[i] * inverse;
    if (!unhidden.empty()) unhidden[i] = clear[i] * inverse;
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
  for (uint32_t strata = samples(1); strata >= std::max(1u, params.least_samples); strata /= 2) {
    own_grids_.emplace_back(strata);
  }
}

// One call of Prepare.
struct ReceiverHierarchy::Pass {
  const ReceiverHierarchy& hierarchy;
  Executor& executor;
  const std::function<bool(double)>& go_on;
  Counts& counts;
  View view;
  // What the centres of the pixels of a rectangle show, row by row; footprint_m < 0: background.
  PixelRect pixels_rect;
  std::vector<ReceiverPlace> pixels;

  struct Made {
    ReceiverPlace place;
    WorldCell cell;
    std::shared_ptr<const ScreenRecord> record;
  };

  bool Cells(size_t l, const PixelRect& region);
  bool Pixels(size_t l, const PixelRect& region);

  ReceiverPlace PlaceAt(int x, int y) const {
    ReceiverPlace place;
    if (hierarchy.source_.ReceiverAt(x, y, place.receiver, place.footprint_m)) {
      place.x_px = static_cast<float>(x) + 0.5f;
      place.y_px = static_cast<float>(y) + 0.5f;
    } else {
      place.footprint_m = -1;
    }
    return place;
  }
  // From now on pixels.rect holds at least `rect`, which shrinks from level to level.
  void LookAt(const PixelRect& rect) {
    if (rect.empty() || pixels_rect.Intersect(rect) == rect) return;
    pixels_rect = rect;
    pixels.resize(static_cast<size_t>(rect.area()));
    const size_t width = static_cast<size_t>(rect.width());
    executor.ForEachPiece(pixels.size(), 64, [&](size_t begin, size_t end) {
      for (size_t i = begin; i < end; ++i) {
        pixels[i] =
            PlaceAt(rect.x0 + static_cast<int>(i % width), rect.y0 + static_cast<int>(i / width));
      }
    });
  }
  const ReceiverPlace& Pixel(int x, int y) const {
    return pixels[static_cast<size_t>(y - pixels_rect.y0) *
                      static_cast<size_t>(pixels_rect.width()) +
                  static_cast<size_t>(x - pixels_rect.x0)];
  }

  // Which of up to eight places are served too badly by `near`, as bits.
  unsigned ServedBadly(std::span<const ScreenRecord* const> near,
                       std::span<const ReceiverPlace* const> places) const {
    const HierarchyParams& params = hierarchy.params_;
    const size_t count = places.size();
    ServedReceiver served[8];
    for (size_t i = 0; i < count; ++i) {
      served[i] = {&places[i]->receiver, places[i]->x_px, places[i]->y_px};
    }
    Rgb irradiance[8];
    float weight[8], openness[8];
    BlendSpread spread[8];
    BlendRecords(near, {served, count}, {irradiance, count}, {weight, count}, {spread, count}, {},
                 {openness, params.spread_open > 0 ? count : 0});
    const auto above = [](float value, float most) { return most > 0 && value > most; };
    unsigned badly = 0;
    for (size_t i = 0; i < count; ++i) {
      if (!(weight[i] >= params.enough) || above(spread[i].irradiance, params.spread_wm2) ||
          above(spread[i].openness, params.spread_open)) {
        badly |= 1u << i;
      }
    }
    return badly;
  }

  // Gathers the records of level l; false: stopped.
  bool Make(size_t l, std::span<Made> made) {
    const Level& level = *hierarchy.levels_[l];
    std::atomic<bool> stopped{false};
    std::atomic<size_t> done{0};
    executor.ForEach(made.size(), 1, [&](size_t i) {
      if (stopped.load(std::memory_order_relaxed)) return;
      const ReceiverPlace& place = made[i].place;
      // By coarser neighbours.
      float most_reach_m = std::numeric_limits<float>::infinity();
      std::vector<const ScreenRecord*> near;
      const int x = PixelOf(place.x_px), y = PixelOf(place.y_px);
      view.Collect({x, y, x + 1, y + 1}, near);
      for (const ScreenRecord* r : near) {
        most_reach_m = std::min(
            most_reach_m, r->gather.reach_m + Length(r->gather.position - place.receiver.position));
      }
      auto record = std::make_shared<ScreenRecord>();
      record->x_px = place.x_px;
      record->y_px = place.y_px;
      record->screen_reach_px = ReachOf(level.spacing);
      const uint64_t seed = hierarchy.params_.seed;
      record->gather = hierarchy.source_.Gather(
          place.receiver, level.grid,
          HashKey(HashOf(made[i].cell, seed), kKeyGather, static_cast<uint64_t>(l)));
      hierarchy.SetReach(place.footprint_m, most_reach_m, *record);
      made[i].record = std::move(record);
      const double part = static_cast<double>(++done) / static_cast<double>(made.size());
      if (go_on &&
          !go_on((static_cast<double>(l) + part) / static_cast<double>(hierarchy.levels_.size()))) {
        stopped = true;
      }
    });
    counts.records += made.size();
    counts.samples += made.size() * uint64_t{level.grid.size()};
    return !stopped;
  }

  // Adds a level's records to the view, in bins; within a bin in the order of their cells.
  struct Kept {
    WorldCell cell;
    std::shared_ptr<const ScreenRecord> record;
  };
  void Show(const Level& level, const PixelRect& region, std::vector<Kept> kept) {
    const int s = level.spacing;
    View::Grid grid;
    grid.spacing = s;
    grid.x0 = FloorDiv(region.x0, s);
    grid.y0 = FloorDiv(region.y0, s);
    grid.columns = FloorDiv(region.x1 - 1, s) - grid.x0 + 1;
    grid.rows = FloorDiv(region.y1 - 1, s) - grid.y0 + 1;
    const auto bin_of = [&](const Kept& k) {
      const int x = FloorDiv(PixelOf(k.record->x_px), s) - grid.x0;
      const int y = FloorDiv(PixelOf(k.record->y_px), s) - grid.y0;
      return static_cast<size_t>(y) * static_cast<size_t>(grid.columns) + static_cast<size_t>(x);
    };
    const size_t bins = static_cast<size_t>(grid.columns) * static_cast<size_t>(grid.rows);
    std::vector<uint32_t> order;
    CountingSort(
        kept.size(), bins, [&](size_t i) { return bin_of(kept[i]); }, grid.first, order);
    for (size_t bin = 0; bin < bins; ++bin) {
      if (grid.first[bin + 1] - grid.first[bin] < 2) continue;
      std::sort(order.begin() + grid.first[bin], order.begin() + grid.first[bin + 1],
                [&](uint32_t i, uint32_t j) { return kept[i].cell < kept[j].cell; });
    }
    grid.records.reserve(kept.size());
    for (const uint32_t i : order) grid.records.push_back(std::move(kept[i].record));
    view.grids_.push_back(std::move(grid));
  }
};

std::shared_ptr<const ReceiverHierarchy::View> ReceiverHierarchy::Prepare(
    const PixelRect& rect, Executor& executor, const std::function<bool(double)>& go_on,
    Counts& counts) const {
  Pass pass{*this, executor, go_on, counts, {}, {}, {}};
  // How far beyond `rect` records matter: their own influence, and that of all finer levels, whose
  // records depend on them.
  std::vector<int> margin(levels_.size());
  float sum = 1;
  for (size_t l = levels_.size(); l-- > 0;) {
    sum += ReachOf(levels_[l]->spacing);
    margin[l] = static_cast<int>(sum) + 1;
  }
  for (size_t l = 0; l < levels_.size(); ++l) {
    const PixelRect region = Grown(rect, margin[l]);
    if (!(levels_[l]->anchored ? pass.Cells(l, region) : pass.Pixels(l, region))) return nullptr;
  }
  return std::make_shared<View>(std::move(pass.view));
}

bool ReceiverHierarchy::Pass::Cells(size_t l, const PixelRect& region) {
  Level& level = *hierarchy.levels_[l];
  const uint64_t seed = hierarchy.params_.seed;
  const int s = level.spacing;
  const auto in_region = [&](float x, float y) {
    return x >= static_cast<float>(region.x0) && x < static_cast<float>(region.x1) &&
           y >= static_cast<float>(region.y0) && y < static_cast<float>(region.y1);
  };

  // Candidates: what they show and the cells that they lie in.
  const int c = std::max(1, s / 2);  // their spacing
  const int shift = static_cast<int>(kMostShift * static_cast<float>(s)) + 1;
  const PixelRect asked = Grown(region, shift).Intersect(hierarchy.frame_);
  if (asked.empty()) {
    Show(level, region, {});
    return true;
  }
  const int x0 = asked.x0 / c, y0 = asked.y0 / c;
  const int columns = (asked.x1 - 1) / c - x0 + 1, rows = (asked.y1 - 1) / c - y0 + 1;
  const size_t count = static_cast<size_t>(columns) * static_cast<size_t>(rows);
  counts.candidates += count;
  if (c == 1) LookAt(asked);
  std::vector<ReceiverPlace> own_places(c == 1 ? 0 : count);
  const auto place_of = [&](size_t i) -> const ReceiverPlace& {
    return c == 1 ? Pixel(x0 + static_cast<int>(i % static_cast<size_t>(columns)),
                          y0 + static_cast<int>(i / static_cast<size_t>(columns)))
                  : own_places[i];
  };
  std::vector<WorldCell> cells(count);
  executor.ForEachPiece(count, 64, [&](size_t begin, size_t end) {
    for (size_t i = begin; i < end; ++i) {
      if (c > 1) {
        const uint64_t column = static_cast<uint64_t>(x0) + i % static_cast<size_t>(columns);
        const uint64_t row = static_cast<uint64_t>(y0) + i / static_cast<size_t>(columns);
        const uint64_t side = static_cast<uint64_t>(c);
        const uint64_t jitter = HashKey(seed, kKeyJitter, row << 32 | column, side);
        const int x = static_cast<int>(column * side + jitter % side);
        const int y = static_cast<int>(row * side + (jitter >> 32) % side);
        if (hierarchy.frame_.Contains(x, y)) {
          own_places[i] = PlaceAt(x, y);
        } else {
          own_places[i].footprint_m = -1;
        }
      }
      const ReceiverPlace& place = place_of(i);
      if (place.footprint_m < 0) continue;
      cells[i] =
          CellOf(place.receiver, kCellSide * static_cast<float>(s) * place.footprint_m, seed);
    }
  });

  // The cells, each once, and who proposes them.
  struct Item {
    WorldCell cell;
    ReceiverPlace place;  // of the cell
    bool known = false, wanted = false, chosen = false, decided = false;
    std::shared_ptr<const ScreenRecord> record;
  };
  std::vector<Item> items;
  constexpr uint32_t kNobody = ~uint32_t{0};
  std::vector<uint32_t> item_of(count, kNobody);
  {
    size_t size = 16;
    while (size < 2 * count) size *= 2;
    std::vector<uint32_t> table(size, kNobody);
    for (size_t i = 0; i < count; ++i) {
      if (place_of(i).footprint_m < 0) continue;
      if (i > 0 && item_of[i - 1] != kNobody && cells[i] == cells[i - 1]) {
        item_of[i] = item_of[i - 1];
        continue;
      }
      size_t at = (WorldCellHash()(cells[i]) + static_cast<size_t>(cells[i].exponent)) & (size - 1);
      while (table[at] != kNobody && !(items[table[at]].cell == cells[i])) {
        at = (at + 1) & (size - 1);
      }
      if (table[at] == kNobody) {
        table[at] = static_cast<uint32_t>(items.size());
        items.emplace_back().cell = cells[i];
      }
      item_of[i] = table[at];
    }
  }
  std::vector<uint32_t> first_proposer, proposers;
  CountingSort(
      count, items.size() + 1,
      [&](size_t i) { return item_of[i] == kNobody ? items.size() : size_t{item_of[i]}; },
      first_proposer, proposers);
  {
    const std::lock_guard lock(level.mutex);
    for (Item& item : items) {
      if (level.records.empty()) break;
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
      } else if (!hierarchy.source_.ReceiverAlong(ProbeOf(item.cell, seed), place)) {
        item.decided = true;
        continue;
      }
      if (!in_region(place.x_px, place.y_px)) continue;
      const float most = kMostShift * static_cast<float>(s);
      item.wanted = std::any_of(proposers.begin() + first_proposer[i],
                                proposers.begin() + first_proposer[i + 1], [&](uint32_t by) {
                                  const ReceiverPlace& from = place_of(by);
                                  const float dx = from.x_px - place.x_px,
                                              dy = from.y_px - place.y_px;
                                  return dx * dx + dy * dy <= most * most;
                                });
      item.chosen = item.wanted && !item.known && l == 0;
    }
  });

  // … and is served too badly …
  std::vector<uint32_t> doubtful;
  for (uint32_t i = 0; i < items.size() && l > 0; ++i) {
    if (items[i].wanted && !items[i].known) doubtful.push_back(i);
  }
  const int across = (region.width() + kSquare - 1) / kSquare;
  const int down = (region.height() + kSquare - 1) / kSquare;
  std::vector<uint32_t> first, by_square;
  CountingSort(
      doubtful.size(), static_cast<size_t>(across) * static_cast<size_t>(down),
      [&](size_t i) {
        const ReceiverPlace& place = items[doubtful[i]].place;
        const int column = (PixelOf(place.x_px) - region.x0) / kSquare;
        const int row = (PixelOf(place.y_px) - region.y0) / kSquare;
        return static_cast<size_t>(row) * static_cast<size_t>(across) + static_cast<size_t>(column);
      },
      first, by_square);
  executor.ForEachPiece(first.size() - 1, 1, [&](size_t begin, size_t end) {
    std::vector<const ScreenRecord*> near;
    for (size_t q = begin; q < end; ++q) {
      if (first[q] == first[q + 1]) continue;
      near.clear();
      const int x = region.x0 + kSquare * static_cast<int>(q % static_cast<size_t>(across));
      const int y = region.y0 + kSquare * static_cast<int>(q / static_cast<size_t>(across));
      view.Collect({x, y, x + kSquare, y + kSquare}, near);
      for (uint32_t at = first[q]; at < first[q + 1]; at += 8) {
        const size_t together = std::min<size_t>(8, first[q + 1] - at);
        const ReceiverPlace* places[8];
        for (size_t i = 0; i < together; ++i) places[i] = &items[doubtful[by_square[at + i]]].place;
        const unsigned badly = ServedBadly(near, {places, together});
        for (size_t i = 0; i < together; ++i) {
          Item& item = items[doubtful[by_square[at + i]]];
          item.chosen = (badly >> i & 1) != 0;
          item.decided = !item.chosen;
        }
      }
    }
  });

  // … gets a record.
  std::vector<uint32_t> chosen;
  for (uint32_t i = 0; i < items.size(); ++i) {
    if (items[i].chosen) chosen.push_back(i);
  }
  std::vector<Made> made(chosen.size());
  for (size_t i = 0; i < chosen.size(); ++i) {
    made[i].place = items[chosen[i]].place;
    made[i].cell = items[chosen[i]].cell;
  }
  if (!Make(l, made)) return false;
  for (size_t i = 0; i < chosen.size(); ++i) items[chosen[i]].record = std::move(made[i].record);
  {
    const std::lock_guard lock(level.mutex);
    if (level.records.size() + items.size() > kKeptRecords) level.records.clear();
    for (const Item& item : items) {
      if (item.chosen || item.decided) level.records.try_emplace(item.cell, item.record);
    }
  }
  std::vector<Kept> kept;
  for (Item& item : items) {
    if (item.wanted && item.record) kept.push_back({item.cell, std::move(item.record)});
  }
  Show(level, region, std::move(kept));
  return true;
}

bool ReceiverHierarchy::Pass::Pixels(size_t l, const PixelRect& region) {
  Level& level = *hierarchy.levels_[l];
  const PixelRect asked = region.Intersect(hierarchy.frame_);
  if (asked.empty()) {
    Show(level, region, {});
    return true;
  }
  LookAt(asked);
  counts.candidates += static_cast<uint64_t>(asked.area());
  // By squares of the frame.
  const int column0 = FloorDiv(asked.x0, kSquare), row0 = FloorDiv(asked.y0, kSquare);
  const int across = FloorDiv(asked.x1 - 1, kSquare) - column0 + 1;
  const int down = FloorDiv(asked.y1 - 1, kSquare) - row0 + 1;
  const size_t squares = static_cast<size_t>(across) * static_cast<size_t>(down);
  struct Square {
    std::vector<std::shared_ptr<const ScreenRecord>> known;
    std::vector<const ReceiverPlace*> chosen;
  };
  std::vector<Square> found(squares);
  const auto key_of = [&](size_t q) {
    return static_cast<uint64_t>(row0 + static_cast<int>(q / static_cast<size_t>(across))) << 32 |
           static_cast<uint32_t>(column0 + static_cast<int>(q % static_cast<size_t>(across)));
  };
  {
    const std::lock_guard lock(level.mutex);
    for (size_t q = 0; q < squares && !level.squares.empty(); ++q) {
      const auto it = level.squares.find(key_of(q));
      if (it != level.squares.end()) found[q].known = it->second;
    }
  }
  executor.ForEachPiece(squares, 1, [&](size_t begin, size_t end) {
    std::vector<const ScreenRecord*> near;
    for (size_t q = begin; q < end; ++q) {
      Square& square = found[q];
      const int x0 = kSquare * (column0 + static_cast<int>(q % static_cast<size_t>(across)));
      const int y0 = kSquare * (row0 + static_cast<int>(q / static_cast<size_t>(across)));
      const PixelRect rect = PixelRect{x0, y0, x0 + kSquare, y0 + kSquare}.Intersect(asked);
      uint64_t done = 0;  // bits of the square's pixels
      const auto bit_of = [&](int x, int y) {
        return uint64_t{1} << (static_cast<unsigned>(y - y0) * kSquare +
                               static_cast<unsigned>(x - x0));
      };
      std::erase_if(square.known, [&](const auto& record) {
        return !rect.Contains(PixelOf(record->x_px), PixelOf(record->y_px));
      });
      for (const auto& record : square.known) {
        done |= bit_of(PixelOf(record->x_px), PixelOf(record->y_px));
      }
      near.clear();
      if (l > 0) view.Collect(rect, near);
      const ReceiverPlace* places[8];
      size_t together = 0;
      const auto flush = [&] {
        if (together == 0) return;
        const unsigned badly = l == 0 ? ~0u : ServedBadly(near, {places, together});
        for (size_t i = 0; i < together; ++i) {
          if ((badly >> i & 1) != 0) square.chosen.push_back(places[i]);
        }
        together = 0;
      };
      for (int y = rect.y0; y < rect.y1; ++y) {
        for (int x = rect.x0; x < rect.x1; ++x) {
          const ReceiverPlace& place = Pixel(x, y);
          if (place.footprint_m < 0 || (done & bit_of(x, y)) != 0) continue;
          places[together++] = &place;
          if (together == 8) flush();
        }
      }
      flush();
    }
  });
  std::vector<Made> made;
  std::vector<Kept> kept;
  for (Square& square : found) {
    // A pixel's record has the key of its place, too.
    for (const ReceiverPlace* place : square.chosen) {
      made.push_back(
          {*place, CellOf(place->receiver, place->footprint_m, hierarchy.params_.seed), nullptr});
    }
    for (auto& record : square.known) kept.push_back({{}, std::move(record)});
  }
  if (!Make(l, made)) return false;
  {
    const std::lock_guard lock(level.mutex);
    if (level.kept + made.size() > kKeptRecords) {
      level.squares.clear();
      level.kept = 0;
    }
    size_t next = 0;
    for (size_t q = 0; q < squares; ++q) {
      if (found[q].chosen.empty()) continue;
      auto& own = level.squares[key_of(q)];
      for (size_t i = 0; i < found[q].chosen.size(); ++i, ++next) {
        const auto& record = made[next].record;
        // Another thread may have been faster.
        if (std::any_of(own.begin(), own.end(), [&](const auto& other) {
              return other->x_px == record->x_px && other->y_px == record->y_px;
            })) {
          continue;
        }
        own.push_back(record);
        ++level.kept;
      }
    }
  }
  for (Made& m : made) kept.push_back({{}, std::move(m.record)});
  Show(level, region, std::move(kept));
  return true;
}

ScreenRecord ReceiverHierarchy::MakeOwnRecord(const ServedReceiver& receiver, float footprint_m,
                                              uint64_t key, float share) const {
  size_t halved = 0;
  while (halved + 1 < own_grids_.size() && 4 * share <= 1) {
    share *= 4;
    ++halved;
  }
  ScreenRecord record;
  record.x_px = receiver.x_px;
  record.y_px = receiver.y_px;
  record.screen_reach_px = ReachOf(1);
  record.gather = source_.Gather(*receiver.receiver, own_grids_[halved],
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
    g.unhidden_gradient *= scale;
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

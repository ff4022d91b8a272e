#include "core/pbgi/receiver_hierarchy.h"

#include <gtest/gtest.h>

#include <cmath>
#include <map>
#include <set>

#include "core/math/sampling.h"

namespace farpoint {
namespace {

// A floor seen from above, one metre a pixel, with a step at x = 40 and a pole of background; its
// irradiance is linear in x, and records know its slope. Pixel (0, 0) begins at (shift, 0).
class Floor final : public PlaceSource {
 public:
  explicit Floor(float shift_m = 0) : shift_m_(shift_m) {}

  bool ReceiverAt(int x, int y, Receiver& r, float& footprint_m) const override {
    r = At(static_cast<float>(x) + 0.5f + shift_m_, static_cast<float>(y) + 0.5f);
    footprint_m = 1;
    return !Hole(r.position);
  }
  bool ReceiverAlong(const CellProbe& probe, ReceiverPlace& place) const override {
    place.receiver = At(probe.origin.x, probe.origin.y);
    place.footprint_m = 1;
    place.x_px = probe.origin.x - shift_m_;
    place.y_px = probe.origin.y;
    const float t = probe.origin.z - place.receiver.position.z;
    return probe.direction.z < 0 && t >= 0 && t <= probe.length_m && !Hole(place.receiver.position);
  }
  static bool Hole(const Vec3f& p) { return p.x >= 20 && p.x < 23 && p.y < 30; }
  static Receiver At(float x, float y) {
    Receiver r;
    r.position = {x, y, x < 40 ? 0.0f : 30.0f};
    r.normal = r.geometric_normal = {0, 0, 1};
    return r;
  }
  static float Irradiance(const Receiver& r) {
    return (r.position.z > 0 ? 5.0f : 1.0f) + 0.01f * r.position.x;
  }
  GatherRecord Gather(const Receiver& r, const HemisphereGrid&, uint64_t key) const override {
    GatherRecord g;
    g.position = r.position;
    g.normal = r.normal;
    const float e = Irradiance(r);
    g.irradiance = Rgb(e, 2 * e, 0);
    g.gradient = {Vec3f(0.01f, 0, 0), Vec3f(0.02f, 0, 0), Vec3f()};
    // Some places are narrow.
    g.harmonic_distance_m = key % 3 == 0 ? 40.0f : 200.0f;
    return g;
  }

 private:
  const float shift_m_;
};

const PixelRect kFrame{0, 0, 100, 75};

// Everything that decides what a record brings.
using Key = std::tuple<float, float, float, float, float>;
std::set<Key> KeysWithin(const ReceiverHierarchy::View& view, const PixelRect& rect) {
  std::vector<const ScreenRecord*> records;
  view.Collect(rect, records);
  std::set<Key> keys;
  for (const ScreenRecord* r : records) {
    keys.insert({r->x_px, r->y_px, r->screen_reach_px, r->gather.reach_m, r->gather.irradiance.x});
  }
  EXPECT_EQ(keys.size(), records.size());
  return keys;
}

TEST(ReceiverHierarchy, RecordsDoNotDependOnTilesThreadsOrEarlierCalls) {
  const Floor floor;
  const HierarchyParams params;
  Executor one(1), two(2);
  ReceiverHierarchy::Counts counts;
  const ReceiverHierarchy whole(params, kFrame, floor);
  const auto all = whole.Prepare(kFrame, one, {}, counts);
  for (const int tile : {32, 96}) {
    const ReceiverHierarchy tiled(params, kFrame, floor);
    for (int y = 64 / tile * tile; y >= 0; y -= tile) {
      for (int x = 96 / tile * tile; x >= 0; x -= tile) {
        const PixelRect rect = PixelRect{x, y, x + tile, y + tile}.Intersect(kFrame);
        if (rect.empty()) continue;
        const ReceiverHierarchy fresh(params, kFrame, floor);
        const auto a = tiled.Prepare(rect, two, {}, counts);
        const auto b = fresh.Prepare(rect, one, {}, counts);
        EXPECT_EQ(KeysWithin(*a, rect), KeysWithin(*all, rect)) << tile << " " << x << " " << y;
        EXPECT_EQ(KeysWithin(*b, rect), KeysWithin(*all, rect)) << tile << " " << x << " " << y;
      }
    }
  }
}

// A camera that moves by parts of a pixel finds nearly all places again, and the same rays from
// them (what the floor shows depends on the key).
TEST(ReceiverHierarchy, PlacesStayWhenTheCameraMoves) {
  Executor executor(2);
  ReceiverHierarchy::Counts counts;
  std::set<std::tuple<float, float, float>> before;
  size_t found = 0, all = 0;
  for (const float shift : {0.0f, 1.3f, 2.7f}) {
    const Floor floor(shift);
    const ReceiverHierarchy hierarchy({}, kFrame, floor);
    const auto view = hierarchy.Prepare(kFrame, executor, {}, counts);
    std::vector<const ScreenRecord*> records;
    view->Collect(kFrame, records);
    std::set<std::tuple<float, float, float>> now;
    for (const ScreenRecord* r : records) {
      const bool inside = r->x_px > 24 && r->x_px < 76;  // what all three see
      if (!inside || r->screen_reach_px <= kLeastScreenReach) continue;
      now.insert({r->gather.position.x, r->gather.position.y, r->gather.harmonic_distance_m});
      found +=
          before.count({r->gather.position.x, r->gather.position.y, r->gather.harmonic_distance_m});
      all += !before.empty();
    }
    before = now;
  }
  EXPECT_GT(all, 40u);
  EXPECT_GT(static_cast<double>(found), 0.8 * static_cast<double>(all));
}

// Light that changes where no record's distances tell: only their disagreement does.
TEST(ReceiverHierarchy, RecordsThatDisagreeAskForMore) {
  class Patches final : public PlaceSource {
   public:
    bool ReceiverAt(int x, int y, Receiver& r, float& footprint_m) const override {
      return floor_.ReceiverAt(x, y, r, footprint_m);
    }
    bool ReceiverAlong(const CellProbe& probe, ReceiverPlace& place) const override {
      return floor_.ReceiverAlong(probe, place);
    }
    static float Irradiance(const Vec3f& p) { return p.y < 37 ? 1.0f : 3.0f; }
    GatherRecord Gather(const Receiver& r, const HemisphereGrid& grid,
                        uint64_t key) const override {
      GatherRecord g = floor_.Gather(r, grid, key);
      g.gradient = {};
      g.irradiance = Rgb(1, 1, 1) * Irradiance(r.position);
      return g;
    }

   private:
    Floor floor_;
  };
  const Patches patches;
  Executor executor(2);
  const auto error = [&](float spread, uint64_t& made) {
    HierarchyParams params;
    params.spread_wm2 = spread;
    const ReceiverHierarchy hierarchy(params, kFrame, patches);
    ReceiverHierarchy::Counts counts;
    const auto view = hierarchy.Prepare(kFrame, executor, {}, counts);
    made = counts.records;
    double sum = 0;
    for (int y = 0; y < kFrame.y1; ++y) {
      for (int x = 50; x < kFrame.x1; ++x) {
        Receiver r;
        float footprint, weight;
        if (!patches.ReceiverAt(x, y, r, footprint)) continue;
        std::vector<const ScreenRecord*> records;
        view->Collect({x, y, x + 1, y + 1}, records);
        const ServedReceiver served{&r, static_cast<float>(x) + 0.5f, static_cast<float>(y) + 0.5f};
        Rgb e;
        BlendRecords(records, {&served, 1}, {&e, 1}, {&weight, 1});
        const double d = static_cast<double>(e.x - Patches::Irradiance(r.position));
        sum += d * d;
      }
    }
    return sum;
  };
  uint64_t few, many;
  const double coarse = error(0, few), fine = error(0.2f, many);
  EXPECT_GT(coarse, 0);
  EXPECT_LT(fine, 0.35 * coarse);
  EXPECT_GT(many, few);
  EXPECT_LT(many, 5000u);  // where it changes, not everywhere: there are 7,410 pixels
}

TEST(ReceiverHierarchy, EveryPixelIsServedAndALinearFieldIsReproduced) {
  const Floor floor;
  const ReceiverHierarchy hierarchy({}, kFrame, floor);
  Executor executor(2);
  ReceiverHierarchy::Counts counts;
  const auto view = hierarchy.Prepare(kFrame, executor, {}, counts);
  std::vector<const ScreenRecord*> records;
  for (int y = 0; y < kFrame.y1; ++y) {
    for (int x = 0; x < kFrame.x1; ++x) {
      Receiver r;
      float footprint;
      if (!floor.ReceiverAt(x, y, r, footprint)) continue;
      records.clear();
      view->Collect({x, y, x + 1, y + 1}, records);
      const ServedReceiver served{&r, static_cast<float>(x) + 0.5f, static_cast<float>(y) + 0.5f};
      Rgb e;
      float weight;
      BlendRecords(records, {&served, 1}, {&e, 1}, {&weight, 1});
      // A record that came later may have taken some of the others' weight, but never its own.
      EXPECT_GE(weight, 0.5f * hierarchy.params().enough) << x << " " << y;
      EXPECT_NEAR(e.x, Floor::Irradiance(r), 2e-5f) << x << " " << y;
      EXPECT_NEAR(e.y, 2 * Floor::Irradiance(r), 4e-5f) << x << " " << y;
    }
  }
  // Far fewer records than pixels, and every call counts what it made.
  EXPECT_LT(counts.records, 7500u / 4);
  EXPECT_GT(counts.records, 30u);
  const uint64_t before = counts.records;
  hierarchy.Prepare(kFrame, executor, {}, counts);
  EXPECT_EQ(counts.records, before);
}

TEST(ReceiverHierarchy, BlendingEqualsTheLiteralSumWhateverItsCompany) {
  std::vector<ScreenRecord> records(60);
  const auto u = [](int i, int k) {
    return ToUnitFloat(
        static_cast<uint32_t>(HashKey(3, static_cast<uint64_t>(i), static_cast<uint64_t>(k))));
  };
  for (int i = 0; i < 60; ++i) {
    ScreenRecord& r = records[static_cast<size_t>(i)];
    r.x_px = 8 * u(i, 0);
    r.y_px = 8 * u(i, 1);
    r.screen_reach_px = 1.5f * static_cast<float>(1 << (i % 4));
    r.gather.position = {r.x_px, r.y_px, 0.2f * u(i, 2)};
    r.gather.normal = Normalize(Vec3f(0.4f * u(i, 3), 0.3f * u(i, 4), 1));
    r.gather.reach_m = 0.5f + 6 * u(i, 5);
    r.gather.irradiance = {u(i, 6), u(i, 7), 0};
    for (int c = 0; c < 3; ++c) {
      r.gather.gradient[static_cast<size_t>(c)] = {u(i, 8 + c) - 0.5f, u(i, 11 + c) - 0.5f, 0};
      r.gather.vector[static_cast<size_t>(c)] = {u(i, 20 + c), u(i, 23 + c) - 0.5f, u(i, 26 + c)};
    }
  }
  std::vector<const ScreenRecord*> list;
  for (const ScreenRecord& r : records) list.push_back(&r);
  std::vector<Receiver> receivers(8);
  std::vector<ServedReceiver> served;
  for (int i = 0; i < 8; ++i) {
    Receiver& r = receivers[static_cast<size_t>(i)];
    r.position = {8 * u(i, 100), 8 * u(i, 101), 0.1f};
    r.normal = Normalize(Vec3f(0.3f * u(i, 103), 0.2f, 1));
    served.push_back({&r, r.position.x, r.position.y});
  }
  std::vector<Rgb> e(8);
  std::vector<float> weight(8);
  int weighed = 0;
  std::vector<std::array<float, 8>> shares(list.size());
  BlendRecords(list, served, e, weight, {}, shares);
  for (size_t i = 0; i < 8; ++i) {
    Vec3d sum;
    double weights = 0, finest = 0, scale = 0;
    std::vector<double> expected(records.size());
    const Receiver& x = receivers[i];
    // Of all records first the finest scale that they tell of, then the weights that it leaves.
    for (const bool weighs : {false, true}) {
      for (size_t k = 0; k < records.size(); ++k) {
        const ScreenRecord& r = records[k];
        const double du = static_cast<double>(served[i].x_px - r.x_px);
        const double dv = static_cast<double>(served[i].y_px - r.y_px);
        const double screen = 1 - (du * du + dv * dv) / (static_cast<double>(r.screen_reach_px) *
                                                         static_cast<double>(r.screen_reach_px));
        const Vec3d d = Vec3d(x.position) - Vec3d(r.gather.position);
        const double off = std::fabs(Dot(d, Vec3d(x.normal) + Vec3d(r.gather.normal)));
        const double turned =
            std::sqrt(std::max(0.0, 1 - Dot(Vec3d(x.normal), Vec3d(r.gather.normal))) /
                      static_cast<double>(kNormalTolerance));
        const double inverse = std::max(1 / static_cast<double>(r.gather.reach_m), finest);
        const double w = 1 - (Length(d) + off) * inverse - turned;
        if (!weighs && screen > 0) {
          const double above = std::max(0.0, -Dot(d, Vec3d(x.normal)));
          scale = std::max(scale, 2 * above / Dot(d, d) * screen);
        }
        if (weighs) expected[k] = w > 0 && screen > 0 ? w * w * screen * screen : 0;
        if (!(w > 0) || !(screen > 0)) continue;
        if (weighs) {
          weights += w * w * screen * screen;
          sum += Vec3d(IrradianceAt(r.gather, x.position, x.normal)) * (w * w * screen * screen);
        } else {
          scale = std::max(scale, w * screen * inverse);
        }
      }
      finest = scale;
    }
    if (!(weights > 0)) {
      EXPECT_EQ(weight[i], 0) << i;
      continue;
    }
    ++weighed;
    for (size_t k = 0; k < records.size(); ++k) EXPECT_NEAR(shares[k][i], expected[k], 1e-5);
    EXPECT_NEAR(weight[i], weights, 1e-4 * weights) << i;
    EXPECT_NEAR(e[i].x, sum.x / weights, 2e-4) << i;
    EXPECT_NEAR(e[i].y, sum.y / weights, 2e-4) << i;
    // Alone, the same bits.
    Rgb alone;
    float alone_weight;
    BlendRecords(list, {&served[i], 1}, {&alone, 1}, {&alone_weight, 1});
    EXPECT_EQ(alone, e[i]);
    EXPECT_EQ(alone_weight, weight[i]);
  }
  EXPECT_GT(weighed, 3);
}

// A record of the open, coarse and far-reaching, beside one that tells of something near.
TEST(ReceiverHierarchy, ARecordOfTheOpenDoesNotReachIntoACorner) {
  ScreenRecord open, corner;
  open.x_px = 20;
  open.screen_reach_px = 24;
  open.gather.position = {20, 0, 0};
  open.gather.normal = {0, 0, 1};
  open.gather.reach_m = 60;
  open.gather.irradiance = {1, 1, 1};
  corner.screen_reach_px = 3;
  corner.gather.normal = {0, 0, 1};
  corner.gather.reach_m = 4;
  corner.gather.irradiance = {0.01f, 0.01f, 0.01f};
  const ScreenRecord* list[] = {&open, &corner};
  const auto at = [&](float px) {
    Receiver r;
    r.position = {px, 0, 0};
    r.normal = {0, 0, 1};
    const ServedReceiver served{&r, px, 0};
    Rgb e;
    float weight;
    BlendRecords(list, {&served, 1}, {&e, 1}, {&weight, 1});
    return e.x;
  };
  EXPECT_FLOAT_EQ(at(0), 0.01f);
  EXPECT_FLOAT_EQ(at(1), 0.01f);
  EXPECT_FLOAT_EQ(at(10), 1.0f);
  // Continuous on the way out.
  float before = at(0);
  for (float px = 0; px <= 10; px += 0.01f) {
    const float e = at(px);
    EXPECT_NEAR(e, before, 0.05f) << px;
    EXPECT_GE(e, before - 1e-5f) << px;
    before = e;
  }
}

// A receiver at the bottom of a groove, between records on the level above it: they do not know
// what it sees, and it must get a record of its own.
TEST(ReceiverHierarchy, ARecordAboveTheReceiversPlaneBoundsTheScale) {
  ScreenRecord beside, above;
  beside.screen_reach_px = above.screen_reach_px = 24;
  beside.x_px = 8;
  beside.gather.position = {0.8f, 0, 0};
  beside.gather.normal = above.gather.normal = {0, 0, 1};
  beside.gather.reach_m = above.gather.reach_m = 2;
  beside.gather.irradiance = {1, 1, 1};
  above.x_px = 1;
  above.gather.position = {0.1f, 0, 0.1f};
  above.gather.irradiance = {3, 3, 3};
  Receiver r;
  r.normal = {0, 0, 1};
  const ServedReceiver served{&r, 0, 0};
  const ScreenRecord* flat[] = {&beside};
  const ScreenRecord* both[] = {&beside, &above};
  Rgb e;
  float weight;
  BlendRecords(flat, {&served, 1}, {&e, 1}, {&weight, 1});
  EXPECT_GT(weight, 0.2f);
  EXPECT_EQ(e, Rgb(1, 1, 1));
  // 1/b = 2 * 0.1 / 0.02: nothing further than 0.1 m weighs, and neither of the two does.
  BlendRecords(both, {&served, 1}, {&e, 1}, {&weight, 1});
  EXPECT_EQ(weight, 0);
  EXPECT_GT(e.x, 1);
  EXPECT_LT(e.x, 3);
  // The same beside a receiver that the record above does weigh at, and that is out of the reach in
  // the image that the first one is in.
  ScreenRecord aside = beside;
  aside.x_px = 30;
  aside.gather.position = {0.001f, 0, 0};
  const ScreenRecord* three[] = {&beside, &above, &aside};
  Receiver other = r;
  other.position = {0.1f, 0, 0.1f};
  const ServedReceiver pair[] = {served, {&other, 29, 0}};
  Rgb alone, both_e[2];
  float alone_weight, both_weight[2];
  BlendRecords(three, {&served, 1}, {&alone, 1}, {&alone_weight, 1});
  BlendRecords(three, pair, both_e, both_weight);
  EXPECT_EQ(both_e[0], alone);
  EXPECT_EQ(both_weight[0], alone_weight);
  EXPECT_GT(alone.x, 1);
  // What lies below bounds nothing.
  above.gather.position.z = -0.1f;
  BlendRecords(both, {&served, 1}, {&e, 1}, {&weight, 1});
  EXPECT_GT(weight, 0.2f);
}

TEST(ReceiverHierarchy, StopsWhenItIsTold) {
  const Floor floor;
  const ReceiverHierarchy hierarchy({}, kFrame, floor);
  Executor executor(2);
  ReceiverHierarchy::Counts counts;
  EXPECT_EQ(hierarchy.Prepare(
                kFrame, executor, [](double) { return false; }, counts),
            nullptr);
  double last = 0;
  std::mutex mutex;
  const auto view = hierarchy.Prepare(
      kFrame, executor,
      [&](double part) {
        const std::lock_guard lock(mutex);
        EXPECT_GT(part, 0);
        EXPECT_LE(part, 1);
        last = std::max(last, part);
        return true;
      },
      counts);
  EXPECT_NE(view, nullptr);
  EXPECT_GT(last, 0.5);
}

// A camera on a surface sees it at depth 0: no footprint, no reach, and still a record.
TEST(ReceiverHierarchy, ARecordWithoutReachServesItsOwnReceiver) {
  class Point final : public PlaceSource {
   public:
    bool ReceiverAt(int, int, Receiver& r, float& footprint_m) const override {
      r.normal = r.geometric_normal = {0, 0, 1};
      footprint_m = 0;
      return true;
    }
    bool ReceiverAlong(const CellProbe&, ReceiverPlace&) const override { return false; }
    GatherRecord Gather(const Receiver& r, const HemisphereGrid&, uint64_t) const override {
      GatherRecord g;
      g.normal = r.normal;
      g.irradiance = Rgb(1, 1, 1);
      g.harmonic_distance_m = 1;
      return g;
    }
  };
  const Point point;
  const PixelRect frame{0, 0, 3, 1};
  const ReceiverHierarchy hierarchy({}, frame, point);
  Executor executor(1);
  ReceiverHierarchy::Counts counts;
  const auto view = hierarchy.Prepare(frame, executor, {}, counts);
  for (int x = 0; x < 3; ++x) {
    std::vector<const ScreenRecord*> records;
    view->Collect({x, 0, x + 1, 1}, records);
    Receiver r;
    r.normal = {0, 0, 1};
    const ServedReceiver served{&r, static_cast<float>(x) + 0.5f, 0.5f};
    Rgb e;
    float weight;
    BlendRecords(records, {&served, 1}, {&e, 1}, {&weight, 1});
    EXPECT_EQ(e, Rgb(1, 1, 1));
    EXPECT_GT(weight, 0);
  }
}

TEST(ReceiverHierarchy, ARecordThatServesAPartOfAPixelHasFewerStrata) {
  // Tells how many strata it was asked for.
  class Counting final : public PlaceSource {
   public:
    bool ReceiverAt(int, int, Receiver&, float&) const override { return false; }
    bool ReceiverAlong(const CellProbe&, ReceiverPlace&) const override { return false; }
    GatherRecord Gather(const Receiver& r, const HemisphereGrid& grid, uint64_t) const override {
      GatherRecord g;
      g.position = r.position;
      g.normal = r.normal;
      g.irradiance = Rgb(static_cast<float>(grid.size()));
      g.harmonic_distance_m = 1;
      return g;
    }
  };
  const Counting source;
  HierarchyParams params;
  params.least_samples = 50;
  const ReceiverHierarchy hierarchy(params, kFrame, source);
  const Receiver receiver = Floor::At(3, 4);
  const ServedReceiver served{&receiver, 3.5f, 4.5f};
  const auto strata = [&](float share) {
    return hierarchy.MakeOwnRecord(served, 1, 7, share).gather.irradiance.x;
  };
  const float all = strata(1);
  EXPECT_EQ(all, static_cast<float>(hierarchy.finest_strata()));
  EXPECT_EQ(hierarchy.MakeOwnRecord(served, 1, 7).gather.irradiance.x, all);
  EXPECT_EQ(strata(0.5f), all);
  EXPECT_NEAR(strata(0.25f), all / 2, 0.05f * all);
  EXPECT_EQ(strata(0.125f), strata(0.25f));
  EXPECT_NEAR(strata(1.0f / 16), all / 4, 0.05f * all);
  // Not below the least, up to the grid's rounding.
  EXPECT_GE(strata(1.0f / 256), 45);
}

}  // namespace
}  // namespace farpoint

// A hierarchy of receivers over the image, coarse to fine: where shared gathers are made and how
// receivers blend them. It stands in for the paper's k clusters per block (§3.1) and is what its
// §5 names as future work: clusters follow the scene's complexity, not the number of pixels.
//
// Level l has the spacing s_l = coarsest / 2^l pixels, down to 2; on these levels clusters are
// anchored to the scene. Candidates, one in each square of s_l / 2 pixels of the frame, jittered by
// the square's coordinates, propose the world cells (core/pbgi/world_cell.h) that they lie in, of a
// side of about s_l pixels' footprints. A cell's place is its active receiver, and a record is
// gathered there, where the records of coarser levels weigh less than `enough` in sum or disagree
// by more than `spread_wm2` or `spread_open`. So a camera that moves finds the same places, and the
// same rays from them, again. A place counts if a candidate within kMostShift s_l pixels proposes
// it. The pixels themselves follow, twice: the second time the records of the first tell of what is
// near. Every receiver at a pixel's centre is served. A record of level l weighs only within ρ =
// max(kScreenReach s_l, kLeastScreenReach) pixels, so what a record is depends on the scene, the
// frame's camera and coarser records near it: never on tiles, threads or order.
//
// The weight of record k at a receiver x with normal n, at point p of the image:
//   w = max(0, 1 - (|x - c| + |(x - c)·(n + n_c)|) / min(a, b) - sqrt((1 - n·n_c) /
//   kNormalTolerance))²
//       · max(0, 1 - |p - p_c|² / ρ²)²,
// continuous and of compact support in all of its arguments (but for b where it is lifted). The
// reach a is `reach` times the harmonic mean distance of what the record saw, at most E / (2 |∇E|),
// at most a coarser neighbour's reach plus the distance to it, at least `floor_px` pixels'
// footprints or, where that is less, the harmonic distance, or one footprint (then the gradient is
// reduced in proportion). The bound b keeps a record of the open from weighing where others, that
// came after it, tell of something near (the neighbour clamping of Křivánek et al. 2006, the other
// way round): of all records j that weigh at x, 1/b >= sqrt(w_j)/a_j, with b = ∞ in w_j; and since
// the places of records are surfaces, of all that lie above x's plane, 1/b >= 2 (c_j - x)·n / |c_j
// - x|² times the second factor of w_j: in a groove the light changes within the groove's width.
// Where no record weighs under the bound, the sum of weights is 0 (and a candidate gets its
// record), and the irradiance is blended without it.
#pragma once

#include <array>
#include <atomic>
#include <cstdint>
#include <functional>
#include <memory>
#include <mutex>
#include <span>
#include <unordered_map>
#include <vector>

#include "core/base/executor.h"
#include "core/image/tile_rect.h"
#include "core/pbgi/gather_record.h"
#include "core/pbgi/receiver_cluster.h"
#include "core/pbgi/world_cell.h"

namespace farpoint {

inline constexpr float kScreenReach = 1.5f;       // of a record, in spacings of its level
inline constexpr float kLeastScreenReach = 3.0f;  // pixels
inline constexpr float kMostShift = 1.5f;         // of a place from a candidate in it, in spacings
inline constexpr float kNormalTolerance = 0.3f;  // 1 - cos of the angle at which weights end (46°)

struct HierarchyParams {
  uint32_t coarsest_px = 16;         // spacing of level 0; a power of two
  uint32_t coarsest_samples = 1024;  // strata of a record of level 0; those of level l are
  float fall_off = 0.35f;            // (s_l / s_0)^fall_off times as many, at least
  uint32_t least_samples = 64;
  float reach = 0.18f;   // a over the harmonic mean distance
  float enough = 0.15f;  // summed weight that spares a receiver a record of its own
  float floor_px = 3;    // least a, in pixels' footprints, see above
  // Standard deviation among records that spares a receiver a record of its own, W/m², mean of the
  // channels, and of openness; 0: any does.
  float spread_wm2 = 0;
  float spread_open = 0;
  uint64_t seed = 0;
};

// A receiver that no pixel's centre shows, perhaps.
struct ReceiverPlace {
  Receiver receiver;
  float footprint_m = 0;     // side of a pixel at its depth
  float x_px = 0, y_px = 0;  // where it lies in the image, or beside it
};

// What those that place records need of a renderer. Thread-safe.
class RecordSource {
 public:
  virtual ~RecordSource() = default;
  // The receiver at the centre of pixel (x, y) and the side of a pixel at its depth. False:
  // background.
  virtual bool ReceiverAt(int x, int y, Receiver& receiver, float& footprint_m) const = 0;
  // All but reach_m; a function of its arguments.
  virtual GatherRecord Gather(const Receiver& receiver, const HemisphereGrid& grid,
                              uint64_t key) const = 0;
};

// What the hierarchy needs besides, to put records at places of the scene.
class PlaceSource : public RecordSource {
 public:
  // The surface that the probe meets first, turned towards where the probe comes from. False: none,
  // or the camera does not see that side of it there: what is buried would carry its dark to what
  // lies over it.
  virtual bool ReceiverAlong(const CellProbe& probe, ReceiverPlace& place) const = 0;
};

struct ScreenRecord {
  GatherRecord gather;
  float x_px = 0, y_px = 0;  // of the active receiver
  float screen_reach_px = 0;
};

// A receiver to be served.
struct ServedReceiver {
  const Receiver* receiver;
  float x_px, y_px;  // in the image
};

// The weighted standard deviations of what records say at a receiver.
struct BlendSpread {
  float irradiance = 0;  // mean of the channels, W/m²
  float openness = 0;    // 0 unless openness is blended
};

// Σ w E(x, n) / Σ w over `records` and Σ w, at 1 to 8 receivers; 0 where no record weighs (see b
// for where only b is why). What a receiver gets depends on the records that weigh on it and on
// their order, not on the other receivers. `spread`: none, or how far they disagree. `shares`:
// none, or for each record its w at each receiver. `openness`: none, or the same blend of the
// records' openness, at most π. `unhidden`: the same of that.
void BlendRecords(std::span<const ScreenRecord* const> records,
                  std::span<const ServedReceiver> receivers, std::span<Rgb> irradiance,
                  std::span<float> weight, std::span<BlendSpread> spread = {},
                  std::span<std::array<float, 8>> shares = {}, std::span<float> openness = {},
                  std::span<float> unhidden = {});

class ReceiverHierarchy {
 public:
  // `source` must outlive the hierarchy.
  ReceiverHierarchy(const HierarchyParams& params, const PixelRect& frame,
                    const PlaceSource& source);

  // The records that can weigh on receivers within a rectangle.
  class View {
   public:
    // Appends the records that can weigh on something within `rect`, always in the same order.
    void Collect(const PixelRect& rect, std::vector<const ScreenRecord*>& out) const;

   private:
    friend class ReceiverHierarchy;
    struct Grid {
      int spacing, x0, y0, columns, rows;  // in bins of spacing²
      std::vector<uint32_t> first;         // of each bin, and the end of the last
      std::vector<std::shared_ptr<const ScreenRecord>> records;
    };
    std::vector<Grid> grids_;  // by level
  };

  struct Counts {
    uint64_t candidates = 0;  // pixels looked at
    uint64_t records = 0;     // gathers made
    uint64_t samples = 0;     // their strata
  };

  // Makes the records that are missing and adds to `counts` what it took; those of earlier calls
  // are kept (up to kKeptRecords). `go_on` (may be empty) is called after each gather, from any
  // thread, with the part of the work that is done, [0, 1]; when it says false the result is null.
  // Thread-safe.
  std::shared_ptr<const View> Prepare(const PixelRect& rect, Executor& executor,
                                      const std::function<bool(double)>& go_on,
                                      Counts& counts) const;

  // A record for a receiver that the view serves badly (it lies beside the pixel's centre, on
  // another surface), with the finest level's reach. `share`: the part of its pixel that the record
  // may serve, (0, 1]; it has the finest level's strata times the root of that, rounded up to a
  // power of two, but not fewer than params.least_samples. `key` tells it from others.
  ScreenRecord MakeOwnRecord(const ServedReceiver& receiver, float footprint_m, uint64_t key,
                             float share = 1) const;

  const HierarchyParams& params() const { return params_; }
  // Strata of the finest level's records.
  uint32_t finest_strata() const { return own_grids_.front().size(); }

  static constexpr size_t kKeptRecords = size_t{1} << 21;

 private:
  struct Level {
    Level(int spacing_px, bool in_world, uint32_t samples)
        : spacing(spacing_px), anchored(in_world), grid(samples) {}
    const int spacing;
    const bool anchored;  // to world cells; else to pixels
    const HemisphereGrid grid;
    std::mutex mutex;
    // Of cells, null: none is needed.
    std::unordered_map<WorldCell, std::shared_ptr<const ScreenRecord>, WorldCellHash> records;
    // Of pixels, by squares of the frame: row << 32 | column.
    std::unordered_map<uint64_t, std::vector<std::shared_ptr<const ScreenRecord>>> squares;
    size_t kept = 0;  // in squares
  };
  struct Pass;

  void SetReach(float footprint_m, float most_reach_m, ScreenRecord& record) const;

  const HierarchyParams params_;
  const PixelRect frame_;
  const PlaceSource& source_;
  std::vector<std::unique_ptr<Level>> levels_;
  std::vector<HemisphereGrid> own_grids_;  // of records for single receivers, each half the last
};

}  // namespace farpoint

// A job from the client's side: submit, watch, fetch and stitch. The same for a farm and for the
// embedded mode; only the link differs.
#pragma once

#include <functional>
#include <map>
#include <optional>
#include <span>
#include <string>
#include <utility>
#include <vector>

#include "client/console.h"
#include "client/farm_link.h"
#include "client/job_request.h"
#include "client/retry.h"
#include "client/stop_flag.h"
#include "core/base/status.h"
#include "core/image/film.h"

namespace farpoint {

struct FetchedFrame {
  uint32_t frame = 0;          // index into info.frames
  Film film;                   // of the crop, rounded to storage; every tile's hash was checked
  uint32_t missing_tiles = 0;  // not committed yet: their pixels are zero
};
// Takes a frame as soon as its last tile is in; the film is freed before the next one is fetched.
// An error ends the call and is returned.
using FrameSink = std::function<absl::Status(const JobInfo& info, FetchedFrame frame)>;

// Takes a tile of info.tiles that is committed; `film` holds at least its pixels, checked as those
// of a frame. Must not wait for anything.
using TileSink = std::function<void(const JobInfo& info, uint32_t tile, const Film& film)>;

// Not thread-safe. The references must outlive this.
class JobRun {
 public:
  JobRun(FarmLink& link, Retry& retry, const StopFlag& stop, Console& console)
      : link_(link), retry_(retry), stop_(stop), console_(console) {}

  // From here on, tiles go to `sink` as soon as they are known to be committed (Wait) or have
  // arrived (Fetch), maybe more than once. That a tile cannot be had yet is no error of Wait.
  void ShowTiles(TileSink sink) { tile_sink_ = std::move(sink); }

  // Sends the blobs that the coordinator lacks, then the job. Survives a coordinator that comes
  // back: the job is made once.
  absl::StatusOr<JobId> Submit(const PreparedRequest& request);

  // Until the job is done (OK). A failed job's own error; kCancelled if the job was cancelled or
  // `stop` raised. Shows notes and progress. With `sink`, every frame goes there once while the job
  // runs; of a job that fails or is cancelled, those that are complete.
  absl::Status Wait(const JobId& job, const FrameSink& sink = nullptr);

  absl::StatusOr<JobInfo> Info(const JobId& job);

  // Fetches `frames` (indices into info.frames) one after the other. A damaged tile is fetched
  // again, a few times, then kUnavailable. A frame that is not complete is left out; with `partial`
  // it is handed on as it is, if it has any tile. Returns how many frames the sink got.
  absl::StatusOr<size_t> Fetch(const JobInfo& info, std::span<const uint32_t> frames, bool partial,
                               const FrameSink& sink);

 private:
  absl::Status FetchFrame(const JobInfo& info, uint32_t frame, bool partial, const FrameSink& sink);
  // Hands on the frames that are complete and not marked in `taken` yet, and marks them.
  absl::Status TakeComplete(const JobInfo& info, std::vector<bool>& taken, const FrameSink& sink);

  // Fetches `tiles` for the tile sink, and keeps them for FetchFrame as far as there is room.
  void ShowEarly(const JobId& job, const std::map<uint32_t, Digest>& tiles);

  FarmLink& link_;
  Retry& retry_;
  const StopFlag& stop_;
  Console& console_;
  TileSink tile_sink_;
  std::optional<JobInfo> shown_job_;    // what ShowEarly knows of the tiles
  std::map<uint32_t, TileData> early_;  // shown, and not part of a frame yet
  size_t early_bytes_ = 0;
};

// The state of a job as a status: OK if it is done, kUnavailable if it has not ended.
absl::Status OutcomeOf(const JobStatus& status);

}  // namespace farpoint

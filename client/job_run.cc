#include "client/job_run.h"

#include <algorithm>
#include <chrono>
#include <cstdio>
#include <map>
#include <random>
#include <utility>
#include <vector>

#include "client/stitcher.h"

namespace farpoint {
namespace {

constexpr size_t kDigestsPerQuestion = 4096;
// Bounds what one call may take and what is lost if it breaks.
constexpr size_t kTilesPerCall = 32;
constexpr int kFetchRounds = 4;
// JobInfo grows with the number of frames. Between two questions for it lies at least this many
// times what the last one took, so that asking stays cheap.
constexpr int kInfoPause = 10;
constexpr std::chrono::seconds kLongestPause(10);

// Between two looks at what there is to show.
constexpr std::chrono::milliseconds kShowPause(100);
// Tiles that were shown and wait for their frame; what is beyond is fetched a second time.
constexpr size_t kMaxEarlyBytes = size_t{256} << 20;

using SteadyTime = std::chrono::steady_clock::time_point;

std::string RandomId() {
  std::random_device entropy;
  std::string id;
  for (int i = 0; i < 4; ++i) {
    char digits[9];
    std::snprintf(digits, sizeof(digits), "%08x", static_cast<unsigned>(entropy()));
    id += digits;
  }
  return id;
}

std::string SizeText(size_t bytes) {
  char text[32];
  std::snprintf(text, sizeof(text), "%.1f MiB", static_cast<double>(bytes) / (1 << 20));
  return text;
}

}  // namespace

absl::Status OutcomeOf(const JobStatus& status) {
  switch (status.state) {
    case JobState::kDone:
      return absl::OkStatus();
    case JobState::kFailed: {
      const std::string context = "job " + status.id.value + " failed";
      if (status.error.ok()) return absl::InternalError(context + " without saying why");
      return Annotate(status.error, context);
    }
    case JobState::kCancelled:
      return absl::CancelledError("job " + status.id.value + " was cancelled; farpoint requeue " +
                                  status.id.value + " lets it go on");
    case JobState::kPaused:
      return absl::UnavailableError("job " + status.id.value + " is paused; farpoint resume " +
                                    status.id.value + " lets it go on");
    default:
      return absl::UnavailableError("job " + status.id.value + " is not done, it is " +
                                    std::string(NameOf(status.state)) +
                                    "; wait for it, farpoint status shows how far it is");
  }
}

absl::StatusOr<JobId> JobRun::Submit(const PreparedRequest& request) {
  std::map<Digest, const Blob*> blobs;
  for (const auto& [uri, digest] : request.spec.asset_files) {
    blobs[digest] = &request.asset.files.at(uri);
  }
  std::vector<Digest> all;
  for (const auto& [digest, blob] : blobs) all.push_back(digest);

  size_t sent = 0, sent_bytes = 0;
  for (size_t first = 0; first < all.size(); first += kDigestsPerQuestion) {
    const size_t count = std::min(kDigestsPerQuestion, all.size() - first);
    const std::span<const Digest> question(all.data() + first, count);
    FP_ASSIGN_OR_RETURN(const std::vector<Digest> missing, retry_.Get<std::vector<Digest>>([&] {
      return link_.FindMissing(question);
    }));
    for (const Digest& digest : missing) {
      const auto blob = blobs.find(digest);
      if (blob == blobs.end()) {
        return absl::InternalError("the coordinator asks for a blob that it was not told of: " +
                                   digest.Hex());
      }
      FP_RETURN_IF_ERROR(retry_.Run([&] { return link_.Put(digest, *blob->second); }));
      ++sent;
      sent_bytes += blob->second->size();
    }
  }
  if (sent > 0) {
    console_.Debug("sent " + std::to_string(sent) + " of " + std::to_string(all.size()) +
                   " files, " + SizeText(sent_bytes));
  }
  const std::string submission_id = RandomId();
  return retry_.Get<JobId>([&] { return link_.Submit(request.spec, submission_id); });
}

absl::Status JobRun::Wait(const JobId& job, const FrameSink& sink) {
  uint64_t last_sequence = 0;
  JobStatus last;
  std::vector<bool> taken;
  size_t taken_count = 0;
  SteadyTime next_take = SteadyTime::min();
  std::map<uint32_t, Digest> to_show;
  SteadyTime next_show = SteadyTime::min();
  while (true) {
    bool take = false, show = false;
    const absl::Status watched = retry_.Run([&] {
      take = show = false;
      return link_.Watch(job, last_sequence, [&](const JobEvent& event) -> absl::Status {
        retry_.Succeeded();
        if (event.sequence > 0) last_sequence = event.sequence;
        last = event.status;
        if (const auto* note = std::get_if<std::string>(&event.body)) console_.Info(*note);
        console_.Progress(event.status);
        const SteadyTime now = std::chrono::steady_clock::now();
        const auto* tile = std::get_if<TileCommitted>(&event.body);
        if (tile != nullptr && tile_sink_ != nullptr) to_show[tile->tile] = tile->sha256;
        show = !to_show.empty() && !IsFinal(last.state) && now >= next_show;
        // The last frame's tiles are fetched when the job has ended.
        take = sink != nullptr && !IsFinal(last.state) && last.frames.done > taken_count &&
               now >= next_take;
        return take || show ? absl::AbortedError("tiles are to be fetched") : absl::OkStatus();
      });
    });
    if (!take && !show) {
      FP_RETURN_IF_ERROR(watched);
      break;
    }
    if (show) {
      ShowEarly(job, to_show);
      to_show.clear();
      next_show = std::chrono::steady_clock::now() + kShowPause;
    }
    if (!take) continue;
    const SteadyTime start = std::chrono::steady_clock::now();
    FP_ASSIGN_OR_RETURN(const JobInfo info, Info(job));
    next_take = std::chrono::steady_clock::now();
    next_take += std::min<SteadyTime::duration>((next_take - start) * kInfoPause, kLongestPause);
    FP_RETURN_IF_ERROR(TakeComplete(info, taken, sink));
    taken_count = static_cast<size_t>(std::count(taken.begin(), taken.end(), true));
  }
  if (!IsFinal(last.state)) {
    // The events ended before the one that says so: ask.
    FP_ASSIGN_OR_RETURN(const FarmStatus status,
                        retry_.Get<FarmStatus>([&] { return link_.Status(job); }));
    if (status.jobs.size() != 1) {
      return absl::InternalError("the coordinator says nothing about job " + job.value);
    }
    last = status.jobs[0];
  }
  if (sink != nullptr && last.frames.done > taken_count) {
    FP_ASSIGN_OR_RETURN(const JobInfo info, Info(job));
    FP_RETURN_IF_ERROR(TakeComplete(info, taken, sink));
  }
  return OutcomeOf(last);
}

void JobRun::ShowEarly(const JobId& job, const std::map<uint32_t, Digest>& tiles) {
  if (!shown_job_ || shown_job_->status.id != job ||
      tiles.rbegin()->first >= shown_job_->tiles.size()) {
    absl::StatusOr<JobInfo> info = link_.Info(job);
    if (!info.ok()) return;  // the frame's tiles are shown when it is fetched
    shown_job_ = *std::move(info);
  }
  const Film sorted({}, shown_job_->spec.settings.layers);
  std::vector<uint32_t> wanted;
  for (const auto& [tile, sha256] : tiles) {
    if (tile < shown_job_->tiles.size()) wanted.push_back(tile);
  }
  for (size_t first = 0; first < wanted.size(); first += kTilesPerCall) {
    const auto some =
        std::span(wanted).subspan(first, std::min(kTilesPerCall, wanted.size() - first));
    const absl::Status fetched = link_.FetchTiles(job, some, [&](TileData data) -> absl::Status {
      const auto asked = tiles.find(data.tile);
      if (asked == tiles.end()) return absl::OkStatus();
      TileInfo expected = shown_job_->tiles[data.tile];
      expected.sha256 = asked->second;
      const absl::StatusOr<Film> film = OpenTile(data, expected, sorted.layers());
      if (!film.ok()) return absl::OkStatus();  // as above, and then it is told
      tile_sink_(*shown_job_, data.tile, *film);
      const size_t size = data.bytes.size();
      if (early_bytes_ + size <= kMaxEarlyBytes &&
          early_.try_emplace(data.tile, std::move(data)).second) {
        early_bytes_ += size;
      }
      return absl::OkStatus();
    });
    if (!fetched.ok()) return;
  }
}

absl::StatusOr<JobInfo> JobRun::Info(const JobId& job) {
  return retry_.Get<JobInfo>([&] { return link_.Info(job); });
}

absl::Status JobRun::TakeComplete(const JobInfo& info, std::vector<bool>& taken,
                                  const FrameSink& sink) {
  taken.resize(info.frames.size(), false);
  for (uint32_t frame = 0; frame < info.frames.size(); ++frame) {
    if (taken[frame] || !TilesOfFrame(info, frame).complete()) continue;
    FP_RETURN_IF_ERROR(FetchFrame(info, frame, false, sink));
    taken[frame] = true;
  }
  return absl::OkStatus();
}

absl::StatusOr<size_t> JobRun::Fetch(const JobInfo& info, std::span<const uint32_t> frames,
                                     bool partial, const FrameSink& sink) {
  size_t fetched = 0;
  for (const uint32_t frame : frames) {
    const FrameTiles tiles = TilesOfFrame(info, frame);
    if (!tiles.complete() && !(partial && tiles.committed > 0)) continue;
    FP_RETURN_IF_ERROR(FetchFrame(info, frame, partial, sink));
    ++fetched;
  }
  return fetched;
}

absl::Status JobRun::FetchFrame(const JobInfo& info, uint32_t frame, bool partial,
                                const FrameSink& sink) {
  const JobId& job = info.status.id;
  FP_ASSIGN_OR_RETURN(Stitcher stitcher, Stitcher::Create(info, frame, partial));
  for (const uint32_t tile : stitcher.Missing()) {
    const auto early = early_.find(tile);
    if (early == early_.end()) continue;
    // One that a requeue has made worthless is fetched again.
    stitcher.Add(early->second).IgnoreError();
    early_bytes_ -= early->second.bytes.size();
    early_.erase(early);
  }
  for (int round = 0; round < kFetchRounds; ++round) {
    const std::vector<uint32_t> missing = stitcher.Missing();
    if (missing.empty()) break;
    for (size_t first = 0; first < missing.size(); first += kTilesPerCall) {
      std::vector<uint32_t> wanted(
          missing.begin() + first,
          missing.begin() + std::min(first + kTilesPerCall, missing.size()));
      FP_RETURN_IF_ERROR(retry_.Run([&]() -> absl::Status {
        if (wanted.empty()) return absl::OkStatus();
        return link_.FetchTiles(job, wanted, [&](TileData tile) -> absl::Status {
          if (stop_.raised()) return absl::CancelledError("stopped by a signal");
          const absl::Status added = stitcher.Add(tile);
          if (!added.ok()) {
            console_.Warn(std::string(added.message()) + "; it is fetched again");
            return absl::OkStatus();
          }
          retry_.Succeeded();
          if (tile_sink_ != nullptr) tile_sink_(info, tile.tile, stitcher.film());
          std::erase(wanted, tile.tile);  // not asked for again if this call breaks
          return absl::OkStatus();
        });
      }));
    }
  }
  const std::vector<uint32_t> missing = stitcher.Missing();
  if (!missing.empty()) {
    return absl::UnavailableError("tile " + std::to_string(missing[0]) + " and " +
                                  std::to_string(missing.size() - 1) + " more of job " + job.value +
                                  " arrived damaged " + std::to_string(kFetchRounds) +
                                  " times; check the network and the coordinator's disk");
  }
  const FrameTiles tiles = TilesOfFrame(info, frame);
  return sink(info, {frame, std::move(stitcher).TakeFilm(), tiles.total - tiles.committed});
}

}  // namespace farpoint

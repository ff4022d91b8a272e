#include "server/time_left.h"

#include <algorithm>
#include <cmath>

namespace farpoint {
namespace {

// The shares that are tried, and how much the usual one weighs against the commits. Both from
// recorded commits of seven scenes.
constexpr double kShareStep = 0.04, kLargestShare = 0.8, kPriorWeight = 3;
// What part of the first tile's time is tried as spent on loading the scene.
constexpr double kStartStep = 0.2, kLargestStart = 0.8, kStartWeight = 0.1;
// Commits that a fit looks at.
constexpr size_t kFitPoints = 64;
constexpr size_t kMaxCells = size_t{1} << 18;
// The frames by which the next ones are judged.
constexpr size_t kLastFrames = 3;

}  // namespace

TimeLeft::TimeLeft(uint32_t tiles, uint32_t frame_tiles, std::span<const PixelRect> rects,
                   std::span<const uint32_t> done, double usual_share)
    : tiles_(tiles),
      frame_tiles_(frame_tiles == 0 ? std::max(1u, tiles) : frame_tiles),
      before_(static_cast<uint32_t>(done.size())),
      usual_share_(usual_share) {
  if (rects.size() == frame_tiles_) {
    rects_.assign(rects.begin(), rects.end());
    PixelRect all = rects_[0];
    for (const PixelRect& r : rects_) {
      all = {std::min(all.x0, r.x0), std::min(all.y0, r.y0), std::max(all.x1, r.x1),
             std::max(all.y1, r.y1)};
      all_px_ += static_cast<double>(r.area());
    }
    left_ = all.x0;
    top_ = all.y0;
    for (;; cell_px_ *= 2) {
      columns_ = std::max(1, (all.width() + cell_px_ - 1) / cell_px_);
      rows_ = std::max(1, (all.height() + cell_px_ - 1) / cell_px_);
      if (static_cast<size_t>(columns_) * static_cast<size_t>(rows_) <= kMaxCells) break;
    }
    near_.resize(static_cast<size_t>(columns_) * static_cast<size_t>(rows_));
    if (!(all_px_ > 0)) rects_.clear();
  }
  for (const uint32_t tile : done) Cover(tile);
  begin_ = parts_.empty() ? Part{} : parts_.back();
  parts_.clear();
}

void TimeLeft::Cover(uint32_t tile) {
  Part part = parts_.empty() ? begin_ : parts_.back();
  if (tile >= rects_.size()) {
    part.own += 1.0 / frame_tiles_;
    part.near += 1.0 / frame_tiles_;
    parts_.push_back(part);
    return;
  }
  const PixelRect& rect = rects_[tile];
  const auto from = [&](int at) { return std::max(0, at - kReachPx) / cell_px_; };
  const auto to = [&](int at, int cells) {
    return std::min(cells, (at + kReachPx + cell_px_ - 1) / cell_px_);
  };
  size_t fresh = 0;
  for (int y = from(rect.y0 - top_); y < to(rect.y1 - top_, rows_); ++y) {
    for (int x = from(rect.x0 - left_); x < to(rect.x1 - left_, columns_); ++x) {
      const size_t cell = static_cast<size_t>(y) * static_cast<size_t>(columns_) + x;
      fresh += near_[cell] ? 0 : 1;
      near_[cell] = true;
    }
  }
  part.own += static_cast<double>(rect.area()) / all_px_;
  part.near += static_cast<double>(fresh) / static_cast<double>(near_.size());
  parts_.push_back(part);
}

void TimeLeft::Commit(uint32_t tile, double elapsed_s) {
  commits_s_.push_back(commits_s_.empty() ? elapsed_s : std::max(commits_s_.back(), elapsed_s));
  const bool knows_a_frame = before_ == 0 && commits_s_.size() >= frame_tiles_;
  if (!knows_a_frame || tiles_ < 2 * frame_tiles_) {
    Cover(tile);
    return;
  }
  rects_ = {};
  near_ = {};
  parts_ = {};
}

std::optional<double> TimeLeft::SecondsLeft(double elapsed_s) const {
  if (commits_s_.empty()) return std::nullopt;
  if (before_ + commits_s_.size() >= tiles_) return 0;
  if (parts_.empty()) return std::max(0.0, LeftOfSequence(elapsed_s));
  if (fit_.commits != commits_s_.size()) fit_ = FitFirstFrame();
  // Once the time is over in which the next tile should have come: as if it came now.
  return std::max(0.0, fit_.whole_s - std::clamp(elapsed_s, commits_s_.back(), fit_.next_s));
}

TimeLeft::Fit TimeLeft::FitFirstFrame() const {
  const size_t count = commits_s_.size();
  const double frames = static_cast<double>(tiles_) / frame_tiles_;
  const double last_s = commits_s_.back();
  const auto remaining = static_cast<double>(tiles_ - before_ - count);
  // The first commits, of a few tiles that happened to be dear, say least.
  const size_t first = count / 8;
  const size_t step = 1 + (count - first) / kFitPoints;
  Fit best;
  double least = 0;
  const auto try_with = [&](double share, double start) {
    const auto done_after = [&](size_t commits) {
      return std::max(1e-12, parts_[commits - 1].Of(share) - begin_.Of(share));
    };
    const double start_s = start * commits_s_.front();
    const double done = done_after(count);
    const double all = std::max(done, frames - begin_.Of(share));
    const double rate = (last_s - start_s) / done;
    double squares = 0;
    size_t points = 0;
    for (size_t j = first; j + 1 < count; j += step, ++points) {
      const double off = std::log(std::max(commits_s_[j], 1e-9) /
                                  std::max(start_s + rate * done_after(j + 1), 1e-9));
      squares += off * off;
    }
    const double usual = share - usual_share_;
    double error = kPriorWeight * usual * usual + kStartWeight * start * start;
    if (points > 0 && last_s > 0) {
      error += squares / static_cast<double>(points) * static_cast<double>(count);
    }
    if (best.commits == 0 || error < least) {
      least = error;
      const double next = std::min(all, done + (all - done) / remaining);
      best = {.commits = count, .whole_s = start_s + rate * all, .next_s = start_s + rate * next};
    }
  };
  for (double start = 0; start <= kLargestStart; start += kStartStep) {
    for (double share = 0; share <= kLargestShare; share += kShareStep) try_with(share, start);
  }
  return best;
}

double TimeLeft::LeftOfSequence(double elapsed_s) const {
  const size_t tiles = frame_tiles_;
  const size_t frames = commits_s_.size() / tiles;
  const auto end_of = [&](size_t frame) {
    return frame == 0 ? 0.0 : commits_s_[frame * tiles - 1];
  };
  // The first frame loads what the others find there: it counts only while there is no other.
  const size_t from = frames == 1 ? 0 : std::max<size_t>(1, frames - std::min(frames, kLastFrames));
  const double frame_s = (end_of(frames) - end_of(from)) / static_cast<double>(frames - from);
  // Where the last frame stood when it had as many tiles as the one in work.
  const size_t in_work = commits_s_.size() - frames * tiles;
  const double last_start = end_of(frames - 1), last_s = end_of(frames) - last_start;
  const auto share = [&](size_t count) {
    if (count == 0 || !(last_s > 0)) return 0.0;
    return (commits_s_[(frames - 1) * tiles + count - 1] - last_start) / last_s;
  };
  const double since = std::max(0.0, elapsed_s - commits_s_.back());
  const double done = std::min(share(in_work) * frame_s + since,
                               in_work + 1 < tiles ? share(in_work + 1) * frame_s : frame_s);
  const double total_frames = static_cast<double>(tiles_) / static_cast<double>(tiles);
  return frame_s * (total_frames - static_cast<double>(frames)) - done;
}

}  // namespace farpoint

#include "client/eta.h"

#include <algorithm>
#include <cmath>
#include <cstddef>

namespace farpoint {
namespace {

// How much the usual exponent weighs against the commits, in commits.
constexpr double kPriorWeight = 0.5;
constexpr double kLeastExponent = 0.5, kLargestExponent = 1.2;
// The frames by which the next ones are judged.
constexpr size_t kLastFrames = 3;

}  // namespace

void EtaEstimator::Update(const JobStatus& status, double now_s) {
  const bool had_tiles = started_;
  if (status.state == JobState::kPaused) {
    if (had_tiles && !paused_since_) paused_since_ = now_s;
  } else if (paused_since_) {
    paused_s_ += now_s - *paused_since_;
    paused_since_.reset();
  }
  if (had_tiles && status.tiles.committed < last_.tiles.committed) {
    *this = {};
  }
  last_ = status;
  if (!started_) {
    if (status.state != JobState::kRendering || status.tiles.total == 0) return;
    started_ = true;
    start_s_ = now_s;
    // What was committed before this looked has no time.
    before_ = status.tiles.committed;
    return;
  }
  const double elapsed = Elapsed(paused_since_.value_or(now_s));
  const size_t committed = status.tiles.committed - std::min(status.tiles.committed, before_);
  if (committed > commits_s_.size()) commits_s_.resize(committed, elapsed);
}

uint32_t EtaEstimator::TilesOfFrame() const {
  return std::max<uint32_t>(1, last_.tiles.total / std::max<uint32_t>(1, last_.frames.total));
}

std::optional<double> EtaEstimator::SecondsLeft(double now_s) const {
  if (!started_ || commits_s_.empty() || last_.state != JobState::kRendering) return std::nullopt;
  const double elapsed = Elapsed(now_s);
  // A frame is complete that began under our eyes.
  const bool knows_a_frame = before_ == 0 && commits_s_.size() >= TilesOfFrame() &&
                             last_.tiles.total >= 2 * TilesOfFrame();
  const double left = knows_a_frame ? LeftOfSequence(elapsed) : LeftOfFirstFrame(elapsed);
  return std::max(0.0, left);
}

double EtaEstimator::LeftOfFirstFrame(double elapsed_s) const {
  const double total = last_.tiles.total - before_;
  const auto count = static_cast<double>(commits_s_.size());
  // Least squares of log t over log j through the last commit; the first ones, of a few tiles that
  // happened to be dear, say least.
  double squares = kPriorWeight * count, products = kUsualExponent * squares;
  const double last_log = std::log(std::max(commits_s_.back(), 1e-9));
  for (size_t j = commits_s_.size() / 8; j + 1 < commits_s_.size(); ++j) {
    const double x = std::log((static_cast<double>(j) + 1) / count);
    products += x * (std::log(std::max(commits_s_[j], 1e-9)) - last_log);
    squares += x * x;
  }
  const double p = std::clamp(products / squares, kLeastExponent, kLargestExponent);
  const double whole = commits_s_.back() * std::pow(total / count, p);
  // Once that time is over, as if the next tile came now.
  const double next = commits_s_.back() * std::pow((count + 1) / count, p);
  return whole - std::min(elapsed_s, next);
}

double EtaEstimator::LeftOfSequence(double elapsed_s) const {
  const size_t tiles = TilesOfFrame();
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
  const double total_frames = static_cast<double>(last_.tiles.total) / static_cast<double>(tiles);
  return frame_s * (total_frames - static_cast<double>(frames)) - done;
}

}  // namespace farpoint

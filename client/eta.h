// How long a job will go on, from what is seen of it: the tiles' commits and the frames that they
// complete. A plain class without a clock: every call says what time it is.
//
// What it knows:
//   - Queueing and bakes before the first tile say nothing of the tiles: nothing is estimated then,
//     and their time counts for nothing afterwards. A pause does not count either.
//   - Of a frame the first tiles cost more than the later ones: scenes are loaded, and what
//     neighbours share is made. The time for j tiles is taken to grow as j^p, p fitted to the
//     commits and drawn towards kUsualExponent where there are few.
//   - Frames of a sequence resemble each other, bakes included: once one is complete, the others
//     take as long as the last ones, and the frame in work spends its time as the last one did.
#pragma once

#include <cstdint>
#include <optional>
#include <vector>

#include "proto/job.h"

namespace farpoint {

class EtaEstimator {
 public:
  // Between tiles that cost alike (1) and scenes whose records are nearly all made at the beginning
  // (0.5 to 0.7); what was measured lies around 0.95.
  static constexpr double kUsualExponent = 0.95;

  // `now_s` never falls. `status` is of one job; a committed count that falls (a requeue) starts
  // anew.
  void Update(const JobStatus& status, double now_s);

  // Seconds from `now_s` to the job's end; none before the first tile is committed, while the job
  // is paused and after its end.
  std::optional<double> SecondsLeft(double now_s) const;

 private:
  // Seconds of the clock without pauses since the tiles began.
  double Elapsed(double now_s) const { return now_s - start_s_ - paused_s_; }
  uint32_t TilesOfFrame() const;
  double LeftOfFirstFrame(double elapsed_s) const;
  double LeftOfSequence(double elapsed_s) const;

  JobStatus last_;
  bool started_ = false;
  double start_s_ = 0, paused_s_ = 0;
  std::optional<double> paused_since_;
  uint32_t before_ = 0;            // tiles that were there at the start
  std::vector<double> commits_s_;  // elapsed time at which one more tile was there; not falling
};

}  // namespace farpoint

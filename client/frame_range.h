// Frames of an animation by their numbers, as in "1-10x2,15". Pure functions, thread-safe.
#pragma once

#include <cstdint>
#include <span>
#include <string>
#include <string_view>
#include <vector>

#include "core/base/status.h"
#include "proto/job.h"

namespace farpoint {

// A list, with commas, of
//   a       one frame,
//   a-b     every frame from a to b, both included; downwards if b < a,
//   a-bxN   every Nth of these, a first (N >= 1),
// with blanks allowed around each. Numbers are 32-bit and may be negative. The frames in the order
// in which they are named; a frame that is named again is not repeated. kInvalidArgument names the
// part that is wrong and what is allowed; also for more than kMaxFrames (proto/job.h) of them,
// before anything is allocated.
absl::StatusOr<std::vector<int32_t>> ParseFrameRange(std::string_view text);

// A short text from which ParseFrameRange makes the same frames again; empty for none.
std::string FrameRangeText(std::span<const int32_t> frames);

}  // namespace farpoint

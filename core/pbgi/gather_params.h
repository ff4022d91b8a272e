// Parameters of the gather, as the kernels of core/pbgi need them.
#pragma once

#include <cstdint>

namespace farpoint {

enum class BufferMap : uint32_t {
  kOctahedral,  // the whole sphere, world-aligned
  kCosine,      // the hemisphere about a receiver's normal, warped by the cosine (pbgi, dpbgi)
};
enum class Splat : uint32_t {
  kCoverage,  // front to back, each node covers as much of a pixel as its solid angle
  kOpaque,    // classic: a node fills the pixels that it touches, the nearest wins
};

}  // namespace farpoint

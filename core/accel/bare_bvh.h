// Embree's own builder of bounding volume hierarchies, to measure others against.
#pragma once

#include <cstddef>
#include <memory>
#include <span>

#include "core/base/status.h"
#include "core/math/vec.h"

namespace farpoint {

class BareBvh {
 public:
  enum class Quality { kLow, kMedium };  // RTC_BUILD_QUALITY_LOW (Morton), _MEDIUM (binned SAH)

  // A builder of up to `threads` threads. kUnavailable if Embree gives no device.
  static absl::StatusOr<std::unique_ptr<BareBvh>> Create(unsigned threads);
  ~BareBvh();
  BareBvh(const BareBvh&) = delete;
  BareBvh& operator=(const BareBvh&) = delete;

  // rtcBuildBVH over the boxes, eight children to a node, up to eight boxes to a leaf, nodes and
  // leaves stored with their bounds. Returns the nodes and leaves that were made; the hierarchy
  // itself is thrown away. kUnavailable: Embree's error. One call at a time.
  absl::StatusOr<size_t> Build(std::span<const Box3f> boxes, Quality quality);

 private:
  struct Impl;
  explicit BareBvh(std::unique_ptr<Impl> impl);
  std::unique_ptr<Impl> impl_;
};

}  // namespace farpoint

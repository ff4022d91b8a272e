#pragma once

#include <cstddef>
#include <span>

#include "core/base/status.h"

namespace farpoint {

// A blob that arrives in pieces. One thread at a time.
class BlobWriter {
 public:
  virtual ~BlobWriter() = default;  // without Commit(): what was written is dropped
  // kInvalidArgument if more arrives than was announced.
  virtual absl::Status Append(std::span<const std::byte> data) = 0;
  // Makes the blob durable. kDataLoss if size or hash differ from what was announced.
  virtual absl::Status Commit() = 0;
};

}  // namespace farpoint

// A stable parallel sort of 64-bit keys that carry an index.
#pragma once

#include <cstdint>

#include "core/base/bulk_vector.h"
#include "core/base/executor.h"

namespace farpoint {

struct KeyedIndex {
  uint64_t key;
  uint32_t index;
};

// Sorts by key; equal keys keep their order. O(n) for each 11 bits in which keys differ (least
// significant digit first), and as much memory again. The same result for any number of threads.
void SortByKey(BulkVector<KeyedIndex>& items, Executor& executor);

}  // namespace farpoint

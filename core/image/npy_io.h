// NumPy's .npy files, as far as masks need them.
#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include "core/base/status.h"

namespace farpoint {

struct NpyArray2d {
  int rows = 0, cols = 0;
  std::vector<double> values;  // rows x cols, row-major
};

// Format versions 1 to 3, dtype bool, u1, little-endian f4 or f8, C order, two dimensions of at
// most 65536 each. Anything else, and any file whose length is not that of its array, is refused:
// kInvalidArgument or kDataLoss name the file and what was found. Nothing is allocated from a size
// that was not checked against the file's.
absl::StatusOr<NpyArray2d> ReadNpy2d(const std::string& path);

}  // namespace farpoint

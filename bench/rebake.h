// What a bake costs after another one of nearly the same scene: docs/benchmarks.md.
#pragma once

#include <cstdint>
#include <functional>
#include <optional>
#include <string>
#include <string_view>
#include <vector>

#include "bench/bench_scene.h"
#include "core/base/stats.h"
#include "core/base/status.h"
#include "core/math/vec.h"

namespace farpoint {

struct RebakeOptions {
  std::string scene = "cornell";  // as for MakeBenchScene
  SceneChanges changes;
  uint64_t points = 0;  // 0: the scene's default
  uint32_t light_samples = 32;
  uint64_t seed = 0;
  uint32_t object = ~0u;  // index of the instance that moves; beyond the last: the last
  uint32_t repeat = 3;
  unsigned threads = 0;  // 0: all cores
  uint64_t cache_bytes = uint64_t{4} << 30;
  bool quick = false;  // 20,000 surfels, once
};

// One change of the scene, baked cold and with the cache of a bake before the change.
struct RebakeCase {
  std::string name, what;
  // Medians of the repeats.
  double cold_s = 0, warm_s = 0;
  Stats cold, warm;              // of the repeat with the median time
  bool topology_same_as_before;  // its blob need not be sent again
};

struct RebakeReport {
  RebakeOptions options;
  uint64_t triangles = 0, surfels = 0, cache_bytes_used = 0;
  double import_s = 0;  // reading the files, not part of the cases
  std::vector<RebakeCase> cases;
};

// kInternal if a warm bake's blobs differ from the cold one's by a bit. Errors of the scene are
// those of MakeBenchScene and Bake.
absl::StatusOr<RebakeReport> RunRebake(const RebakeOptions& options,
                                       const std::function<void(std::string_view)>& log);

std::string RebakeJson(const RebakeReport& report);
std::string RebakeTable(const RebakeReport& report);

}  // namespace farpoint

// What a run did: seconds by stage, counts, and what was skipped. The keys of the `--json` file.
#pragma once

#include <array>
#include <cstdint>
#include <map>
#include <string>

namespace farpoint {

enum class Stage {
  kImport,
  kSample,
  kShade,
  kTree,
  kBroadcast,
  kPrimary,
  kDirect,
  kCluster,
  kCut,
  kRaster,
  kComposite,
  kConvolve,
  kTrace,
};
inline constexpr int kStageCount = 13;
inline constexpr std::array<const char*, kStageCount> kStageNames = {
    "import",  "sample", "shade",  "tree",      "broadcast", "primary", "direct",
    "cluster", "cut",    "raster", "composite", "convolve",  "trace"};

// Plain sums: merge with +=. Not thread-safe; each block has its own, merged in block order.
struct Stats {
  std::array<double, kStageCount> seconds{};       // thread-seconds by stage
  std::array<double, kStageCount> wall_seconds{};  // wall-clock seconds by stage
  std::map<std::string, uint64_t> counts;          // triangles, surfels, nodes, receivers, …
  std::map<std::string, uint64_t> skipped;         // what was not computed, by reason
  std::map<std::string, uint64_t> bytes;           // tree, scene, peak_rss

  Stats& operator+=(const Stats& other) {
    for (int i = 0; i < kStageCount; ++i) {
      seconds[i] += other.seconds[i];
      wall_seconds[i] += other.wall_seconds[i];
    }
    for (const auto& [k, v] : other.counts) counts[k] += v;
    for (const auto& [k, v] : other.skipped) skipped[k] += v;
    for (const auto& [k, v] : other.bytes) bytes[k] += v;
    return *this;
  }
};

}  // namespace farpoint

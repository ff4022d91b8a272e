// From the files of an asset to what workers need: the step between Submit and the first tile.
#pragma once

#include <atomic>
#include <cstdint>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "core/base/hash.h"
#include "core/base/stats.h"
#include "core/base/status.h"
#include "core/render/bake.h"
#include "core/scene/asset.h"
#include "proto/job.h"

namespace farpoint {

struct BakeResult {
  BakedScene blobs;
  std::vector<Camera> cameras;     // of the scene, or one made up: not empty
  bool made_up_camera = false;     // then a note beginning with "no camera" says so
  std::vector<std::string> notes;  // one line each
  bool animated = false;           // another time may give another scene
  Stats stats;
};

// Thread-safe.
class SceneBaker {
 public:
  virtual ~SceneBaker() = default;
  // The scene at `time_s`; nothing: at rest. `cancel` is looked at between the stages: kCancelled.
  // Limits of `spec` that the scene exceeds are kResourceExhausted; whatever is wrong with the
  // scene is kInvalidArgument or kNotFound.
  virtual absl::StatusOr<BakeResult> Bake(const AssetBundle& asset, const JobSpec& spec,
                                          std::optional<double> time_s,
                                          const std::atomic<bool>& cancel) = 0;
};

// What a baker keeps in memory for later bakes, if not told otherwise.
inline constexpr uint64_t kDefaultBakeCacheBytes = uint64_t{2} << 30;

// Import, overrides, camera and light if there are none, Bake: on `threads` threads (0: all cores).
// Products of its stages are kept, at most `cache_bytes` of them (0: none), so that a bake of
// nearly the same scene does again only what the change affects (core/render/bake.h); the result is
// that of a first bake. Surfels of an animated scene lie as densely at all times as at rest.
std::shared_ptr<SceneBaker> MakeCoreBaker(unsigned threads,
                                          uint64_t cache_bytes = kDefaultBakeCacheBytes);

// What decides a bake's blobs and nothing else: the asset's files, overrides, light units, the
// settings that Bake reads, and this version. Jobs with equal keys share their blobs. Settings that
// only the tiles need are left out by name, so that a new one counts until it is known to be free.
// This is the key of a scene that is the same at all times.
Digest BakeKey(const JobSpec& spec);
// The key of an animated scene at one time, or at rest.
Digest BakeKeyAt(const JobSpec& spec, std::optional<double> time_s);

}  // namespace farpoint

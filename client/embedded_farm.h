// The embedded mode: a coordinator and workers within this process, joined by calls instead of
// sockets. The one place where the client knows server and worker.
#pragma once

#include <memory>

#include "client/console.h"
#include "client/farm_link.h"
#include "client/stop_flag.h"
#include "core/base/status.h"

namespace farpoint {

struct EmbeddedFarmOptions {
  uint32_t workers = 1;
  uint32_t threads = 0;  // of each worker and of the bake; 0: all cores
  // Scenes and tiles lie in a folder among the temporary files (TMPDIR), which is removed at the
  // end, instead of in memory: a sequence is larger than that.
  bool on_disk = false;
};

// Runs until it is destroyed; tiles in work are then dropped. `stop` and `console` must outlive it.
absl::StatusOr<std::unique_ptr<FarmLink>> StartEmbeddedFarm(const EmbeddedFarmOptions& options,
                                                            const StopFlag& stop, Console& console);

}  // namespace farpoint

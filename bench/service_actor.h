// Processes of the service's benchmark that misbehave on purpose, so that the real programs need no
// switch for it: made of the same classes as farpoint-worker and farpoint-server, with a fault
// around them.
#pragma once

#include <cstdint>
#include <memory>
#include <string>

#include "worker/tile_renderer.h"

namespace farpoint {

// What an actor's renderer does. Places are pixels: the block that holds one is meant.
struct RendererFaults {
  bool null = false;               // tiles of zeros, without computing
  int tile_ms = 0;                 // each takes so long more, with progress
  int crash_x = -1, crash_y = -1;  // SIGSEGV in that block
  int hang_x = -1, hang_y = -1;    // computes that block for ever without a processor
  int spin_x = -1, spin_y = -1;    // and with one
  double wrong = 0;                // share of tiles with a pixel that is not right
  bool fails = false;              // every tile
  uint64_t seed = 1;
};
std::unique_ptr<TileRenderer> MakeFaultyRenderer(const RendererFaults& faults);

// Roles, for RunServiceActor:
//   worker  coordinator= cache= name= and what RendererFaults names (crash=X,Y hang=X,Y)
//   server  store= port= kill_at=N: dies at the Nth point at which its job store writes
//   getter  coordinator= cache= blob= [blob_dir=] [pause_us=]: fetches a blob as a worker does

}  // namespace farpoint

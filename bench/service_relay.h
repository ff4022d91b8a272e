// A bad network between two processes: passes TCP connections on to a port of this machine, and
// delays, stalls, slows, resets, silences or damages them. TCP puts what it carries in order, so
// what reordering and loss do to a program is delay and stalls, which is what this makes.
#pragma once

#include <atomic>
#include <chrono>
#include <cstdint>
#include <list>
#include <memory>
#include <mutex>
#include <thread>

#include "core/base/status.h"

namespace farpoint {

struct RelayFaults {
  std::chrono::milliseconds delay{0};      // each way
  double stall = 0;                        // chance of each piece of up to 1400 bytes to be …
  std::chrono::milliseconds stalled{200};  // … late by so much, with all that follows
  double reset = 0;                        // chance of each piece to end its connection
  double flip = 0;                         // chance of each piece to have a bit flipped
  uint64_t bytes_per_second = 0;           // each way; 0: no limit
};

// Thread-safe.
class Relay {
 public:
  // Listens on a port of 127.0.0.1.
  static absl::StatusOr<std::unique_ptr<Relay>> Start(int target_port, uint64_t seed,
                                                      const RelayFaults& faults = {});
  ~Relay();

  int port() const { return port_; }
  // Silent: nothing passes and nothing is closed, as if the cable were cut. What was to pass is
  // lost with its connections when it ends.
  void SetSilent(bool silent) { silent_ = silent; }
  void ResetAll();  // ends all connections; new ones are taken
  // That went from the target to those who connected.
  uint64_t bytes_down() const { return bytes_down_; }
  uint64_t connections() const { return accepted_; }
  uint64_t flipped() const { return flipped_; }

 private:
  struct Link;
  Relay(int listener, int port, int target_port, uint64_t seed, const RelayFaults& faults);
  void Accept();
  void Pump(Link& link, int from, int to, bool down, uint64_t seed);

  const int listener_, port_, target_port_;
  const uint64_t seed_;
  const RelayFaults faults_;
  std::atomic<bool> ending_ = false, silent_ = false;
  std::atomic<uint64_t> bytes_down_ = 0, accepted_ = 0, flipped_ = 0;
  std::mutex mutex_;
  std::list<std::unique_ptr<Link>> links_;  // guarded by mutex_
  std::thread acceptor_;
};

}  // namespace farpoint

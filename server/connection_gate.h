// Takes the connections of a coordinator and hands on those that speak its protocol. A peer that
// says nothing, something else or TLS to a coordinator without it (or the reverse) never reaches
// gRPC: it costs a descriptor and no memory to speak of, is told what is wrong in words of its own
// protocol, and is logged. Connections are limited, together and for each host. No gRPC.
// Thread-safe.
#pragma once

#include <chrono>
#include <cstddef>
#include <functional>
#include <memory>
#include <string>

#include "core/base/status.h"

namespace farpoint {

struct ConnectionGateOptions {
  std::string address;  // HOST:PORT; port 0: any free one
  bool tls = false;     // what the coordinator speaks
  size_t max_connections = 8192;
  size_t max_per_host = 4096;
  // How long a peer may take until it has said what it speaks.
  std::chrono::milliseconds patience{10000};
  // Of the connections that were refused; at most 20 lines in ten seconds.
  std::function<void(std::string)> refused;
};

class ConnectionGate {
 public:
  // Owns the descriptor from here on. Called from one thread.
  using Handover = std::function<void(int descriptor)>;

  // Listens from now on; nobody is let in before Start(). kUnavailable if the address is taken or
  // is not this machine's.
  static absl::StatusOr<std::unique_ptr<ConnectionGate>> Listen(ConnectionGateOptions options);
  virtual ~ConnectionGate() = default;  // Stop()

  virtual void Start(Handover handover) = 0;
  // Nobody is let in any more; who was let in stays. The handover is not called after this.
  virtual void Stop() = 0;

  virtual int port() const = 0;
  // Open now, those that were handed on among them.
  virtual size_t connections() = 0;
};

}  // namespace farpoint

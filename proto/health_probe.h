// What an orchestrator asks from within a container: is this process able to serve? Of a
// coordinator by gRPC's health protocol (grpc.health.v1), of a worker, which has no gRPC port, by
// its metrics. No rights are needed for either.
#pragma once

#include <chrono>
#include <optional>
#include <string>

#include "core/base/status.h"

namespace farpoint {

// How to reach a coordinator that speaks TLS.
struct HealthTls {
  std::string ca;    // PEM
  std::string name;  // that its certificate must name; empty: the address's host
};

// OK if the server at `address` (HOST:PORT) says SERVING within `timeout`, which ends a coordinator
// that drains, too.
//   kUnavailable        it does not answer, or says that it does not serve
//   kFailedPrecondition it speaks another protocol, or has no health service
//   kUnauthenticated    its certificate was refused
// The process must ignore SIGPIPE.
absl::Status AskHealth(const std::string& address, const std::optional<HealthTls>& tls,
                       std::chrono::milliseconds timeout);

// OK if http://ADDRESS/metrics answers with status 200 and a metric of farpoint's within `timeout`.
// kUnavailable: nobody answers in time; kFailedPrecondition: somebody else does.
absl::Status AskMetrics(const std::string& address, std::chrono::milliseconds timeout);

}  // namespace farpoint

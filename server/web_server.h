// The coordinator over HTTP, for people and Prometheus: metrics, and with `page` a page that shows
// jobs, workers and images and lets jobs be paused, cancelled and requeued. docs/web.md has every
// path. Beside /metrics, the page's own files and nothing else, every request is held against the
// rules of the API (GrpcServer::Admit) under the name of the method that it stands for.
#pragma once

#include <memory>
#include <optional>
#include <string>

#include "core/base/status.h"
#include "proto/http_server.h"
#include "server/coordinator_meter.h"
#include "server/grpc_server.h"

namespace farpoint {

struct WebServerOptions {
  std::string address;             // HOST:PORT, port 0: any free one
  std::optional<TlsMaterial> tls;  // none: in the clear
  bool page = true;                // false: /metrics only
  // /metrics for everybody who reaches the port. In any case that is so where `api` has no TLS.
  bool open_metrics = false;
};

// `meter` and `api` must outlive the server. Without TLS on loopback, requests whose Host is not
// this machine are refused: pages of strangers in a browser here could pass for it otherwise.
absl::StatusOr<std::unique_ptr<HttpServer>> StartWebServer(WebServerOptions options,
                                                           CoordinatorMeter& meter,
                                                           GrpcServer& api);

}  // namespace farpoint

// A small HTTP/1.1 server for people and their tools: short requests, whole answers, in the clear
// or over TLS; who speaks in the clear to one that wants TLS is told so. It is built to stand
// beside a service that matters more: threads, connections, bytes and seconds of a request are
// bounded. A connection that says nothing is not even taken from the system's queue; others wait
// there while all threads are busy.
#pragma once

#include <chrono>
#include <functional>
#include <map>
#include <memory>
#include <optional>
#include <string>

#include "core/base/status.h"
#include "proto/tls_files.h"

namespace farpoint {

struct HttpRequest {
  std::string method;  // "GET", "HEAD", "POST"
  std::string path;    // decoded, without the query
  std::map<std::string, std::string> query;
  std::map<std::string, std::string> headers;  // names in lower case; the first of each name
  std::string certificates;                    // PEM that the peer has shown; empty: none
  // Empty if it is not there.
  std::string Header(const std::string& name) const;
  std::string Query(const std::string& name) const;
};

struct HttpResponse {
  int status = 200;
  std::string content_type = "text/plain; charset=utf-8";
  std::string body;
};

// The HTTP status that means what `status` means; 200 for OK.
int HttpStatusOf(const absl::Status& status);

struct HttpServerOptions {
  std::string address;             // HOST:PORT, port 0: any free one
  std::optional<TlsMaterial> tls;  // none: in the clear
  // Ask the peer for a certificate; whether one comes and is any good is for the handler to say.
  bool ask_for_certificate = false;
  size_t threads = 16;
  // From a request's first byte to its last, and for the peer to take the answer.
  std::chrono::milliseconds request_time{5000};
  std::chrono::milliseconds idle_time{1000};  // between requests of a connection
  size_t max_header_bytes = 16 << 10;         // of a request, its first line included
  size_t max_body_bytes = 4 << 10;
};

class HttpServer {
 public:
  // Called by several threads at once. Exceptions must not leave it.
  using Handler = std::function<HttpResponse(const HttpRequest&)>;

  // kUnavailable: the address is taken or not this machine's; kInvalidArgument: certificate or key
  // cannot be used. HEAD and GET reach the handler alike. Every answer carries a Content-Security-
  // Policy that allows what comes from this server and nothing else, and is not to be cached.
  static absl::StatusOr<std::unique_ptr<HttpServer>> Start(HttpServerOptions options,
                                                           Handler handler);
  // Requests in work are answered first.
  virtual ~HttpServer() = default;
  virtual int port() const = 0;
  // New connections see this certificate; those that are open go on. kInvalidArgument: it cannot be
  // used, and the one before stays. kFailedPrecondition: this server speaks in the clear.
  virtual absl::Status Renew(const TlsMaterial& tls) = 0;
};

}  // namespace farpoint

// Why a connection to a coordinator fails, found out step by step: name, port, protocol,
// certificates. gRPC says of all of these only that it could not connect.
#pragma once

#include <chrono>
#include <optional>
#include <string>

#include "core/base/status.h"
#include "proto/tls_files.h"

namespace farpoint {

// How a client or worker proves who it is; nothing set: in the clear.
struct ChannelSecurity {
  std::optional<TlsMaterial> tls;
  std::string token;  // with TLS only; empty: none
};

// Reads a token from a file: its first line. kFailedPrecondition if others may read the file or it
// holds no token.
absl::StatusOr<std::string> ReadTokenFile(const std::string& path);

// Connects to `address` (HOST:PORT) as `security` says, up to the first bytes of HTTP/2, within
// `timeout`. The text names cause and cure.
//   kUnavailable        nobody listens, no route, no answer in time, the name does not resolve
//   kFailedPrecondition another kind of server answers (plaintext for TLS, TLS for plaintext,
//   HTTP/1,
//                       something else)
//   kUnauthenticated    a certificate was refused, by us or by the coordinator
// The process must ignore SIGPIPE.
absl::Status ProbeConnection(const std::string& address, const ChannelSecurity& security,
                             std::chrono::milliseconds timeout);

}  // namespace farpoint

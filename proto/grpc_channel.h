// How farpoint's processes connect: keepalive, message sizes, deadlines, encryption. One place for
// both sides, since a server that expects fewer pings than its clients send cuts them off.
#pragma once

#include <grpcpp/channel.h>
#include <grpcpp/client_context.h>
#include <grpcpp/security/server_credentials.h>
#include <grpcpp/server_builder.h>

#include <chrono>
#include <memory>
#include <string>

#include "proto/connection_probe.h"

namespace farpoint {

// Job descriptions with their lists of files and tiles are the largest messages; bulk data travel
// in chunks of 1 MiB. What is larger is refused before it is read.
inline constexpr int kMaxRequestBytes = 32 << 20;
inline constexpr int kMaxResponseBytes = 128 << 20;

// Connects in the background. Without keepalive a link that goes down would never be noticed; with
// it in 3 s. Channels of one process to one address share a connection, but for those with one of
// their own.
std::shared_ptr<grpc::Channel> OpenChannel(const std::string& address,
                                           const ChannelSecurity& security = {},
                                           bool own_connection = false);

// Waits up to `time` for a channel whose connection has failed; at once if it stands or was never
// tried. gRPC goes on with an attempt to connect only while somebody waits for it, and a call on a
// channel that failed does not wait: who only calls again and again may never be connected.
void AwaitConnection(grpc::Channel& channel, std::chrono::milliseconds time);

// What of a failed call's cause can be found out by looking: with a connection that failed
// (kUnavailable), ProbeConnection's answer if that is worth more; else `status` as it is.
absl::Status ExplainFailure(const absl::Status& status, const std::string& address,
                            const ChannelSecurity& security);

// What a server's connections may hold in memory together, unread messages above all. Beyond it the
// library closes idle connections, then ends calls with RESOURCE_EXHAUSTED: a message of many MiB
// is gathered whole before its size is looked at.
inline constexpr size_t kDefaultNetworkBytes = size_t{48} << 20;

// The same on the server's side: keepalive, limits of messages, streams, memory and time to
// connect.
void ConfigureServer(grpc::ServerBuilder& builder, size_t network_bytes = kDefaultNetworkBytes);
// Asks every peer for a certificate and takes whatever comes: who uses this checks each call.
std::shared_ptr<grpc::ServerCredentials> ServerTls(const TlsMaterial& material);

inline void SetDeadline(grpc::ClientContext& context, std::chrono::milliseconds timeout) {
  context.set_deadline(std::chrono::system_clock::now() + timeout);
}

}  // namespace farpoint

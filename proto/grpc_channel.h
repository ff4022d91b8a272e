// How farpoint's processes connect: keepalive, message sizes, deadlines. One place for both sides,
// since a server that expects fewer pings than its clients send cuts them off.
#pragma once

#include <grpcpp/channel.h>
#include <grpcpp/client_context.h>
#include <grpcpp/server_builder.h>

#include <chrono>
#include <memory>
#include <string>

namespace farpoint {

// Connects in the background. Without keepalive a link that goes down would never be noticed; with
// it in 3 s.
std::shared_ptr<grpc::Channel> OpenChannel(const std::string& address);

// The same on the server's side.
void ConfigureServer(grpc::ServerBuilder& builder);

inline void SetDeadline(grpc::ClientContext& context, std::chrono::milliseconds timeout) {
  context.set_deadline(std::chrono::system_clock::now() + timeout);
}

}  // namespace farpoint

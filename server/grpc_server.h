// The coordinator on a socket: BlobService, JobService and WorkerService, gRPC health v1 and
// reflection. With TLS every call is held against AccessGuard before its handler runs.
#pragma once

#include <chrono>
#include <functional>
#include <memory>
#include <optional>
#include <string>
#include <string_view>

#include "core/base/status.h"
#include "proto/tls_files.h"
#include "server/access_guard.h"
#include "server/client_ledger.h"
#include "server/coordinator.h"
#include "server/server_facts.h"

namespace farpoint {

struct GrpcServerOptions {
  std::optional<TlsMaterial> tls;  // none: in the clear, and everybody may do everything
  std::string tokens_file, revoked_file;
  double calls_per_second = 500;  // of a client
  size_t max_connections = 8192, max_connections_per_host = 4096;
  size_t network_bytes = size_t{48} << 20;  // proto/grpc_channel.h, ConfigureServer
  // With TLS: what clients own and may use; its ledger lies in this file (empty: in memory).
  std::string ledger_file;
  std::function<bool(const Digest&)> has_blob;                 // ClientLedgerOptions
  uint64_t max_jobs_per_client = 0, max_bytes_per_client = 0;  // 0: no limit
  std::string blob_directory;                                  // shared with workers; empty: none
  // What the coordinator's health is asked for (Diagnose); connections, limits of clients, the
  // certificate and the shared folder are filled in by this.
  std::function<ServerFacts()> facts;
  // Of calls and connections that were refused, at most some in ten seconds.
  std::function<void(std::string)> refused;
};

class GrpcServer {
 public:
  // Listens on `address` (host:port, port 0: any free one). kUnavailable if it is taken.
  // `coordinator` must outlive this.
  static absl::StatusOr<std::unique_ptr<GrpcServer>> Start(CoordinatorApi& coordinator,
                                                           const std::string& address,
                                                           GrpcServerOptions options = {});
  virtual ~GrpcServer() = default;  // Shutdown(0)

  virtual int port() const = 0;

  // For other ways in beside gRPC, by the same rules: who calls, by the header `authorization`, if
  // it may call `method` ("/farpoint.v1.JobService/Status"); without TLS an admin. Errors as
  // AccessGuard::Admit.
  virtual absl::StatusOr<Caller> Admit(std::string_view method, std::string_view authorization) = 0;
  // Whether the caller may change the job; kNotFound, kPermissionDenied.
  virtual absl::Status MayChange(const Caller& caller, const JobId& job) = 0;
  virtual std::string OwnerOf(const JobId& job) = 0;  // empty: not known
  virtual uint64_t connections() const = 0;
  virtual AccessGuard::Refusals refusals() = 0;
  virtual const Traffic& traffic() const = 0;
  virtual bool draining() const = 0;

  // New connections see this certificate; those that stand keep theirs, but for those that have
  // outlived several. kUnavailable if it cannot be used: then nothing changes.
  virtual absl::Status Renew(const TlsMaterial& tls) = 0;

  // Health says NOT_SERVING from now on; calls still go through.
  virtual void StopServing() = 0;
  // Takes no more calls; those in progress have `grace` to end.
  virtual void Shutdown(std::chrono::milliseconds grace) = 0;
};

}  // namespace farpoint

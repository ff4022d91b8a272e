// The thin layer between messages and CoordinatorApi: decode, call, encode. One .cc per service.
// Everything that is passed in must outlive them.
#pragma once

#include <grpcpp/support/status.h>

#include <functional>
#include <memory>

#include "server/access_guard.h"
#include "server/client_ledger.h"
#include "server/coordinator.h"
#include "server/server_facts.h"

namespace grpc {
class Service;
class ServerContextBase;
}  // namespace grpc

namespace farpoint {

// What the services know of their callers.
struct ServiceAccess {
  AccessGuard* guard = nullptr;  // null: callers cannot be told apart, everybody may do everything
  ClientLedger* ledger = nullptr;      // null: nothing is limited for each client
  std::function<ServerFacts()> facts;  // none: nothing is known
  Traffic* traffic = nullptr;          // null: not counted
};
// OK if the caller may change the job: it is an admin's or its own. kNotFound, kPermissionDenied.
absl::Status MayChange(const Caller& caller, const ServiceAccess& access,
                       CoordinatorApi& coordinator, const JobId& job);
// Of a call that the guard admitted. kUnauthenticated if its certificate has expired meanwhile.
absl::StatusOr<Caller> CallerOf(const grpc::ServerContextBase& context,
                                const ServiceAccess& access);

std::unique_ptr<grpc::Service> MakeBlobService(CoordinatorApi& coordinator,
                                               const ServiceAccess& access);
std::unique_ptr<grpc::Service> MakeJobService(CoordinatorApi& coordinator,
                                              const ServiceAccess& access);
std::unique_ptr<grpc::Service> MakeWorkerService(CoordinatorApi& coordinator,
                                                 const ServiceAccess& access);

}  // namespace farpoint

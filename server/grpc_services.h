// The thin layer between messages and CoordinatorApi: decode, call, encode. One .cc per service.
// The coordinator must outlive them.
#pragma once

#include <grpcpp/support/status.h>

#include <memory>

#include "server/coordinator.h"

namespace grpc {
class Service;
}

namespace farpoint {

std::unique_ptr<grpc::Service> MakeBlobService(CoordinatorApi& coordinator);
std::unique_ptr<grpc::Service> MakeJobService(CoordinatorApi& coordinator);
std::unique_ptr<grpc::Service> MakeWorkerService(CoordinatorApi& coordinator);

}  // namespace farpoint

#include "server/grpc_server.h"

#include <grpcpp/ext/proto_server_reflection_plugin.h>
#include <grpcpp/health_check_service_interface.h>
#include <grpcpp/impl/codegen/service_type.h>
#include <grpcpp/security/server_credentials.h>
#include <grpcpp/server.h>
#include <grpcpp/server_builder.h>

#include "proto/grpc_channel.h"
#include "server/grpc_services.h"

namespace farpoint {

namespace {

class GrpcServerImpl final : public GrpcServer {
 public:
  explicit GrpcServerImpl(CoordinatorApi& coordinator)
      : blobs_(MakeBlobService(coordinator)),
        jobs_(MakeJobService(coordinator)),
        workers_(MakeWorkerService(coordinator)) {}
  ~GrpcServerImpl() override {
    if (server_ != nullptr) Shutdown(std::chrono::milliseconds(0));
  }

  absl::Status Listen(const std::string& address) {
    grpc::EnableDefaultHealthCheckService(true);
    // Registering twice would be an error; several servers in one process are a test's business.
    static const bool reflection = [] {
      grpc::reflection::InitProtoReflectionServerBuilderPlugin();
      return true;
    }();
    (void)reflection;
    grpc::ServerBuilder builder;
    ConfigureServer(builder);
    builder.AddListeningPort(address, grpc::InsecureServerCredentials(), &port_);
    builder.RegisterService(blobs_.get());
    builder.RegisterService(jobs_.get());
    builder.RegisterService(workers_.get());
    server_ = builder.BuildAndStart();
    if (server_ == nullptr || port_ == 0) {
      return absl::UnavailableError("cannot listen on '" + address +
                                    "'; is the port taken, or the address not this machine's?");
    }
    server_->GetHealthCheckService()->SetServingStatus(true);
    return absl::OkStatus();
  }

  int port() const override { return port_; }
  void StopServing() override { server_->GetHealthCheckService()->SetServingStatus(false); }
  void Shutdown(std::chrono::milliseconds grace) override {
    server_->Shutdown(std::chrono::system_clock::now() + grace);
    server_->Wait();
  }

 private:
  const std::unique_ptr<grpc::Service> blobs_, jobs_, workers_;
  std::unique_ptr<grpc::Server> server_;
  int port_ = 0;
};

}  // namespace

absl::StatusOr<std::unique_ptr<GrpcServer>> GrpcServer::Start(CoordinatorApi& coordinator,
                                                              const std::string& address) {
  auto server = std::make_unique<GrpcServerImpl>(coordinator);
  FP_RETURN_IF_ERROR(server->Listen(address));
  return server;
}

}  // namespace farpoint

#include "server/grpc_server.h"

#include <grpcpp/ext/proto_server_reflection_plugin.h>
#include <grpcpp/health_check_service_interface.h>
#include <grpcpp/impl/codegen/service_type.h>
#include <grpcpp/security/auth_metadata_processor.h>
#include <grpcpp/security/server_credentials.h>
#include <grpcpp/server.h>
#include <grpcpp/server_builder.h>
#include <unistd.h>

#include <atomic>

#include "proto/grpc_channel.h"
#include "proto/grpc_status.h"
#include "server/connection_gate.h"
#include "server/grpc_services.h"

namespace farpoint {

namespace {

std::string_view View(const grpc::string_ref& text) { return {text.data(), text.size()}; }

// The peer's own certificate; there is none between it and the authority.
std::string_view CertificateOf(const grpc::AuthContext& context) {
  const auto found = context.FindPropertyValues(GRPC_X509_PEM_CERT_PROPERTY_NAME);
  return found.empty() ? std::string_view() : View(found.front());
}

template <typename Metadata>
std::string_view HeaderOf(const Metadata& metadata, const char* name) {
  const auto at = metadata.find(name);
  return at == metadata.end() ? std::string_view() : View(at->second);
}

// gRPC asks it about every call, once the headers are there and before anything else is read.
class GuardProcessor final : public grpc::AuthMetadataProcessor {
 public:
  explicit GuardProcessor(AccessGuard& guard) : guard_(guard) {}
  // In gRPC's own thread: what it does takes microseconds, but for a certificate's first call.
  bool IsBlocking() const override { return false; }
  grpc::Status Process(const InputMetadata& metadata, grpc::AuthContext* context, OutputMetadata*,
                       OutputMetadata*) override {
    return ToGrpc(guard_.Admit(HeaderOf(metadata, ":path"),
                               {CertificateOf(*context), HeaderOf(metadata, "authorization")}));
  }

 private:
  AccessGuard& guard_;
};

class GrpcServerImpl final : public GrpcServer {
 public:
  GrpcServerImpl(CoordinatorApi& coordinator, GrpcServerOptions options)
      : coordinator_(coordinator), options_(std::move(options)) {
    if (!options_.tls) return;
    guard_ =
        std::make_unique<AccessGuard>(AccessOptions{.ca = options_.tls->ca,
                                                    .tokens_file = options_.tokens_file,
                                                    .revoked_file = options_.revoked_file,
                                                    .calls_per_second = options_.calls_per_second,
                                                    .clock = nullptr,
                                                    .unix_s = nullptr,
                                                    .refused = options_.refused});
  }
  ~GrpcServerImpl() override {
    if (server_ != nullptr) Shutdown(std::chrono::milliseconds(0));
  }

  absl::Status Listen(const std::string& address) {
    FP_ASSIGN_OR_RETURN(gate_,
                        ConnectionGate::Listen({.address = address,
                                                .tls = options_.tls.has_value(),
                                                .max_connections = options_.max_connections,
                                                .max_per_host = options_.max_connections_per_host,
                                                .refused = options_.refused}));
    FP_RETURN_IF_ERROR(MakeServices());
    grpc::EnableDefaultHealthCheckService(true);
    // Registering twice would be an error; several servers in one process are a test's business.
    static const bool reflection = [] {
      grpc::reflection::InitProtoReflectionServerBuilderPlugin();
      return true;
    }();
    (void)reflection;
    grpc::ServerBuilder builder;
    ConfigureServer(builder, options_.network_bytes);
    std::shared_ptr<grpc::ServerCredentials> credentials = grpc::InsecureServerCredentials();
    if (options_.tls) {
      credentials = ServerTls(*options_.tls);
      credentials->SetAuthMetadataProcessor(std::make_shared<GuardProcessor>(*guard_));
    }
    acceptor_ = builder.experimental().AddExternalConnectionAcceptor(
        grpc::ServerBuilder::experimental_type::ExternalConnectionType::FROM_FD, credentials);
    builder.RegisterService(blobs_.get());
    builder.RegisterService(jobs_.get());
    builder.RegisterService(workers_.get());
    server_ = builder.BuildAndStart();
    if (server_ == nullptr) {
      return absl::UnavailableError("the server on '" + address +
                                    "' does not start; are certificate and key in order?");
    }
    server_->GetHealthCheckService()->SetServingStatus(true);
    gate_->Start([this](int fd) {
      grpc::experimental::ExternalConnectionAcceptor::NewConnectionParameters connection;
      connection.fd = fd;
      acceptor_->HandleNewConnection(&connection);
    });
    return absl::OkStatus();
  }

  int port() const override { return gate_->port(); }

  absl::StatusOr<Caller> Admit(std::string_view method, std::string_view authorization) override {
    if (guard_ == nullptr) return Caller{Role::kAdmin, ""};
    const AccessGuard::Credentials shown{.certificates = "", .authorization = authorization};
    FP_RETURN_IF_ERROR(guard_->Admit(method, shown));
    return guard_->Identify(shown);
  }
  absl::Status MayChange(const Caller& caller, const JobId& job) override {
    return farpoint::MayChange(caller, access_, coordinator_, job);
  }
  std::string OwnerOf(const JobId& job) override {
    return ledger_ == nullptr ? "" : ledger_->OwnerOf(job);
  }
  uint64_t connections() const override { return gate_->connections(); }
  AccessGuard::Refusals refusals() override {
    return guard_ == nullptr ? AccessGuard::Refusals{} : guard_->refusals();
  }
  const Traffic& traffic() const override { return traffic_; }
  bool draining() const override { return draining_; }

  void StopServing() override {
    draining_ = true;
    server_->GetHealthCheckService()->SetServingStatus(false);
  }
  void Shutdown(std::chrono::milliseconds grace) override {
    gate_->Stop();
    server_->Shutdown(std::chrono::system_clock::now() + grace);
    server_->Wait();
  }

 private:
  absl::Status MakeServices() {
    if (guard_ != nullptr) {
      ClientLedgerOptions ledger;
      ledger.path = options_.ledger_file;
      ledger.has_blob = options_.has_blob ? options_.has_blob : [](const Digest&) { return true; };
      ledger.is_active = [this](const JobId& job) -> std::optional<bool> {
        const absl::StatusOr<JobStatus> status = coordinator_.Status(job);
        if (!status.ok()) return std::nullopt;
        return !IsFinal(status->state);
      };
      ledger.max_jobs = options_.max_jobs_per_client;
      ledger.max_bytes = options_.max_bytes_per_client;
      FP_ASSIGN_OR_RETURN(ledger_, ClientLedger::Open(std::move(ledger)));
    }
    access_.guard = guard_.get();
    access_.ledger = ledger_.get();
    access_.traffic = &traffic_;
    access_.facts = [this] {
      ServerFacts facts;
      if (options_.facts) facts = options_.facts();
      facts.draining = draining_;
      facts.connections = gate_->connections();
      facts.max_connections = options_.max_connections;
      facts.blob_directory = options_.blob_directory;
      if (!facts.blob_directory.empty()) facts.blob_mark = LeaveMark(facts.blob_directory);
      if (options_.tls) {
        facts.max_jobs = options_.max_jobs_per_client;
        facts.max_bytes = options_.max_bytes_per_client;
        facts.certificate_not_after_s = options_.tls->facts.not_after_s;
      }
      return facts;
    };
    blobs_ = MakeBlobService(coordinator_, access_);
    jobs_ = MakeJobService(coordinator_, access_);
    workers_ = MakeWorkerService(coordinator_, access_);
    return absl::OkStatus();
  }

  CoordinatorApi& coordinator_;
  const GrpcServerOptions options_;
  std::atomic<bool> draining_ = false;
  std::unique_ptr<AccessGuard> guard_;
  std::unique_ptr<ClientLedger> ledger_;
  Traffic traffic_;
  ServiceAccess access_;
  std::unique_ptr<ConnectionGate> gate_;
  std::unique_ptr<grpc::Service> blobs_, jobs_, workers_;
  std::unique_ptr<grpc::experimental::ExternalConnectionAcceptor> acceptor_;
  std::unique_ptr<grpc::Server> server_;
};

}  // namespace

absl::StatusOr<Caller> CallerOf(const grpc::ServerContextBase& context,
                                const ServiceAccess& access) {
  if (access.guard == nullptr) return Caller{Role::kAdmin, ""};
  return access.guard->Identify({CertificateOf(*context.auth_context()),
                                 HeaderOf(context.client_metadata(), "authorization")});
}

absl::StatusOr<std::unique_ptr<GrpcServer>> GrpcServer::Start(CoordinatorApi& coordinator,
                                                              const std::string& address,
                                                              GrpcServerOptions options) {
  auto server = std::make_unique<GrpcServerImpl>(coordinator, std::move(options));
  FP_RETURN_IF_ERROR(server->Listen(address));
  return server;
}

}  // namespace farpoint

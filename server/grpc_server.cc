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
#include <mutex>
#include <vector>

#include "proto/grpc_channel.h"
#include "proto/grpc_status.h"
#include "server/connection_gate.h"
#include "server/grpc_services.h"

namespace farpoint {

namespace {

// Servers that stand beside the one with the newest certificate.
constexpr size_t kMostFronts = 2;

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
                                                    .ca_file = options_.tls->paths.ca,
                                                    .tokens_file = options_.tokens_file,
                                                    .revoked_file = options_.revoked_file,
                                                    .calls_per_second = options_.calls_per_second,
                                                    .clock = nullptr,
                                                    .unix_s = nullptr,
                                                    .refused = options_.refused});
  }
  ~GrpcServerImpl() override {
    if (!fronts_.empty()) Shutdown(std::chrono::milliseconds(0));
  }

  absl::Status Listen(const std::string& address) {
    address_ = address;
    if (options_.tls) not_after_s_ = options_.tls->facts.not_after_s;
    FP_ASSIGN_OR_RETURN(gate_,
                        ConnectionGate::Listen({.address = address,
                                                .tls = options_.tls.has_value(),
                                                .max_connections = options_.max_connections,
                                                .max_per_host = options_.max_connections_per_host,
                                                .refused = options_.refused}));
    FP_RETURN_IF_ERROR(MakeAccess());
    grpc::EnableDefaultHealthCheckService(true);
    // Registering twice would be an error; several servers in one process are a test's business.
    static const bool reflection = [] {
      grpc::reflection::InitProtoReflectionServerBuilderPlugin();
      return true;
    }();
    (void)reflection;
    FP_RETURN_IF_ERROR(StartFront(options_.tls));
    gate_->Start([this](int fd) {
      std::lock_guard lock(mutex_);
      grpc::experimental::ExternalConnectionAcceptor::NewConnectionParameters connection;
      connection.fd = fd;
      fronts_.back()->acceptor->HandleNewConnection(&connection);
    });
    return absl::OkStatus();
  }

  absl::Status Renew(const TlsMaterial& tls) override {
    FP_RETURN_IF_ERROR(StartFront(tls));
    std::unique_ptr<Front> oldest;
    {
      std::lock_guard lock(mutex_);
      not_after_s_ = tls.facts.not_after_s;
      if (fronts_.size() <= kMostFronts) return absl::OkStatus();
      oldest = std::move(fronts_.front());
      fronts_.erase(fronts_.begin());
    }
    // Whoever is still there connects again, as after any loss.
    oldest->server->Shutdown(std::chrono::system_clock::now());
    oldest->server->Wait();
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
    std::lock_guard lock(mutex_);
    for (const auto& front : fronts_) {
      front->server->GetHealthCheckService()->SetServingStatus(false);
    }
  }
  void Shutdown(std::chrono::milliseconds grace) override {
    gate_->Stop();
    const auto end = std::chrono::system_clock::now() + grace;
    std::lock_guard lock(mutex_);
    for (const auto& front : fronts_) {
      front->server->Shutdown(end);
      front->server->Wait();
    }
  }

 private:
  // gRPC's server takes its certificate when it is built. A new one gets a server of its own,
  // beside those that serve the connections which stand.
  struct Front {
    std::unique_ptr<grpc::Service> blobs, jobs, workers;
    std::unique_ptr<grpc::experimental::ExternalConnectionAcceptor> acceptor;
    std::unique_ptr<grpc::Server> server;
  };

  absl::Status StartFront(const std::optional<TlsMaterial>& tls) {
    auto front = std::make_unique<Front>();
    front->blobs = MakeBlobService(coordinator_, access_);
    front->jobs = MakeJobService(coordinator_, access_);
    front->workers = MakeWorkerService(coordinator_, access_);
    grpc::ServerBuilder builder;
    ConfigureServer(builder, options_.network_bytes);
    std::shared_ptr<grpc::ServerCredentials> credentials = grpc::InsecureServerCredentials();
    if (tls) {
      credentials = ServerTls(*tls);
      credentials->SetAuthMetadataProcessor(std::make_shared<GuardProcessor>(*guard_));
    }
    front->acceptor = builder.experimental().AddExternalConnectionAcceptor(
        grpc::ServerBuilder::experimental_type::ExternalConnectionType::FROM_FD, credentials);
    builder.RegisterService(front->blobs.get());
    builder.RegisterService(front->jobs.get());
    builder.RegisterService(front->workers.get());
    front->server = builder.BuildAndStart();
    if (front->server == nullptr) {
      return absl::UnavailableError("the server on '" + address_ +
                                    "' does not start; are certificate and key in order?");
    }
    front->server->GetHealthCheckService()->SetServingStatus(!draining_);
    std::lock_guard lock(mutex_);
    fronts_.push_back(std::move(front));
    return absl::OkStatus();
  }

  absl::Status MakeAccess() {
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
        facts.certificate_not_after_s = not_after_s_;
      }
      return facts;
    };
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
  std::string address_;
  std::atomic<int64_t> not_after_s_ = 0;
  std::mutex mutex_;
  std::vector<std::unique_ptr<Front>> fronts_;  // guarded by mutex_; the last takes connections
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

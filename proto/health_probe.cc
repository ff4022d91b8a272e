#include "proto/health_probe.h"

#include <grpcpp/client_context.h>
#include <grpcpp/create_channel.h>
#include <grpcpp/generic/generic_stub.h>
#include <grpcpp/security/credentials.h>
#include <grpcpp/support/byte_buffer.h>
#include <grpcpp/support/channel_arguments.h>
#include <sys/socket.h>
#include <sys/time.h>

#include <cerrno>
#include <cstring>
#include <future>
#include <string_view>
#include <vector>

#include "core/base/posix_file.h"
#include "proto/access.h"
#include "proto/connection_probe.h"
#include "proto/grpc_channel.h"
#include "proto/grpc_status.h"
#include "proto/resolve.h"

namespace farpoint {

namespace {

// HealthCheckResponse.ServingStatus of grpc/health/v1/health.proto.
enum class Serving { kUnknown = 0, kServing = 1, kNotServing = 2, kServiceUnknown = 3 };

// A HealthCheckResponse has one field, `status = 1`, an enum: a tag of one byte and a small number.
std::optional<Serving> Decode(const grpc::ByteBuffer& buffer) {
  std::vector<grpc::Slice> slices;
  if (!buffer.Valid() || !buffer.Dump(&slices).ok()) return std::nullopt;
  std::string bytes;
  for (const grpc::Slice& slice : slices) {
    bytes.append(reinterpret_cast<const char*>(slice.begin()), slice.size());
  }
  if (bytes.empty()) return Serving::kUnknown;
  constexpr char kStatusTag = 1 << 3;
  if (bytes.size() != 2 || bytes[0] != kStatusTag || bytes[1] < 0 || bytes[1] > 3) {
    return std::nullopt;
  }
  return static_cast<Serving>(bytes[1]);
}

// Sending, receiving and connecting each end after `timeout`.
absl::StatusOr<Descriptor> Connect(const std::string& address, std::chrono::milliseconds timeout) {
  FP_ASSIGN_OR_RETURN(const AddressList list, Resolve(address));
  const timeval limit{.tv_sec = timeout.count() / 1000, .tv_usec = timeout.count() % 1000 * 1000};
  int error = ECONNREFUSED;
  for (const addrinfo* at = list.get(); at != nullptr; at = at->ai_next) {
    Descriptor fd(::socket(at->ai_family, SOCK_STREAM | SOCK_CLOEXEC, 0));
    if (fd.valid() && ::setsockopt(fd.get(), SOL_SOCKET, SO_RCVTIMEO, &limit, sizeof(limit)) == 0 &&
        ::setsockopt(fd.get(), SOL_SOCKET, SO_SNDTIMEO, &limit, sizeof(limit)) == 0 &&
        ::connect(fd.get(), at->ai_addr, at->ai_addrlen) == 0) {
      return fd;
    }
    error = errno;
  }
  return absl::UnavailableError(std::string("cannot be reached: ") + std::strerror(error));
}

}  // namespace

absl::Status AskHealth(const std::string& address, const std::optional<HealthTls>& tls,
                       std::chrono::milliseconds timeout) {
  grpc::ChannelArguments arguments;
  arguments.SetInt(GRPC_ARG_ENABLE_HTTP_PROXY, 0);
  std::shared_ptr<grpc::ChannelCredentials> credentials = grpc::InsecureChannelCredentials();
  if (tls) {
    grpc::SslCredentialsOptions options;
    options.pem_root_certs = tls->ca;
    credentials = grpc::SslCredentials(options);
    if (!tls->name.empty()) arguments.SetSslTargetNameOverride(tls->name);
  }
  grpc::GenericStub stub(grpc::CreateCustomChannel(address, credentials, arguments));
  grpc::ClientContext context;
  SetDeadline(context, timeout);
  // An empty HealthCheckRequest: the server as a whole.
  const grpc::Slice empty;
  const grpc::ByteBuffer request(&empty, 1);
  grpc::ByteBuffer response;
  std::promise<grpc::Status> done;
  stub.UnaryCall(&context, "/grpc.health.v1.Health/Check", {}, &request, &response,
                 [&done](grpc::Status status) { done.set_value(std::move(status)); });
  const grpc::Status status = done.get_future().get();
  if (!status.ok()) {
    if (status.error_code() == grpc::StatusCode::UNIMPLEMENTED) {
      return absl::FailedPreconditionError(address +
                                           " has no health service; is it a "
                                           "farpoint-server?");
    }
    const absl::Status failed = FromGrpc(status);
    ChannelSecurity security;
    // The probe of connections would look for the address's host in the certificate.
    if (tls && !tls->name.empty()) return Annotate(failed, address);
    if (tls) security.tls = TlsMaterial{.ca = tls->ca, .certificate = "", .key = "", .facts = {}};
    return Annotate(ExplainFailure(failed, address, security), address);
  }
  const std::optional<Serving> serving = Decode(response);
  if (!serving) {
    return absl::FailedPreconditionError(address + " answers what no health service would");
  }
  if (*serving != Serving::kServing) {
    return absl::UnavailableError(address + " does not serve: it is starting or draining");
  }
  return absl::OkStatus();
}

absl::Status AskMetrics(const std::string& address, std::chrono::milliseconds timeout) {
  absl::StatusOr<Descriptor> fd = Connect(address, timeout);
  if (!fd.ok()) return Annotate(fd.status(), address);
  const std::string request =
      "GET /metrics HTTP/1.1\r\nHost: " + address + "\r\nConnection: close\r\n\r\n";
  if (::send(fd->get(), request.data(), request.size(), MSG_NOSIGNAL) !=
      static_cast<ssize_t>(request.size())) {
    return absl::UnavailableError(address + " takes no request");
  }
  // Up to the first metric that only farpoint has; a peer that sends something else for ever is not
  // listened to for ever.
  constexpr std::string_view kMetric = "\nfarpoint_build_info";
  constexpr size_t kMostBytes = 1 << 20;
  std::string answer;
  const auto end = std::chrono::steady_clock::now() + timeout;
  while (answer.size() < kMostBytes && std::chrono::steady_clock::now() < end) {
    char part[4096];
    const ssize_t size = ::recv(fd->get(), part, sizeof(part), 0);
    if (size < 0 && errno == EINTR) continue;
    if (size < 0) return absl::UnavailableError(address + " does not answer");
    if (size == 0) break;
    answer.append(part, static_cast<size_t>(size));
    if (answer.find(kMetric) != std::string::npos) break;
  }
  if (!answer.starts_with("HTTP/1.1 200 ") || answer.find(kMetric) == std::string::npos) {
    return absl::FailedPreconditionError(
        address + " does not answer with farpoint's metrics; give the address of --metrics");
  }
  return absl::OkStatus();
}

}  // namespace farpoint

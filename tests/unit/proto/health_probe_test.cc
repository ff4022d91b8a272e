#include "proto/health_probe.h"

#include <gmock/gmock.h>
#include <grpcpp/generic/async_generic_service.h>
#include <grpcpp/grpcpp.h>
#include <grpcpp/health_check_service_interface.h>
#include <gtest/gtest.h>

#include <memory>
#include <optional>
#include <string>

#include "proto/http_server.h"

namespace farpoint {
namespace {

using std::chrono::milliseconds;
using testing::HasSubstr;

constexpr milliseconds kLong{20000};

std::string Loopback(int port) { return "127.0.0.1:" + std::to_string(port); }

// Answers every call with the same bytes, or with none: that there is no such method.
class Parrot final : public grpc::CallbackGenericService {
 public:
  explicit Parrot(const std::optional<std::string>& bytes)
      : status_(bytes ? grpc::Status::OK : grpc::Status(grpc::StatusCode::UNIMPLEMENTED, "")) {
    const grpc::Slice slice(bytes.value_or(""));
    buffer_ = grpc::ByteBuffer(&slice, 1);
  }
  grpc::ServerGenericBidiReactor* CreateReactor(grpc::GenericCallbackServerContext*) override {
    class Reactor final : public grpc::ServerGenericBidiReactor {
     public:
      Reactor(const grpc::ByteBuffer& answer, const grpc::Status& status) {
        if (status.ok()) {
          StartWriteAndFinish(&answer, grpc::WriteOptions(), status);
        } else {
          Finish(status);
        }
      }
      void OnDone() override { delete this; }
    };
    return new Reactor(buffer_, status_);
  }

 private:
  const grpc::Status status_;
  grpc::ByteBuffer buffer_;
};

struct Server {
  explicit Server(bool health, const std::optional<std::string>& bytes = std::nullopt)
      : parrot(bytes) {
    grpc::EnableDefaultHealthCheckService(health);
    grpc::ServerBuilder builder;
    int port = 0;
    builder.AddListeningPort("127.0.0.1:0", grpc::InsecureServerCredentials(), &port);
    builder.RegisterCallbackGenericService(&parrot);
    server = builder.BuildAndStart();
    address = Loopback(port);
  }
  Parrot parrot;
  std::unique_ptr<grpc::Server> server;
  std::string address;
};

TEST(HealthProbe, AServerIsHealthyAsLongAsItSaysSo) {
  const Server server(true);
  server.server->GetHealthCheckService()->SetServingStatus(true);
  EXPECT_EQ(AskHealth(server.address, std::nullopt, kLong), absl::OkStatus());
  server.server->GetHealthCheckService()->SetServingStatus(false);
  const absl::Status draining = AskHealth(server.address, std::nullopt, kLong);
  EXPECT_TRUE(absl::IsUnavailable(draining)) << draining;
  EXPECT_THAT(std::string(draining.message()), HasSubstr("draining"));
}

TEST(HealthProbe, AServerWithoutHealthServiceIsNotOurs) {
  const Server server(false);
  const absl::Status status = AskHealth(server.address, std::nullopt, kLong);
  EXPECT_TRUE(absl::IsFailedPrecondition(status)) << status;
}

TEST(HealthProbe, OnlyTheBytesOfServingCount) {
  for (const auto& [bytes, code] :
       {std::pair{std::string("\x08\x01"), absl::StatusCode::kOk},
        std::pair{std::string("\x08\x02"), absl::StatusCode::kUnavailable},
        std::pair{std::string("\x08\x03"), absl::StatusCode::kUnavailable},
        std::pair{std::string(), absl::StatusCode::kUnavailable},
        std::pair{std::string("\x08\x04"), absl::StatusCode::kFailedPrecondition},
        std::pair{std::string("\x10\x01"), absl::StatusCode::kFailedPrecondition},
        std::pair{std::string("\x08\x01\x08\x02"), absl::StatusCode::kFailedPrecondition},
        std::pair{std::string(100000, '\x08'), absl::StatusCode::kFailedPrecondition}}) {
    const Server server(false, bytes);
    EXPECT_EQ(AskHealth(server.address, std::nullopt, kLong).code(), code)
        << testing::PrintToString(bytes.substr(0, 8));
  }
}

TEST(HealthProbe, MetricsAreKnownByFarpointsOwn) {
  for (const auto& [status, body, good] :
       {std::tuple{200, std::string("# x\nfarpoint_build_info{version=\"1\"} 1\n"), true},
        std::tuple{200, std::string(300000, 'x') + "\nfarpoint_build_info 1\n", true},
        std::tuple{200, std::string("hello\n"), false},
        std::tuple{503, std::string("\nfarpoint_build_info 1\n"), false}}) {
    const auto server = HttpServer::Start(
        {.address = "127.0.0.1:0", .tls = std::nullopt},
        [status = status, body = body](const HttpRequest& request) {
          return HttpResponse{.status = request.path == "/metrics" ? status : 404, .body = body};
        });
    ASSERT_TRUE(server.ok()) << server.status();
    const absl::Status found = AskMetrics(Loopback((*server)->port()), kLong);
    EXPECT_EQ(found.code(), good ? absl::StatusCode::kOk : absl::StatusCode::kFailedPrecondition)
        << found;
  }
}

}  // namespace
}  // namespace farpoint

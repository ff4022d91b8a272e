#include "proto/http_server.h"

#include <arpa/inet.h>
#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <sys/socket.h>

#include <csignal>
#include <string>

#include "core/base/posix_file.h"
#include "proto/certificate.h"
#include "proto/connection_probe.h"

namespace farpoint {
namespace {

using ::testing::AllOf;
using ::testing::HasSubstr;

class HttpServerTest : public ::testing::Test {
 protected:
  HttpServerTest() {
    std::signal(SIGPIPE, SIG_IGN);
    const int64_t now_s = NowUnixS();
    authority_ = *MakeAuthority("farm", now_s - 60, now_s + 3600);
  }
  TlsMaterial For(const std::string& host) const {
    const int64_t now_s = NowUnixS();
    const auto issued = IssueCertificate(authority_, {.name = "server",
                                                      .role = Role::kServer,
                                                      .hosts = {host},
                                                      .not_before_s = now_s - 60,
                                                      .not_after_s = now_s + 3600});
    EXPECT_TRUE(issued.ok()) << issued.status();
    return {.ca = authority_.certificate, .certificate = issued->certificate, .key = issued->key};
  }
  static std::unique_ptr<HttpServer> Start(std::optional<TlsMaterial> tls) {
    HttpServerOptions options;
    options.address = "127.0.0.1:0";
    options.tls = std::move(tls);
    options.threads = 2;
    auto server = HttpServer::Start(std::move(options), [](const HttpRequest& request) {
      return HttpResponse{.body = "you asked for " + request.path};
    });
    EXPECT_TRUE(server.ok()) << server.status();
    return *std::move(server);
  }
  // What comes back for `request`, sent as it stands.
  static std::string Say(int port, const std::string& request) {
    const Descriptor fd(::socket(AF_INET, SOCK_STREAM | SOCK_CLOEXEC, 0));
    sockaddr_in at{};
    at.sin_family = AF_INET;
    at.sin_port = htons(static_cast<uint16_t>(port));
    at.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
    EXPECT_EQ(::connect(fd.get(), reinterpret_cast<const sockaddr*>(&at), sizeof(at)), 0);
    EXPECT_EQ(::send(fd.get(), request.data(), request.size(), MSG_NOSIGNAL),
              static_cast<ssize_t>(request.size()));
    std::string answer;
    char bytes[4096];
    for (ssize_t n = 0; (n = ::recv(fd.get(), bytes, sizeof(bytes), 0)) > 0;) {
      answer.append(bytes, static_cast<size_t>(n));
    }
    return answer;
  }
  absl::Status Probe(const HttpServer& server) const {
    ChannelSecurity security;
    security.tls = TlsMaterial{.ca = authority_.certificate};
    return ProbeConnection("127.0.0.1:" + std::to_string(server.port()), security,
                           std::chrono::seconds(30));
  }

  CertificateAndKey authority_;
};

constexpr char kGet[] = "GET /x HTTP/1.1\r\nHost: here\r\nConnection: close\r\n\r\n";

TEST_F(HttpServerTest, AnswersInTheClear) {
  const auto server = Start(std::nullopt);
  EXPECT_THAT(Say(server->port(), kGet),
              AllOf(HasSubstr("HTTP/1.1 200"), HasSubstr("you asked for /x")));
  EXPECT_TRUE(absl::IsFailedPrecondition(server->Renew(For("127.0.0.1"))));
}

TEST_F(HttpServerTest, TellsWhoSpeaksInTheClearToSayHttps) {
  const auto server = Start(For("127.0.0.1"));
  const std::string answer = Say(server->port(), kGet);
  EXPECT_THAT(answer, AllOf(HasSubstr("HTTP/1.1 400"), HasSubstr("say https:// here")));
  // As long as it says it is.
  const size_t body = answer.find("\r\n\r\n") + 4;
  EXPECT_THAT(answer,
              HasSubstr("Content-Length: " + std::to_string(answer.size() - body) + "\r\n"));
  // What is neither gets nothing.
  EXPECT_EQ(Say(server->port(), "\x01\x02\x03\x04\x05\x06\x07").find("HTTP"), std::string::npos);
}

TEST_F(HttpServerTest, ShowsANewCertificateToNewConnections) {
  const auto server = Start(For("elsewhere.example"));
  const absl::Status before = Probe(*server);
  EXPECT_TRUE(absl::IsUnauthenticated(before)) << before;
  EXPECT_THAT(std::string(before.message()), HasSubstr("elsewhere.example"));
  // One that cannot be used changes nothing.
  TlsMaterial broken = For("127.0.0.1");
  broken.key = For("127.0.0.1").key;
  EXPECT_TRUE(absl::IsInvalidArgument(server->Renew(broken)));
  EXPECT_TRUE(absl::IsUnauthenticated(Probe(*server)));
  ASSERT_TRUE(server->Renew(For("127.0.0.1")).ok());
  // The certificate is good; that no coordinator is behind it is what is said now.
  const absl::Status after = Probe(*server);
  EXPECT_TRUE(absl::IsFailedPrecondition(after)) << after;
}

}  // namespace
}  // namespace farpoint

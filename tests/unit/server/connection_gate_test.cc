#include "server/connection_gate.h"

#include <arpa/inet.h>
#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <netinet/in.h>
#include <poll.h>
#include <sys/socket.h>
#include <unistd.h>

#include <mutex>
#include <thread>
#include <vector>

#include "core/base/posix_file.h"

namespace farpoint {
namespace {

using std::chrono::milliseconds;
using testing::HasSubstr;
using testing::StartsWith;

constexpr std::string_view kPreface = "PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n";

class ConnectionGateTest : public testing::Test {
 protected:
  void Open(ConnectionGateOptions options) {
    options.address = "127.0.0.1:0";
    options.refused = [this](std::string text) {
      std::lock_guard lock(mutex_);
      told_.push_back(std::move(text));
    };
    auto gate = ConnectionGate::Listen(std::move(options));
    ASSERT_TRUE(gate.ok()) << gate.status();
    gate_ = *std::move(gate);
    gate_->Start([this](int fd) {
      std::lock_guard lock(mutex_);
      let_in_.emplace_back(fd);
    });
  }
  Descriptor Connect() {
    Descriptor fd(::socket(AF_INET, SOCK_STREAM | SOCK_CLOEXEC, 0));
    sockaddr_in address{};
    address.sin_family = AF_INET;
    address.sin_port = htons(static_cast<uint16_t>(gate_->port()));
    address.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
    EXPECT_EQ(::connect(fd.get(), reinterpret_cast<sockaddr*>(&address), sizeof(address)), 0);
    return fd;
  }
  static void Send(const Descriptor& fd, std::string_view bytes) {
    ASSERT_EQ(::send(fd.get(), bytes.data(), bytes.size(), MSG_NOSIGNAL),
              static_cast<ssize_t>(bytes.size()));
  }
  // Everything until the peer closes.
  static std::string ReadAll(const Descriptor& fd) {
    std::string all;
    char bytes[1024];
    pollfd one{.fd = fd.get(), .events = POLLIN, .revents = 0};
    while (::poll(&one, 1, 20000) > 0) {
      const ssize_t size = ::recv(fd.get(), bytes, sizeof(bytes), 0);
      if (size <= 0) return all;
      all.append(bytes, static_cast<size_t>(size));
    }
    ADD_FAILURE() << "neither bytes nor the end";
    return all;
  }
  size_t LetIn() {
    std::lock_guard lock(mutex_);
    return let_in_.size();
  }
  std::string Told() {
    std::lock_guard lock(mutex_);
    std::string all;
    for (const std::string& one : told_) all += one + "\n";
    return all;
  }
  template <typename Condition>
  static bool Eventually(Condition&& condition) {
    for (int i = 0; i < 2000; ++i) {
      if (condition()) return true;
      std::this_thread::sleep_for(milliseconds(10));
    }
    return false;
  }

  std::mutex mutex_;
  std::vector<Descriptor> let_in_;  // guarded by mutex_
  std::vector<std::string> told_;   // guarded by mutex_
  std::unique_ptr<ConnectionGate> gate_;
};

TEST_F(ConnectionGateTest, LetsInWhoSpeaksItsProtocolWithNothingLost) {
  Open({});
  const Descriptor client = Connect();
  Send(client, kPreface);
  ASSERT_TRUE(Eventually([&] { return LetIn() == 1; }));
  char bytes[64];
  EXPECT_EQ(
      std::string(bytes, static_cast<size_t>(::recv(let_in_[0].get(), bytes, sizeof(bytes), 0))),
      kPreface);
  EXPECT_EQ(gate_->connections(), 1u);
  let_in_.clear();
  EXPECT_EQ(gate_->connections(), 0u) << "closed behind its back";
}

TEST_F(ConnectionGateTest, WaitsForAllOfTheFirstWords) {
  Open({});
  const Descriptor client = Connect();
  for (const char byte : kPreface.substr(0, kPreface.size() - 1)) {
    Send(client, std::string_view(&byte, 1));
  }
  std::this_thread::sleep_for(milliseconds(50));
  EXPECT_EQ(LetIn(), 0u);
  Send(client, kPreface.substr(kPreface.size() - 1));
  EXPECT_TRUE(Eventually([&] { return LetIn() == 1; }));
}

TEST_F(ConnectionGateTest, WaitsForAWholeTlsHello) {
  Open({.address = "", .tls = true});
  const Descriptor client = Connect();
  Send(client, std::string_view("\x16\x03\x01\x00\x04", 5));
  std::this_thread::sleep_for(milliseconds(50));
  EXPECT_EQ(LetIn(), 0u);
  Send(client, "\x01\x02\x03\x04");
  EXPECT_TRUE(Eventually([&] { return LetIn() == 1; }));
}

TEST_F(ConnectionGateTest, RefusesEachInItsOwnWords) {
  Open({});
  const Descriptor http = Connect();
  Send(http, "GET / HTTP/1.1\r\nHost: x\r\n\r\n");
  EXPECT_THAT(ReadAll(http), StartsWith("HTTP/1.1 400"));
  const Descriptor tls = Connect();
  Send(tls, std::string_view("\x16\x03\x01\x00\x04xxxx", 9));
  EXPECT_EQ(ReadAll(tls), std::string("\x15\x03\x03\x00\x02\x02\x46", 7)) << "an alert";
  const Descriptor noise = Connect();
  Send(noise, "\x99\x98 noise");
  EXPECT_EQ(ReadAll(noise), "");
  EXPECT_EQ(LetIn(), 0u);
  EXPECT_THAT(Told(), HasSubstr("127.0.0.1: it speaks HTTP/1, not gRPC"));
  EXPECT_THAT(Told(), HasSubstr("it speaks TLS, this coordinator does not"));
  EXPECT_THAT(Told(), HasSubstr("neither TLS nor gRPC"));
}

TEST_F(ConnectionGateTest, AnswersTheCallOfWhoSpeaksNoTls) {
  Open({.address = "", .tls = true});
  const Descriptor client = Connect();
  // Settings, a window, then a request on stream 5, in pieces.
  std::string words(kPreface);
  words += std::string("\0\0\0\4\0\0\0\0\0", 9);
  words += std::string("\0\0\4\10\0\0\0\0\0\0\1\0\0", 13);
  words += std::string("\0\0\2\1\4\0\0\0\5\x82\x84", 11);
  for (size_t at = 0; at < words.size(); at += 7) Send(client, words.substr(at, 7));
  const std::string answer = ReadAll(client);
  EXPECT_THAT(answer, HasSubstr("grpc-status\x02"
                                "16"));
  EXPECT_THAT(answer, HasSubstr("this coordinator speaks TLS"));
  EXPECT_NE(answer.find(std::string("\1\5\0\0\0\5", 6)), std::string::npos) << "on that stream";
  EXPECT_EQ(LetIn(), 0u);
}

TEST_F(ConnectionGateTest, ClosesWhoSaysNothingOrTooMuch) {
  Open({.address = "", .tls = true, .patience = milliseconds(300)});
  const Descriptor silent = Connect();
  EXPECT_EQ(ReadAll(silent), "");
  EXPECT_THAT(Told(), HasSubstr("did not say in time"));
  // HTTP/2 without a request, for ever.
  const Descriptor endless = Connect();
  (void)::send(endless.get(), kPreface.data(), kPreface.size(), MSG_NOSIGNAL);
  const std::string pings(9 * 100, '\0');
  for (int i = 0; i < 1000; ++i) {
    if (::send(endless.get(), pings.data(), pings.size(), MSG_NOSIGNAL) <= 0) break;
  }
  ReadAll(endless);
  EXPECT_TRUE(Eventually([&] { return gate_->connections() == 0; }));
}

TEST_F(ConnectionGateTest, LimitsConnectionsOfAHost) {
  Open({.address = "", .tls = false, .max_connections = 100, .max_per_host = 3});
  std::vector<Descriptor> clients;
  for (int i = 0; i < 3; ++i) {
    clients.push_back(Connect());
    Send(clients.back(), kPreface);
  }
  ASSERT_TRUE(Eventually([&] { return LetIn() == 3; }));
  const Descriptor one_more = Connect();
  EXPECT_EQ(ReadAll(one_more), "");
  EXPECT_THAT(Told(), HasSubstr("--max-connections-per-host"));
  {
    std::lock_guard lock(mutex_);
    let_in_.pop_back();
  }
  const Descriptor again = Connect();
  Send(again, kPreface);
  EXPECT_TRUE(Eventually([&] { return LetIn() == 3; }));
}

TEST(ConnectionGate, APortThatIsTakenIsAClearError) {
  auto first = ConnectionGate::Listen({.address = "127.0.0.1:0"});
  ASSERT_TRUE(first.ok());
  const auto second =
      ConnectionGate::Listen({.address = "127.0.0.1:" + std::to_string((*first)->port())});
  EXPECT_TRUE(absl::IsUnavailable(second.status()));
  EXPECT_THAT(std::string(second.status().message()), HasSubstr("is the port taken"));
  EXPECT_TRUE(absl::IsUnavailable(ConnectionGate::Listen({.address = "192.0.2.1:0"}).status()));
}

}  // namespace
}  // namespace farpoint

// What strangers and clients may throw at a coordinator without its memory growing: connections
// that say nothing or little, sizes that are not true, messages without number, files that unpack
// to far more than they say. Asserted of the real process, by the peak of its resident memory.
#include <arpa/inet.h>
#include <fcntl.h>
#include <gmock/gmock.h>
#include <grpcpp/impl/codegen/client_unary_call.h>
#include <gtest/gtest.h>
#include <netinet/in.h>
#include <poll.h>
#include <sys/resource.h>
#include <sys/socket.h>
#include <unistd.h>

#include <algorithm>
#include <atomic>
#include <cstring>
#include <fstream>
#include <thread>

#include "core/base/posix_file.h"
#include "proto/convert.h"
#include "proto/farpoint.grpc.pb.h"
#include "proto/grpc_channel.h"
#include "tests/integration/certificates.h"
#include "tests/integration/farm.h"

namespace farpoint {
namespace {

using std::chrono::milliseconds;
using std::chrono::seconds;
using testing::HasSubstr;

constexpr uint64_t kMaxGrowth = uint64_t{64} << 20;
constexpr int kConnections = 1000;

constexpr std::string_view kPreface("PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n\0\0\0\4\0\0\0\0\0", 33);

// RFC 9113, section 4.1.
std::string Frame(char type, char flags, uint32_t stream, const std::string& payload) {
  std::string frame;
  for (const int shift : {16, 8, 0}) frame += static_cast<char>(payload.size() >> shift);
  frame += type;
  frame += flags;
  for (const int shift : {24, 16, 8, 0}) frame += static_cast<char>(stream >> shift);
  return frame + payload;
}
// A gRPC request's headers; RFC 7541: literals without indexing.
std::string Headers(uint32_t stream, const std::string& path) {
  std::string block;
  for (const auto& [name, value] :
       std::vector<std::pair<std::string, std::string>>{{":method", "POST"},
                                                        {":scheme", "http"},
                                                        {":path", path},
                                                        {":authority", "127.0.0.1"},
                                                        {"content-type", "application/grpc"},
                                                        {"te", "trailers"}}) {
    block += '\0';
    block += static_cast<char>(name.size());
    block += name;
    block += static_cast<char>(value.size());
    block += value;
  }
  return Frame(1, 4, stream, block);
}

class Intrusion : public testing::Test {
 protected:
  void SetUp() override {
    rlimit files{};
    ::getrlimit(RLIMIT_NOFILE, &files);
    files.rlim_cur = files.rlim_max;
    ::setrlimit(RLIMIT_NOFILE, &files);
    if (files.rlim_max < kConnections + 200) GTEST_SKIP() << "needs more open files";
  }
  // After this the coordinator has done once what it does, and its peak is counted afresh.
  void Settle(const ChannelSecurity& security = {}) {
    channel_ = OpenChannel(farm_.address(), security);
    for (int i = 0; i < 50; ++i) ASSERT_TRUE(Status().ok());
    std::ofstream("/proc/" + std::to_string(farm_.server().pid()) + "/clear_refs") << "5";
    before_ = Memory("VmRSS:");
    ASSERT_GT(before_, 0u);
  }
  grpc::Status Status() {
    grpc::ClientContext context;
    SetDeadline(context, milliseconds(20000));
    v1::StatusResponse response;
    return v1::JobService::NewStub(channel_)->Status(&context, {}, &response);
  }
  uint64_t Memory(const std::string& name) {
    std::ifstream file("/proc/" + std::to_string(farm_.server().pid()) + "/status");
    for (std::string line; std::getline(file, line);) {
      if (line.starts_with(name)) return std::stoull(line.substr(name.size())) << 10;
    }
    return 0;
  }
  // It still answers, and never took more than it may.
  void ExpectUnharmed() {
    EXPECT_TRUE(Status().ok()) << farm_.Logs();
    const uint64_t peak = Memory("VmHWM:");
    RecordProperty("growth_kib", static_cast<int>((peak - std::min(peak, before_)) >> 10));
    EXPECT_LE(peak, before_ + kMaxGrowth)
        << "grew by " << ((peak - before_) >> 10) << " KiB from " << (before_ >> 10);
  }

  Descriptor Connect() {
    Descriptor fd(::socket(AF_INET, SOCK_STREAM | SOCK_CLOEXEC, 0));
    sockaddr_in address{};
    address.sin_family = AF_INET;
    address.sin_port = htons(
        static_cast<uint16_t>(std::stoi(farm_.address().substr(farm_.address().rfind(':') + 1))));
    address.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
    EXPECT_EQ(::connect(fd.get(), reinterpret_cast<sockaddr*>(&address), sizeof(address)), 0)
        << std::strerror(errno);
    return fd;
  }
  static bool Send(const Descriptor& fd, std::string_view bytes) {
    while (!bytes.empty()) {
      const ssize_t sent = ::send(fd.get(), bytes.data(), bytes.size(), MSG_NOSIGNAL);
      if (sent <= 0) return false;
      bytes.remove_prefix(static_cast<size_t>(sent));
    }
    return true;
  }
  // What arrives within `time`, until `enough` says so or the peer closes.
  template <typename Enough>
  static std::string Receive(const Descriptor& fd, milliseconds time, Enough&& enough) {
    std::string got;
    const auto end = std::chrono::steady_clock::now() + time;
    while (!enough(got)) {
      const auto left =
          std::chrono::duration_cast<milliseconds>(end - std::chrono::steady_clock::now());
      pollfd one{.fd = fd.get(), .events = POLLIN, .revents = 0};
      if (left.count() <= 0 || ::poll(&one, 1, static_cast<int>(left.count())) <= 0) break;
      char bytes[4096];
      const ssize_t size = ::recv(fd.get(), bytes, sizeof(bytes), 0);
      if (size <= 0) break;
      got.append(bytes, static_cast<size_t>(size));
    }
    return got;
  }

  // 1,000 connections that say `first`, then a byte of `slowly` now and then.
  void HoldConnections(std::string_view first, std::string_view slowly) {
    std::vector<Descriptor> connections;
    for (int i = 0; i < kConnections; ++i) {
      connections.push_back(Connect());
      if (HasFatalFailure()) return;
      Send(connections.back(), first);
    }
    for (const char byte : slowly) {
      for (const Descriptor& fd : connections) Send(fd, std::string_view(&byte, 1));
      std::this_thread::sleep_for(milliseconds(20));
    }
    EXPECT_TRUE(Status().ok()) << "others are served meanwhile";
    std::this_thread::sleep_for(milliseconds(300));
    EXPECT_TRUE(Status().ok());
  }

  Farm farm_;
  std::shared_ptr<grpc::Channel> channel_;
  uint64_t before_ = 0;
};

TEST_F(Intrusion, AThousandConnectionsThatSayNothingCostNothing) {
  farm_.StartServer();
  Settle();
  HoldConnections("", "");
  ExpectUnharmed();
}

TEST_F(Intrusion, AThousandConnectionsThatDribbleTheirFirstWordsCostNothing) {
  farm_.StartServer();
  Settle();
  HoldConnections(kPreface.substr(0, 3), kPreface.substr(3, 10));
  ExpectUnharmed();
}

TEST_F(Intrusion, AThousandOpenConnectionsWithoutACallCostLittle) {
  farm_.StartServer();
  Settle();
  HoldConnections(kPreface, "");
  ExpectUnharmed();
}

TEST_F(Intrusion, AThousandTlsConnectionsThatDribbleTheirHelloCostNothing) {
  const std::string certs = MakeCerts(farm_);
  farm_.StartServer({"--certs", certs});
  Settle({Unchecked(certs, certs, "alice"), ""});
  // The head of a record of 512 bytes, of which little comes.
  HoldConnections(std::string_view("\x16\x03\x01\x02\x00", 5), "\x01\x00\x01\xfc\x03\x03");
  ExpectUnharmed();
}

TEST_F(Intrusion, OpenTlsConnectionsOfAStrangerCostLittle) {
  const std::string certs = MakeCerts(farm_);
  farm_.StartServer({"--certs", certs});
  Settle({Unchecked(certs, certs, "alice"), ""});
  TlsMaterial stranger;
  stranger.ca = ReadWhole(certs + "/ca.pem");
  // 600 from one host, of which 512 are let in. Health answers strangers, too.
  constexpr size_t kThreads = 4, kOfEach = 150;
  std::vector<std::vector<std::shared_ptr<grpc::Channel>>> channels(kThreads);
  std::atomic<int> answered = 0;
  std::vector<std::thread> threads;
  for (size_t t = 0; t < kThreads; ++t) {
    threads.emplace_back([&, t] {
      for (size_t i = 0; i < kOfEach; ++i) {
        const auto channel = OpenChannel(farm_.address(), {stranger, ""}, /*own_connection=*/true);
        grpc::ClientContext context;
        SetDeadline(context, milliseconds(10000));
        const v1::CancelRequest nothing;
        v1::CancelResponse answer;
        const grpc::internal::RpcMethod check("/grpc.health.v1.Health/Check",
                                              grpc::internal::RpcMethod::NORMAL_RPC);
        const grpc::Status status =
            grpc::internal::BlockingUnaryCall<v1::CancelRequest, v1::CancelResponse>(
                channel.get(), check, &context, nothing, &answer);
        answered += status.ok() ? 1 : 0;
        channels[t].push_back(channel);
      }
    });
  }
  for (std::thread& thread : threads) thread.join();
  EXPECT_GE(answered, 400);
  channels.clear();
  EXPECT_TRUE(WaitUntil(seconds(30), [&] { return Status().ok(); })) << farm_.Logs();
  ExpectUnharmed();
}

TEST_F(Intrusion, ConnectionsAreLimitedAndSaidToBe) {
  farm_.StartServer({"--max-connections-per-host", "20"});
  Settle();
  std::vector<Descriptor> connections;
  int refused = 0;
  for (int i = 0; i < 40; ++i) {
    connections.push_back(Connect());
    Send(connections.back(), kPreface);
    // Settings come, or the end.
    refused += Receive(
                   connections.back(), seconds(5),
                   [](const std::string& got) {
                     return got.size() >= 9;
                   }).empty()
                   ? 1
                   : 0;
  }
  EXPECT_GE(refused, 20);
  EXPECT_LE(refused, 22);
  EXPECT_THAT(farm_.Logs(), HasSubstr("--max-connections-per-host"));
  // Who leaves makes room.
  connections.clear();
  EXPECT_TRUE(WaitUntil(seconds(20), [&] {
    const Descriptor fd = Connect();
    Send(fd, kPreface);
    return !Receive(fd, seconds(5), [](const std::string& got) { return got.size() >= 9; }).empty();
  }));
}

TEST_F(Intrusion, MessagesThatClaimFourGibibytesTakeWhatWasSent) {
  farm_.StartServer();
  Settle();
  std::vector<Descriptor> connections;
  for (const char* path :
       {"/farpoint.v1.JobService/Submit", "/farpoint.v1.BlobService/Put",
        "/farpoint.v1.BlobService/FindMissing", "/farpoint.v1.WorkerService/Return",
        "/farpoint.v1.WorkerService/Register"}) {
    for (int i = 0; i < 40; ++i) {
      connections.push_back(Connect());
      const std::string claim("\0\xff\xff\xff\xff", 5);
      ASSERT_TRUE(Send(connections.back(), std::string(kPreface) + Headers(1, path) +
                                               Frame(0, 0, 1, claim + std::string(1000, 'x'))));
    }
  }
  EXPECT_TRUE(Status().ok());
  // Who does not answer pings is gone soon.
  const auto gone = [](const std::string& got) {
    return got.find("keepalive watchdog timeout") != std::string::npos;
  };
  EXPECT_TRUE(gone(Receive(connections.front(), seconds(30), gone)));
  EXPECT_TRUE(gone(Receive(connections.back(), seconds(30), gone)));
  ExpectUnharmed();
}

TEST_F(Intrusion, MessagesBeyondTheLimitAreCutOffAsTheyArrive) {
  farm_.StartServer();
  Settle();
  v1::FindMissingRequest request;
  for (int i = 0; i < 300; ++i) request.add_sha256(std::string(size_t{1} << 20, 'f'));
  grpc::ClientContext context;
  SetDeadline(context, milliseconds(60000));
  v1::FindMissingResponse response;
  const grpc::Status status =
      v1::BlobService::NewStub(channel_)->FindMissing(&context, request, &response);
  EXPECT_EQ(status.error_code(), grpc::StatusCode::RESOURCE_EXHAUSTED) << status.error_message();
  ExpectUnharmed();
}

TEST_F(Intrusion, BlobsThatAnnounceFarMoreThanTheySendTakeWhatTheySend) {
  farm_.StartServer();
  Settle();
  const auto blobs = v1::BlobService::NewStub(channel_);
  std::vector<std::unique_ptr<grpc::ClientContext>> contexts;
  std::vector<v1::PutBlobResponse> responses(100);
  std::vector<std::unique_ptr<grpc::ClientWriter<v1::PutBlobChunk>>> writers;
  for (size_t i = 0; i < responses.size(); ++i) {
    contexts.push_back(std::make_unique<grpc::ClientContext>());
    SetDeadline(*contexts.back(), milliseconds(30000));
    writers.push_back(blobs->Put(contexts.back().get(), &responses[i]));
    v1::PutBlobChunk chunk;
    chunk.set_sha256(Sha256().UpdateU64(i).Finish().Hex());
    chunk.set_size_bytes(uint64_t{1} << 35);
    chunk.set_data("all that comes");
    EXPECT_TRUE(writers.back()->Write(chunk));
  }
  EXPECT_TRUE(Status().ok());
  for (auto& writer : writers) {
    writer->WritesDone();
    EXPECT_EQ(writer->Finish().error_code(), grpc::StatusCode::DATA_LOSS);
  }
  // Beyond every limit: refused at once. And a tile of 8 GiB that ends early.
  grpc::ClientContext context;
  SetDeadline(context, milliseconds(20000));
  v1::PutBlobResponse response;
  const auto writer = blobs->Put(&context, &response);
  v1::PutBlobChunk chunk;
  chunk.set_sha256(Sha256().Finish().Hex());
  chunk.set_size_bytes(~uint64_t{0});
  writer->Write(chunk);
  writer->WritesDone();
  EXPECT_EQ(writer->Finish().error_code(), grpc::StatusCode::RESOURCE_EXHAUSTED);
  ExpectUnharmed();
}

TEST_F(Intrusion, TinyMessagesWithoutNumberTakeNoMemory) {
  farm_.StartServer();
  Settle();
  grpc::ClientContext context;
  SetDeadline(context, milliseconds(120000));
  v1::PutBlobResponse response;
  const auto writer = v1::BlobService::NewStub(channel_)->Put(&context, &response);
  constexpr int kMessages = 1'000'000;
  v1::PutBlobChunk chunk;
  chunk.set_sha256(Sha256().Update(std::string(kMessages, 'x')).Finish().Hex());
  chunk.set_size_bytes(kMessages);
  chunk.set_data("x");
  // Writes that never wait never look for the coordinator's pings either, and who does not answer
  // those is dropped: other calls on the connection do.
  std::atomic<bool> done = false;
  std::thread others([&] {
    while (!done) {
      EXPECT_TRUE(Status().ok()) << "others are served meanwhile";
      std::this_thread::sleep_for(milliseconds(100));
    }
  });
  int sent = 0;
  for (; sent < kMessages && writer->Write(chunk); ++sent) {
    chunk.clear_sha256();
    chunk.clear_size_bytes();
  }
  writer->WritesDone();
  const grpc::Status status = writer->Finish();
  done = true;
  others.join();
  EXPECT_TRUE(status.ok()) << "after " << sent << ": " << status.error_message()
                           << "; many small chunks are slow, not wrong";
  ExpectUnharmed();
}

TEST_F(Intrusion, WhatKeepsMemorySmallLetsManyLargeTransfersThrough) {
  farm_.StartServer();
  Settle();
  constexpr size_t kTransfers = 32, kChunks = 16;
  std::vector<std::thread> threads;
  std::atomic<int> good = 0;
  for (size_t i = 0; i < kTransfers; ++i) {
    threads.emplace_back([&, i] {
      // A connection of its own, as from another machine.
      const auto channel =
          OpenChannel(farm_.address(), {std::nullopt, ""}, /*own_connection=*/true);
      grpc::ClientContext context;
      SetDeadline(context, milliseconds(60000));
      // Where 32 connect at once, a busy machine may need more than one attempt.
      context.set_wait_for_ready(true);
      v1::PutBlobResponse response;
      const auto writer = v1::BlobService::NewStub(channel)->Put(&context, &response);
      const std::string data(kChunkBytes, static_cast<char>(i));
      Sha256 hash;
      for (size_t k = 0; k < kChunks; ++k) hash.Update(data);
      v1::PutBlobChunk chunk;
      chunk.set_sha256(hash.Finish().Hex());
      chunk.set_size_bytes(kChunks * data.size());
      chunk.set_data(data);
      for (size_t k = 0; k < kChunks && writer->Write(chunk); ++k) {
        chunk.clear_sha256();
        chunk.clear_size_bytes();
      }
      writer->WritesDone();
      const grpc::Status status = writer->Finish();
      good += status.ok() ? 1 : 0;
      EXPECT_TRUE(status.ok()) << status.error_message();
    });
  }
  for (std::thread& thread : threads) thread.join();
  EXPECT_EQ(good, static_cast<int>(kTransfers));
}

// Deflate with its fixed code (RFC 1951, 3.2.6): a zero and then matches of 258 bytes at
// distance 1.
std::string DeflatedZeros(size_t matches) {
  std::string out("\x78\x01", 2);
  uint32_t bits = 0;
  int count = 0;
  const auto put = [&](uint32_t value, int size) {  // least significant bit first
    bits |= value << count;
    count += size;
    while (count >= 8) {
      out += static_cast<char>(bits & 255);
      bits >>= 8;
      count -= 8;
    }
  };
  const auto code = [&](uint32_t value, int size) {  // codes: most significant bit first
    for (int i = size - 1; i >= 0; --i) put(value >> i & 1, 1);
  };
  put(1, 1);
  put(1, 2);
  code(0x30, 8);
  for (size_t i = 0; i < matches; ++i) {
    code(0xc5, 8);  // length 258
    code(0, 5);     // distance 1
  }
  code(0, 7);
  put(0, 7);
  return out + std::string(4, '\0');
}

std::string Png(uint32_t width, uint32_t height, const std::string& data) {
  const auto big = [](uint32_t v) {
    std::string text;
    for (const int shift : {24, 16, 8, 0}) text += static_cast<char>(v >> shift);
    return text;
  };
  const auto chunk = [&](const std::string& type, const std::string& body) {
    uint32_t crc = 0xffffffff;
    for (const char c : type + body) {
      crc ^= static_cast<unsigned char>(c);
      for (int k = 0; k < 8; ++k) crc = (crc >> 1) ^ (0xedb88320u & (0u - (crc & 1)));
    }
    return big(static_cast<uint32_t>(body.size())) + type + body + big(~crc);
  };
  return std::string("\x89PNG\r\n\x1a\n") +
         chunk("IHDR", big(width) + big(height) + std::string("\x08\x06\0\0\0", 5)) +
         chunk("IDAT", data) + chunk("IEND", "");
}

TEST_F(Intrusion, ImagesThatUnpackToFarMoreThanTheySayAreStopped) {
  farm_.StartServer();
  const auto submit = [&](const std::string& image) {
    farm_.Write("bomb.png", image);
    const std::string obj =
        farm_.Write("bomb.obj",
                    "mtllib bomb.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nusemtl a\n"
                    "f 1/1 2/2 3/3\n");
    farm_.Write("bomb.mtl", "newmtl a\nKd 1 1 1\nmap_Kd bomb.png\n");
    return farm_.Client(farm_.WithCoordinator(
        {"submit", obj, "-o", farm_.File("x.exr"), "--points", "100", "--resolution", "32x32"}));
  };
  const size_t kMatches = size_t{1} << 20;  // 256 MiB of zeros in 1.6 MiB
  const std::string zeros = DeflatedZeros(kMatches);
  // A small image of the kind first: importing and failing once is not growth.
  EXPECT_NE(submit(Png(16, 16, DeflatedZeros(1))).exit_code, 0);
  Settle();
  const RunResult bomb = submit(Png(16, 16, zeros));
  EXPECT_EQ(bomb.exit_code, 42) << bomb.err;
  EXPECT_THAT(bomb.err, HasSubstr("bomb.png"));
  ExpectUnharmed();
}

}  // namespace
}  // namespace farpoint

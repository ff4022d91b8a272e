// Misconfigurations, each made for real; `farpoint doctor` must name the cause and the cure
// of each in one line, and nothing else.
#include <arpa/inet.h>
#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <netinet/in.h>
#include <sched.h>
#include <signal.h>
#include <sys/mount.h>
#include <sys/resource.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <sys/wait.h>
#include <unistd.h>

#include <atomic>
#include <cstring>
#include <filesystem>
#include <functional>
#include <nlohmann/json.hpp>
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
using testing::AllOf;
using testing::HasSubstr;
using Json = nlohmann::json;
using Args = std::vector<std::string>;

Args operator+(Args a, const Args& b) {
  a.insert(a.end(), b.begin(), b.end());
  return a;
}

// Listens on loopback and answers every connection with `greeting`; with none, it says nothing.
class FakeServer {
 public:
  explicit FakeServer(std::string greeting, int backlog = 16) : greeting_(std::move(greeting)) {
    fd_ = Descriptor(::socket(AF_INET, SOCK_STREAM | SOCK_CLOEXEC, 0));
    sockaddr_in address{};
    address.sin_family = AF_INET;
    address.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
    socklen_t size = sizeof(address);
    if (::bind(fd_.get(), reinterpret_cast<sockaddr*>(&address), size) != 0 ||
        ::listen(fd_.get(), backlog) != 0 ||
        ::getsockname(fd_.get(), reinterpret_cast<sockaddr*>(&address), &size) != 0) {
      std::abort();
    }
    port_ = ntohs(address.sin_port);
    if (backlog > 0) thread_ = std::thread([this] { Serve(); });
  }
  ~FakeServer() {
    ::shutdown(fd_.get(), SHUT_RDWR);
    if (thread_.joinable()) thread_.join();
  }
  std::string address() const { return "127.0.0.1:" + std::to_string(port_); }
  int port() const { return port_; }

 private:
  void Serve() {
    for (;;) {
      Descriptor peer(::accept(fd_.get(), nullptr, nullptr));
      if (!peer.valid()) return;
      if (greeting_.empty()) {
        silent_.push_back(std::move(peer));
        continue;
      }
      char bytes[256];
      (void)!::recv(peer.get(), bytes, sizeof(bytes), 0);
      (void)::send(peer.get(), greeting_.data(), greeting_.size(), MSG_NOSIGNAL);
      ::shutdown(peer.get(), SHUT_WR);
      while (::recv(peer.get(), bytes, sizeof(bytes), 0) > 0) {
      }
    }
  }
  const std::string greeting_;
  Descriptor fd_;
  int port_ = 0;
  std::vector<Descriptor> silent_;
  std::thread thread_;
};

// A coordinator that says of itself what a test wants.
class FakeCoordinator {
 public:
  explicit FakeCoordinator(CoordinatorHealth health) { service_.health = std::move(health); }
  ~FakeCoordinator() {
    if (server_ != nullptr) server_->Shutdown();
  }
  std::string Start() {
    grpc::ServerBuilder builder;
    int port = 0;
    builder.AddListeningPort("127.0.0.1:0", grpc::InsecureServerCredentials(), &port);
    builder.RegisterService(&service_);
    server_ = builder.BuildAndStart();
    return "127.0.0.1:" + std::to_string(port);
  }
  static CoordinatorHealth Good() {
    CoordinatorHealth health;
    health.version = FARPOINT_VERSION;
    health.protocol_version = kProtocolVersion;
    health.oldest_protocol_version = kOldestProtocolVersion;
    health.unix_ms = NowUnixS() * 1000;
    health.workers = {{.id = {"0badcafe"}, .name = "w1", .fingerprint = HashBytes({})}};
    return health;
  }

 private:
  class Service final : public v1::JobService::Service {
   public:
    CoordinatorHealth health;
    grpc::Status Diagnose(grpc::ServerContext*, const v1::DiagnoseRequest*,
                          v1::DiagnoseResponse* response) override {
      *response = ToWire(health);
      return grpc::Status::OK;
    }
  } service_;
  std::unique_ptr<grpc::Server> server_;
};

class Doctor : public testing::Test {
 protected:
  // Of the faults that `farpoint doctor ARGS` finds. `prepare` runs in the new process, before it.
  Json Faults(const Args& args, const std::function<void()>& prepare = nullptr,
              const std::map<std::string, std::string>& environment = {}) {
    const std::string name = "doctor" + std::to_string(runs_++);
    Args all = {BinFolder() + "/farpoint", "doctor", "--json", farm_.File(name + ".json")};
    all.insert(all.end(), args.begin(), args.end());
    if (prepare) {
      Launch(all, name, prepare);
    } else {
      Process process(all, farm_.File(name + ".out"), farm_.File(name + ".err"), environment);
      exit_code_ = process.Wait(seconds(60)).value_or(-1);
    }
    last_text_ = farm_.Read(name + ".out") + farm_.Read(name + ".err");
    Json faults = Json::array();
    if (!std::filesystem::exists(farm_.File(name + ".json"))) return faults;
    const Json found = Json::parse(farm_.Read(name + ".json"));
    for (const Json& one : found["findings"]) {
      if (one["health"] == "fault") faults.push_back(one);
    }
    return faults;
  }
  // Exactly one fault, of this kind, whose line holds cause and cure.
  void ExpectFault(const std::string& what, const std::string& cause, const std::string& cure,
                   const Args& args, const std::function<void()>& prepare = nullptr) {
    const Json faults = Faults(args, prepare);
    SCOPED_TRACE(last_text_);
    ASSERT_EQ(faults.size(), 1u);
    EXPECT_EQ(faults[0]["what"], what);
    const std::string text = faults[0]["text"];
    EXPECT_THAT(text, AllOf(HasSubstr(cause), HasSubstr(cure)));
    EXPECT_EQ(text.find('\n'), std::string::npos) << "one line";
    EXPECT_LT(text.find(cause), text.rfind(cure)) << "the cause first";
    EXPECT_TRUE(exit_code_ == 42 || exit_code_ == 75) << exit_code_;
  }
  Args At(const std::string& address) { return {"--coordinator", address}; }
  Args Here() { return At(farm_.address()); }

  void Launch(const Args& args, const std::string& name, const std::function<void()>& prepare) {
    const pid_t child = ::fork();
    if (child == 0) {
      prepare();
      std::vector<char*> argv;
      for (const std::string& arg : args) argv.push_back(const_cast<char*>(arg.c_str()));
      argv.push_back(nullptr);
      (void)!std::freopen(farm_.File(name + ".out").c_str(), "w", stdout);
      (void)!std::freopen(farm_.File(name + ".err").c_str(), "w", stderr);
      ::execv(argv[0], argv.data());
      ::_exit(127);
    }
    int status = 0;
    ::waitpid(child, &status, 0);
    exit_code_ = WIFEXITED(status) ? WEXITSTATUS(status) : 128 + WTERMSIG(status);
  }

  Farm farm_;
  int runs_ = 0;
  int exit_code_ = -1;
  std::string last_text_;
};

TEST_F(Doctor, FindsNothingWrongWithAFarmThatWorks) {
  const std::string certs = MakeCerts(farm_);
  farm_.StartServer({"--certs", certs});
  farm_.StartWorker(1, {"--certs", certs});
  ASSERT_TRUE(WaitUntil(seconds(60), [&] {
    return farm_.Logs().find("registered") != std::string::npos;
  })) << farm_.Logs();
  const Json faults =
      Faults(Here() + TlsFlagsOf(certs, "alice") +
             Args{SceneFile("cornell.gltf"), "--points", "1000", "--cache", farm_.File("cache"),
                  "--store", farm_.folder(), "--listen", "127.0.0.1:0"});
  EXPECT_EQ(faults.size(), 0u) << last_text_;
  EXPECT_EQ(exit_code_, 0);
  EXPECT_THAT(last_text_, AllOf(HasSubstr("ok     workers"), HasSubstr("ok     certificate"),
                                HasSubstr("ok     scene")));
}

// --- The way there ------------------------------------------------------------------------------

TEST_F(Doctor, Seed01ANameThatDoesNotResolve) {
  ExpectFault("connection", "'no-such-machine.invalid' does not resolve", "check its spelling",
              At("no-such-machine.invalid:7447") + Args{"--insecure"});
}
TEST_F(Doctor, Seed02NobodyListens) {
  int port = 0;
  { port = FakeServer("x").port(); }
  ExpectFault("connection", "nobody listens on port " + std::to_string(port),
              "start farpoint-server there", At("127.0.0.1:" + std::to_string(port)));
}
TEST_F(Doctor, Seed03NobodyAnswers) {
  // A full queue of connections looks from outside as a firewall that drops.
  FakeServer full("", 0);
  std::vector<Descriptor> waiting;
  for (int i = 0; i < 8; ++i) {
    waiting.emplace_back(::socket(AF_INET, SOCK_STREAM | SOCK_NONBLOCK | SOCK_CLOEXEC, 0));
    sockaddr_in address{};
    address.sin_family = AF_INET;
    address.sin_port = htons(static_cast<uint16_t>(full.port()));
    address.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
    (void)::connect(waiting.back().get(), reinterpret_cast<sockaddr*>(&address), sizeof(address));
  }
  ExpectFault("connection", "does not answer", "no firewall drop port",
              At(full.address()) + Args{"--patience", "1"});
}
TEST_F(Doctor, Seed04AnHttpServerIsThere) {
  FakeServer http("HTTP/1.1 400 Bad Request\r\nContent-Length: 0\r\n\r\n");
  ExpectFault("connection", "an HTTP server answers", "correct the port", At(http.address()));
}
TEST_F(Doctor, Seed05SomethingElseIsThere) {
  FakeServer ssh("SSH-2.0-OpenSSH_9.2p1 Debian-2\r\n");
  ExpectFault("connection", "something else than a coordinator answers", "correct the port",
              At(ssh.address()));
}
TEST_F(Doctor, Seed06AProcessThatHangs) {
  FakeServer silent("");
  ExpectFault("connection", "takes connections but says nothing", "hangs",
              At(silent.address()) + Args{"--patience", "1"});
}
TEST_F(Doctor, Seed07NoTlsBeyondThisMachine) {
  ExpectFault("tls", "without TLS everybody on the way could read", "--certs DIR",
              At("farm.example:7447"));
}

// --- Certificates -------------------------------------------------------------------------------

TEST_F(Doctor, Seed08ACoordinatorThatWantsTls) {
  const std::string certs = MakeCerts(farm_);
  farm_.StartServer({"--certs", certs});
  ExpectFault("certificate", "speaks TLS", "--certs DIR", Here());
}
TEST_F(Doctor, Seed09ACoordinatorWithoutTls) {
  const std::string certs = MakeCerts(farm_);
  farm_.StartServer();
  ExpectFault("connection", "speaks no TLS", "start it with --certs",
              Here() + TlsFlagsOf(certs, "alice"));
}
TEST_F(Doctor, Seed10AnotherFarmsCoordinator) {
  const std::string certs = MakeCerts(farm_), others = MakeCerts(farm_, "others");
  farm_.StartServer({"--certs", certs});
  ExpectFault("connection", "not by this farm's authority", "of one farpoint certs init",
              Here() + TlsFlagsOf(others, "alice"));
}
TEST_F(Doctor, Seed11AnothersCertificate) {
  const std::string certs = MakeCerts(farm_), others = MakeCerts(farm_, "others");
  ExpectFault("certificate", "not by this farm's authority", "of one farpoint certs init",
              Args{"--tls-ca", certs + "/ca.pem", "--tls-cert", others + "/alice.pem", "--tls-key",
                   others + "/alice.key"});
}
TEST_F(Doctor, Seed12AnExpiredCertificate) {
  const std::string certs = MakeCerts(farm_);
  IssueInto(certs, "late", Role::kClient, NowUnixS() - 9 * kTestDayS, NowUnixS() - kTestDayS);
  ExpectFault("certificate", "'late' expired on", "farpoint certs add", TlsFlagsOf(certs, "late"));
}
TEST_F(Doctor, Seed13AClockThatIsBehind) {
  const std::string certs = MakeCerts(farm_);
  IssueInto(certs, "early", Role::kClient, NowUnixS() + kTestDayS, NowUnixS() + 9 * kTestDayS);
  ExpectFault("certificate", "not valid before", "set the clocks", TlsFlagsOf(certs, "early"));
}
TEST_F(Doctor, Seed14AKeyOfAnotherCertificate) {
  const std::string certs = MakeCerts(farm_);
  ExpectFault("certificate", "is not the key of the certificate of 'alice'", "made together",
              Args{"--tls-ca", certs + "/ca.pem", "--tls-cert", certs + "/alice.pem", "--tls-key",
                   certs + "/bob.key"});
}
TEST_F(Doctor, Seed15AKeyThatOthersCanRead) {
  const std::string certs = MakeCerts(farm_);
  ASSERT_EQ(::chmod((certs + "/alice.key").c_str(), 0644), 0);
  ExpectFault("certificate", "can be read or changed by others", "chmod 600",
              TlsFlagsOf(certs, "alice"));
}
TEST_F(Doctor, Seed16AMissingCertificate) {
  const std::string certs = MakeCerts(farm_);
  ExpectFault("certificate", "carol.pem", "No such file", TlsFlagsOf(certs, "carol"));
}
TEST_F(Doctor, Seed17AWorkersCertificateForAClient) {
  const std::string certs = MakeCerts(farm_);
  ExpectFault("role", "is the certificate of a worker", "--role worker",
              TlsFlagsOf(certs, "worker"));
}
TEST_F(Doctor, Seed18ACoordinatorUnderAnotherName) {
  const std::string certs = MakeCerts(farm_);
  IssueInto(certs, "else", Role::kServer, NowUnixS() - 60, NowUnixS() + kTestDayS,
            {"farm.example"});
  farm_.StartServer(TlsFlagsOf(certs, "else"));
  ExpectFault("connection", "names farm.example, not '127.0.0.1'", "--server 127.0.0.1",
              Here() + TlsFlagsOf(certs, "alice"));
}
TEST_F(Doctor, Seed19ATokenThatCountsNoLonger) {
  const std::string certs = MakeCerts(farm_);
  farm_.StartServer({"--certs", certs});
  const RunResult token = farm_.Client({"certs", "token", "carol", "--dir", certs});
  WriteSecret(farm_.File("token"), token.out);
  ASSERT_EQ(farm_.Client({"certs", "revoke", "carol", "--dir", certs}).exit_code, 0);
  ExpectFault("token", "the token is not known here", "farpoint certs token",
              Here() + Args{"--tls-ca", certs + "/ca.pem", "--token-file", farm_.File("token")});
}
TEST_F(Doctor, Seed20ARevokedCertificate) {
  const std::string certs = MakeCerts(farm_);
  ASSERT_EQ(farm_.Client({"certs", "revoke", "alice", "--dir", certs}).exit_code, 0);
  farm_.StartServer({"--certs", certs});
  ExpectFault("certificate", "was revoked", "farpoint certs add",
              Here() + TlsFlagsOf(certs, "alice"));
}

// --- The coordinator ----------------------------------------------------------------------------

TEST_F(Doctor, Seed21AnotherProtocol) {
  CoordinatorHealth health = FakeCoordinator::Good();
  health.version = "9.0.0";
  health.protocol_version = kProtocolVersion + 5;
  health.oldest_protocol_version = kProtocolVersion + 3;
  FakeCoordinator newer(health);
  ExpectFault("version", "speaks protocol", "update this side", At(newer.Start()));
  health.protocol_version = health.oldest_protocol_version = kOldestProtocolVersion - 1;
  FakeCoordinator older(health);
  ExpectFault("version", "speaks protocol", "update the coordinator", At(older.Start()));
}
TEST_F(Doctor, Seed22ACoordinatorFromBefore) {
  grpc::ServerBuilder builder;
  int port = 0;
  v1::JobService::Service knows_nothing;
  builder.AddListeningPort("127.0.0.1:0", grpc::InsecureServerCredentials(), &port);
  builder.RegisterService(&knows_nothing);
  const std::unique_ptr<grpc::Server> server = builder.BuildAndStart();
  ExpectFault("version", "is older than this farpoint", "use one version",
              At("127.0.0.1:" + std::to_string(port)));
}
TEST_F(Doctor, Seed23ClocksThatDisagree) {
  CoordinatorHealth health = FakeCoordinator::Good();
  health.unix_ms += 3600'000;
  FakeCoordinator coordinator(health);
  ExpectFault("clock", "ahead of this machine's", "NTP", At(coordinator.Start()));
}
TEST_F(Doctor, Seed24NoWorkers) {
  farm_.StartServer();
  ExpectFault("workers", "no worker is registered", "start farpoint-worker", Here());
  EXPECT_EQ(exit_code_, 75);
}
TEST_F(Doctor, Seed25WorkersThatComputeOtherPixels) {
  // They say nothing after they have registered.
  farm_.StartServer({"--silence-ms", "600000"});
  const auto workers = v1::WorkerService::NewStub(OpenChannel(farm_.address()));
  for (const char* name : {"epyc1", "epyc2", "xeon"}) {
    grpc::ClientContext context;
    SetDeadline(context, milliseconds(20000));
    const WorkerHello hello{.version = FARPOINT_VERSION,
                            .fingerprint = Sha256().Update(std::string(name, 4)).Finish(),
                            .threads = 1,
                            .name = name};
    v1::RegisterResponse response;
    ASSERT_TRUE(workers->Register(&context, ToWire(hello), &response).ok());
  }
  ExpectFault("fingerprints", "1 of 3 workers ('xeon')", "one make of processor", Here());
}
TEST_F(Doctor, Seed25bWorkersThatAreGone) {
  farm_.StartServer();
  farm_.StartWorker();
  farm_.StartWorker();
  const auto gone = [&](size_t count) {
    return WaitUntil(seconds(60), [&] {
      const std::string status = farm_.Status();
      if (status.empty()) return false;
      const Json workers = Json::parse(status)["workers"];
      return workers.size() == 2 &&
             static_cast<size_t>(std::count_if(workers.begin(), workers.end(), [](const Json& one) {
               return one["gone"] == true;
             })) == count;
    });
  };
  ASSERT_TRUE(gone(0)) << farm_.Logs();
  farm_.worker(0).Signal(SIGKILL);
  ASSERT_TRUE(gone(1)) << farm_.Logs();
  EXPECT_TRUE(Faults(Here()).empty());
  EXPECT_THAT(last_text_, HasSubstr("1 worker is gone"));
  EXPECT_THAT(last_text_, HasSubstr("1 worker is there"));
  farm_.worker(1).Signal(SIGKILL);
  ASSERT_TRUE(gone(2)) << farm_.Logs();
  ExpectFault("workers", "all workers are gone", "start farpoint-worker", Here());
}
TEST_F(Doctor, Seed26ADrainingCoordinator) {
  farm_.StartServer({"--drain-seconds", "60"});
  farm_.StartWorker();
  const auto client = farm_.StartClient(
      farm_.WithCoordinator({"submit", SceneFile("cornell.gltf"), "-o", farm_.File("x.exr"),
                             "--resolution", "64x64", "--integrator", "pt", "--paths", "65536",
                             "--points", "100", "--tile", "64"}),
      "client");
  ASSERT_TRUE(WaitUntil(seconds(60), [&] {
    const std::string status = farm_.Status();
    if (status.empty()) return false;
    const Json jobs = Json::parse(status)["jobs"];
    return jobs.size() == 1 && jobs[0]["tiles"]["leased"] == 1;
  })) << farm_.Logs();
  farm_.server().Signal(SIGTERM);
  ASSERT_TRUE(
      WaitUntil(seconds(20), [&] { return farm_.Logs().find("draining") != std::string::npos; }));
  ExpectFault("draining", "the coordinator drains", "wait until it is started again", Here());
  farm_.worker(0).Signal(SIGKILL);
}
TEST_F(Doctor, Seed27AJobThatIsTooLargeForTheCoordinator) {
  farm_.StartServer({"--max-asset-bytes", "100"});
  const auto workers = v1::WorkerService::NewStub(OpenChannel(farm_.address()));
  grpc::ClientContext context;
  SetDeadline(context, milliseconds(20000));
  v1::RegisterResponse response;
  const WorkerHello hello{
      .version = FARPOINT_VERSION, .fingerprint = HashBytes({}), .threads = 1, .name = "w"};
  ASSERT_TRUE(workers->Register(&context, ToWire(hello), &response).ok());
  ExpectFault("limits", "the coordinator takes 100 bytes", "--max-asset-bytes",
              Here() + Args{SceneFile("cornell.gltf")});
}
TEST_F(Doctor, Seed28TooFewOpenFilesForACoordinator) {
  CoordinatorHealth health = FakeCoordinator::Good();
  health.open_files_limit = 300;
  FakeCoordinator coordinator(health);
  ExpectFault("files", "the coordinator may have only 300 open files", "ulimit -n 65536",
              At(coordinator.Start()));
}
TEST_F(Doctor, Seed29ASharedFolderThatIsNotShared) {
  farm_.StartServer({"--blob-dir", farm_.File("blobs")});
  const auto workers = v1::WorkerService::NewStub(OpenChannel(farm_.address()));
  grpc::ClientContext context;
  SetDeadline(context, milliseconds(20000));
  v1::RegisterResponse response;
  const WorkerHello hello{
      .version = FARPOINT_VERSION, .fingerprint = HashBytes({}), .threads = 1, .name = "w"};
  ASSERT_TRUE(workers->Register(&context, ToWire(hello), &response).ok());
  EXPECT_EQ(Faults(Here() + Args{"--blob-dir", farm_.File("blobs")}).size(), 0u) << last_text_;
  std::filesystem::create_directory(farm_.File("local"));
  ExpectFault("blobs", "is not the folder that the coordinator shares",
              "mount the same file system", Here() + Args{"--blob-dir", farm_.File("local")});
}

// --- This machine -------------------------------------------------------------------------------

TEST_F(Doctor, Seed30APortThatIsTaken) {
  FakeServer other("x");
  ExpectFault("listen", "another process listens there", "take another port",
              {"--listen", other.address()});
}
TEST_F(Doctor, Seed31AnAddressOfAnotherMachine) {
  ExpectFault("listen", "no address of this machine", "0.0.0.0", {"--listen", "192.0.2.7:7447"});
}
TEST_F(Doctor, Seed32AStoreOnAMissingFolder) {
  ExpectFault("store", "there is no such folder", "create it",
              {"--store", farm_.File("not-mounted/store")});
}
TEST_F(Doctor, Seed33AStoreThatCannotBeWritten) {
  // Nobody can, not even root.
  ExpectFault("store", "cannot write into", "give this user the right", {"--store", "/proc"});
}
TEST_F(Doctor, Seed34ACacheThatCannotBeWritten) {
  ExpectFault("cache", "cannot write into", "name another folder", {"--cache", "/proc/farpoint"});
  ExpectFault("cache", "is no folder", "name another one",
              {"--cache", farm_.Write("file", "x") + "/cache"});
}
TEST_F(Doctor, Seed35AStoreThatIsFull) {
  const std::string folder = farm_.File("small");
  std::filesystem::create_directory(folder);
  const auto small_disk = [folder] {
    // A file system of its own, for this process alone.
    if (::unshare(::geteuid() == 0 ? CLONE_NEWNS : CLONE_NEWUSER | CLONE_NEWNS) != 0 ||
        ::mount("none", "/", nullptr, MS_REC | MS_PRIVATE, nullptr) != 0 ||
        ::mount("tmpfs", folder.c_str(), "tmpfs", 0, "size=8m") != 0) {
      ::_exit(99);
    }
  };
  Faults({"--store", folder}, small_disk);
  if (exit_code_ == 99) GTEST_SKIP() << "no file system can be mounted here";
  ExpectFault("store", "are free there", "name a folder on another disk", {"--store", folder},
              small_disk);
}
TEST_F(Doctor, Seed36TooLittleMemoryForAScene) {
  ExpectFault("memory", "the scene takes about 104.6 TiB", "fewer --points",
              {SceneFile("cornell.gltf"), "--points", "1000000000000"});
}
TEST_F(Doctor, Seed37TooFewOpenFilesHere) {
  ExpectFault("files", "only 100 open files", "ulimit -n 65536", {}, [] {
    const rlimit few{100, 100};
    ::setrlimit(RLIMIT_NOFILE, &few);
  });
}
TEST_F(Doctor, Seed38AProcessorWithoutAvx2) {
  // The C library's own way of hiding a feature. The programs say so before they do anything else.
  Faults({}, nullptr, {{"GLIBC_TUNABLES", "glibc.cpu.hwcaps=-AVX2"}});
  EXPECT_EQ(exit_code_, 42);
  EXPECT_THAT(last_text_, AllOf(HasSubstr("this processor has no AVX2"),
                                HasSubstr("take a machine of 2013 or later")));
}

}  // namespace
}  // namespace farpoint

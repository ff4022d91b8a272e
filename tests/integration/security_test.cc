// Who may do what at a coordinator, with real processes and real handshakes: every refusal happens
// before a handler runs, and says why on both sides.
#include <gmock/gmock.h>
#include <grpcpp/grpcpp.h>
#include <grpcpp/impl/codegen/client_unary_call.h>
#include <gtest/gtest.h>
#include <signal.h>
#include <sys/inotify.h>
#include <sys/stat.h>
#include <unistd.h>

#include <filesystem>
#include <nlohmann/json.hpp>

#include "proto/convert.h"
#include "proto/farpoint.grpc.pb.h"
#include "proto/grpc_channel.h"
#include "tests/integration/certificates.h"
#include "tests/integration/farm.h"

namespace farpoint {
namespace {

namespace fs = std::filesystem;
using std::chrono::milliseconds;
using std::chrono::seconds;
using testing::AllOf;
using testing::HasSubstr;
using testing::StartsWith;
using Json = nlohmann::json;

std::vector<std::string> operator+(std::vector<std::string> a, const std::vector<std::string>& b) {
  a.insert(a.end(), b.begin(), b.end());
  return a;
}

class SecurityTest : public testing::Test {
 protected:
  void SetUp() override { certs_ = MakeCerts(farm_); }
  void Start(const std::vector<std::string>& flags = {}) {
    farm_.StartServer(std::vector<std::string>{"--certs", certs_} + flags);
  }

  RunResult Ask(const std::vector<std::string>& flags, const std::string& verb = "status") {
    return farm_.Client(farm_.WithCoordinator({verb, "--patience", "1"}) + flags);
  }
  // What a call over a channel with this material answers. Nothing of the peer's is checked first.
  grpc::Status Call(const TlsMaterial& tls, const std::string& token = "") {
    return CallOn(OpenChannel(farm_.address(), {tls, token}));
  }
  static grpc::Status CallOn(const std::shared_ptr<grpc::Channel>& channel) {
    grpc::ClientContext context;
    SetDeadline(context, milliseconds(20000));
    v1::StatusResponse response;
    return v1::JobService::NewStub(channel)->Status(&context, {}, &response);
  }
  grpc::Status Register(const TlsMaterial& tls) {
    grpc::ClientContext context;
    SetDeadline(context, milliseconds(20000));
    v1::RegisterResponse response;
    const WorkerHello hello{
        .version = FARPOINT_VERSION, .fingerprint = HashBytes({}), .threads = 1, .name = "guest"};
    return v1::WorkerService::NewStub(OpenChannel(farm_.address(), {tls, ""}))
        ->Register(&context, ToWire(hello), &response);
  }
  std::string Token(const std::string& name, const std::vector<std::string>& flags = {}) {
    const RunResult made =
        farm_.Client(std::vector<std::string>{"certs", "token", name, "--dir", certs_} + flags);
    EXPECT_EQ(made.exit_code, 0) << made.err;
    WriteSecret(farm_.File(name + ".token"), made.out);
    return farm_.File(name + ".token");
  }
  // Submits a small job that stays paused; its id.
  std::string Submit(const std::vector<std::string>& flags, const std::string& scene = "") {
    const RunResult result = farm_.Client(
        farm_.WithCoordinator({"submit", scene.empty() ? SceneFile("cornell.gltf") : scene,
                               "--detach", "--paused", "--resolution", "32x32"}) +
        flags);
    last_error_ = result.err;
    return result.exit_code == 0 ? result.out.substr(0, result.out.find('\n')) : std::string();
  }

  Farm farm_;
  std::string certs_, last_error_;
};

TEST_F(SecurityTest, AWholeJobGoesOverTls) {
  Start();
  farm_.StartWorker(1, {"--certs", certs_});
  const std::vector<std::string> job = {
      SceneFile("cornell.gltf"), "--resolution", "48x32", "--points", "300", "--tile", "32"};
  const RunResult submitted =
      farm_.Client(farm_.WithCoordinator(std::vector<std::string>{"submit"} + job +
                                         std::vector<std::string>{"-o", farm_.File("tls.exr")}) +
                   TlsFlagsOf(certs_, "alice"));
  ASSERT_EQ(submitted.exit_code, 0) << submitted.err << farm_.Logs();
  ASSERT_EQ(farm_
                .Client(std::vector<std::string>{"render"} + job +
                        std::vector<std::string>{"-o", farm_.File("here.exr")})
                .exit_code,
            0);
  EXPECT_EQ(ImageHashOf(farm_.File("tls.exr")), ImageHashOf(farm_.File("here.exr")));
  const Json status =
      Json::parse(Ask(TlsFlagsOf(certs_, "bob") + std::vector<std::string>{"--json", "-"}).out);
  EXPECT_EQ(status["jobs"][0]["owner"], "alice");
}

// Certificates expire: new ones are put where the old ones are, while everything runs.
TEST_F(SecurityTest, NewCertificatesAreTakenWithoutARestart) {
  Start();
  farm_.StartWorker(1, {"--certs", certs_});
  const auto replace = [&](const std::string& name, Role role, const std::string& host) {
    const std::string folder = farm_.File("new");
    fs::create_directory(folder);
    for (const char* file : {"ca.pem", "ca.key"}) {
      fs::copy_file(certs_ + "/" + file, folder + "/" + file, fs::copy_options::skip_existing);
    }
    const int64_t now_s = NowUnixS();
    IssueInto(folder, name, role, now_s - 60, now_s + kTestDayS,
              host.empty() ? std::vector<std::string>() : std::vector<std::string>{host});
    fs::rename(folder + "/" + name + ".key", certs_ + "/" + name + ".key");
    fs::rename(folder + "/" + name + ".pem", certs_ + "/" + name + ".pem");
  };
  const auto wait_for = [&](const std::string& text, size_t count) {
    for (int i = 0; i < 600; ++i) {
      const std::string logs = farm_.Logs();
      size_t found = 0;
      for (size_t at = logs.find(text); at != std::string::npos; at = logs.find(text, at + 1)) {
        ++found;
      }
      if (found >= count) return true;
      std::this_thread::sleep_for(milliseconds(50));
    }
    return false;
  };
  const auto ask = [&] {
    return Ask(TlsFlagsOf(certs_, "bob") + std::vector<std::string>{"--json", "-"});
  };
  ASSERT_TRUE(wait_for("registered as", 1)) << farm_.Logs();
  // One that names another machine shows that new connections see it.
  replace("server", Role::kServer, "elsewhere.example");
  ASSERT_TRUE(wait_for("new connections see it", 1)) << farm_.Logs();
  EXPECT_NE(ask().exit_code, 0);
  for (size_t i = 2; i <= 4; ++i) {
    replace("server", Role::kServer, "127.0.0.1");
    ASSERT_TRUE(wait_for("new connections see it", i)) << farm_.Logs();
  }
  replace("worker", Role::kWorker, "");
  ASSERT_TRUE(wait_for("connected anew with it", 1)) << farm_.Logs();
  const RunResult asked = ask();
  ASSERT_EQ(asked.exit_code, 0) << asked.err;
  const RunResult submitted =
      farm_.Client(farm_.WithCoordinator({"submit", SceneFile("cornell.gltf"), "--resolution",
                                          "32x32", "--points", "300", "-o", farm_.File("a.exr")}) +
                   TlsFlagsOf(certs_, "alice"));
  EXPECT_EQ(submitted.exit_code, 0) << submitted.err << farm_.Logs();
  // Files that do not fit together are told, and change nothing.
  fs::copy_file(certs_ + "/alice.key", certs_ + "/server.key",
                fs::copy_options::overwrite_existing);
  ASSERT_TRUE(wait_for("cannot be used", 1)) << farm_.Logs();
  EXPECT_EQ(ask().exit_code, 0);
}

TEST_F(SecurityTest, PlaintextIsRefusedInWordsThatItsSenderUnderstands) {
  Start();
  const RunResult client = Ask({});
  EXPECT_EQ(client.exit_code, 42);
  EXPECT_THAT(client.err, AllOf(HasSubstr("speaks TLS"), HasSubstr("--certs DIR")));
  EXPECT_THAT(farm_.Logs(), HasSubstr("does not speak TLS"));
  // A worker ends with it too, instead of trying for ever.
  const size_t worker = farm_.StartWorker();
  EXPECT_EQ(farm_.worker(worker).Wait(seconds(30)), 42);
  EXPECT_THAT(farm_.Logs(), HasSubstr("cannot register: this coordinator speaks TLS"));
}

TEST_F(SecurityTest, TlsToACoordinatorInTheClearIsRefusedClearly) {
  farm_.StartServer();
  const RunResult client = Ask(TlsFlagsOf(certs_, "alice"));
  EXPECT_EQ(client.exit_code, 42);
  EXPECT_THAT(client.err, HasSubstr("speaks no TLS"));
  EXPECT_THAT(farm_.Logs(), HasSubstr("speaks TLS, this coordinator does not"));
}

TEST_F(SecurityTest, AnotherFarmsCertificatesAreRefusedOnBothSides) {
  const std::string others = MakeCerts(farm_, "others");
  Start();
  // The client finds the coordinator's certificate to be of another authority.
  const RunResult client = Ask(TlsFlagsOf(others, "alice"));
  EXPECT_EQ(client.exit_code, 42);
  EXPECT_THAT(client.err, AllOf(HasSubstr("not by this farm's authority"), HasSubstr("'server'")));
  // One that trusts the coordinator, with a certificate of another authority: found in its own
  // files …
  const RunResult mixed = Ask({"--tls-ca", certs_ + "/ca.pem", "--tls-cert", others + "/alice.pem",
                               "--tls-key", others + "/alice.key"});
  EXPECT_EQ(mixed.exit_code, 42);
  EXPECT_THAT(mixed.err, HasSubstr("not by this farm's authority"));
  // … and by the coordinator.
  const grpc::Status refused = Call(Unchecked(certs_, others, "alice"));
  EXPECT_EQ(refused.error_code(), grpc::StatusCode::UNAUTHENTICATED);
  EXPECT_THAT(refused.error_message(), HasSubstr("not by this farm's authority"));
  EXPECT_EQ(Register(Unchecked(certs_, others, "worker")).error_code(),
            grpc::StatusCode::UNAUTHENTICATED);
  EXPECT_THAT(farm_.Logs(), AllOf(HasSubstr("refused /farpoint.v1.JobService/Status"),
                                  HasSubstr("refused /farpoint.v1.WorkerService/Register")));
}

TEST_F(SecurityTest, ExpiredAndFutureCertificatesAreRefused) {
  const int64_t now = NowUnixS();
  IssueInto(certs_, "late", Role::kClient, now - 30 * kTestDayS, now - kTestDayS);
  IssueInto(certs_, "early", Role::kClient, now + kTestDayS, now + 30 * kTestDayS);
  Start();
  const grpc::Status late = Call(Unchecked(certs_, certs_, "late"));
  EXPECT_EQ(late.error_code(), grpc::StatusCode::UNAUTHENTICATED);
  EXPECT_THAT(late.error_message(), AllOf(HasSubstr("'late' expired on"), HasSubstr("certs add")));
  const grpc::Status early = Call(Unchecked(certs_, certs_, "early"));
  EXPECT_EQ(early.error_code(), grpc::StatusCode::UNAUTHENTICATED);
  EXPECT_THAT(early.error_message(), AllOf(HasSubstr("not valid before"), HasSubstr("clock")));
  EXPECT_THAT(Ask(TlsFlagsOf(certs_, "late")).err, HasSubstr("expired on"));
}

TEST_F(SecurityTest, AnExpiredCoordinatorIsRefusedByItselfAndByItsClients) {
  const int64_t now = NowUnixS();
  IssueInto(certs_, "old", Role::kServer, now - 30 * kTestDayS, now - kTestDayS, {"127.0.0.1"});
  Process itself({BinFolder() + "/farpoint-server", "--listen", "127.0.0.1:0", "--store",
                  farm_.File("store"), "--tls-ca", certs_ + "/ca.pem", "--tls-cert",
                  certs_ + "/old.pem", "--tls-key", certs_ + "/old.key"},
                 farm_.File("itself"), farm_.File("itself"));
  EXPECT_EQ(itself.Wait(seconds(20)), 42);
  EXPECT_THAT(farm_.Read("itself"), HasSubstr("'old' expired on"));
  // One that was started in time and runs on.
  grpc::ServerBuilder builder;
  int port = 0;
  builder.AddListeningPort("127.0.0.1:0", ServerTls(Unchecked(certs_, certs_, "old")), &port);
  v1::JobService::Service service;
  builder.RegisterService(&service);
  const std::unique_ptr<grpc::Server> server = builder.BuildAndStart();
  ASSERT_NE(server, nullptr);
  const RunResult client =
      farm_.Client(std::vector<std::string>{"status", "--patience", "1", "--coordinator",
                                            "127.0.0.1:" + std::to_string(port)} +
                   TlsFlagsOf(certs_, "alice"));
  EXPECT_EQ(client.exit_code, 42);
  EXPECT_THAT(client.err, HasSubstr("'old' expired on"));
}

TEST_F(SecurityTest, ACoordinatorUnderAnotherNameIsRefused) {
  IssueInto(certs_, "elsewhere", Role::kServer, NowUnixS() - 60, NowUnixS() + kTestDayS,
            {"farm.example", "10.1.2.3"});
  farm_.StartServer(TlsFlagsOf(certs_, "elsewhere"));
  const RunResult client = Ask(TlsFlagsOf(certs_, "alice"));
  EXPECT_EQ(client.exit_code, 42);
  EXPECT_THAT(client.err, AllOf(HasSubstr("farm.example, 10.1.2.3"), HasSubstr("not '127.0.0.1'")));
}

TEST_F(SecurityTest, EachRoleMayCallItsOwnMethodsOnly) {
  Start();
  // A client as a worker.
  const grpc::Status as_worker = Register(Unchecked(certs_, certs_, "alice"));
  EXPECT_EQ(as_worker.error_code(), grpc::StatusCode::PERMISSION_DENIED);
  EXPECT_THAT(as_worker.error_message(),
              AllOf(HasSubstr("'alice' has the role client"), HasSubstr("wants worker")));
  const size_t worker = farm_.StartWorker(1, TlsFlagsOf(certs_, "alice"));
  EXPECT_EQ(farm_.worker(worker).Wait(seconds(30)), 42);
  EXPECT_THAT(farm_.Logs(), HasSubstr("'alice' has the role client"));
  // A worker as a client, and a coordinator's certificate as anything.
  EXPECT_EQ(Call(Unchecked(certs_, certs_, "worker")).error_code(),
            grpc::StatusCode::PERMISSION_DENIED);
  EXPECT_EQ(Call(Unchecked(certs_, certs_, "server")).error_code(),
            grpc::StatusCode::UNAUTHENTICATED);
  EXPECT_TRUE(Register(Unchecked(certs_, certs_, "worker")).ok());
  EXPECT_TRUE(Call(Unchecked(certs_, certs_, "alice")).ok());
  // A client's certificate does not make a coordinator.
  Process impostor({BinFolder() + "/farpoint-server", "--listen", "127.0.0.1:0", "--store",
                    farm_.File("other"), "--tls-ca", certs_ + "/ca.pem", "--tls-cert",
                    certs_ + "/alice.pem", "--tls-key", certs_ + "/alice.key"},
                   farm_.File("impostor"), farm_.File("impostor"));
  EXPECT_EQ(impostor.Wait(seconds(20)), 42);
}

TEST_F(SecurityTest, NobodyWithoutCertificateOrTokenGetsAnAnswerButHealth) {
  Start();
  TlsMaterial stranger;
  stranger.ca = ReadWhole(certs_ + "/ca.pem");
  const grpc::Status refused = Call(stranger);
  EXPECT_EQ(refused.error_code(), grpc::StatusCode::UNAUTHENTICATED);
  EXPECT_THAT(refused.error_message(), HasSubstr("wants to know who calls"));
  EXPECT_EQ(Register(stranger).error_code(), grpc::StatusCode::UNAUTHENTICATED);
  // What an orchestrator asks, without a word: HealthCheckRequest has no field that must be set.
  grpc::ClientContext context;
  SetDeadline(context, milliseconds(20000));
  const v1::CancelRequest nothing;
  v1::CancelResponse answer;
  const grpc::internal::RpcMethod check("/grpc.health.v1.Health/Check",
                                        grpc::internal::RpcMethod::NORMAL_RPC);
  const auto channel = OpenChannel(farm_.address(), {stranger, ""});
  EXPECT_TRUE((grpc::internal::BlockingUnaryCall<v1::CancelRequest, v1::CancelResponse>(
                   channel.get(), check, &context, nothing, &answer))
                  .ok());
  EXPECT_EQ(Ask({"--tls-ca", certs_ + "/ca.pem"}).exit_code, 42);
}

TEST_F(SecurityTest, TokensStandInForAClientsCertificate) {
  const std::string good = Token("carol");
  const std::string other = Token("dave");
  Start();
  const auto with = [&](const std::string& file) {
    return std::vector<std::string>{"--certs", certs_, "--token-file", file};
  };
  EXPECT_EQ(Ask(with(good)).exit_code, 0) << farm_.Logs();
  // The hash is kept, not the token.
  const std::string text = ReadWhole(good).substr(0, 67);
  EXPECT_THAT(ReadWhole(certs_ + "/tokens"),
              AllOf(HasSubstr(TokenHash(text).Hex()), testing::Not(HasSubstr(text))));
  // Not a worker's.
  TlsMaterial nobody;
  nobody.ca = ReadWhole(certs_ + "/ca.pem");
  EXPECT_TRUE(Call(nobody, text).ok());

  std::string wrong = text;
  wrong.back() = wrong.back() == '0' ? '1' : '0';
  WriteSecret(farm_.File("wrong.token"), wrong + "\n");
  const RunResult refused = Ask(with(farm_.File("wrong.token")));
  EXPECT_EQ(refused.exit_code, 42);
  EXPECT_THAT(refused.err, HasSubstr("the token is not known here"));
  EXPECT_EQ(Call(nobody, "fp_short").error_code(), grpc::StatusCode::UNAUTHENTICATED);

  // Revoked while the coordinator runs; the other one goes on.
  ASSERT_EQ(farm_.Client({"certs", "revoke", "carol", "--dir", certs_}).exit_code, 0);
  EXPECT_TRUE(WaitUntil(seconds(10), [&] { return Ask(with(good)).exit_code == 42; }));
  EXPECT_EQ(Ask(with(other)).exit_code, 0);
  // Readable by others, or over an open line: not used at all.
  ASSERT_EQ(::chmod(other.c_str(), 0644), 0);
  EXPECT_THAT(Ask(with(other)).err, HasSubstr("chmod 600"));
  ASSERT_EQ(::chmod(other.c_str(), 0600), 0);
  EXPECT_EQ(Ask({"--token-file", other}).exit_code, 2);
}

TEST_F(SecurityTest, ARevokedCertificateCountsNoLongerEvenOnAnOpenConnection) {
  Start();
  const auto alice = OpenChannel(farm_.address(), {Unchecked(certs_, certs_, "alice"), ""});
  const auto bob = OpenChannel(farm_.address(), {Unchecked(certs_, certs_, "bob"), ""});
  EXPECT_TRUE(CallOn(alice).ok());
  ASSERT_EQ(farm_.Client({"certs", "revoke", "alice", "--dir", certs_}).exit_code, 0);
  grpc::Status refused;
  EXPECT_TRUE(WaitUntil(seconds(10), [&] { return !(refused = CallOn(alice)).ok(); }));
  EXPECT_EQ(refused.error_code(), grpc::StatusCode::UNAUTHENTICATED);
  EXPECT_THAT(refused.error_message(), HasSubstr("was revoked"));
  EXPECT_TRUE(CallOn(bob).ok());
}

TEST_F(SecurityTest, AClientChangesItsOwnJobsAndAnAdminAll) {
  IssueInto(certs_, "boss", Role::kAdmin, NowUnixS() - 60, NowUnixS() + kTestDayS);
  Start();
  const std::string job = Submit(TlsFlagsOf(certs_, "alice"));
  ASSERT_NE(job, "") << last_error_;
  const auto tell = [&](const std::string& verb, const std::string& who) {
    return farm_.Client(farm_.WithCoordinator({verb, job}) + TlsFlagsOf(certs_, who));
  };
  for (const char* verb : {"cancel", "resume", "pause", "requeue"}) {
    const RunResult refused = tell(verb, "bob");
    EXPECT_EQ(refused.exit_code, 42) << verb;
    EXPECT_THAT(refused.err, AllOf(HasSubstr("'alice''s"), HasSubstr("'bob''s"))) << verb;
  }
  EXPECT_EQ(tell("status", "bob").exit_code, 0) << "everybody may look";
  EXPECT_EQ(tell("resume", "alice").exit_code, 0);
  EXPECT_EQ(tell("cancel", "boss").exit_code, 0);
  // Still known after a restart.
  farm_.server().Signal(SIGKILL);
  farm_.server().Wait(seconds(10));
  Start();
  EXPECT_EQ(tell("requeue", "bob").exit_code, 42);
  EXPECT_EQ(tell("requeue", "alice").exit_code, 0);
}

TEST_F(SecurityTest, EachClientHasItsLimits) {
  Start({"--max-jobs-per-client", "1", "--max-bytes-per-client", "200000"});
  const std::string first = Submit(TlsFlagsOf(certs_, "alice"));
  ASSERT_NE(first, "") << last_error_;
  EXPECT_EQ(Submit(TlsFlagsOf(certs_, "alice")), "");
  EXPECT_THAT(last_error_, AllOf(HasSubstr("'alice' has 1 jobs"), HasSubstr("cancel one")));
  EXPECT_NE(Submit(TlsFlagsOf(certs_, "bob")), "") << last_error_;
  ASSERT_EQ(farm_.Client(farm_.WithCoordinator({"cancel", first}) + TlsFlagsOf(certs_, "alice"))
                .exit_code,
            0);
  EXPECT_NE(Submit(TlsFlagsOf(certs_, "alice")), "") << last_error_;
  // Another scene, too large for what is left.
  EXPECT_EQ(Submit(TlsFlagsOf(certs_, "bob"), SceneFile("city.glb")), "");
  EXPECT_THAT(last_error_, AllOf(HasSubstr("above the limit of 200000")));
}

TEST_F(SecurityTest, AClientThatCallsTooOftenIsToldSo) {
  Start({"--max-calls-per-second", "5"});
  const auto alice = OpenChannel(farm_.address(), {Unchecked(certs_, certs_, "alice"), ""});
  grpc::Status refused;
  int calls = 0;
  while (refused.ok() && ++calls < 1000) refused = CallOn(alice);
  EXPECT_EQ(refused.error_code(), grpc::StatusCode::RESOURCE_EXHAUSTED);
  EXPECT_THAT(refused.error_message(), HasSubstr("more than 5 calls a second"));
  EXPECT_GE(calls, 20) << "a burst is no flood";
  const auto bob = OpenChannel(farm_.address(), {Unchecked(certs_, certs_, "bob"), ""});
  EXPECT_TRUE(CallOn(bob).ok());
}

TEST(Plaintext, IsForThisMachineOnlyUnlessSomebodyInsists) {
  Farm farm;
  const auto run = [&](std::vector<std::string> args) {
    args[0] = BinFolder() + "/" + args[0];
    const std::string name =
        "run" + std::to_string(std::hash<std::string>()(args[1] + args.back()));
    Process process(args, farm.File(name), farm.File(name));
    const auto code = process.Wait(seconds(20));
    return RunResult{code.value_or(-1), "", farm.Read(name)};
  };
  const RunResult server =
      run({"farpoint-server", "--listen", "0.0.0.0:0", "--store", farm.File("store")});
  EXPECT_EQ(server.exit_code, 2);
  EXPECT_THAT(server.err, AllOf(StartsWith("farpoint-server: --listen"), HasSubstr("--certs DIR"),
                                HasSubstr("--insecure")));
  const RunResult worker =
      run({"farpoint-worker", "--coordinator", "10.255.255.1:7447", "--cache", farm.File("cache")});
  EXPECT_EQ(worker.exit_code, 2);
  EXPECT_THAT(worker.err, AllOf(HasSubstr("--coordinator"), HasSubstr("--certs DIR")));
  const RunResult client = farm.Client({"status", "--coordinator", "10.255.255.1:7447"});
  EXPECT_EQ(client.exit_code, 2);
  EXPECT_THAT(client.err, AllOf(HasSubstr("--coordinator"), HasSubstr("--insecure")));
  // A name that only looks like loopback is not.
  EXPECT_EQ(farm.Client({"status", "--coordinator", "127.0.0.1.example:7447"}).exit_code, 2);
}

TEST(Plaintext, BeyondThisMachineIsPossibleAndLoud) {
  Farm farm;
  Process server({BinFolder() + "/farpoint-server", "--listen", "0.0.0.0:0", "--insecure",
                  "--store", farm.File("store")},
                 farm.File("log"), farm.File("log"));
  EXPECT_TRUE(WaitUntil(
      seconds(20), [&] { return farm.Read("log").find("listening on") != std::string::npos; }));
  EXPECT_THAT(farm.Read("log"), AllOf(HasSubstr("warning"), HasSubstr("no encryption")));
}

TEST(Certs, NothingIsOverwrittenAndKeysAreSecret) {
  Farm farm;
  const std::string certs = MakeCerts(farm);
  for (const char* key : {"ca.key", "server.key", "worker.key", "alice.key"}) {
    struct stat facts {};
    ASSERT_EQ(::stat((certs + "/" + key).c_str(), &facts), 0) << key;
    EXPECT_EQ(facts.st_mode & 0777, 0600u) << key;
  }
  const std::string before = ReadWhole(certs + "/ca.pem");
  const RunResult again = farm.Client({"certs", "init", "--dir", certs});
  EXPECT_EQ(again.exit_code, 42);
  EXPECT_THAT(again.err, HasSubstr("farpoint certs add"));
  EXPECT_EQ(farm.Client({"certs", "add", "alice", "--dir", certs}).exit_code, 42);
  EXPECT_EQ(ReadWhole(certs + "/ca.pem"), before);
  EXPECT_EQ(farm.Client({"certs", "add", "eve", "--role", "worker", "--dir", certs}).exit_code, 0);
  const RunResult shown = farm.Client({"certs", "show", "--dir", certs});
  EXPECT_THAT(shown.out,
              AllOf(HasSubstr("authority 'farpoint-ca"), HasSubstr("eve.pem, .key: worker"),
                    HasSubstr("server, for 127.0.0.1 localhost")));
  // OpenSSL's own program agrees, where it is installed.
  if (::access("/usr/bin/openssl", X_OK) == 0) {
    Process verify({"/usr/bin/openssl", "verify", "-x509_strict", "-purpose", "sslserver",
                    "-CAfile", certs + "/ca.pem", certs + "/server.pem"},
                   farm.File("verify"), farm.File("verify"));
    EXPECT_EQ(verify.Wait(seconds(20)), 0) << farm.Read("verify");
  }
}

// --- No path of a job is opened ---------------------------------------------------------------

class PathTest : public testing::Test {
 protected:
  void SetUp() override {
    farm_.StartServer();
    farm_.StartWorker();
    bait_ = farm_.Write("bait.png", "not for jobs");
    watch_ = ::inotify_init1(IN_NONBLOCK | IN_CLOEXEC);
    ASSERT_GE(watch_, 0);
    ASSERT_GE(::inotify_add_watch(watch_, bait_.c_str(), IN_OPEN | IN_ACCESS), 0);
    channel_ = OpenChannel(farm_.address());
  }
  void TearDown() override {
    if (watch_ >= 0) ::close(watch_);
  }
  bool BaitWasTouched() {
    char events[4096];
    return ::read(watch_, events, sizeof(events)) > 0;
  }
  std::string Put(const std::string& content) {
    const Digest digest = Sha256().Update(content).Finish();
    grpc::ClientContext context;
    SetDeadline(context, milliseconds(20000));
    v1::PutBlobResponse response;
    const auto stream = v1::BlobService::NewStub(channel_)->Put(&context, &response);
    v1::PutBlobChunk chunk;
    chunk.set_sha256(digest.Hex());
    chunk.set_size_bytes(content.size());
    chunk.set_data(content);
    stream->Write(chunk);
    stream->WritesDone();
    EXPECT_TRUE(stream->Finish().ok());
    return digest.Hex();
  }
  // The error with which the coordinator refuses the job, or with which the job fails.
  std::string Fate(const std::map<std::string, std::string>& files, const std::string& root,
                   const std::string& environment) {
    v1::SubmitRequest request;
    request.set_protocol_version(kProtocolVersion);
    v1::RenderJob* job = request.mutable_job();
    job->mutable_film()->set_width_px(32);
    job->mutable_film()->set_height_px(32);
    job->mutable_settings()->set_points(100);
    job->mutable_asset()->set_root(root);
    for (const auto& [uri, content] : files) {
      v1::AssetFile* file = job->mutable_asset()->add_files();
      file->set_uri(uri);
      file->set_sha256(Put(content));
    }
    if (!environment.empty()) job->mutable_overrides()->mutable_environment()->set_uri(environment);
    const auto jobs = v1::JobService::NewStub(channel_);
    v1::SubmitResponse submitted;
    {
      grpc::ClientContext context;
      SetDeadline(context, milliseconds(20000));
      const grpc::Status status = jobs->Submit(&context, request, &submitted);
      if (!status.ok()) return status.error_message();
    }
    v1::JobStatus last;
    EXPECT_TRUE(WaitUntil(seconds(60), [&] {
      grpc::ClientContext context;
      SetDeadline(context, milliseconds(20000));
      v1::StatusRequest ask;
      ask.set_job_id(submitted.job_id());
      v1::StatusResponse answer;
      if (!jobs->Status(&context, ask, &answer).ok() || answer.jobs_size() != 1) return false;
      last = answer.jobs(0);
      return last.state() == v1::JOB_STATE_FAILED || last.state() == v1::JOB_STATE_DONE;
    })) << farm_.Logs();
    return last.error();
  }

  static std::string Gltf(const std::string& image_uri) {
    Json scene = Json::parse(ReadWhole(SceneFile("cornell.gltf")));
    scene["images"] = {{{"uri", image_uri}}};
    scene["textures"] = {{{"source", 0}}};
    scene["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"] = {{"index", 0}};
    return scene.dump();
  }
  static std::map<std::string, std::string> WithBuffers(const std::string& gltf) {
    std::map<std::string, std::string> files = {{"scene.gltf", gltf}};
    const Json scene = Json::parse(gltf);
    for (const Json& buffer : scene["buffers"]) {
      if (!buffer.contains("uri")) continue;
      const std::string uri = buffer["uri"];
      if (!uri.starts_with("data:")) {
        files[uri] = ReadWhole(std::string(FARPOINT_SCENE_FOLDER) + "/" + uri);
      }
    }
    return files;
  }

  Farm farm_;
  std::string bait_;
  int watch_ = -1;
  std::shared_ptr<grpc::Channel> channel_;
};

TEST_F(PathTest, OfTheCoordinatorOrAWorkerIsOpenedWhateverAJobNames) {
  ASSERT_FALSE(BaitWasTouched());
  const std::string good = ReadWhole(SceneFile("cornell.gltf"));
  EXPECT_EQ(Fate(WithBuffers(good), "scene.gltf", ""), "") << "what is refused below is the path";
  // As root, as environment map, as texture, as buffer, as material library; absolute, relative and
  // as URI.
  for (const std::string& path :
       {bait_, "../../../../../.." + bait_, "file://" + bait_, std::string("/etc/passwd")}) {
    SCOPED_TRACE(path);
    EXPECT_NE(Fate({{"scene.gltf", good}}, path, ""), "");
    EXPECT_NE(Fate(WithBuffers(good), "scene.gltf", path), "");
    EXPECT_NE(Fate(WithBuffers(Gltf(path)), "scene.gltf", ""), "");
    Json buffers = Json::parse(good);
    for (Json& buffer : buffers["buffers"]) buffer["uri"] = path;
    EXPECT_NE(Fate({{"scene.gltf", buffers.dump()}}, "scene.gltf", ""), "");
    // A missing material library is no error.
    (void)Fate(
        {{"scene.obj", "mtllib " + path + "\nv 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl a\nf 1 2 3\n"}},
        "scene.obj", "");
  }
  EXPECT_FALSE(BaitWasTouched());
  // The watch does see a reader.
  EXPECT_FALSE(ReadWhole(bait_).empty());
  EXPECT_TRUE(BaitWasTouched());
}

}  // namespace
}  // namespace farpoint

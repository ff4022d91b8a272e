// The coordinator and a worker over HTTP, as real processes: metrics that agree with a job that was
// rendered, the page's requests, who may make them, and what strangers cost.
#include <arpa/inet.h>
#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <httplib.h>
#include <netinet/in.h>
#include <sys/socket.h>
#include <unistd.h>

#include <algorithm>
#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <map>
#include <nlohmann/json.hpp>
#include <regex>
#include <set>
#include <sstream>

#include "tests/integration/certificates.h"
#include "tests/integration/farm.h"
#include "tests/integration/process.h"

namespace farpoint {
namespace {

using std::chrono::seconds;
using ::testing::HasSubstr;
using Json = nlohmann::json;

// The port behind "WHAT on http…://host:PORT" in a log, or in all if it has no name; 0 if it does
// not come.
int PortIn(Farm& farm, const std::string& log, const std::string& what) {
  const std::regex pattern(what + R"( on https?://[^\s/]+:(\d+)/)");
  int port = 0;
  WaitUntil(seconds(20), [&] {
    std::smatch match;
    const std::string text = log.empty() ? farm.Logs() : farm.Read(log);
    if (std::regex_search(text, match, pattern)) port = std::stoi(match[1]);
    return port != 0;
  });
  EXPECT_NE(port, 0) << farm.Logs();
  return port;
}

// Samples by their names with labels. Fails the test at a line that the format does not allow, at a
// sample without a family, and at a name that comes twice.
std::map<std::string, double> ParseMetrics(const std::string& text) {
  static const std::regex help(R"(# HELP ([a-z_]+) \S.*)");
  static const std::regex type(R"(# TYPE ([a-z_]+) (counter|gauge|histogram))");
  static const std::regex sample(
      R"re(([a-z_]+)(\{[a-z_]+="([^"\\\n]|\\["\\n])*"(,[a-z_]+="([^"\\\n]|\\["\\n])*")*\})? (\S+))re");
  std::map<std::string, double> samples;
  std::set<std::string> families;
  std::string family, kind;
  EXPECT_TRUE(text.ends_with("\n"));
  std::istringstream lines(text);
  for (std::string line; std::getline(lines, line);) {
    std::smatch match;
    if (std::regex_match(line, match, help)) {
      family = match[1];
      kind.clear();
      EXPECT_TRUE(families.insert(family).second) << "twice: " << line;
    } else if (std::regex_match(line, match, type)) {
      EXPECT_EQ(match[1], family) << line;
      kind = match[2];
      EXPECT_EQ(kind == "counter", family.ends_with("_total")) << line;
    } else if (std::regex_match(line, match, sample)) {
      const std::string name = match[1];
      if (kind == "histogram") {
        EXPECT_TRUE(name == family + "_bucket" || name == family + "_sum" ||
                    name == family + "_count")
            << line;
      } else {
        EXPECT_FALSE(kind.empty()) << line;
        EXPECT_EQ(name, family) << line;
      }
      char* end = nullptr;
      const std::string number = match[6];
      const double value = std::strtod(number.c_str(), &end);
      EXPECT_EQ(*end, '\0') << line;
      EXPECT_TRUE(samples.emplace(name + match[2].str(), value).second) << "twice: " << line;
    } else {
      ADD_FAILURE() << "no line of the format: " << line;
    }
  }
  return samples;
}

double SumOf(const std::map<std::string, double>& samples, const std::string& prefix) {
  double sum = 0;
  for (const auto& [name, value] : samples) {
    if (name.starts_with(prefix)) sum += value;
  }
  return sum;
}

std::string GetText(int port, const std::string& path) {
  httplib::Client http("127.0.0.1", port);
  const auto answer = http.Get(path.c_str());
  EXPECT_TRUE(answer);
  if (!answer) return "";
  EXPECT_EQ(answer->status, 200) << path << ": " << answer->body;
  return answer->body;
}

const std::vector<std::string> kSmallJob = {"submit",  "SCENE", "--resolution", "128x64",
                                            "--tile",  "32",    "--integrator", "pt",
                                            "--paths", "1",     "--points",     "2000"};
constexpr int kSmallJobTiles = 8;

void RenderSmallJob(Farm& farm, std::vector<std::string> more = {}) {
  std::vector<std::string> args = kSmallJob;
  args[1] = SceneFile("cornell.gltf");
  args.insert(args.end(), {"-o", farm.File("out.exr")});
  args.insert(args.end(), more.begin(), more.end());
  const RunResult run = farm.Client(farm.WithCoordinator(args));
  ASSERT_EQ(run.exit_code, 0) << run.err << farm.Logs();
}

TEST(Web, AWorkerThatIsKilledIsCountedAsGoneAndItsLeaseAsLost) {
  Farm farm;
  farm.StartServer({"--metrics", "127.0.0.1:0"});
  farm.StartWorker();
  std::vector<std::string> args = kSmallJob;
  args[1] = SceneFile("cornell.gltf");
  // Tiles that would take hours; those at the sides show nothing and are done at once.
  args.insert(args.end(), {"--detach", "--paths", "1048576", "--crop", "32,0,96,64"});
  ASSERT_EQ(farm.Client(farm.WithCoordinator(args)).exit_code, 0) << farm.Logs();
  const auto metric = [&](const char* name) {
    return ParseMetrics(GetText(PortIn(farm, "server0.log", "metrics"), "/metrics")).at(name);
  };
  ASSERT_TRUE(WaitUntil(std::chrono::seconds(60), [&] {
    return metric(R"(farpoint_workers{state="busy"})") == 1;
  })) << farm.Logs();
  farm.worker(0).Signal(SIGKILL);
  EXPECT_TRUE(WaitUntil(std::chrono::seconds(60), [&] {
    // Silent if it died before it opened the connection by which its life is seen.
    return metric(R"(farpoint_leases_lost_total{cause="disconnected"})") +
                   metric(R"(farpoint_leases_lost_total{cause="silent"})") ==
               1 &&
           metric(R"(farpoint_workers{state="gone"})") == 1;
  })) << farm.Logs();
  EXPECT_EQ(metric("farpoint_worker_threads"), 0);
}

TEST(Services, NameTheFlagThatIsWrongAndTheNearestOne) {
  Farm farm;
  const auto refusal = [&](std::vector<std::string> args) {
    args[0] = BinFolder() + "/" + args[0];
    Process process(args, farm.File("x.out"), farm.File("x.err"));
    EXPECT_EQ(process.Wait(std::chrono::seconds(60)), 2);
    const std::string text = farm.Read("x.err");
    std::filesystem::remove(farm.File("x.err"));
    EXPECT_EQ(std::count(text.begin(), text.end(), '\n'), 1) << text;
    return text;
  };
  EXPECT_EQ(refusal({"farpoint-server", "--listn", "h:1", "--store", "s"}),
            "farpoint-server: --listn: unknown flag; did you mean --listen?\n");
  EXPECT_THAT(refusal({"farpoint-server", "--stroe", "s"}), HasSubstr("did you mean --store?"));
  EXPECT_THAT(refusal({"farpoint-server"}), HasSubstr("farpoint-server: --store is required"));
  EXPECT_THAT(refusal({"farpoint-worker", "--coordinator", "h:1", "left"}),
              HasSubstr("farpoint-worker: 'left' is one argument too many"));
  EXPECT_THAT(refusal({"farpoint-worker", "--coordinator", "h:1", "--threads", "many"}),
              HasSubstr("--threads"));
  EXPECT_THAT(refusal({"farpoint-health"}), HasSubstr("farpoint-health: ADDRESS is required"));
}

TEST(Web, MetricsAgreeWithWhatWasRendered) {
  Farm farm;
  farm.StartServer({"--metrics", "127.0.0.1:0", "--audit-fraction", "0"});
  farm.StartWorker(1, {"--metrics", "127.0.0.1:0"});
  RenderSmallJob(farm);
  const auto server = ParseMetrics(GetText(PortIn(farm, "server0.log", "metrics"), "/metrics"));
  const auto worker = ParseMetrics(GetText(PortIn(farm, "worker1.log", "metrics"), "/metrics"));
  const double accepted = server.at(R"(farpoint_lease_ends_total{outcome="accepted"})");
  EXPECT_EQ(server.at(R"(farpoint_jobs{state="done"})"), 1);
  EXPECT_EQ(server.at(R"(farpoint_tiles{state="committed"})"), kSmallJobTiles);
  EXPECT_EQ(SumOf(server, "farpoint_tiles{"), kSmallJobTiles);
  EXPECT_EQ(accepted, kSmallJobTiles);
  EXPECT_EQ(server.at("farpoint_leases_total"), kSmallJobTiles);
  EXPECT_EQ(server.at("farpoint_lease_seconds_count"), kSmallJobTiles);
  EXPECT_EQ(server.at(R"(farpoint_lease_seconds_bucket{le="+Inf"})"), kSmallJobTiles);
  EXPECT_GT(server.at("farpoint_lease_seconds_sum"), 0);
  EXPECT_EQ(SumOf(server, "farpoint_results_refused_total"), 0);
  EXPECT_EQ(SumOf(server, "farpoint_leases_lost_total"), 0);
  EXPECT_EQ(server.at(R"(farpoint_workers{state="gone"})"), 0);
  EXPECT_EQ(SumOf(server, "farpoint_workers{"), 1);
  EXPECT_EQ(server.at("farpoint_queue_tiles"), 0);
  EXPECT_GT(server.at("farpoint_scene_received_bytes_total"), 0);
  EXPECT_GT(server.at("farpoint_tile_sent_bytes_total"), 0);
  EXPECT_GT(server.at("process_resident_memory_bytes"), 1 << 20);
  EXPECT_GT(server.at("process_cpu_seconds_total"), 0);
  EXPECT_GT(server.at("process_start_time_seconds"), 1.6e9);

  EXPECT_EQ(worker.at(R"(farpoint_worker_tiles_total{outcome="accepted"})"), kSmallJobTiles);
  EXPECT_EQ(worker.at("farpoint_worker_leases_total"), kSmallJobTiles);
  EXPECT_EQ(worker.at("farpoint_worker_tile_seconds_count"), kSmallJobTiles);
  EXPECT_EQ(worker.at("farpoint_worker_threads"), 1);
  EXPECT_GE(worker.at(R"(farpoint_worker_blobs_total{source="coordinator"})"), 1);
  EXPECT_EQ(worker.at("farpoint_worker_blob_received_bytes_total"),
            server.at("farpoint_broadcast_bytes_total"));
  EXPECT_EQ(worker.at("farpoint_worker_tile_sent_bytes_total"),
            server.at("farpoint_tile_received_bytes_total"));
  // What the worker rendered is in the coordinator's stages, which have the bake beside it.
  for (const char* stage : {"primary", "direct", "trace"}) {
    const std::string name = std::string(R"(farpoint_stage_seconds_total{stage=")") + stage + "\"}";
    EXPECT_GT(worker.at(name), 0) << name;
    EXPECT_NEAR(worker.at(name), server.at(name), 1e-9) << name;
  }
  EXPECT_GT(server.at(R"(farpoint_stage_seconds_total{stage="import"})"), 0);
}

TEST(Web, ShowsAndChangesJobs) {
  Farm farm;
  farm.StartServer({"--web", "127.0.0.1:0"});
  farm.StartWorker();
  RenderSmallJob(farm, {"--title", "a <b> \"title\""});
  httplib::Client http("127.0.0.1", PortIn(farm, "server0.log", "web"));
  const auto page = http.Get("/");
  ASSERT_TRUE(page);
  EXPECT_THAT(page->get_header_value("Content-Security-Policy"), HasSubstr("default-src 'none'"));
  EXPECT_THAT(page->body, HasSubstr("/app.js"));
  const auto overview = http.Get("/api/overview");
  ASSERT_TRUE(overview);
  const Json all = Json::parse(overview->body);
  ASSERT_EQ(all["jobs"].size(), 1u);
  EXPECT_EQ(all["jobs"][0]["title"], "a <b> \"title\"");
  EXPECT_EQ(all["workers"].size(), 1u);
  const std::string job = "/api/jobs/" + all["jobs"][0]["id"].get<std::string>();
  const auto get = [&](const std::string& path) {
    const auto answer = http.Get(path.c_str());
    return answer ? answer->status : 0;
  };
  const auto post = [&](const std::string& action) {
    const auto answer =
        http.Post((job + "/" + action).c_str(), httplib::Headers{{"X-Farpoint", "1"}});
    return answer ? answer->status : 0;
  };

  const Json view = Json::parse(http.Get(job.c_str())->body);
  ASSERT_EQ(view["tiles"].size(), size_t{kSmallJobTiles});
  for (const Json& tile : view["tiles"]) {
    EXPECT_EQ(tile["state"], "committed");
    EXPECT_GT(tile["seconds"].get<double>(), 0);
    EXPECT_EQ(tile["rect"][2].get<int>() - tile["rect"][0].get<int>(), 32);
    EXPECT_FALSE(tile["worker"].get<std::string>().empty());
  }
  EXPECT_FALSE(view["log"].empty());
  EXPECT_FALSE(Json::parse(http.Get((job + "/explain").c_str())->body)["lines"].empty());
  const auto png = http.Get((job + "/tiles/7.png?shrink=4&stops=1").c_str());
  ASSERT_TRUE(png);
  EXPECT_EQ(png->body.substr(1, 3), "PNG");
  EXPECT_EQ(png->body[19], 8);  // 32 / 4 pixels wide

  EXPECT_EQ(get(job + "/tiles/8.png"), 400);
  EXPECT_EQ(get(job + "/tiles/x.png"), 400);
  EXPECT_EQ(get(job + "/tiles/0.png?shrink=0"), 400);
  EXPECT_EQ(get(job + "/tiles/0.png?stops=1e9"), 400);
  EXPECT_EQ(get(job + "?frame=1"), 400);
  EXPECT_EQ(get("/api/jobs/nobody"), 404);
  EXPECT_EQ(get("/../etc/passwd"), 404);
  EXPECT_EQ(http.Get("/api/overview", {{"Host", "evil.example"}})->status, 403);
  EXPECT_EQ(http.Post((job + "/requeue-all").c_str())->status, 403) << "no header";
  EXPECT_EQ(post("explode"), 404);

  const auto state = [&] { return Json::parse(http.Get(job.c_str())->body)["job"]["state"]; };
  farm.StopWorkers();
  EXPECT_EQ(post("requeue-all"), 200);
  EXPECT_EQ(state(), "rendering");
  EXPECT_EQ(post("pause"), 200);
  EXPECT_EQ(state(), "paused");
  EXPECT_EQ(get(job + "/tiles/0.png"), 409);
  EXPECT_EQ(post("resume"), 200);
  EXPECT_EQ(state(), "rendering");
  EXPECT_EQ(post("cancel"), 200);
  EXPECT_EQ(state(), "cancelled");
  EXPECT_EQ(post("requeue"), 200);
  EXPECT_EQ(state(), "rendering");
}

TEST(Web, AsksForATokenWhereTlsIsInForce) {
  Farm farm;
  const std::string certs = MakeCerts(farm);
  const auto token_of = [&](const std::string& name) {
    const RunResult made = farm.Client({"certs", "token", name, "--dir", certs});
    EXPECT_EQ(made.exit_code, 0) << made.err;
    return made.out.substr(0, made.out.find('\n'));
  };
  const std::string alice = token_of("alice"), carol = token_of("carol");
  farm.StartServer({"--web", "127.0.0.1:0", "--metrics", "127.0.0.1:0", "--certs", certs});
  const RunResult submitted = farm.Client(
      farm.WithCoordinator({"submit", SceneFile("cornell.gltf"), "--resolution", "64x32",
                            "--paused", "--detach", "--tls-ca", certs + "/ca.pem", "--tls-cert",
                            certs + "/alice.pem", "--tls-key", certs + "/alice.key"}));
  ASSERT_EQ(submitted.exit_code, 0) << submitted.err;

  httplib::SSLClient http("127.0.0.1", PortIn(farm, "", "web"));
  http.set_ca_cert_path((certs + "/ca.pem").c_str());
  http.enable_server_certificate_verification(true);
  const auto get = [&](const std::string& path, const std::string& token) {
    httplib::Headers headers;
    if (!token.empty()) headers.emplace("Authorization", "Bearer " + token);
    return http.Get(path.c_str(), headers);
  };
  for (const char* open : {"/", "/app.js", "/style.css"}) {
    ASSERT_TRUE(get(open, "")) << open;
    EXPECT_EQ(get(open, "")->status, 200) << open;
  }
  for (const char* closed : {"/api/overview", "/api/jobs/x", "/metrics"}) {
    EXPECT_EQ(get(closed, "")->status, 401) << closed;
    EXPECT_EQ(get(closed, "fp_" + std::string(64, '0'))->status, 401) << closed;
  }
  const auto overview = get("/api/overview", carol);
  ASSERT_EQ(overview->status, 200) << overview->body;
  const Json all = Json::parse(overview->body);
  EXPECT_EQ(all["caller"], "carol");
  ASSERT_EQ(all["jobs"].size(), 1u);
  EXPECT_EQ(all["jobs"][0]["owner"], "alice");
  const std::string cancel = "/api/jobs/" + all["jobs"][0]["id"].get<std::string>() + "/cancel";
  const auto post = [&](const std::string& token) {
    return http
        .Post(cancel.c_str(),
              httplib::Headers{{"X-Farpoint", "1"}, {"Authorization", "Bearer " + token}})
        ->status;
  };
  EXPECT_EQ(post(carol), 403) << "another's job";
  EXPECT_EQ(post(alice), 200);
  // What loopback may see of the metrics needs no token.
  const auto metrics = ParseMetrics(GetText(PortIn(farm, "", "metrics"), "/metrics"));
  EXPECT_EQ(metrics.at(R"(farpoint_calls_refused_total{cause="unauthenticated"})"), 6);
  EXPECT_EQ(metrics.at(R"(farpoint_jobs{state="cancelled"})"), 1);
}

TEST(Web, DoesNotListenBeyondThisMachineInTheClear) {
  Farm farm;
  for (const char* flag : {"--web", "--metrics"}) {
    const std::string log = std::string("refused") + flag;
    Process server({BinFolder() + "/farpoint-server", "--listen", "127.0.0.1:0", "--store",
                    farm.File("other"), flag, "0.0.0.0:0"},
                   farm.File(log), farm.File(log));
    EXPECT_EQ(server.Wait(seconds(20)), 2) << farm.Read(log);
    EXPECT_THAT(farm.Read(log), HasSubstr(flag));
  }
}

uint64_t ResidentBytes(pid_t pid) {
  std::ifstream file("/proc/" + std::to_string(pid) + "/statm");
  uint64_t total = 0, resident = 0;
  file >> total >> resident;
  return resident * static_cast<uint64_t>(::sysconf(_SC_PAGESIZE));
}

TEST(Web, StrangersThatSayNothingCostNextToNothing) {
  Farm farm;
  farm.StartServer({"--web", "127.0.0.1:0"});
  const int port = PortIn(farm, "server0.log", "web");
  EXPECT_NE(GetText(port, "/api/overview"), "");
  const uint64_t before = ResidentBytes(farm.server().pid());
  std::vector<int> strangers;
  sockaddr_in to{};
  to.sin_family = AF_INET;
  to.sin_port = htons(static_cast<uint16_t>(port));
  to.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
  for (int i = 0; i < 1000; ++i) {
    const int fd = ::socket(AF_INET, SOCK_STREAM | SOCK_CLOEXEC | SOCK_NONBLOCK, 0);
    ASSERT_GE(fd, 0);
    (void)::connect(fd, reinterpret_cast<const sockaddr*>(&to), sizeof(to));
    strangers.push_back(fd);
  }
  // The page and the API go on; then some strangers begin to speak, and stop.
  EXPECT_NE(GetText(port, "/api/overview"), "");
  for (int i = 0; i < 100; ++i) (void)::send(strangers[i], "GET / HT", 8, MSG_NOSIGNAL);
  EXPECT_NE(farm.Status(), "") << farm.Logs();
  EXPECT_LT(ResidentBytes(farm.server().pid()), before + (uint64_t{64} << 20));
  for (const int fd : strangers) ::close(fd);
  EXPECT_TRUE(WaitUntil(seconds(60), [&] {
    httplib::Client http("127.0.0.1", port);
    const auto answer = http.Get("/api/overview");
    return answer && answer->status == 200;
  }));
}

TEST(Web, LogObjectsNameJobTileAndAttempt) {
  Farm farm;
  farm.StartServer({"--log-format", "json"});
  farm.StartWorker(1, {"--log-format", "json"});
  RenderSmallJob(farm);
  for (const auto& [log, text] :
       {std::pair{"server0.log", "committed"}, std::pair{"worker1.log", "returned"}}) {
    // A worker writes its line after the job is done.
    std::set<int> tiles;
    WaitUntil(seconds(20), [&] {
      std::istringstream lines(farm.Read(log));
      for (std::string line; std::getline(lines, line);) {
        if (line.empty() || line[0] != '{') continue;  // what is for stdout
        const Json entry = Json::parse(line, nullptr, false);
        if (entry.is_discarded() || entry.value("text", "") != text) continue;
        EXPECT_EQ(entry["job"].get<std::string>().size(), 8u) << line;
        EXPECT_GE(entry["attempt"].get<int>(), 1) << line;
        EXPECT_EQ(entry["level"], "info") << line;
        tiles.insert(entry["tile"].get<int>());
      }
      return tiles.size() == size_t{kSmallJobTiles};
    });
    EXPECT_EQ(tiles.size(), size_t{kSmallJobTiles}) << log << "\n" << farm.Logs();
  }
}

}  // namespace
}  // namespace farpoint

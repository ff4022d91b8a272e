// How much a coordinator carries, and what it costs: stragglers, broadcast, network, load, cost.
#include <signal.h>
#include <unistd.h>

#include <algorithm>
#include <atomic>
#include <filesystem>
#include <mutex>
#include <set>
#include <thread>

#include "absl/strings/str_format.h"
#include "bench/service_cases.h"
#include "bench/service_network.h"
#include "bench/service_relay.h"
#include "core/base/executor.h"
#include "worker/fingerprint.h"
#include "worker/grpc_link.h"

namespace farpoint {

namespace fs = std::filesystem;
using std::chrono::milliseconds;
using std::chrono::seconds;
using std::chrono::steady_clock;

namespace {

void Sleep(int ms) { std::this_thread::sleep_for(milliseconds(ms)); }

size_t Occurrences(const std::string& text, std::string_view part) {
  size_t count = 0;
  for (size_t at = text.find(part); at != std::string::npos; at = text.find(part, at + 1)) ++count;
  return count;
}

absl::Status WaitForWorkers(ServiceFarm& farm, size_t count) {
  for (const Stopwatch watch; watch.seconds() < 60;) {
    const auto all = farm.client().Status({});
    if (all.ok() && all->workers.size() == count) return absl::OkStatus();
    Sleep(10);
  }
  return farm.Annotated(absl::DeadlineExceededError("workers do not register"));
}

}  // namespace

// --- stragglers ------------------------------------------------------------------------------

absl::Status RunStragglers(const ServiceContext& context, ServiceResult& result) {
  FP_ASSIGN_OR_RETURN(const auto farm, ServiceFarm::Create(context.programs));
  FP_RETURN_IF_ERROR(farm->StartServer({}));
  constexpr int kTileMs = 200;
  for (int i = 0; i < 3; ++i) {
    FP_RETURN_IF_ERROR(
        farm->StartActor("worker", {"render=null", "tile_ms=" + std::to_string(kTileMs)}).status());
  }
  FP_RETURN_IF_ERROR(
      farm->StartActor("worker", {"render=null", "tile_ms=" + std::to_string(10 * kTileMs)})
          .status());
  FP_RETURN_IF_ERROR(WaitForWorkers(*farm, 4));
  const int tiles = context.Pick(160, 40);
  FP_ASSIGN_OR_RETURN(
      const JobId job,
      farm->Submit(
          {.width = tiles * 32, .height = 32, .integrator = Integrator::kPt, .beauty_only = true}));
  FP_RETURN_IF_ERROR(
      farm->WaitFor(job, seconds(20), [](const JobStatus& s) { return s.tiles.leased > 0; })
          .status());
  const Stopwatch watch;
  FP_RETURN_IF_ERROR(farm->WaitUntilDone(job, seconds(240)).status());
  const double took = watch.seconds();
  const double capacity = 3 / (0.001 * kTileMs) + 1 / (0.01 * kTileMs);  // tiles a second
  Time(result, "time over what the capacity allows", took / (tiles / capacity), 1.25);
  const std::string log = farm->ServerLog();
  const size_t begun = Occurrences(log, " leased\n") + Occurrences(log, " copied\n");
  Figure(result, "tiles", tiles);
  Figure(result, "copies", static_cast<double>(Occurrences(log, " copied\n")));
  Count(result, "share of the work that was thrown away",
        (static_cast<double>(begun) - tiles) / tiles, 0.05);
  return absl::OkStatus();
}

// --- broadcast -------------------------------------------------------------------------------

namespace {

// The most anonymous memory that a process has while this lives, kB.
class MemoryWatch {
 public:
  explicit MemoryWatch(const ChildProcess& process)
      : process_(process), thread_([this] {
          while (!ending_) {
            most_ = std::max(most_.load(), process_.StatusKb("RssAnon"));
            Sleep(20);
          }
        }) {}
  ~MemoryWatch() {
    ending_ = true;
    thread_.join();
  }
  uint64_t most_kb() const { return most_; }

 private:
  const ChildProcess& process_;
  std::atomic<bool> ending_ = false;
  std::atomic<uint64_t> most_ = 0;
  std::thread thread_;
};

absl::Status WaitForAll(ServiceFarm& farm, const std::vector<size_t>& getters, int time_s) {
  for (const size_t i : getters) {
    const std::optional<int> code = farm.worker(i).Wait(seconds(time_s));
    if (code != 0) {
      return farm.Annotated(absl::InternalError(
          "a transfer ended with " + (code ? std::to_string(*code) : std::string("nothing"))));
    }
  }
  return absl::OkStatus();
}

}  // namespace

absl::Status RunBroadcast(const ServiceContext& context, ServiceResult& result) {
  std::mt19937_64 random = context.Random();
  const size_t mib = static_cast<size_t>(context.Pick(256, 8));
  constexpr double kMiB = 1 << 20;
  FP_ASSIGN_OR_RETURN(const auto farm, ServiceFarm::Create(context.programs));
  FP_RETURN_IF_ERROR(farm->StartServer({"--listen", "0.0.0.0:0", "--insecure"}));
  std::vector<std::byte> bytes(mib << 20);
  for (size_t i = 0; i < bytes.size(); i += 8) {
    const uint64_t value = random();
    std::copy_n(reinterpret_cast<const std::byte*>(&value), 8,
                bytes.begin() + static_cast<long>(i));
  }
  const Blob blob = Blob::FromVector(bytes);
  const Digest digest = blob.Hash();
  bytes = {};
  FP_RETURN_IF_ERROR(farm->client().Put(digest, blob));
  const std::string name = "blob=" + digest.Hex();
  const std::string file = "/" + digest.Hex();
  // A first reader, so that what a transfer costs once does not count as growth.
  FP_ASSIGN_OR_RETURN(const size_t first, farm->StartActor("getter", {name}));
  FP_RETURN_IF_ERROR(WaitForAll(*farm, {first}, 120));
  const uint64_t before_kb = farm->server()->StatusKb("RssAnon");
  Figure(result, "MiB of the blob", static_cast<double>(mib));

  // Eight readers that take their time.
  {
    std::vector<std::unique_ptr<Relay>> relays;
    std::vector<size_t> getters;
    const Stopwatch watch;
    uint64_t most_kb = 0;
    {
      const MemoryWatch memory(*farm->server());
      for (int i = 0; i < 8; ++i) {
        FP_ASSIGN_OR_RETURN(auto relay, Relay::Start(farm->port(), random()));
        FP_ASSIGN_OR_RETURN(const size_t getter,
                            farm->StartActor("getter", {name, "pause_us=30000"},
                                             "127.0.0.1:" + std::to_string(relay->port())));
        relays.push_back(std::move(relay));
        getters.push_back(getter);
      }
      FP_RETURN_IF_ERROR(WaitForAll(*farm, getters, 300));
      most_kb = memory.most_kb();
    }
    uint64_t down = 0;
    for (const auto& relay : relays) down += relay->bytes_down();
    Count(result, "MiB by which the coordinator grew with 8 slow readers",
          (static_cast<double>(most_kb) - static_cast<double>(before_kb)) / 1024, 64);
    Count(result, "bytes sent for each byte that 8 readers needed",
          static_cast<double>(down) / (8 * static_cast<double>(blob.size())), 1.02);
    Figure(result, "s for 8 slow readers", watch.seconds());
  }

  // Interrupted: connections are reset, and the reader is killed and started again.
  {
    FP_ASSIGN_OR_RETURN(const auto relay, Relay::Start(farm->port(), random()));
    FP_ASSIGN_OR_RETURN(const size_t getter,
                        farm->StartActor("getter", {name, "pause_us=10000"},
                                         "127.0.0.1:" + std::to_string(relay->port())));
    const auto wait_for_more = [&] {
      const uint64_t from = relay->bytes_down();
      for (const Stopwatch watch; watch.seconds() < 30 && farm->worker(getter).Running() &&
                                  relay->bytes_down() < from + blob.size() / 8;) {
        Sleep(5);
      }
    };
    int interruptions = 0;
    for (int i = 0; i < 3; ++i) {
      wait_for_more();
      relay->ResetAll();
      ++interruptions;
      wait_for_more();
      FP_RETURN_IF_ERROR(farm->Restart(getter));
      ++interruptions;
    }
    FP_RETURN_IF_ERROR(WaitForAll(*farm, {getter}, 120));
    Figure(result, "interruptions of a transfer", interruptions);
    // What was on its way is sent again: some chunks each time.
    Count(result, "MiB sent more than once for all of them",
          (static_cast<double>(relay->bytes_down()) - static_cast<double>(blob.size())) / kMiB,
          0.02 * static_cast<double>(mib) + 8 * interruptions);
  }

  // Damaged: bits flip on the wire. Whatever arrives in the end has the right hash, and a damaged
  // chunk does not cost the ones before it.
  {
    RelayFaults faults;
    faults.flip = 1400 / (6.4 * kMiB);  // in every seventh chunk
    FP_ASSIGN_OR_RETURN(const auto relay, Relay::Start(farm->port(), random(), faults));
    FP_ASSIGN_OR_RETURN(
        const size_t getter,
        farm->StartActor("getter", {name}, "127.0.0.1:" + std::to_string(relay->port())));
    FP_RETURN_IF_ERROR(WaitForAll(*farm, {getter}, 300));
    Figure(result, "bits flipped on the wire", static_cast<double>(relay->flipped()));
    size_t wrong = 0, files = 0;
    for (const auto& entry : fs::recursive_directory_iterator(farm->File(""))) {
      if (entry.path().filename() != digest.Hex() ||
          entry.path().string().find(".cache") == std::string::npos) {
        continue;
      }
      ++files;
      FP_ASSIGN_OR_RETURN(const Blob got, Blob::MapFile(entry.path().string()));
      wrong += got.Hash() != digest;
    }
    CountAtLeast(result, "caches that have the blob by now", static_cast<double>(files), 11);
    Count(result, "of these with a wrong bit", static_cast<double>(wrong), 0);
    // What was on its way behind a damaged chunk is sent again.
    Count(result, "MiB sent more than once because of them",
          (static_cast<double>(relay->bytes_down()) - static_cast<double>(blob.size())) / kMiB,
          5 * static_cast<double>(1 + relay->flipped()));
  }

  // Two at a time that share a cache, and a second job: one transfer.
  {
    FP_ASSIGN_OR_RETURN(const auto relay, Relay::Start(farm->port(), random()));
    const std::string through = "127.0.0.1:" + std::to_string(relay->port());
    const std::string cache = "cache=" + farm->File("shared.cache");
    std::vector<size_t> getters;
    for (int i = 0; i < 2; ++i) {
      FP_ASSIGN_OR_RETURN(const size_t getter, farm->StartActor("getter", {name, cache}, through));
      getters.push_back(getter);
    }
    FP_RETURN_IF_ERROR(WaitForAll(*farm, getters, 120));
    FP_ASSIGN_OR_RETURN(const size_t later, farm->StartActor("getter", {name, cache}, through));
    FP_RETURN_IF_ERROR(WaitForAll(*farm, {later}, 60));
    Count(result, "bytes sent for each byte that two workers and two jobs share",
          static_cast<double>(relay->bytes_down()) / static_cast<double>(blob.size()), 1.02);
  }

  // From the site's file system: nothing but the connection itself.
  {
    FP_ASSIGN_OR_RETURN(const auto relay, Relay::Start(farm->port(), random()));
    FP_ASSIGN_OR_RETURN(const size_t getter,
                        farm->StartActor("getter", {name, "blob_dir=" + farm->File("store/blobs")},
                                         "127.0.0.1:" + std::to_string(relay->port())));
    FP_RETURN_IF_ERROR(WaitForAll(*farm, {getter}, 120));
    Count(result, "bytes sent where --blob-dir has the blob",
          static_cast<double>(relay->bytes_down()), 10000);
  }

  // Each behind its own link of 100 Mbit/s.
  if (context.options.quick) return absl::OkStatus();
  std::vector<std::unique_ptr<NetworkSpace>> spaces;
  for (int i = 0; i < 8; ++i) {
    absl::StatusOr<std::unique_ptr<NetworkSpace>> space = NetworkSpace::Create(100 + i, 100);
    if (!space.ok()) {
      result.notes.push_back("8 links of 100 Mbit/s: " + std::string(space.status().message()));
      return absl::OkStatus();
    }
    spaces.push_back(*std::move(space));
  }
  const Stopwatch watch;
  std::vector<std::unique_ptr<ChildProcess>> getters;
  for (int i = 0; i < 8; ++i) {
    const auto& space = *spaces[static_cast<size_t>(i)];
    FP_ASSIGN_OR_RETURN(
        auto getter,
        ChildProcess::Start({context.programs.bench, "service-actor", "getter",
                             "coordinator=" + space.host() + ":" + std::to_string(farm->port()),
                             "cache=" + farm->File("space" + std::to_string(i) + ".cache"), name},
                            {.log = farm->File("space.log"), .network = space.name()}));
    getters.push_back(std::move(getter));
  }
  for (const auto& getter : getters) {
    if (getter->Wait(seconds(300)) != 0) {
      return farm->Annotated(absl::InternalError("a transfer over a link of 100 Mbit/s fails"));
    }
  }
  const double took = watch.seconds();
  Figure(result, "s for 8 workers, each behind 100 Mbit/s", took);
  Rate(result, "of the links' rate that each got", static_cast<double>(blob.size()) / took / 12.5e6,
       0.8);
  return absl::OkStatus();
}

// --- network ---------------------------------------------------------------------------------

absl::Status RunNetwork(const ServiceContext& context, ServiceResult& result) {
  std::mt19937_64 random = context.Random();
  FP_ASSIGN_OR_RETURN(const auto farm, ServiceFarm::Create(context.programs));
  FP_RETURN_IF_ERROR(farm->StartServer({}));
  const SmallJob job{.width = context.Pick(256, 96), .height = context.Pick(192, 64)};
  FP_RETURN_IF_ERROR(farm->StartWorker().status());
  std::set<std::string> hashes;
  double undisturbed = 0;
  {
    const Stopwatch watch;
    FP_ASSIGN_OR_RETURN(const JobId id, farm->Submit(job));
    FP_RETURN_IF_ERROR(farm->WaitUntilDone(id, seconds(60)).status());
    undisturbed = watch.seconds();
    FP_ASSIGN_OR_RETURN(const Digest hash, farm->ImageOf(id));
    hashes.insert(hash.Hex());
  }
  farm->RemoveWorkers();
  RelayFaults faults;
  faults.delay = milliseconds(50);
  faults.stall = 0.02;
  faults.reset = 0.001;
  std::vector<std::unique_ptr<Relay>> relays;
  for (int i = 0; i < 2; ++i) {
    FP_ASSIGN_OR_RETURN(auto relay, Relay::Start(farm->port(), random(), faults));
    FP_RETURN_IF_ERROR(
        farm->StartWorker({}, "127.0.0.1:" + std::to_string(relay->port())).status());
    relays.push_back(std::move(relay));
  }
  uint64_t lost = 0, reissued = 0;
  double slowest = 0;
  for (int i = 0; i < context.Pick(10, 1); ++i) {
    const Stopwatch watch;
    FP_ASSIGN_OR_RETURN(const JobId id, farm->Submit(job));
    FP_ASSIGN_OR_RETURN(const JobStatus end, farm->WaitUntilDone(id, seconds(120)));
    slowest = std::max(slowest, watch.seconds());
    reissued += end.reissued;
    FP_ASSIGN_OR_RETURN(const std::vector<uint32_t> commits, farm->CommitsOf(id));
    for (const uint32_t count : commits) lost += count != 1;
    FP_ASSIGN_OR_RETURN(const Digest hash, farm->ImageOf(id));
    hashes.insert(hash.Hex());
  }
  // Idle, too: keepalive pings go on.
  Sleep(context.Pick(20000, 1000));
  size_t too_many = Occurrences(farm->ServerLog(), "too_many_pings");
  for (size_t i = 0; i < farm->worker_count(); ++i) {
    too_many += Occurrences(farm->WorkerLog(i), "too_many_pings");
  }
  uint64_t connections = 0;
  for (const auto& relay : relays) connections += relay->connections();
  Count(result, "image hashes beyond the first", static_cast<double>(hashes.size()) - 1, 0);
  Count(result, "tiles lost or committed twice", static_cast<double>(lost), 0);
  Count(result, "too_many_pings", static_cast<double>(too_many), 0);
  Figure(result, "connections that were needed", static_cast<double>(connections));
  Figure(result, "leases lost", static_cast<double>(reissued));
  Figure(result, "s of a job with one worker on a good network", undisturbed);
  Figure(result, "s at most with two on the bad one", slowest);
  result.notes.emplace_back(
      "TCP hides reordering and loss from programs behind delay: the relay stalls 2 % of the "
      "pieces "
      "by 200 ms and resets connections instead");
  return absl::OkStatus();
}

// --- load ------------------------------------------------------------------------------------

namespace {

// Many workers in threads of this process, each with a connection of its own, whose tiles are
// zeros.
class Crowd {
 public:
  Crowd(const std::string& address, const Digest& fingerprint, int workers, int think_ms)
      : address_(address), fingerprint_(fingerprint), think_ms_(think_ms) {
    for (int i = 0; i < workers; ++i) threads_.emplace_back([this, i] { Work(i); });
  }
  ~Crowd() { Stop(); }

  int registered() const { return registered_; }
  // Lease calls that begin from now on count.
  void StartMeasuring() { measuring_ = true; }
  void Stop() {
    stop_ = true;
    for (std::thread& thread : threads_) thread.join();
    threads_.clear();
  }
  // Milliseconds, sorted; after Stop.
  std::vector<double> lease_ms, return_ms;
  std::atomic<uint64_t> errors = 0;

 private:
  void Work(int index) {
    const auto link = GrpcLink::Connect(address_);
    absl::StatusOr<WorkerWelcome> welcome = absl::UnavailableError("not tried");
    // Hundreds that connect at the same moment: some are late, and try again as workers do.
    while (!stop_ && !welcome.ok()) {
      welcome = link->Register({.version = FARPOINT_VERSION,
                                .fingerprint = fingerprint_,
                                .threads = 1,
                                .name = "crowd " + std::to_string(index)});
      if (!welcome.ok()) Sleep(100);
    }
    if (!welcome.ok()) return;
    link->Attend(welcome->id);
    ++registered_;
    std::vector<double> leases, returns;
    while (!stop_) {
      const bool measured = measuring_;
      const Stopwatch lease;
      const auto work = link->Lease(welcome->id, milliseconds(1000));
      if (!work.ok()) {
        ++errors;
        continue;
      }
      if (!work->has_value()) continue;
      const TileWork& tile = **work;
      if (measured) leases.push_back(1000 * lease.seconds());
      if (think_ms_ > 0) Sleep(think_ms_);
      TileResult result;
      result.lease = tile.lease;
      result.attempt = tile.attempt;
      result.bytes = Blob::FromVector(EncodeFilm(Film(tile.rect, tile.frame.settings.layers)));
      result.sha256 = result.bytes.Hash();
      const Stopwatch back;
      const auto answer = link->Return(welcome->id, result);
      if (measured) returns.push_back(1000 * back.seconds());
      if (!answer.ok() || !answer->accepted) ++errors;
    }
    (void)link->Leave(welcome->id);
    std::lock_guard lock(mutex_);
    lease_ms.insert(lease_ms.end(), leases.begin(), leases.end());
    return_ms.insert(return_ms.end(), returns.begin(), returns.end());
  }

  const std::string address_;
  const Digest fingerprint_;
  const int think_ms_;
  std::atomic<int> registered_ = 0;
  std::atomic<bool> stop_ = false, measuring_ = false;
  std::mutex mutex_;
  std::vector<std::thread> threads_;
};

double Percentile(std::vector<double> values, double part) {
  if (values.empty()) return 0;
  const auto at = static_cast<size_t>(part * static_cast<double>(values.size() - 1));
  std::nth_element(values.begin(), values.begin() + static_cast<long>(at), values.end());
  return values[at];
}

struct CrowdRun {
  double tiles_per_s = 0, lease_p50_ms = 0, lease_p99_ms = 0, return_p99_ms = 0, cpu_us = 0;
  uint64_t errors = 0, lost = 0;
};

absl::StatusOr<CrowdRun> RunCrowd(const ServiceContext& context, int workers, int think_ms,
                                  int tiles) {
  FP_ASSIGN_OR_RETURN(const auto farm, ServiceFarm::Create(context.programs));
  FP_RETURN_IF_ERROR(farm->StartServer({"--log-level", "warn"}));
  Executor executor(1);
  FP_ASSIGN_OR_RETURN(const Digest fingerprint, ComputeFingerprint(executor));
  FP_ASSIGN_OR_RETURN(const JobId job, farm->Submit({.width = 100 * 32,
                                                     .height = tiles / 100 * 32,
                                                     .integrator = Integrator::kPt,
                                                     .beauty_only = true,
                                                     .paused = true}));
  CrowdRun run;
  Crowd crowd(farm->address(), fingerprint, workers, think_ms);
  for (const Stopwatch watch; crowd.registered() < workers && watch.seconds() < 60;) Sleep(20);
  if (crowd.registered() < workers) {
    return farm->Annotated(absl::DeadlineExceededError("simulated workers do not register"));
  }
  Sleep(500);
  FP_RETURN_IF_ERROR(farm->client().Resume(job));
  FP_RETURN_IF_ERROR(
      farm->WaitFor(job, seconds(30), [](const JobStatus& s) { return s.tiles.committed > 0; })
          .status());
  FP_ASSIGN_OR_RETURN(const JobStatus begin, farm->Status(job));
  const Stopwatch watch;
  crowd.StartMeasuring();
  for (;;) {
    FP_ASSIGN_OR_RETURN(const JobStatus status, farm->Status(job));
    if (status.state == JobState::kDone) break;
    if (watch.seconds() > 300) return farm->Annotated(absl::DeadlineExceededError("load"));
    Sleep(50);
  }
  run.tiles_per_s = (begin.tiles.total - begin.tiles.committed) / watch.seconds();
  crowd.Stop();
  run.errors = crowd.errors;
  run.lease_p50_ms = Percentile(crowd.lease_ms, 0.5);
  run.lease_p99_ms = Percentile(crowd.lease_ms, 0.99);
  run.return_p99_ms = Percentile(crowd.return_ms, 0.99);
  FP_ASSIGN_OR_RETURN(const std::vector<uint32_t> commits, farm->CommitsOf(job));
  for (const uint32_t count : commits) run.lost += count != 1;
  farm->server()->Signal(SIGTERM);
  farm->server()->Wait(seconds(30));
  run.cpu_us = 1e6 * farm->server()->cpu_seconds() / begin.tiles.total;
  return run;
}

}  // namespace

absl::Status RunLoad(const ServiceContext& context, ServiceResult& result) {
  const int workers = context.Pick(500, 30);
  {
    FP_ASSIGN_OR_RETURN(const CrowdRun run,
                        RunCrowd(context, workers, 0, context.Pick(40000, 600)));
    Figure(result, "simulated workers, each with its connection", workers);
    Rate(result, "tiles/s leased, returned and durable, without a pause", run.tiles_per_s, 2000);
    Figure(result, "us of the coordinator's processor time for a tile", run.cpu_us);
    Count(result, "calls that failed", static_cast<double>(run.errors), 0);
    Count(result, "tiles lost or committed twice", static_cast<double>(run.lost), 0);
  }
  {
    // 500 workers whose tiles take a quarter of a second ask for 2,000 a second.
    FP_ASSIGN_OR_RETURN(const CrowdRun run,
                        RunCrowd(context, workers, 250, context.Pick(20000, 300)));
    Figure(result, "tiles/s of workers that take 250 ms for each", run.tiles_per_s);
    Figure(result, "ms for a lease at that rate, median", run.lease_p50_ms);
    Time(result, "ms for a lease at that rate, 99th percentile", run.lease_p99_ms, 50);
    Figure(result, "ms for a durable return, 99th percentile", run.return_p99_ms);
    Count(result, "calls that failed at that rate", static_cast<double>(run.errors), 0);
  }
  {
    FP_ASSIGN_OR_RETURN(const auto farm, ServiceFarm::Create(context.programs));
    FP_RETURN_IF_ERROR(farm->StartServer({"--log-level", "warn"}));
    const int side = context.Pick(320, 40);
    FP_ASSIGN_OR_RETURN(const JobId job, farm->Submit({.width = side * 32,
                                                       .height = side * 32,
                                                       .integrator = Integrator::kPt,
                                                       .beauty_only = true}));
    FP_RETURN_IF_ERROR(
        farm->WaitFor(job, seconds(30),
                      [](const JobStatus& s) { return s.state == JobState::kRendering; })
            .status());
    // What a client asks for that stitches it.
    FP_ASSIGN_OR_RETURN(const JobInfo info, farm->client().Info(job));
    Figure(result, "tiles of one job", static_cast<double>(info.tiles.size()));
    Count(result, "MiB that the coordinator holds with it",
          static_cast<double>(farm->server()->StatusKb("VmRSS")) / 1024, 256);
  }
  {
    // In memory, so that the time to make them is not that of the disk: a listing reads no disk.
    const std::string memory = ::access("/dev/shm", W_OK) == 0 ? "/dev/shm" : "";
    FP_ASSIGN_OR_RETURN(const auto farm, ServiceFarm::Create(context.programs, memory));
    FP_RETURN_IF_ERROR(farm->StartServer({"--log-level", "warn"}));
    const int jobs = context.Pick(10000, 200);
    for (int i = 0; i < jobs; ++i) {
      FP_RETURN_IF_ERROR(
          farm->Submit(
                  {.width = 64, .height = 64, .title = "job " + std::to_string(i), .paused = true})
              .status());
    }
    double best = 1e9, worst = 0;
    for (int i = 0; i < 10; ++i) {
      const Stopwatch watch;
      FP_ASSIGN_OR_RETURN(const FarmStatus all, farm->client().Status({}));
      if (all.jobs.size() != static_cast<size_t>(jobs)) {
        return absl::InternalError("jobs are missing from the list");
      }
      best = std::min(best, watch.seconds());
      worst = std::max(worst, watch.seconds());
    }
    Figure(result, "jobs that wait", jobs);
    Time(result, "ms to list them (the best of ten)", 1000 * best, 100);
    Figure(result, "ms to list them (the worst of ten)", 1000 * worst);
    farm->server()->Kill();
    const Stopwatch watch;
    FP_RETURN_IF_ERROR(farm->StartServer({"--log-level", "warn"}));
    Figure(result, "s to start again with them", watch.seconds());
  }
  return absl::OkStatus();
}

// --- cost ------------------------------------------------------------------------------------

absl::Status RunCost(const ServiceContext& context, ServiceResult& result) {
  for (const char* const integrator : {"pt", "fpbgi"}) {
    if (context.options.quick && integrator == std::string_view("fpbgi")) continue;
    const bool pt = std::string_view(integrator) == "pt";
    // Half a minute of one thread each, so that starting processes is not what is measured.
    const std::string side = std::to_string(context.Pick(pt ? 1024 : 2560, 64));
    FP_ASSIGN_OR_RETURN(const auto farm, ServiceFarm::Create(context.programs));
    const AssetBundle asset = ServiceScene();
    const std::string scene = farm->File("scene.obj");
    FP_RETURN_IF_ERROR(WriteFileAtomically(scene, asset.files.at("scene.obj").bytes()));
    const std::vector<std::string> job = {scene,
                                          "--integrator",
                                          integrator,
                                          "--resolution",
                                          side + "x" + side,
                                          "--eye",
                                          "5,4,6",
                                          "--target",
                                          "0,0.7,0",
                                          "--sun",
                                          "1,2,0.5:3,3,2.5",
                                          "--sky",
                                          "0.3,0.4,0.5",
                                          "--paths",
                                          context.options.quick ? "4" : "96",
                                          "--quality",
                                          pt ? "normal" : "fine",
                                          "--points",
                                          "100000",
                                          "--log-level",
                                          "error"};
    const auto run = [&](std::vector<std::string> args) -> absl::StatusOr<double> {
      FP_ASSIGN_OR_RETURN(const auto process,
                          ChildProcess::Start(args, {.log = farm->File("client.log")}));
      if (process->Wait(seconds(900)) != 0) {
        return farm->Annotated(absl::InternalError(args[1] + " fails"));
      }
      return process->cpu_seconds();
    };
    const auto command = [&](const char* verb, const std::vector<std::string>& more) {
      std::vector<std::string> args = {context.programs.client, verb};
      args.insert(args.end(), job.begin(), job.end());
      args.insert(args.end(), more.begin(), more.end());
      return args;
    };
    FP_ASSIGN_OR_RETURN(
        const double one,
        run(command("render", {"-o", farm->File("a.exr"), "--workers", "1", "--threads", "1"})));
    FP_ASSIGN_OR_RETURN(
        const double two,
        run(command("render", {"-o", farm->File("b.exr"), "--workers", "2", "--threads", "1"})));
    for (const char* const audits : {"0", "0.02"}) {
      const bool none = std::string_view(audits) == "0";
      FP_RETURN_IF_ERROR(farm->StartServer({"--audit-fraction", audits}));
      for (int i = 0; i < 2; ++i) FP_RETURN_IF_ERROR(farm->StartWorker().status());
      FP_RETURN_IF_ERROR(WaitForWorkers(*farm, 2));
      FP_ASSIGN_OR_RETURN(
          double cost,
          run(command("submit", {"-o", farm->File("c.exr"), "--coordinator", farm->address()})));
      for (size_t i = 0; i < 2; ++i) {
        farm->worker(i).Signal(SIGTERM);
        farm->worker(i).Wait(seconds(20));
        cost += farm->worker(i).cpu_seconds();
      }
      farm->server()->Signal(SIGTERM);
      farm->server()->Wait(seconds(30));
      cost += farm->server()->cpu_seconds();
      farm->RemoveWorkers();
      fs::remove_all(farm->File("store"));
      if (none) {
        Figure(result, absl::StrFormat("%s: processor s embedded, one worker", integrator), one);
        Figure(result, absl::StrFormat("%s: processor s embedded, two workers", integrator), two);
        Figure(result, absl::StrFormat("%s: processor s of the farm", integrator), cost);
        Time(result, absl::StrFormat("%s: the farm over embedded, two workers each", integrator),
             cost / two, 1.03);
        if (!pt) {
          Figure(result, absl::StrFormat("%s: the farm over embedded with one worker", integrator),
                 cost / one);
        }
      } else {
        Figure(result, absl::StrFormat("%s: the same with audits of 2 %%", integrator), cost / two);
      }
    }
  }
  return absl::OkStatus();
}

}  // namespace farpoint

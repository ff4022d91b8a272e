// Processes that die, stop and come back: schedules, kills, coordinator, fencing, states.
#include <signal.h>
#include <sys/mount.h>

#include <algorithm>
#include <atomic>
#include <filesystem>
#include <fstream>
#include <optional>
#include <set>
#include <string>
#include <thread>
#include <utility>

#include "bench/service_cases.h"
#include "bench/service_network.h"
#include "bench/service_relay.h"
#include "core/base/executor.h"
#include "core/image/exr_io.h"
#include "worker/fingerprint.h"
#include "worker/grpc_link.h"

namespace farpoint {

using std::chrono::milliseconds;
using std::chrono::seconds;
using std::chrono::steady_clock;

namespace {

// So that a case does not wait for the seconds that a farm has.
const std::vector<std::string> kImpatient = {"--heartbeat-ms", "50", "--silence-ms", "400",
                                             "--reconnect-ms", "150"};

void Sleep(int ms) { std::this_thread::sleep_for(milliseconds(ms)); }

// Commits of one job, as they should be: each tile once.
absl::Status CountCommits(ServiceFarm& farm, const JobId& job, uint64_t& lost, uint64_t& twice) {
  FP_ASSIGN_OR_RETURN(const std::vector<uint32_t> commits, farm.CommitsOf(job));
  for (const uint32_t count : commits) {
    lost += count == 0;
    twice += count > 1;
  }
  return absl::OkStatus();
}

}  // namespace

// --- schedules -------------------------------------------------------------------------------

absl::Status RunSchedules(const ServiceContext& context, ServiceResult& result) {
  std::mt19937_64 random = context.Random();
  const auto below = [&random](uint64_t n) { return static_cast<int>(random() % n); };
  FP_ASSIGN_OR_RETURN(const auto farm, ServiceFarm::Create(context.programs));
  FP_RETURN_IF_ERROR(farm->StartServer(kImpatient));
  std::vector<std::unique_ptr<Relay>> relays;
  const auto grow = [&](size_t count) -> absl::Status {
    while (relays.size() < count) {
      FP_ASSIGN_OR_RETURN(auto relay, Relay::Start(farm->port(), random()));
      FP_RETURN_IF_ERROR(
          farm->StartWorker({}, "127.0.0.1:" + std::to_string(relay->port())).status());
      relays.push_back(std::move(relay));
    }
    return absl::OkStatus();
  };

  SmallJob job{.width = 192, .height = 128};
  std::set<std::string> hashes;
  uint64_t kills = 0, stops = 0, slowed = 0, resets = 0, cuts = 0, restarts = 0, requeued = 0;
  uint64_t lost = 0, twice = 0, reissued = 0;
  const int schedules = context.Pick(200, 6);
  for (int number = 0; number < schedules; ++number) {
    const auto count = static_cast<size_t>(1 << below(4));
    job.tile = 32 << below(3);
    FP_RETURN_IF_ERROR(grow(count));
    // Exactly the schedule's number. Those beyond it must not be stopped instead: the coordinator
    // would give them the tiles that they wait for.
    for (size_t i = 0; i < farm->worker_count(); ++i) {
      if (i >= count) {
        farm->worker(i).Kill();
      } else if (!farm->worker(i).Running()) {
        FP_RETURN_IF_ERROR(farm->Restart(i));
      }
    }
    FP_ASSIGN_OR_RETURN(const JobId id, farm->Submit(job));
    struct Later {
      steady_clock::time_point when;
      size_t worker;
      bool network;
    };
    std::vector<Later> undo;
    const auto undo_due = [&](bool all) {
      std::erase_if(undo, [&](const Later& later) {
        if (!all && steady_clock::now() < later.when) return false;
        if (later.network) {
          relays[later.worker]->SetSilent(false);
          relays[later.worker]->ResetAll();
        } else {
          farm->worker(later.worker).Signal(SIGCONT);
        }
        return true;
      });
    };
    const int events = below(7);
    int killed = 0;
    for (int event = 0; event < events; ++event) {
      const auto next = steady_clock::now() + milliseconds(10 + below(120));
      while (steady_clock::now() < next) {
        undo_due(false);
        Sleep(2);
      }
      const size_t victim = random() % count;
      const auto until = [&](int least, int most) {
        return steady_clock::now() + milliseconds(least + below(static_cast<uint64_t>(most)));
      };
      switch (below(number % 8 == 7 ? 6 : 5)) {
        case 0:
          // A tile that loses three workers by chance would be set aside.
          if (killed++ == 2) break;
          FP_RETURN_IF_ERROR(farm->Restart(victim));
          ++kills;
          break;
        case 1:
          farm->worker(victim).Signal(SIGSTOP);
          undo.push_back({until(30, 700), victim, false});
          ++stops;
          break;
        case 2:
          for (int i = 0; i < 5; ++i) {
            farm->worker(victim).Signal(SIGSTOP);
            Sleep(20);
            farm->worker(victim).Signal(SIGCONT);
            Sleep(5);
          }
          ++slowed;
          break;
        case 3:
          relays[victim]->ResetAll();
          ++resets;
          break;
        case 4:
          relays[victim]->SetSilent(true);
          undo.push_back({until(100, 900), victim, true});
          ++cuts;
          break;
        default:
          farm->server()->Kill();
          FP_RETURN_IF_ERROR(farm->StartServer(kImpatient));
          ++restarts;
      }
    }
    undo_due(true);
    for (int tries = 0;; ++tries) {
      FP_ASSIGN_OR_RETURN(
          const JobStatus end,
          farm->WaitFor(id, seconds(120), [](const JobStatus& s) { return IsFinal(s.state); }));
      reissued += tries == 0 ? end.reissued : 0;
      if (end.state == JobState::kDone || tries == 3) break;
      ++requeued;
      result.notes.push_back("schedule " + std::to_string(number) +
                             " had to be requeued: " + std::string(end.error.message()));
      FP_RETURN_IF_ERROR(farm->client().Requeue(id, false));
    }
    FP_ASSIGN_OR_RETURN(const Digest hash, farm->ImageOf(id));
    hashes.insert(hash.Hex());
    FP_RETURN_IF_ERROR(CountCommits(*farm, id, lost, twice));
    for (size_t i = 0; i < count; ++i) farm->worker(i).Signal(SIGCONT);
    if (number % 20 == 19) context.progress("schedules: " + std::to_string(number + 1));
  }
  Figure(result, "schedules", schedules);
  Count(result, "image hashes beyond the first", static_cast<double>(hashes.size()) - 1, 0);
  Count(result, "tiles lost", static_cast<double>(lost), 0);
  Count(result, "tiles committed twice", static_cast<double>(twice), 0);
  Count(result, "answers in which tiles do not add up", static_cast<double>(farm->wrong_sums()), 0);
  Figure(result, "workers killed", static_cast<double>(kills));
  Figure(result, "workers stopped and continued", static_cast<double>(stops));
  Figure(result, "workers slowed down", static_cast<double>(slowed));
  Figure(result, "connections reset", static_cast<double>(resets));
  Figure(result, "links cut", static_cast<double>(cuts));
  Figure(result, "coordinators killed", static_cast<double>(restarts));
  Figure(result, "leases lost", static_cast<double>(reissued));
  Figure(result, "jobs whose tile lost three workers by chance, requeued",
         static_cast<double>(requeued));
  return absl::OkStatus();
}

// --- kills -----------------------------------------------------------------------------------

namespace {

// A tile that a worker holds when something happens to it; seconds until another one has done it.
absl::StatusOr<double> TimeToDoneAgain(const ServiceContext& context, const std::string& what) {
  FP_ASSIGN_OR_RETURN(const auto farm, ServiceFarm::Create(context.programs));
  FP_RETURN_IF_ERROR(farm->StartServer());
  FP_ASSIGN_OR_RETURN(const auto relay, Relay::Start(farm->port(), context.options.seed));
  const std::string through = "127.0.0.1:" + std::to_string(relay->port());
  std::vector<std::string> values = {"render=null"};
  const bool from_the_lease = what == "hang" || what == "spin";
  values.push_back(from_the_lease ? what + "=0,0" : "tile_ms=3600000");
  FP_ASSIGN_OR_RETURN(const size_t victim, farm->StartActor("worker", values, through));
  FP_ASSIGN_OR_RETURN(const JobId job,
                      farm->Submit({.width = 32, .height = 32, .integrator = Integrator::kPt}));
  FP_RETURN_IF_ERROR(
      farm->WaitFor(job, seconds(30), [](const JobStatus& s) { return s.tiles.leased == 1; })
          .status());
  const Stopwatch since_lease;
  FP_RETURN_IF_ERROR(farm->StartActor("worker", {"render=null"}).status());
  // The other one waits for work, and the victim has sent heartbeats.
  for (;;) {
    FP_ASSIGN_OR_RETURN(const FarmStatus status, farm->client().Status({}));
    if (status.workers.size() == 2) break;
    Sleep(10);
  }
  if (!from_the_lease) Sleep(1500);
  const Stopwatch watch;
  if (what == "kill") farm->worker(victim).Signal(SIGKILL);
  if (what == "stop") farm->worker(victim).Signal(SIGSTOP);
  if (what == "cut") relay->SetSilent(true);
  FP_RETURN_IF_ERROR(farm->WaitUntilDone(job, seconds(60)).status());
  // A thread that hangs does so from its lease on.
  const double took = from_the_lease ? since_lease.seconds() : watch.seconds();
  if (what == "stop") farm->worker(victim).Signal(SIGCONT);
  return took;
}

// The same with a link of its own. kUnavailable where that is not permitted.
absl::StatusOr<double> TimeWithNetworkDown(const ServiceContext& context, bool drop) {
  FP_ASSIGN_OR_RETURN(const auto space, NetworkSpace::Create(77, 0));
  FP_ASSIGN_OR_RETURN(const auto farm, ServiceFarm::Create(context.programs));
  FP_RETURN_IF_ERROR(farm->StartServer({"--listen", "0.0.0.0:0", "--insecure"}));
  FP_RETURN_IF_ERROR(farm->StartWorker({"--insecure"},
                                       space->host() + ":" + std::to_string(farm->port()),
                                       {.network = space->name()})
                         .status());
  // Minutes of work in one tile.
  FP_ASSIGN_OR_RETURN(const JobId job, farm->Submit({.width = 32,
                                                     .height = 32,
                                                     .integrator = Integrator::kPt,
                                                     .paths = 1 << 20,
                                                     .beauty_only = true}));
  FP_RETURN_IF_ERROR(
      farm->WaitFor(job, seconds(30), [](const JobStatus& s) { return s.tiles.leased == 1; })
          .status());
  Sleep(1500);
  const Stopwatch watch;
  FP_RETURN_IF_ERROR(drop ? space->DropAll() : space->TakeDown());
  FP_RETURN_IF_ERROR(
      farm->WaitFor(job, seconds(60), [](const JobStatus& s) { return s.reissued >= 1; }).status());
  return watch.seconds();
}

}  // namespace

absl::Status RunKills(const ServiceContext& context, ServiceResult& result) {
  // By the farm's own times: no flags.
  const struct {
    const char* what;
    const char* text;
    double bound;
  } kinds[] = {{"kill", "s until the tile of a killed worker (SIGKILL) is done again", 1},
               {"stop", "s of a stopped one (SIGSTOP)", 5},
               {"hang", "s of one whose render thread hangs, from the lease on", 5},
               {"spin", "s of one whose render thread computes for ever, from the lease on", 5},
               {"cut", "s of one whose link is cut (a relay that goes silent)", 5}};
  for (const auto& kind : kinds) {
    if (context.options.quick && kind.bound > 1) continue;
    FP_ASSIGN_OR_RETURN(const double took, TimeToDoneAgain(context, kind.what));
    Time(result, kind.text, took, kind.bound);
  }
  for (const bool drop : {false, true}) {
    if (context.options.quick) continue;
    const absl::StatusOr<double> took = TimeWithNetworkDown(context, drop);
    const std::string text = drop ? "s until a worker's lease is lost when its packets are dropped"
                                  : "s until a worker's lease is lost when its interface goes down";
    if (took.ok()) {
      Time(result, text, *took, 5);
    } else if (absl::IsUnavailable(took.status())) {
      result.notes.push_back(text + ": " + std::string(took.status().message()));
    } else {
      return took.status();
    }
  }

  std::mt19937_64 random = context.Random();
  FP_ASSIGN_OR_RETURN(const auto farm, ServiceFarm::Create(context.programs));
  FP_RETURN_IF_ERROR(farm->StartServer(kImpatient));
  for (int i = 0; i < 4; ++i) FP_RETURN_IF_ERROR(farm->StartWorker().status());
  const int wanted = context.Pick(1000, 8);
  int kills = 0, jobs = 0;
  uint64_t lost = 0, twice = 0, reissued = 0, requeued = 0;
  std::set<std::string> hashes;
  while (kills < wanted) {
    FP_ASSIGN_OR_RETURN(const JobId job, farm->Submit({.width = 256, .height = 192}));
    ++jobs;
    for (;;) {
      FP_ASSIGN_OR_RETURN(const JobStatus status, farm->Status(job));
      if (status.state == JobState::kFailed) {
        // Three workers of one tile by chance: what a person would do.
        ++requeued;
        FP_RETURN_IF_ERROR(farm->client().Requeue(job, false));
      }
      if (status.state == JobState::kDone) {
        reissued += status.reissued;
        break;
      }
      Sleep(20 + static_cast<int>(random() % 80));
      // Whoever holds a tile; those that only start are of no use.
      if (kills < wanted && status.tiles.leased > 0) {
        FP_RETURN_IF_ERROR(farm->Restart(random() % 4));
        if (++kills % 100 == 0) context.progress("kills: " + std::to_string(kills));
      }
    }
    FP_RETURN_IF_ERROR(CountCommits(*farm, job, lost, twice));
    FP_ASSIGN_OR_RETURN(const Digest hash, farm->ImageOf(job));
    hashes.insert(hash.Hex());
  }
  Figure(result, "kills", kills);
  Figure(result, "jobs rendered meanwhile", jobs);
  Figure(result, "leases lost", static_cast<double>(reissued));
  Count(result, "tiles lost", static_cast<double>(lost), 0);
  Count(result, "tiles committed twice", static_cast<double>(twice), 0);
  Count(result, "image hashes beyond the first", static_cast<double>(hashes.size()) - 1, 0);
  Count(result, "jobs that failed because a tile lost six workers", static_cast<double>(requeued),
        0);
  return absl::OkStatus();
}

// --- coordinator -----------------------------------------------------------------------------

namespace {

struct Deaths {
  uint64_t deaths = 0, lost = 0, twice = 0, forgotten = 0;
  double slowest_s = 0;  // from listening again to the next commit
  std::set<std::string> hashes;
};

// A job whose coordinator dies once; then one that lives goes on.
absl::Status GoOnAfterDeath(ServiceFarm& farm, const JobId& job, uint32_t committed_before,
                            Deaths& deaths) {
  ++deaths.deaths;
  farm.server()->Wait(seconds(10));
  FP_RETURN_IF_ERROR(farm.StartActorServer(0));
  const Stopwatch watch;
  FP_ASSIGN_OR_RETURN(const JobStatus first, farm.Status(job));
  deaths.forgotten += first.tiles.committed < committed_before;
  if (first.state != JobState::kDone) {
    FP_RETURN_IF_ERROR(farm.WaitFor(job, seconds(60),
                                    [&](const JobStatus& s) {
                                      return s.tiles.committed > first.tiles.committed ||
                                             s.state == JobState::kDone;
                                    })
                           .status());
    deaths.slowest_s = std::max(deaths.slowest_s, watch.seconds());
  }
  FP_RETURN_IF_ERROR(farm.WaitUntilDone(job, seconds(60)).status());
  FP_RETURN_IF_ERROR(CountCommits(farm, job, deaths.lost, deaths.twice));
  FP_ASSIGN_OR_RETURN(const Digest hash, farm.ImageOf(job));
  deaths.hashes.insert(hash.Hex());
  return absl::OkStatus();
}

}  // namespace

namespace {

// A small file system of its own, for as long as this lives.
class SmallDisk {
 public:
  // kUnavailable where that is not permitted.
  static absl::StatusOr<std::unique_ptr<SmallDisk>> Mount(const std::string& folder, int mib) {
    std::filesystem::create_directories(folder);
    const std::string options = "size=" + std::to_string(mib) + "m";
    if (::mount("farpoint", folder.c_str(), "tmpfs", 0, options.c_str()) != 0) {
      return absl::UnavailableError(
          "a file system of its own cannot be mounted here (run as root)");
    }
    return std::unique_ptr<SmallDisk>(new SmallDisk(folder));
  }
  ~SmallDisk() { ::umount2(folder_.c_str(), MNT_DETACH); }

  // Takes all the room there is, and gives it back.
  void Fill() {
    std::ofstream file(filler(), std::ios::binary);
    const std::string block(4096, 'x');
    while (file.write(block.data(), static_cast<std::streamsize>(block.size())).flush()) {
    }
  }
  void Free() { std::filesystem::remove(filler()); }

 private:
  explicit SmallDisk(std::string folder) : folder_(std::move(folder)) {}
  std::string filler() const { return folder_ + "/filler"; }
  const std::string folder_;
};

// The disk fills in the middle of a job, and then there is room again.
absl::Status RunFullDisk(const ServiceContext& context, ServiceResult& result) {
  FP_ASSIGN_OR_RETURN(const auto farm, ServiceFarm::Create(context.programs));
  absl::StatusOr<std::unique_ptr<SmallDisk>> disk =
      context.options.quick ? absl::UnavailableError("a quick run mounts nothing")
                            : SmallDisk::Mount(farm->File("store"), 8);
  if (!disk.ok()) {
    // The next best thing: no file may grow.
    result.notes.push_back("full disk: " + std::string(disk.status().message()) +
                           "; files that may not grow instead");
  }
  FP_RETURN_IF_ERROR(farm->StartServer());
  FP_RETURN_IF_ERROR(farm->StartActor("worker", {"tile_ms=50"}).status());
  FP_ASSIGN_OR_RETURN(const JobId job, farm->Submit({.width = 256, .height = 192}));
  FP_ASSIGN_OR_RETURN(const JobStatus some, farm->WaitFor(job, seconds(60), [](const JobStatus& s) {
    return s.tiles.committed >= 3;
  }));
  if (disk.ok()) {
    (*disk)->Fill();
  } else {
    farm->server()->LimitFileBytes(4096);
  }
  const auto told = [&] { return farm->ServerLog().find("not committed: ") != std::string::npos; };
  for (const Stopwatch watch; watch.seconds() < 20 && !told();) Sleep(20);
  Sleep(500);
  FP_ASSIGN_OR_RETURN(const JobStatus stuck, farm->Status(job));
  Count(result, "full disk: a coordinator that does not say so", !told(), 0);
  const std::string log = farm->ServerLog();
  const size_t at = log.find("not committed: ");
  if (at != std::string::npos) {
    result.notes.push_back("full disk: " + log.substr(at, log.find('\n', at) - at));
  }
  Count(result, "full disk: tiles forgotten", stuck.tiles.committed < some.tiles.committed, 0);
  Count(result, "full disk: jobs that failed", IsFinal(stuck.state), 0);
  if (disk.ok()) {
    (*disk)->Free();
  } else {
    farm->server()->LimitFileBytes(0);
  }
  FP_RETURN_IF_ERROR(farm->WaitUntilDone(job, seconds(120)).status());
  uint64_t lost = 0, twice = 0;
  FP_RETURN_IF_ERROR(CountCommits(*farm, job, lost, twice));
  Count(result, "full disk: tiles lost or committed twice", static_cast<double>(lost + twice), 0);
  FP_RETURN_IF_ERROR(farm->ImageOf(job).status());
  farm->RemoveWorkers();
  farm->server()->Kill();
  return absl::OkStatus();
}

}  // namespace

absl::Status RunCoordinatorDeath(const ServiceContext& context, ServiceResult& result) {
  std::mt19937_64 random = context.Random();
  const SmallJob job{.width = 96, .height = 64};
  Deaths deaths;
  // One farm, one life after the other: the workers stay, and find the next coordinator.
  FP_ASSIGN_OR_RETURN(const auto farm, ServiceFarm::Create(context.programs));
  FP_RETURN_IF_ERROR(farm->StartActorServer(0));
  for (int i = 0; i < 2; ++i) FP_RETURN_IF_ERROR(farm->StartWorker().status());
  {
    FP_ASSIGN_OR_RETURN(const JobId id, farm->Submit(job));
    FP_RETURN_IF_ERROR(farm->WaitUntilDone(id, seconds(60)).status());
    FP_ASSIGN_OR_RETURN(const Digest hash, farm->ImageOf(id));
    deaths.hashes.insert(hash.Hex());
  }
  const int step = context.Pick(1, 9);
  int points = 0, submissions_lost = 0;
  for (int point = 1;; point += step) {
    farm->server()->Kill();
    FP_RETURN_IF_ERROR(farm->StartActorServer(point));
    // Dying while it takes the job: the client submits again and gets one job all the same.
    std::optional<JobId> id;
    {
      std::thread reviver;
      std::atomic<bool> submitted = false;
      std::atomic<bool> died = false;
      // The client tries again for as long as nobody answers: somebody else must start the next
      // one.
      absl::StatusOr<JobId> answer = absl::UnknownError("");
      std::thread client([&] {
        answer = farm->Submit(job);
        submitted = true;
      });
      while (!submitted) {
        if (!farm->server()->Running() && !died.exchange(true)) {
          const absl::Status up = farm->StartActorServer(0);
          if (!up.ok()) {
            client.join();
            return up;
          }
        }
        Sleep(1);
      }
      client.join();
      FP_RETURN_IF_ERROR(answer.status());
      id = *answer;
      if (died) {
        ++points;
        ++deaths.deaths;
        FP_RETURN_IF_ERROR(farm->WaitUntilDone(*id, seconds(60)).status());
        FP_RETURN_IF_ERROR(CountCommits(*farm, *id, deaths.lost, deaths.twice));
        FP_ASSIGN_OR_RETURN(const FarmStatus all, farm->client().Status({}));
        submissions_lost += std::count_if(all.jobs.begin(), all.jobs.end(),
                                          [](const JobStatus& s) { return !IsFinal(s.state); }) > 0;
        continue;
      }
    }
    uint32_t committed = 0;
    bool done = false;
    while (farm->server()->Running() && !done) {
      const absl::StatusOr<FarmStatus> status = farm->client().Status(*id);
      if (!status.ok()) {
        Sleep(2);
        continue;
      }
      committed = std::max(committed, status->jobs[0].tiles.committed);
      done = status->jobs[0].state == JobState::kDone;
      Sleep(2);
    }
    if (done) {
      // The last points are those of its end: it may die a moment after it was seen.
      if (farm->server()->Wait(milliseconds(300)).has_value()) {
        ++points;
        FP_RETURN_IF_ERROR(GoOnAfterDeath(*farm, *id, committed, deaths));
        continue;
      }
      break;
    }
    ++points;
    FP_RETURN_IF_ERROR(GoOnAfterDeath(*farm, *id, committed, deaths));
    if (points % 10 == 0) context.progress("coordinator: point " + std::to_string(point));
  }
  Figure(result, "write points at which it died", points);
  Count(result, "submissions that made a second job", submissions_lost, 0);

  // The last one waits for a point that its job does not have.
  farm->server()->Kill();
  FP_RETURN_IF_ERROR(farm->StartActorServer(0));
  for (int i = 0; i < context.Pick(20, 2); ++i) {
    FP_ASSIGN_OR_RETURN(const JobId id, farm->Submit({.width = 256, .height = 192}));
    Sleep(static_cast<int>(random() % 1200));
    uint32_t committed = 0;
    if (const auto status = farm->client().Status(id); status.ok()) {
      committed = status->jobs[0].tiles.committed;
    }
    farm->server()->Kill();
    Deaths large;
    FP_RETURN_IF_ERROR(GoOnAfterDeath(*farm, id, committed, large));
    deaths.deaths += large.deaths;
    deaths.lost += large.lost;
    deaths.twice += large.twice;
    deaths.forgotten += large.forgotten;
    deaths.slowest_s = std::max(deaths.slowest_s, large.slowest_s);
  }
  Figure(result, "deaths in all", static_cast<double>(deaths.deaths));
  Count(result, "lives that forgot a committed tile", static_cast<double>(deaths.forgotten), 0);
  Count(result, "tiles lost", static_cast<double>(deaths.lost), 0);
  Count(result, "tiles committed twice", static_cast<double>(deaths.twice), 0);
  Count(result, "image hashes beyond the first", static_cast<double>(deaths.hashes.size()) - 1, 0);
  Time(result, "s at most from its start to the next committed tile", deaths.slowest_s, 3);

  farm->RemoveWorkers();
  farm->server()->Kill();
  return RunFullDisk(context, result);
}

// --- fencing ---------------------------------------------------------------------------------

namespace {

// A worker without threads: what it does is said step by step.
class HandWorker {
 public:
  static absl::StatusOr<std::unique_ptr<HandWorker>> Join(const std::string& address,
                                                          const Digest& fingerprint,
                                                          const std::string& name) {
    auto worker = std::unique_ptr<HandWorker>(new HandWorker(address));
    FP_ASSIGN_OR_RETURN(
        worker->welcome_,
        worker->link_->Register(
            {.version = FARPOINT_VERSION, .fingerprint = fingerprint, .threads = 1, .name = name}));
    return worker;
  }
  absl::StatusOr<std::optional<TileWork>> Lease(milliseconds wait) {
    return link_->Lease(welcome_.id, wait);
  }
  absl::StatusOr<ReturnAnswer> Return(const TileWork& work) {
    TileResult result;
    result.lease = work.lease;
    result.attempt = work.attempt;
    result.bytes = Blob::FromVector(EncodeFilm(Film(work.rect, work.frame.settings.layers)));
    result.sha256 = result.bytes.Hash();
    return link_->Return(welcome_.id, result);
  }

 private:
  explicit HandWorker(const std::string& address) : link_(GrpcLink::Connect(address)) {}
  const std::unique_ptr<GrpcLink> link_;
  WorkerWelcome welcome_;
};

}  // namespace

absl::Status RunFencing(const ServiceContext& context, ServiceResult& result) {
  FP_ASSIGN_OR_RETURN(const auto farm, ServiceFarm::Create(context.programs));
  FP_RETURN_IF_ERROR(farm->StartServer({"--heartbeat-ms", "50", "--silence-ms", "200"}));
  Executor executor(1);
  FP_ASSIGN_OR_RETURN(const Digest fingerprint, ComputeFingerprint(executor));
  const int wanted = context.Pick(1000, 40);
  const int rounds = context.Pick(20, 2);
  const int each = wanted / rounds;
  std::vector<std::unique_ptr<HandWorker>> slow;
  for (int i = 0; i < each; ++i) {
    FP_ASSIGN_OR_RETURN(auto worker, HandWorker::Join(farm->address(), fingerprint,
                                                      "stopped " + std::to_string(i)));
    slow.push_back(std::move(worker));
  }
  FP_ASSIGN_OR_RETURN(const auto good, HandWorker::Join(farm->address(), fingerprint, "good"));
  uint64_t stale = 0, stale_accepted = 0, repeated = 0, repeated_accepted = 0;
  uint64_t counted = 0, lost = 0, twice = 0;
  std::set<std::string> hashes;
  for (int round = 0; round < rounds; ++round) {
    FP_ASSIGN_OR_RETURN(const JobId job, farm->Submit({.width = 32 * each,
                                                       .height = 32,
                                                       .integrator = Integrator::kPt,
                                                       .beauty_only = true}));
    // All tiles are leased, and nothing is heard of those who have them.
    std::vector<TileWork> held;
    for (const auto& worker : slow) {
      FP_ASSIGN_OR_RETURN(std::optional<TileWork> work, worker->Lease(seconds(20)));
      if (!work) return farm->Annotated(absl::InternalError("no tile for a worker"));
      held.push_back(*std::move(work));
    }
    FP_RETURN_IF_ERROR(
        farm->WaitFor(job, seconds(20), [](const JobStatus& s) { return s.tiles.leased == 0; })
            .status());
    // Another one does half of them before the first ones wake up, half of them after.
    std::vector<TileWork> done;
    const auto render = [&](int count) -> absl::Status {
      for (int i = 0; i < count; ++i) {
        FP_ASSIGN_OR_RETURN(std::optional<TileWork> work, good->Lease(seconds(20)));
        if (!work) return farm->Annotated(absl::InternalError("no tile for the good worker"));
        FP_ASSIGN_OR_RETURN(const ReturnAnswer answer, good->Return(*work));
        if (!answer.accepted) return absl::InternalError("refused: " + answer.reason);
        done.push_back(*std::move(work));
      }
      return absl::OkStatus();
    };
    FP_RETURN_IF_ERROR(render(each / 2));
    for (int i = 0; i < each; ++i) {
      FP_ASSIGN_OR_RETURN(const ReturnAnswer answer,
                          slow[static_cast<size_t>(i)]->Return(held[static_cast<size_t>(i)]));
      ++stale;
      stale_accepted += answer.accepted;
    }
    FP_RETURN_IF_ERROR(render(each - each / 2));
    // The acknowledgement never arrived, so it is sent again.
    for (const TileWork& work : done) {
      FP_ASSIGN_OR_RETURN(const ReturnAnswer answer, good->Return(work));
      ++repeated;
      repeated_accepted += answer.accepted;
    }
    FP_ASSIGN_OR_RETURN(const JobStatus end, farm->WaitUntilDone(job, seconds(20)));
    counted += end.refused_results;
    FP_RETURN_IF_ERROR(CountCommits(*farm, job, lost, twice));
    FP_ASSIGN_OR_RETURN(const Digest hash, farm->ImageOf(job));
    hashes.insert(hash.Hex());
  }
  Figure(result, "results of workers that were overtaken", static_cast<double>(stale));
  Count(result, "of these accepted", static_cast<double>(stale_accepted), 0);
  Figure(result, "accepted results that were sent again", static_cast<double>(repeated));
  Count(result, "of these accepted twice", static_cast<double>(repeated_accepted), 0);
  // Results that come after their job's end are refused, too, but no job counts them any more.
  CountAtLeast(result, "refusals that the jobs counted", static_cast<double>(counted),
               static_cast<double>(stale));
  Count(result, "tiles lost or committed twice", static_cast<double>(lost + twice), 0);
  Count(result, "image hashes beyond the first", static_cast<double>(hashes.size()) - 1, 0);

  // The same with real processes, which are stopped in the middle of a tile.
  uint64_t stopped = 0;
  FP_ASSIGN_OR_RETURN(const size_t victim,
                      farm->StartActor("worker", {"render=null", "tile_ms=300"}));
  FP_RETURN_IF_ERROR(farm->StartActor("worker", {"render=null", "tile_ms=100"}).status());
  for (int i = 0; i < context.Pick(20, 2); ++i) {
    FP_ASSIGN_OR_RETURN(
        const JobId job,
        farm->Submit(
            {.width = 256, .height = 32, .integrator = Integrator::kPt, .beauty_only = true}));
    FP_RETURN_IF_ERROR(
        farm->WaitFor(job, seconds(20), [](const JobStatus& s) { return s.tiles.leased == 2; })
            .status());
    farm->worker(victim).Signal(SIGSTOP);
    FP_RETURN_IF_ERROR(farm->WaitUntilDone(job, seconds(30)).status());
    farm->worker(victim).Signal(SIGCONT);
    ++stopped;
    FP_RETURN_IF_ERROR(CountCommits(*farm, job, lost, twice));
    Sleep(300);
  }
  Figure(result, "processes stopped, overtaken and continued", static_cast<double>(stopped));
  Count(result, "their tiles lost or committed twice", static_cast<double>(lost + twice), 0);
  return absl::OkStatus();
}

// --- states ----------------------------------------------------------------------------------

absl::Status RunStates(const ServiceContext& context, ServiceResult& result) {
  std::mt19937_64 random = context.Random();
  FP_ASSIGN_OR_RETURN(const auto farm, ServiceFarm::Create(context.programs));
  FP_RETURN_IF_ERROR(farm->StartServer());
  FP_RETURN_IF_ERROR(farm->StartWorker().status());
  FP_ASSIGN_OR_RETURN(const JobId job, farm->Submit({.width = context.Pick(1024, 256),
                                                     .height = context.Pick(768, 192),
                                                     .tile = 64}));
  FP_RETURN_IF_ERROR(farm->WaitUntilDone(job, seconds(300)).status());
  FP_ASSIGN_OR_RETURN(const Digest right, farm->ImageOf(job));
  const auto fetch = [&](const std::string& path) {
    return ChildProcess::Start(
        {context.programs.client, "fetch", job.value, "-o", path, "--coordinator", farm->address()},
        {.log = farm->File("fetch.log")});
  };
  // How long it takes when nobody disturbs it.
  const Stopwatch watch;
  {
    FP_ASSIGN_OR_RETURN(const auto client, fetch(farm->File("whole.exr")));
    if (client->Wait(seconds(60)) != 0) return farm->Annotated(absl::InternalError("fetch fails"));
  }
  const double whole_s = watch.seconds();
  int killed = 0, whole = 0, absent = 0, broken = 0;
  for (int i = 0; i < context.Pick(100, 6); ++i) {
    const std::string path = farm->File("image" + std::to_string(i) + ".exr");
    FP_ASSIGN_OR_RETURN(const auto client, fetch(path));
    std::this_thread::sleep_for(
        std::chrono::duration<double>(whole_s * 1.1 * static_cast<double>(random() % 1000) / 1000));
    client->Kill();
    ++killed;
    if (!std::filesystem::exists(path)) {
      ++absent;
      continue;
    }
    const auto image = ReadExr(path);
    const auto film = image.ok() ? FilmFromExr(*image) : image.status();
    if (film.ok() && ImageHash(*film) == right) {
      ++whole;
    } else {
      ++broken;
    }
    std::filesystem::remove(path);
  }
  Figure(result, "clients killed", killed);
  Figure(result, "images that were whole by then", whole);
  Figure(result, "images that were not there", absent);
  Count(result, "images that were broken", broken, 0);
  Figure(result, "answers about jobs", static_cast<double>(farm->answers()));
  Count(result, "answers in which tiles do not add up", static_cast<double>(farm->wrong_sums()), 0);
  return absl::OkStatus();
}

}  // namespace farpoint

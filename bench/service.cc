#include "bench/service.h"

#include <algorithm>
#include <iterator>
#include <thread>

#include "absl/strings/str_format.h"
#include "absl/strings/str_join.h"
#include "bench/machine.h"
#include "bench/service_cases.h"
#include "bench/text.h"

namespace farpoint {

namespace {

struct Case {
  std::string_view name, check;
  absl::Status (*run)(const ServiceContext&, ServiceResult&);
};

constexpr Case kCases[] = {
    {"schedules",
     "One image rendered again and again by 1, 2, 4 or 8 workers in tiles of 32, 64 or 128 pixels "
     "while they are killed, stopped, continued, slowed down, cut off and reset: one hash.",
     RunSchedules},
    {"kills",
     "Workers are killed by SIGKILL under a stream of jobs: no tile is lost or committed twice. "
     "How "
     "long it takes until the tile of a worker that is killed, stopped, hung or cut off is done by "
     "another one.",
     RunKills},
    {"coordinator",
     "The coordinator dies at each place where its job store writes, one by one, and at random "
     "instants; its disk is full for a while. It is started again: no acknowledged tile is lost or "
     "rendered again, and the hash is the same.",
     RunCoordinatorDeath},
    {"fencing",
     "Workers whose tile was given to another one return it all the same, and results that were "
     "accepted are sent again: each is refused and counted.",
     RunFencing},
    {"stragglers",
     "Of four workers one is ten times slower: time against what the capacity allows, and what was "
     "rendered for nothing.",
     RunStragglers},
    {"poison",
     "A tile that crashes its worker, and a worker that fails on everything: both are set aside, "
     "the rest is done.",
     RunPoison},
    {"flips", "Bits flipped in results, in blobs and in a worker's cache: none is accepted.",
     RunFlips},
    {"audits",
     "A worker returns wrong pixels with right hashes for a fifth of its tiles; 2 % of the tiles "
     "are rendered again by others.",
     RunAudits},
    {"broadcast",
     "A large blob to eight workers: memory, interruption, damage, sharing, and a folder of the "
     "site.",
     RunBroadcast},
    {"network",
     "Workers behind a relay with a round trip of 100 ms that stalls and resets connections.",
     RunNetwork},
    {"load", "Simulated workers with tiles of zeros, jobs of many tiles, many jobs.", RunLoad},
    {"cost",
     "The processor time of two one-thread workers and a coordinator against that of the embedded "
     "run of the same job.",
     RunCost},
    {"states",
     "Clients are killed while they fetch an image: the file is whole or not there. In every "
     "answer the tiles add up.",
     RunStates},
};

}  // namespace

size_t ServiceResult::failures() const {
  size_t count = error.empty() ? 0 : 1;
  for (const ServiceCheck& check : checks) {
    count += check.kind == ServiceCheck::Kind::kCount && !check.holds();
  }
  return count;
}

size_t ServiceResult::late() const {
  size_t count = 0;
  for (const ServiceCheck& check : checks) {
    count += check.kind == ServiceCheck::Kind::kTime && !check.holds();
  }
  return count;
}

size_t ServiceReport::failures() const {
  size_t count = 0;
  for (const ServiceResult& result : results) count += result.failures();
  return count;
}

size_t ServiceReport::late() const {
  size_t count = 0;
  for (const ServiceResult& result : results) count += result.late();
  return count;
}

static_assert(std::equal(std::begin(kCases), std::end(kCases), kServiceNames.begin(),
                         kServiceNames.end(),
                         [](const Case& one, std::string_view name) { return one.name == name; }));

absl::StatusOr<ServiceReport> RunService(const ServiceOptions& options,
                                         const std::function<void(std::string_view)>& progress) {
  for (const std::string& name : options.cases) {
    if (std::find(kServiceNames.begin(), kServiceNames.end(), name) == kServiceNames.end()) {
      return absl::InvalidArgumentError(
          Concat({"--case ", name, " is none of ", absl::StrJoin(ServiceNames(), ", ")}));
    }
  }
  FP_ASSIGN_OR_RETURN(const FarmPrograms programs, FarmPrograms::Find(options.bin_dir));
  const ServiceContext context{.options = options, .programs = programs, .progress = progress};
  ServiceReport report;
  report.options = options;
  report.date_utc = DateUtc();
  report.cpu = CpuModel();
  report.cores = std::thread::hardware_concurrency();
  report.load_average_start = LoadAverage();
  for (const Case& one : kCases) {
    if (!options.cases.empty() &&
        std::find(options.cases.begin(), options.cases.end(), one.name) == options.cases.end()) {
      continue;
    }
    progress(Concat({one.name, " …"}));
    ServiceResult result;
    result.name = one.name;
    result.check = one.check;
    const Stopwatch watch;
    const absl::Status status = one.run(context, result);
    if (!status.ok()) result.error = status.ToString();
    result.seconds = watch.seconds();
    result.load_average = LoadAverage();
    progress(absl::StrFormat("%s: %d checks, %d fail, %d late, %.1f s", one.name,
                             result.checks.size(), result.failures(), result.late(),
                             result.seconds));
    report.results.push_back(std::move(result));
  }
  report.load_average_end = LoadAverage();
  return report;
}

}  // namespace farpoint

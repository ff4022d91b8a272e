#include "server/tile_scheduler.h"

#include <algorithm>
#include <iterator>

#include "core/base/check.h"

namespace farpoint {

namespace {

constexpr size_t kRememberedLeases = 4096;
constexpr size_t kRememberedDurations = 256;
// Slowness is judged against a median of at least so many tiles.
constexpr size_t kDurationsForSlowness = 4;
// A worker so much slower than the one that asks gives up its tile to it.
constexpr double kMuchSlower = 2;
constexpr Duration kWorthCopying = std::chrono::milliseconds(200);
// For each lease of a job that is looked at: some hundred times what that takes.
constexpr Duration kCopySearch = std::chrono::microseconds(20);
constexpr size_t kManyLeases = 64;
// How long a vanished worker counts as a sign that the farm, not a tile, is at fault.
constexpr Duration kStormWindow = std::chrono::minutes(10);
constexpr size_t kStormFactor = 3;
constexpr uint32_t kStormTries = 4;
// A render thread that uses less than this part of one core does not compute.
constexpr double kBusyFraction = 0.01;
constexpr uint32_t kMostDoublings = 6;

double Seconds(Duration d) { return std::chrono::duration<double>(d).count(); }

std::string SecondsText(Duration d) {
  return std::to_string(std::chrono::duration_cast<std::chrono::milliseconds>(d).count()) + " ms";
}

// What the worker itself is not to blame for and trying again cannot change: the job is wrong.
bool IsPermanent(absl::StatusCode code) {
  switch (code) {
    case absl::StatusCode::kInvalidArgument:
    case absl::StatusCode::kFailedPrecondition:
    case absl::StatusCode::kOutOfRange:
    case absl::StatusCode::kUnimplemented:
      return true;
    default:
      return false;
  }
}

}  // namespace

bool TileScheduler::Audit::HasOpinionOf(const std::string& owner) const {
  for (const auto& [digest, workers] : opinions) {
    for (const auto& [id, hello] : workers) {
      if (OwnerOf(hello) == owner) return true;
    }
  }
  return false;
}

// Names of certified workers begin with the certificate's.
bool TileScheduler::IsOf(const std::string& name, const WorkerHello& owner) {
  if (owner.certified_as.empty()) return name == owner.name;
  return name == owner.certified_as || name.starts_with(owner.certified_as + "/");
}

bool TileScheduler::Rank::operator<(const Rank& other) const {
  if (priority != other.priority) return priority > other.priority;
  if (number != other.number) return number < other.number;
  return id < other.id;
}

TileScheduler::TileScheduler(const SchedulerOptions& options, const Clock& clock)
    : options_(options), clock_(clock) {
  std::random_device random;
  epoch_ = (uint64_t{random()} << 32) | random();
  random_.seed(options.audit_seed != 0 ? options.audit_seed
                                       : (uint64_t{random()} << 32) | random());
}

// --- Jobs ------------------------------------------------------------------------------------

void TileScheduler::AddJob(const ScheduledJob& spec) {
  FP_CHECK(!jobs_.contains(spec.id));
  FP_CHECK(spec.committed_by.empty() || spec.committed_by.size() == spec.committed.size());
  Job job;
  job.spec = spec;
  job.spec.committed_by.clear();
  job.fingerprint = spec.fingerprint;
  job.tiles.resize(spec.tiles);
  job.names.emplace_back();
  std::map<std::string, uint32_t> names{{"", 0}};
  for (size_t i = 0; i < spec.committed.size(); ++i) {
    const uint32_t tile = spec.committed[i];
    FP_CHECK(tile < spec.tiles && job.tiles[tile].state == TileState::kQueued);
    job.tiles[tile].state = TileState::kCommitted;
    if (spec.committed_by.empty()) continue;
    const auto [name, added] =
        names.emplace(spec.committed_by[i], static_cast<uint32_t>(job.names.size()));
    if (added) job.names.push_back(name->first);
    job.tiles[tile].committed_by = name->second;
  }
  for (uint32_t i = 0; i < spec.tiles; ++i) {
    job.tiles[i].open = spec.open;
    if (spec.open && job.tiles[i].state == TileState::kQueued) {
      job.queued.insert(job.queued.end(), i);
    }
  }
  job.counts.total = spec.tiles;
  job.counts.committed = static_cast<uint32_t>(spec.committed.size());
  job.counts.queued = spec.tiles - job.counts.committed;
  if (spec.paused) job.paused_at = clock_.Now();
  RestartTimeLeft(job);
  Rerank(jobs_.emplace(spec.id, std::move(job)).first->second);
}

void TileScheduler::RemoveJob(const JobId& id) {
  const auto at = jobs_.find(id);
  if (at == jobs_.end()) return;
  const std::set<LeaseId> ending = at->second.leases;
  for (const LeaseId& lease : ending) EndLease(lease);
  Unrank(at->second);
  started_.erase(id);
  jobs_.erase(at);
}

void TileScheduler::OpenTiles(const JobId& id, uint32_t first, uint32_t count) {
  const auto at = jobs_.find(id);
  if (at == jobs_.end()) return;
  Job& job = at->second;
  FP_CHECK(first <= job.tiles.size() && count <= job.tiles.size() - first);
  for (uint32_t tile = first; tile < first + count; ++tile) {
    job.tiles[tile].open = true;
    if (job.tiles[tile].state == TileState::kQueued) job.queued.insert(tile);
  }
  Rerank(job);
}

void TileScheduler::SetPaused(const JobId& id, bool paused) {
  const auto at = jobs_.find(id);
  if (at == jobs_.end()) return;
  Job& job = at->second;
  if (paused == job.paused_at.has_value()) return;
  const TimePoint now = clock_.Now();
  if (paused) {
    job.paused_at = now;
  } else {
    if (job.started) *job.started += now - std::max(*job.paused_at, *job.started);
    job.paused_at.reset();
  }
  Rerank(job);
}

void TileScheduler::SetPriority(const JobId& id, int32_t priority) {
  const auto at = jobs_.find(id);
  if (at == jobs_.end()) return;
  Unrank(at->second);
  at->second.spec.priority = priority;
  Rerank(at->second);
}

void TileScheduler::ForgetFailures(const JobId& id) {
  const auto at = jobs_.find(id);
  if (at == jobs_.end()) return;
  Job& job = at->second;
  for (uint32_t i = 0; i < job.tiles.size(); ++i) {
    Tile& tile = job.tiles[i];
    tile.failures = 0;
    tile.dead.clear();
    if (tile.state == TileState::kFailed) SetState(job, i, TileState::kQueued);
  }
  job.causes.clear();
  job.permanent.clear();
}

TileCounts TileScheduler::Counts(const JobId& id) const {
  const auto at = jobs_.find(id);
  return at == jobs_.end() ? TileCounts{} : at->second.counts;
}

double TileScheduler::Progress(const JobId& id) const {
  const auto at = jobs_.find(id);
  if (at == jobs_.end() || at->second.counts.total == 0) return 0;
  const Job& job = at->second;
  double done = job.counts.committed;
  for (const LeaseId& lease : job.leases) {
    const LiveLease& live = leases_.at(lease);
    if (live.grant.speculative || live.grant.audit) continue;
    done += std::clamp<double>(live.progress.fraction, 0, 1);
  }
  return std::min(1.0, done / job.counts.total);
}

std::optional<double> TileScheduler::EtaSeconds(const JobId& id) const {
  const auto at = jobs_.find(id);
  if (at == jobs_.end()) return std::nullopt;
  const Job& job = at->second;
  if (job.counts.committed == job.counts.total) return 0;
  if (!job.started || job.paused_at) return std::nullopt;
  return job.time_left.SecondsLeft(ElapsedSeconds(job) - job.time_left_from_s);
}

double TileScheduler::ElapsedSeconds(const Job& job) const {
  if (!job.started) return 0;
  return std::max(0.0, Seconds(job.paused_at.value_or(clock_.Now()) - *job.started));
}

void TileScheduler::RestartTimeLeft(Job& job) const {
  std::vector<uint32_t> done;
  for (uint32_t i = 0; i < job.tiles.size(); ++i) {
    if (job.tiles[i].state == TileState::kCommitted) done.push_back(i);
  }
  job.time_left = TimeLeft(job.spec.tiles, job.spec.frame_tiles, job.spec.frame_rects, done,
                           job.spec.usual_share);
  job.time_left_from_s = ElapsedSeconds(job);
}

uint64_t TileScheduler::Reissued(const JobId& id) const {
  const auto at = jobs_.find(id);
  return at == jobs_.end() ? 0 : at->second.reissued;
}
uint64_t TileScheduler::Refused(const JobId& id) const {
  const auto at = jobs_.find(id);
  return at == jobs_.end() ? 0 : at->second.refused;
}

uint32_t TileScheduler::Leasable(const JobId& id) const {
  const auto at = jobs_.find(id);
  return at == jobs_.end() ? 0 : static_cast<uint32_t>(at->second.queued.size());
}

JobReport TileScheduler::Report(const JobId& id) const {
  JobReport report;
  const auto at = jobs_.find(id);
  if (at == jobs_.end()) return report;
  const Job& job = at->second;
  report.leasable = static_cast<uint32_t>(job.queued.size());
  report.fingerprint = job.fingerprint;
  report.audits_open = static_cast<uint32_t>(job.audits.size());
  report.audits_done = job.audits_done;
  report.audits_differ = job.audits_differ;
  const TimePoint now = clock_.Now();
  for (const LeaseId& lease : job.leases) {
    const LiveLease& live = leases_.at(lease);
    if (live.grant.audit) continue;
    report.in_work.push_back({.grant = live.grant,
                              .worker_name = NameOfWorker(live.grant.worker),
                              .seconds = Seconds(now - live.started),
                              .fraction = std::clamp(live.progress.fraction, 0.0f, 1.0f)});
  }
  std::stable_sort(report.in_work.begin(), report.in_work.end(),
                   [](const TileInWork& a, const TileInWork& b) { return a.seconds > b.seconds; });
  for (const auto& [tile, cause] : job.causes) {
    const Tile& t = job.tiles[tile];
    if (t.state == TileState::kCommitted || t.failures == 0) continue;
    report.troubled.push_back({.tile = tile,
                               .failures = t.failures,
                               .workers = static_cast<uint32_t>(t.dead.size()),
                               .cause = cause,
                               .set_aside = t.state == TileState::kFailed});
  }
  return report;
}

AuditState TileScheduler::Audits(const JobId& id) const {
  const auto at = jobs_.find(id);
  if (at == jobs_.end()) return AuditState::kNone;
  bool undecided = false;
  for (const auto& [tile, audit] : at->second.audits) {
    if (audit.lease || SomeWorkerCouldAudit(at->second, audit)) return AuditState::kOpen;
    if (!audit.disputed_at) continue;
    if (clock_.Now() - *audit.disputed_at < options_.decide_time) return AuditState::kOpen;
    undecided = true;
  }
  return undecided ? AuditState::kUndecided : AuditState::kNone;
}

bool TileScheduler::MayGiveUp(const JobId& id) const {
  const auto at = jobs_.find(id);
  return at == jobs_.end() || clock_.Now() >= at->second.comeback_until;
}

bool TileScheduler::IsCommitted(const JobId& id, uint32_t tile) const {
  const auto at = jobs_.find(id);
  return at != jobs_.end() && tile < at->second.tiles.size() &&
         at->second.tiles[tile].state == TileState::kCommitted;
}

std::vector<uint32_t> TileScheduler::DisputedTiles(const JobId& id) const {
  std::vector<uint32_t> tiles;
  const auto at = jobs_.find(id);
  if (at == jobs_.end()) return tiles;
  for (const auto& [tile, audit] : at->second.audits) {
    if (audit.disputed_at) tiles.push_back(tile);
  }
  return tiles;
}

void TileScheduler::SetState(Job& job, uint32_t tile, TileState state) {
  const auto count = [&](TileState s) -> uint32_t& {
    switch (s) {
      case TileState::kQueued:
        return job.counts.queued;
      case TileState::kLeased:
        return job.counts.leased;
      case TileState::kCommitted:
        return job.counts.committed;
      case TileState::kFailed:
        break;
    }
    return job.counts.failed;
  };
  TileState& now = job.tiles[tile].state;
  --count(now);
  ++count(state);
  if (now == TileState::kQueued) {
    job.queued.erase(tile);
    job.again.erase(tile);
  }
  if (state == TileState::kQueued && job.tiles[tile].open) {
    job.queued.insert(tile);
    if (job.tiles[tile].attempts > 0) job.again.insert(tile);
  }
  now = state;
  Rerank(job);
}

void TileScheduler::Rerank(const Job& job) {
  const Rank rank = RankOf(job);
  const auto enter = [&rank](std::set<Rank>& ranks, bool in) {
    if (in) {
      ranks.insert(rank);
    } else {
      ranks.erase(rank);
    }
  };
  const bool goes = !job.paused_at;
  enter(ready_, goes && !job.queued.empty());
  enter(working_, goes && !job.leases.empty());
  enter(auditing_, goes && !job.audits.empty());
}

void TileScheduler::Unrank(const Job& job) {
  const Rank rank = RankOf(job);
  for (std::set<Rank>* ranks : {&ready_, &working_, &auditing_}) ranks->erase(rank);
}

// --- Workers ---------------------------------------------------------------------------------

void TileScheduler::AddWorker(const WorkerId& id, const WorkerHello& hello) {
  FP_CHECK(!workers_.contains(id));
  Worker worker;
  worker.hello = hello;
  worker.heard = clock_.Now();
  worker.convicted = IsConvicted(hello);
  const std::string name = hello.name.empty() ? id.value : hello.name;
  worker.hello.name = name;
  const auto taken = [&] {
    return std::any_of(workers_.begin(), workers_.end(), [&](const auto& other) {
      return other.second.hello.name == worker.hello.name && IsThere(other.second);
    });
  };
  for (int number = 2; taken(); ++number) {
    worker.hello.name = name + "#" + std::to_string(number);
  }
  workers_.emplace(id, std::move(worker));
}

// A worker that vanished and is heard of again did not die of the tile that it had.
void TileScheduler::Heard(const WorkerId& id, Worker& worker) {
  worker.heard = clock_.Now();
  if (worker.vanished_from.empty()) return;
  for (const auto& [job_id, tile_index] : worker.vanished_from) {
    std::erase_if(vanished_, [&](const Vanishing& v) {
      return v.worker == id && v.job == job_id && v.tile == tile_index;
    });
    if (worker.failures > 0) --worker.failures;
    if (worker.failures_in_a_row > 0) --worker.failures_in_a_row;
    const auto job = jobs_.find(job_id);
    if (job == jobs_.end()) continue;
    Tile& tile = job->second.tiles[tile_index];
    if (!tile.dead.contains(id)) continue;
    tile.dead.erase(id);
    if (tile.failures > 0) --tile.failures;
    if (tile.state == TileState::kFailed && tile.dead.size() < options_.max_dead_workers &&
        tile.failures < options_.max_tile_failures) {
      SetState(job->second, tile_index, TileState::kQueued);
    }
  }
  worker.vanished_from.clear();
  if (!worker.convicted && worker.failures_in_a_row < options_.max_worker_failures) {
    worker.set_aside_until.reset();
  }
}

bool TileScheduler::Touch(const WorkerId& id) {
  const auto at = workers_.find(id);
  if (at == workers_.end()) return false;
  Heard(id, at->second);
  return true;
}

uint64_t TileScheduler::Connected(const WorkerId& id) {
  const auto at = workers_.find(id);
  if (at == workers_.end()) return 0;
  at->second.connection = next_connection_++;
  at->second.disconnected_at.reset();
  Heard(id, at->second);
  return at->second.connection;
}

void TileScheduler::Disconnected(const WorkerId& id, uint64_t connection) {
  const auto at = workers_.find(id);
  if (at == workers_.end() || at->second.connection != connection) return;
  at->second.disconnected_at = clock_.Now();
}

void TileScheduler::RemoveWorker(const WorkerId& id) {
  const auto at = workers_.find(id);
  if (at == workers_.end()) return;
  const std::set<LeaseId> ending = at->second.leases;
  for (const LeaseId& lease : ending) {
    // A result that is being stored counts even if its worker has left.
    if (!leases_.at(lease).committing) EndLease(lease);
  }
  EraseWorker(id);
}

void TileScheduler::EraseWorker(const WorkerId& id) {
  workers_.erase(id);
  for (const JobId& job : started_) jobs_.at(job).last_tiles.erase(id);
}

std::vector<WorkerStatus> TileScheduler::Workers() const {
  std::vector<WorkerStatus> all;
  for (const auto& [id, worker] : workers_) {
    WorkerStatus status;
    status.id = id;
    status.name = worker.hello.name;
    status.version = worker.hello.version;
    status.threads = worker.hello.threads;
    status.fingerprint = worker.hello.fingerprint;
    status.leases = static_cast<uint32_t>(worker.leases.size());
    status.committed = worker.committed;
    status.failures = worker.failures;
    status.set_aside = IsSetAside(worker);
    status.idle_s = Seconds(clock_.Now() - worker.heard);
    status.gone = !IsThere(worker);
    all.push_back(std::move(status));
  }
  return all;
}

const WorkerHello* TileScheduler::FindWorker(const WorkerId& id) const {
  const auto at = workers_.find(id);
  return at == workers_.end() ? nullptr : &at->second.hello;
}

std::string TileScheduler::NameOfWorker(const WorkerId& id) const {
  const WorkerHello* const hello = FindWorker(id);
  return hello == nullptr || hello->name.empty() ? id.value : hello->name;
}

bool TileScheduler::IsSetAside(const Worker& worker) const {
  return worker.convicted || (worker.set_aside_until && clock_.Now() < *worker.set_aside_until);
}

// Neither silent nor cut off. One that was heard of after its connection broke is there.
bool TileScheduler::IsThere(const Worker& worker) const {
  if (worker.disconnected_at && worker.heard <= *worker.disconnected_at) return false;
  return clock_.Now() - worker.heard < options_.silence_time;
}

bool TileScheduler::TakesFingerprint(const Job& job, const Worker& worker) const {
  return job.fingerprint.empty() || job.fingerprint == worker.hello.fingerprint;
}

// --- Leases ----------------------------------------------------------------------------------

bool TileScheduler::AnotherWorkerCouldTake(const Job& job, const Tile& tile,
                                           const WorkerId& but) const {
  for (const auto& [id, worker] : workers_) {
    if (id == but || IsSetAside(worker) || tile.dead.contains(id)) continue;
    if (TakesFingerprint(job, worker) && IsThere(worker)) return true;
  }
  return false;
}

bool TileScheduler::IsAlone(const Job& job, const WorkerId& but) const {
  return std::none_of(workers_.begin(), workers_.end(), [&](const auto& entry) {
    const auto& [id, worker] = entry;
    return id != but && !IsSetAside(worker) && TakesFingerprint(job, worker) && IsThere(worker);
  });
}

bool TileScheduler::SomeWorkerCouldAudit(const Job& job, const Audit& audit) const {
  for (const auto& [id, worker] : workers_) {
    if (IsSetAside(worker) || audit.HasOpinionOf(OwnerOf(worker.hello))) continue;
    if (TakesFingerprint(job, worker) && IsThere(worker)) return true;
  }
  return false;
}

LeaseGrant TileScheduler::Grant(const WorkerId& worker, Job& job, uint32_t tile, bool speculative,
                                bool audit) {
  const TimePoint now = clock_.Now();
  LiveLease live;
  char name[48];
  std::snprintf(name, sizeof(name), "%016llx-%llu", static_cast<unsigned long long>(epoch_),
                static_cast<unsigned long long>(next_lease_++));
  live.grant = {.lease = {name},
                .worker = worker,
                .job = job.spec.id,
                .tile = tile,
                .attempt = ++job.tiles[tile].attempts,
                .speculative = speculative,
                .careful = job.tiles[tile].failures > 0,
                .audit = audit};
  live.started = live.heard = live.progressed = live.busy = live.stepped = now;
  if (!job.started) {
    job.started = now;
    started_.insert(job.spec.id);
  }
  const LeaseGrant grant = live.grant;
  leases_.emplace(grant.lease, std::move(live));
  workers_.at(worker).leases.insert(grant.lease);
  job.leases.insert(grant.lease);
  if (audit) {
    job.audits.at(tile).lease = grant.lease;
  } else {
    job.tiles[tile].leases.push_back(grant.lease);
    if (!speculative) {
      job.last_tiles[worker] = tile;
      SetState(job, tile, TileState::kLeased);
    }
  }
  Rerank(job);
  return grant;
}

std::optional<LeaseGrant> TileScheduler::Lease(const WorkerId& id) {
  const auto at = workers_.find(id);
  if (at == workers_.end()) return std::nullopt;
  Worker& worker = at->second;
  Heard(id, worker);
  // A worker has one tile at a time. If it asks while we think that it has one, the answer that
  // granted it was lost on its way.
  const std::set<LeaseId> unheard_of = worker.leases;
  for (const LeaseId& lease : unheard_of) {
    if (leases_.at(lease).committing) continue;
    ++jobs_.at(leases_.at(lease).grant.job).reissued;
    EndLease(lease);
  }
  if (IsSetAside(worker)) return std::nullopt;

  if (auto grant = LeaseAudit(id, worker)) return grant;
  for (const Rank& rank : ready_) {
    Job& job = jobs_.at(rank.id);
    if (!TakesFingerprint(job, worker)) continue;
    if (const std::optional<uint32_t> tile = PickTile(job, id)) {
      return Grant(id, job, *tile, false, false);
    }
  }
  return LeaseCopy(id, worker);
}

std::optional<uint32_t> TileScheduler::PickTile(Job& job, const WorkerId& id) {
  const auto takes = [&](uint32_t tile) {
    const Tile& candidate = job.tiles[tile];
    return !candidate.dead.contains(id) || !AnotherWorkerCouldTake(job, candidate, id);
  };
  for (const uint32_t tile : job.again) {
    if (takes(tile)) return tile;
  }
  if (job.again.size() == job.queued.size()) return std::nullopt;
  // The others were never leased, so they have not failed on anybody.
  const auto fresh_from = [&](uint32_t from) -> std::optional<uint32_t> {
    for (auto at = job.queued.lower_bound(from); at != job.queued.end(); ++at) {
      if (!job.again.contains(*at)) return *at;
    }
    return std::nullopt;
  };
  const uint32_t first = *fresh_from(0);
  const uint32_t frame = job.spec.frame_tiles == 0 ? job.spec.tiles : job.spec.frame_tiles;
  const uint32_t end = std::min((first / frame + 1) * frame, job.spec.tiles);
  if (IsAlone(job, id)) {
    // Multiples of the golden ratio, which leave no large part of a frame, nor of its rows, unseen.
    const uint32_t at = job.begun++ * 2654435769u;
    const uint32_t begin = end - std::min(frame, end);
    const auto tile = fresh_from(begin + static_cast<uint32_t>(uint64_t{end - begin} * at >> 32));
    return tile && *tile < end ? *tile : first;
  }
  const auto last = job.last_tiles.find(id);
  if (last != job.last_tiles.end() && last->second + 1 < job.tiles.size()) {
    const uint32_t next = last->second + 1;
    if (next / frame == first / frame && job.queued.contains(next) && !job.again.contains(next)) {
      return next;
    }
  }
  // Halves, quarters, eighths … of what is left of the first frame that is not done.
  uint32_t reversed = 0;
  uint32_t number = job.begun++;
  for (int bit = 0; bit < 16; ++bit, number >>= 1) reversed = reversed << 1 | (number & 1);
  const auto offset = static_cast<uint32_t>(uint64_t{end - first} * reversed >> 16);
  const std::optional<uint32_t> tile = fresh_from(first + offset);
  return tile && *tile < end ? *tile : first;
}

std::optional<LeaseGrant> TileScheduler::LeaseAudit(const WorkerId& id, const Worker& worker) {
  const std::string owner = OwnerOf(worker.hello);
  for (const Rank& rank : auditing_) {
    Job& job = jobs_.at(rank.id);
    if (!TakesFingerprint(job, worker)) continue;
    for (const auto& [tile, audit] : job.audits) {
      if (!audit.lease && !audit.HasOpinionOf(owner)) return Grant(id, job, tile, false, true);
    }
  }
  return std::nullopt;
}

// Nothing is queued for this worker: the slowest tile, if it is slow, or is known to become so.
std::optional<LeaseGrant> TileScheduler::LeaseCopy(const WorkerId& id, const Worker& worker) {
  const TimePoint now = clock_.Now();
  for (const Rank& rank : working_) {
    Job& job = jobs_.at(rank.id);
    if (!TakesFingerprint(job, worker) || job.durations.empty()) continue;
    // Hundreds of idle workers ask several times a second, and each would look at hundreds of
    // leases.
    if (job.leases.size() >= kManyLeases) {
      if (now < job.copies_after) continue;
      job.copies_after = now + kCopySearch * job.leases.size();
    }
    const Duration slow =
        std::max(options_.speculate_after,
                 std::chrono::duration_cast<Duration>(job.median * options_.speculate_factor));
    const LiveLease* slowest = nullptr;
    for (const LeaseId& lease : job.leases) {
      const LiveLease& live = leases_.at(lease);
      if (live.grant.audit || live.grant.worker == id || live.committing) continue;
      const Tile& tile = job.tiles[live.grant.tile];
      if (tile.leases.size() > 1 || tile.dead.contains(id)) continue;
      const Duration age = now - live.started;
      const auto holder = workers_.find(live.grant.worker);
      const double slowness = holder == workers_.end() ? 1 : holder->second.slowness;
      const auto left = std::chrono::duration_cast<Duration>(job.median * slowness) - age;
      const auto needed = std::chrono::duration_cast<Duration>(job.median * worker.slowness);
      const bool known_slow = job.durations.size() >= kDurationsForSlowness &&
                              slowness >= kMuchSlower * worker.slowness &&
                              left > needed + kWorthCopying;
      if (age < slow && !known_slow) continue;
      if (slowest == nullptr || live.started < slowest->started) slowest = &live;
    }
    if (slowest != nullptr) return Grant(id, job, slowest->grant.tile, true, false);
  }
  return std::nullopt;
}

RenewAnswer TileScheduler::Renew(const WorkerId& worker, const LeaseId& lease,
                                 const LeaseProgress& progress) {
  Touch(worker);
  const auto at = leases_.find(lease);
  if (at == leases_.end() || at->second.grant.worker != worker) {
    return {.drop = true, .reason = "the lease has ended"};
  }
  LiveLease& live = at->second;
  const TimePoint now = clock_.Now();
  live.heard = now;
  // Computing is a sign of life, though not progress: a block may take long.
  const double used = std::chrono::duration<double>(progress.cpu - live.busy_cpu).count();
  if (!progress.rendering || progress.cpu.count() == 0 ||
      progress.counter > live.progress.counter ||
      used >= kBusyFraction * Seconds(now - live.busy)) {
    live.busy = now;
    live.busy_cpu = progress.cpu;
  }
  if (!progress.rendering || progress.pulse == 0 || progress.pulse != live.progress.pulse ||
      progress.counter > live.progress.counter) {
    live.stepped = now;
    live.stepped_cpu = progress.cpu;
  }
  if (progress.counter > live.progress.counter) live.progressed = now;
  if (progress.counter >= live.progress.counter) live.progress = progress;
  return {};
}

absl::StatusOr<LeaseGrant> TileScheduler::BeginCommit(const WorkerId& worker, const LeaseId& lease,
                                                      uint32_t attempt) {
  Touch(worker);
  const auto refuse = [this](const JobId& job, const std::string& reason) {
    const auto at = jobs_.find(job);
    if (at != jobs_.end()) ++at->second.refused;
    return absl::FailedPreconditionError(reason);
  };
  const auto at = leases_.find(lease);
  if (at == leases_.end()) {
    const auto ended = ended_.find(lease);
    return refuse(ended == ended_.end() ? JobId{} : ended->second, "the lease has ended");
  }
  LiveLease& live = at->second;
  if (live.grant.worker != worker) {
    return refuse(live.grant.job, "the lease belongs to another worker");
  }
  if (live.grant.attempt != attempt) {
    return refuse(live.grant.job, "attempt " + std::to_string(attempt) + " is not the lease's " +
                                      std::to_string(live.grant.attempt));
  }
  if (live.committing) return refuse(live.grant.job, "a result of this tile is being stored");
  Job& job = jobs_.at(live.grant.job);
  for (const LeaseId& other : job.tiles[live.grant.tile].leases) {
    if (leases_.at(other).committing) {
      return refuse(live.grant.job, "a result of this tile is being stored");
    }
  }
  const auto by = workers_.find(worker);
  if (by == workers_.end() || !TakesFingerprint(job, by->second)) {
    return refuse(live.grant.job, "the job's tiles have another fingerprint");
  }
  // Two first tiles may be stored at a time: the one that came first decides.
  job.fingerprint = by->second.hello.fingerprint;
  live.committing = true;
  return live.grant;
}

void TileScheduler::RememberDuration(Job& job, Duration took) {
  if (job.durations.size() < kRememberedDurations) {
    job.durations.push_back(took);
  } else {
    job.durations[job.committed_here % kRememberedDurations] = took;
  }
  std::vector<Duration> durations = job.durations;
  const auto middle = durations.begin() + static_cast<ptrdiff_t>(durations.size() / 2);
  std::nth_element(durations.begin(), middle, durations.end());
  job.median = *middle;
}

bool TileScheduler::FinishCommit(const LeaseId& lease, bool durable, const Digest& result) {
  const auto at = leases_.find(lease);
  if (at == leases_.end()) return false;
  const LiveLease live = at->second;
  FP_CHECK(live.committing && !live.grant.audit);
  Job& job = jobs_.at(live.grant.job);
  if (!durable || live.doomed) {
    EndLease(lease);
    ++job.reissued;
    ForgetUnusedFingerprint(job);
    return !live.doomed;
  }
  const Duration took = clock_.Now() - live.started;
  const auto by = workers_.find(live.grant.worker);
  if (by != workers_.end()) {
    Worker& worker = by->second;
    ++worker.committed;
    worker.failures_in_a_row = 0;
    worker.set_aside_until.reset();
    if (job.durations.size() >= kDurationsForSlowness && job.median.count() > 0) {
      const double ratio = Seconds(took) / Seconds(job.median);
      worker.slowness = std::clamp((worker.slowness + ratio) / 2, 0.01, 1000.0);
    }
  }
  RememberDuration(job, took);
  ++job.committed_here;
  job.time_left.Commit(live.grant.tile, ElapsedSeconds(job) - job.time_left_from_s);
  Tile& tile = job.tiles[live.grant.tile];
  const std::string name = NameOfWorker(live.grant.worker);
  const auto known = std::find(job.names.begin(), job.names.end(), name);
  tile.committed_by = static_cast<uint32_t>(known - job.names.begin());
  if (known == job.names.end()) job.names.push_back(name);
  SetState(job, live.grant.tile, TileState::kCommitted);
  const std::vector<LeaseId> ending = tile.leases;
  for (const LeaseId& one : ending) EndLease(one);
  if (options_.audit_fraction > 0 &&
      std::uniform_real_distribution<double>(0, 1)(random_) < options_.audit_fraction) {
    Audit audit;
    WorkerHello hello = by == workers_.end() ? WorkerHello{} : by->second.hello;
    hello.name = name;
    audit.opinions[result].emplace(live.grant.worker, std::move(hello));
    audit.committed = result;
    job.audits[live.grant.tile] = std::move(audit);
    Rerank(job);
  }
  if (job.counts.committed > 1) return true;

  // The first tile decides the job's fingerprint: others' leases cannot count any more.
  const std::set<LeaseId> leases = job.leases;
  for (const LeaseId& id : leases) {
    const auto holder = workers_.find(leases_.at(id).grant.worker);
    if (holder != workers_.end() && holder->second.hello.fingerprint != job.fingerprint) {
      EndLease(id);
    }
  }
  return true;
}

AuditVerdict TileScheduler::FinishAudit(const LeaseId& lease, const Digest& result) {
  AuditVerdict verdict;
  const auto at = leases_.find(lease);
  if (at == leases_.end()) return verdict;
  const LiveLease live = at->second;
  FP_CHECK(live.committing && live.grant.audit);
  EndLease(lease);
  Job& job = jobs_.at(live.grant.job);
  const auto found = job.audits.find(live.grant.tile);
  if (live.doomed || found == job.audits.end()) return verdict;
  verdict.counted = true;
  Audit& audit = found->second;
  WorkerHello voter;
  if (const auto by = workers_.find(live.grant.worker); by != workers_.end()) {
    ++by->second.committed;
    by->second.failures_in_a_row = 0;
    voter = by->second.hello;
  }
  voter.name = NameOfWorker(live.grant.worker);
  const Digest committed = audit.committed;
  audit.opinions[result].emplace(live.grant.worker, std::move(voter));
  const auto agreed = std::find_if(audit.opinions.begin(), audit.opinions.end(),
                                   [](const auto& opinion) { return opinion.second.size() >= 2; });
  if (agreed == audit.opinions.end()) {
    if (!audit.disputed_at) {
      ++job.audits_differ;
      audit.disputed_at = clock_.Now();
    }
    verdict.disputed = true;
    return verdict;
  }
  ++job.audits_done;
  verdict.agreed = agreed->first == committed;
  std::map<WorkerId, WorkerHello> wrong;
  for (const auto& [digest, workers] : audit.opinions) {
    if (digest != agreed->first) wrong.insert(workers.begin(), workers.end());
  }
  job.audits.erase(found);
  Rerank(job);
  for (const auto& [id, hello] : wrong) Convict(id, hello, verdict);
  return verdict;
}

void TileScheduler::Convict(const WorkerId& id, const WorkerHello& hello, AuditVerdict& verdict) {
  verdict.convicted.push_back({.id = id, .name = hello.name, .certified_as = hello.certified_as});
  const std::string owner = OwnerOf(hello);
  convicts_.insert(owner);
  for (auto& [other, worker] : workers_) {
    if (other != id && OwnerOf(worker.hello) != owner) continue;
    worker.convicted = true;
    const std::set<LeaseId> ending = worker.leases;
    for (const LeaseId& lease : ending) {
      LiveLease& live = leases_.at(lease);
      if (live.committing) {
        live.doomed = true;
      } else {
        EndLease(lease);
      }
    }
  }
  for (auto& [job_id, job] : jobs_) {
    std::vector<bool> theirs;
    for (const std::string& name : job.names) theirs.push_back(IsOf(name, hello));
    if (std::find(theirs.begin(), theirs.end(), true) == theirs.end()) continue;
    for (uint32_t i = 0; i < job.tiles.size(); ++i) {
      Tile& tile = job.tiles[i];
      if (tile.state != TileState::kCommitted || !theirs[tile.committed_by]) continue;
      if (const auto audit = job.audits.find(i); audit != job.audits.end()) {
        const std::optional<LeaseId> lease = audit->second.lease;
        if (lease && leases_.at(*lease).committing) {
          leases_.at(*lease).doomed = true;
        } else if (lease) {
          EndLease(*lease);
        }
        job.audits.erase(i);
      }
      tile.committed_by = 0;
      SetState(job, i, TileState::kQueued);
      verdict.reopened[job_id].push_back(i);
    }
    if (verdict.reopened.contains(job_id)) RestartTimeLeft(job);
    // If nothing else was committed, any fingerprint may begin again.
    ForgetUnusedFingerprint(job);
  }
}

void TileScheduler::ForgetUnusedFingerprint(Job& job) {
  if (job.counts.committed > 0) return;
  for (const LeaseId& lease : job.leases) {
    if (leases_.at(lease).committing) return;
  }
  job.fingerprint = {};
}

std::optional<LeaseGrant> TileScheduler::FindLease(const LeaseId& lease) const {
  const auto at = leases_.find(lease);
  if (at == leases_.end()) return std::nullopt;
  return at->second.grant;
}

JobId TileScheduler::JobOf(const LeaseId& lease) const {
  if (const auto at = leases_.find(lease); at != leases_.end()) return at->second.grant.job;
  const auto ended = ended_.find(lease);
  return ended == ended_.end() ? JobId{} : ended->second;
}

void TileScheduler::EndLease(const LeaseId& lease) {
  const auto at = leases_.find(lease);
  if (at == leases_.end()) return;
  const LeaseGrant grant = at->second.grant;
  leases_.erase(at);
  if (const auto worker = workers_.find(grant.worker); worker != workers_.end()) {
    worker->second.leases.erase(grant.lease);
  }
  Job& job = jobs_.at(grant.job);
  job.leases.erase(grant.lease);
  if (grant.audit) {
    const auto audit = job.audits.find(grant.tile);
    if (audit != job.audits.end() && audit->second.lease == grant.lease) {
      audit->second.lease.reset();
    }
  } else {
    Tile& tile = job.tiles[grant.tile];
    std::erase(tile.leases, grant.lease);
    if (tile.leases.empty() && tile.state == TileState::kLeased) {
      SetState(job, grant.tile, TileState::kQueued);
    } else if (tile.leases.size() == 1) {
      // The copy that is left is the tile's only attempt now: it may be copied again.
      leases_.at(tile.leases.front()).grant.speculative = false;
    }
  }
  Rerank(job);
  // A ring of the most recent ones.
  if (ended_order_.size() < kRememberedLeases) {
    ended_order_.push_back(grant.lease);
  } else {
    ended_.erase(ended_order_[ended_next_]);
    ended_order_[ended_next_] = grant.lease;
    ended_next_ = (ended_next_ + 1) % kRememberedLeases;
  }
  ended_[grant.lease] = grant.job;
}

void TileScheduler::FailJob(Job& job, absl::Status error, std::optional<uint32_t> tile,
                            SchedulerNews& news) {
  const std::set<LeaseId> ending = job.leases;
  for (const LeaseId& lease : ending) EndLease(lease);
  for (uint32_t i = 0; i < job.tiles.size(); ++i) {
    if (job.tiles[i].state == TileState::kQueued) SetState(job, i, TileState::kFailed);
  }
  job.audits.clear();
  Rerank(job);
  news.failed.push_back({job.spec.id, std::move(error), tile});
}

bool TileScheduler::IsPoison(const Job& job, uint32_t index) {
  const Tile& tile = job.tiles[index];
  if (tile.dead.size() < options_.max_dead_workers && tile.failures < options_.max_tile_failures) {
    return false;
  }
  std::erase_if(vanished_,
                [&](const Vanishing& v) { return clock_.Now() - v.when > kStormWindow; });
  const size_t here = static_cast<size_t>(
      std::count_if(vanished_.begin(), vanished_.end(),
                    [&](const Vanishing& v) { return v.job == job.spec.id && v.tile == index; }));
  const size_t elsewhere = vanished_.size() - here;
  if (tile.failures >= options_.max_tile_failures) {
    // Where workers die by the hundred, some tile loses as many of them by chance.
    return elsewhere <= kStormFactor * kStormFactor * here ||
           tile.failures >= options_.max_tile_failures + here ||
           tile.failures >= kStormTries * options_.max_tile_failures;
  }
  if (tile.dead.size() >= options_.max_dead_workers + here) return true;  // without them, too
  return elsewhere <= kStormFactor * here;
}

void TileScheduler::Blame(const LeaseGrant& grant, const std::string& cause, Fault fault,
                          SchedulerNews& news, LossCause loss) {
  LostLease lost{
      .grant = grant, .reason = cause, .cause = loss, .worker_name = NameOfWorker(grant.worker)};
  const auto by = workers_.find(grant.worker);
  if (by != workers_.end()) {
    Worker& worker = by->second;
    ++worker.failures;
    if (++worker.failures_in_a_row >= options_.max_worker_failures) {
      worker.set_aside_until = clock_.Now() + options_.set_aside_time;
      lost.worker_set_aside = true;
    }
  }
  news.lost.push_back(std::move(lost));
  Job& job = jobs_.at(grant.job);
  Tile& tile = job.tiles[grant.tile];
  ++job.reissued;
  // An audited tile has been rendered well once: whatever happens is not its fault.
  if (tile.state == TileState::kCommitted || tile.state == TileState::kFailed) return;
  ++tile.failures;
  tile.dead.insert(grant.worker);
  job.causes[grant.tile] = cause;
  if (fault == Fault::kVanished) {
    vanished_.push_back({clock_.Now(), grant.worker, grant.job, grant.tile});
    if (by != workers_.end()) by->second.vanished_from.emplace_back(grant.job, grant.tile);
  }
  if (!IsPoison(job, grant.tile)) return;
  const std::vector<LeaseId> ending = tile.leases;
  for (const LeaseId& lease : ending) {
    // A copy whose result is being stored may save the tile.
    if (leases_.at(lease).committing) return;
  }
  for (const LeaseId& lease : ending) EndLease(lease);
  SetState(job, grant.tile, TileState::kFailed);
  if (fault == Fault::kVanished) job.comeback_until = clock_.Now() + options_.comeback_time;
  news.set_aside.push_back({grant.job, grant.tile});
}

SchedulerNews TileScheduler::RefuseResult(const LeaseId& lease, const std::string& reason) {
  SchedulerNews news;
  const auto at = leases_.find(lease);
  if (at == leases_.end()) return news;
  const LeaseGrant grant = at->second.grant;
  ++jobs_.at(grant.job).refused;
  EndLease(lease);
  ForgetUnusedFingerprint(jobs_.at(grant.job));
  Blame(grant, reason, Fault::kReported, news);
  return news;
}

SchedulerNews TileScheduler::ReportFailure(const WorkerId& worker, const LeaseId& lease,
                                           bool given_back, const absl::Status& error) {
  SchedulerNews news;
  Touch(worker);
  const auto at = leases_.find(lease);
  if (at == leases_.end() || at->second.grant.worker != worker || at->second.committing) {
    return news;
  }
  const LeaseGrant grant = at->second.grant;
  EndLease(lease);
  if (given_back) {
    ++jobs_.at(grant.job).reissued;
    return news;
  }
  const std::string cause(error.message());
  if (IsPermanent(error.code()) && !grant.audit) {
    Job& job = jobs_.at(grant.job);
    if (const auto by = workers_.find(worker); by != workers_.end()) {
      job.permanent.insert(OwnerOf(by->second.hello));
    }
    // Another worker is asked first, if there is one.
    if (job.permanent.size() > 1 || !AnotherWorkerCouldTake(job, job.tiles[grant.tile], worker)) {
      FailJob(job, Annotate(error, "tile " + std::to_string(grant.tile)), grant.tile, news);
      return news;
    }
  }
  Blame(grant, cause, Fault::kReported, news);
  return news;
}

void TileScheduler::Forgive(Duration gap) {
  const TimePoint now = clock_.Now();
  for (auto& [id, live] : leases_) {
    live.heard = std::min(now, live.heard + gap);
    live.progressed = std::min(now, live.progressed + gap);
    live.busy = std::min(now, live.busy + gap);
    live.stepped = std::min(now, live.stepped + gap);
  }
  for (auto& [id, worker] : workers_) {
    worker.heard = std::min(now, worker.heard + gap);
    if (worker.disconnected_at) {
      worker.disconnected_at = std::min(now, *worker.disconnected_at + gap);
    }
  }
}

bool TileScheduler::GoesInCircles(const LiveLease& live) const {
  if (!live.progress.rendering || live.progress.pulse == 0) return false;
  const Job& job = jobs_.at(live.grant.job);
  const uint32_t failures = std::min(job.tiles[live.grant.tile].failures, kMostDoublings);
  const Duration patience = std::max(options_.stall_time, job.spec.step_time) * (1 << failures);
  const Duration still = live.heard - live.stepped;
  if (still < patience) return false;
  // Whose process is starved of processor time gets on slowly: that is no fault.
  return live.progress.cpu - live.stepped_cpu >= still / 2;
}

SchedulerNews TileScheduler::Tick() {
  SchedulerNews news;
  const TimePoint now = clock_.Now();
  struct Expired {
    LeaseGrant grant;
    std::string reason;
    Fault fault;
    LossCause cause;
  };
  std::vector<Expired> expired;
  for (const auto& [id, live] : leases_) {
    if (live.committing) continue;
    const auto expire = [&, &live = live](std::string reason, Fault fault, LossCause cause) {
      if (!live.progress.at.empty()) reason += "; the work was at " + live.progress.at;
      expired.push_back({live.grant, std::move(reason), fault, cause});
    };
    const auto holder = workers_.find(live.grant.worker);
    const std::optional<TimePoint> broke =
        holder == workers_.end() ? std::nullopt : holder->second.disconnected_at;
    if (broke && holder->second.heard <= *broke && now - *broke >= options_.reconnect_time) {
      expire("the connection to the worker broke", Fault::kVanished, LossCause::kDisconnected);
    } else if (now - live.heard >= options_.silence_time) {
      expire("nothing was heard of the worker for " + SecondsText(now - live.heard),
             Fault::kVanished, LossCause::kSilent);
    } else if (now - live.progressed >=
               std::max(options_.lease_time, jobs_.at(live.grant.job).spec.lease_time)) {
      expire("no progress for " + SecondsText(now - live.progressed), Fault::kReported,
             LossCause::kNoProgress);
    } else if (live.progress.rendering && live.heard - live.busy >= options_.stall_time) {
      expire("a render thread hangs: neither progress nor processor time for " +
                 SecondsText(now - live.busy),
             Fault::kReported, LossCause::kHung);
    } else if (GoesInCircles(live)) {
      expire("a render thread computes, but has not got on for " + SecondsText(now - live.stepped),
             Fault::kReported, LossCause::kHung);
    }
  }
  for (const Expired& one : expired) {
    // A tile that was set aside a moment ago took its leases with it.
    if (!leases_.contains(one.grant.lease)) continue;
    EndLease(one.grant.lease);
    Blame(one.grant, one.reason, one.fault, news, one.cause);
  }
  for (const JobId& id : started_) {
    Job& job = jobs_.at(id);
    if (job.paused_at || job.counts.queued + job.counts.leased == 0) continue;
    if (job.spec.max_time != Duration::max() && now - *job.started > job.spec.max_time) {
      FailJob(job,
              absl::ResourceExhaustedError("the job rendered longer than its limit of " +
                                           SecondsText(job.spec.max_time) +
                                           "; raise limits.max_seconds or render less"),
              std::nullopt, news);
    }
  }
  for (const auto& [id, worker] : workers_) {
    if (worker.leases.empty() && now - worker.heard >= options_.forget_worker_after) {
      news.forgotten.push_back(id);
    }
  }
  for (const WorkerId& id : news.forgotten) EraseWorker(id);
  return news;
}

}  // namespace farpoint

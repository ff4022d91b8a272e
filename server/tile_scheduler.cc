#include "server/tile_scheduler.h"

#include <algorithm>
#include <random>

#include "core/base/check.h"

namespace farpoint {

namespace {

constexpr size_t kRememberedLeases = 4096;
constexpr size_t kRememberedDurations = 256;

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

TileScheduler::TileScheduler(const SchedulerOptions& options, const Clock& clock)
    : options_(options), clock_(clock) {
  std::random_device random;
  epoch_ = (uint64_t{random()} << 32) | random();
}

// --- Jobs ------------------------------------------------------------------------------------

void TileScheduler::AddJob(const ScheduledJob& spec) {
  FP_CHECK(!jobs_.contains(spec.id));
  Job job;
  job.spec = spec;
  job.fingerprint = spec.fingerprint;
  job.tiles.resize(spec.tiles);
  for (uint32_t tile : spec.committed) {
    FP_CHECK(tile < spec.tiles && job.tiles[tile].state == TileState::kQueued);
    job.tiles[tile].state = TileState::kCommitted;
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
  jobs_.emplace(spec.id, std::move(job));
}

void TileScheduler::RemoveJob(const JobId& id) {
  const auto at = jobs_.find(id);
  if (at == jobs_.end()) return;
  std::vector<LeaseId> ending;
  for (const auto& [lease, live] : leases_) {
    if (live.grant.job == id) ending.push_back(lease);
  }
  for (const LeaseId& lease : ending) EndLease(lease);
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
}

void TileScheduler::SetPaused(const JobId& id, bool paused) {
  const auto at = jobs_.find(id);
  if (at == jobs_.end()) return;
  Job& job = at->second;
  if (paused == job.paused_at.has_value()) return;
  const TimePoint now = clock_.Now();
  if (paused) {
    job.paused_at = now;
    return;
  }
  if (job.started) *job.started += now - std::max(*job.paused_at, *job.started);
  job.paused_at.reset();
}

void TileScheduler::SetPriority(const JobId& id, int32_t priority) {
  const auto at = jobs_.find(id);
  if (at != jobs_.end()) at->second.spec.priority = priority;
}

void TileScheduler::ForgetFailures(const JobId& id) {
  const auto at = jobs_.find(id);
  if (at == jobs_.end()) return;
  Job& job = at->second;
  for (Tile& tile : job.tiles) {
    tile.failures = 0;
    tile.dead.clear();
  }
  job.causes.clear();
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
  for (const auto& [lease, live] : leases_) {
    if (live.grant.job != id || live.grant.speculative) continue;
    done += std::clamp<double>(live.progress.fraction, 0, 1);
  }
  return std::min(1.0, done / job.counts.total);
}

std::optional<double> TileScheduler::EtaSeconds(const JobId& id) const {
  const auto at = jobs_.find(id);
  if (at == jobs_.end()) return std::nullopt;
  const Job& job = at->second;
  if (job.counts.committed == job.counts.total) return 0;
  if (!job.started || job.committed_here == 0 || job.paused_at) return std::nullopt;
  const double total = job.counts.total;
  const double here = Progress(id) * total - (job.counts.committed - job.committed_here);
  const double elapsed = Seconds(clock_.Now() - *job.started);
  return elapsed * (total - Progress(id) * total) / std::max(here, 1.0);
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
  const TimePoint now = clock_.Now();
  for (const auto& [lease, live] : leases_) {
    if (live.grant.job != id) continue;
    report.in_work.push_back({.grant = live.grant,
                              .worker_name = NameOfWorker(live.grant.worker),
                              .seconds = Seconds(now - live.started),
                              .fraction = std::clamp(live.progress.fraction, 0.0f, 1.0f)});
  }
  std::stable_sort(report.in_work.begin(), report.in_work.end(),
                   [](const TileInWork& a, const TileInWork& b) { return a.seconds > b.seconds; });
  for (const auto& [tile, cause] : job.causes) {
    const Tile& t = job.tiles[tile];
    if (t.state == TileState::kCommitted) continue;
    report.troubled.push_back({.tile = tile,
                               .failures = t.failures,
                               .workers = static_cast<uint32_t>(t.dead.size()),
                               .cause = cause});
  }
  return report;
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
  FP_CHECK(now != TileState::kCommitted);
  --count(now);
  ++count(state);
  if (now == TileState::kQueued) job.queued.erase(tile);
  if (state == TileState::kQueued && job.tiles[tile].open) job.queued.insert(tile);
  now = state;
}

// --- Workers ---------------------------------------------------------------------------------

void TileScheduler::AddWorker(const WorkerId& id, const WorkerHello& hello) {
  FP_CHECK(!workers_.contains(id));
  Worker worker;
  worker.hello = hello;
  worker.heard = clock_.Now();
  workers_.emplace(id, std::move(worker));
}

bool TileScheduler::Touch(const WorkerId& id) {
  const auto at = workers_.find(id);
  if (at == workers_.end()) return false;
  at->second.heard = clock_.Now();
  return true;
}

void TileScheduler::RemoveWorker(const WorkerId& id) {
  const auto at = workers_.find(id);
  if (at == workers_.end()) return;
  const std::set<LeaseId> ending = at->second.leases;
  for (const LeaseId& lease : ending) {
    // A result that is being stored counts even if its worker has left.
    if (!leases_.at(lease).committing) EndLease(lease);
  }
  workers_.erase(at);
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
  return worker.set_aside_until && clock_.Now() < *worker.set_aside_until;
}

// --- Leases ----------------------------------------------------------------------------------

bool TileScheduler::AnotherWorkerCouldTake(const Job& job, const Tile& tile,
                                           const WorkerId& but) const {
  for (const auto& [id, worker] : workers_) {
    if (id == but || IsSetAside(worker) || tile.dead.contains(id)) continue;
    if (!job.fingerprint.empty() && worker.hello.fingerprint != job.fingerprint) continue;
    if (clock_.Now() - worker.heard < options_.silence_time) return true;
  }
  return false;
}

LeaseGrant TileScheduler::Grant(const WorkerId& worker, Job& job, uint32_t tile, bool speculative) {
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
                .speculative = speculative};
  live.started = live.heard = live.progressed = now;
  if (!job.started) job.started = now;
  if (!speculative) SetState(job, tile, TileState::kLeased);
  job.tiles[tile].leases.push_back(live.grant.lease);
  workers_.at(worker).leases.insert(live.grant.lease);
  const LeaseGrant grant = live.grant;
  leases_.emplace(grant.lease, std::move(live));
  return grant;
}

std::optional<LeaseGrant> TileScheduler::Lease(const WorkerId& id) {
  const auto at = workers_.find(id);
  if (at == workers_.end()) return std::nullopt;
  Worker& worker = at->second;
  worker.heard = clock_.Now();
  // A worker has one tile at a time. If it asks while we think that it has one, the answer that
  // granted it was lost on its way.
  const std::set<LeaseId> unheard_of = worker.leases;
  for (const LeaseId& lease : unheard_of) {
    if (leases_.at(lease).committing) continue;
    ++jobs_.at(leases_.at(lease).grant.job).reissued;
    EndLease(lease);
  }
  if (IsSetAside(worker)) return std::nullopt;

  std::vector<Job*> jobs;
  for (auto& [job_id, job] : jobs_) {
    if (job.paused_at) continue;
    if (job.fingerprint.empty() || job.fingerprint == worker.hello.fingerprint) {
      jobs.push_back(&job);
    }
  }
  std::sort(jobs.begin(), jobs.end(), [](const Job* a, const Job* b) {
    if (a->spec.priority != b->spec.priority) return a->spec.priority > b->spec.priority;
    return a->spec.number < b->spec.number;
  });

  for (Job* job : jobs) {
    for (uint32_t tile : job->queued) {
      const Tile& candidate = job->tiles[tile];
      if (candidate.dead.contains(id) && AnotherWorkerCouldTake(*job, candidate, id)) continue;
      return Grant(id, *job, tile, false);
    }
  }
  // Nothing is queued for this worker: copy the slowest tile, if it is slow.
  for (Job* job : jobs) {
    if (job->durations.empty()) continue;
    std::vector<Duration> durations = job->durations;
    const auto middle = durations.begin() + static_cast<ptrdiff_t>(durations.size() / 2);
    std::nth_element(durations.begin(), middle, durations.end());
    const Duration median = *middle;
    const Duration slow =
        std::max(options_.speculate_after,
                 std::chrono::duration_cast<Duration>(median * options_.speculate_factor));
    const LiveLease* slowest = nullptr;
    for (const auto& [lease, live] : leases_) {
      if (live.grant.job != job->spec.id || live.grant.worker == id || live.committing) continue;
      const Tile& tile = job->tiles[live.grant.tile];
      if (tile.leases.size() > 1 || tile.dead.contains(id)) continue;
      if (clock_.Now() - live.started < slow) continue;
      if (slowest == nullptr || live.started < slowest->started) slowest = &live;
    }
    if (slowest != nullptr) return Grant(id, *job, slowest->grant.tile, true);
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
  live.heard = clock_.Now();
  if (progress.counter > live.progress.counter) {
    live.progressed = live.heard;
    live.progress = progress;
  }
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
  Job& job = jobs_.at(live.grant.job);
  for (const LeaseId& other : job.tiles[live.grant.tile].leases) {
    if (leases_.at(other).committing) {
      return refuse(live.grant.job, "a result of this tile is being stored");
    }
  }
  const auto by = workers_.find(worker);
  if (by == workers_.end() ||
      (!job.fingerprint.empty() && job.fingerprint != by->second.hello.fingerprint)) {
    return refuse(live.grant.job, "the job's tiles have another fingerprint");
  }
  // Two first tiles may be stored at a time: the one that came first decides.
  job.fingerprint = by->second.hello.fingerprint;
  live.committing = true;
  return live.grant;
}

bool TileScheduler::FinishCommit(const LeaseId& lease, bool durable) {
  const auto at = leases_.find(lease);
  if (at == leases_.end()) return false;
  const LiveLease live = at->second;
  FP_CHECK(live.committing);
  Job& job = jobs_.at(live.grant.job);
  if (!durable) {
    EndLease(lease);
    ++job.reissued;
    ForgetUnusedFingerprint(job);
    return true;
  }
  const auto by = workers_.find(live.grant.worker);
  if (by != workers_.end()) {
    ++by->second.committed;
    by->second.failures_in_a_row = 0;
    by->second.set_aside_until.reset();
  }
  const Duration took = clock_.Now() - live.started;
  if (job.durations.size() < kRememberedDurations) {
    job.durations.push_back(took);
  } else {
    job.durations[job.committed_here % kRememberedDurations] = took;
  }
  ++job.committed_here;
  SetState(job, live.grant.tile, TileState::kCommitted);
  const std::vector<LeaseId> ending = job.tiles[live.grant.tile].leases;
  for (const LeaseId& one : ending) EndLease(one);

  // The first tile decides the job's fingerprint: others' leases cannot count any more.
  std::vector<LeaseId> foreign;
  for (const auto& [id, other] : leases_) {
    if (other.grant.job != live.grant.job) continue;
    const auto holder = workers_.find(other.grant.worker);
    if (holder != workers_.end() && holder->second.hello.fingerprint != job.fingerprint) {
      foreign.push_back(id);
    }
  }
  for (const LeaseId& id : foreign) EndLease(id);
  return true;
}

void TileScheduler::ForgetUnusedFingerprint(Job& job) {
  if (job.counts.committed > 0) return;
  for (const auto& [id, live] : leases_) {
    if (live.grant.job == job.spec.id && live.committing) return;
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
    worker->second.leases.erase(lease);
  }
  Job& job = jobs_.at(grant.job);
  Tile& tile = job.tiles[grant.tile];
  std::erase(tile.leases, lease);
  if (tile.leases.empty() && tile.state == TileState::kLeased) {
    SetState(job, grant.tile, TileState::kQueued);
  } else if (tile.leases.size() == 1) {
    // The copy that is left is the tile's only attempt now: it may be copied again.
    leases_.at(tile.leases.front()).grant.speculative = false;
  }
  // A ring of the most recent ones.
  if (ended_order_.size() < kRememberedLeases) {
    ended_order_.push_back(lease);
  } else {
    ended_.erase(ended_order_[ended_next_]);
    ended_order_[ended_next_] = lease;
    ended_next_ = (ended_next_ + 1) % kRememberedLeases;
  }
  ended_[lease] = grant.job;
}

void TileScheduler::FailJob(Job& job, absl::Status error, std::optional<uint32_t> tile,
                            SchedulerNews& news) {
  std::vector<LeaseId> ending;
  for (const auto& [lease, live] : leases_) {
    if (live.grant.job == job.spec.id) ending.push_back(lease);
  }
  for (const LeaseId& lease : ending) EndLease(lease);
  for (uint32_t i = 0; i < job.tiles.size(); ++i) {
    if (job.tiles[i].state == TileState::kQueued) SetState(job, i, TileState::kFailed);
  }
  news.failed.push_back({job.spec.id, std::move(error), tile});
}

void TileScheduler::Blame(const LeaseGrant& grant, const std::string& cause, SchedulerNews& news) {
  LostLease lost{.grant = grant, .reason = cause, .worker_name = NameOfWorker(grant.worker)};
  if (const auto at = workers_.find(grant.worker); at != workers_.end()) {
    Worker& worker = at->second;
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
  if (tile.state == TileState::kCommitted || tile.state == TileState::kFailed) return;
  ++tile.failures;
  tile.dead.insert(grant.worker);
  job.causes[grant.tile] = cause;
  if (tile.dead.size() < options_.max_dead_workers && tile.failures < options_.max_tile_failures) {
    return;
  }
  FailJob(job,
          absl::AbortedError("tile " + std::to_string(grant.tile) + " failed " +
                             std::to_string(tile.failures) + " times on " +
                             std::to_string(tile.dead.size()) + " workers; the last cause: " +
                             cause + "; see the workers' logs, then requeue the job"),
          grant.tile, news);
}

SchedulerNews TileScheduler::RefuseResult(const LeaseId& lease, const std::string& reason) {
  SchedulerNews news;
  const auto at = leases_.find(lease);
  if (at == leases_.end()) return news;
  const LeaseGrant grant = at->second.grant;
  ++jobs_.at(grant.job).refused;
  EndLease(lease);
  ForgetUnusedFingerprint(jobs_.at(grant.job));
  Blame(grant, reason, news);
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
  if (IsPermanent(error.code())) {
    FailJob(jobs_.at(grant.job), Annotate(error, "tile " + std::to_string(grant.tile)), grant.tile,
            news);
    return news;
  }
  Blame(grant, cause, news);
  return news;
}

void TileScheduler::Forgive(Duration gap) {
  const TimePoint now = clock_.Now();
  for (auto& [id, live] : leases_) {
    live.heard = std::min(now, live.heard + gap);
    live.progressed = std::min(now, live.progressed + gap);
  }
  for (auto& [id, worker] : workers_) worker.heard = std::min(now, worker.heard + gap);
}

SchedulerNews TileScheduler::Tick() {
  SchedulerNews news;
  const TimePoint now = clock_.Now();
  std::vector<std::pair<LeaseGrant, std::string>> expired;
  for (const auto& [id, live] : leases_) {
    if (live.committing) continue;
    if (now - live.heard >= options_.silence_time) {
      expired.emplace_back(live.grant,
                           "nothing was heard of the worker for " + SecondsText(now - live.heard));
    } else if (now - live.progressed >=
               std::max(options_.lease_time, jobs_.at(live.grant.job).spec.lease_time)) {
      expired.emplace_back(live.grant, "no progress for " + SecondsText(now - live.progressed));
    }
  }
  for (const auto& [grant, reason] : expired) {
    // A job that failed a moment ago took its leases with it.
    if (!leases_.contains(grant.lease)) continue;
    EndLease(grant.lease);
    Blame(grant, reason, news);
  }
  for (auto& [id, job] : jobs_) {
    if (!job.started || job.paused_at || job.counts.queued + job.counts.leased == 0) continue;
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
  for (const WorkerId& id : news.forgotten) workers_.erase(id);
  return news;
}

}  // namespace farpoint

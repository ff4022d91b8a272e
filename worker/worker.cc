#include "worker/worker.h"

#include <algorithm>
#include <atomic>
#include <condition_variable>
#include <mutex>
#include <random>
#include <thread>

#include "core/base/clock.h"
#include "core/base/executor.h"
#include "core/base/pulse.h"
#include "worker/tile_runner.h"

namespace farpoint {

namespace {

using std::chrono::steady_clock;

bool TryAgain(const absl::Status& status) {
  return absl::IsUnavailable(status) || absl::IsDeadlineExceeded(status) ||
         absl::IsResourceExhausted(status) || absl::IsAborted(status);
}

}  // namespace

struct Worker::Impl {
  Impl(WorkerOptions options, CoordinatorLink& link, BlobSource& blobs,
       const TileRenderer& renderer)
      : options(std::move(options)),
        link(link),
        executor(this->options.threads),
        runner(renderer, blobs, executor, this->options.cached_scenes),
        jitter(std::random_device{}()) {}

  absl::Status Run() {
    while (!Stopping()) {
      FP_RETURN_IF_ERROR(Register());
      if (Stopping()) break;
      WorkUntilUnknown();
    }
    if (!welcome.id.empty()) (void)link.Leave(welcome.id);  // it would find out by itself
    return absl::OkStatus();
  }

  // Tries for ever, until it is stopped (OK) or refused.
  absl::Status Register() {
    WorkerHello hello;
    hello.version = FARPOINT_VERSION;
    hello.fingerprint = options.fingerprint;
    hello.threads = executor.threads();
    hello.name = options.name;
    ResetBackoff();
    while (!Stopping()) {
      const absl::StatusOr<WorkerWelcome> answer = link.Register(hello);
      if (answer.ok()) {
        {
          std::lock_guard lock(crash_mutex);
          welcome = *answer;
        }
        link.Attend(welcome.id);
        Log(WorkerLogEntry::Level::kInfo, "registered as " + welcome.id.value);
        return absl::OkStatus();
      }
      if (!TryAgain(answer.status())) return Annotate(answer.status(), "cannot register");
      Log(WorkerLogEntry::Level::kWarning,
          "cannot reach the coordinator, trying again: " + answer.status().ToString());
      BackOff();
    }
    return absl::OkStatus();
  }

  // Returns when the coordinator does not know this worker any more, or to stop.
  void WorkUntilUnknown() {
    ResetBackoff();
    while (!Stopping()) {
      const absl::StatusOr<std::optional<TileWork>> work = link.Lease(welcome.id, welcome.max_wait);
      if (work.ok()) {
        ResetBackoff();
        if (work->has_value() && !WorkOn(**work)) return;
        continue;
      }
      if (absl::IsCancelled(work.status()) && Stopping()) return;
      if (absl::IsNotFound(work.status())) {
        Log(WorkerLogEntry::Level::kWarning,
            "the coordinator does not know this worker, registering again");
        return;
      }
      Log(WorkerLogEntry::Level::kWarning, "no lease, trying again: " + work.status().ToString());
      BackOff();
    }
  }

  // The tile in work, for as long as this lives.
  class CurrentWork {
   public:
    CurrentWork(Impl& impl, const LeaseId& lease, const TileProgress& progress) : impl_(impl) {
      std::lock_guard lock(impl_.crash_mutex);
      impl_.current_lease = lease;
      impl_.current_progress = &progress;
    }
    ~CurrentWork() {
      std::lock_guard lock(impl_.crash_mutex);
      impl_.current_progress = nullptr;
    }
    CurrentWork(const CurrentWork&) = delete;
    CurrentWork& operator=(const CurrentWork&) = delete;

   private:
    Impl& impl_;
  };

  void ReportCrash(const std::string& cause) {
    std::lock_guard lock(crash_mutex);
    if (current_progress == nullptr) return;
    const std::string place = current_progress->place();
    (void)link.ReportFailure(
        welcome.id, current_lease, false,
        absl::AbortedError("the worker crashed" + (place.empty() ? "" : " in " + place) + ": " +
                           cause));
  }

  // One tile from lease to result. False if the coordinator does not know this worker any more.
  bool WorkOn(const TileWork& work) {
    TileProgress progress;
    const auto renew = [&] {
      return link.Renew(
          welcome.id, work.lease,
          {.counter = progress.counter.load(),
           .fraction = progress.fraction.load(),
           .at = progress.place(),
           .rendering = progress.rendering.load(),
           .cpu = std::chrono::milliseconds(static_cast<int64_t>(1000 * ProcessCpuSeconds())),
           .pulse = Pulses()});
    };
    // Whether it is heard or not, the work goes on: the heartbeat hears what is to be done.
    progress.tell = [&] { (void)renew(); };
    const CurrentWork current(*this, work.lease, progress);
    std::atomic<bool> cancel = false;
    bool known = true;      // by the coordinator; both written by the heartbeat, read after join
    std::string dropped;    // why the coordinator dropped the tile
    bool finished = false;  // guarded by mutex
    std::thread heartbeat([&] {
      std::unique_lock lock(mutex);
      auto next = steady_clock::now() + welcome.heartbeat;
      while (!finished) {
        // A stop with time to drain changes nothing until that is over.
        auto until = next;
        if (stop_at) until = std::min(until, *stop_at + options.drain_time);
        changed.wait_until(lock, until, [&] {
          return finished || (stop_at && steady_clock::now() >= *stop_at + options.drain_time);
        });
        if (finished) return;
        if (stop_at && steady_clock::now() >= *stop_at + options.drain_time) {
          cancel = true;
          changed.notify_all();
          // Heartbeats go on until the tile is given back; nothing else is waited for.
          changed.wait_until(lock, next, [&] { return finished; });
          if (finished) return;
        }
        if (steady_clock::now() < next) continue;
        lock.unlock();
        const absl::StatusOr<RenewAnswer> answer = renew();
        lock.lock();
        next = steady_clock::now() + welcome.heartbeat;
        if (answer.ok() && answer->drop) {
          dropped = answer->reason;
          cancel = true;
        } else if (absl::IsNotFound(answer.status())) {
          known = false;
          cancel = true;
        }
        // Cannot be reached now: it may be back before the lease is lost.
      }
    });

    const absl::StatusOr<TileResult> result = runner.Run(work, progress, cancel);
    absl::StatusOr<ReturnAnswer> answer = absl::UnknownError("not returned");
    if (result.ok() && !cancel.load()) {
      ResetBackoff();
      for (;;) {
        answer = link.Return(welcome.id, *result);
        progress.Advance();
        if (answer.ok() || !TryAgain(answer.status()) || cancel.load()) break;
        LogTile(WorkerLogEntry::Level::kWarning,
                "result not delivered, trying again: " + answer.status().ToString(), work);
        BackOff(&cancel);
      }
    }
    {
      std::lock_guard lock(mutex);
      finished = true;
    }
    changed.notify_all();
    heartbeat.join();

    if (!known) return false;
    if (!dropped.empty()) {
      LogTile(WorkerLogEntry::Level::kInfo, "dropped: " + dropped, work);
      return true;
    }
    if (result.ok() && answer.ok()) {
      LogTile(answer->accepted ? WorkerLogEntry::Level::kInfo : WorkerLogEntry::Level::kWarning,
              answer->accepted ? "returned" : "result refused: " + answer->reason, work);
      return true;
    }
    if (cancel.load()) {
      const absl::Status given = link.ReportFailure(welcome.id, work.lease, true, absl::OkStatus());
      LogTile(WorkerLogEntry::Level::kInfo, "given back: " + given.ToString(), work);
      return !absl::IsNotFound(given);
    }
    const absl::Status error = result.ok() ? answer.status() : result.status();
    if (absl::IsNotFound(error) && result.ok()) return false;
    LogTile(WorkerLogEntry::Level::kError, "failed: " + error.ToString(), work);
    const absl::Status reported = link.ReportFailure(welcome.id, work.lease, false, error);
    if (!reported.ok()) {
      LogTile(WorkerLogEntry::Level::kWarning, "failure not reported: " + reported.ToString(),
              work);
    }
    return !absl::IsNotFound(reported);
  }

  void Stop() {
    {
      std::lock_guard lock(mutex);
      if (!stop_at) stop_at = steady_clock::now();
    }
    link.CancelWaits();
    changed.notify_all();
  }

  bool Stopping() {
    std::lock_guard lock(mutex);
    return stop_at.has_value();
  }

  void ResetBackoff() { backoff = options.first_backoff; }
  // Waits, but for Stop(); with `cancel` for that instead: a tile that is done is delivered while
  // the worker stops, too.
  void BackOff(const std::atomic<bool>* cancel = nullptr) {
    std::uniform_real_distribution<double> factor(0.5, 1.5);
    const auto wait = std::chrono::duration_cast<steady_clock::duration>(backoff * factor(jitter));
    backoff = std::min(backoff * 2, options.last_backoff);
    std::unique_lock lock(mutex);
    if (cancel == nullptr) {
      changed.wait_for(lock, wait, [this] { return stop_at.has_value(); });
    } else {
      changed.wait_for(lock, wait, [cancel] { return cancel->load(); });
    }
  }

  void Log(WorkerLogEntry::Level level, std::string text) const {
    if (options.log) options.log({.level = level, .text = std::move(text)});
  }
  void LogTile(WorkerLogEntry::Level level, std::string text, const TileWork& work) const {
    if (!options.log) return;
    options.log({.level = level,
                 .text = std::move(text),
                 .job = work.job,
                 .tile = work.tile,
                 .attempt = work.attempt});
  }

  const WorkerOptions options;
  CoordinatorLink& link;
  Executor executor;
  TileRunner runner;
  WorkerWelcome welcome;
  std::mt19937 jitter;
  std::chrono::milliseconds backoff{};

  // For ReportCrash; never held while anything is computed.
  std::mutex crash_mutex;
  LeaseId current_lease;                           // guarded by crash_mutex
  const TileProgress* current_progress = nullptr;  // guarded by crash_mutex; null: no tile

  std::mutex mutex;
  std::condition_variable changed;
  std::optional<steady_clock::time_point> stop_at;  // guarded by mutex
};

Worker::Worker(WorkerOptions options, CoordinatorLink& link, BlobSource& blobs,
               const TileRenderer& renderer)
    : impl_(std::make_unique<Impl>(std::move(options), link, blobs, renderer)) {}
Worker::~Worker() = default;
absl::Status Worker::Run() { return impl_->Run(); }
void Worker::Stop() { impl_->Stop(); }
void Worker::ReportCrash(const std::string& cause) { impl_->ReportCrash(cause); }

}  // namespace farpoint

#include "client/embedded_farm.h"

#include <atomic>
#include <chrono>
#include <cstdlib>
#include <filesystem>
#include <string>
#include <thread>
#include <utility>
#include <vector>

#include "server/coordinator.h"
#include "server/scene_baker.h"
#include "worker/in_process_link.h"
#include "worker/tile_renderer.h"
#include "worker/worker.h"

namespace farpoint {
namespace {

// Also how fast a signal is seen.
constexpr std::chrono::milliseconds kEventWait(100);

void Show(Console& console, bool warning, bool error, std::string_view text) {
  if (error) {
    console.Error(text);
  } else if (warning) {
    console.Warn(text);
  } else {
    console.Debug(text);
  }
}

// A folder of its own that goes with this.
class TemporaryFolder {
 public:
  static absl::StatusOr<TemporaryFolder> Create() {
    std::error_code error;
    const std::filesystem::path base = std::filesystem::temp_directory_path(error);
    std::string path = (base / "farpoint-XXXXXX").string();
    if (error || mkdtemp(path.data()) == nullptr) {
      return absl::UnavailableError("cannot make a folder among the temporary files, " + path +
                                    "; let TMPDIR name a folder that can be written");
    }
    return TemporaryFolder(std::move(path));
  }
  TemporaryFolder() = default;
  TemporaryFolder(TemporaryFolder&& from) noexcept : path_(std::exchange(from.path_, {})) {}
  TemporaryFolder& operator=(TemporaryFolder&& from) noexcept {
    std::swap(path_, from.path_);
    return *this;
  }
  ~TemporaryFolder() {
    std::error_code ignored;
    if (!path_.empty()) std::filesystem::remove_all(path_, ignored);
  }
  const std::string& path() const { return path_; }

 private:
  explicit TemporaryFolder(std::string path) : path_(std::move(path)) {}

  std::string path_;
};

class EmbeddedFarm final : public FarmLink {
 public:
  EmbeddedFarm(TemporaryFolder folder, std::unique_ptr<Coordinator> coordinator,
               const EmbeddedFarmOptions& options, const StopFlag& stop, Console& console)
      : stop_(stop),
        folder_(std::move(folder)),
        coordinator_(std::move(coordinator)),
        link_(*coordinator_),
        renderer_(MakeCoreRenderer()) {
    WorkerOptions worker_options;
    worker_options.threads = options.threads;
    // Within one process every worker computes alike.
    worker_options.fingerprint = HashBytes({});
    worker_options.log = [this, &console](const WorkerLogEntry& entry) {
      if (ending_) return;  // what is cut off then is no news
      Show(console, entry.level == WorkerLogEntry::Level::kWarning,
           entry.level == WorkerLogEntry::Level::kError, entry.text);
    };
    for (uint32_t i = 0; i < options.workers; ++i) {
      worker_options.name = "embedded " + std::to_string(i);
      workers_.push_back(std::make_unique<Worker>(worker_options, link_, link_, *renderer_));
    }
    for (const auto& worker : workers_) {
      threads_.emplace_back([&console, &worker] {
        const absl::Status status = worker->Run();
        if (!status.ok()) console.Error("embedded worker: " + std::string(status.message()));
      });
    }
  }

  ~EmbeddedFarm() override {
    ending_ = true;
    for (const auto& worker : workers_) worker->Stop();
    coordinator_->Drain();  // wakes workers that wait for a lease
    for (std::thread& thread : threads_) thread.join();
  }

  absl::StatusOr<std::vector<Digest>> FindMissing(std::span<const Digest> blobs) override {
    return coordinator_->FindMissing(blobs);
  }
  absl::Status Put(const Digest& digest, const Blob& blob) override {
    return coordinator_->PutBlob(digest, blob);
  }
  absl::StatusOr<JobId> Submit(const JobSpec& spec, const std::string& submission_id) override {
    return coordinator_->Submit(spec, submission_id);
  }
  absl::StatusOr<FarmStatus> Status(const JobId& job) override {
    FarmStatus status;
    if (job.empty()) {
      status.jobs = coordinator_->Jobs();
      status.workers = coordinator_->Workers();
    } else {
      FP_ASSIGN_OR_RETURN(JobStatus one, coordinator_->Status(job));
      status.jobs.push_back(std::move(one));
    }
    return status;
  }
  absl::Status Cancel(const JobId& job) override { return coordinator_->Cancel(job); }

  absl::Status Pause(const JobId& job) override { return coordinator_->Pause(job); }
  absl::Status Resume(const JobId& job) override { return coordinator_->Resume(job); }
  absl::Status SetPriority(const JobId& job, int32_t priority) override {
    return coordinator_->SetPriority(job, priority);
  }
  absl::Status Requeue(const JobId& job, bool all) override {
    return coordinator_->Requeue(job, all);
  }
  absl::StatusOr<Explanation> Explain(const JobId& job) override {
    return coordinator_->Explain(job);
  }

  absl::Status Watch(const JobId& job, uint64_t after_sequence,
                     const std::function<absl::Status(const JobEvent&)>& on_event) override {
    while (true) {
      FP_ASSIGN_OR_RETURN(const std::vector<JobEvent> events,
                          coordinator_->NextEvents(job, after_sequence, kEventWait));
      if (events.empty()) return absl::OkStatus();
      for (const JobEvent& event : events) {
        if (event.sequence > 0) after_sequence = event.sequence;
        FP_RETURN_IF_ERROR(on_event(event));
      }
      if (stop_.raised()) return absl::CancelledError("stopped by a signal");
    }
  }

  absl::StatusOr<JobInfo> Info(const JobId& job) override { return coordinator_->FetchInfo(job); }

  absl::Status FetchTiles(const JobId& job, std::span<const uint32_t> tiles,
                          const std::function<absl::Status(TileData)>& on_tile) override {
    const std::vector<uint32_t> wanted(tiles.begin(), tiles.end());  // on_tile may change them
    for (const uint32_t tile : wanted) {
      FP_ASSIGN_OR_RETURN(TileData data, coordinator_->FetchTile(job, tile));
      FP_RETURN_IF_ERROR(on_tile(std::move(data)));
    }
    return absl::OkStatus();
  }

 private:
  const StopFlag& stop_;
  std::atomic<bool> ending_{false};
  TemporaryFolder folder_;  // outlives the coordinator
  std::unique_ptr<Coordinator> coordinator_;
  InProcessLink<CoordinatorApi> link_;
  std::unique_ptr<TileRenderer> renderer_;
  std::vector<std::unique_ptr<Worker>> workers_;
  std::vector<std::thread> threads_;
};

}  // namespace

absl::StatusOr<std::unique_ptr<FarmLink>> StartEmbeddedFarm(const EmbeddedFarmOptions& options,
                                                            const StopFlag& stop,
                                                            Console& console) {
  CoordinatorOptions coordinator_options;
  TemporaryFolder folder;
  if (options.on_disk) {
    FP_ASSIGN_OR_RETURN(folder, TemporaryFolder::Create());
    coordinator_options.store_directory = folder.path();
  }
  coordinator_options.baker = MakeCoreBaker(options.threads);
  // Workers of one process do not vanish, and none is faster than another.
  coordinator_options.silence_time = std::chrono::hours(24);
  coordinator_options.lease_time = std::chrono::hours(24);
  coordinator_options.speculate_after = std::chrono::hours(24);
  coordinator_options.log = [&console](const CoordinatorLogEntry& entry) {
    Show(console, entry.level == CoordinatorLogEntry::Level::kWarning,
         entry.level == CoordinatorLogEntry::Level::kError, entry.text);
  };
  FP_ASSIGN_OR_RETURN(std::unique_ptr<Coordinator> coordinator,
                      Coordinator::Open(std::move(coordinator_options)));
  return std::make_unique<EmbeddedFarm>(std::move(folder), std::move(coordinator), options, stop,
                                        console);
}

}  // namespace farpoint

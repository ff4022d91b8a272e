// A farm of real processes for one case of the service's benchmark: a folder of its own, a
// coordinator, workers, and a client's connection. Errors carry the end of the logs.
#pragma once

#include <atomic>
#include <chrono>
#include <functional>
#include <map>
#include <memory>
#include <optional>
#include <string>
#include <string_view>
#include <vector>

#include "bench/service_process.h"
#include "client/farm_link.h"
#include "client/stop_flag.h"
#include "core/image/film.h"

namespace farpoint {

struct FarmPrograms {
  std::string server, worker, client, bench;
  // Those beside `bin_dir`; kNotFound names the one that is missing.
  static absl::StatusOr<FarmPrograms> Find(const std::string& bin_dir);
};

// A box on a floor under a sun, as files; every job of the benchmark renders it.
AssetBundle ServiceScene();

struct SmallJob {
  int width = 128, height = 96, tile = 32;
  Integrator integrator = Integrator::kFpbgi;
  uint32_t paths = 16;    // of pt
  uint64_t points = 400;  // of the others
  bool beauty_only = false;
  std::string title;
  int32_t priority = 0;
  bool paused = false;
};

// Not thread-safe, but for Submit beside StartServer and StartActorServer.
class ServiceFarm {
 public:
  static absl::StatusOr<std::unique_ptr<ServiceFarm>> Create(const FarmPrograms& programs,
                                                             const std::string& parent = "");
  ~ServiceFarm();

  std::string File(const std::string& name) const { return folder_ + "/" + name; }
  const FarmPrograms& programs() const { return programs_; }

  // The first start chooses a port, later ones use it and the same store. Returns when it listens.
  absl::Status StartServer(const std::vector<std::string>& flags = {},
                           const ProcessOptions& options = {});
  absl::Status StartActorServer(int64_t kill_at);
  ChildProcess* server() { return server_.get(); }
  int port() const { return port_; }
  std::string address() const { return "127.0.0.1:" + std::to_string(port_); }
  std::string ServerLog() const;

  // Returns its index. `address`: of a relay; empty: the coordinator's own.
  absl::StatusOr<size_t> StartWorker(const std::vector<std::string>& flags = {},
                                     const std::string& address = "",
                                     const ProcessOptions& options = {});
  absl::StatusOr<size_t> StartActor(const std::string& role, const std::vector<std::string>& values,
                                    const std::string& address = "");
  ChildProcess& worker(size_t i) { return *workers_[i].process; }
  // The same program with the same cache again.
  absl::Status Restart(size_t i);
  std::string WorkerLog(size_t i) const;
  size_t worker_count() const { return workers_.size(); }
  void RemoveWorkers() { workers_.clear(); }  // SIGKILL

  // --- The client ---
  FarmLink& client() { return *client_; }
  absl::StatusOr<JobId> Submit(const SmallJob& job);
  // Of an answer; tries again for `time` while the coordinator cannot be reached. Counts answers
  // in which the tiles do not add up.
  absl::StatusOr<JobStatus> Status(const JobId& job,
                                   std::chrono::milliseconds time = std::chrono::seconds(20));
  // kDeadlineExceeded with the logs if it does not come true.
  absl::StatusOr<JobStatus> WaitFor(const JobId& job, std::chrono::milliseconds time,
                                    const std::function<bool(const JobStatus&)>& holds);
  // Done; an error if it fails.
  absl::StatusOr<JobStatus> WaitUntilDone(const JobId& job, std::chrono::milliseconds time);
  // The hash of the image, after each tile's hash was checked.
  absl::StatusOr<Digest> ImageOf(const JobId& job);
  // How often each tile was committed, by the job's events: 1 for all of a job that is done.
  absl::StatusOr<std::vector<uint32_t>> CommitsOf(const JobId& job);
  uint64_t wrong_sums() const { return wrong_sums_; }
  uint64_t answers() const { return answers_; }
  absl::Status Annotated(const absl::Status& status) const;  // with the logs

 private:
  struct WorkerProcess {
    std::vector<std::string> args;
    ProcessOptions options;
    std::unique_ptr<ChildProcess> process;
  };
  ServiceFarm(const FarmPrograms& programs, std::string folder);
  absl::Status Listen(const std::vector<std::string>& args, ProcessOptions options);
  absl::StatusOr<size_t> Start(std::vector<std::string> args, ProcessOptions options);

  const FarmPrograms programs_;
  const std::string folder_;
  int port_ = 0;
  std::atomic<int> runs_ = 0;
  std::string server_log_;
  StopFlag stop_;
  std::unique_ptr<ChildProcess> server_;
  std::vector<WorkerProcess> workers_;
  std::unique_ptr<FarmLink> client_;
  bool sent_ = false;  // the scene's files
  uint64_t wrong_sums_ = 0, answers_ = 0;
};

}  // namespace farpoint

#include "bench/service_farm.h"

#include <signal.h>
#include <unistd.h>

#include <algorithm>
#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <iterator>
#include <thread>
#include <utility>

#include "client/grpc_farm_link.h"

namespace farpoint {

namespace fs = std::filesystem;
using std::chrono::milliseconds;
using std::chrono::seconds;
using std::chrono::steady_clock;

namespace {

constexpr size_t kLogTail = 1500;

// A floor, a box and a wall: 24 triangles, winding irrelevant.
constexpr std::string_view kScene = R"(v -4 0 -4
v 4 0 -4
v 4 0 4
v -4 0 4
v -1 0 -1
v 1 0 -1
v 1 0 1
v -1 0 1
v -1 1.5 -1
v 1 1.5 -1
v 1 1.5 1
v -1 1.5 1
v -4 4 -4
v 4 4 -4
f 1 4 3 2
f 5 6 10 9
f 6 7 11 10
f 7 8 12 11
f 8 5 9 12
f 9 10 11 12
f 1 2 14 13
)";

std::string ReadAll(const std::string& path) {
  std::ifstream file(path, std::ios::binary);
  return {std::istreambuf_iterator<char>(file), {}};
}

std::string TailOf(const std::string& text) {
  return text.size() <= kLogTail ? text : "…" + text.substr(text.size() - kLogTail);
}

bool MayComeBack(const absl::Status& status) {
  return absl::IsUnavailable(status) || absl::IsDeadlineExceeded(status);
}

}  // namespace

absl::StatusOr<FarmPrograms> FarmPrograms::Find(const std::string& bin_dir) {
  std::error_code error;
  const fs::path self = fs::read_symlink("/proc/self/exe", error);
  const fs::path folder = bin_dir.empty() ? self.parent_path() : fs::path(bin_dir);
  FarmPrograms programs;
  const auto find = [&](const char* name, std::string& path) -> absl::Status {
    path = (folder / name).string();
    if (::access(path.c_str(), X_OK) == 0) return absl::OkStatus();
    return absl::NotFoundError("'" + path +
                               "' is missing; build it, or name its folder with --bin");
  };
  FP_RETURN_IF_ERROR(find("farpoint-server", programs.server));
  FP_RETURN_IF_ERROR(find("farpoint-worker", programs.worker));
  FP_RETURN_IF_ERROR(find("farpoint", programs.client));
  FP_RETURN_IF_ERROR(find("farpoint-bench", programs.bench));
  return programs;
}

AssetBundle ServiceScene() {
  AssetBundle asset;
  asset.root = "scene.obj";
  asset.files["scene.obj"] = Blob::FromString(kScene);
  return asset;
}

absl::StatusOr<std::unique_ptr<ServiceFarm>> ServiceFarm::Create(const FarmPrograms& programs,
                                                                 const std::string& parent) {
  std::error_code error;
  const fs::path base = parent.empty() ? fs::temp_directory_path(error) : fs::path(parent);
  std::string folder = (base / "farpoint-service-XXXXXX").string();
  if (::mkdtemp(folder.data()) == nullptr) {
    return absl::UnavailableError("cannot make a folder in '" + base.string() + "'");
  }
  return std::unique_ptr<ServiceFarm>(new ServiceFarm(programs, folder));
}

ServiceFarm::ServiceFarm(const FarmPrograms& programs, std::string folder)
    : programs_(programs), folder_(std::move(folder)) {}

ServiceFarm::~ServiceFarm() {
  workers_.clear();
  client_.reset();
  server_.reset();
  std::error_code ignored;
  fs::remove_all(folder_, ignored);
}

std::string ServiceFarm::ServerLog() const { return ReadAll(server_log_); }
std::string ServiceFarm::WorkerLog(size_t i) const { return ReadAll(workers_[i].options.log); }

absl::Status ServiceFarm::Annotated(const absl::Status& status) const {
  if (status.ok()) return status;
  std::string text(status.message());
  text += "\n--- the coordinator: " + TailOf(ServerLog());
  for (size_t i = 0; i < workers_.size(); ++i) {
    text += "\n--- worker " + std::to_string(i) + ": " + TailOf(WorkerLog(i));
  }
  return absl::Status(status.code(), text);
}

absl::Status ServiceFarm::Listen(const std::vector<std::string>& args, ProcessOptions options) {
  server_.reset();
  server_log_ = File("server" + std::to_string(runs_++) + ".log");
  options.log = server_log_;
  FP_ASSIGN_OR_RETURN(server_, ChildProcess::Start(args, options));
  const auto end = steady_clock::now() + seconds(60);
  constexpr std::string_view kListening = "listening on ";
  while (steady_clock::now() < end && server_->Running()) {
    const std::string text = ServerLog();
    const size_t at = text.find(kListening);
    if (at != std::string::npos && text.find('\n', at) != std::string::npos) {
      port_ = std::atoi(text.c_str() + text.find(':', at + kListening.size()) + 1);
      if (client_ == nullptr) client_ = MakeGrpcFarmLink(address(), stop_);
      return absl::OkStatus();
    }
    std::this_thread::sleep_for(milliseconds(2));
  }
  return Annotated(absl::UnavailableError("the coordinator does not listen"));
}

absl::Status ServiceFarm::StartServer(const std::vector<std::string>& flags,
                                      const ProcessOptions& options) {
  std::vector<std::string> args = {programs_.server, "--store", File("store"), "--threads", "1"};
  const auto add_default = [&](const std::string& flag, const std::string& value) {
    if (std::find(flags.begin(), flags.end(), flag) != flags.end()) return;
    args.insert(args.end(), {flag, value});
  };
  add_default("--listen", address());
  add_default("--audit-fraction", "0");
  args.insert(args.end(), flags.begin(), flags.end());
  return Listen(args, options);
}

absl::Status ServiceFarm::StartActorServer(int64_t kill_at) {
  return Listen({programs_.bench, "service-actor", "server", "store=" + File("store"),
                 "port=" + std::to_string(port_), "kill_at=" + std::to_string(kill_at)},
                {});
}

absl::StatusOr<size_t> ServiceFarm::Start(std::vector<std::string> args, ProcessOptions options) {
  WorkerProcess worker{.args = std::move(args), .options = std::move(options), .process = nullptr};
  FP_ASSIGN_OR_RETURN(worker.process, ChildProcess::Start(worker.args, worker.options));
  workers_.push_back(std::move(worker));
  return workers_.size() - 1;
}

absl::Status ServiceFarm::Restart(size_t i) {
  workers_[i].process->Kill();
  FP_ASSIGN_OR_RETURN(workers_[i].process,
                      ChildProcess::Start(workers_[i].args, workers_[i].options));
  return absl::OkStatus();
}

absl::StatusOr<size_t> ServiceFarm::StartWorker(const std::vector<std::string>& flags,
                                                const std::string& at,
                                                const ProcessOptions& options) {
  const std::string name = "worker" + std::to_string(runs_++);
  std::vector<std::string> args = {programs_.worker,
                                   "--coordinator",
                                   at.empty() ? address() : at,
                                   "--cache",
                                   File(name + ".cache"),
                                   "--threads",
                                   "1",
                                   "--name",
                                   name};
  args.insert(args.end(), flags.begin(), flags.end());
  ProcessOptions with_log = options;
  with_log.log = File(name + ".log");
  return Start(std::move(args), std::move(with_log));
}

absl::StatusOr<size_t> ServiceFarm::StartActor(const std::string& role,
                                               const std::vector<std::string>& values,
                                               const std::string& at) {
  const std::string name = role + std::to_string(runs_++);
  std::vector<std::string> args = {programs_.bench,
                                   "service-actor",
                                   role,
                                   "coordinator=" + (at.empty() ? address() : at),
                                   "cache=" + File(name + ".cache"),
                                   "name=" + name};
  args.insert(args.end(), values.begin(), values.end());
  return Start(std::move(args), {.log = File(name + ".log")});
}

absl::StatusOr<JobId> ServiceFarm::Submit(const SmallJob& job) {
  const AssetBundle asset = ServiceScene();
  JobSpec spec;
  spec.asset_root = asset.root;
  for (const auto& [uri, blob] : asset.files) {
    spec.asset_files[uri] = blob.Hash();
    if (!sent_) FP_RETURN_IF_ERROR(Annotated(client_->Put(blob.Hash(), blob)));
  }
  sent_ = true;
  spec.film = {.width = job.width, .height = job.height, .crop = {0, 0, job.width, job.height}};
  spec.camera = LookAt{.eye = {5, 4, 6}, .target = {0, 0.7, 0}};
  spec.overrides.suns.push_back({.to_sun = {1, 2, 0.5}, .irradiance = Rgb(3, 3, 2.5f)});
  spec.overrides.sky = Rgb(0.3f, 0.4f, 0.5f);
  spec.settings.integrator = job.integrator;
  spec.settings.paths = job.paths;
  spec.settings.points = job.points;
  spec.settings.light_samples = 4;
  spec.settings.tile_px = static_cast<uint32_t>(job.tile);
  if (job.beauty_only) spec.settings.layers = {Layer::kBeauty};
  spec.title = job.title;
  spec.priority = job.priority;
  spec.start_paused = job.paused;
  const std::string submission = "s" + std::to_string(runs_++) + "-" +
                                 std::to_string(steady_clock::now().time_since_epoch().count());
  const auto end = steady_clock::now() + seconds(20);
  for (;;) {
    absl::StatusOr<JobId> id = client_->Submit(spec, submission);
    if (id.ok() || !MayComeBack(id.status()) || steady_clock::now() > end) {
      if (!id.ok()) return Annotated(id.status());
      return id;
    }
    std::this_thread::sleep_for(milliseconds(20));
  }
}

absl::StatusOr<JobStatus> ServiceFarm::Status(const JobId& job, milliseconds time) {
  const auto end = steady_clock::now() + time;
  for (;;) {
    const absl::StatusOr<FarmStatus> status = client_->Status(job);
    if (status.ok() && status->jobs.size() == 1) {
      const TileCounts& t = status->jobs[0].tiles;
      ++answers_;
      if (t.queued + t.leased + t.committed + t.failed != t.total) ++wrong_sums_;
      return status->jobs[0];
    }
    if ((!status.ok() && !MayComeBack(status.status())) || steady_clock::now() > end) {
      return Annotated(status.ok() ? absl::InternalError("no status") : status.status());
    }
    std::this_thread::sleep_for(milliseconds(20));
  }
}

absl::StatusOr<JobStatus> ServiceFarm::WaitFor(const JobId& job, milliseconds time,
                                               const std::function<bool(const JobStatus&)>& holds) {
  const auto end = steady_clock::now() + time;
  for (;;) {
    FP_ASSIGN_OR_RETURN(JobStatus status, Status(job));
    if (holds(status)) return status;
    if (steady_clock::now() > end) {
      return Annotated(absl::DeadlineExceededError("job " + job.value + " is " +
                                                   std::string(NameOf(status.state)) + " with " +
                                                   std::to_string(status.tiles.committed) + " of " +
                                                   std::to_string(status.tiles.total) + " tiles"));
    }
    std::this_thread::sleep_for(milliseconds(5));
  }
}

absl::StatusOr<JobStatus> ServiceFarm::WaitUntilDone(const JobId& job, milliseconds time) {
  FP_ASSIGN_OR_RETURN(JobStatus status,
                      WaitFor(job, time, [](const JobStatus& s) { return IsFinal(s.state); }));
  if (status.state != JobState::kDone) {
    return Annotated(absl::AbortedError("job " + job.value + " is " +
                                        std::string(NameOf(status.state)) + ": " +
                                        std::string(status.error.message())));
  }
  return status;
}

absl::StatusOr<Digest> ServiceFarm::ImageOf(const JobId& job) {
  FP_ASSIGN_OR_RETURN(const JobInfo info, client_->Info(job));
  Film image(info.spec.film.crop, info.spec.settings.layers);
  size_t tiles = 0;
  FP_RETURN_IF_ERROR(client_->FetchTiles(job, {}, [&](TileData tile) -> absl::Status {
    if (tile.tile >= info.tiles.size() || tile.bytes.Hash() != info.tiles[tile.tile].sha256) {
      return absl::DataLossError("a tile has another hash than the job says");
    }
    FP_ASSIGN_OR_RETURN(const Film film, DecodeFilm(tile.bytes.bytes()));
    image.Paste(film);
    ++tiles;
    return absl::OkStatus();
  }));
  if (tiles != info.tiles.size()) return absl::DataLossError("tiles are missing");
  return ImageHash(image);
}

absl::StatusOr<std::vector<uint32_t>> ServiceFarm::CommitsOf(const JobId& job) {
  FP_ASSIGN_OR_RETURN(const JobStatus status, Status(job));
  std::vector<uint32_t> commits(status.tiles.total);
  FP_RETURN_IF_ERROR(client_->Watch(job, 0, [&](const JobEvent& event) {
    if (const auto* const tile = std::get_if<TileCommitted>(&event.body);
        tile != nullptr && tile->tile < commits.size()) {
      ++commits[tile->tile];
    }
    return absl::OkStatus();
  }));
  return commits;
}

}  // namespace farpoint

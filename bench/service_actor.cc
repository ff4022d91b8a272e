#include "bench/service_actor.h"

#include <signal.h>
#include <unistd.h>

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cstdio>
#include <map>
#include <random>
#include <string>
#include <thread>
#include <utility>
#include <vector>

#include "bench/service.h"
#include "core/base/executor.h"
#include "server/coordinator.h"
#include "server/grpc_server.h"
#include "server/scene_baker.h"
#include "worker/blob_cache.h"
#include "worker/crash_reporter.h"
#include "worker/fingerprint.h"
#include "worker/grpc_link.h"
#include "worker/worker.h"

namespace farpoint {

namespace {

using std::chrono::milliseconds;

class FaultyFrame final : public RenderedFrame {
 public:
  FaultyFrame(std::unique_ptr<RenderedFrame> frame, FrameSpec spec, const RendererFaults& faults,
              std::shared_ptr<std::mt19937_64> random)
      : frame_(std::move(frame)),
        spec_(std::move(spec)),
        faults_(faults),
        random_(std::move(random)) {}

  absl::StatusOr<TileOutput> RenderTile(const PixelRect& tile, Executor& executor,
                                        const std::function<void(int, int)>& progress,
                                        const std::atomic<bool>* cancel) const override {
    if (faults_.fails) return absl::InternalError("this worker fails on everything");
    const auto end = std::chrono::steady_clock::now() + milliseconds(faults_.tile_ms);
    while (std::chrono::steady_clock::now() < end) {
      if (cancel != nullptr && cancel->load()) return absl::CancelledError("dropped");
      std::this_thread::sleep_for(milliseconds(std::min(faults_.tile_ms, 50)));
      if (progress) progress(0, 1);
    }
    if (tile.Contains(faults_.crash_x, faults_.crash_y)) ::raise(SIGSEGV);
    while (tile.Contains(faults_.hang_x, faults_.hang_y)) {
      std::this_thread::sleep_for(std::chrono::hours(1));
    }
    // Not known to the compiler, so that the loop stays.
    volatile bool for_ever = tile.Contains(faults_.spin_x, faults_.spin_y);
    while (for_ever) {
    }
    TileOutput output;
    if (frame_ != nullptr) {
      FP_ASSIGN_OR_RETURN(output, frame_->RenderTile(tile, executor, progress, cancel));
    } else {
      output.film = Film(tile, spec_.settings.layers);
      if (progress) progress(1, 1);
    }
    if (std::uniform_real_distribution<double>(0, 1)(*random_) < faults_.wrong) {
      const Layer layer = output.film.layers().front();
      float& value = output.film.Plane(layer, 0)[0];
      value = value == 0.25f ? 0.5f : 0.25f;
    }
    return output;
  }

 private:
  const std::unique_ptr<RenderedFrame> frame_;  // null: zeros
  const FrameSpec spec_;
  const RendererFaults faults_;
  const std::shared_ptr<std::mt19937_64> random_;
};

class FaultyScene final : public RenderedScene {
 public:
  FaultyScene(std::shared_ptr<const RenderedScene> scene, const RendererFaults& faults,
              std::shared_ptr<std::mt19937_64> random)
      : scene_(std::move(scene)), faults_(faults), random_(std::move(random)) {}
  absl::StatusOr<std::unique_ptr<RenderedFrame>> StartFrame(const FrameSpec& frame) const override {
    std::unique_ptr<RenderedFrame> core;
    if (scene_ != nullptr) {
      FP_ASSIGN_OR_RETURN(core, scene_->StartFrame(frame));
    }
    return std::make_unique<FaultyFrame>(std::move(core), frame, faults_, random_);
  }

 private:
  const std::shared_ptr<const RenderedScene> scene_;
  const RendererFaults faults_;
  const std::shared_ptr<std::mt19937_64> random_;
};

class FaultyRenderer final : public TileRenderer {
 public:
  explicit FaultyRenderer(const RendererFaults& faults)
      : faults_(faults),
        core_(faults.null ? nullptr : MakeCoreRenderer()),
        random_(std::make_shared<std::mt19937_64>(faults.seed)) {}
  absl::StatusOr<std::shared_ptr<const RenderedScene>> LoadScene(
      const BakedScene& blobs, Executor& executor) const override {
    std::shared_ptr<const RenderedScene> scene;
    if (core_ != nullptr) {
      FP_ASSIGN_OR_RETURN(scene, core_->LoadScene(blobs, executor));
    }
    return std::make_shared<const FaultyScene>(std::move(scene), faults_, random_);
  }

 private:
  const RendererFaults faults_;
  const std::unique_ptr<TileRenderer> core_;
  const std::shared_ptr<std::mt19937_64> random_;
};

// NAME=VALUE.
class Values {
 public:
  explicit Values(const std::vector<std::string>& args) {
    for (const std::string& arg : args) {
      const size_t at = arg.find('=');
      if (at != std::string::npos) values_[arg.substr(0, at)] = arg.substr(at + 1);
    }
  }
  std::string Text(const std::string& name) const {
    const auto at = values_.find(name);
    return at == values_.end() ? std::string() : at->second;
  }
  double Number(const std::string& name, double otherwise) const {
    const std::string text = Text(name);
    return text.empty() ? otherwise : std::strtod(text.c_str(), nullptr);
  }
  // "X,Y"; -1, -1 if it is absent.
  std::pair<int, int> Place(const std::string& name) const {
    int x = -1, y = -1;
    if (std::sscanf(Text(name).c_str(), "%d,%d", &x, &y) != 2) return {-1, -1};
    return {x, y};
  }

 private:
  std::map<std::string, std::string> values_;
};

int Say(const absl::Status& status) {
  if (status.ok()) return 0;
  std::fprintf(stderr, "%s\n", status.ToString().c_str());
  return 42;
}

sigset_t BlockStopSignals() {
  sigset_t signals;
  sigemptyset(&signals);
  sigaddset(&signals, SIGTERM);
  ::pthread_sigmask(SIG_BLOCK, &signals, nullptr);
  return signals;
}

absl::Status RunWorker(const Values& values) {
  const sigset_t signals = BlockStopSignals();
  RendererFaults faults;
  faults.null = values.Text("render") == "null";
  faults.tile_ms = static_cast<int>(values.Number("tile_ms", 0));
  std::tie(faults.crash_x, faults.crash_y) = values.Place("crash");
  std::tie(faults.hang_x, faults.hang_y) = values.Place("hang");
  std::tie(faults.spin_x, faults.spin_y) = values.Place("spin");
  faults.wrong = values.Number("wrong", 0);
  faults.fails = values.Number("fails", 0) != 0;
  faults.seed = static_cast<uint64_t>(values.Number("seed", 1));
  WorkerOptions options;
  options.threads = 1;
  options.name = values.Text("name");
  {
    Executor executor(1);
    FP_ASSIGN_OR_RETURN(options.fingerprint, ComputeFingerprint(executor));
  }
  options.log = [](const WorkerLogEntry& entry) {
    std::fprintf(stderr, "%s\n", entry.text.c_str());
  };
  const std::unique_ptr<GrpcLink> link = GrpcLink::Connect(values.Text("coordinator"));
  FP_ASSIGN_OR_RETURN(const std::unique_ptr<BlobCache> cache,
                      BlobCache::Open({.directory = values.Text("cache")}, *link));
  const std::unique_ptr<TileRenderer> renderer = MakeFaultyRenderer(faults);
  Worker worker(options, *link, *cache, *renderer);
  const CrashReporter crashes([&](const std::string& cause) { worker.ReportCrash(cause); });
  std::atomic<bool> ended = false;
  std::thread stopper([&] {
    const timespec step{0, 50'000'000};
    while (!ended) {
      if (::sigtimedwait(&signals, nullptr, &step) > 0) worker.Stop();
    }
  });
  const absl::Status status = worker.Run();
  ended = true;
  stopper.join();
  return status;
}

absl::Status RunServer(const Values& values) {
  const sigset_t signals = BlockStopSignals();
  const auto kill_at = static_cast<int64_t>(values.Number("kill_at", 0));
  const auto passed = std::make_shared<std::atomic<int64_t>>(0);
  CoordinatorOptions options;
  options.store_directory = values.Text("store");
  options.baker = MakeCoreBaker(1, 64 << 20);
  options.heartbeat = milliseconds(100);
  options.silence_time = milliseconds(2000);
  options.log = [](const CoordinatorLogEntry& entry) {
    std::fprintf(stderr, "%s\n", entry.text.c_str());
  };
  options.store_hook = [=](std::string_view point) {
    if (++*passed != kill_at) return;
    std::fprintf(stderr, "dies %.*s\n", static_cast<int>(point.size()), point.data());
    ::kill(::getpid(), SIGKILL);
  };
  FP_ASSIGN_OR_RETURN(const std::unique_ptr<Coordinator> coordinator,
                      Coordinator::Open(std::move(options)));
  FP_ASSIGN_OR_RETURN(const std::unique_ptr<GrpcServer> server,
                      GrpcServer::Start(*coordinator, "127.0.0.1:" + values.Text("port")));
  std::printf("listening on 127.0.0.1:%d\n", server->port());
  std::fflush(stdout);
  int signal = 0;
  ::sigwait(&signals, &signal);
  coordinator->Drain();
  server->Shutdown(milliseconds(100));
  // How many points a job passes when nothing happens.
  std::printf("passed %lld points\n", static_cast<long long>(passed->load()));
  return absl::OkStatus();
}

absl::Status RunGetter(const Values& values) {
  const std::unique_ptr<GrpcLink> link = GrpcLink::Connect(values.Text("coordinator"));
  FP_ASSIGN_OR_RETURN(
      const std::unique_ptr<BlobCache> cache,
      BlobCache::Open(
          {.directory = values.Text("cache"), .shared_directory = values.Text("blob_dir")}, *link));
  FP_ASSIGN_OR_RETURN(const Digest digest, Digest::FromHex(values.Text("blob")));
  // A slow reader takes its time for each chunk.
  const std::chrono::microseconds pause(static_cast<int64_t>(values.Number("pause_us", 0)));
  return cache
      ->Get(digest,
            [&] {
              std::this_thread::sleep_for(pause);
              return true;
            })
      .status();
}

}  // namespace

std::unique_ptr<TileRenderer> MakeFaultyRenderer(const RendererFaults& faults) {
  return std::make_unique<FaultyRenderer>(faults);
}

int RunServiceActor(const std::vector<std::string>& args) {
  const std::string role = args.empty() ? "" : args.front();
  const Values values(args);
  if (role == "worker") return Say(RunWorker(values));
  if (role == "server") return Say(RunServer(values));
  if (role == "getter") return Say(RunGetter(values));
  std::fprintf(stderr, "no role '%s'\n", role.c_str());
  return 2;
}

}  // namespace farpoint

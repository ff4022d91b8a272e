#include "worker/worker.h"

#include <gtest/gtest.h>

#include <atomic>
#include <condition_variable>
#include <deque>
#include <mutex>
#include <thread>

#include "core/image/film.h"
#include "server/coordinator.h"
#include "tests/unit/server/fake_render.h"
#include "tests/unit/server/temp_folder.h"
#include "worker/blob_cache.h"
#include "worker/in_process_link.h"

namespace farpoint {
namespace {

using std::chrono::milliseconds;

// A coordinator that does what the test says.
class FakeLink final : public CoordinatorLink, public BlobSource {
 public:
  absl::StatusOr<WorkerWelcome> Register(const WorkerHello&) override {
    std::lock_guard lock(mutex);
    ++registrations;
    changed.notify_all();
    if (!register_errors.empty()) {
      const absl::Status error = register_errors.front();
      register_errors.pop_front();
      return error;
    }
    return WorkerWelcome{.id = {"w" + std::to_string(registrations)},
                         .heartbeat = milliseconds(5),
                         .max_wait = milliseconds(10)};
  }
  absl::StatusOr<std::optional<TileWork>> Lease(const WorkerId&, milliseconds wait) override {
    std::unique_lock lock(mutex);
    if (cancelled) return absl::CancelledError("stop");
    if (!lease_errors.empty()) {
      const absl::Status error = lease_errors.front();
      lease_errors.pop_front();
      return error;
    }
    if (works.empty()) {
      changed.wait_for(lock, wait);
      return std::nullopt;
    }
    const TileWork work = works.front();
    works.pop_front();
    return work;
  }
  absl::StatusOr<RenewAnswer> Renew(const WorkerId&, const LeaseId& lease,
                                    const LeaseProgress& progress) override {
    std::lock_guard lock(mutex);
    ++renewals;
    last_progress = progress;
    changed.notify_all();
    if (unknown) return absl::NotFoundError("who?");
    return RenewAnswer{.drop = drop == lease, .reason = "told so"};
  }
  absl::StatusOr<ReturnAnswer> Return(const WorkerId&, const TileResult& result) override {
    std::lock_guard lock(mutex);
    if (!return_errors.empty()) {
      const absl::Status error = return_errors.front();
      return_errors.pop_front();
      changed.notify_all();
      return error;
    }
    returned.push_back(result);
    changed.notify_all();
    return ReturnAnswer{.accepted = true};
  }
  absl::Status ReportFailure(const WorkerId&, const LeaseId& lease, bool given_back,
                             const absl::Status& error) override {
    std::lock_guard lock(mutex);
    failures.push_back({lease, given_back, error});
    changed.notify_all();
    return absl::OkStatus();
  }
  absl::Status Leave(const WorkerId& id) override {
    std::lock_guard lock(mutex);
    left.push_back(id);
    return absl::OkStatus();
  }
  void CancelWaits() override {
    std::lock_guard lock(mutex);
    cancelled = true;
    changed.notify_all();
  }
  absl::StatusOr<Blob> Get(const Digest&, const std::function<bool()>&) override {
    return Blob::FromString("scene");
  }

  template <typename Condition>
  bool WaitFor(Condition condition) {
    std::unique_lock lock(mutex);
    return changed.wait_for(lock, std::chrono::seconds(10), condition);
  }
  void Give(const std::string& lease) {
    std::lock_guard lock(mutex);
    TileWork work;
    work.lease = {lease};
    work.attempt = 1;
    work.job = {"job"};
    work.rect = {0, 0, 32, 32};
    work.frame.film = {.width = 32, .height = 32, .crop = {0, 0, 32, 32}};
    work.frame.settings.layers = {Layer::kBeauty};
    work.blobs.prepared_scene = Sha256().Update("scene").Finish();
    works.push_back(work);
    changed.notify_all();
  }

  struct Failure {
    LeaseId lease;
    bool given_back;
    absl::Status error;
  };
  std::mutex mutex;
  std::condition_variable changed;
  std::deque<absl::Status> register_errors, lease_errors, return_errors;
  std::deque<TileWork> works;
  int registrations = 0, renewals = 0;
  LeaseProgress last_progress;
  LeaseId drop;
  bool unknown = false, cancelled = false;
  std::vector<TileResult> returned;
  std::vector<Failure> failures;
  std::vector<WorkerId> left;
};

class WorkerTest : public ::testing::Test {
 protected:
  ~WorkerTest() override { StopAndJoin(); }
  void Start(FakeFrame::Hook hook = {}, milliseconds drain = milliseconds(0)) {
    renderer_ = std::make_unique<FakeRenderer>(std::move(hook));
    WorkerOptions options;
    options.threads = 1;
    options.first_backoff = milliseconds(1);
    options.last_backoff = milliseconds(4);
    options.drain_time = drain;
    worker_ = std::make_unique<Worker>(options, link_, link_, *renderer_);
    thread_ = std::thread([this] { status_ = worker_->Run(); });
  }
  void StopAndJoin() {
    if (worker_) worker_->Stop();
    if (thread_.joinable()) thread_.join();
  }
  // A tile that renders until it is told to stop.
  static absl::Status UntilCancelled(const PixelRect&, const std::atomic<bool>* cancel) {
    while (!cancel->load()) std::this_thread::sleep_for(milliseconds(1));
    return absl::CancelledError("stopped");
  }
  FakeLink link_;
  std::unique_ptr<FakeRenderer> renderer_;
  std::unique_ptr<Worker> worker_;
  std::thread thread_;
  absl::Status status_ = absl::UnknownError("runs");
};

TEST_F(WorkerTest, RendersReturnsAndLeaves) {
  link_.Give("a");
  link_.Give("b");
  Start();
  ASSERT_TRUE(link_.WaitFor([&] { return link_.returned.size() == 2; }));
  StopAndJoin();
  EXPECT_TRUE(status_.ok()) << status_;
  EXPECT_EQ(link_.returned[1].lease, LeaseId{"b"});
  EXPECT_EQ(link_.left, std::vector<WorkerId>{{"w1"}});
  EXPECT_TRUE(link_.failures.empty());
}

TEST_F(WorkerTest, WaitsForACoordinatorThatIsNotThereYet) {
  link_.register_errors = {absl::UnavailableError("x"), absl::DeadlineExceededError("y")};
  link_.lease_errors = {absl::UnavailableError("x")};
  link_.return_errors = {absl::UnavailableError("x"), absl::UnavailableError("x")};
  link_.Give("a");
  Start();
  ASSERT_TRUE(link_.WaitFor([&] { return link_.returned.size() == 1; }));
  EXPECT_EQ(link_.registrations, 3);
}

TEST_F(WorkerTest, ARefusedRegistrationEndsIt) {
  link_.register_errors = {absl::FailedPreconditionError("another version")};
  Start();
  thread_.join();
  EXPECT_TRUE(absl::IsFailedPrecondition(status_)) << status_;
}

TEST_F(WorkerTest, RegistersAgainWhenItIsForgotten) {
  link_.lease_errors = {absl::NotFoundError("who?")};
  link_.Give("a");
  Start();
  ASSERT_TRUE(link_.WaitFor([&] { return link_.returned.size() == 1; }));
  EXPECT_EQ(link_.registrations, 2);
}

TEST_F(WorkerTest, HeartbeatsCarryProgress) {
  link_.Give("a");
  std::atomic<bool> finish = false;
  Start([&](const PixelRect&, const std::atomic<bool>*) {
    while (!finish) std::this_thread::sleep_for(milliseconds(1));
    return absl::OkStatus();
  });
  EXPECT_TRUE(link_.WaitFor([&] { return link_.renewals >= 3; }));
  finish = true;
  ASSERT_TRUE(link_.WaitFor([&] { return link_.returned.size() == 1; }));
  EXPECT_GT(link_.last_progress.counter, 0u);
}

TEST_F(WorkerTest, ADroppedTileIsLetGoSilently) {
  link_.Give("a");
  link_.drop = {"a"};
  std::atomic<int> tiles = 0;
  Start([&](const PixelRect& rect, const std::atomic<bool>* cancel) {
    return ++tiles == 1 ? UntilCancelled(rect, cancel) : absl::OkStatus();
  });
  link_.Give("b");
  ASSERT_TRUE(link_.WaitFor([&] { return link_.returned.size() == 1; }));
  EXPECT_EQ(link_.returned[0].lease, LeaseId{"b"});
  EXPECT_TRUE(link_.failures.empty());
}

TEST_F(WorkerTest, AForgottenWorkerDropsItsTileAndRegistersAgain) {
  link_.Give("a");
  link_.unknown = true;
  Start(UntilCancelled);
  ASSERT_TRUE(link_.WaitFor([&] { return link_.registrations >= 2; }));
  EXPECT_TRUE(link_.returned.empty());
  EXPECT_TRUE(link_.failures.empty());
}

TEST_F(WorkerTest, FailuresAreReportedWithTheirCode) {
  link_.Give("a");
  Start([](const PixelRect&, const std::atomic<bool>*) {
    return absl::DataLossError("the tree is damaged");
  });
  ASSERT_TRUE(link_.WaitFor([&] { return link_.failures.size() == 1; }));
  EXPECT_FALSE(link_.failures[0].given_back);
  EXPECT_TRUE(absl::IsDataLoss(link_.failures[0].error));
}

TEST_F(WorkerTest, StopGivesTheTileBack) {
  link_.Give("a");
  std::atomic<bool> started = false;
  Start([&](const PixelRect& rect, const std::atomic<bool>* cancel) {
    started = true;
    return UntilCancelled(rect, cancel);
  });
  while (!started) std::this_thread::sleep_for(milliseconds(1));
  StopAndJoin();
  EXPECT_TRUE(status_.ok());
  ASSERT_EQ(link_.failures.size(), 1u);
  EXPECT_TRUE(link_.failures[0].given_back);
  EXPECT_EQ(link_.left.size(), 1u);
}

TEST_F(WorkerTest, StopWithTimeToDrainFinishesTheTile) {
  link_.Give("a");
  std::atomic<bool> started = false;
  Start(
      [&](const PixelRect&, const std::atomic<bool>*) {
        started = true;
        std::this_thread::sleep_for(milliseconds(50));
        return absl::OkStatus();
      },
      milliseconds(20000));
  while (!started) std::this_thread::sleep_for(milliseconds(1));
  StopAndJoin();
  EXPECT_TRUE(link_.failures.empty());
  EXPECT_EQ(link_.returned.size(), 1u);
}

// A coordinator whose disk is full must not be sent the tile over and over while a worker stops.
TEST_F(WorkerTest, ADrainingWorkerWaitsBetweenItsTries) {
  constexpr size_t kErrors = 1'000'000;
  link_.return_errors.assign(kErrors, absl::UnavailableError("the disk is full"));
  link_.Give("a");
  Start({}, milliseconds(200));
  EXPECT_TRUE(link_.WaitFor([&] { return link_.return_errors.size() < kErrors; }));
  StopAndJoin();
  // Half of a millisecond at least between two.
  EXPECT_LT(kErrors - link_.return_errors.size(), 2000u);
  ASSERT_EQ(link_.failures.size(), 1u);
  EXPECT_TRUE(link_.failures[0].given_back);
}

TEST_F(WorkerTest, StopBeforeRunEndsAtOnce) {
  const FakeRenderer renderer;
  Worker worker({.threads = 1}, link_, link_, renderer);
  worker.Stop();
  EXPECT_TRUE(worker.Run().ok());
  EXPECT_EQ(link_.registrations, 0);
}

// The embedded mode: coordinator and workers in one process, nothing on disk.
TEST(InProcess, TwoWorkersRenderAJob) {
  CoordinatorOptions options;
  options.baker = std::make_shared<FakeBaker>();
  auto coordinator = Coordinator::Open(std::move(options));
  ASSERT_TRUE(coordinator.ok()) << coordinator.status();
  const Blob blob = Blob::FromString("scene");
  ASSERT_TRUE((*coordinator)->PutBlob(blob.Hash(), blob).ok());
  JobSpec spec;
  spec.asset_root = "a.gltf";
  spec.asset_files["a.gltf"] = blob.Hash();
  spec.film = {.width = 200, .height = 100, .crop = {3, 5, 190, 99}};
  spec.settings.tile_px = 32;
  spec.settings.layers = {Layer::kBeauty};
  const auto job = (*coordinator)->Submit(spec, "");
  ASSERT_TRUE(job.ok()) << job.status();

  const FakeRenderer renderer;
  struct Embedded {
    Embedded(CoordinatorApi& api, const TileRenderer& renderer)
        : link(api),
          worker({.threads = 1, .fingerprint = Sha256().Update("f").Finish()}, link, link,
                 renderer),
          thread([this] { status = worker.Run(); }) {}
    InProcessLink<CoordinatorApi> link;
    Worker worker;
    absl::Status status;
    std::thread thread;
  };
  Embedded a(**coordinator, renderer), b(**coordinator, renderer);
  Film image(spec.film.crop, spec.settings.layers);
  uint64_t after = 0;
  bool ended = false;
  while (!ended) {
    const auto events = (*coordinator)->NextEvents(*job, after, milliseconds(1000));
    ASSERT_TRUE(events.ok()) << events.status();
    for (const JobEvent& event : *events) {
      if (event.sequence != 0) after = event.sequence;
      if (const auto* tile = std::get_if<TileCommitted>(&event.body)) {
        const auto film = DecodeFilm((*coordinator)->FetchTile(*job, tile->tile)->bytes.bytes());
        ASSERT_TRUE(film.ok());
        image.Paste(*film);
      }
      if (const auto* state = std::get_if<JobState>(&event.body)) {
        ASSERT_NE(*state, JobState::kFailed) << event.status.error;
        ended = *state == JobState::kDone;
      }
    }
  }
  for (Embedded* e : {&a, &b}) {
    e->worker.Stop();
    e->thread.join();
    EXPECT_TRUE(e->status.ok());
  }
  EXPECT_EQ(ImageHash(image), ImageHash(FakeTile(spec.film.crop, spec.settings.layers)));
}

// A coordinator's blobs as a worker on another machine gets them.
class CountingStreamer final : public BlobStreamer {
 public:
  explicit CountingStreamer(CoordinatorApi& api) : api_(api) {}
  absl::Status Stream(const Digest& digest, uint64_t offset, const Sink& sink) override {
    ++streams;
    FP_ASSIGN_OR_RETURN(const Blob blob, api_.GetBlob(digest));
    return sink(blob.size(), blob.bytes().subspan(offset));
  }
  std::atomic<int> streams = 0;

 private:
  CoordinatorApi& api_;
};

TEST(InProcess, ASecondJobOfASceneSendsNoBlob) {
  CoordinatorOptions options;
  const auto baker = std::make_shared<FakeBaker>();
  options.baker = baker;
  auto coordinator = Coordinator::Open(std::move(options));
  ASSERT_TRUE(coordinator.ok()) << coordinator.status();
  TempFolder folder;
  CountingStreamer streamer(**coordinator);
  auto cache = BlobCache::Open({.directory = folder.path()}, streamer);
  ASSERT_TRUE(cache.ok()) << cache.status();
  const FakeRenderer renderer;

  const Blob blob = Blob::FromString("scene");
  const std::vector<Digest> files = {blob.Hash()};
  int puts = 0;
  // Submits as a client does, renders by a worker that has started afresh.
  const auto render = [&](const JobSpec& spec) {
    const std::vector<Digest> missing = *(*coordinator)->FindMissing(files);
    for (const Digest& digest : missing) {
      ++puts;
      ASSERT_TRUE((*coordinator)->PutBlob(digest, blob).ok());
    }
    const auto job = (*coordinator)->Submit(spec, "");
    ASSERT_TRUE(job.ok()) << job.status();
    InProcessLink<CoordinatorApi> link(**coordinator);
    Worker worker({.threads = 1, .fingerprint = Sha256().Update("f").Finish()}, link, **cache,
                  renderer);
    std::thread thread([&] { EXPECT_TRUE(worker.Run().ok()); });
    uint64_t after = 0;
    for (int i = 0; i < 200 && (*coordinator)->Status(*job)->state != JobState::kDone; ++i) {
      const auto events = (*coordinator)->NextEvents(*job, after, milliseconds(100));
      if (!events->empty()) after = std::max(after, events->back().sequence);
    }
    EXPECT_EQ((*coordinator)->Status(*job)->state, JobState::kDone);
    worker.Stop();
    thread.join();
  };
  JobSpec spec;
  spec.asset_root = "a.gltf";
  spec.asset_files["a.gltf"] = blob.Hash();
  spec.film = {.width = 64, .height = 32, .crop = {0, 0, 64, 32}};
  spec.settings.tile_px = 32;
  spec.settings.layers = {Layer::kBeauty};
  ASSERT_NO_FATAL_FAILURE(render(spec));
  EXPECT_EQ(puts, 1);
  EXPECT_EQ(streamer.streams.load(), 2);  // the scene and the topology; the fake bakes no radiance
  // Another camera and other frames of a scene that stands still: not one byte of it.
  spec.camera = LookAt{.eye = {0, 0, 5}, .target = {0, 0, 0}};
  ASSERT_NO_FATAL_FAILURE(render(spec));
  spec.frames = {1, 2, 3};
  ASSERT_NO_FATAL_FAILURE(render(spec));
  EXPECT_EQ(puts, 1);
  EXPECT_EQ(streamer.streams.load(), 2);
  EXPECT_EQ(baker->bakes.load(), 1);
}

}  // namespace
}  // namespace farpoint

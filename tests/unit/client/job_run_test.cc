#include "client/job_run.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <algorithm>
#include <map>
#include <set>

#include "client/farm_commands.h"
#include "tests/unit/client/sample_job.h"

namespace farpoint {
namespace {

using std::chrono::milliseconds;
using testing::ElementsAre;
using testing::HasSubstr;

// A coordinator in memory that fails where a test wants it to.
class FakeFarm final : public FarmLink {
 public:
  explicit FakeFarm(const StopFlag& stop) : stop(stop) {}
  const StopFlag& stop;
  // Each call first takes a status from here, if there is one.
  std::vector<absl::Status> failures;
  std::map<Digest, Blob> blobs;
  std::vector<Digest> put_order;
  std::map<std::string, JobId> submissions;
  SampleJob job = MakeSampleJob({96, 64, {0, 0, 96, 64}});
  std::vector<JobEvent> events;
  std::vector<uint64_t> watched_after;
  std::set<uint32_t> damage_once;  // tiles that arrive damaged the first time
  bool damage_always = false;
  int break_after_tiles = -1;  // of the next fetch
  int tiles_sent = 0;
  int infos = 0;
  // How many tiles are committed just before an event is sent; see UncommitAll.
  std::map<uint64_t, uint32_t> commits_before;

  void UncommitAll() {
    for (TileInfo& tile : job.info.tiles) tile.sha256 = {};
    job.info.status.state = JobState::kRendering;
    job.info.status.tiles.committed = job.info.status.frames.done = 0;
  }
  void CommitNext() {
    const uint32_t tile = job.info.status.tiles.committed++;
    job.info.tiles[tile].sha256 = job.tiles[tile].sha256;
  }

  absl::StatusOr<std::vector<Digest>> FindMissing(std::span<const Digest> asked) override {
    FP_RETURN_IF_ERROR(Next());
    std::vector<Digest> missing;
    for (const Digest& digest : asked) {
      if (!blobs.contains(digest)) missing.push_back(digest);
    }
    return missing;
  }
  absl::Status Put(const Digest& digest, const Blob& blob) override {
    FP_RETURN_IF_ERROR(Next());
    blobs[digest] = blob;
    put_order.push_back(digest);
    return absl::OkStatus();
  }
  absl::StatusOr<JobId> Submit(const JobSpec& spec, const std::string& submission_id) override {
    const JobId id =
        submissions.try_emplace(submission_id, JobId{std::to_string(submissions.size() + 1)})
            .first->second;
    FP_RETURN_IF_ERROR(Next());  // the job is made, the answer is lost
    return id;
  }
  absl::StatusOr<FarmStatus> Status(const JobId&) override {
    FP_RETURN_IF_ERROR(Next());
    FarmStatus status;
    status.jobs.push_back(job.info.status);
    return status;
  }
  absl::Status Cancel(const JobId&) override { return Next(); }
  absl::Status Pause(const JobId&) override { return Next(); }
  absl::Status Resume(const JobId&) override { return Next(); }
  absl::Status SetPriority(const JobId&, int32_t) override { return Next(); }
  absl::Status Requeue(const JobId&, bool) override { return Next(); }
  absl::StatusOr<Explanation> Explain(const JobId&) override { return Explanation{}; }
  absl::Status Watch(const JobId&, uint64_t after,
                     const std::function<absl::Status(const JobEvent&)>& on_event) override {
    watched_after.push_back(after);
    for (const JobEvent& event : events) {
      if (event.sequence != 0 && event.sequence <= after) continue;
      if (stop.raised()) return absl::CancelledError("stop");
      // What the coordinator knows grows with its events.
      for (uint32_t i = 0; i < commits_before[event.sequence]; ++i) CommitNext();
      FP_RETURN_IF_ERROR(on_event(event));
      if (event.sequence % 2 == 0) FP_RETURN_IF_ERROR(Next());
    }
    return absl::OkStatus();
  }
  absl::StatusOr<JobInfo> Info(const JobId&) override {
    FP_RETURN_IF_ERROR(Next());
    ++infos;
    return job.info;
  }
  absl::Status FetchTiles(const JobId&, std::span<const uint32_t> tiles,
                          const std::function<absl::Status(TileData)>& on_tile) override {
    FP_RETURN_IF_ERROR(Next());
    const std::vector<uint32_t> wanted(tiles.begin(), tiles.end());
    for (const uint32_t tile : wanted) {
      if (break_after_tiles-- == 0) return absl::UnavailableError("cut");
      ++tiles_sent;
      TileData data = job.tiles[tile];
      if (damage_always || damage_once.erase(tile) > 0) {
        data.bytes = Blob::FromString("damaged");
      }
      FP_RETURN_IF_ERROR(on_tile(std::move(data)));
    }
    return absl::OkStatus();
  }

 private:
  absl::Status Next() {
    if (failures.empty()) return absl::OkStatus();
    const absl::Status status = failures.front();
    failures.erase(failures.begin());
    return status;
  }
};

class JobRunTest : public testing::Test {
 protected:
  PreparedRequest Request(const std::vector<std::string>& contents) {
    PreparedRequest request;
    for (size_t i = 0; i < contents.size(); ++i) {
      const std::string uri = "file" + std::to_string(i);
      request.asset.files[uri] = Blob::FromString(contents[i]);
      request.spec.asset_files[uri] = request.asset.files[uri].Hash();
    }
    return request;
  }
  JobEvent Event(uint64_t sequence, JobState state, JobEventBody body = {}) {
    JobEvent event;
    event.sequence = sequence;
    event.body = std::move(body);
    event.status = farm_.job.info.status;
    event.status.state = state;
    return event;
  }

  // Every frame, as fetch does; their hashes go to `hashes_`.
  absl::Status FetchAll(bool partial = false) {
    FP_ASSIGN_OR_RETURN(const JobInfo info, run_.Info(JobId{"1"}));
    std::vector<uint32_t> frames;
    for (uint32_t i = 0; i < info.frames.size(); ++i) frames.push_back(i);
    FP_ASSIGN_OR_RETURN(fetched_, run_.Fetch(info, frames, partial, Sink()));
    return absl::OkStatus();
  }
  FrameSink Sink() {
    return [this](const JobInfo& info, FetchedFrame frame) {
      numbers_.push_back(info.frames[frame.frame].number);
      hashes_.push_back(ImageHash(frame.film));
      missing_.push_back(frame.missing_tiles);
      return sink_status_;
    };
  }
  Digest HashOfFrame(uint32_t frame) {
    return ImageHash(SampleFilm({0, 0, 96, 64}, {Layer::kBeauty, Layer::kDepth}, frame));
  }

  size_t fetched_ = 0;
  std::vector<int32_t> numbers_;
  std::vector<Digest> hashes_;
  std::vector<uint32_t> missing_;
  absl::Status sink_status_;
  StopFlag stop_;
  Console console_{stderr, false, ConsoleLevel::kOff, true};
  FakeFarm farm_{stop_};
  Retry retry_{{.first_wait = milliseconds(1),
                .longest_wait = milliseconds(1),
                .patience = milliseconds(200)},
               "coordinator fake:1",
               stop_,
               console_};
  JobRun run_{farm_, retry_, stop_, console_};
};

TEST_F(JobRunTest, SendsOnlyWhatIsMissing) {
  const PreparedRequest request = Request({"one", "two", "three", "two"});
  const Blob two = Blob::FromString("two");
  farm_.blobs[two.Hash()] = two;
  ASSERT_TRUE(run_.Submit(request).ok());
  EXPECT_EQ(farm_.put_order.size(), 2u);
  EXPECT_EQ(farm_.blobs.size(), 3u);
  ASSERT_TRUE(run_.Submit(request).ok());
  EXPECT_EQ(farm_.put_order.size(), 2u) << "nothing is sent twice";
  EXPECT_EQ(farm_.submissions.size(), 2u) << "two runs are two jobs";
}

TEST_F(JobRunTest, MakesOneJobThoughTheAnswerIsLost) {
  const PreparedRequest request = Request({"one"});
  // FindMissing, Put, Submit each fail once.
  farm_.failures = {absl::UnavailableError("a"), absl::OkStatus(), absl::UnavailableError("b"),
                    absl::OkStatus(), absl::DeadlineExceededError("c")};
  const auto id = run_.Submit(request);
  ASSERT_TRUE(id.ok()) << id.status();
  EXPECT_EQ(farm_.submissions.size(), 1u);
  EXPECT_EQ(id->value, "1");
}

TEST_F(JobRunTest, ARefusedJobIsRefusedAtOnce) {
  farm_.failures = {absl::OkStatus(), absl::OkStatus(), absl::InvalidArgumentError("too large")};
  EXPECT_EQ(run_.Submit(Request({"one"})).status(), absl::InvalidArgumentError("too large"));
}

TEST_F(JobRunTest, WatchesOnFromWhereItWasCutOff) {
  farm_.events = {Event(1, JobState::kBaking), Event(2, JobState::kRendering),
                  Event(0, JobState::kRendering), Event(3, JobState::kRendering),
                  Event(4, JobState::kDone, JobState::kDone)};
  farm_.failures = {absl::OkStatus(), absl::UnavailableError("restart")};
  // The event of sequence 0 takes the OK, the fourth the failure.
  ASSERT_TRUE(run_.Wait(JobId{"1"}).ok());
  farm_.watched_after.clear();
  farm_.failures = {absl::UnavailableError("restart")};
  ASSERT_TRUE(run_.Wait(JobId{"1"}).ok());
  EXPECT_THAT(farm_.watched_after, testing::ElementsAre(0u, 2u));
}

TEST_F(JobRunTest, AsksForTheStateIfTheEventsEndEarly) {
  farm_.events = {Event(1, JobState::kRendering)};
  EXPECT_TRUE(run_.Wait(JobId{"1"}).ok());
}

TEST_F(JobRunTest, HandsOnWhatAJobFailedOf) {
  JobEvent failed = Event(1, JobState::kFailed, JobState::kFailed);
  failed.status.error = absl::InvalidArgumentError("a.gltf: /meshes/0: no such accessor");
  farm_.events = {failed};
  const absl::Status status = run_.Wait(JobId{"1"});
  EXPECT_TRUE(absl::IsInvalidArgument(status));
  EXPECT_THAT(std::string(status.message()), HasSubstr("a.gltf: /meshes/0: no such accessor"));
  farm_.events = {Event(1, JobState::kCancelled)};
  const absl::Status cancelled = run_.Wait(JobId{"1"});
  EXPECT_TRUE(absl::IsCancelled(cancelled));
  EXPECT_THAT(std::string(cancelled.message()), HasSubstr("farpoint requeue"));
}

TEST(ControlText, SaysWhatToDoIfNothingWasDone) {
  JobStatus status;
  status.id = JobId{"a1"};
  status.state = JobState::kCancelled;
  EXPECT_EQ(ControlText(Verb::kCancel, status), "job a1 is cancelled");
  EXPECT_EQ(ControlText(Verb::kResume, status),
            "job a1 is cancelled; farpoint requeue a1 lets it go on");
  status.state = JobState::kDone;
  EXPECT_EQ(ControlText(Verb::kCancel, status), "job a1 is done; nothing was done");
  EXPECT_THAT(ControlText(Verb::kPriority, status), HasSubstr("of no effect"));
  status.state = JobState::kRendering;
  EXPECT_EQ(ControlText(Verb::kResume, status), "job a1 is rendering");
}

TEST_F(JobRunTest, StopsWaitingWhenASignalComes) {
  farm_.events = {Event(1, JobState::kRendering), Event(2, JobState::kDone)};
  stop_.Raise(15);
  EXPECT_TRUE(absl::IsCancelled(run_.Wait(JobId{"1"})));
}

TEST_F(JobRunTest, FetchesAndStitches) {
  ASSERT_TRUE(FetchAll().ok());
  EXPECT_THAT(hashes_, ElementsAre(HashOfFrame(0)));
  EXPECT_EQ(farm_.tiles_sent, 6);
}

TEST_F(JobRunTest, FetchesOnlyTheRestAfterABreak) {
  farm_.break_after_tiles = 4;
  ASSERT_TRUE(FetchAll().ok());
  EXPECT_EQ(farm_.tiles_sent, 6);
}

TEST_F(JobRunTest, FetchesADamagedTileAgain) {
  farm_.damage_once = {1, 4};
  ASSERT_TRUE(FetchAll().ok());
  EXPECT_EQ(farm_.tiles_sent, 8);
  EXPECT_THAT(hashes_, ElementsAre(HashOfFrame(0)));
}

TEST_F(JobRunTest, GivesUpOnTilesThatAreAlwaysDamaged) {
  farm_.damage_always = true;
  const absl::Status status = FetchAll();
  EXPECT_TRUE(absl::IsUnavailable(status));
  EXPECT_THAT(std::string(status.message()), HasSubstr("damaged"));
  EXPECT_TRUE(hashes_.empty());
}

TEST_F(JobRunTest, FetchesTheFramesThatAreComplete) {
  farm_.job = MakeSampleJob({96, 64, {0, 0, 96, 64}}, {10, 20, 30});
  farm_.job.info.tiles[7].sha256 = {};
  ASSERT_TRUE(FetchAll().ok());
  EXPECT_EQ(fetched_, 2u);
  EXPECT_THAT(numbers_, ElementsAre(10, 30));
  EXPECT_THAT(hashes_, ElementsAre(HashOfFrame(0), HashOfFrame(2)));
}

TEST_F(JobRunTest, FetchesWhatIsThereOfTheOthersIfThatIsWanted) {
  farm_.job = MakeSampleJob({96, 64, {0, 0, 96, 64}}, {10, 20, 30});
  farm_.job.info.tiles[7].sha256 = {};
  for (int tile = 12; tile < 18; ++tile) farm_.job.info.tiles[tile].sha256 = {};
  ASSERT_TRUE(FetchAll(/*partial=*/true).ok());
  EXPECT_THAT(numbers_, ElementsAre(10, 20)) << "30 has no tile at all";
  EXPECT_THAT(missing_, ElementsAre(0u, 1u));
}

TEST_F(JobRunTest, TheSinksErrorEndsTheFetch) {
  farm_.job = MakeSampleJob({96, 64, {0, 0, 96, 64}}, {10, 20, 30});
  sink_status_ = absl::ResourceExhaustedError("the disk is full");
  EXPECT_EQ(FetchAll(), sink_status_);
  EXPECT_THAT(numbers_, ElementsAre(10));
}

TEST_F(JobRunTest, HandsOnEachFrameWhenItsLastTileIsIn) {
  farm_.job = MakeSampleJob({96, 64, {0, 0, 96, 64}}, {10, 20, 30});
  farm_.UncommitAll();
  // Six tiles a frame. The first frame is there with event 2, the others with event 4.
  farm_.commits_before = {{1, 2}, {2, 4}, {3, 3}, {4, 9}};
  for (uint64_t sequence = 1; sequence <= 5; ++sequence) {
    JobEvent event = Event(sequence, JobState::kRendering);
    event.status.frames.done = sequence < 2 ? 0 : sequence < 4 ? 1 : 3;
    farm_.events.push_back(event);
  }
  farm_.events.back().status.state = JobState::kDone;
  std::vector<uint32_t> committed;
  const FrameSink record = Sink();
  const absl::Status status = run_.Wait(JobId{"1"}, [&](const JobInfo& info, FetchedFrame frame) {
    committed.push_back(info.status.tiles.committed);
    return record(info, std::move(frame));
  });
  ASSERT_TRUE(status.ok()) << status;
  EXPECT_THAT(numbers_, ElementsAre(10, 20, 30));
  EXPECT_THAT(hashes_, ElementsAre(HashOfFrame(0), HashOfFrame(1), HashOfFrame(2)));
  EXPECT_EQ(committed.front(), 6u) << "the first frame did not wait for the others";
  EXPECT_EQ(farm_.tiles_sent, 18) << "each tile once";
  EXPECT_LE(farm_.infos, 3);
}

TEST_F(JobRunTest, AFailedSequenceHandsOnWhatIsComplete) {
  farm_.job = MakeSampleJob({96, 64, {0, 0, 96, 64}}, {10, 20});
  farm_.UncommitAll();
  farm_.commits_before = {{1, 8}};
  JobEvent failed = Event(1, JobState::kFailed, JobState::kFailed);
  failed.status.frames.done = 1;
  failed.status.error = absl::InvalidArgumentError("tile 9 failed");
  farm_.events = {failed};
  EXPECT_TRUE(absl::IsInvalidArgument(run_.Wait(JobId{"1"}, Sink())));
  EXPECT_THAT(numbers_, ElementsAre(10));
}

TEST_F(JobRunTest, AFullDiskEndsTheWait) {
  farm_.job = MakeSampleJob({96, 64, {0, 0, 96, 64}}, {10, 20});
  JobEvent event = Event(1, JobState::kRendering);
  farm_.events = {event, Event(2, JobState::kDone)};
  sink_status_ = absl::ResourceExhaustedError("the disk is full");
  EXPECT_EQ(run_.Wait(JobId{"1"}, Sink()), sink_status_);
}

class ShownTiles : public JobRunTest {
 protected:
  void SetUp() override {
    farm_.UncommitAll();
    run_.ShowTiles([this](const JobInfo& info, uint32_t tile, const Film& film) {
      const PixelRect& rect = info.tiles[tile].rect;
      ASSERT_TRUE(film.rect().Contains(rect));
      const Film sample = SampleFilm(rect, {Layer::kBeauty, Layer::kDepth});
      EXPECT_EQ(film.Get(Layer::kBeauty, 1, rect.x0, rect.y0),
                sample.Get(Layer::kBeauty, 1, rect.x0, rect.y0));
      shown_.push_back(tile);
    });
    // Each tile is committed with its event; the last event ends the job.
    for (uint32_t tile = 0; tile < 6; ++tile) {
      farm_.commits_before[tile + 1] = 1;
      farm_.events.push_back(
          Event(tile + 1, JobState::kRendering, TileCommitted{tile, farm_.job.tiles[tile].sha256}));
    }
    farm_.events.push_back(Event(7, JobState::kDone, JobState::kDone));
    farm_.events.back().status.frames.done = 1;
  }
  std::vector<uint32_t> shown_;
};

TEST_F(ShownTiles, ComeBeforeTheFrameAndAreFetchedOnce) {
  size_t shown_before_frame = 0;
  const FrameSink record = Sink();
  const absl::Status status =
      run_.Wait(JobId{"0badcafe"}, [&](const JobInfo& info, FetchedFrame frame) {
        shown_before_frame = shown_.size();
        return record(info, std::move(frame));
      });
  ASSERT_TRUE(status.ok()) << status;
  EXPECT_EQ(shown_.front(), 0u);
  EXPECT_EQ(shown_before_frame, 6u);
  EXPECT_EQ(farm_.tiles_sent, 6) << "what was shown is not fetched again";
  EXPECT_THAT(hashes_, ElementsAre(HashOfFrame(0)));
}

TEST_F(ShownTiles, ADamagedOneIsLeftToTheFrame) {
  farm_.damage_once = {0};
  const absl::Status status = run_.Wait(JobId{"0badcafe"}, Sink());
  ASSERT_TRUE(status.ok()) << status;
  EXPECT_THAT(shown_, testing::UnorderedElementsAre(0, 1, 2, 3, 4, 5));
  EXPECT_EQ(farm_.tiles_sent, 7);
  EXPECT_THAT(hashes_, ElementsAre(HashOfFrame(0)));
}

TEST_F(ShownTiles, OneThatCannotBeHadIsNoError) {
  // The question for the job's tiles fails, for good.
  farm_.failures = {absl::NotFoundError("gone")};
  const absl::Status status = run_.Wait(JobId{"0badcafe"}, Sink());
  ASSERT_TRUE(status.ok()) << status;
  EXPECT_TRUE(farm_.failures.empty());
  EXPECT_THAT(shown_, testing::UnorderedElementsAre(0, 1, 2, 3, 4, 5));
  EXPECT_THAT(hashes_, ElementsAre(HashOfFrame(0)));
}

TEST_F(ShownTiles, NobodyFetchesForNoViewer) {
  run_.ShowTiles(nullptr);
  ASSERT_TRUE(run_.Wait(JobId{"0badcafe"}).ok());
  EXPECT_EQ(farm_.tiles_sent, 0);
  EXPECT_EQ(farm_.watched_after.size(), 1u);
}

TEST(OutcomeOf, IsOkOnlyForADoneJob) {
  JobStatus status;
  status.state = JobState::kDone;
  EXPECT_TRUE(OutcomeOf(status).ok());
  status.state = JobState::kFailed;
  EXPECT_TRUE(absl::IsInternal(OutcomeOf(status)));
  status.state = JobState::kBaking;
  EXPECT_THAT(std::string(OutcomeOf(status).message()), HasSubstr("baking"));
  status.state = JobState::kPaused;
  EXPECT_TRUE(absl::IsUnavailable(OutcomeOf(status)));
  EXPECT_THAT(std::string(OutcomeOf(status).message()), HasSubstr("farpoint resume"));
}

}  // namespace
}  // namespace farpoint

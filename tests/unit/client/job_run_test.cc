#include "client/job_run.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <algorithm>
#include <map>
#include <set>

#include "tests/unit/client/sample_job.h"

namespace farpoint {
namespace {

using std::chrono::milliseconds;
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
  absl::Status Watch(const JobId&, uint64_t after,
                     const std::function<void(const JobEvent&)>& on_event) override {
    watched_after.push_back(after);
    for (const JobEvent& event : events) {
      if (event.sequence != 0 && event.sequence <= after) continue;
      if (stop.raised()) return absl::CancelledError("stop");
      on_event(event);
      if (event.sequence % 2 == 0) FP_RETURN_IF_ERROR(Next());
    }
    return absl::OkStatus();
  }
  absl::StatusOr<JobInfo> Info(const JobId&) override {
    FP_RETURN_IF_ERROR(Next());
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
  EXPECT_TRUE(absl::IsCancelled(run_.Wait(JobId{"1"})));
}

TEST_F(JobRunTest, StopsWaitingWhenASignalComes) {
  farm_.events = {Event(1, JobState::kRendering), Event(2, JobState::kDone)};
  stop_.Raise(15);
  EXPECT_TRUE(absl::IsCancelled(run_.Wait(JobId{"1"})));
}

TEST_F(JobRunTest, FetchesAndStitches) {
  const auto job = run_.Fetch(JobId{"1"});
  ASSERT_TRUE(job.ok()) << job.status();
  EXPECT_EQ(ImageHash(job->film),
            ImageHash(SampleFilm({0, 0, 96, 64}, {Layer::kBeauty, Layer::kDepth})));
  EXPECT_EQ(farm_.tiles_sent, 6);
}

TEST_F(JobRunTest, FetchesOnlyTheRestAfterABreak) {
  farm_.break_after_tiles = 4;
  ASSERT_TRUE(run_.Fetch(JobId{"1"}).ok());
  EXPECT_EQ(farm_.tiles_sent, 6);
}

TEST_F(JobRunTest, FetchesADamagedTileAgain) {
  farm_.damage_once = {1, 4};
  const auto job = run_.Fetch(JobId{"1"});
  ASSERT_TRUE(job.ok()) << job.status();
  EXPECT_EQ(farm_.tiles_sent, 8);
  EXPECT_EQ(ImageHash(job->film),
            ImageHash(SampleFilm({0, 0, 96, 64}, {Layer::kBeauty, Layer::kDepth})));
}

TEST_F(JobRunTest, GivesUpOnTilesThatAreAlwaysDamaged) {
  farm_.damage_always = true;
  const auto job = run_.Fetch(JobId{"1"});
  EXPECT_TRUE(absl::IsUnavailable(job.status()));
  EXPECT_THAT(std::string(job.status().message()), HasSubstr("damaged"));
}

TEST_F(JobRunTest, DoesNotFetchWhatIsNotDone) {
  farm_.job.info.status.state = JobState::kRendering;
  EXPECT_TRUE(absl::IsUnavailable(run_.Fetch(JobId{"1"}).status()));
}

TEST(OutcomeOf, IsOkOnlyForADoneJob) {
  JobStatus status;
  status.state = JobState::kDone;
  EXPECT_TRUE(OutcomeOf(status).ok());
  status.state = JobState::kFailed;
  EXPECT_TRUE(absl::IsInternal(OutcomeOf(status)));
  status.state = JobState::kBaking;
  EXPECT_THAT(std::string(OutcomeOf(status).message()), HasSubstr("baking"));
}

}  // namespace
}  // namespace farpoint

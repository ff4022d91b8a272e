// A coordinator with a fake bake, and the moves of its clients and workers.
#pragma once

#include <gtest/gtest.h>

#include <chrono>
#include <memory>
#include <string>
#include <thread>
#include <utility>
#include <variant>

#include "server/coordinator.h"
#include "tests/unit/server/fake_render.h"

namespace farpoint {

using std::chrono::milliseconds;

inline Digest TestFingerprint() { return Sha256().Update("fingerprint").Finish(); }

class CoordinatorTest : public ::testing::Test {
 protected:
  void Open(const std::string& folder = "") {
    coordinator_.reset();
    CoordinatorOptions options;
    options.store_directory = folder;
    options.baker = baker_;
    options.limits = limits_;
    options.silence_time = milliseconds(300);
    options.retention = retention_;
    options.audit_fraction = audit_fraction_;
    auto opened = Coordinator::Open(std::move(options));
    ASSERT_TRUE(opened.ok()) << opened.status();
    coordinator_ = *std::move(opened);
  }
  JobSpec Spec(const std::string& content = "scene", int width = 64, int height = 32) {
    JobSpec spec;
    const Blob blob = Blob::FromString(content);
    spec.asset_root = "a.gltf";
    spec.asset_files["a.gltf"] = blob.Hash();
    spec.film = {.width = width, .height = height, .crop = {0, 0, width, height}};
    spec.settings.tile_px = 32;
    spec.settings.layers = {Layer::kBeauty, Layer::kDepth};
    EXPECT_TRUE(coordinator_->PutBlob(blob.Hash(), blob).ok());
    return spec;
  }
  JobId SubmitOrDie(const JobSpec& spec, const std::string& submission = "") {
    const auto id = coordinator_->Submit(spec, submission);
    EXPECT_TRUE(id.ok()) << id.status();
    return id.ok() ? *id : JobId{};
  }
  WorkerId RegisterOrDie(const std::string& name = "w") {
    const auto welcome = coordinator_->Register({.version = FARPOINT_VERSION,
                                                 .fingerprint = TestFingerprint(),
                                                 .threads = 1,
                                                 .name = name});
    EXPECT_TRUE(welcome.ok()) << welcome.status();
    return welcome.ok() ? welcome->id : WorkerId{};
  }
  TileWork LeaseOrDie(const WorkerId& worker) {
    const auto work = coordinator_->Lease(worker, milliseconds(5000));
    EXPECT_TRUE(work.ok() && work->has_value()) << work.status();
    return work.ok() && work->has_value() ? **work : TileWork{};
  }
  static TileResult Render(const TileWork& work) {
    TileResult result;
    result.lease = work.lease;
    result.attempt = work.attempt;
    result.bytes = Blob::FromVector(EncodeFilm(FakeTile(work.rect, work.frame.settings.layers)));
    result.sha256 = result.bytes.Hash();
    result.stats.counts["receivers"] = static_cast<uint64_t>(work.rect.area());
    return result;
  }
  // Waits for the state, watching events as a client does.
  JobState WaitForEnd(const JobId& job) {
    uint64_t after = 0;
    for (int i = 0; i < 200; ++i) {
      const auto events = coordinator_->NextEvents(job, after, milliseconds(100));
      EXPECT_TRUE(events.ok()) << events.status();
      if (!events.ok()) break;
      for (const JobEvent& event : *events) {
        if (event.sequence == 0) continue;
        EXPECT_EQ(event.sequence, after + 1);
        after = event.sequence;
        if (const auto* state = std::get_if<JobState>(&event.body); state && IsFinal(*state)) {
          EXPECT_TRUE(coordinator_->NextEvents(job, after, milliseconds(1000))->empty());
          return *state;
        }
      }
    }
    ADD_FAILURE() << "the job did not end";
    return JobState::kQueued;
  }

  std::shared_ptr<FakeBaker> baker_ = std::make_shared<FakeBaker>();
  JobLimits limits_;
  std::chrono::hours retention_{24};
  double audit_fraction_ = 0;
  std::unique_ptr<Coordinator> coordinator_;
};

}  // namespace farpoint

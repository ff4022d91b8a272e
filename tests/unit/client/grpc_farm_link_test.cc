#include "client/grpc_farm_link.h"

#include <gmock/gmock.h>
#include <grpcpp/grpcpp.h>
#include <gtest/gtest.h>

#include <atomic>
#include <chrono>
#include <functional>
#include <memory>
#include <mutex>
#include <thread>

#include "proto/convert.h"
#include "proto/farpoint.grpc.pb.h"
#include "tests/unit/client/sample_job.h"

namespace farpoint {
namespace {

using testing::HasSubstr;

// Says what a test tells it to say.
class FakeJobs final : public v1::JobService::Service {
 public:
  std::mutex mutex;
  std::vector<v1::TileChunk> chunks;  // change it under `mutex`
  v1::SubmitRequest submitted;
  std::vector<std::string> told;

  grpc::Status Submit(grpc::ServerContext*, const v1::SubmitRequest* request,
                      v1::SubmitResponse* response) override {
    submitted = *request;
    response->set_job_id("0badcafe");
    return grpc::Status::OK;
  }
  grpc::Status Status(grpc::ServerContext*, const v1::StatusRequest* request,
                      v1::StatusResponse*) override {
    return {grpc::StatusCode::NOT_FOUND, "job " + request->job_id() + " is not known"};
  }
  grpc::Status Pause(grpc::ServerContext*, const v1::PauseRequest* request,
                     v1::PauseResponse*) override {
    told.push_back("pause " + request->job_id());
    return grpc::Status::OK;
  }
  grpc::Status Resume(grpc::ServerContext*, const v1::ResumeRequest* request,
                      v1::ResumeResponse*) override {
    told.push_back("resume " + request->job_id());
    return grpc::Status::OK;
  }
  grpc::Status SetPriority(grpc::ServerContext*, const v1::SetPriorityRequest* request,
                           v1::SetPriorityResponse*) override {
    told.push_back("priority " + request->job_id() + " " + std::to_string(request->priority()));
    return grpc::Status::OK;
  }
  grpc::Status Requeue(grpc::ServerContext*, const v1::RequeueRequest* request,
                       v1::RequeueResponse*) override {
    told.push_back("requeue " + request->job_id() + (request->all() ? " all" : ""));
    return grpc::Status::OK;
  }
  grpc::Status Explain(grpc::ServerContext*, const v1::ExplainRequest* request,
                       v1::ExplainResponse* response) override {
    response->add_lines("job " + request->job_id());
    response->add_lines("waits");
    return grpc::Status::OK;
  }
  // Sends one event, then says nothing for as long as the client listens.
  grpc::Status Watch(grpc::ServerContext* context, const v1::WatchRequest* request,
                     grpc::ServerWriter<v1::JobEvent>* writer) override {
    JobEvent event;
    event.sequence = request->after_sequence() + 1;
    event.body = std::string("a note");
    event.status.id = JobId{"0badcafe"};
    writer->Write(ToWire(event));
    while (!context->IsCancelled()) std::this_thread::sleep_for(std::chrono::milliseconds(5));
    return grpc::Status::CANCELLED;
  }
  grpc::Status FetchTiles(grpc::ServerContext*, const v1::FetchTilesRequest*,
                          grpc::ServerWriter<v1::TileChunk>* writer) override {
    // A copy: a client that gives up returns while this still writes, and the test goes on.
    std::vector<v1::TileChunk> sent;
    {
      std::lock_guard lock(mutex);
      sent = chunks;
    }
    for (const v1::TileChunk& chunk : sent) {
      if (!writer->Write(chunk)) break;
    }
    return grpc::Status::OK;
  }
};

class FakeBlobs final : public v1::BlobService::Service {
 public:
  std::string received, sha256;
  uint64_t announced = 0;
  size_t largest_chunk = 0;
  bool refuse = false;
  bool stall = false;

  grpc::Status FindMissing(grpc::ServerContext*, const v1::FindMissingRequest* request,
                           v1::FindMissingResponse* response) override {
    for (const std::string& hex : request->sha256()) response->add_sha256(hex);
    return grpc::Status::OK;
  }
  grpc::Status Put(grpc::ServerContext* context, grpc::ServerReader<v1::PutBlobChunk>* reader,
                   v1::PutBlobResponse*) override {
    if (refuse) return {grpc::StatusCode::RESOURCE_EXHAUSTED, "the store is full"};
    while (stall && !context->IsCancelled()) {
      std::this_thread::sleep_for(std::chrono::milliseconds(5));
    }
    v1::PutBlobChunk chunk;
    for (bool first = true; reader->Read(&chunk); first = false) {
      if (first) {
        sha256 = chunk.sha256();
        announced = chunk.size_bytes();
      }
      largest_chunk = std::max(largest_chunk, chunk.data().size());
      received += chunk.data();
    }
    return grpc::Status::OK;
  }
};

class GrpcFarmLinkTest : public testing::Test {
 protected:
  void SetUp() override {
    int port = 0;
    grpc::ServerBuilder builder;
    builder.AddListeningPort("127.0.0.1:0", grpc::InsecureServerCredentials(), &port);
    builder.RegisterService(&jobs_);
    builder.RegisterService(&blobs_);
    server_ = builder.BuildAndStart();
    ASSERT_NE(server_, nullptr);
    link_ = MakeGrpcFarmLink("127.0.0.1:" + std::to_string(port), stop_);
  }
  void TearDown() override {
    if (server_) server_->Shutdown(std::chrono::system_clock::now());
  }

  std::vector<v1::TileChunk> ChunksOf(const TileData& tile, size_t piece) {
    std::vector<v1::TileChunk> chunks;
    const auto bytes = tile.bytes.bytes();
    for (size_t at = 0; at < bytes.size(); at += piece) {
      v1::TileChunk chunk;
      chunk.set_tile(tile.tile);
      chunk.set_offset_bytes(at);
      chunk.set_size_bytes(bytes.size());
      chunk.set_sha256(ToWire(tile.sha256));
      chunk.set_data(bytes.data() + at, std::min(piece, bytes.size() - at));
      chunks.push_back(chunk);
    }
    return chunks;
  }
  absl::Status Fetch(std::vector<TileData>* tiles) {
    return link_->FetchTiles(JobId{"1"}, std::vector<uint32_t>{0, 1}, [&](TileData tile) {
      tiles->push_back(std::move(tile));
      return absl::OkStatus();
    });
  }

  StopFlag stop_;
  FakeJobs jobs_;
  FakeBlobs blobs_;
  std::unique_ptr<grpc::Server> server_;
  std::unique_ptr<FarmLink> link_;
};

TEST_F(GrpcFarmLinkTest, SendsABlobInPieces) {
  const std::string content(3 * kChunkBytes + 17, 'x');
  const Blob blob = Blob::FromString(content);
  ASSERT_TRUE(link_->Put(blob.Hash(), blob).ok());
  EXPECT_EQ(blobs_.received, content);
  EXPECT_EQ(blobs_.sha256, blob.Hash().Hex());
  EXPECT_EQ(blobs_.announced, content.size());
  EXPECT_LE(blobs_.largest_chunk, kChunkBytes);
}

TEST_F(GrpcFarmLinkTest, SendsAnEmptyBlobToo) {
  ASSERT_TRUE(link_->Put(Blob().Hash(), Blob()).ok());
  EXPECT_EQ(blobs_.sha256, Blob().Hash().Hex());
}

TEST_F(GrpcFarmLinkTest, HandsOnWhyABlobWasRefused) {
  blobs_.refuse = true;
  const Blob blob = Blob::FromString(std::string(8 << 20, 'x'));
  const absl::Status status = link_->Put(blob.Hash(), blob);
  EXPECT_TRUE(absl::IsResourceExhausted(status));
  EXPECT_THAT(std::string(status.message()), HasSubstr("store is full"));
}

TEST_F(GrpcFarmLinkTest, SubmitsWithItsProtocolVersion) {
  const SampleJob job = MakeSampleJob({64, 32, {0, 0, 64, 32}});
  const auto id = link_->Submit(job.info.spec, "submission");
  ASSERT_TRUE(id.ok()) << id.status();
  EXPECT_EQ(id->value, "0badcafe");
  EXPECT_EQ(jobs_.submitted.protocol_version(), kProtocolVersion);
  EXPECT_EQ(jobs_.submitted.submission_id(), "submission");
  EXPECT_EQ(jobs_.submitted.job().film().width_px(), 64u);
}

TEST_F(GrpcFarmLinkTest, HandsOnARefusal) {
  const absl::Status status = link_->Status(JobId{"77"}).status();
  EXPECT_TRUE(absl::IsNotFound(status));
  EXPECT_EQ(std::string(status.message()), "job 77 is not known");
}

TEST_F(GrpcFarmLinkTest, AnAbsentCoordinatorIsUnavailableAtOnce) {
  server_->Shutdown(std::chrono::system_clock::now());
  const auto start = std::chrono::steady_clock::now();
  EXPECT_TRUE(absl::IsUnavailable(link_->Status(JobId{"1"}).status()));
  EXPECT_LT(std::chrono::steady_clock::now() - start, std::chrono::seconds(5));
}

TEST_F(GrpcFarmLinkTest, TheLibraryWritesNothingOnItsOwn) {
  testing::internal::CaptureStderr();
  const auto link = MakeGrpcFarmLink("ipv4:no address:1", stop_);
  EXPECT_FALSE(link->Status(JobId{"1"}).ok());
  EXPECT_EQ(testing::internal::GetCapturedStderr(), "");
}

TEST_F(GrpcFarmLinkTest, ASignalEndsAWatch) {
  std::vector<uint64_t> sequences;
  std::atomic<bool> received{false};  // a signal before the event could overtake it
  std::thread raiser([&] {
    for (int i = 0; i < 1000 && !received; ++i) {
      std::this_thread::sleep_for(std::chrono::milliseconds(5));
    }
    stop_.Raise(2);
  });
  const absl::Status status = link_->Watch(JobId{"1"}, 41, [&](const JobEvent& event) {
    sequences.push_back(event.sequence);
    received = true;
    return absl::OkStatus();
  });
  raiser.join();
  EXPECT_TRUE(absl::IsCancelled(status)) << status;
  EXPECT_THAT(sequences, testing::ElementsAre(42u));
}

TEST_F(GrpcFarmLinkTest, TheReceiversErrorEndsTheWatch) {
  int events = 0;
  const absl::Status status = link_->Watch(JobId{"1"}, 0, [&](const JobEvent&) {
    ++events;
    return absl::AbortedError("enough");
  });
  EXPECT_EQ(status, absl::AbortedError("enough"));
  EXPECT_EQ(events, 1);
}

TEST_F(GrpcFarmLinkTest, CarriesWhatJobsAreToldToDo) {
  EXPECT_TRUE(link_->Pause(JobId{"a1"}).ok());
  EXPECT_TRUE(link_->Resume(JobId{"b2"}).ok());
  EXPECT_TRUE(link_->SetPriority(JobId{"c3"}, -7).ok());
  EXPECT_TRUE(link_->Requeue(JobId{"d4"}, false).ok());
  EXPECT_TRUE(link_->Requeue(JobId{"e5"}, true).ok());
  EXPECT_THAT(jobs_.told, testing::ElementsAre("pause a1", "resume b2", "priority c3 -7",
                                               "requeue d4", "requeue e5 all"));
  const auto explanation = link_->Explain(JobId{"f6"});
  ASSERT_TRUE(explanation.ok()) << explanation.status();
  EXPECT_THAT(explanation->lines, testing::ElementsAre("job f6", "waits"));
}

TEST_F(GrpcFarmLinkTest, ASignalEndsAnUpload) {
  blobs_.stall = true;
  // More than flow control lets through to a reader that does not read.
  const Blob blob = Blob::FromString(std::string(size_t{64} << 20, 'x'));
  std::thread raiser([&] {
    std::this_thread::sleep_for(std::chrono::milliseconds(100));
    stop_.Raise(2);
  });
  const absl::Status status = link_->Put(blob.Hash(), blob);
  raiser.join();
  EXPECT_TRUE(absl::IsCancelled(status)) << status;
}

TEST_F(GrpcFarmLinkTest, JoinsThePiecesOfTiles) {
  const SampleJob job = MakeSampleJob({64, 32, {0, 0, 64, 32}});
  for (const TileData& tile : job.tiles) {
    for (const v1::TileChunk& chunk : ChunksOf(tile, 1000)) jobs_.chunks.push_back(chunk);
  }
  std::vector<TileData> tiles;
  ASSERT_TRUE(Fetch(&tiles).ok());
  ASSERT_EQ(tiles.size(), 2u);
  for (size_t i = 0; i < 2; ++i) {
    EXPECT_EQ(tiles[i].tile, i);
    EXPECT_EQ(tiles[i].sha256, job.tiles[i].sha256);
    EXPECT_EQ(tiles[i].bytes.Hash(), job.tiles[i].sha256);
  }
}

TEST_F(GrpcFarmLinkTest, RefusesPiecesThatDoNotFit) {
  const SampleJob job = MakeSampleJob({64, 32, {0, 0, 64, 32}});
  const std::vector<v1::TileChunk> good = ChunksOf(job.tiles[0], 1000);
  ASSERT_GT(good.size(), 2u);
  const std::vector<std::function<void(std::vector<v1::TileChunk>&)>> damages = {
      [](auto& chunks) { chunks.erase(chunks.begin()); },
      [](auto& chunks) { chunks.erase(chunks.begin() + 1); },
      [](auto& chunks) { chunks[1].set_tile(9); },
      [](auto& chunks) { chunks[1].set_offset_bytes(999); },
      [](auto& chunks) { chunks[0].set_size_bytes(10); },
      [](auto& chunks) { chunks[0].set_size_bytes(uint64_t{1} << 60); },
      [](auto& chunks) { chunks[0].set_sha256("zz"); },
      [](auto& chunks) { chunks[1].clear_data(); },
  };
  for (size_t i = 0; i < damages.size(); ++i) {
    {
      std::lock_guard lock(jobs_.mutex);
      jobs_.chunks = good;
      damages[i](jobs_.chunks);
    }
    std::vector<TileData> tiles;
    EXPECT_FALSE(Fetch(&tiles).ok()) << i;
    EXPECT_TRUE(tiles.empty()) << i;
  }
}

TEST_F(GrpcFarmLinkTest, TheReceiversErrorEndsTheFetch) {
  const SampleJob job = MakeSampleJob({64, 32, {0, 0, 64, 32}});
  for (const TileData& tile : job.tiles) {
    for (const v1::TileChunk& chunk : ChunksOf(tile, 1000)) jobs_.chunks.push_back(chunk);
  }
  int received = 0;
  const absl::Status status =
      link_->FetchTiles(JobId{"1"}, std::vector<uint32_t>{0, 1}, [&](TileData) {
        ++received;
        return absl::DataLossError("enough");
      });
  EXPECT_EQ(status, absl::DataLossError("enough"));
  EXPECT_EQ(received, 1);
}

}  // namespace
}  // namespace farpoint

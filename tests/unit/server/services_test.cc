// The whole way over real sockets on loopback: a job by gRPC, two workers with a fake renderer, one
// of which vanishes in mid-tile.
#include <gmock/gmock.h>
#include <grpcpp/server.h>
#include <grpcpp/server_builder.h>
#include <gtest/gtest.h>

#include <atomic>
#include <thread>

#include "proto/convert.h"
#include "proto/farpoint.grpc.pb.h"
#include "proto/grpc_channel.h"
#include "proto/grpc_status.h"
#include "server/coordinator.h"
#include "server/coordinator_meter.h"
#include "server/grpc_server.h"
#include "tests/unit/server/fake_render.h"
#include "tests/unit/server/temp_folder.h"
#include "worker/blob_cache.h"
#include "worker/grpc_link.h"
#include "worker/worker.h"

namespace farpoint {
namespace {

using std::chrono::milliseconds;
using ::testing::HasSubstr;

class ServicesTest : public ::testing::Test {
 protected:
  void SetUp() override {
    CoordinatorOptions options;
    options.store_directory = folder_ / "store";
    options.baker = std::make_shared<FakeBaker>();
    options.heartbeat = milliseconds(50);
    options.silence_time = milliseconds(400);
    options.speculate_after = std::chrono::hours(1);
    auto coordinator = Coordinator::Open(std::move(options));
    ASSERT_TRUE(coordinator.ok()) << coordinator.status();
    coordinator_ = *std::move(coordinator);
    auto server = GrpcServer::Start(*coordinator_, "127.0.0.1:0");
    ASSERT_TRUE(server.ok()) << server.status();
    server_ = *std::move(server);
    address_ = "127.0.0.1:" + std::to_string(server_->port());
    channel_ = OpenChannel(address_);
    jobs_ = v1::JobService::NewStub(channel_);
    blobs_ = v1::BlobService::NewStub(channel_);
    workers_ = v1::WorkerService::NewStub(channel_);
  }

  struct Call : grpc::ClientContext {
    Call() { SetDeadline(*this, milliseconds(20000)); }
  };

  absl::Status Put(const std::string& name, const std::string& content, uint64_t size,
                   size_t chunk_bytes = 1000) {
    Call call;
    v1::PutBlobResponse response;
    const auto stream = blobs_->Put(&call, &response);
    v1::PutBlobChunk chunk;
    chunk.set_sha256(name);
    chunk.set_size_bytes(size);
    for (size_t at = 0; at < content.size() || at == 0; at += chunk_bytes) {
      chunk.set_data(content.substr(at, chunk_bytes));
      if (!stream->Write(chunk)) break;
      chunk.Clear();
    }
    stream->WritesDone();
    return FromGrpc(stream->Finish());
  }

  // A job of 16 tiles.
  v1::SubmitRequest Request() {
    const std::string content(5000, 'x');
    const Digest digest = Sha256().Update(content).Finish();
    EXPECT_TRUE(Put(digest.Hex(), content, content.size()).ok());
    JobSpec spec;
    spec.asset_root = "a.gltf";
    spec.asset_files["a.gltf"] = digest;
    spec.film = {.width = 128, .height = 128, .crop = {0, 0, 128, 128}};
    spec.settings.tile_px = 32;
    spec.settings.layers = {Layer::kBeauty, Layer::kDepth};
    v1::SubmitRequest request;
    request.set_protocol_version(kProtocolVersion);
    *request.mutable_job() = ToWire(spec);
    return request;
  }

  // A worker process in small.
  struct FarWorker {
    FarWorker(const std::string& address, const std::string& cache, FakeFrame::Hook hook)
        : link(GrpcLink::Connect(address)), renderer(std::move(hook)) {
      auto opened = BlobCache::Open({.directory = cache}, *link);
      EXPECT_TRUE(opened.ok());
      blobs = *std::move(opened);
      WorkerOptions options;
      options.threads = 1;
      options.name = cache;
      options.fingerprint = Sha256().Update("f").Finish();
      worker = std::make_unique<Worker>(options, *link, *blobs, renderer);
      thread = std::thread([this] { status = worker->Run(); });
    }
    ~FarWorker() { StopAndJoin(); }
    void StopAndJoin() {
      worker->Stop();
      if (thread.joinable()) thread.join();
    }
    std::unique_ptr<GrpcLink> link;
    std::unique_ptr<BlobCache> blobs;
    FakeRenderer renderer;
    std::unique_ptr<Worker> worker;
    absl::Status status = absl::UnknownError("runs");
    std::thread thread;
  };

  TempFolder folder_;
  std::unique_ptr<Coordinator> coordinator_;
  std::unique_ptr<GrpcServer> server_;
  std::string address_;
  std::shared_ptr<grpc::Channel> channel_;
  std::unique_ptr<v1::JobService::Stub> jobs_;
  std::unique_ptr<v1::BlobService::Stub> blobs_;
  std::unique_ptr<v1::WorkerService::Stub> workers_;
};

TEST_F(ServicesTest, JobsArePausedOrderedRequeuedAndExplained) {
  v1::SubmitRequest request = Request();
  request.mutable_job()->set_start_paused(true);
  for (const int frame : {3, 5}) request.mutable_job()->add_frames(frame);
  v1::SubmitResponse submitted;
  {
    Call call;
    ASSERT_TRUE(jobs_->Submit(&call, request, &submitted).ok());
  }
  const std::string& id = submitted.job_id();
  const auto status = [&] {
    Call call;
    v1::StatusRequest ask;
    ask.set_job_id(id);
    v1::StatusResponse answer;
    EXPECT_TRUE(jobs_->Status(&call, ask, &answer).ok());
    return *JobStatusFromWire(answer.jobs(0));
  };
  EXPECT_EQ(status().state, JobState::kPaused);
  EXPECT_EQ(status().frames.total, 2u);
  EXPECT_EQ(status().tiles.total, 32u);
  {
    Call call;
    v1::ExplainRequest ask;
    ask.set_job_id(id);
    v1::ExplainResponse answer;
    ASSERT_TRUE(jobs_->Explain(&call, ask, &answer).ok());
    EXPECT_THAT(ExplanationFromWire(answer)->lines.front(), HasSubstr("paused"));
  }
  {
    Call call;
    v1::SetPriorityRequest ask;
    ask.set_job_id(id);
    ask.set_priority(-3);
    v1::SetPriorityResponse answer;
    ASSERT_TRUE(jobs_->SetPriority(&call, ask, &answer).ok());
    EXPECT_EQ(status().priority, -3);
    ask.set_priority(5000);
    Call refused;
    EXPECT_EQ(jobs_->SetPriority(&refused, ask, &answer).error_code(),
              grpc::StatusCode::INVALID_ARGUMENT);
  }
  {
    Call call;
    v1::ResumeRequest ask;
    ask.set_job_id(id);
    v1::ResumeResponse answer;
    ASSERT_TRUE(jobs_->Resume(&call, ask, &answer).ok());
    EXPECT_NE(status().state, JobState::kPaused);
  }
  {
    Call call;
    v1::PauseRequest ask;
    ask.set_job_id(id);
    v1::PauseResponse answer;
    ASSERT_TRUE(jobs_->Pause(&call, ask, &answer).ok());
    EXPECT_EQ(status().state, JobState::kPaused);
  }
  ASSERT_TRUE(coordinator_->Cancel({id}).ok());
  {
    Call call;
    v1::RequeueRequest ask;
    ask.set_job_id(id);
    ask.set_all(true);
    v1::RequeueResponse answer;
    ASSERT_TRUE(jobs_->Requeue(&call, ask, &answer).ok());
  }
  FarWorker worker(address_, folder_ / "a", {});
  for (int i = 0; i < 500 && !IsFinal(status().state); ++i) {
    std::this_thread::sleep_for(milliseconds(20));
  }
  EXPECT_EQ(status().state, JobState::kDone);
  EXPECT_EQ(status().frames, (FrameCounts{.total = 2, .baked = 2, .done = 2}));
  Call call;
  v1::FetchInfoRequest ask;
  ask.set_job_id(id);
  v1::FetchInfoResponse answer;
  ASSERT_TRUE(jobs_->FetchInfo(&call, ask, &answer).ok());
  const auto info = JobInfoFromWire(answer);
  ASSERT_TRUE(info.ok()) << info.status();
  EXPECT_EQ(info->frames[1].number, 5);
  EXPECT_EQ(info->tiles[16].frame, 1u);
}

TEST_F(ServicesTest, TwoWorkersRenderAJobThoughAThirdVanishesInMidTile) {
  v1::SubmitResponse submitted;
  {
    Call call;
    const grpc::Status status = jobs_->Submit(&call, Request(), &submitted);
    ASSERT_TRUE(status.ok()) << status.error_message();
  }
  // The one that vanishes: it takes a tile and is never heard of again.
  {
    v1::RegisterResponse welcome;
    Call call;
    ASSERT_TRUE(workers_
                    ->Register(&call,
                               ToWire(WorkerHello{.version = FARPOINT_VERSION,
                                                  .fingerprint = Sha256().Update("f").Finish(),
                                                  .threads = 1,
                                                  .name = "vanishes"}),
                               &welcome)
                    .ok());
    v1::LeaseRequest request;
    request.set_worker_id(welcome.worker_id());
    request.set_wait_ms(5000);
    v1::LeaseResponse lease;
    Call lease_call;
    ASSERT_TRUE(workers_->Lease(&lease_call, request, &lease).ok());
    ASSERT_TRUE(lease.has_work());
  }
  const auto slowly = [](const PixelRect&, const std::atomic<bool>*) {
    std::this_thread::sleep_for(milliseconds(5));
    return absl::OkStatus();
  };
  FarWorker a(address_, folder_ / "a", slowly), b(address_, folder_ / "b", slowly);

  // Watch to the end; break off once and resume without a gap.
  uint64_t after = 0;
  std::set<uint32_t> committed;
  JobState end = JobState::kQueued;
  for (int round = 0; round < 2; ++round) {
    Call call;
    v1::WatchRequest request;
    request.set_job_id(submitted.job_id());
    request.set_after_sequence(after);
    const auto stream = jobs_->Watch(&call, request);
    v1::JobEvent wire;
    while (stream->Read(&wire)) {
      const absl::StatusOr<JobEvent> event = JobEventFromWire(wire);
      ASSERT_TRUE(event.ok()) << event.status();
      if (event->sequence == 0) continue;
      ASSERT_EQ(event->sequence, after + 1);
      after = event->sequence;
      if (const auto* tile = std::get_if<TileCommitted>(&event->body)) {
        EXPECT_TRUE(committed.insert(tile->tile).second) << "committed twice";
        if (round == 0) break;
      }
      if (const auto* state = std::get_if<JobState>(&event->body)) end = *state;
    }
    if (round == 0) {
      call.TryCancel();
      (void)stream->Finish();
    } else {
      EXPECT_TRUE(stream->Finish().ok());
    }
  }
  EXPECT_EQ(end, JobState::kDone);
  EXPECT_EQ(committed.size(), 16u);

  Call status_call;
  v1::StatusResponse status;
  ASSERT_TRUE(jobs_->Status(&status_call, v1::StatusRequest(), &status).ok());
  ASSERT_EQ(status.jobs_size(), 1);
  EXPECT_EQ(status.jobs(0).reissued(), 1u);
  EXPECT_GE(status.workers_size(), 2);

  // Stitch what FetchTiles sends.
  Film image({0, 0, 128, 128}, {Layer::kBeauty, Layer::kDepth});
  Call fetch_call;
  v1::FetchTilesRequest fetch;
  fetch.set_job_id(submitted.job_id());
  const auto stream = jobs_->FetchTiles(&fetch_call, fetch);
  v1::TileChunk chunk;
  int tiles = 0;
  while (stream->Read(&chunk)) {
    ASSERT_EQ(chunk.offset_bytes(), 0u);
    ASSERT_EQ(chunk.data().size(), chunk.size_bytes());
    const auto bytes = std::as_bytes(std::span(chunk.data().data(), chunk.data().size()));
    EXPECT_EQ(HashBytes(bytes).Hex(), chunk.sha256());
    const absl::StatusOr<Film> film = DecodeFilm(bytes);
    ASSERT_TRUE(film.ok());
    image.Paste(*film);
    ++tiles;
  }
  ASSERT_TRUE(stream->Finish().ok());
  EXPECT_EQ(tiles, 16);
  EXPECT_EQ(ImageHash(image),
            ImageHash(FakeTile({0, 0, 128, 128}, {Layer::kBeauty, Layer::kDepth})));

  a.StopAndJoin();
  b.StopAndJoin();
  EXPECT_TRUE(a.status.ok()) << a.status;
  EXPECT_TRUE(b.status.ok()) << b.status;
  EXPECT_EQ(a.renderer.loads + b.renderer.loads, 2);  // each loaded the scene once
}

TEST_F(ServicesTest, BlobsGoThereAndBackFromAnyOffset) {
  std::string content(3 * kChunkBytes + 17, '\0');
  for (size_t i = 0; i < content.size(); ++i) content[i] = static_cast<char>(i * 2654435761u >> 13);
  const Digest digest = Sha256().Update(content).Finish();
  Call find;
  v1::FindMissingRequest missing_request;
  missing_request.add_sha256(digest.Hex());
  v1::FindMissingResponse missing;
  ASSERT_TRUE(blobs_->FindMissing(&find, missing_request, &missing).ok());
  EXPECT_EQ(missing.sha256_size(), 1);
  ASSERT_TRUE(Put(digest.Hex(), content, content.size(), kChunkBytes).ok());

  const auto link = GrpcLink::Connect(address_);
  for (const size_t offset : {size_t{0}, kChunkBytes - 1, content.size() - 1, content.size()}) {
    std::string got;
    uint64_t size = 0;
    const absl::Status status =
        link->Stream(digest, offset, [&](uint64_t total, std::span<const std::byte> data) {
          size = total;
          got.append(reinterpret_cast<const char*>(data.data()), data.size());
          return absl::OkStatus();
        });
    ASSERT_TRUE(status.ok()) << status;
    EXPECT_EQ(size, content.size());
    EXPECT_EQ(got, content.substr(offset));
  }
  EXPECT_TRUE(absl::IsOutOfRange(
      link->Stream(digest, content.size() + 1, [](auto, auto) { return absl::OkStatus(); })));
  const Digest unknown = Sha256().Update("unknown").Finish();
  EXPECT_TRUE(
      absl::IsNotFound(link->Stream(unknown, 0, [](auto, auto) { return absl::OkStatus(); })));
}

TEST_F(ServicesTest, EveryChunkHasItsHash) {
  const std::string content(2 * kChunkBytes + 5, 'c');
  const Digest digest = Sha256().Update(content).Finish();
  ASSERT_TRUE(Put(digest.Hex(), content, content.size(), kChunkBytes).ok());
  for (const uint64_t offset : {uint64_t{0}, uint64_t{kChunkBytes}, uint64_t{kChunkBytes + 7}}) {
    Call call;
    v1::GetBlobRequest request;
    request.set_sha256(digest.Hex());
    request.set_offset_bytes(offset);
    const auto stream = blobs_->Get(&call, request);
    v1::GetBlobChunk chunk;
    uint64_t at = offset;
    while (stream->Read(&chunk)) {
      const Digest hash = Sha256().Update(chunk.data()).Finish();
      EXPECT_EQ(chunk.data_sha256(),
                std::string(reinterpret_cast<const char*>(hash.bytes.data()), hash.bytes.size()));
      at += chunk.data().size();
      // From the first whole chunk on, all begin where chunks do.
      EXPECT_TRUE(at % kChunkBytes == 0 || at == content.size());
    }
    EXPECT_TRUE(stream->Finish().ok());
    EXPECT_EQ(at, content.size());
  }
}

// Tells how often a worker has opened the stream by which its life is seen.
class CountsStreams final : public CoordinatorMeter {
 public:
  explicit CountsStreams(CoordinatorApi& coordinator)
      : CoordinatorMeter(coordinator, std::make_shared<StageMeter>()) {}
  absl::StatusOr<uint64_t> Attached(const WorkerId& worker) override {
    absl::StatusOr<uint64_t> connection = CoordinatorMeter::Attached(worker);
    if (connection.ok()) ++opened;
    return connection;
  }
  std::atomic<int> opened{0};
};

TEST_F(ServicesTest, ABrokenConnectionCostsTheLeaseBeforeSilenceDoes) {
  CoordinatorOptions options;
  options.baker = std::make_shared<FakeBaker>();
  options.silence_time = std::chrono::hours(1);  // so that nothing else can
  options.reconnect_time = milliseconds(50);
  auto coordinator = Coordinator::Open(std::move(options));
  ASSERT_TRUE(coordinator.ok());
  CountsStreams streams(**coordinator);
  auto server = GrpcServer::Start(streams, "127.0.0.1:0");
  ASSERT_TRUE(server.ok());
  const std::string address = "127.0.0.1:" + std::to_string((*server)->port());
  const Blob blob = Blob::FromString("scene");
  ASSERT_TRUE((*coordinator)->PutBlob(blob.Hash(), blob).ok());
  JobSpec spec;
  spec.asset_root = "a.gltf";
  spec.asset_files["a.gltf"] = blob.Hash();
  spec.film = {.width = 32, .height = 32, .crop = {0, 0, 32, 32}};
  const auto job = (*coordinator)->Submit(spec, "");
  ASSERT_TRUE(job.ok());
  const auto status = [&] { return *(*coordinator)->Status(*job); };
  const auto wait_for = [&](const auto& holds) {
    for (int i = 0; i < 2000 && !holds(); ++i) std::this_thread::sleep_for(milliseconds(5));
    return holds();
  };
  const WorkerHello hello{.version = FARPOINT_VERSION, .fingerprint = Sha256().Finish()};
  auto link = GrpcLink::Connect(address);
  const auto welcome = link->Register(hello);
  ASSERT_TRUE(welcome.ok()) << welcome.status();
  link->Attend(welcome->id);
  const auto work = link->Lease(welcome->id, milliseconds(5000));
  ASSERT_TRUE(work.ok() && work->has_value());
  // The stream may open a moment after the lease was given.
  ASSERT_TRUE(wait_for([&] { return streams.opened.load() == 1; }));
  EXPECT_EQ(status().tiles.leased, 1u);
  link.reset();
  EXPECT_TRUE(wait_for([&] { return status().tiles.leased == 0; }));
  EXPECT_EQ(status().reissued, 1u);
  // Nobody has left: it is known, and may come back.
  EXPECT_EQ((*coordinator)->Workers().size(), 1u);
  link = GrpcLink::Connect(address);
  link->Attend(welcome->id);
  const auto again = link->Lease(welcome->id, milliseconds(5000));
  ASSERT_TRUE(again.ok() && again->has_value()) << again.status();
  EXPECT_EQ((*again)->attempt, 2u);
}

// Answers nothing but how long each caller would wait.
class DeadlineKeeper final : public v1::WorkerService::Service {
 public:
  grpc::Status Register(grpc::ServerContext* c, const v1::RegisterRequest*,
                        v1::RegisterResponse*) override {
    return Note(c);
  }
  grpc::Status Lease(grpc::ServerContext* c, const v1::LeaseRequest*, v1::LeaseResponse*) override {
    return Note(c);
  }
  grpc::Status Renew(grpc::ServerContext* c, const v1::RenewRequest*, v1::RenewResponse*) override {
    return Note(c);
  }
  grpc::Status Return(grpc::ServerContext* c, grpc::ServerReader<v1::ReturnChunk>*,
                      v1::ReturnResponse*) override {
    return Note(c);
  }
  grpc::Status ReportFailure(grpc::ServerContext* c, const v1::ReportFailureRequest*,
                             v1::ReportFailureResponse*) override {
    return Note(c);
  }
  grpc::Status Leave(grpc::ServerContext* c, const v1::LeaveRequest*, v1::LeaveResponse*) override {
    return Note(c);
  }
  grpc::Status Attend(grpc::ServerContext* c, const v1::AttendRequest*,
                      grpc::ServerWriter<v1::AttendResponse>*) override {
    ++attends;
    return Note(c);
  }
  grpc::Status Note(grpc::ServerContext* context) {
    const auto left = context->deadline() - std::chrono::system_clock::now();
    ++calls;
    if (left > std::chrono::hours(2)) ++endless;
    return {grpc::StatusCode::UNIMPLEMENTED, "only looks"};
  }
  std::atomic<int> calls = 0, endless = 0, attends = 0;
};

TEST(WorkerLink, EveryCallHasADeadline) {
  DeadlineKeeper keeper;
  grpc::ServerBuilder builder;
  int port = 0;
  builder.AddListeningPort("127.0.0.1:0", grpc::InsecureServerCredentials(), &port);
  builder.RegisterService(&keeper);
  const std::unique_ptr<grpc::Server> server = builder.BuildAndStart();
  ASSERT_NE(server, nullptr);
  const auto link = GrpcLink::Connect("127.0.0.1:" + std::to_string(port));
  const WorkerId worker{"w"};
  TileResult result;
  result.lease = {"l"};
  result.bytes = Blob::FromString("bytes");
  EXPECT_FALSE(link->Register({.version = FARPOINT_VERSION}).ok());
  EXPECT_FALSE(link->Lease(worker, milliseconds(10)).ok());
  EXPECT_FALSE(link->Renew(worker, {"l"}, {}).ok());
  EXPECT_FALSE(link->Return(worker, result).ok());
  EXPECT_FALSE(link->ReportFailure(worker, {"l"}, true, absl::OkStatus()).ok());
  link->Attend(worker);
  for (int i = 0; i < 2000 && keeper.attends == 0; ++i) {
    std::this_thread::sleep_for(milliseconds(5));
  }
  EXPECT_FALSE(link->Leave(worker).ok());
  EXPECT_EQ(keeper.calls, 7);
  EXPECT_EQ(keeper.endless, 0);
  server->Shutdown();
}

TEST_F(ServicesTest, DamagedUploadsAreRefused) {
  const std::string content = "content";
  const Digest digest = Sha256().Update(content).Finish();
  EXPECT_TRUE(absl::IsDataLoss(Put(digest.Hex(), "contend", 7)));
  EXPECT_TRUE(absl::IsDataLoss(Put(digest.Hex(), "conten", 7)));
  EXPECT_TRUE(absl::IsInvalidArgument(Put(digest.Hex(), "content!", 7)));
  EXPECT_TRUE(absl::IsInvalidArgument(Put("abc", content, 7)));
  EXPECT_TRUE(absl::IsResourceExhausted(Put(digest.Hex(), content, uint64_t{1} << 60)));
  EXPECT_TRUE(absl::IsInvalidArgument(
      Put(digest.Hex(), std::string(kChunkBytes + 1, 'x'), kChunkBytes + 1, kChunkBytes + 1)));
  EXPECT_FALSE(coordinator_->GetBlob(digest).ok());
}

TEST_F(ServicesTest, NeighbouringProtocolsWorkTogether) {
  const auto submit = [&](uint32_t oldest, uint32_t newest) {
    v1::SubmitRequest request = Request();
    request.set_protocol_version(newest);
    request.set_oldest_protocol_version(oldest);
    v1::SubmitResponse response;
    Call call;
    return jobs_->Submit(&call, request, &response);
  };
  EXPECT_TRUE(submit(0, kOldestProtocolVersion).ok()) << "an older client that knows of no range";
  EXPECT_TRUE(submit(kProtocolVersion, kProtocolVersion + 1).ok()) << "a newer one";
  v1::RegisterRequest hello = ToWire(WorkerHello{.version = FARPOINT_VERSION,
                                                 .fingerprint = Sha256().Update("f").Finish(),
                                                 .threads = 1,
                                                 .name = "newer"});
  hello.set_protocol_version(kProtocolVersion + 1);
  v1::RegisterResponse welcome;
  Call call;
  EXPECT_TRUE(workers_->Register(&call, hello, &welcome).ok());
}

TEST_F(ServicesTest, AJobWithSomethingNewIsRefusedAndNotRenderedWithoutIt) {
  v1::SubmitRequest request = Request();
  v1::RenderSettings* settings = request.mutable_job()->mutable_settings();
  settings->GetReflection()->MutableUnknownFields(settings)->AddVarint(1000, 1);
  v1::SubmitResponse response;
  Call call;
  const grpc::Status status = jobs_->Submit(&call, request, &response);
  EXPECT_EQ(status.error_code(), grpc::StatusCode::FAILED_PRECONDITION);
  EXPECT_THAT(status.error_message(), HasSubstr("job.settings"));
}

TEST_F(ServicesTest, TheCoordinatorSaysHowItIs) {
  v1::DiagnoseResponse response;
  Call call;
  ASSERT_TRUE(jobs_->Diagnose(&call, {}, &response).ok());
  EXPECT_EQ(response.version(), FARPOINT_VERSION);
  EXPECT_EQ(response.protocol_version(), kProtocolVersion);
  EXPECT_EQ(response.oldest_protocol_version(), kOldestProtocolVersion);
  EXPECT_EQ(response.caller_role(), "") << "without TLS nobody is known";
  EXPECT_GE(response.connections(), 1u);
  EXPECT_GT(response.unix_ms(), 1'600'000'000'000);
}

TEST_F(ServicesTest, AnotherProtocolIsRefusedClearly) {
  v1::SubmitRequest request = Request();
  request.set_protocol_version(kProtocolVersion + 1);
  request.set_oldest_protocol_version(kProtocolVersion + 1);
  v1::SubmitResponse response;
  Call call;
  const grpc::Status status = jobs_->Submit(&call, request, &response);
  EXPECT_EQ(status.error_code(), grpc::StatusCode::FAILED_PRECONDITION);
  EXPECT_THAT(status.error_message(), HasSubstr("update the coordinator"));
  Call register_call;
  v1::RegisterResponse welcome;
  EXPECT_EQ(workers_->Register(&register_call, v1::RegisterRequest(), &welcome).error_code(),
            grpc::StatusCode::FAILED_PRECONDITION);
}

TEST_F(ServicesTest, MalformedMessagesAreInvalidArguments) {
  {
    Call call;
    v1::ReturnResponse response;
    const auto stream = workers_->Return(&call, &response);
    stream->Write(v1::ReturnChunk());
    stream->WritesDone();
    EXPECT_EQ(stream->Finish().error_code(), grpc::StatusCode::INVALID_ARGUMENT);
  }
  {
    Call call;
    v1::RenewRequest request;
    request.set_fraction(std::numeric_limits<float>::quiet_NaN());
    v1::RenewResponse response;
    EXPECT_EQ(workers_->Renew(&call, request, &response).error_code(),
              grpc::StatusCode::INVALID_ARGUMENT);
  }
  {
    Call call;
    v1::SubmitRequest request = Request();
    request.mutable_job()->mutable_settings()->set_spp(100000);
    v1::SubmitResponse response;
    EXPECT_EQ(jobs_->Submit(&call, request, &response).error_code(),
              grpc::StatusCode::INVALID_ARGUMENT);
  }
  {
    Call call;
    v1::GetBlobRequest request;
    request.set_sha256("../../etc/passwd");
    v1::GetBlobChunk chunk;
    const auto stream = blobs_->Get(&call, request);
    EXPECT_FALSE(stream->Read(&chunk));
    EXPECT_EQ(stream->Finish().error_code(), grpc::StatusCode::INVALID_ARGUMENT);
  }
}

TEST_F(ServicesTest, ATakenPortIsAnError) {
  const auto second = GrpcServer::Start(*coordinator_, address_);
  EXPECT_TRUE(absl::IsUnavailable(second.status())) << second.status();
}

TEST_F(ServicesTest, WorkersWaitForACoordinatorThatComesBack) {
  FarWorker worker(address_, folder_ / "w", {});
  while (coordinator_->Workers().empty()) std::this_thread::sleep_for(milliseconds(5));
  const std::string id = coordinator_->Workers()[0].id.value;
  server_.reset();
  coordinator_.reset();
  CoordinatorOptions options;
  options.store_directory = folder_ / "store";
  options.baker = std::make_shared<FakeBaker>();
  coordinator_ = *Coordinator::Open(std::move(options));
  auto server = GrpcServer::Start(*coordinator_, address_);
  ASSERT_TRUE(server.ok()) << server.status();
  server_ = *std::move(server);
  for (int i = 0; i < 2000 && coordinator_->Workers().empty(); ++i) {
    std::this_thread::sleep_for(milliseconds(10));
  }
  ASSERT_EQ(coordinator_->Workers().size(), 1u);
  EXPECT_NE(coordinator_->Workers()[0].id.value, id);
}

}  // namespace
}  // namespace farpoint

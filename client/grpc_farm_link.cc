#include "client/grpc_farm_link.h"

#include <grpc/support/log.h>
#include <grpcpp/grpcpp.h>

#include <algorithm>
#include <chrono>
#include <condition_variable>
#include <cstdlib>
#include <mutex>
#include <thread>
#include <utility>

#include "proto/convert.h"
#include "proto/farpoint.grpc.pb.h"
#include "proto/grpc_channel.h"
#include "proto/grpc_status.h"

namespace farpoint {
namespace {

using std::chrono::milliseconds;
using std::chrono::seconds;

constexpr seconds kControlDeadline(20);
constexpr seconds kDiagnoseDeadline(5);
// How long a call waits for a connection that was lost, before it says so.
constexpr milliseconds kReconnectTime(500);
constexpr seconds kInfoDeadline(60);
// A watch is renewed after so long; it then goes on where it was.
constexpr seconds kWatchDeadline(600);
// Bulk calls get time for their bytes at the slowest link that is worth using.
constexpr seconds kBulkDeadline(60);
constexpr size_t kSlowestBytesPerSecond = size_t{256} << 10;
constexpr uint64_t kMaxTileBytes = uint64_t{1} << 32;

// What the library writes to stderr on its own says nothing that a call's status does not say, and
// would stand in front of our error's one line. Who asks for it by GRPC_VERBOSITY gets it.
void SilenceLibrary() {
  static const bool silenced = [] {
    if (std::getenv("GRPC_VERBOSITY") == nullptr) {
      gpr_set_log_function([](gpr_log_func_args*) {});
    }
    return true;
  }();
  static_cast<void>(silenced);
}

absl::Status Damaged(std::string text) {
  return absl::UnavailableError("the coordinator's answer is damaged: " + std::move(text));
}

// The context of one call, with its deadline, cancelled when the flag is raised.
class Call {
 public:
  Call(grpc::Channel& channel, seconds time, const StopFlag& stop) {
    AwaitConnection(channel, kReconnectTime);
    context_.set_deadline(std::chrono::system_clock::now() + time);
    // A signal handler can wake nobody, so this looks at the flag now and then.
    watcher_ = std::thread([this, &stop] {
      std::unique_lock lock(mutex_);
      while (!ended_) {
        if (stop.raised()) return context_.TryCancel();
        wake_.wait_for(lock, milliseconds(20));
      }
    });
  }
  ~Call() {
    {
      std::lock_guard lock(mutex_);
      ended_ = true;
    }
    wake_.notify_one();
    watcher_.join();
  }
  grpc::ClientContext* context() { return &context_; }

 private:
  grpc::ClientContext context_;
  std::mutex mutex_;
  std::condition_variable wake_;
  bool ended_ = false;  // guarded by mutex_
  std::thread watcher_;
};

class GrpcFarmLink final : public FarmLink {
 public:
  GrpcFarmLink(const std::string& address, const StopFlag& stop, const ChannelSecurity& security)
      : stop_(stop),
        address_(address),
        security_(security),
        channel_(OpenChannel(address, security)),
        jobs_(v1::JobService::NewStub(channel_)),
        blobs_(v1::BlobService::NewStub(channel_)) {}

  absl::StatusOr<std::vector<Digest>> FindMissing(std::span<const Digest> blobs) override {
    Call call(*channel_, kControlDeadline, stop_);
    v1::FindMissingRequest request;
    for (const Digest& digest : blobs) request.add_sha256(ToWire(digest));
    v1::FindMissingResponse response;
    FP_RETURN_IF_ERROR(Outcome(blobs_->FindMissing(call.context(), request, &response)));
    std::vector<Digest> missing;
    for (const std::string& hex : response.sha256()) {
      FP_ASSIGN_OR_RETURN(const Digest digest, DigestFromWire(hex, "sha256"));
      missing.push_back(digest);
    }
    return missing;
  }

  absl::Status Put(const Digest& digest, const Blob& blob) override {
    Call call(*channel_, kBulkDeadline + seconds(blob.size() / kSlowestBytesPerSecond), stop_);
    v1::PutBlobResponse response;
    const auto writer = blobs_->Put(call.context(), &response);
    v1::PutBlobChunk chunk;
    chunk.set_sha256(ToWire(digest));
    chunk.set_size_bytes(blob.size());
    // At least one message, also for an empty blob.
    size_t at = 0;
    do {
      const size_t count = std::min(kChunkBytes, blob.size() - at);
      chunk.set_data(blob.bytes().data() + at, count);
      if (!writer->Write(chunk)) break;  // Finish() says why
      at += count;
      chunk.clear_sha256();
      chunk.clear_size_bytes();
    } while (at < blob.size());
    writer->WritesDone();
    return Outcome(writer->Finish());
  }

  absl::StatusOr<JobId> Submit(const JobSpec& spec, const std::string& submission_id) override {
    Call call(*channel_, kControlDeadline, stop_);
    v1::SubmitRequest request;
    request.set_protocol_version(kProtocolVersion);
    request.set_oldest_protocol_version(kOldestProtocolVersion);
    *request.mutable_job() = ToWire(spec);
    request.set_submission_id(submission_id);
    v1::SubmitResponse response;
    FP_RETURN_IF_ERROR(Outcome(jobs_->Submit(call.context(), request, &response)));
    return JobId{response.job_id()};
  }

  absl::StatusOr<FarmStatus> Status(const JobId& job) override {
    Call call(*channel_, kControlDeadline, stop_);
    v1::StatusRequest request;
    request.set_job_id(job.value);
    v1::StatusResponse response;
    FP_RETURN_IF_ERROR(Outcome(jobs_->Status(call.context(), request, &response)));
    FarmStatus status;
    for (const v1::JobStatus& wire : response.jobs()) {
      FP_ASSIGN_OR_RETURN(JobStatus one, JobStatusFromWire(wire));
      status.jobs.push_back(std::move(one));
    }
    for (const v1::WorkerStatus& wire : response.workers()) {
      FP_ASSIGN_OR_RETURN(WorkerStatus one, WorkerStatusFromWire(wire));
      status.workers.push_back(std::move(one));
    }
    return status;
  }

  absl::StatusOr<CoordinatorHealth> Diagnose() override {
    Call call(*channel_, kDiagnoseDeadline, stop_);
    v1::DiagnoseResponse response;
    FP_RETURN_IF_ERROR(Outcome(jobs_->Diagnose(call.context(), {}, &response)));
    return HealthFromWire(response);
  }

  absl::Status Cancel(const JobId& job) override {
    Call call(*channel_, kControlDeadline, stop_);
    v1::CancelRequest request;
    request.set_job_id(job.value);
    v1::CancelResponse response;
    return Outcome(jobs_->Cancel(call.context(), request, &response));
  }

  absl::Status Pause(const JobId& job) override {
    Call call(*channel_, kControlDeadline, stop_);
    v1::PauseRequest request;
    request.set_job_id(job.value);
    v1::PauseResponse response;
    return Outcome(jobs_->Pause(call.context(), request, &response));
  }

  absl::Status Resume(const JobId& job) override {
    Call call(*channel_, kControlDeadline, stop_);
    v1::ResumeRequest request;
    request.set_job_id(job.value);
    v1::ResumeResponse response;
    return Outcome(jobs_->Resume(call.context(), request, &response));
  }

  absl::Status SetPriority(const JobId& job, int32_t priority) override {
    Call call(*channel_, kControlDeadline, stop_);
    v1::SetPriorityRequest request;
    request.set_job_id(job.value);
    request.set_priority(priority);
    v1::SetPriorityResponse response;
    return Outcome(jobs_->SetPriority(call.context(), request, &response));
  }

  absl::Status Requeue(const JobId& job, bool all) override {
    Call call(*channel_, kControlDeadline, stop_);
    v1::RequeueRequest request;
    request.set_job_id(job.value);
    request.set_all(all);
    v1::RequeueResponse response;
    return Outcome(jobs_->Requeue(call.context(), request, &response));
  }

  absl::StatusOr<Explanation> Explain(const JobId& job) override {
    Call call(*channel_, kControlDeadline, stop_);
    v1::ExplainRequest request;
    request.set_job_id(job.value);
    v1::ExplainResponse response;
    FP_RETURN_IF_ERROR(Outcome(jobs_->Explain(call.context(), request, &response)));
    return Explanation{{response.lines().begin(), response.lines().end()}};
  }

  absl::Status Watch(const JobId& job, uint64_t after_sequence,
                     const std::function<absl::Status(const JobEvent&)>& on_event) override {
    Call call(*channel_, kWatchDeadline, stop_);
    v1::WatchRequest request;
    request.set_job_id(job.value);
    request.set_after_sequence(after_sequence);
    const auto reader = jobs_->Watch(call.context(), request);
    v1::JobEvent wire;
    while (reader->Read(&wire)) {
      const absl::StatusOr<JobEvent> event = JobEventFromWire(wire);
      const absl::Status status =
          event.ok() ? on_event(*event)
                     : Annotate(event.status(), "the coordinator's event cannot be read");
      if (!status.ok()) {
        call.context()->TryCancel();
        while (reader->Read(&wire)) {
        }
        reader->Finish().ok();
        return status;
      }
    }
    return Outcome(reader->Finish());
  }

  absl::StatusOr<JobInfo> Info(const JobId& job) override {
    Call call(*channel_, kInfoDeadline, stop_);
    v1::FetchInfoRequest request;
    request.set_job_id(job.value);
    v1::FetchInfoResponse response;
    FP_RETURN_IF_ERROR(Outcome(jobs_->FetchInfo(call.context(), request, &response)));
    return JobInfoFromWire(response);
  }

  absl::Status FetchTiles(const JobId& job, std::span<const uint32_t> tiles,
                          const std::function<absl::Status(TileData)>& on_tile) override {
    Call call(*channel_, kBulkDeadline * std::max<size_t>(1, tiles.size()), stop_);
    v1::FetchTilesRequest request;
    request.set_job_id(job.value);
    for (const uint32_t tile : tiles) request.add_tiles(tile);
    const auto reader = jobs_->FetchTiles(call.context(), request);
    const absl::Status read = ReadTiles(*reader, on_tile);
    if (!read.ok()) {
      call.context()->TryCancel();
      v1::TileChunk rest;
      while (reader->Read(&rest)) {
      }
      reader->Finish().ok();
      return read;
    }
    return Outcome(reader->Finish());
  }

 private:
  // Memory grows with the bytes that arrive, not with what a header promises.
  static absl::Status ReadTiles(grpc::ClientReader<v1::TileChunk>& reader,
                                const std::function<absl::Status(TileData)>& on_tile) {
    v1::TileChunk chunk;
    TileData tile;
    AlignedVector<std::byte> bytes;
    uint64_t size = 0;
    bool open = false;
    while (reader.Read(&chunk)) {
      if (!open) {
        if (chunk.offset_bytes() != 0) return Damaged("a tile does not start at its beginning");
        if (chunk.size_bytes() > kMaxTileBytes) {
          return Damaged("a tile of " + std::to_string(chunk.size_bytes()) + " bytes");
        }
        size = chunk.size_bytes();
        tile.tile = chunk.tile();
        FP_ASSIGN_OR_RETURN(tile.sha256, DigestFromWire(chunk.sha256(), "sha256"));
        bytes.clear();
        open = true;
      }
      const std::string& data = chunk.data();
      if (chunk.tile() != tile.tile || chunk.offset_bytes() != bytes.size() ||
          data.size() > size - bytes.size() || (data.empty() && size > bytes.size())) {
        return Damaged("a piece of tile " + std::to_string(tile.tile) + " is out of place");
      }
      const auto* begin = reinterpret_cast<const std::byte*>(data.data());
      bytes.insert(bytes.end(), begin, begin + data.size());
      if (bytes.size() == size) {
        tile.bytes = Blob::FromAligned(std::move(bytes));
        bytes = {};
        FP_RETURN_IF_ERROR(on_tile(std::move(tile)));
        tile = {};
        open = false;
      }
    }
    return absl::OkStatus();
  }

  // Of a call. While it is not known that the coordinator can be reached, with what keeps it from
  // it.
  absl::Status Outcome(const grpc::Status& grpc_status) {
    const absl::Status status = FromGrpc(grpc_status);
    if (reached_ || stop_.raised()) return status;
    if (absl::IsUnavailable(status)) return ExplainFailure(status, address_, security_);
    reached_ = !absl::IsDeadlineExceeded(status) && !absl::IsCancelled(status);
    return status;
  }

  const StopFlag& stop_;
  const std::string address_;
  const ChannelSecurity security_;
  bool reached_ = false;
  std::shared_ptr<grpc::Channel> channel_;
  std::unique_ptr<v1::JobService::Stub> jobs_;
  std::unique_ptr<v1::BlobService::Stub> blobs_;
};

}  // namespace

std::unique_ptr<FarmLink> MakeGrpcFarmLink(const std::string& address, const StopFlag& stop,
                                           const ChannelSecurity& security) {
  SilenceLibrary();
  return std::make_unique<GrpcFarmLink>(address, stop, security);
}

}  // namespace farpoint

#include "worker/grpc_link.h"

#include <algorithm>
#include <mutex>
#include <set>

#include "proto/convert.h"
#include "proto/farpoint.grpc.pb.h"
#include "proto/grpc_channel.h"
#include "proto/grpc_status.h"

namespace farpoint {

namespace {

constexpr std::chrono::milliseconds kCallTimeout{10000};
constexpr std::chrono::milliseconds kRenewTimeout{3000};
// Bulk transfers: a blob that takes longer is resumed, a tile returned again.
constexpr std::chrono::milliseconds kStreamTimeout{600000};

class GrpcLinkImpl final : public GrpcLink {
 public:
  GrpcLinkImpl(const std::string& address, const ChannelSecurity& security)
      : channel_(OpenChannel(address, security)),
        address_(address),
        security_(security),
        workers_(v1::WorkerService::NewStub(channel_)),
        blobs_(v1::BlobService::NewStub(channel_)) {}

  absl::StatusOr<WorkerWelcome> Register(const WorkerHello& hello) override {
    grpc::ClientContext context;
    SetDeadline(context, kCallTimeout);
    v1::RegisterResponse response;
    FP_RETURN_IF_ERROR(ExplainFailure(
        FromGrpc(workers_->Register(&context, ToWire(hello), &response)), address_, security_));
    return WelcomeFromWire(response);
  }

  absl::StatusOr<std::optional<TileWork>> Lease(const WorkerId& worker,
                                                std::chrono::milliseconds wait) override {
    grpc::ClientContext context;
    SetDeadline(context, wait + kCallTimeout);
    v1::LeaseRequest request;
    request.set_worker_id(worker.value);
    request.set_wait_ms(static_cast<uint32_t>(wait.count()));
    v1::LeaseResponse response;
    {
      std::lock_guard lock(mutex_);
      if (cancelled_) return absl::CancelledError("the worker stops");
      waits_.insert(&context);
    }
    const grpc::Status status = workers_->Lease(&context, request, &response);
    {
      std::lock_guard lock(mutex_);
      waits_.erase(&context);
    }
    FP_RETURN_IF_ERROR(FromGrpc(status));
    if (!response.has_work()) return std::nullopt;
    FP_ASSIGN_OR_RETURN(TileWork work, TileWorkFromWire(response.work()));
    return work;
  }

  absl::StatusOr<RenewAnswer> Renew(const WorkerId& worker, const LeaseId& lease,
                                    const LeaseProgress& progress) override {
    grpc::ClientContext context;
    SetDeadline(context, kRenewTimeout);
    v1::RenewRequest request;
    request.set_worker_id(worker.value);
    request.set_lease_id(lease.value);
    request.set_progress(progress.counter);
    request.set_fraction(progress.fraction);
    v1::RenewResponse response;
    FP_RETURN_IF_ERROR(FromGrpc(workers_->Renew(&context, request, &response)));
    return RenewAnswer{.drop = response.drop(), .reason = response.reason()};
  }

  absl::StatusOr<ReturnAnswer> Return(const WorkerId& worker, const TileResult& result) override {
    grpc::ClientContext context;
    SetDeadline(context, kStreamTimeout);
    v1::ReturnResponse response;
    const auto stream = workers_->Return(&context, &response);
    v1::ReturnChunk chunk;
    *chunk.mutable_header() = ToWire(worker, result);
    const std::span<const std::byte> bytes = result.bytes.bytes();
    size_t at = 0;
    for (;;) {
      const size_t size = std::min(kChunkBytes, bytes.size() - at);
      chunk.set_data(bytes.data() + at, size);
      at += size;
      // A refusal ends the stream early; Finish says why.
      if (!stream->Write(chunk) || at == bytes.size()) break;
      chunk.clear_header();
    }
    stream->WritesDone();
    FP_RETURN_IF_ERROR(FromGrpc(stream->Finish()));
    return ReturnAnswer{.accepted = response.accepted(), .reason = response.reason()};
  }

  absl::Status ReportFailure(const WorkerId& worker, const LeaseId& lease, bool given_back,
                             const absl::Status& error) override {
    grpc::ClientContext context;
    SetDeadline(context, kCallTimeout);
    v1::ReportFailureRequest request;
    request.set_worker_id(worker.value);
    request.set_lease_id(lease.value);
    request.set_given_back(given_back);
    request.set_code(error.raw_code());
    request.set_message(std::string(error.message().substr(0, 2048)));
    v1::ReportFailureResponse response;
    return FromGrpc(workers_->ReportFailure(&context, request, &response));
  }

  absl::Status Leave(const WorkerId& worker) override {
    grpc::ClientContext context;
    SetDeadline(context, kRenewTimeout);
    v1::LeaveRequest request;
    request.set_worker_id(worker.value);
    v1::LeaveResponse response;
    return FromGrpc(workers_->Leave(&context, request, &response));
  }

  void CancelWaits() override {
    std::lock_guard lock(mutex_);
    cancelled_ = true;
    for (grpc::ClientContext* context : waits_) context->TryCancel();
  }

  absl::Status Stream(const Digest& digest, uint64_t offset_bytes, const Sink& sink) override {
    grpc::ClientContext context;
    SetDeadline(context, kStreamTimeout);
    v1::GetBlobRequest request;
    request.set_sha256(ToWire(digest));
    request.set_offset_bytes(offset_bytes);
    const auto stream = blobs_->Get(&context, request);
    v1::GetBlobChunk chunk;
    uint64_t size = 0;
    bool first = true;
    while (stream->Read(&chunk)) {
      if (first) size = chunk.size_bytes();
      first = false;
      const absl::Status taken =
          chunk.data().size() > kChunkBytes
              ? absl::DataLossError("a chunk of " + std::to_string(chunk.data().size()) + " bytes")
              : sink(size, std::as_bytes(std::span(chunk.data().data(), chunk.data().size())));
      if (taken.ok()) continue;
      context.TryCancel();
      (void)stream->Finish();
      return taken;
    }
    return FromGrpc(stream->Finish());
  }

 private:
  const std::shared_ptr<grpc::Channel> channel_;
  const std::string address_;
  const ChannelSecurity security_;
  const std::unique_ptr<v1::WorkerService::Stub> workers_;
  const std::unique_ptr<v1::BlobService::Stub> blobs_;
  std::mutex mutex_;
  bool cancelled_ = false;                // guarded by mutex_
  std::set<grpc::ClientContext*> waits_;  // guarded by mutex_
};

}  // namespace

std::unique_ptr<GrpcLink> GrpcLink::Connect(const std::string& address,
                                            const ChannelSecurity& security) {
  return std::make_unique<GrpcLinkImpl>(address, security);
}

}  // namespace farpoint

#include "worker/grpc_link.h"

#include <algorithm>
#include <condition_variable>
#include <cstring>
#include <mutex>
#include <set>
#include <thread>

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
// How long a call waits for a connection that was lost, before it says so.
constexpr std::chrono::milliseconds kReconnectTime{1000};
// Of one Attend; then it is opened again.
constexpr std::chrono::milliseconds kAttendTimeout{3600000};
constexpr std::chrono::milliseconds kAttendAgain{100};

class GrpcLinkImpl final : public GrpcLink {
 public:
  GrpcLinkImpl(const std::string& address, const ChannelSecurity& security)
      : address_(address),
        connection_(std::make_shared<const Connection>(address, security)),
        attendant_([this] { AttendLoop(); }) {}
  ~GrpcLinkImpl() override {
    {
      std::lock_guard lock(mutex_);
      ending_ = true;
      if (attending_ != nullptr) attending_->TryCancel();
    }
    attend_changed_.notify_all();
    attendant_.join();
  }

  absl::StatusOr<WorkerWelcome> Register(const WorkerHello& hello) override {
    const std::shared_ptr<const Connection> connection = Current();
    AwaitConnection(*connection->channel, kReconnectTime);
    grpc::ClientContext context;
    SetDeadline(context, kCallTimeout);
    v1::RegisterResponse response;
    FP_RETURN_IF_ERROR(
        ExplainFailure(FromGrpc(connection->workers->Register(&context, ToWire(hello), &response)),
                       address_, connection->security));
    return WelcomeFromWire(response);
  }

  absl::StatusOr<std::optional<TileWork>> Lease(const WorkerId& worker,
                                                std::chrono::milliseconds wait) override {
    const std::shared_ptr<const Connection> connection = Current();
    AwaitConnection(*connection->channel, kReconnectTime);
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
    const grpc::Status status = connection->workers->Lease(&context, request, &response);
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
    const std::shared_ptr<const Connection> connection = Current();
    AwaitConnection(*connection->channel, kReconnectTime);
    grpc::ClientContext context;
    SetDeadline(context, kRenewTimeout);
    v1::RenewRequest request;
    request.set_worker_id(worker.value);
    request.set_lease_id(lease.value);
    request.set_progress(progress.counter);
    request.set_fraction(progress.fraction);
    request.set_at(progress.at.substr(0, kMaxPlaceBytes));
    request.set_rendering(progress.rendering);
    request.set_cpu_ms(static_cast<uint64_t>(progress.cpu.count()));
    request.set_pulse(progress.pulse);
    v1::RenewResponse response;
    FP_RETURN_IF_ERROR(FromGrpc(connection->workers->Renew(&context, request, &response)));
    return RenewAnswer{.drop = response.drop(), .reason = response.reason()};
  }

  absl::StatusOr<ReturnAnswer> Return(const WorkerId& worker, const TileResult& result) override {
    const std::shared_ptr<const Connection> connection = Current();
    AwaitConnection(*connection->channel, kReconnectTime);
    grpc::ClientContext context;
    SetDeadline(context, kStreamTimeout);
    v1::ReturnResponse response;
    const auto stream = connection->workers->Return(&context, &response);
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
    const std::shared_ptr<const Connection> connection = Current();
    AwaitConnection(*connection->channel, kReconnectTime);
    grpc::ClientContext context;
    SetDeadline(context, kCallTimeout);
    v1::ReportFailureRequest request;
    request.set_worker_id(worker.value);
    request.set_lease_id(lease.value);
    request.set_given_back(given_back);
    request.set_code(error.raw_code());
    request.set_message(std::string(error.message().substr(0, 2048)));
    v1::ReportFailureResponse response;
    return FromGrpc(connection->workers->ReportFailure(&context, request, &response));
  }

  absl::Status Leave(const WorkerId& worker) override {
    const std::shared_ptr<const Connection> connection = Current();
    grpc::ClientContext context;
    SetDeadline(context, kRenewTimeout);
    v1::LeaveRequest request;
    request.set_worker_id(worker.value);
    v1::LeaveResponse response;
    const grpc::Status left = connection->workers->Leave(&context, request, &response);
    Attend({});
    return FromGrpc(left);
  }

  void Attend(const WorkerId& worker) override {
    {
      std::lock_guard lock(mutex_);
      attended_ = worker;
      if (attending_ != nullptr) attending_->TryCancel();
    }
    attend_changed_.notify_all();
  }

  void CancelWaits() override {
    std::lock_guard lock(mutex_);
    cancelled_ = true;
    for (grpc::ClientContext* context : waits_) context->TryCancel();
  }

  absl::Status Stream(const Digest& digest, uint64_t offset_bytes, const Sink& sink) override {
    const std::shared_ptr<const Connection> connection = Current();
    AwaitConnection(*connection->channel, kReconnectTime);
    grpc::ClientContext context;
    SetDeadline(context, kStreamTimeout);
    v1::GetBlobRequest request;
    request.set_sha256(ToWire(digest));
    request.set_offset_bytes(offset_bytes);
    const auto stream = connection->blobs->Get(&context, request);
    v1::GetBlobChunk chunk;
    uint64_t size = 0;
    bool first = true;
    while (stream->Read(&chunk)) {
      if (first) size = chunk.size_bytes();
      first = false;
      const std::span<const std::byte> data =
          std::as_bytes(std::span(chunk.data().data(), chunk.data().size()));
      absl::Status taken;
      if (data.size() > kChunkBytes) {
        taken = absl::DataLossError("a chunk of " + std::to_string(data.size()) + " bytes");
      } else if (!HasHash(data, chunk.data_sha256())) {
        taken = absl::UnavailableError("a chunk arrived damaged and is not used");
      } else {
        taken = sink(size, data);
      }
      if (taken.ok()) continue;
      context.TryCancel();
      (void)stream->Finish();
      return taken;
    }
    return FromGrpc(stream->Finish());
  }

  void Reconnect(const ChannelSecurity& security) override {
    auto fresh = std::make_shared<const Connection>(address_, security);
    std::lock_guard lock(mutex_);
    connection_ = std::move(fresh);
    // It is opened again on the new one; calls end on the one that they began on.
    if (attending_ != nullptr) attending_->TryCancel();
  }

 private:
  struct Connection {
    Connection(const std::string& address, const ChannelSecurity& given)
        : security(given),
          channel(OpenChannel(address, given)),
          workers(v1::WorkerService::NewStub(channel)),
          blobs(v1::BlobService::NewStub(channel)) {}
    const ChannelSecurity security;
    const std::shared_ptr<grpc::Channel> channel;
    const std::unique_ptr<v1::WorkerService::Stub> workers;
    const std::unique_ptr<v1::BlobService::Stub> blobs;
  };
  std::shared_ptr<const Connection> Current() {
    std::lock_guard lock(mutex_);
    return connection_;
  }

  // A coordinator before data_sha256 sends none: the blob's own hash decides then.
  static bool HasHash(std::span<const std::byte> data, const std::string& sha256) {
    if (sha256.empty()) return true;
    const Digest digest = HashBytes(data);
    return sha256.size() == digest.bytes.size() &&
           std::memcmp(sha256.data(), digest.bytes.data(), sha256.size()) == 0;
  }

  // Holds a stream open for attended_; it says nothing, its end says all.
  void AttendLoop() {
    std::unique_lock lock(mutex_);
    while (!ending_) {
      if (attended_.empty()) {
        attend_changed_.wait(lock);
        continue;
      }
      const WorkerId worker = attended_;
      const std::shared_ptr<const Connection> connection = connection_;
      grpc::ClientContext context;
      SetDeadline(context, kAttendTimeout);
      context.set_wait_for_ready(true);
      attending_ = &context;
      lock.unlock();
      v1::AttendRequest request;
      request.set_worker_id(worker.value);
      const auto stream = connection->workers->Attend(&context, request);
      v1::AttendResponse nothing;
      while (stream->Read(&nothing)) {
      }
      const grpc::Status status = stream->Finish();
      lock.lock();
      attending_ = nullptr;
      if (ending_ || attended_ != worker || connection_ != connection) continue;
      // Not known any more: Lease and Renew hear it too, and the worker registers again.
      if (status.error_code() == grpc::StatusCode::NOT_FOUND ||
          status.error_code() == grpc::StatusCode::UNIMPLEMENTED) {
        attended_ = {};
        continue;
      }
      attend_changed_.wait_for(lock, kAttendAgain);
    }
  }

  const std::string address_;
  std::mutex mutex_;
  std::shared_ptr<const Connection> connection_;  // guarded by mutex_
  bool cancelled_ = false;                        // guarded by mutex_
  std::set<grpc::ClientContext*> waits_;          // guarded by mutex_
  std::condition_variable attend_changed_;
  bool ending_ = false;                       // guarded by mutex_
  WorkerId attended_;                         // guarded by mutex_; empty: none
  grpc::ClientContext* attending_ = nullptr;  // guarded by mutex_
  std::thread attendant_;                     // the last member: it uses all others
};

}  // namespace

std::unique_ptr<GrpcLink> GrpcLink::Connect(const std::string& address,
                                            const ChannelSecurity& security) {
  return std::make_unique<GrpcLinkImpl>(address, security);
}

}  // namespace farpoint

#include <algorithm>
#include <atomic>

#include "proto/convert.h"
#include "proto/farpoint.grpc.pb.h"
#include "proto/grpc_status.h"
#include "server/grpc_services.h"

namespace farpoint {

namespace {

// A tile of 2^30 pixels with every layer would be larger; tiles of 16384² pixels fit.
constexpr uint64_t kMaxTileBytes = uint64_t{1} << 35;
constexpr std::chrono::milliseconds kMaxLeaseWait{30000};
// How often a waiting Lease looks whether its worker is still there: a tile given to one that is
// gone would have to time out.
constexpr std::chrono::milliseconds kLeaseSlice{250};

// The end of a worker's connection. Costs no thread while it lasts, of which there are as many as
// workers.
class Attendance final : public grpc::ServerWriteReactor<v1::AttendResponse> {
 public:
  Attendance(CoordinatorApi& coordinator, const WorkerId& worker)
      : coordinator_(coordinator), worker_(worker) {
    const absl::StatusOr<uint64_t> connection = coordinator_.Attached(worker_);
    if (connection.ok()) {
      connection_ = *connection;
      StartSendInitialMetadata();
    } else {
      End(ToGrpc(connection.status()));
    }
  }
  void OnCancel() override {
    if (const uint64_t connection = connection_; connection != 0) {
      coordinator_.Detached(worker_, connection);
    }
    End(grpc::Status::CANCELLED);
  }
  void OnDone() override { delete this; }

 private:
  void End(const grpc::Status& status) {
    if (!ended_.exchange(true)) Finish(status);
  }

  CoordinatorApi& coordinator_;
  const WorkerId worker_;
  std::atomic<uint64_t> connection_ = 0;  // 0: none
  std::atomic<bool> ended_ = false;
};

using WorkerServiceBase = v1::WorkerService::WithCallbackMethod_Attend<v1::WorkerService::Service>;

class WorkerServiceImpl final : public WorkerServiceBase {
 public:
  explicit WorkerServiceImpl(CoordinatorApi& coordinator) : coordinator_(coordinator) {}

  grpc::ServerWriteReactor<v1::AttendResponse>* Attend(grpc::CallbackServerContext*,
                                                       const v1::AttendRequest* request) override {
    return new Attendance(coordinator_, {request->worker_id()});
  }

  grpc::Status Register(grpc::ServerContext* context, const v1::RegisterRequest* request,
                        v1::RegisterResponse* response) override {
    return ToGrpc([&]() -> absl::Status {
      FP_RETURN_IF_ERROR(
          AgreeOnProtocol(request->oldest_protocol_version(), request->protocol_version(), "worker")
              .status());
      FP_ASSIGN_OR_RETURN(WorkerHello hello, HelloFromWire(*request));
      if (hello.name.empty()) hello.name = context->peer();
      FP_ASSIGN_OR_RETURN(const WorkerWelcome welcome, coordinator_.Register(hello));
      *response = ToWire(welcome);
      return absl::OkStatus();
    }());
  }

  grpc::Status Lease(grpc::ServerContext* context, const v1::LeaseRequest* request,
                     v1::LeaseResponse* response) override {
    return ToGrpc([&]() -> absl::Status {
      const auto end = std::chrono::steady_clock::now() +
                       std::min<std::chrono::milliseconds>(
                           std::chrono::milliseconds(request->wait_ms()), kMaxLeaseWait);
      for (;;) {
        if (context->IsCancelled()) return absl::CancelledError("the worker is gone");
        const auto left =
            std::chrono::ceil<std::chrono::milliseconds>(end - std::chrono::steady_clock::now());
        FP_ASSIGN_OR_RETURN(
            const std::optional<TileWork> work,
            coordinator_.Lease({request->worker_id()},
                               std::clamp(left, std::chrono::milliseconds(0), kLeaseSlice)));
        if (work) {
          *response->mutable_work() = ToWire(*work);
          return absl::OkStatus();
        }
        if (left <= kLeaseSlice) return absl::OkStatus();
      }
    }());
  }

  grpc::Status Renew(grpc::ServerContext*, const v1::RenewRequest* request,
                     v1::RenewResponse* response) override {
    return ToGrpc([&]() -> absl::Status {
      if (!(request->fraction() >= 0 && request->fraction() <= 1)) {
        return absl::InvalidArgumentError("fraction is not within 0 to 1");
      }
      if (request->at().size() > kMaxPlaceBytes) {
        return absl::InvalidArgumentError("at is longer than " + std::to_string(kMaxPlaceBytes) +
                                          " bytes");
      }
      constexpr uint64_t kMaxCpuMs = uint64_t{1} << 50;  // 35,000 years
      FP_ASSIGN_OR_RETURN(const RenewAnswer answer,
                          coordinator_.Renew({request->worker_id()}, {request->lease_id()},
                                             {.counter = request->progress(),
                                              .fraction = request->fraction(),
                                              .at = request->at(),
                                              .rendering = request->rendering(),
                                              .cpu = std::chrono::milliseconds(static_cast<int64_t>(
                                                  std::min(request->cpu_ms(), kMaxCpuMs)))}));
      response->set_drop(answer.drop);
      response->set_reason(answer.reason);
      return absl::OkStatus();
    }());
  }

  grpc::Status Return(grpc::ServerContext*, grpc::ServerReader<v1::ReturnChunk>* stream,
                      v1::ReturnResponse* response) override {
    return ToGrpc([&]() -> absl::Status {
      v1::ReturnChunk chunk;
      if (!stream->Read(&chunk) || !chunk.has_header()) {
        return absl::InvalidArgumentError("Return without a header");
      }
      FP_ASSIGN_OR_RETURN(ReturnHead head, ReturnHeadFromWire(chunk.header(), kMaxTileBytes));
      // Memory is taken as data arrive, never because of what was announced.
      std::vector<std::byte> bytes;
      do {
        const std::string& data = chunk.data();
        if (data.size() > kChunkBytes || data.size() > head.size_bytes - bytes.size()) {
          return absl::InvalidArgumentError("data is larger than a chunk or than announced");
        }
        const auto* begin = reinterpret_cast<const std::byte*>(data.data());
        bytes.insert(bytes.end(), begin, begin + data.size());
      } while (stream->Read(&chunk));
      if (bytes.size() != head.size_bytes) {
        // The worker's stream broke off; it will return the tile again.
        return absl::UnavailableError("the tile ended after " + std::to_string(bytes.size()) +
                                      " of " + std::to_string(head.size_bytes) + " bytes");
      }
      head.result.bytes = Blob::FromVector(std::move(bytes));
      FP_ASSIGN_OR_RETURN(const ReturnAnswer answer, coordinator_.Return(head.worker, head.result));
      response->set_accepted(answer.accepted);
      response->set_reason(answer.reason);
      return absl::OkStatus();
    }());
  }

  grpc::Status ReportFailure(grpc::ServerContext*, const v1::ReportFailureRequest* request,
                             v1::ReportFailureResponse*) override {
    return ToGrpc([&]() -> absl::Status {
      if (request->code() < 0 || request->code() > 16) {
        return absl::InvalidArgumentError("code is " + std::to_string(request->code()) +
                                          "; allowed: 0 to 16");
      }
      const absl::Status error(static_cast<absl::StatusCode>(request->code()),
                               request->message().substr(0, 4096));
      return coordinator_.ReportFailure({request->worker_id()}, {request->lease_id()},
                                        request->given_back(), error);
    }());
  }

  grpc::Status Leave(grpc::ServerContext*, const v1::LeaveRequest* request,
                     v1::LeaveResponse*) override {
    return ToGrpc(coordinator_.Leave({request->worker_id()}));
  }

 private:
  CoordinatorApi& coordinator_;
};

}  // namespace

std::unique_ptr<grpc::Service> MakeWorkerService(CoordinatorApi& coordinator) {
  return std::make_unique<WorkerServiceImpl>(coordinator);
}

}  // namespace farpoint

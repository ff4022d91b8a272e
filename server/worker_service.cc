#include <algorithm>
#include <atomic>
#include <chrono>
#include <list>
#include <mutex>
#include <thread>
#include <vector>

#include "proto/convert.h"
#include "proto/farpoint.grpc.pb.h"
#include "proto/grpc_status.h"
#include "server/grpc_services.h"

namespace farpoint {

namespace {

// A tile of 2^30 pixels with every layer would be larger; tiles of 16384² pixels fit.
constexpr uint64_t kMaxTileBytes = uint64_t{1} << 35;
constexpr std::chrono::milliseconds kMaxLeaseWait{30000};
// Tiles become slow and workers come back from being set aside without a notification.
constexpr std::chrono::milliseconds kLeasePeriod{250};

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

class LeaseCall;

// Workers that wait for a tile: none holds a thread, of which there would be as many as workers,
// and one thread asks for all of them when something has changed.
class LeaseWaiters {
 public:
  explicit LeaseWaiters(CoordinatorApi& coordinator)
      : coordinator_(coordinator), thread_([this] { Loop(); }) {}
  ~LeaseWaiters();
  CoordinatorApi& coordinator() { return coordinator_; }
  void Add(LeaseCall* call);
  // False if it is not there: somebody else answers it.
  bool Remove(LeaseCall* call);

 private:
  void Loop();

  CoordinatorApi& coordinator_;
  std::mutex mutex_;
  std::list<LeaseCall*> calls_;  // guarded by mutex_, in the order in which they came
  std::atomic<bool> ending_ = false;
  std::thread thread_;
};

// Whoever takes it out of the list of waiters answers it; then it is gone.
class LeaseCall final : public grpc::ServerUnaryReactor {
 public:
  LeaseCall(LeaseWaiters& waiters, grpc::CallbackServerContext* context,
            const v1::LeaseRequest& request, v1::LeaseResponse* response)
      : waiters_(waiters),
        context_(context),
        worker_{request.worker_id()},
        end_(std::chrono::steady_clock::now() +
             std::min<std::chrono::milliseconds>(std::chrono::milliseconds(request.wait_ms()),
                                                 kMaxLeaseWait)),
        response_(response) {
    // gRPC keeps this at least until the handler has returned, whoever answers it.
    for (;;) {
      const uint64_t before = waiters_.coordinator().AwaitWork(0, std::chrono::milliseconds(0));
      if (Try()) return;
      waiters_.Add(this);
      // What changed in between may have been missed by both.
      if (waiters_.coordinator().AwaitWork(0, std::chrono::milliseconds(0)) == before) return;
      if (!waiters_.Remove(this)) return;
    }
  }
  // True if it was answered.
  bool Try() {
    // A tile given to a worker that is gone would have to be lost first.
    if (context_->IsCancelled()) {
      Finish(grpc::Status::CANCELLED);
      return true;
    }
    absl::StatusOr<std::optional<TileWork>> work =
        waiters_.coordinator().Lease(worker_, std::chrono::milliseconds(0));
    if (work.ok() && !*work && std::chrono::steady_clock::now() < end_) return false;
    if (work.ok() && *work) *response_->mutable_work() = ToWire(**work);
    Finish(ToGrpc(work.status()));
    return true;
  }
  void OnCancel() override {
    if (waiters_.Remove(this)) Finish(grpc::Status::CANCELLED);
  }
  void OnDone() override { delete this; }

 private:
  LeaseWaiters& waiters_;
  grpc::CallbackServerContext* const context_;
  const WorkerId worker_;
  const std::chrono::steady_clock::time_point end_;
  v1::LeaseResponse* const response_;
};

LeaseWaiters::~LeaseWaiters() {
  ending_ = true;
  thread_.join();
}

void LeaseWaiters::Add(LeaseCall* call) {
  std::lock_guard lock(mutex_);
  calls_.push_back(call);
}

bool LeaseWaiters::Remove(LeaseCall* call) {
  std::lock_guard lock(mutex_);
  return std::erase(calls_, call) > 0;
}

void LeaseWaiters::Loop() {
  uint64_t seen = 0;
  while (!ending_) {
    seen = coordinator_.AwaitWork(seen, kLeasePeriod);
    // One after the other: while one is asked for it is out of the list, and cannot end by itself.
    size_t left = 0;
    {
      std::lock_guard lock(mutex_);
      left = calls_.size();
    }
    for (; left > 0; --left) {
      LeaseCall* call = nullptr;
      {
        std::lock_guard lock(mutex_);
        if (calls_.empty()) break;
        call = calls_.front();
        calls_.pop_front();
      }
      if (!call->Try()) Add(call);
    }
  }
}

using WorkerServiceBase =
    v1::WorkerService::WithCallbackMethod_Attend<v1::WorkerService::WithCallbackMethod_Lease<
        v1::WorkerService::WithCallbackMethod_Renew<v1::WorkerService::Service>>>;

class WorkerServiceImpl final : public WorkerServiceBase {
 public:
  WorkerServiceImpl(CoordinatorApi& coordinator, const ServiceAccess& access)
      : coordinator_(coordinator), access_(access), waiters_(coordinator) {}

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
      if (access_.guard != nullptr) {
        // What a worker calls itself is for people; what it does is held against its certificate.
        FP_ASSIGN_OR_RETURN(const Caller caller, CallerOf(*context, access_));
        hello.certified_as = caller.name;
        if (hello.name != caller.name) hello.name = caller.name + "/" + hello.name;
      }
      FP_ASSIGN_OR_RETURN(const WorkerWelcome welcome, coordinator_.Register(hello));
      *response = ToWire(welcome);
      return absl::OkStatus();
    }());
  }

  grpc::ServerUnaryReactor* Lease(grpc::CallbackServerContext* context,
                                  const v1::LeaseRequest* request,
                                  v1::LeaseResponse* response) override {
    return new LeaseCall(waiters_, context, *request, response);
  }

  grpc::ServerUnaryReactor* Renew(grpc::CallbackServerContext* context,
                                  const v1::RenewRequest* request,
                                  v1::RenewResponse* response) override {
    grpc::ServerUnaryReactor* const reactor = context->DefaultReactor();
    reactor->Finish(RenewNow(request, response));
    return reactor;
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
  grpc::Status RenewNow(const v1::RenewRequest* request, v1::RenewResponse* response) {
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
                                                  std::min(request->cpu_ms(), kMaxCpuMs))),
                                              .pulse = request->pulse()}));
      response->set_drop(answer.drop);
      response->set_reason(answer.reason);
      return absl::OkStatus();
    }());
  }

  CoordinatorApi& coordinator_;
  const ServiceAccess& access_;
  LeaseWaiters waiters_;
};

}  // namespace

std::unique_ptr<grpc::Service> MakeWorkerService(CoordinatorApi& coordinator,
                                                 const ServiceAccess& access) {
  return std::make_unique<WorkerServiceImpl>(coordinator, access);
}

}  // namespace farpoint

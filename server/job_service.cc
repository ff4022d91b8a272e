#include <algorithm>
#include <chrono>

#include "proto/convert.h"
#include "proto/farpoint.grpc.pb.h"
#include "proto/grpc_channel.h"
#include "proto/grpc_status.h"
#include "server/grpc_services.h"

namespace farpoint {

namespace {

constexpr std::chrono::milliseconds kWatchPeriod{500};

class JobServiceImpl final : public v1::JobService::Service {
 public:
  JobServiceImpl(CoordinatorApi& coordinator, const ServiceAccess& access)
      : coordinator_(coordinator), access_(access) {}

  grpc::Status Submit(grpc::ServerContext* context, const v1::SubmitRequest* request,
                      v1::SubmitResponse* response) override {
    return ToGrpc([&]() -> absl::Status {
      FP_RETURN_IF_ERROR(
          AgreeOnProtocol(request->oldest_protocol_version(), request->protocol_version(), "client")
              .status());
      FP_RETURN_IF_ERROR(CheckFieldsKnown(request->job(), "job"));
      FP_ASSIGN_OR_RETURN(const Caller caller, CallerOf(*context, access_));
      FP_ASSIGN_OR_RETURN(const JobSpec spec, JobFromWire(request->job()));
      if (access_.ledger != nullptr) FP_RETURN_IF_ERROR(access_.ledger->MaySubmit(caller.name));
      FP_ASSIGN_OR_RETURN(const JobId id, coordinator_.Submit(spec, request->submission_id()));
      if (access_.ledger != nullptr) {
        FP_RETURN_IF_ERROR(access_.ledger->Submitted(caller.name, id));
      }
      response->set_job_id(id.value);
      return absl::OkStatus();
    }());
  }

  grpc::Status Status(grpc::ServerContext*, const v1::StatusRequest* request,
                      v1::StatusResponse* response) override {
    return ToGrpc([&]() -> absl::Status {
      if (!request->job_id().empty()) {
        FP_ASSIGN_OR_RETURN(const JobStatus status, coordinator_.Status({request->job_id()}));
        *response->add_jobs() = Described(status);
        return absl::OkStatus();
      }
      for (const JobStatus& status : coordinator_.Jobs()) *response->add_jobs() = Described(status);
      for (const WorkerStatus& status : coordinator_.Workers()) {
        *response->add_workers() = ToWire(status);
      }
      return absl::OkStatus();
    }());
  }

  grpc::Status Cancel(grpc::ServerContext* context, const v1::CancelRequest* request,
                      v1::CancelResponse*) override {
    return ToGrpc([&]() -> absl::Status {
      FP_RETURN_IF_ERROR(MayChange(*context, {request->job_id()}));
      return coordinator_.Cancel({request->job_id()});
    }());
  }

  grpc::Status Pause(grpc::ServerContext* context, const v1::PauseRequest* request,
                     v1::PauseResponse*) override {
    return ToGrpc([&]() -> absl::Status {
      FP_RETURN_IF_ERROR(MayChange(*context, {request->job_id()}));
      return coordinator_.Pause({request->job_id()});
    }());
  }
  grpc::Status Resume(grpc::ServerContext* context, const v1::ResumeRequest* request,
                      v1::ResumeResponse*) override {
    return ToGrpc([&]() -> absl::Status {
      FP_RETURN_IF_ERROR(MayChange(*context, {request->job_id()}));
      return coordinator_.Resume({request->job_id()});
    }());
  }
  grpc::Status SetPriority(grpc::ServerContext* context, const v1::SetPriorityRequest* request,
                           v1::SetPriorityResponse*) override {
    return ToGrpc([&]() -> absl::Status {
      FP_RETURN_IF_ERROR(MayChange(*context, {request->job_id()}));
      return coordinator_.SetPriority({request->job_id()}, request->priority());
    }());
  }
  grpc::Status Requeue(grpc::ServerContext* context, const v1::RequeueRequest* request,
                       v1::RequeueResponse*) override {
    return ToGrpc([&]() -> absl::Status {
      FP_RETURN_IF_ERROR(MayChange(*context, {request->job_id()}));
      return coordinator_.Requeue({request->job_id()}, request->all());
    }());
  }
  grpc::Status Explain(grpc::ServerContext*, const v1::ExplainRequest* request,
                       v1::ExplainResponse* response) override {
    return ToGrpc([&]() -> absl::Status {
      FP_ASSIGN_OR_RETURN(const Explanation explanation, coordinator_.Explain({request->job_id()}));
      *response = ToWire(explanation);
      return absl::OkStatus();
    }());
  }

  grpc::Status Diagnose(grpc::ServerContext* context, const v1::DiagnoseRequest*,
                        v1::DiagnoseResponse* response) override {
    return ToGrpc([&]() -> absl::Status {
      FP_ASSIGN_OR_RETURN(const Caller caller, CallerOf(*context, access_));
      CoordinatorHealth health;
      if (access_.facts) health = HealthOf(access_.facts());
      health.version = FARPOINT_VERSION;
      health.protocol_version = kProtocolVersion;
      health.oldest_protocol_version = kOldestProtocolVersion;
      health.unix_ms = std::chrono::duration_cast<std::chrono::milliseconds>(
                           std::chrono::system_clock::now().time_since_epoch())
                           .count();
      if (access_.guard != nullptr) {
        health.caller_name = caller.name;
        health.caller_role = std::string(NameOf(caller.role));
      }
      if (access_.ledger != nullptr) {
        FP_ASSIGN_OR_RETURN(const ClientLedger::Use use, access_.ledger->UseOf(caller.name));
        health.jobs = use.jobs;
        health.bytes = use.bytes;
      }
      health.max_request_bytes = kMaxRequestBytes;
      health.workers = coordinator_.Workers();
      *response = ToWire(health);
      return absl::OkStatus();
    }());
  }

  grpc::Status Watch(grpc::ServerContext* context, const v1::WatchRequest* request,
                     grpc::ServerWriter<v1::JobEvent>* stream) override {
    return ToGrpc([&]() -> absl::Status {
      uint64_t after = request->after_sequence();
      while (!context->IsCancelled()) {
        FP_ASSIGN_OR_RETURN(const std::vector<JobEvent> events,
                            coordinator_.NextEvents({request->job_id()}, after, kWatchPeriod));
        if (events.empty()) return absl::OkStatus();
        for (const JobEvent& event : events) {
          if (!stream->Write(ToWire(event))) return absl::CancelledError("the peer is gone");
          if (event.sequence != 0) after = event.sequence;
        }
      }
      return absl::CancelledError("the peer is gone");
    }());
  }

  grpc::Status FetchInfo(grpc::ServerContext*, const v1::FetchInfoRequest* request,
                         v1::FetchInfoResponse* response) override {
    return ToGrpc([&]() -> absl::Status {
      FP_ASSIGN_OR_RETURN(const JobInfo info, coordinator_.FetchInfo({request->job_id()}));
      *response = ToWire(info);
      return absl::OkStatus();
    }());
  }

  grpc::Status FetchTiles(grpc::ServerContext*, const v1::FetchTilesRequest* request,
                          grpc::ServerWriter<v1::TileChunk>* stream) override {
    return ToGrpc([&]() -> absl::Status {
      const JobId job{request->job_id()};
      std::vector<uint32_t> tiles(request->tiles().begin(), request->tiles().end());
      if (tiles.empty()) {
        FP_ASSIGN_OR_RETURN(const JobInfo info, coordinator_.FetchInfo(job));
        for (uint32_t i = 0; i < info.tiles.size(); ++i) {
          if (!info.tiles[i].sha256.empty()) tiles.push_back(i);
        }
      }
      for (uint32_t tile : tiles) {
        FP_ASSIGN_OR_RETURN(const TileData data, coordinator_.FetchTile(job, tile));
        FP_RETURN_IF_ERROR(SendTile(data, *stream));
      }
      return absl::OkStatus();
    }());
  }

 private:
  absl::Status MayChange(const grpc::ServerContext& context, const JobId& job) {
    FP_ASSIGN_OR_RETURN(const Caller caller, CallerOf(context, access_));
    return farpoint::MayChange(caller, access_, coordinator_, job);
  }

  v1::JobStatus Described(const JobStatus& status) {
    v1::JobStatus wire = ToWire(status);
    if (access_.ledger != nullptr) wire.set_owner(access_.ledger->OwnerOf(status.id));
    return wire;
  }

  static CoordinatorHealth HealthOf(const ServerFacts& facts) {
    CoordinatorHealth health;
    health.draining = facts.draining;
    health.store_error = facts.store_error;
    health.store_free_bytes = facts.disk.free_bytes;
    health.store_total_bytes = facts.disk.total_bytes;
    health.memory_available_bytes = facts.memory.available_bytes;
    health.memory_total_bytes = facts.memory.total_bytes;
    health.open_files = facts.files.open;
    health.open_files_limit = facts.files.limit;
    health.connections = facts.connections;
    health.max_connections = facts.max_connections;
    health.max_blob_bytes = facts.max_blob_bytes;
    health.limits = facts.limits;
    health.max_jobs = facts.max_jobs;
    health.max_bytes = facts.max_bytes;
    health.blob_directory = facts.blob_directory;
    health.blob_mark = facts.blob_mark;
    health.certificate_not_after_s = facts.certificate_not_after_s;
    return health;
  }

  absl::Status SendTile(const TileData& data, grpc::ServerWriter<v1::TileChunk>& stream) {
    const std::span<const std::byte> bytes = data.bytes.bytes();
    v1::TileChunk chunk;
    chunk.set_tile(data.tile);
    chunk.set_size_bytes(bytes.size());
    chunk.set_sha256(data.sha256.Hex());
    size_t at = 0;
    do {
      const size_t size = std::min(kChunkBytes, bytes.size() - at);
      chunk.set_offset_bytes(at);
      chunk.set_data(bytes.data() + at, size);
      at += size;
      if (!stream.Write(chunk)) return absl::CancelledError("the peer is gone");
      if (access_.traffic != nullptr) access_.traffic->tiles_sent += size;
    } while (at < bytes.size());
    return absl::OkStatus();
  }

  CoordinatorApi& coordinator_;
  const ServiceAccess& access_;
};

}  // namespace

absl::Status MayChange(const Caller& caller, const ServiceAccess& access,
                       CoordinatorApi& coordinator, const JobId& job) {
  if (caller.role == Role::kAdmin || access.ledger == nullptr) return absl::OkStatus();
  FP_RETURN_IF_ERROR(coordinator.Status(job).status());  // kNotFound before whose it is
  const std::string owner = access.ledger->OwnerOf(job);
  if (owner == caller.name) return absl::OkStatus();
  return absl::PermissionDeniedError(
      "job " + job.value + " is " + (owner.empty() ? "nobody's" : "'" + owner + "''s") + ", not '" +
      caller.name + "''s; ask an admin (farpoint certs add NAME --role admin)");
}

std::unique_ptr<grpc::Service> MakeJobService(CoordinatorApi& coordinator,
                                              const ServiceAccess& access) {
  return std::make_unique<JobServiceImpl>(coordinator, access);
}

}  // namespace farpoint

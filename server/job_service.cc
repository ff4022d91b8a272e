#include <algorithm>

#include "proto/convert.h"
#include "proto/farpoint.grpc.pb.h"
#include "proto/grpc_status.h"
#include "server/grpc_services.h"

namespace farpoint {

namespace {

constexpr std::chrono::milliseconds kWatchPeriod{500};

class JobServiceImpl final : public v1::JobService::Service {
 public:
  explicit JobServiceImpl(CoordinatorApi& coordinator) : coordinator_(coordinator) {}

  grpc::Status Submit(grpc::ServerContext*, const v1::SubmitRequest* request,
                      v1::SubmitResponse* response) override {
    return ToGrpc([&]() -> absl::Status {
      FP_RETURN_IF_ERROR(CheckProtocolVersion(request->protocol_version(), "client"));
      FP_ASSIGN_OR_RETURN(const JobSpec spec, JobFromWire(request->job()));
      FP_ASSIGN_OR_RETURN(const JobId id, coordinator_.Submit(spec, request->submission_id()));
      response->set_job_id(id.value);
      return absl::OkStatus();
    }());
  }

  grpc::Status Status(grpc::ServerContext*, const v1::StatusRequest* request,
                      v1::StatusResponse* response) override {
    return ToGrpc([&]() -> absl::Status {
      if (!request->job_id().empty()) {
        FP_ASSIGN_OR_RETURN(const JobStatus status, coordinator_.Status({request->job_id()}));
        *response->add_jobs() = ToWire(status);
        return absl::OkStatus();
      }
      for (const JobStatus& status : coordinator_.Jobs()) *response->add_jobs() = ToWire(status);
      for (const WorkerStatus& status : coordinator_.Workers()) {
        *response->add_workers() = ToWire(status);
      }
      return absl::OkStatus();
    }());
  }

  grpc::Status Cancel(grpc::ServerContext*, const v1::CancelRequest* request,
                      v1::CancelResponse*) override {
    return ToGrpc(coordinator_.Cancel({request->job_id()}));
  }

  grpc::Status Pause(grpc::ServerContext*, const v1::PauseRequest* request,
                     v1::PauseResponse*) override {
    return ToGrpc(coordinator_.Pause({request->job_id()}));
  }
  grpc::Status Resume(grpc::ServerContext*, const v1::ResumeRequest* request,
                      v1::ResumeResponse*) override {
    return ToGrpc(coordinator_.Resume({request->job_id()}));
  }
  grpc::Status SetPriority(grpc::ServerContext*, const v1::SetPriorityRequest* request,
                           v1::SetPriorityResponse*) override {
    return ToGrpc(coordinator_.SetPriority({request->job_id()}, request->priority()));
  }
  grpc::Status Requeue(grpc::ServerContext*, const v1::RequeueRequest* request,
                       v1::RequeueResponse*) override {
    return ToGrpc(coordinator_.Requeue({request->job_id()}, request->all()));
  }
  grpc::Status Explain(grpc::ServerContext*, const v1::ExplainRequest* request,
                       v1::ExplainResponse* response) override {
    return ToGrpc([&]() -> absl::Status {
      FP_ASSIGN_OR_RETURN(const Explanation explanation, coordinator_.Explain({request->job_id()}));
      *response = ToWire(explanation);
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
  static absl::Status SendTile(const TileData& data, grpc::ServerWriter<v1::TileChunk>& stream) {
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
    } while (at < bytes.size());
    return absl::OkStatus();
  }

  CoordinatorApi& coordinator_;
};

}  // namespace

std::unique_ptr<grpc::Service> MakeJobService(CoordinatorApi& coordinator) {
  return std::make_unique<JobServiceImpl>(coordinator);
}

}  // namespace farpoint

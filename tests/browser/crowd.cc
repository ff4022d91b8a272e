// farpoint-test-crowd HOST:PORT JOBS WORKERS: submits paused jobs and registers workers that do
// nothing, so that a page has a crowd to show. Exit code 1 if the coordinator refuses one.
#include <cstdio>
#include <cstdlib>
#include <string>

#include "proto/convert.h"
#include "proto/farpoint.grpc.pb.h"
#include "proto/grpc_channel.h"
#include "proto/grpc_status.h"

namespace farpoint {
namespace {

absl::Status Crowd(const std::string& address, int jobs, int workers) {
  const auto channel = OpenChannel(address, {});
  const auto blob_service = v1::BlobService::NewStub(channel);
  const auto job_service = v1::JobService::NewStub(channel);
  const auto worker_service = v1::WorkerService::NewStub(channel);
  const Blob scene = Blob::FromString("{}");
  {
    grpc::ClientContext context;
    v1::PutBlobResponse response;
    const auto stream = blob_service->Put(&context, &response);
    v1::PutBlobChunk chunk;
    chunk.set_sha256(scene.Hash().Hex());
    chunk.set_size_bytes(scene.size());
    chunk.set_data("{}");
    stream->Write(chunk);
    stream->WritesDone();
    FP_RETURN_IF_ERROR(FromGrpc(stream->Finish()));
  }
  for (int i = 0; i < jobs; ++i) {
    JobSpec spec;
    spec.asset_root = "scene.gltf";
    spec.asset_files["scene.gltf"] = scene.Hash();
    spec.film = {.width = 1920, .height = 1080, .crop = {0, 0, 1920, 1080}};
    spec.title = "shot " + std::to_string(i) + " of a sequence with a long name";
    spec.start_paused = true;
    grpc::ClientContext context;
    v1::SubmitRequest request;
    request.set_oldest_protocol_version(kOldestProtocolVersion);
    request.set_protocol_version(kProtocolVersion);
    *request.mutable_job() = ToWire(spec);
    v1::SubmitResponse response;
    FP_RETURN_IF_ERROR(FromGrpc(job_service->Submit(&context, request, &response)));
  }
  for (int i = 0; i < workers; ++i) {
    WorkerHello hello;
    hello.version = FARPOINT_VERSION;
    hello.fingerprint = scene.Hash();
    hello.threads = 32;
    hello.name = "rack" + std::to_string(i / 40) + "-node" + std::to_string(i % 40);
    grpc::ClientContext context;
    v1::RegisterResponse response;
    FP_RETURN_IF_ERROR(FromGrpc(worker_service->Register(&context, ToWire(hello), &response)));
  }
  return absl::OkStatus();
}

}  // namespace
}  // namespace farpoint

int main(int argc, char** argv) {
  if (argc != 4) {
    std::fprintf(stderr, "usage: farpoint-test-crowd HOST:PORT JOBS WORKERS\n");
    return 2;
  }
  const absl::Status status = farpoint::Crowd(argv[1], std::atoi(argv[2]), std::atoi(argv[3]));
  if (status.ok()) return 0;
  std::fprintf(stderr, "farpoint-test-crowd: %s\n", std::string(status.message()).c_str());
  return 1;
}

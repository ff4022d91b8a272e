#include <algorithm>
#include <map>
#include <memory>
#include <mutex>
#include <vector>

#include "proto/convert.h"
#include "proto/farpoint.grpc.pb.h"
#include "proto/grpc_status.h"
#include "server/grpc_services.h"

namespace farpoint {

namespace {

constexpr int kMaxAsked = 65536;
constexpr size_t kRememberedBlobs = 64;

// The hashes of a blob's chunks from its start, computed once for all who get it. Thread-safe.
class ChunkHashes {
 public:
  using Hashes = std::vector<Digest>;
  std::shared_ptr<const Hashes> Of(const Digest& name, std::span<const std::byte> bytes) {
    std::lock_guard lock(mutex_);
    auto at = known_.find(name);
    if (at != known_.end()) return at->second;
    // Held while it computes: who else wants this blob would only do the same.
    auto hashes = std::make_shared<Hashes>();
    for (size_t begin = 0; begin < bytes.size(); begin += kChunkBytes) {
      hashes->push_back(
          HashBytes(bytes.subspan(begin, std::min(kChunkBytes, bytes.size() - begin))));
    }
    if (known_.size() >= kRememberedBlobs) known_.erase(known_.begin());
    known_.emplace(name, hashes);
    return hashes;
  }

 private:
  std::mutex mutex_;
  std::map<Digest, std::shared_ptr<const Hashes>> known_;  // guarded by mutex_
};

class BlobServiceImpl final : public v1::BlobService::Service {
 public:
  BlobServiceImpl(CoordinatorApi& coordinator, const ServiceAccess& access)
      : coordinator_(coordinator), access_(access) {}

  grpc::Status FindMissing(grpc::ServerContext*, const v1::FindMissingRequest* request,
                           v1::FindMissingResponse* response) override {
    return ToGrpc([&]() -> absl::Status {
      if (request->sha256_size() > kMaxAsked) {
        return absl::InvalidArgumentError("sha256 has " + std::to_string(request->sha256_size()) +
                                          " entries; allowed: at most " +
                                          std::to_string(kMaxAsked));
      }
      std::vector<Digest> digests;
      for (const std::string& hex : request->sha256()) {
        FP_ASSIGN_OR_RETURN(digests.emplace_back(), DigestFromWire(hex, "sha256"));
      }
      FP_ASSIGN_OR_RETURN(const std::vector<Digest> missing, coordinator_.FindMissing(digests));
      for (const Digest& digest : missing) response->add_sha256(digest.Hex());
      return absl::OkStatus();
    }());
  }

  grpc::Status Put(grpc::ServerContext* context, grpc::ServerReader<v1::PutBlobChunk>* stream,
                   v1::PutBlobResponse*) override {
    return ToGrpc([&]() -> absl::Status {
      FP_ASSIGN_OR_RETURN(const Caller caller, CallerOf(*context, access_));
      v1::PutBlobChunk chunk;
      if (!stream->Read(&chunk)) return absl::InvalidArgumentError("Put without a message");
      FP_ASSIGN_OR_RETURN(const Digest digest, DigestFromWire(chunk.sha256(), "sha256"));
      const uint64_t size = chunk.size_bytes();
      std::unique_ptr<ClientLedger::Transfer> transfer;
      if (access_.ledger != nullptr) {
        FP_ASSIGN_OR_RETURN(transfer, access_.ledger->BeginTransfer(caller.name, size));
      }
      FP_ASSIGN_OR_RETURN(const std::unique_ptr<BlobWriter> writer,
                          coordinator_.StartPut(digest, size));
      do {
        if (chunk.data().size() > kChunkBytes) {
          return absl::InvalidArgumentError("data has " + std::to_string(chunk.data().size()) +
                                            " bytes; allowed: at most " +
                                            std::to_string(kChunkBytes));
        }
        FP_RETURN_IF_ERROR(
            writer->Append(std::as_bytes(std::span(chunk.data().data(), chunk.data().size()))));
        if (access_.traffic != nullptr) access_.traffic->blobs_received += chunk.data().size();
      } while (stream->Read(&chunk));
      FP_RETURN_IF_ERROR(writer->Commit());
      if (access_.ledger == nullptr) return absl::OkStatus();
      return access_.ledger->Stored(caller.name, digest, size);
    }());
  }

  grpc::Status Get(grpc::ServerContext*, const v1::GetBlobRequest* request,
                   grpc::ServerWriter<v1::GetBlobChunk>* stream) override {
    return ToGrpc([&]() -> absl::Status {
      FP_ASSIGN_OR_RETURN(const Digest digest, DigestFromWire(request->sha256(), "sha256"));
      FP_ASSIGN_OR_RETURN(const Blob blob, coordinator_.GetBlob(digest));
      const std::span<const std::byte> bytes = blob.bytes();
      if (request->offset_bytes() > bytes.size()) {
        return absl::OutOfRangeError("offset_bytes is " + std::to_string(request->offset_bytes()) +
                                     ", the blob has " + std::to_string(bytes.size()));
      }
      size_t at = static_cast<size_t>(request->offset_bytes());
      const std::shared_ptr<const ChunkHashes::Hashes> hashes = chunk_hashes_.Of(digest, bytes);
      v1::GetBlobChunk chunk;
      chunk.set_size_bytes(bytes.size());
      do {
        // To the next whole chunk first, so that the hashes fit from there on.
        const size_t size = std::min(kChunkBytes - at % kChunkBytes, bytes.size() - at);
        chunk.set_data(bytes.data() + at, size);
        const bool whole = at % kChunkBytes == 0 && size > 0;
        const Digest hash =
            whole ? (*hashes)[at / kChunkBytes] : HashBytes(bytes.subspan(at, size));
        chunk.set_data_sha256(hash.bytes.data(), hash.bytes.size());
        at += size;
        // Blocks while the peer does not read: at most a few chunks are in memory.
        if (!stream->Write(chunk)) return absl::CancelledError("the peer is gone");
        if (access_.traffic != nullptr) access_.traffic->blobs_sent += size;
        chunk.clear_size_bytes();
      } while (at < bytes.size());
      return absl::OkStatus();
    }());
  }

 private:
  CoordinatorApi& coordinator_;
  const ServiceAccess& access_;
  ChunkHashes chunk_hashes_;
};

}  // namespace

std::unique_ptr<grpc::Service> MakeBlobService(CoordinatorApi& coordinator,
                                               const ServiceAccess& access) {
  return std::make_unique<BlobServiceImpl>(coordinator, access);
}

}  // namespace farpoint

// What workers, networks and disks get wrong: poison, flipped bits, lies.
#include <signal.h>

#include <algorithm>
#include <filesystem>
#include <fstream>
#include <map>
#include <set>
#include <thread>

#include "bench/service_cases.h"
#include "core/base/executor.h"
#include "worker/blob_cache.h"
#include "worker/fingerprint.h"
#include "worker/grpc_link.h"

namespace farpoint {

using std::chrono::milliseconds;
using std::chrono::seconds;

namespace {

void Sleep(int ms) { std::this_thread::sleep_for(milliseconds(ms)); }

bool Says(const std::string& text, std::string_view part) {
  return text.find(part) != std::string::npos;
}

absl::StatusOr<Digest> ReferenceHash(ServiceFarm& farm, const SmallJob& job) {
  FP_RETURN_IF_ERROR(farm.StartWorker().status());
  FP_ASSIGN_OR_RETURN(const JobId id, farm.Submit(job));
  FP_RETURN_IF_ERROR(farm.WaitUntilDone(id, seconds(120)).status());
  farm.RemoveWorkers();
  return farm.ImageOf(id);
}

}  // namespace

// --- poison ----------------------------------------------------------------------------------

absl::Status RunPoison(const ServiceContext& context, ServiceResult& result) {
  FP_ASSIGN_OR_RETURN(const auto farm, ServiceFarm::Create(context.programs));
  FP_RETURN_IF_ERROR(farm->StartServer({"--heartbeat-ms", "100"}));
  const SmallJob job{.width = 256, .height = 192, .tile = 64};  // 4 x 3 tiles
  FP_ASSIGN_OR_RETURN(const Digest right, ReferenceHash(*farm, job));

  // The block at pixels 96..127 across and 32..63 down kills whoever computes it.
  for (int i = 0; i < 4; ++i) {
    FP_RETURN_IF_ERROR(farm->StartActor("worker", {"crash=100,40"}).status());
  }
  FP_ASSIGN_OR_RETURN(const JobId id, farm->Submit(job));
  int crashes = 0;
  JobStatus end;
  for (const Stopwatch watch; watch.seconds() < 120;) {
    FP_ASSIGN_OR_RETURN(end, farm->Status(id));
    if (IsFinal(end.state)) break;
    // What Kubernetes, Slurm or systemd does.
    for (size_t i = 0; i < farm->worker_count(); ++i) {
      if (farm->worker(i).Running()) continue;
      ++crashes;
      FP_RETURN_IF_ERROR(farm->Restart(i));
    }
    Sleep(20);
  }
  const std::string error(end.error.message());
  Count(result, "jobs that did not end with an error", end.state != JobState::kFailed, 0);
  Count(result, "crashes of workers by the tile", crashes, 3);
  Count(result, "other tiles that are not done",
        static_cast<double>(end.tiles.total - 1 - end.tiles.committed), 0);
  Count(result, "errors that do not name the tile", !Says(error, "tile 1 (pixels 64 to 127"), 0);
  Count(result, "errors that do not name the block", !Says(error, "block 3, 1"), 0);
  Count(result, "errors that do not name the cause", !Says(error, "signal 11"), 0);
  result.notes.push_back("the error: " + error);
  farm->RemoveWorkers();
  FP_RETURN_IF_ERROR(farm->StartWorker().status());
  FP_RETURN_IF_ERROR(farm->client().Requeue(id, false));
  FP_RETURN_IF_ERROR(farm->WaitUntilDone(id, seconds(60)).status());
  FP_ASSIGN_OR_RETURN(const Digest hash, farm->ImageOf(id));
  Count(result, "other hashes after `requeue` with a good worker", hash != right, 0);

  // A worker that fails on everything, beside a good one.
  FP_RETURN_IF_ERROR(farm->StartActor("worker", {"fails=1"}).status());
  Sleep(500);
  FP_ASSIGN_OR_RETURN(const JobId second, farm->Submit({.width = context.Pick(512, 192),
                                                        .height = context.Pick(384, 128)}));
  FP_ASSIGN_OR_RETURN(const JobStatus done, farm->WaitUntilDone(second, seconds(120)));
  FP_ASSIGN_OR_RETURN(const FarmStatus all, farm->client().Status({}));
  int set_aside = 0;
  uint64_t failures = 0;
  for (const WorkerStatus& worker : all.workers) {
    if (!worker.set_aside) continue;
    ++set_aside;
    failures = std::max(failures, worker.failures);
  }
  Count(result, "tiles set aside by a worker that fails on everything",
        static_cast<double>(done.tiles.failed), 0);
  CountAtLeast(result, "workers set aside", set_aside, 1);
  Count(result, "tiles that it got before", static_cast<double>(failures), 3);
  return absl::OkStatus();
}

// --- flips -----------------------------------------------------------------------------------

absl::Status RunFlips(const ServiceContext& context, ServiceResult& result) {
  std::mt19937_64 random = context.Random();
  FP_ASSIGN_OR_RETURN(const auto farm, ServiceFarm::Create(context.programs));
  FP_RETURN_IF_ERROR(farm->StartServer());
  Executor executor(1);
  FP_ASSIGN_OR_RETURN(const Digest fingerprint, ComputeFingerprint(executor));
  const int wanted = context.Pick(4000, 60);

  // Results: two damaged ones for each tile, by workers of their own, then the right one.
  FP_ASSIGN_OR_RETURN(const JobId job, farm->Submit({.width = 64 * 32,
                                                     .height = (wanted / 2 + 63) / 64 * 32,
                                                     .integrator = Integrator::kPt,
                                                     .beauty_only = true}));
  const auto link = GrpcLink::Connect(farm->address());
  const WorkerHello hello{.version = FARPOINT_VERSION, .fingerprint = fingerprint, .name = "hand"};
  std::vector<WorkerId> workers;
  int flips = 0, accepted = 0;
  uint64_t rendered = 0;
  std::map<uint32_t, int> damaged;
  std::map<WorkerId, int> in_a_row;
  WorkerId mine;
  for (;;) {
    if (mine.empty() || in_a_row[mine] == 3) {
      // Three damaged results in a row set a worker aside.
      FP_ASSIGN_OR_RETURN(const WorkerWelcome welcome, link->Register(hello));
      if (!mine.empty()) (void)link->Leave(mine);
      mine = welcome.id;
    }
    FP_ASSIGN_OR_RETURN(const std::optional<TileWork> work, link->Lease(mine, milliseconds(5000)));
    if (!work) break;
    TileResult back;
    back.lease = work->lease;
    back.attempt = work->attempt;
    std::vector<std::byte> bytes = EncodeFilm(Film(work->rect, work->frame.settings.layers));
    back.sha256 = HashBytes(bytes);
    const bool damage = flips < wanted && damaged[work->tile] < 2;
    if (damage) {
      const uint64_t bit = random() % (bytes.size() * 8);
      bytes[bit / 8] ^= static_cast<std::byte>(1 << (bit % 8));
      ++flips;
      ++damaged[work->tile];
      ++in_a_row[mine];
    } else {
      in_a_row[mine] = 0;
      ++rendered;
    }
    back.bytes = Blob::FromVector(bytes);
    FP_ASSIGN_OR_RETURN(const ReturnAnswer answer, link->Return(mine, back));
    if (damage) accepted += answer.accepted;
    if (!damage && !answer.accepted) return absl::InternalError("refused: " + answer.reason);
    if (rendered % 64 == 0) {
      FP_ASSIGN_OR_RETURN(const JobStatus status, farm->Status(job));
      if (IsFinal(status.state)) break;
    }
  }
  FP_ASSIGN_OR_RETURN(const JobStatus end, farm->WaitUntilDone(job, seconds(20)));
  Figure(result, "results with a flipped bit", flips);
  Count(result, "of these accepted", accepted, 0);
  CountAtLeast(result, "refusals that the job counted", static_cast<double>(end.refused_results),
               flips);
  FP_ASSIGN_OR_RETURN(const Digest image, farm->ImageOf(job));
  (void)image;

  // Blobs on their way to the coordinator.
  int blob_flips = 0, blobs_accepted = 0;
  for (int i = 0; i < context.Pick(3000, 40); ++i) {
    std::vector<std::byte> bytes(64 + random() % 4096);
    for (std::byte& byte : bytes) byte = static_cast<std::byte>(random());
    const Digest digest = HashBytes(bytes);
    const uint64_t bit = random() % (bytes.size() * 8);
    bytes[bit / 8] ^= static_cast<std::byte>(1 << (bit % 8));
    ++blob_flips;
    blobs_accepted += farm->client().Put(digest, Blob::FromVector(bytes)).ok();
    FP_ASSIGN_OR_RETURN(const std::vector<Digest> missing,
                        farm->client().FindMissing(std::span(&digest, 1)));
    blobs_accepted += missing.empty();
  }
  Figure(result, "blobs sent with a flipped bit", blob_flips);
  Count(result, "of these accepted", blobs_accepted, 0);

  // A worker's cache: a bit of a file flips between two processes.
  std::vector<std::byte> bytes(10000);
  for (std::byte& byte : bytes) byte = static_cast<std::byte>(random());
  const Blob blob = Blob::FromVector(bytes);
  FP_RETURN_IF_ERROR(farm->client().Put(blob.Hash(), blob));
  const std::string folder = farm->File("flipped.cache");
  int cache_flips = 0, served = 0;
  for (int i = 0; i < context.Pick(3000, 40); ++i) {
    FP_ASSIGN_OR_RETURN(const auto cache, BlobCache::Open({.directory = folder}, *link));
    FP_ASSIGN_OR_RETURN(const Blob got, cache->Get(blob.Hash(), {}));
    served += got.Hash() != blob.Hash();
    std::fstream file(folder + "/" + blob.Hash().Hex(),
                      std::ios::in | std::ios::out | std::ios::binary);
    const uint64_t bit = random() % (bytes.size() * 8);
    file.seekp(static_cast<std::streamoff>(bit / 8));
    const char flipped = static_cast<char>(bytes[bit / 8] ^ static_cast<std::byte>(1 << (bit % 8)));
    file.write(&flipped, 1);
    ++cache_flips;
  }
  Figure(result, "bits flipped in a worker's cache", cache_flips);
  Count(result, "damaged blobs served from it", served, 0);
  return absl::OkStatus();
}

// --- audits ----------------------------------------------------------------------------------

absl::Status RunAudits(const ServiceContext& context, ServiceResult& result) {
  const int trials = context.Pick(20, 1);
  int found = 0, wrong_images = 0, good_set_aside = 0;
  uint64_t liar_tiles = 0;
  std::set<std::string> right;
  for (int trial = 0; trial < trials; ++trial) {
    FP_ASSIGN_OR_RETURN(const auto farm, ServiceFarm::Create(context.programs));
    // In the quick form every fifth tile is audited: one trial should find it.
    FP_RETURN_IF_ERROR(farm->StartServer(
        {"--heartbeat-ms", "100", "--audit-fraction", context.options.quick ? "0.2" : "0.02"}));
    std::vector<std::string> values = {"render=null", "tile_ms=1"};
    for (int i = 0; i < 2; ++i) {
      FP_RETURN_IF_ERROR(farm->StartActor("worker", values).status());
    }
    values.emplace_back("wrong=0.2");
    values.push_back("seed=" + std::to_string(context.options.seed + static_cast<uint64_t>(trial)));
    FP_ASSIGN_OR_RETURN(const size_t liar, farm->StartActor("worker", values));
    for (;;) {
      FP_ASSIGN_OR_RETURN(const FarmStatus all, farm->client().Status({}));
      if (all.workers.size() == 3) break;
      Sleep(10);
    }
    // A third of the tiles each: 400 for the one that lies.
    FP_ASSIGN_OR_RETURN(const JobId job, farm->Submit({.width = 40 * 32,
                                                       .height = context.Pick(30, 10) * 32,
                                                       .integrator = Integrator::kPt,
                                                       .beauty_only = true}));
    FP_RETURN_IF_ERROR(farm->WaitUntilDone(job, seconds(240)).status());
    FP_ASSIGN_OR_RETURN(const FarmStatus all, farm->client().Status({}));
    bool caught = false;
    for (const WorkerStatus& worker : all.workers) {
      const bool is_liar = Says(farm->WorkerLog(liar), worker.id.value);
      if (is_liar) liar_tiles += worker.committed;
      if (is_liar && worker.set_aside) caught = true;
      good_set_aside += !is_liar && worker.set_aside;
    }
    found += caught;
    FP_ASSIGN_OR_RETURN(const JobInfo info, farm->client().Info(job));
    // Every tile of zeros has one hash for its place; the right image is all zeros.
    FP_ASSIGN_OR_RETURN(const Digest hash, farm->ImageOf(job));
    Film zeros(info.spec.film.crop, info.spec.settings.layers);
    if (caught) wrong_images += ImageHash(zeros) != hash;
  }
  Figure(result, "farms with a worker that lies", trials);
  Figure(result, "tiles that it returned on average, found or not",
         static_cast<double>(liar_tiles) / trials);
  // 20 trials of p = 0.8: fewer than 11 come once in 370 runs.
  CountAtLeast(result, "share of farms in which it was found", static_cast<double>(found) / trials,
               context.options.quick ? 1 : 0.55);
  Count(result, "wrong images where it was found", wrong_images, 0);
  Count(result, "good workers set aside", good_set_aside, 0);
  return absl::OkStatus();
}

}  // namespace farpoint

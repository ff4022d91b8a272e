#include "client/reports.h"

#include <sys/resource.h>

#include <algorithm>
#include <cstdio>
#include <nlohmann/json.hpp>

#include "client/console.h"
#include "client/job_request.h"

namespace farpoint {
namespace {

// Keeps the order in which keys were written.
using Json = nlohmann::ordered_json;

constexpr const char* kCounts[] = {"triangles", "surfels",  "nodes",     "receivers",
                                   "blocks",    "clusters", "cut_nodes", "rays"};
constexpr const char* kBytes[] = {"tree", "scene", "peak_rss"};

// Text of peers and files may be no UTF-8; that must not stop a report.
std::string Dump(const Json& json) {
  return json.dump(2, ' ', false, Json::error_handler_t::replace) + "\n";
}

template <typename T>
Json OrNull(const std::optional<T>& value) {
  return value ? Json(*value) : Json(nullptr);
}

Json ToJson(const JobStatus& status) {
  Json json;
  json["id"] = status.id.value;
  json["state"] = NameOf(status.state);
  json["tiles"] = {{"queued", status.tiles.queued},
                   {"leased", status.tiles.leased},
                   {"committed", status.tiles.committed},
                   {"failed", status.tiles.failed},
                   {"total", status.tiles.total}};
  json["reissued"] = status.reissued;
  json["refused_results"] = status.refused_results;
  json["eta_s"] = OrNull(status.eta_s);
  json["progress"] = status.progress;
  json["title"] = status.title;
  json["priority"] = status.priority;
  json["error"] = status.error.ok() ? Json(nullptr) : Json(std::string(status.error.message()));
  return json;
}

Json ToJson(const WorkerStatus& worker) {
  return {{"id", worker.id.value},       {"name", worker.name},
          {"version", worker.version},   {"threads", worker.threads},
          {"leases", worker.leases},     {"committed", worker.committed},
          {"failures", worker.failures}, {"set_aside", worker.set_aside},
          {"idle_s", worker.idle_s}};
}

template <typename... Args>
std::string Format(const char* format, Args... args) {
  char text[512];
  std::snprintf(text, sizeof(text), format, args...);
  return text;
}

std::string Number(const std::optional<double>& value) {
  return value ? Format("%.6g", *value) : std::string("-");
}

}  // namespace

std::string StatisticsJson(const Stats& stats, const SceneBlobs& blobs, const Digest& image_hash,
                           double run_seconds) {
  Json seconds = Json::object(), wall_seconds = Json::object();
  double total = 0;
  for (int i = 0; i < kStageCount; ++i) {
    seconds[kStageNames[i]] = stats.seconds[i];
    wall_seconds[kStageNames[i]] = stats.wall_seconds[i];
    total += stats.seconds[i];
  }
  seconds["total"] = total;
  seconds["wall"] = run_seconds;
  Json counts = Json::object(), skipped = Json::object(), bytes = Json::object();
  for (const char* key : kCounts) counts[key] = 0;
  for (const auto& [key, value] : stats.counts) counts[key] = value;
  for (const auto& [key, value] : stats.skipped) skipped[key] = value;
  for (const char* key : kBytes) bytes[key] = 0;
  for (const auto& [key, value] : stats.bytes) bytes[key] = value;
  const Digest tree = TreeHash(blobs);
  const Json json = {{"seconds", seconds},
                     {"wall_seconds", wall_seconds},
                     {"counts", counts},
                     {"skipped", skipped},
                     {"bytes", bytes},
                     {"hash",
                      {{"scene", blobs.prepared_scene.Hex()},
                       {"tree", tree.empty() ? std::string() : tree.Hex()},
                       {"image", image_hash.Hex()}}}};
  return Dump(json);
}

Digest TreeHash(const SceneBlobs& blobs) {
  if (blobs.tree_topology.empty() && blobs.tree_radiance.empty()) return {};
  return Sha256()
      .Update(std::as_bytes(std::span(blobs.tree_topology.bytes)))
      .Update(std::as_bytes(std::span(blobs.tree_radiance.bytes)))
      .Finish();
}

std::string JobStatusJson(const JobStatus& status) { return Dump(ToJson(status)); }

std::string FarmStatusJson(const FarmStatus& status) {
  Json jobs = Json::array(), workers = Json::array();
  for (const JobStatus& job : status.jobs) jobs.push_back(ToJson(job));
  for (const WorkerStatus& worker : status.workers) workers.push_back(ToJson(worker));
  return Dump({{"jobs", jobs}, {"workers", workers}});
}

std::string FarmStatusText(const FarmStatus& status) {
  std::string text = "JOB       STATE      TILES        AGAIN  REFUSED  ETA      TITLE\n";
  for (const JobStatus& job : status.jobs) {
    const std::string tiles =
        std::to_string(job.tiles.committed) + "/" + std::to_string(job.tiles.total);
    text += Format("%-9s %-10s %-12s %-6llu %-8llu %-8s %s\n", job.id.value.c_str(),
                   std::string(NameOf(job.state)).c_str(), tiles.c_str(),
                   static_cast<unsigned long long>(job.reissued),
                   static_cast<unsigned long long>(job.refused_results),
                   job.eta_s ? DurationText(*job.eta_s).c_str() : "-", job.title.c_str());
    if (!job.error.ok()) text += "          " + std::string(job.error.message()) + "\n";
  }
  if (status.workers.empty()) return text;
  text += "\nWORKER            THREADS  LEASES  TILES    FAILURES  IDLE     NAME\n";
  for (const WorkerStatus& worker : status.workers) {
    text += Format("%-17s %-8u %-7u %-8llu %-9llu %-8s %s%s\n", worker.id.value.c_str(),
                   worker.threads, worker.leases, static_cast<unsigned long long>(worker.committed),
                   static_cast<unsigned long long>(worker.failures),
                   DurationText(worker.idle_s).c_str(), worker.name.c_str(),
                   worker.set_aside ? " (set aside)" : "");
  }
  return text;
}

std::string ComparisonJson(const CompareResult& result) {
  const Json json = {
      {"mse", result.mse},
      {"rel_rmse", OrNull(result.rel_rmse)},
      {"rr", OrNull(result.rr)},
      {"bias", OrNull(result.bias)},
      {"max_abs", result.max_abs},
      {"pdp", OrNull(result.pdp)},
      {"flip", OrNull(result.flip)},
      {"hash_equal", result.hash_equal},
      {"hash_a", result.hash_a},
      {"hash_b", result.hash_b},
      {"pixels", result.pixels},
      {"left_out", result.left_out},
      {"mean", result.mean},
      {"ref_mean", result.ref_mean},
      {"rect", {result.rect.x0, result.rect.y0, result.rect.x1, result.rect.y1}},
  };
  return Dump(json);
}

std::string ComparisonText(const CompareResult& result) {
  std::string text;
  const auto line = [&](const char* name, const std::string& value) {
    text += Format("%-10s %s\n", name, value.c_str());
  };
  line("pixels", std::to_string(result.pixels));
  line("mse", Number(result.mse));
  line("rel_rmse", Number(result.rel_rmse));
  line("rr", Number(result.rr));
  line("bias", Number(result.bias));
  line("max_abs", Number(result.max_abs));
  line("pdp", result.pdp ? std::to_string(*result.pdp) : "-");
  line("flip", Number(result.flip));
  line("hash", result.hash_equal ? "equal" : "different");
  return text;
}

ExrMetadata ImageMetadata(const JobInfo& info, const Digest& image_hash) {
  ExrMetadata metadata;
  metadata.strings["farpoint:version"] = info.version;
  metadata.strings["farpoint:jobHash"] = JobHash(info.spec).Hex();
  metadata.strings["farpoint:imageHash"] = image_hash.Hex();
  metadata.strings["farpoint:settings"] = ImageSettingsJson(info.spec);
  metadata.matrices["worldToCamera"] = info.camera.world_to_camera;
  metadata.matrices["worldToNDC"] = info.camera.world_to_ndc;
  return metadata;
}

uint64_t PeakResidentBytes() {
  struct rusage usage = {};
  getrusage(RUSAGE_SELF, &usage);
  return static_cast<uint64_t>(usage.ru_maxrss) * 1024;
}

}  // namespace farpoint

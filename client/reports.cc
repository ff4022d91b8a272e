#include "client/reports.h"

#include <sys/resource.h>

#include <algorithm>
#include <cstdio>
#include <ctime>
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
  json["frames"] = {
      {"total", status.frames.total}, {"baked", status.frames.baked}, {"done", status.frames.done}};
  json["after"] = Json::array();
  for (const JobId& id : status.after) json["after"].push_back(id.value);
  json["title"] = status.title;
  json["owner"] = status.owner;
  json["priority"] = status.priority;
  json["suspect_tiles"] = status.suspect_tiles;
  json["error"] = status.error.ok() ? Json(nullptr) : Json(std::string(status.error.message()));
  return json;
}

Json ToJson(const WorkerStatus& worker) {
  return {{"id", worker.id.value},       {"name", worker.name},
          {"version", worker.version},   {"threads", worker.threads},
          {"leases", worker.leases},     {"committed", worker.committed},
          {"failures", worker.failures}, {"set_aside", worker.set_aside},
          {"idle_s", worker.idle_s},     {"gone", worker.gone}};
}

template <typename T>
Json ArrayOf(std::span<const T> values) {
  Json array = Json::array();
  for (const T& value : values) array.push_back(ToJson(value));
  return array;
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

Json HashesJson(const FrameReport& frame) {
  const Digest tree = TreeHash(frame.blobs);
  return {{"scene", frame.blobs.prepared_scene.Hex()},
          {"tree", tree.empty() ? std::string() : tree.Hex()},
          {"image", frame.image_hash.Hex()}};
}

// "2025-01-31T12:34:56.789Z"; "-" for a time that is not known.
std::string TimeText(int64_t unix_ms) {
  if (unix_ms <= 0) return "-";
  const std::time_t seconds = unix_ms / 1000;
  struct tm utc = {};
  if (gmtime_r(&seconds, &utc) == nullptr) return "-";
  char text[64];
  const size_t length = std::strftime(text, sizeof(text), "%Y-%m-%dT%H:%M:%S", &utc);
  std::snprintf(text + length, sizeof(text) - length, ".%03dZ", static_cast<int>(unix_ms % 1000));
  return text;
}

// What a kept event says, whatever its kind.
struct LogEntry {
  std::string level = "info", text;
  std::optional<uint32_t> tile;
  uint32_t attempt = 0;
  std::string worker, state;
};

std::optional<LogEntry> EntryOf(const JobEvent& event) {
  LogEntry entry;
  if (const auto* state = std::get_if<JobState>(&event.body)) {
    entry.state = NameOf(*state);
    entry.text = "the job is " + entry.state;
    if (*state == JobState::kFailed) {
      entry.level = "error";
      if (!event.status.error.ok()) {
        entry.text += ": " + std::string(event.status.error.message());
      }
    }
  } else if (const auto* tile = std::get_if<TileCommitted>(&event.body)) {
    entry.text = "committed";
    entry.tile = tile->tile;
  } else if (const auto* note = std::get_if<std::string>(&event.body)) {
    entry.text = *note;
  } else if (const auto* line = std::get_if<LogLine>(&event.body)) {
    entry.level = NameOf(line->level);
    entry.text = line->text;
    entry.tile = line->tile;
    entry.attempt = line->attempt;
    entry.worker = line->worker;
  } else {
    return std::nullopt;
  }
  return entry;
}

}  // namespace

std::string StatisticsJson(const Stats& stats, std::span<const FrameReport> frames, bool sequence,
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
  Json json = {
      {"seconds", seconds}, {"wall_seconds", wall_seconds},
      {"counts", counts},   {"skipped", skipped},
      {"bytes", bytes},
  };
  if (!sequence) {
    json["hash"] = HashesJson(frames.empty() ? FrameReport{} : frames[0]);
    return Dump(json);
  }
  std::vector<FrameReport> sorted(frames.begin(), frames.end());
  std::sort(sorted.begin(), sorted.end(),
            [](const FrameReport& a, const FrameReport& b) { return a.number < b.number; });
  Sha256 scene, tree, image;
  for (const FrameReport& frame : sorted) {
    const auto add = [](Sha256& all, const Digest& one) {
      all.Update(std::as_bytes(std::span(one.bytes)));
    };
    add(scene, frame.blobs.prepared_scene);
    add(tree, TreeHash(frame.blobs));
    add(image, frame.image_hash);
  }
  json["hash"] = {{"scene", scene.Finish().Hex()},
                  {"tree", tree.Finish().Hex()},
                  {"image", image.Finish().Hex()}};
  json["frames"] = Json::array();
  for (const FrameReport& frame : frames) {
    json["frames"].push_back({{"frame", frame.number},
                              {"file", frame.file},
                              {"written_s", frame.written_s},
                              {"missing_tiles", frame.missing_tiles},
                              {"hash", HashesJson(frame)}});
  }
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

std::string JobsJson(std::span<const JobStatus> jobs) { return Dump(ArrayOf(jobs)); }

std::string FarmStatusJson(const FarmStatus& status) {
  return Dump({{"jobs", ArrayOf(std::span<const JobStatus>(status.jobs))},
               {"workers", ArrayOf(std::span<const WorkerStatus>(status.workers))}});
}

std::string WorkersJson(std::span<const WorkerStatus> workers) {
  return Dump({{"workers", ArrayOf(workers)}});
}

std::string ExplanationJson(const JobId& job, const Explanation& explanation) {
  return Dump({{"id", job.value}, {"lines", explanation.lines}});
}

std::string FarmStatusText(const FarmStatus& status) {
  std::string text =
      "JOB       STATE      PRIO   TILES        FRAMES       AGAIN  REFUSED  ETA      TITLE\n";
  for (const JobStatus& job : status.jobs) {
    const std::string tiles =
        std::to_string(job.tiles.committed) + "/" + std::to_string(job.tiles.total);
    const std::string frames = job.frames.total > 1 ? std::to_string(job.frames.done) + "/" +
                                                          std::to_string(job.frames.total)
                                                    : "-";
    text += Format("%-9s %-10s %-6d %-12s %-12s %-6llu %-8llu %-8s ", job.id.value.c_str(),
                   std::string(NameOf(job.state)).c_str(), job.priority, tiles.c_str(),
                   frames.c_str(), static_cast<unsigned long long>(job.reissued),
                   static_cast<unsigned long long>(job.refused_results),
                   job.eta_s ? DurationText(*job.eta_s).c_str() : "-") +
            job.title + "\n";
    if (!job.after.empty() && !IsFinal(job.state)) {
      text += "          after";
      for (const JobId& id : job.after) text += " " + id.value;
      text += "\n";
    }
    if (!job.error.ok()) text += "          " + std::string(job.error.message()) + "\n";
    if (job.suspect_tiles > 0) {
      text += "          " + std::to_string(job.suspect_tiles) +
              " tiles are of a worker that returned wrong pixels elsewhere; farpoint requeue " +
              job.id.value + " renders them again\n";
    }
  }
  if (!status.workers.empty()) text += "\n" + WorkersText(status.workers);
  return text;
}

std::string WorkersText(std::span<const WorkerStatus> workers) {
  if (workers.empty()) return "no worker is registered; start farpoint-worker\n";
  std::string text = "WORKER            THREADS  LEASES  TILES    FAILURES  IDLE     NAME\n";
  for (const WorkerStatus& worker : workers) {
    text += Format("%-17s %-8u %-7u %-8llu %-9llu %-8s ", worker.id.value.c_str(), worker.threads,
                   worker.leases, static_cast<unsigned long long>(worker.committed),
                   static_cast<unsigned long long>(worker.failures),
                   DurationText(worker.idle_s).c_str()) +
            worker.name + (worker.set_aside ? " (set aside)" : "") +
            (worker.gone ? " (gone)" : "") + "\n";
  }
  return text;
}

std::string LogText(const JobEvent& event) {
  const std::optional<LogEntry> entry = EntryOf(event);
  if (!entry) return "";
  std::string text = TimeText(event.unix_ms) + "  " + Format("%-7s  ", entry->level.c_str());
  std::string where;
  if (entry->tile) where += "tile " + std::to_string(*entry->tile);
  if (entry->attempt > 0) {
    where += (where.empty() ? "attempt " : ", attempt ") + std::to_string(entry->attempt);
  }
  if (!entry->worker.empty()) where += (where.empty() ? "worker " : ", worker ") + entry->worker;
  if (!where.empty()) text += where + ": ";
  text += entry->text;
  // One line whatever a peer wrote.
  std::replace(text.begin(), text.end(), '\n', ' ');
  return text;
}

std::string LogJson(const JobEvent& event) {
  const std::optional<LogEntry> entry = EntryOf(event);
  if (!entry) return "";
  Json json = {{"time", event.unix_ms > 0 ? Json(TimeText(event.unix_ms)) : Json(nullptr)},
               {"sequence", event.sequence},
               {"level", entry->level},
               {"text", entry->text}};
  if (entry->tile) json["tile"] = *entry->tile;
  if (entry->attempt > 0) json["attempt"] = entry->attempt;
  if (!entry->worker.empty()) json["worker"] = entry->worker;
  if (!entry->state.empty()) json["state"] = entry->state;
  return json.dump(-1, ' ', false, Json::error_handler_t::replace);
}

std::string ComparisonJson(const CompareResult& result) {
  const Json json = {
      {"mse", result.mse},
      {"rel_rmse", OrNull(result.rel_rmse)},
      {"rr", OrNull(result.rr)},
      {"noise", result.noise},
      {"noise_above_error", result.noise_above_error},
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

std::optional<std::string> ComparisonWarning(const CompareResult& result) {
  if (!result.noise_above_error) return std::nullopt;
  return Format(
      "--noise %.6g is above the measured error, rel_rmse %.6g: rr is 0 and says only that the "
      "error is below what the reference can show; take a reference with less noise",
      result.noise, result.rel_rmse.value_or(0.0));
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

ExrMetadata ImageMetadata(const JobInfo& info, uint32_t frame, const Digest& image_hash,
                          ExrCompression compression, uint32_t missing_tiles) {
  const FrameInfo& of_frame = info.frames[frame];
  const JobSpec spec = SpecOfFrame(info.spec, frame);
  ExrMetadata metadata;
  metadata.strings["software"] = "farpoint " + info.version;
  if (!info.spec.title.empty()) metadata.strings["comments"] = info.spec.title;
  metadata.strings["farpoint:version"] = info.version;
  metadata.strings["farpoint:jobHash"] = JobHash(spec).Hex();
  metadata.strings["farpoint:settings"] = ImageSettingsJson(spec);
  if (IsLossless(compression)) {
    metadata.strings["farpoint:imageHash"] = image_hash.Hex();
  } else {
    metadata.strings["farpoint:renderedHash"] = image_hash.Hex();
    metadata.strings["farpoint:lossy"] = NameOf(compression);
  }
  if (missing_tiles > 0) {
    metadata.ints["farpoint:missingTiles"] = static_cast<int32_t>(missing_tiles);
  }
  if (!info.spec.frames.empty()) {
    metadata.ints["farpoint:frame"] = of_frame.number;
    metadata.ints["imageCounter"] = of_frame.number;
    metadata.frames_per_second = info.spec.fps;
  }
  metadata.matrices["worldToCamera"] = of_frame.camera.world_to_camera;
  metadata.matrices["worldToNDC"] = of_frame.camera.world_to_ndc;
  return metadata;
}

uint64_t PeakResidentBytes() {
  struct rusage usage = {};
  getrusage(RUSAGE_SELF, &usage);
  return static_cast<uint64_t>(usage.ru_maxrss) * 1024;
}

}  // namespace farpoint

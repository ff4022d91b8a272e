#include "client/commands.h"

#include <unistd.h>

#include <chrono>
#include <cstdio>
#include <filesystem>
#include <memory>
#include <optional>
#include <string>
#include <utility>

#include "client/embedded_farm.h"
#include "client/exit_code.h"
#include "client/grpc_farm_link.h"
#include "client/job_request.h"
#include "client/job_run.h"
#include "client/reports.h"
#include "client/retry.h"
#include "core/base/blob.h"
#include "core/image/compare.h"
#include "core/image/exr_io.h"

namespace farpoint {
namespace {

using SteadyTime = std::chrono::steady_clock::time_point;

double SecondsSince(SteadyTime start) {
  return std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count();
}

// Before hours of work, not after them.
absl::Status CheckFolderOf(const std::string& file, std::string_view flag) {
  if (file.empty() || file == "-") return absl::OkStatus();
  std::filesystem::path folder = std::filesystem::path(file).parent_path();
  if (folder.empty()) folder = ".";
  std::error_code error;
  const std::string context = std::string(flag) + " " + file;
  if (!std::filesystem::is_directory(folder, error)) {
    return absl::NotFoundError(context + ": the folder " + folder.string() +
                               " does not exist; create it");
  }
  if (access(folder.c_str(), W_OK) != 0) {
    return absl::PermissionDeniedError(context + ": the folder " + folder.string() +
                                       " cannot be written; choose another one");
  }
  return absl::OkStatus();
}

absl::Status CheckOutputs(const CommandLine& line) {
  FP_RETURN_IF_ERROR(CheckFolderOf(line.output, "-o"));
  FP_RETURN_IF_ERROR(CheckFolderOf(line.png, "--png"));
  FP_RETURN_IF_ERROR(CheckFolderOf(line.diff, "--diff"));
  return CheckFolderOf(line.json, "--json");
}

absl::Status WriteText(const std::string& file, const std::string& text) {
  if (file != "-") return WriteFileAtomically(file, std::as_bytes(std::span(text)));
  if (std::fwrite(text.data(), 1, text.size(), stdout) != text.size() || std::fflush(stdout) != 0) {
    return absl::UnavailableError("stdout cannot be written");
  }
  return absl::OkStatus();
}

absl::Status WriteImage(const CommandLine& line, const FinishedJob& job, SteadyTime start,
                        Console& console) {
  const Digest image_hash = ImageHash(job.film);
  const FilmSpec& film = job.info.spec.film;
  FP_RETURN_IF_ERROR(WriteExr(line.output, job.film, film.width, film.height,
                              ImageMetadata(job.info, image_hash), ExrCompression::kZip));
  if (!line.png.empty()) {
    FP_RETURN_IF_ERROR(WritePngPreview(line.png, job.film, line.exposure_stops));
  }
  const double run_seconds = SecondsSince(start);
  if (!line.json.empty()) {
    Stats stats = job.info.stats;
    uint64_t& peak_rss = stats.bytes["peak_rss"];
    peak_rss = std::max(peak_rss, PeakResidentBytes());
    FP_RETURN_IF_ERROR(
        WriteText(line.json, StatisticsJson(stats, job.info.blobs, image_hash, run_seconds)));
  }
  console.Info("wrote " + line.output + ", " + std::to_string(film.crop.width()) + "x" +
               std::to_string(film.crop.height()) + ", in " + DurationText(run_seconds) +
               ", image hash " + image_hash.Hex());
  return absl::OkStatus();
}

Retry MakeRetry(const CommandLine& line, const StopFlag& stop, Console& console) {
  RetryPolicy policy;
  policy.patience = std::chrono::milliseconds(static_cast<int64_t>(line.patience_s * 1000));
  return Retry(policy, "coordinator " + line.coordinator, stop, console);
}

absl::Status Render(const CommandLine& line, const StopFlag& stop, Console& console,
                    bool& usage_error) {
  const SteadyTime start = std::chrono::steady_clock::now();
  FP_RETURN_IF_ERROR(CheckOutputs(line));
  FP_ASSIGN_OR_RETURN(const PreparedRequest request,
                      PrepareRequest(line.scene, line.render_flags, usage_error));
  FP_ASSIGN_OR_RETURN(
      const std::unique_ptr<FarmLink> farm,
      StartEmbeddedFarm({.workers = line.workers, .threads = line.threads}, stop, console));
  // Nothing is between this and the coordinator: one attempt says all.
  Retry once({.patience = std::chrono::milliseconds(0)}, "the embedded coordinator", stop, console);
  JobRun run(*farm, once, stop, console);
  FP_ASSIGN_OR_RETURN(const JobId id, run.Submit(request));
  const absl::Status outcome = run.Wait(id);
  if (absl::IsCancelled(outcome)) farm->Cancel(id).IgnoreError();
  FP_RETURN_IF_ERROR(outcome);
  FP_ASSIGN_OR_RETURN(const FinishedJob job, run.Fetch(id));
  return WriteImage(line, job, start, console);
}

absl::Status Submit(const CommandLine& line, const StopFlag& stop, Console& console,
                    bool& usage_error) {
  const SteadyTime start = std::chrono::steady_clock::now();
  FP_RETURN_IF_ERROR(CheckOutputs(line));
  if (line.farm_ignores) {
    console.Info("--workers and --threads say nothing to a farm: its workers have their own");
  }
  FP_ASSIGN_OR_RETURN(PreparedRequest request,
                      PrepareRequest(line.scene, line.render_flags, usage_error));
  if (line.title) request.spec.title = *line.title;
  if (line.priority) request.spec.priority = *line.priority;
  const std::unique_ptr<FarmLink> farm = MakeGrpcFarmLink(line.coordinator, stop);
  Retry retry = MakeRetry(line, stop, console);
  JobRun run(*farm, retry, stop, console);
  FP_ASSIGN_OR_RETURN(const JobId id, run.Submit(request));
  if (line.detach) return WriteText("-", id.value + "\n");
  console.Info("job " + id.value);
  const absl::Status outcome = run.Wait(id);
  if (stop.raised()) {
    console.Info("job " + id.value + " goes on; farpoint fetch " + id.value +
                 " gets its image, farpoint cancel " + id.value + " ends it");
  }
  FP_RETURN_IF_ERROR(outcome);
  FP_ASSIGN_OR_RETURN(const FinishedJob job, run.Fetch(id));
  return WriteImage(line, job, start, console);
}

absl::Status Fetch(const CommandLine& line, const StopFlag& stop, Console& console) {
  const SteadyTime start = std::chrono::steady_clock::now();
  FP_RETURN_IF_ERROR(CheckOutputs(line));
  const std::unique_ptr<FarmLink> farm = MakeGrpcFarmLink(line.coordinator, stop);
  Retry retry = MakeRetry(line, stop, console);
  JobRun run(*farm, retry, stop, console);
  FP_ASSIGN_OR_RETURN(const FinishedJob job, run.Fetch(JobId{line.job}));
  return WriteImage(line, job, start, console);
}

absl::Status Status(const CommandLine& line, const StopFlag& stop, Console& console) {
  FP_RETURN_IF_ERROR(CheckOutputs(line));
  const std::unique_ptr<FarmLink> farm = MakeGrpcFarmLink(line.coordinator, stop);
  Retry retry = MakeRetry(line, stop, console);
  FP_ASSIGN_OR_RETURN(const FarmStatus status,
                      retry.Get<FarmStatus>([&] { return farm->Status(JobId{line.job}); }));
  if (line.json.empty()) return WriteText("-", FarmStatusText(status));
  if (line.job.empty()) return WriteText(line.json, FarmStatusJson(status));
  if (status.jobs.size() != 1) {
    return absl::InternalError("the coordinator says nothing about job " + line.job);
  }
  return WriteText(line.json, JobStatusJson(status.jobs[0]));
}

absl::Status Cancel(const CommandLine& line, const StopFlag& stop, Console& console) {
  const std::unique_ptr<FarmLink> farm = MakeGrpcFarmLink(line.coordinator, stop);
  Retry retry = MakeRetry(line, stop, console);
  return retry.Run([&] { return farm->Cancel(JobId{line.job}); });
}

absl::Status Compare(const CommandLine& line) {
  FP_RETURN_IF_ERROR(CheckOutputs(line));
  FP_ASSIGN_OR_RETURN(const ExrImage a, ReadExr(line.image_a));
  FP_ASSIGN_OR_RETURN(const ExrImage b, ReadExr(line.image_b));
  CompareOptions options;
  options.layer = line.layer;
  options.ref_layer = line.ref_layer;
  options.noise = line.noise;
  if (!line.mask.empty()) {
    FP_ASSIGN_OR_RETURN(options.mask, ReadMask(line.mask));
  }
  FP_ASSIGN_OR_RETURN(const CompareResult result, CompareImages(a, b, options));
  if (!line.diff.empty()) FP_RETURN_IF_ERROR(WriteDiffPng(line.diff, a, b, options, 0));
  if (!line.json.empty()) FP_RETURN_IF_ERROR(WriteText(line.json, ComparisonJson(result)));
  // A stdout that carries JSON carries nothing else.
  if (line.json == "-" || line.quiet) return absl::OkStatus();
  return WriteText("-", ComparisonText(result));
}

}  // namespace

int RunCommand(const CommandLine& line, const StopFlag& stop, Console& console) {
  bool usage_error = false;
  absl::Status status;
  switch (line.verb) {
    case Verb::kRender:
      status = Render(line, stop, console, usage_error);
      break;
    case Verb::kSubmit:
      status = Submit(line, stop, console, usage_error);
      break;
    case Verb::kStatus:
      status = Status(line, stop, console);
      break;
    case Verb::kCancel:
      status = Cancel(line, stop, console);
      break;
    case Verb::kFetch:
      status = Fetch(line, stop, console);
      break;
    case Verb::kCompare:
      status = Compare(line);
      break;
  }
  if (status.ok()) return kExitOk;
  if (stop.raised()) {
    console.Error("stopped by signal " + std::to_string(stop.signal()));
    return 128 + stop.signal();
  }
  console.Error(std::string(status.message()));
  return usage_error ? static_cast<int>(kExitUsage) : ExitCodeOf(status);
}

}  // namespace farpoint

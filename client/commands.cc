#include "client/commands.h"

#include <unistd.h>

#include <algorithm>
#include <chrono>
#include <filesystem>
#include <map>
#include <memory>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "client/certs.h"
#include "client/display_server.h"
#include "client/doctor.h"
#include "client/embedded_farm.h"
#include "client/exit_code.h"
#include "client/farm_commands.h"
#include "client/frame_range.h"
#include "client/grpc_farm_link.h"
#include "client/image_writer.h"
#include "client/job_request.h"
#include "client/job_run.h"
#include "client/reports.h"
#include "client/retry.h"
#include "core/image/compare.h"
#include "core/image/exr_io.h"

namespace farpoint {
namespace {

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

Retry MakeRetry(const CommandLine& line, const StopFlag& stop, Console& console) {
  RetryPolicy policy;
  policy.patience = std::chrono::milliseconds(static_cast<int64_t>(line.patience_s * 1000));
  return Retry(policy, "coordinator " + line.coordinator, stop, console);
}

// How the line says that the coordinator is reached. kInvalidArgument: its flags contradict each
// other.
absl::StatusOr<ChannelSecurity> SecurityOf(const CommandLine& line, Console& console) {
  ChannelSecurity security;
  if (line.tls.empty()) {
    if (!line.token_file.empty()) {
      return absl::InvalidArgumentError(
          "--token-file: without TLS the token could be read on the way; add --tls-ca FILE");
    }
    FP_RETURN_IF_ERROR(Annotate(CheckMayBePlain(line.tls, line.coordinator), "--coordinator"));
    if (!IsLoopback(line.coordinator)) {
      console.Warn("--insecure: whoever is on the way to " + line.coordinator +
                   " can read the scene and change the image");
    }
    return security;
  }
  TlsPaths paths{.ca = line.tls.directory + "/ca.pem"};
  if (line.token_file.empty() || line.tls.directory.empty()) {
    FP_ASSIGN_OR_RETURN(paths, FindTls(line.tls, Role::kClient));
  }
  if (!line.token_file.empty()) {
    if (!line.tls.paths.certificate.empty()) {
      return absl::InvalidArgumentError("--token-file: stands in for --tls-cert; give one of both");
    }
    FP_ASSIGN_OR_RETURN(security.token, ReadTokenFile(line.token_file));
  }
  FP_ASSIGN_OR_RETURN(security.tls, LoadTls(paths, TlsUse::kPeer, NowUnixS()));
  return security;
}

absl::StatusOr<std::unique_ptr<FarmLink>> OpenFarm(const CommandLine& line, const StopFlag& stop,
                                                   Console& console, bool& usage_error) {
  const absl::StatusOr<ChannelSecurity> security = SecurityOf(line, console);
  usage_error = absl::IsInvalidArgument(security.status());
  FP_RETURN_IF_ERROR(security.status());
  return MakeGrpcFarmLink(line.coordinator, stop, *security);
}

absl::StatusOr<ImageWriter> MakeWriter(const CommandLine& line, Console& console) {
  return ImageWriter::Create({.exr = line.output,
                              .png = line.png,
                              .json = line.json,
                              .exposure_stops = line.exposure_stops,
                              .compression = line.compression},
                             std::chrono::steady_clock::now(), console);
}

// Writes frames, and shows them and their tiles to the viewer of --display-server, if there is one.
class ImageOutput {
 public:
  // `writer` must outlive this. For jobs that `run` waits for or fetches.
  ImageOutput(const CommandLine& line, ImageWriter& writer, JobRun& run, Console& console)
      : writer_(writer) {
    if (line.display_server.empty()) return;
    display_ = std::make_unique<DisplayServer>(
        DisplayOptions{.address = line.display_server,
                       .name = [&writer](const JobInfo& info,
                                         uint32_t frame) { return writer.NameOf(info, frame); },
                       .warn = [&console](const std::string& text) { console.Warn(text); }});
    run.ShowTiles([this](const JobInfo& info, uint32_t tile, const Film& film) {
      display_->ShowTile(info, tile, film);
    });
  }

  FrameSink Sink() {
    return [this](const JobInfo& info, FetchedFrame frame) {
      FP_RETURN_IF_ERROR(writer_.Write(info, frame));
      if (display_ != nullptr) display_->ShowFrame(info, frame.frame, std::move(frame.film));
      return absl::OkStatus();
    };
  }

  // After all is written.
  void Finish() {
    if (display_ != nullptr) display_->Finish();
  }

 private:
  ImageWriter& writer_;
  std::unique_ptr<DisplayServer> display_;
};

// The numbers of the frames that are not written, as --frames takes them.
std::string FramesLeft(const JobSpec& spec, const ImageWriter& writer) {
  std::vector<int32_t> left = spec.frames;
  for (const FrameReport& frame : writer.written()) std::erase(left, frame.number);
  return FrameRangeText(left);
}

// The command that gets what this one asked for.
std::string FetchCommand(const CommandLine& line, const JobId& job) {
  std::string command = "farpoint fetch " + job.value + " -o ";
  command += line.output.empty() ? "OUT.exr" : line.output;
  if (!line.png.empty()) command += " --png " + line.png;
  if (line.compression != ExrCompression::kZip) {
    command.append(" --compression ").append(NameOf(line.compression));
  }
  return command + " --coordinator " + line.coordinator;
}

void Say(const PreparedRequest& request, const CommandLine& line, Console& console) {
  for (const std::string& note : request.notes) console.Info(note);
  if (line.quiet) return;
  for (const std::string& warning : request.warnings) console.Warn(warning);
}

absl::Status Render(const CommandLine& line, const StopFlag& stop, Console& console,
                    bool& usage_error) {
  FP_RETURN_IF_ERROR(CheckOutputs(line));
  usage_error = true;
  FP_ASSIGN_OR_RETURN(ImageWriter writer, MakeWriter(line, console));
  FP_ASSIGN_OR_RETURN(PreparedRequest request,
                      PrepareRequest(line.scene, line.render_flags, usage_error));
  Say(request, line, console);
  if (request.spec.start_paused) {
    console.Info("start_paused says nothing to render: nobody could resume the job");
    request.spec.start_paused = false;
  }
  const JobSpec& spec = request.spec;
  usage_error = true;
  FP_RETURN_IF_ERROR(writer.CheckNames(spec.frame_count(), !spec.frames.empty()));
  usage_error = false;
  FP_ASSIGN_OR_RETURN(
      const std::unique_ptr<FarmLink> farm,
      StartEmbeddedFarm(
          {.workers = line.workers, .threads = line.threads, .on_disk = spec.frame_count() > 1},
          stop, console));
  // Nothing is between this and the coordinator: one attempt says all.
  Retry once({.patience = std::chrono::milliseconds(0)}, "the embedded coordinator", stop, console);
  JobRun run(*farm, once, stop, console);
  ImageOutput output(line, writer, run, console);
  FP_ASSIGN_OR_RETURN(const JobId id, run.Submit(request));
  const absl::Status outcome = run.Wait(id, output.Sink());
  if (stop.raised()) {
    farm->Cancel(id).IgnoreError();
    if (!writer.written().empty()) {
      console.Info("the frames that were written are whole; --frames " + FramesLeft(spec, writer) +
                   " renders the others");
    }
  }
  FP_RETURN_IF_ERROR(outcome);
  output.Finish();
  return writer.WriteStatistics();
}

absl::Status Submit(const CommandLine& line, const StopFlag& stop, Console& console,
                    bool& usage_error) {
  FP_RETURN_IF_ERROR(CheckOutputs(line));
  if (line.farm_ignores) {
    console.Info("--workers and --threads say nothing to a farm: its workers have their own");
  }
  usage_error = true;
  FP_ASSIGN_OR_RETURN(ImageWriter writer, MakeWriter(line, console));
  FP_ASSIGN_OR_RETURN(PreparedRequest request,
                      PrepareRequest(line.scene, line.render_flags, usage_error));
  Say(request, line, console);
  JobSpec& spec = request.spec;
  if (line.title) spec.title = *line.title;
  if (line.priority) spec.priority = *line.priority;
  for (const std::string& id : line.after) spec.after.push_back(JobId{id});
  if (line.paused) spec.start_paused = true;
  usage_error = true;
  if (!line.output.empty()) {
    FP_RETURN_IF_ERROR(writer.CheckNames(spec.frame_count(), !spec.frames.empty()));
  }
  usage_error = false;
  FP_ASSIGN_OR_RETURN(const std::unique_ptr<FarmLink> farm,
                      OpenFarm(line, stop, console, usage_error));
  Retry retry = MakeRetry(line, stop, console);
  JobRun run(*farm, retry, stop, console);
  FP_ASSIGN_OR_RETURN(const JobId id, run.Submit(request));
  if (line.detach) {
    console.Info("job " + id.value + " is on its way; " + FetchCommand(line, id) +
                 (spec.frames.empty() ? " gets its image" : " gets its images"));
    if (!line.json.empty()) {
      FP_ASSIGN_OR_RETURN(const FarmStatus status,
                          retry.Get<FarmStatus>([&] { return farm->Status(id); }));
      if (status.jobs.size() == 1) {
        FP_RETURN_IF_ERROR(WriteText(line.json, JobStatusJson(status.jobs[0])));
      }
    }
    // A stdout that carries JSON carries nothing else.
    return line.json == "-" ? absl::OkStatus() : WriteText("-", id.value + "\n");
  }
  console.Info("job " + id.value);
  ImageOutput output(line, writer, run, console);
  const absl::Status outcome = run.Wait(id, output.Sink());
  if (stop.raised()) {
    std::string command = FetchCommand(line, id);
    if (!writer.written().empty()) command += " --frames " + FramesLeft(spec, writer);
    console.Info("job " + id.value + " goes on; " + command +
                 " gets what is left, farpoint cancel " + id.value + " ends it");
  }
  FP_RETURN_IF_ERROR(outcome);
  output.Finish();
  return writer.WriteStatistics();
}

// The indices of the frames that the line names.
absl::StatusOr<std::vector<uint32_t>> FramesWanted(const CommandLine& line, const JobInfo& info) {
  std::vector<uint32_t> indices;
  if (line.frames.empty()) {
    for (uint32_t i = 0; i < info.frames.size(); ++i) indices.push_back(i);
    return indices;
  }
  if (info.spec.frames.empty()) {
    return absl::InvalidArgumentError("--frames: job " + info.status.id.value +
                                      " is a still; leave the flag out");
  }
  std::map<int32_t, uint32_t> index_of;
  for (uint32_t i = 0; i < info.frames.size(); ++i) index_of[info.frames[i].number] = i;
  for (const int32_t frame : line.frames) {
    const auto found = index_of.find(frame);
    if (found == index_of.end()) {
      return absl::InvalidArgumentError("--frames: job " + info.status.id.value + " has no frame " +
                                        std::to_string(frame) + "; it has " +
                                        FrameRangeText(info.spec.frames));
    }
    indices.push_back(found->second);
  }
  return indices;
}

absl::Status Fetch(const CommandLine& line, const StopFlag& stop, Console& console,
                   bool& usage_error) {
  FP_RETURN_IF_ERROR(CheckOutputs(line));
  usage_error = true;
  FP_ASSIGN_OR_RETURN(ImageWriter writer, MakeWriter(line, console));
  usage_error = false;
  FP_ASSIGN_OR_RETURN(const std::unique_ptr<FarmLink> farm,
                      OpenFarm(line, stop, console, usage_error));
  Retry retry = MakeRetry(line, stop, console);
  JobRun run(*farm, retry, stop, console);
  ImageOutput output(line, writer, run, console);
  const JobId id{line.jobs[0]};
  FP_ASSIGN_OR_RETURN(JobInfo info, run.Info(id));
  usage_error = true;
  FP_ASSIGN_OR_RETURN(const std::vector<uint32_t> wanted, FramesWanted(line, info));
  FP_RETURN_IF_ERROR(writer.CheckNames(wanted.size(), !info.spec.frames.empty()));
  usage_error = false;

  if (line.wait && !IsFinal(info.status.state)) {
    // Frame by frame if all are wanted, else together at the end.
    const bool all = line.frames.empty();
    const absl::Status outcome = run.Wait(id, all ? output.Sink() : FrameSink());
    if (stop.raised()) return outcome;
    if (all) {
      FP_RETURN_IF_ERROR(outcome);
      output.Finish();
      return writer.WriteStatistics();
    }
    FP_ASSIGN_OR_RETURN(info, run.Info(id));
  }
  FP_ASSIGN_OR_RETURN(const size_t fetched, run.Fetch(info, wanted, line.partial, output.Sink()));
  output.Finish();
  if (fetched > 0) FP_RETURN_IF_ERROR(writer.WriteStatistics());
  const auto whole =
      std::count_if(writer.written().begin(), writer.written().end(),
                    [](const FrameReport& frame) { return frame.missing_tiles == 0; });
  if (static_cast<size_t>(whole) == wanted.size()) return absl::OkStatus();
  if (line.partial && fetched > 0) return absl::OkStatus();
  absl::Status outcome = OutcomeOf(info.status);
  if (outcome.ok()) {
    outcome = absl::InternalError("job " + id.value + " is done, but tiles of it are missing");
  }
  if (info.spec.frames.empty()) return outcome;
  return Annotate(outcome, std::to_string(whole) + " of " + std::to_string(wanted.size()) +
                               " frames are written");
}

absl::Status Compare(const CommandLine& line, Console& console) {
  FP_RETURN_IF_ERROR(CheckOutputs(line));
  FP_ASSIGN_OR_RETURN(const ExrImage a, ReadExr(line.image_a));
  FP_ASSIGN_OR_RETURN(const ExrImage b, ReadExr(line.image_b));
  CompareOptions options;
  options.layer = line.layer;
  options.ref_layer = line.ref_layer;
  options.noise = line.noise;
  options.image_name = line.image_a;
  options.ref_name = line.image_b;
  if (!line.mask.empty()) {
    FP_ASSIGN_OR_RETURN(options.mask, ReadMask(line.mask));
  }
  FP_ASSIGN_OR_RETURN(const CompareResult result, CompareImages(a, b, options));
  const std::optional<std::string> warning = ComparisonWarning(result);
  if (warning && !line.quiet) console.Warn(*warning);
  if (!line.diff.empty()) FP_RETURN_IF_ERROR(WriteDiffPng(line.diff, a, b, options, 0));
  if (!line.json.empty()) FP_RETURN_IF_ERROR(WriteText(line.json, ComparisonJson(result)));
  // A stdout that carries JSON carries nothing else.
  if (line.json == "-" || line.quiet) return absl::OkStatus();
  return WriteText("-", ComparisonText(result));
}

absl::Status Certs(const CommandLine& line, bool& usage_error) {
  const int64_t now_s = NowUnixS();
  absl::StatusOr<std::vector<std::string>> lines;
  switch (line.certs_action) {
    case CertsAction::kInit:
      lines = InitCerts({.directory = line.certs_directory,
                         .server_hosts = line.certs_hosts,
                         .workers = line.workers,
                         .clients = line.certs_clients,
                         .days = line.certs_days},
                        now_s);
      break;
    case CertsAction::kAdd:
      lines = AddCertificate({.directory = line.certs_directory,
                              .name = line.certs_name,
                              .role = line.certs_role,
                              .hosts = line.certs_hosts,
                              .days = line.certs_days},
                             now_s);
      break;
    case CertsAction::kShow:
      lines = ShowCerts(line.certs_directory, now_s);
      break;
    case CertsAction::kRevoke:
      lines = Revoke(line.certs_directory, line.certs_name, now_s);
      break;
    case CertsAction::kToken: {
      const absl::StatusOr<std::string> token = AddToken({.directory = line.certs_directory,
                                                          .name = line.certs_name,
                                                          .role = line.certs_role,
                                                          .days = line.certs_days},
                                                         now_s);
      if (token.ok()) {
        lines = std::vector<std::string>{*token};
      } else {
        lines = token.status();
      }
      break;
    }
  }
  usage_error = absl::IsInvalidArgument(lines.status());
  FP_RETURN_IF_ERROR(lines.status());
  std::string text;
  for (const std::string& one : *lines) text += one + "\n";
  return WriteText("-", text);
}

absl::Status Doctor(const CommandLine& line, const StopFlag& stop) {
  const std::vector<Finding> findings =
      Examine({.coordinator = line.coordinator,
               .tls = line.tls,
               .token_file = line.token_file,
               .role = line.doctor_role,
               .scene = line.scene,
               .points = line.points,
               .store = line.store,
               .listen = line.listen,
               .cache = line.cache,
               .blob_directory = line.blob_dir,
               .patience = std::chrono::milliseconds(
                   static_cast<int64_t>(1000 * std::clamp(line.patience_s, 0.1, 4.0)))},
              [&](const ChannelSecurity& security) {
                return MakeGrpcFarmLink(line.coordinator, stop, security);
              });
  if (!line.json.empty()) FP_RETURN_IF_ERROR(WriteText(line.json, FindingsJson(findings)));
  // A stdout that carries JSON carries nothing else.
  if (line.json != "-") FP_RETURN_IF_ERROR(WriteText("-", FindingsText(findings)));
  return OutcomeOf(findings);
}

absl::Status AskFarm(const CommandLine& line, const StopFlag& stop, Console& console,
                     bool& usage_error) {
  FP_RETURN_IF_ERROR(CheckOutputs(line));
  FP_ASSIGN_OR_RETURN(const std::unique_ptr<FarmLink> farm,
                      OpenFarm(line, stop, console, usage_error));
  Retry retry = MakeRetry(line, stop, console);
  const FarmSession session{line, *farm, retry, stop, console};
  switch (line.verb) {
    case Verb::kStatus:
      return RunStatus(session);
    case Verb::kWorkers:
      return RunWorkers(session);
    case Verb::kWatch:
      return RunWatch(session);
    case Verb::kLogs:
      return RunLogs(session);
    case Verb::kExplain:
      return RunExplain(session);
    default:
      return RunControl(session);
  }
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
    case Verb::kFetch:
      status = Fetch(line, stop, console, usage_error);
      break;
    case Verb::kCompare:
      status = Compare(line, console);
      break;
    case Verb::kCerts:
      status = Certs(line, usage_error);
      break;
    case Verb::kDoctor:
      status = Doctor(line, stop);
      break;
    default:
      status = AskFarm(line, stop, console, usage_error);
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

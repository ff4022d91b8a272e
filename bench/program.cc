#include "bench/program.h"

#include <filesystem>
#include <optional>
#include <ostream>
#include <span>
#include <string_view>

#include "bench/accuracy_report.h"
#include "bench/command_line.h"
#include "bench/paper_report.h"
#include "bench/pareto_report.h"
#include "bench/scale_report.h"
#include "bench/service.h"
#include "bench/service_report.h"
#include "bench/skip_report.h"
#include "bench/stability_report.h"
#include "core/base/blob.h"
#include "core/image/png_io.h"

namespace farpoint {

namespace {

enum : int { kOk = 0, kUsage = 2, kPermanent = 42, kTryAgain = 75 };

int ExitCode(const absl::Status& status) {
  if (status.ok()) return kOk;
  return absl::IsUnavailable(status) || absl::IsResourceExhausted(status) ? kTryAgain : kPermanent;
}

absl::Status WriteText(const std::filesystem::path& path, std::string_view text) {
  return WriteFileAtomically(path.string(), std::as_bytes(std::span(text)));
}

absl::Status Pareto(const BenchCommandLine& line, std::ostream& out, std::ostream& err) {
  const std::filesystem::path dir = line.output_dir;
  // A folder that cannot be written should not cost the time of a run.
  const std::filesystem::path probe = dir / "pareto.json.part";
  FP_RETURN_IF_ERROR(WriteText(probe, ""));
  std::error_code error;
  std::filesystem::remove(probe, error);
  FP_ASSIGN_OR_RETURN(const ParetoReport report, RunPareto(line.pareto, [&](std::string_view text) {
                        err << "farpoint-bench: " << text << std::endl;
                      }));
  for (const std::string& note : report.notes) err << "farpoint-bench: note: " << note << "\n";
  if (const std::optional<std::string> warning = NoiseWarning(report)) {
    err << "farpoint-bench: warning: " << *warning << "\n";
  }
  FP_RETURN_IF_ERROR(WriteText(dir / "pareto.json", ParetoJson(report)));
  FP_RETURN_IF_ERROR(WriteText(dir / "pareto.html", ParetoHtml(report)));
  out << ParetoTable(report) << "\n"
      << (dir / "pareto.json").string() << "\n"
      << (dir / "pareto.html").string() << "\n";
  return absl::OkStatus();
}

absl::Status Accuracy(const BenchCommandLine& line, std::ostream& out, std::ostream& err) {
  const std::filesystem::path dir = line.output_dir;
  // A folder that cannot be written should not cost the time of a run.
  const std::filesystem::path probe = dir / "accuracy.json.part";
  FP_RETURN_IF_ERROR(WriteText(probe, ""));
  std::error_code error;
  std::filesystem::remove(probe, error);
  FP_ASSIGN_OR_RETURN(const AccuracyReport report,
                      RunAccuracy(line.accuracy, [&](std::string_view text) {
                        err << "farpoint-bench: " << text << std::endl;
                      }));
  FP_ASSIGN_OR_RETURN(const std::string html, AccuracyHtml(report));
  const auto write_pictures = [&](const std::vector<AccuracyPicture>& pictures) -> absl::Status {
    for (const AccuracyPicture& p : pictures) {
      FP_RETURN_IF_ERROR(WritePng((dir / p.file).string(), p.width, p.height, p.rgb));
    }
    return absl::OkStatus();
  };
  for (const AccuracyResult& result : report.results) {
    FP_RETURN_IF_ERROR(write_pictures(result.pictures));
  }
  for (const AccuracyCheck& check : report.checks) {
    FP_RETURN_IF_ERROR(write_pictures(check.pictures));
  }
  FP_RETURN_IF_ERROR(WriteText(dir / "accuracy.json", AccuracyJson(report)));
  FP_RETURN_IF_ERROR(WriteText(dir / "accuracy.html", html));
  out << AccuracyTable(report) << "\n"
      << (dir / "accuracy.json").string() << "\n"
      << (dir / "accuracy.html").string() << "\n";
  if (report.results.empty() && report.checks.empty()) {
    return absl::InvalidArgumentError(
        "accuracy: nothing was measured: the cases that were asked for need --scenes DIR or "
        "--references DIR with their files (the report lists what was left out)");
  }
  return absl::OkStatus();
}

absl::Status Paper(const BenchCommandLine& line, std::ostream& out, std::ostream& err) {
  const std::filesystem::path dir = line.output_dir;
  // A folder that cannot be written should not cost the time of a run.
  const std::filesystem::path probe = dir / "paper.json.part";
  FP_RETURN_IF_ERROR(WriteText(probe, ""));
  std::error_code error;
  std::filesystem::remove(probe, error);
  FP_ASSIGN_OR_RETURN(const PaperReport report, RunPaper(line.paper, [&](std::string_view text) {
                        err << "farpoint-bench: " << text << std::endl;
                      }));
  FP_ASSIGN_OR_RETURN(const std::string html, PaperHtml(report));
  FP_RETURN_IF_ERROR(WriteText(dir / "paper.json", PaperJson(report)));
  FP_RETURN_IF_ERROR(WriteText(dir / "paper.html", html));
  out << PaperTable(report) << "\n"
      << (dir / "paper.json").string() << "\n"
      << (dir / "paper.html").string() << "\n";
  return absl::OkStatus();
}

absl::Status Stability(const BenchCommandLine& line, std::ostream& out, std::ostream& err) {
  const std::filesystem::path dir = line.output_dir;
  // A folder that cannot be written should not cost the time of a run.
  const std::filesystem::path probe = dir / "stability.json.part";
  FP_RETURN_IF_ERROR(WriteText(probe, ""));
  std::error_code error;
  std::filesystem::remove(probe, error);
  FP_ASSIGN_OR_RETURN(const StabilityReport report,
                      RunStability(line.stability, [&](std::string_view text) {
                        err << "farpoint-bench: " << text << std::endl;
                      }));
  FP_RETURN_IF_ERROR(WriteText(dir / "stability.json", StabilityJson(report)));
  FP_RETURN_IF_ERROR(WriteText(dir / "stability.html", StabilityHtml(report)));
  out << StabilityTable(report) << "\n"
      << (dir / "stability.json").string() << "\n"
      << (dir / "stability.html").string() << "\n";
  if (report.failures() > 0) {
    return absl::FailedPreconditionError("stability: " + std::to_string(report.failures()) +
                                         " figures are above their bar (the table lists them)");
  }
  return absl::OkStatus();
}

absl::Status Scale(const BenchCommandLine& line, std::ostream& out, std::ostream& err) {
  const std::filesystem::path dir = line.output_dir;
  // A folder that cannot be written should not cost the time of a run.
  const std::filesystem::path probe = dir / "scale.json.part";
  FP_RETURN_IF_ERROR(WriteText(probe, ""));
  std::error_code error;
  std::filesystem::remove(probe, error);
  FP_ASSIGN_OR_RETURN(const ScaleReport report, RunScale(line.scale, [&](std::string_view text) {
                        err << "farpoint-bench: " << text << std::endl;
                      }));
  for (const std::string& note : report.notes) err << "farpoint-bench: note: " << note << "\n";
  FP_RETURN_IF_ERROR(WriteText(dir / "scale.json", ScaleJson(report)));
  FP_RETURN_IF_ERROR(WriteText(dir / "scale.html", ScaleHtml(report)));
  out << ScaleTable(report) << "\n"
      << (dir / "scale.json").string() << "\n"
      << (dir / "scale.html").string() << "\n";
  return absl::OkStatus();
}

absl::Status Skip(const BenchCommandLine& line, std::ostream& out, std::ostream& err) {
  const std::filesystem::path dir = line.output_dir;
  // A folder that cannot be written should not cost the time of a run.
  const std::filesystem::path probe = dir / "skip.json.part";
  FP_RETURN_IF_ERROR(WriteText(probe, ""));
  std::error_code error;
  std::filesystem::remove(probe, error);
  FP_ASSIGN_OR_RETURN(const SkipReport report, RunSkip(line.skip, [&](std::string_view text) {
                        err << "farpoint-bench: " << text << std::endl;
                      }));
  FP_RETURN_IF_ERROR(WriteText(dir / "skip.json", SkipJson(report)));
  FP_RETURN_IF_ERROR(WriteText(dir / "skip.html", SkipHtml(report)));
  out << SkipTable(report) << "\n"
      << (dir / "skip.json").string() << "\n"
      << (dir / "skip.html").string() << "\n";
  if (report.failures() > 0) {
    return absl::FailedPreconditionError("skip: " + std::to_string(report.failures()) +
                                         " promises do not hold (the table lists them)");
  }
  return absl::OkStatus();
}

absl::Status Service(const BenchCommandLine& line, std::ostream& out, std::ostream& err) {
#ifdef FARPOINT_SERVICE
  const std::filesystem::path dir = line.output_dir;
  // A folder that cannot be written should not cost the time of a run.
  const std::filesystem::path probe = dir / "service.json.part";
  FP_RETURN_IF_ERROR(WriteText(probe, ""));
  std::error_code error;
  std::filesystem::remove(probe, error);
  FP_ASSIGN_OR_RETURN(const ServiceReport report,
                      RunService(line.service, [&](std::string_view text) {
                        err << "farpoint-bench: " << text << std::endl;
                      }));
  FP_RETURN_IF_ERROR(WriteText(dir / "service.json", ServiceJson(report)));
  FP_RETURN_IF_ERROR(WriteText(dir / "service.html", ServiceHtml(report)));
  out << ServiceTable(report) << "\n"
      << (dir / "service.json").string() << "\n"
      << (dir / "service.html").string() << "\n";
  if (report.failures() > 0) {
    return absl::FailedPreconditionError("service: " + std::to_string(report.failures()) +
                                         " checks fail (the table lists them)");
  }
  return absl::OkStatus();
#else
  (void)line, (void)out, (void)err;
  return absl::UnimplementedError(
      "service: this farpoint-bench was built without the service; configure with "
      "-DFARPOINT_SERVICE=ON");
#endif
}

absl::Status Rebake(const BenchCommandLine& line, std::ostream& out, std::ostream& err) {
  FP_ASSIGN_OR_RETURN(const RebakeReport report, RunRebake(line.rebake, [&](std::string_view text) {
                        err << "farpoint-bench: " << text << std::endl;
                      }));
  const std::filesystem::path path = std::filesystem::path(line.output_dir) / "rebake.json";
  FP_RETURN_IF_ERROR(WriteText(path, RebakeJson(report)));
  out << RebakeTable(report) << "\n" << path.string() << "\n";
  return absl::OkStatus();
}

absl::Status Lights(const BenchCommandLine& line, std::ostream& out, std::ostream& err) {
  FP_ASSIGN_OR_RETURN(const LightsReport report, RunLights(line.lights, [&](std::string_view text) {
                        err << "farpoint-bench: " << text << std::endl;
                      }));
  const std::filesystem::path path = std::filesystem::path(line.output_dir) / "lights.json";
  FP_RETURN_IF_ERROR(WriteText(path, LightsJson(report)));
  out << LightsTable(report) << "\n" << path.string() << "\n";
  return absl::OkStatus();
}

absl::Status Figures(const BenchCommandLine& line, std::ostream& out, std::ostream& err) {
  FP_ASSIGN_OR_RETURN(const FiguresReport report,
                      RunFigures(line.figures, line.output_dir, [&](std::string_view text) {
                        err << "farpoint-bench: " << text << std::endl;
                      }));
  const std::filesystem::path folder(line.output_dir);
  FP_RETURN_IF_ERROR(WriteText(folder / "figures.json", FiguresJson(report)));
  FP_RETURN_IF_ERROR(WriteText(folder / "figures.md", FiguresTables(report)));
  out << FiguresTables(report) << "\n";
  for (const std::string& file : report.files) out << (folder / file).string() << "\n";
  return absl::OkStatus();
}

absl::Status Antialiasing(const BenchCommandLine& line, std::ostream& out, std::ostream& err) {
  const std::filesystem::path dir = line.output_dir;
  // A folder that cannot be written should not cost the time of a run.
  const std::filesystem::path probe = dir / "antialiasing.json.part";
  FP_RETURN_IF_ERROR(WriteText(probe, ""));
  std::error_code error;
  std::filesystem::remove(probe, error);
  FP_ASSIGN_OR_RETURN(const AntialiasingReport report,
                      RunAntialiasing(line.antialiasing, dir.string(), [&](std::string_view text) {
                        err << "farpoint-bench: " << text << std::endl;
                      }));
  FP_RETURN_IF_ERROR(WriteText(dir / "antialiasing.json", AntialiasingJson(report)));
  out << AntialiasingTable(report) << "\n" << (dir / "antialiasing.json").string() << "\n";
  for (const std::string& file : report.files) out << (dir / file).string() << "\n";
  if (report.scenes.empty()) {
    return absl::InvalidArgumentError(
        "antialiasing: nothing was measured: the cases that were asked for need --scenes DIR with "
        "their files (the report lists what was left out)");
  }
  return absl::OkStatus();
}

absl::Status Micro(const BenchCommandLine& line, std::ostream& out) {
  MicroOptions options = line.micro;
  options.json_path = (std::filesystem::path(line.output_dir) / "micro.json").string();
  FP_RETURN_IF_ERROR(RunMicro(options, out));
  out << "\n" << options.json_path << "\n";
  return absl::OkStatus();
}

absl::Status Run(const BenchCommandLine& line, std::ostream& out, std::ostream& err) {
  std::error_code error;
  std::filesystem::create_directories(line.output_dir, error);
  if (error) {
    return absl::InvalidArgumentError(line.output_dir + ": cannot be made: " + error.message() +
                                      "; name another folder with -o");
  }
  switch (line.verb) {
    case BenchVerb::kPareto:
      return Pareto(line, out, err);
    case BenchVerb::kRebake:
      return Rebake(line, out, err);
    case BenchVerb::kLights:
      return Lights(line, out, err);
    case BenchVerb::kAccuracy:
      return Accuracy(line, out, err);
    case BenchVerb::kPaper:
      return Paper(line, out, err);
    case BenchVerb::kStability:
      return Stability(line, out, err);
    case BenchVerb::kScale:
      return Scale(line, out, err);
    case BenchVerb::kSkip:
      return Skip(line, out, err);
    case BenchVerb::kService:
      return Service(line, out, err);
    case BenchVerb::kFigures:
      return Figures(line, out, err);
    case BenchVerb::kAntialiasing:
      return Antialiasing(line, out, err);
    case BenchVerb::kMicro:
      return Micro(line, out);
  }
  return absl::OkStatus();
}

}  // namespace

int RunBench(const std::vector<std::string>& args, std::ostream& out, std::ostream& err) {
#ifdef FARPOINT_SERVICE
  // A process of the service's benchmark, not for people: not in the help.
  if (!args.empty() && args.front() == "service-actor") {
    return RunServiceActor({args.begin() + 1, args.end()});
  }
#endif
  const absl::StatusOr<BenchCommandLine> line = ParseBenchCommandLine(args);
  if (!line.ok()) {
    err << "farpoint-bench: " << line.status().message() << std::endl;
    return kUsage;
  }
  if (line->print) {
    out << *line->print << std::flush;
    return kOk;
  }
  const absl::Status status = Run(*line, out, err);
  if (!status.ok()) err << "farpoint-bench: " << status.message() << std::endl;
  out.flush();
  if (absl::IsUnimplemented(status)) return kUsage;
  return ExitCode(status);
}

}  // namespace farpoint

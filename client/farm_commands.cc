#include "client/farm_commands.h"

#include <algorithm>
#include <cerrno>
#include <chrono>
#include <cstdio>
#include <map>
#include <memory>
#include <set>
#include <string>
#include <utility>
#include <vector>

#include "client/display_server.h"
#include "client/exit_code.h"
#include "client/image_writer.h"
#include "client/job_run.h"
#include "client/reports.h"

namespace farpoint {
namespace {

constexpr std::chrono::milliseconds kPollPeriod(500);

absl::StatusOr<JobStatus> StatusOf(FarmSession& session, const JobId& job) {
  FP_ASSIGN_OR_RETURN(FarmStatus status,
                      session.retry.Get<FarmStatus>([&] { return session.farm.Status(job); }));
  if (status.jobs.size() == 1) return std::move(status.jobs[0]);
  return absl::InternalError("the coordinator says nothing about job " + job.value);
}

// One named job is an object, all else an array.
absl::Status WriteJobs(const CommandLine& line, const std::vector<JobStatus>& jobs) {
  if (line.json.empty()) return absl::OkStatus();
  const bool one = line.jobs.size() == 1 && jobs.size() == 1;
  return WriteText(line.json, one ? JobStatusJson(jobs[0]) : JobsJson(jobs));
}

// Remembers which of several errors is to be returned and shows the others.
class Errors {
 public:
  explicit Errors(Console& console) : console_(console) {}

  void Add(const absl::Status& status) {
    if (status.ok()) return;
    const bool worse =
        worst_.ok() || (ExitCodeOf(worst_) == kExitTryAgain && ExitCodeOf(status) != kExitTryAgain);
    const absl::Status shown = worse ? worst_ : status;
    if (worse) worst_ = status;
    if (!shown.ok()) console_.Error(std::string(shown.message()));
  }
  const absl::Status& worst() const { return worst_; }

 private:
  Console& console_;
  absl::Status worst_;
};

absl::Status Tell(FarmSession& session, const JobId& job) {
  switch (session.line.verb) {
    case Verb::kPause:
      return session.farm.Pause(job);
    case Verb::kResume:
      return session.farm.Resume(job);
    case Verb::kRequeue:
      return session.farm.Requeue(job, session.line.all);
    case Verb::kPriority:
      return session.farm.SetPriority(job, *session.line.priority);
    default:
      return session.farm.Cancel(job);
  }
}

// A stream of lines to stdout or a file.
class LineOutput {
 public:
  static absl::StatusOr<LineOutput> Open(const std::string& file) {
    if (file.empty() || file == "-") return LineOutput(stdout, false);
    std::FILE* stream = std::fopen(file.c_str(), "w");
    if (stream == nullptr) {
      return absl::UnavailableError("--json " + file + ": cannot be written; choose another file");
    }
    return LineOutput(stream, true);
  }
  absl::Status Write(const std::string& line) {
    const std::string text = line + "\n";
    // At once: the reader may follow.
    if (std::fwrite(text.data(), 1, text.size(), stream_.get()) == text.size() &&
        std::fflush(stream_.get()) == 0) {
      return absl::OkStatus();
    }
    closed_ = errno == EPIPE;
    if (closed_) return absl::AbortedError("nobody reads the log any more");
    return absl::InternalError("the log cannot be written; is the disk full?");
  }
  // Whether the reader went away, as head does: no failure.
  bool closed() const { return closed_; }

 private:
  LineOutput(std::FILE* stream, bool owned)
      : stream_(
            stream, owned ? [](std::FILE* file) { std::fclose(file); } : [](std::FILE*) {}) {}

  std::unique_ptr<std::FILE, void (*)(std::FILE*)> stream_;
  bool closed_ = false;
};

// "a1b2c3d4" or its title, and the frame's number.
std::string ImageName(const JobInfo& info, uint32_t frame) {
  std::string name = info.spec.title.empty() ? info.status.id.value : info.spec.title;
  if (!info.spec.frames.empty()) name += " " + std::to_string(info.frames[frame].number);
  std::replace(name.begin(), name.end(), '\0', ' ');
  return name;
}

absl::Status WatchOne(FarmSession& session, const JobId& job) {
  JobRun run(session.farm, session.retry, session.stop, session.console);
  if (session.line.display_server.empty()) return run.Wait(job);
  DisplayServer display({.address = session.line.display_server,
                         .name = ImageName,
                         .warn = [&](const std::string& text) { session.console.Warn(text); }});
  run.ShowTiles([&](const JobInfo& info, uint32_t tile, const Film& film) {
    display.ShowTile(info, tile, film);
  });
  const absl::Status outcome = run.Wait(job, [&](const JobInfo& info, FetchedFrame frame) {
    display.ShowFrame(info, frame.frame, std::move(frame.film));
    return absl::OkStatus();
  });
  if (outcome.ok()) display.Finish();
  return outcome;
}

// Several jobs at once, by asking again and again.
absl::StatusOr<std::vector<JobStatus>> WatchSeveral(FarmSession& session, std::set<JobId> jobs) {
  std::map<JobId, JobStatus> ended;
  while (true) {
    FP_ASSIGN_OR_RETURN(const FarmStatus status, session.retry.Get<FarmStatus>(
                                                     [&] { return session.farm.Status(JobId{}); }));
    std::set<JobId> found;
    for (const JobStatus& job : status.jobs) {
      if (!jobs.contains(job.id)) continue;
      found.insert(job.id);
      session.console.Report(job);
      if (IsFinal(job.state)) ended[job.id] = job;
    }
    for (const JobId& job : jobs) {
      if (found.contains(job) || ended.contains(job)) continue;
      return absl::NotFoundError(
          "job " + job.value + " is not known to the coordinator; farpoint status lists the jobs");
    }
    if (ended.size() == jobs.size()) break;
    if (!session.stop.SleepFor(kPollPeriod)) return absl::CancelledError("stopped by a signal");
  }
  std::vector<JobStatus> statuses;
  for (auto& [id, status] : ended) statuses.push_back(std::move(status));
  return statuses;
}

}  // namespace

std::string ControlText(Verb verb, const JobStatus& status) {
  std::string text = "job " + status.id.value + " is " + std::string(NameOf(status.state));
  if (verb == Verb::kPriority) text += ", its priority " + std::to_string(status.priority);
  if (!IsFinal(status.state)) return text;
  switch (verb) {
    case Verb::kPriority:
      return text + ", of no effect unless it is requeued";
    case Verb::kCancel:
      if (status.state == JobState::kCancelled) return text;
      return text + "; nothing was done";
    case Verb::kPause:
    case Verb::kResume:
      if (status.state == JobState::kDone) return text + "; nothing was done";
      return text + "; farpoint requeue " + status.id.value + " lets it go on";
    case Verb::kRequeue:
      if (status.state != JobState::kDone) return text;
      return text + "; nothing was done, --all renders it again";
    default:
      return text;
  }
}

absl::Status RunStatus(FarmSession session) {
  const JobId job{session.line.jobs.empty() ? std::string() : session.line.jobs[0]};
  FP_ASSIGN_OR_RETURN(const FarmStatus status,
                      session.retry.Get<FarmStatus>([&] { return session.farm.Status(job); }));
  if (session.line.json.empty()) return WriteText("-", FarmStatusText(status));
  if (job.empty()) return WriteText(session.line.json, FarmStatusJson(status));
  if (status.jobs.size() != 1) {
    return absl::InternalError("the coordinator says nothing about job " + job.value);
  }
  return WriteText(session.line.json, JobStatusJson(status.jobs[0]));
}

absl::Status RunWorkers(FarmSession session) {
  FP_ASSIGN_OR_RETURN(const FarmStatus status,
                      session.retry.Get<FarmStatus>([&] { return session.farm.Status(JobId{}); }));
  if (!session.line.json.empty()) return WriteText(session.line.json, WorkersJson(status.workers));
  return WriteText("-", WorkersText(status.workers));
}

absl::Status RunControl(FarmSession session) {
  Errors errors(session.console);
  std::vector<JobStatus> statuses;
  for (const std::string& id : session.line.jobs) {
    const JobId job{id};
    const absl::Status told = session.retry.Run([&] { return Tell(session, job); });
    if (session.stop.raised()) return told;
    if (!told.ok()) {
      errors.Add(told);
      continue;
    }
    // What came of it: pausing a job that is done leaves it done.
    FP_ASSIGN_OR_RETURN(JobStatus status, StatusOf(session, job));
    session.console.Info(ControlText(session.line.verb, status));
    statuses.push_back(std::move(status));
  }
  FP_RETURN_IF_ERROR(WriteJobs(session.line, statuses));
  return errors.worst();
}

absl::Status RunWatch(FarmSession session) {
  std::set<JobId> jobs;
  for (const std::string& id : session.line.jobs) jobs.insert(JobId{id});
  if (jobs.empty()) {
    FP_ASSIGN_OR_RETURN(const FarmStatus status, session.retry.Get<FarmStatus>(
                                                     [&] { return session.farm.Status(JobId{}); }));
    for (const JobStatus& job : status.jobs) {
      if (!IsFinal(job.state)) jobs.insert(job.id);
    }
    if (jobs.empty()) {
      session.console.Info("every job has ended");
      return WriteJobs(session.line, {});
    }
  }
  if (jobs.size() == 1) {
    const JobId& job = *jobs.begin();
    const absl::Status outcome = WatchOne(session, job);
    if (session.stop.raised()) return outcome;
    // A coordinator that was lost, or an id that it does not know, has no status to write either.
    const auto status = StatusOf(session, job);
    if (!status.ok()) return outcome.ok() ? status.status() : outcome;
    FP_RETURN_IF_ERROR(WriteJobs(session.line, {*status}));
    if (outcome.ok()) session.console.Info("job " + job.value + " is done");
    return outcome;
  }
  FP_ASSIGN_OR_RETURN(const std::vector<JobStatus> ended, WatchSeveral(session, jobs));
  FP_RETURN_IF_ERROR(WriteJobs(session.line, ended));
  Errors errors(session.console);
  for (const JobStatus& job : ended) errors.Add(OutcomeOf(job));
  return errors.worst();
}

absl::Status RunLogs(FarmSession session) {
  const JobId job{session.line.jobs[0]};
  const bool json = !session.line.json.empty();
  FP_ASSIGN_OR_RETURN(LineOutput output, LineOutput::Open(session.line.json));
  uint64_t last_sequence = 0;
  bool caught_up = false;
  const absl::Status status = session.retry.Run([&] {
    return session.farm.Watch(job, last_sequence, [&](const JobEvent& event) -> absl::Status {
      session.retry.Succeeded();
      if (event.sequence == 0) {
        // A passing report comes only when nothing else is to be told.
        caught_up = true;
        return session.line.follow ? absl::OkStatus() : absl::AbortedError("caught up");
      }
      last_sequence = event.sequence;
      return output.Write(json ? LogJson(event) : LogText(event));
    });
  });
  if ((caught_up || output.closed()) && absl::IsAborted(status)) return absl::OkStatus();
  return status;
}

absl::Status RunExplain(FarmSession session) {
  const JobId job{session.line.jobs[0]};
  FP_ASSIGN_OR_RETURN(const Explanation explanation,
                      session.retry.Get<Explanation>([&] { return session.farm.Explain(job); }));
  if (!session.line.json.empty()) {
    return WriteText(session.line.json, ExplanationJson(job, explanation));
  }
  std::string text;
  for (const std::string& line : explanation.lines) text += line + "\n";
  return WriteText("-", text);
}

}  // namespace farpoint

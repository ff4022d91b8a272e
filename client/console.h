// What a person sees: one line per message on stderr, and a progress bar that is redrawn in place
// on a terminal and is a line per tenth elsewhere. Thread-safe.
#pragma once

#include <chrono>
#include <cstdio>
#include <map>
#include <mutex>
#include <optional>
#include <string>
#include <string_view>

#include "core/base/status.h"
#include "proto/job.h"

namespace farpoint {

enum class ConsoleLevel { kDebug, kInfo, kWarn, kError, kOff };
// kInvalidArgument lists the known names.
absl::StatusOr<ConsoleLevel> ConsoleLevelFromName(std::string_view name);

// "[#########-----------]  45 %  12/27 tiles  eta 1:05", or before there are tiles the state and
// for how long the job has been in it, "baking, 0:12"; `columns` >= 20.
std::string ProgressText(const JobStatus& status, int columns, double in_state_s = 0);
// "1:05", "2:03:04"
std::string DurationText(double seconds);

class Console {
 public:
  // Without progress if `quiet`. `stream` must live as long as this.
  Console(std::FILE* stream, bool terminal, ConsoleLevel level, bool quiet);
  ~Console();

  void Debug(std::string_view text) { Write(ConsoleLevel::kDebug, "", text); }
  void Info(std::string_view text) { Write(ConsoleLevel::kInfo, "", text); }
  void Warn(std::string_view text) { Write(ConsoleLevel::kWarn, "warning: ", text); }
  void Error(std::string_view text) { Write(ConsoleLevel::kError, "error: ", text); }

  void Progress(const JobStatus& status);
  // Of one of several jobs: a line with its id when something changed that is worth one.
  void Report(const JobStatus& status);

 private:
  void Write(ConsoleLevel level, std::string_view prefix, std::string_view text);
  void EraseBar();
  // Of the terminal that the stream is, less one; 79 if it is none.
  int Columns() const;

  std::FILE* const stream_;
  const bool terminal_;
  const ConsoleLevel level_;
  const bool quiet_;
  std::mutex mutex_;
  bool bar_drawn_ = false;                             // guarded by mutex_
  std::optional<JobState> state_;                      // that Progress saw last; guarded by mutex_
  std::chrono::steady_clock::time_point state_since_;  // guarded by mutex_
  std::string last_report_;                            // guarded by mutex_
  std::map<JobId, std::string> last_reports_;          // guarded by mutex_
};

}  // namespace farpoint

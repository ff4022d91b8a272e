// What a person sees: one line per message on stderr, and a progress bar that is redrawn in place
// on a terminal and is a line per tenth elsewhere. Thread-safe.
#pragma once

#include <cstdio>
#include <mutex>
#include <string>
#include <string_view>

#include "core/base/status.h"
#include "proto/job.h"

namespace farpoint {

enum class LogLevel { kDebug, kInfo, kWarn, kError, kOff };
// kInvalidArgument lists the known names.
absl::StatusOr<LogLevel> LogLevelFromName(std::string_view name);

// "[#########-----------]  45 %  12/27 tiles  eta 1:05"; `columns` >= 20.
std::string ProgressText(const JobStatus& status, int columns);
// "1:05", "2:03:04"
std::string DurationText(double seconds);

class Console {
 public:
  // Without progress if `quiet`. `stream` must live as long as this.
  Console(std::FILE* stream, bool terminal, LogLevel level, bool quiet);
  ~Console();

  void Debug(std::string_view text) { Write(LogLevel::kDebug, "", text); }
  void Info(std::string_view text) { Write(LogLevel::kInfo, "", text); }
  void Warn(std::string_view text) { Write(LogLevel::kWarn, "warning: ", text); }
  void Error(std::string_view text) { Write(LogLevel::kError, "error: ", text); }

  void Progress(const JobStatus& status);

 private:
  void Write(LogLevel level, std::string_view prefix, std::string_view text);
  void EraseBar();

  std::FILE* const stream_;
  const bool terminal_;
  const LogLevel level_;
  const bool quiet_;
  std::mutex mutex_;
  bool bar_drawn_ = false;   // guarded by mutex_
  std::string last_report_;  // guarded by mutex_
};

}  // namespace farpoint

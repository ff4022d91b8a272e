// What the main programs of the services share: exit codes, addresses, the log, signals to stop.
// For main.cc only: libraries neither log nor exit.
#pragma once

#include <chrono>
#include <csignal>
#include <cstdint>
#include <optional>
#include <string>
#include <string_view>
#include <vector>

#include "core/base/status.h"
#include "proto/job.h"

namespace farpoint {

inline constexpr int kServiceExitUsage = 2;
inline constexpr int kServiceExitPermanent = 42;
inline constexpr int kServiceExitTryAgain = 75;

// By core/base/status.h.
int ServiceExitCode(const absl::Status& status);
// "PROGRAM: message" on stderr; returns the exit code.
int ReportFatal(std::string_view program, const absl::Status& status);

// HOST:PORT with a port of 1..65535, or 0 if `any_port`; a host of colons stands in brackets.
// kInvalidArgument says what is wrong with `flag`.
absl::Status CheckHostPort(std::string_view flag, const std::string& address, bool any_port);

// What --log-level takes.
std::vector<std::string> LogLevelNames();
// What --log-format takes: "text", "json".
std::vector<std::string> LogFormatNames();
// What a line is about; what is empty or 0 is left out.
struct LogSubject {
  JobId job;
  std::optional<uint32_t> tile;
  uint32_t attempt = 0;
  WorkerId worker;
};
// Lines go to stderr from here on. In the format "json" each is an object with time (UTC,
// RFC 3339), level ("info", "warning", "error"), program, text, and job, tile, attempt and worker
// as far as they are known; ReportFatal writes one, too.
void StartLog(const std::string& program, const std::string& level,
              const std::string& format = "text");
// `detail`: only at --log-level debug.
void WriteLog(LogLevel level, const std::string& text, const LogSubject& subject = {},
              bool detail = false);
// The lines, without the time and level that the text format has in front.
// "job=… tile=… attempt=… worker=… text".
std::string LogText(const LogSubject& subject, std::string_view text);
std::string LogJson(std::string_view program, LogLevel level, const LogSubject& subject,
                    std::string_view text, std::chrono::system_clock::time_point time);

// SIGTERM and SIGINT, heard only by whoever waits. Construct before any thread starts, so that all
// inherit it. SIGPIPE and SIGXFSZ are ignored, too.
class StopSignals {
 public:
  StopSignals();
  // True if one came within `timeout`. One thread at a time.
  bool Wait(std::chrono::milliseconds timeout) const;

 private:
  sigset_t signals_;
};

}  // namespace farpoint

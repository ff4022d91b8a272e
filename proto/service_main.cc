#include "proto/service_main.h"

#include <pthread.h>
#include <spdlog/sinks/stdout_color_sinks.h>
#include <spdlog/spdlog.h>

#include <charconv>
#include <cstdio>
#include <ctime>
#include <nlohmann/json.hpp>

namespace farpoint {

namespace {

// Set by StartLog, before other threads write.
struct Log {
  std::string program;
  bool json = false;
} g_log;

}  // namespace

int ServiceExitCode(const absl::Status& status) {
  switch (status.code()) {
    case absl::StatusCode::kOk:
      return 0;
    case absl::StatusCode::kUnavailable:
    case absl::StatusCode::kDeadlineExceeded:
    case absl::StatusCode::kAborted:
      return kServiceExitTryAgain;
    default:
      return kServiceExitPermanent;
  }
}

int ReportFatal(std::string_view program, const absl::Status& status) {
  const std::string text(status.message());
  if (g_log.json) {
    WriteLog(LogLevel::kError, text);
  } else {
    std::fprintf(stderr, "%s: %s\n", std::string(program).c_str(), text.c_str());
  }
  return ServiceExitCode(status);
}

absl::Status CheckHostPort(std::string_view flag, const std::string& address, bool any_port) {
  const auto bad = [&](const std::string& why) {
    return absl::InvalidArgumentError(std::string(flag) + " '" + address + "': " + why +
                                      "; say HOST:PORT, e.g. farm.example:7447");
  };
  const size_t colon = address.rfind(':');
  if (colon == std::string::npos) return bad("there is no port");
  const std::string host = address.substr(0, colon);
  if (host.empty()) return bad("there is no host");
  const bool in_brackets = host.size() > 2 && host.front() == '[' && host.back() == ']';
  if (!in_brackets && host.find_first_of(":[]") != std::string::npos) {
    return bad("an address of several colons stands in brackets, as in [::1]:7447");
  }
  if (host.find_first_of(" \t/") != std::string::npos) return bad("'" + host + "' is not a host");
  int port = -1;
  const char* const end = address.data() + address.size();
  const auto read = std::from_chars(address.data() + colon + 1, end, port);
  if (read.ec != std::errc() || read.ptr != end || port < (any_port ? 0 : 1) || port > 65535) {
    return bad("'" + address.substr(colon + 1) + "' is not a port from " + (any_port ? "0" : "1") +
               " to 65535");
  }
  return absl::OkStatus();
}

std::vector<std::string> LogLevelNames() { return {"debug", "info", "warn", "error", "off"}; }

std::vector<std::string> LogFormatNames() { return {"text", "json"}; }

void StartLog(const std::string& program, const std::string& level, const std::string& format) {
  g_log.program = program;
  g_log.json = format == "json";
  spdlog::set_default_logger(spdlog::stderr_color_mt(program));
  spdlog::set_level(spdlog::level::from_str(level));
  if (g_log.json) spdlog::set_pattern("%v");
}

void WriteLog(LogLevel level, const std::string& text, const LogSubject& subject, bool detail) {
  if (detail && !spdlog::should_log(spdlog::level::debug)) return;
  const std::string line =
      g_log.json ? LogJson(g_log.program, level, subject, text, std::chrono::system_clock::now())
                 : LogText(subject, text);
  switch (level) {
    case LogLevel::kInfo:
      spdlog::info("{}", line);
      break;
    case LogLevel::kWarning:
      spdlog::warn("{}", line);
      break;
    case LogLevel::kError:
      spdlog::error("{}", line);
      break;
  }
}

std::string LogText(const LogSubject& subject, std::string_view text) {
  std::string line;
  if (!subject.job.empty()) line += "job=" + subject.job.value + " ";
  if (subject.tile) line += "tile=" + std::to_string(*subject.tile) + " ";
  if (subject.attempt != 0) line += "attempt=" + std::to_string(subject.attempt) + " ";
  if (!subject.worker.empty()) line += "worker=" + subject.worker.value + " ";
  return line.append(text);
}

std::string LogJson(std::string_view program, LogLevel level, const LogSubject& subject,
                    std::string_view text, std::chrono::system_clock::time_point time) {
  const auto ms =
      std::chrono::duration_cast<std::chrono::milliseconds>(time.time_since_epoch()).count();
  const std::time_t seconds = static_cast<std::time_t>(ms / 1000);
  std::tm utc{};
  ::gmtime_r(&seconds, &utc);
  char when[40];
  const size_t size = std::strftime(when, sizeof(when), "%Y-%m-%dT%H:%M:%S", &utc);
  std::snprintf(when + size, sizeof(when) - size, ".%03dZ", static_cast<int>(ms % 1000));
  nlohmann::ordered_json line;
  line["time"] = when;
  line["level"] = NameOf(level);
  line["program"] = program;
  if (!subject.job.empty()) line["job"] = subject.job.value;
  if (subject.tile) line["tile"] = *subject.tile;
  if (subject.attempt != 0) line["attempt"] = subject.attempt;
  if (!subject.worker.empty()) line["worker"] = subject.worker.value;
  line["text"] = text;
  // What is no UTF-8 came from outside; a line is written all the same.
  return line.dump(-1, ' ', false, nlohmann::ordered_json::error_handler_t::replace);
}

StopSignals::StopSignals() {
  sigemptyset(&signals_);
  sigaddset(&signals_, SIGTERM);
  sigaddset(&signals_, SIGINT);
  ::pthread_sigmask(SIG_BLOCK, &signals_, nullptr);
  std::signal(SIGPIPE, SIG_IGN);
  std::signal(SIGXFSZ, SIG_IGN);  // a file that may not grow is an error of the write
}

bool StopSignals::Wait(std::chrono::milliseconds timeout) const {
  const timespec limit{.tv_sec = timeout.count() / 1000,
                       .tv_nsec = (timeout.count() % 1000) * 1000000};
  return ::sigtimedwait(&signals_, nullptr, &limit) > 0;
}

}  // namespace farpoint

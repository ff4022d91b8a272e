#include "proto/service_main.h"

#include <pthread.h>
#include <spdlog/sinks/stdout_color_sinks.h>
#include <spdlog/spdlog.h>

#include <charconv>
#include <cstdio>

namespace farpoint {

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
  std::fprintf(stderr, "%s: %s\n", std::string(program).c_str(),
               std::string(status.message()).c_str());
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

std::vector<std::string> LogLevelNames() {
  return {"trace", "debug", "info", "warn", "warning", "error", "off"};
}

void StartLog(const std::string& program, const std::string& level) {
  spdlog::set_default_logger(spdlog::stderr_color_mt(program));
  spdlog::set_level(spdlog::level::from_str(level));
}

void WriteLog(LogLevel level, const std::string& line) {
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

std::string LogText(const JobId& job, std::optional<uint32_t> tile, uint32_t attempt,
                    const WorkerId& worker, std::string_view text) {
  std::string line;
  if (!job.empty()) line += "job=" + job.value + " ";
  if (tile) line += "tile=" + std::to_string(*tile) + " ";
  if (attempt != 0) line += "attempt=" + std::to_string(attempt) + " ";
  if (!worker.empty()) line += "worker=" + worker.value + " ";
  return line.append(text);
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

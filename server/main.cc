// farpoint-server: flags, log, signals. Everything else is the coordinator's.
#include <CLI/CLI.hpp>
#include <chrono>
#include <cstdio>
#include <string>

#include "core/base/blob.h"
#include "proto/service_main.h"
#include "server/coordinator.h"
#include "server/grpc_server.h"
#include "server/scene_baker.h"

namespace farpoint {
namespace {

constexpr const char* kProgram = "farpoint-server";

struct ServerFlags {
  std::string listen = "127.0.0.1:7447";
  std::string store, port_file, log_level = "info";
  unsigned threads = 0;
  uint64_t silence_ms = 5000, lease_ms = 120000, heartbeat_ms = 1000, speculate_after_ms = 5000;
  uint64_t retention_hours = 24 * 7, drain_seconds = 30;
  uint64_t max_blob_bytes = uint64_t{1} << 36;
  uint64_t bake_cache_mib = kDefaultBakeCacheBytes >> 20;
  JobLimits limits;
};

void DefineFlags(CLI::App& app, ServerFlags& flags) {
  app.set_version_flag("--version", "farpoint-server " FARPOINT_VERSION);
  app.set_config("--config", "", "Flags from a file: one NAME=VALUE a line, without the dashes");
  app.allow_config_extras(CLI::config_extras_mode::error);
  app.add_option("--listen", flags.listen, "HOST:PORT to listen on; port 0 takes a free one")
      ->capture_default_str();
  app.add_option("--store", flags.store, "Folder for jobs, blobs and tiles")->required();
  app.add_option("--threads", flags.threads, "Threads that bake scenes; 0: all cores");
  app.add_option("--port-file", flags.port_file, "Write the chosen port to this file");
  app.add_option("--log-level", flags.log_level, "What is logged to stderr")
      ->check(CLI::IsMember(LogLevelNames()))
      ->capture_default_str();
  const auto number = [&app](const char* name, uint64_t& value, uint64_t min, const char* text) {
    app.add_option(name, value, text)
        ->check(CLI::Range(min, uint64_t{1} << 62))
        ->capture_default_str();
  };
  number("--heartbeat-ms", flags.heartbeat_ms, 10, "How often workers renew their leases");
  number("--silence-ms", flags.silence_ms, 50, "A lease is lost when its worker is silent so long");
  number("--lease-ms", flags.lease_ms, 100, "A lease is lost when its progress stops for so long");
  number("--speculate-after-ms", flags.speculate_after_ms, 1,
         "A slow tile is copied to an idle worker no sooner");
  number("--drain-seconds", flags.drain_seconds, 0, "How long a stop waits for tiles in work");
  number("--retention-hours", flags.retention_hours, 1, "How long ended jobs are kept");
  app.add_option("--bake-cache-mib", flags.bake_cache_mib,
                 "MiB of memory for what bakes leave to later ones of nearly the same scene")
      ->check(CLI::Range(uint64_t{0}, uint64_t{1} << 24))
      ->capture_default_str();
  number("--max-blob-bytes", flags.max_blob_bytes, 1, "Largest blob that is taken");
  number("--max-pixels", flags.limits.max_pixels, 1, "Most pixels of a job");
  number("--max-asset-bytes", flags.limits.max_asset_bytes, 1, "Most bytes of a job's files");
  number("--max-triangles", flags.limits.max_triangles, 1, "Most triangles of a job");
  number("--max-surfels", flags.limits.max_surfels, 1, "Most surfels of a job");
  number("--max-seconds", flags.limits.max_seconds, 1, "Longest rendering time of a job");
}

void LogEntry(const CoordinatorLogEntry& entry) {
  WriteLog(entry.level, LogText(entry.job, entry.tile, entry.attempt, entry.worker, entry.text));
}

int Main(int argc, char** argv) {
  ServerFlags flags;
  CLI::App app{"farpoint-server: takes jobs, bakes their scenes, hands tiles to workers."};
  DefineFlags(app, flags);
  try {
    app.parse(argc, argv);
  } catch (const CLI::ParseError& error) {
    return app.exit(error) == 0 ? 0 : kServiceExitUsage;
  }
  if (const absl::Status bad = CheckHostPort("--listen", flags.listen, /*any_port=*/true);
      !bad.ok()) {
    ReportFatal(kProgram, bad);
    return kServiceExitUsage;
  }
  StartLog(kProgram, flags.log_level);
  const StopSignals signals;

  CoordinatorOptions options;
  options.store_directory = flags.store;
  options.baker = MakeCoreBaker(flags.threads, flags.bake_cache_mib << 20);
  options.limits = flags.limits;
  options.max_blob_bytes = flags.max_blob_bytes;
  options.heartbeat = std::chrono::milliseconds(flags.heartbeat_ms);
  options.silence_time = std::chrono::milliseconds(flags.silence_ms);
  options.lease_time = std::chrono::milliseconds(flags.lease_ms);
  options.speculate_after = std::chrono::milliseconds(flags.speculate_after_ms);
  options.retention = std::chrono::hours(flags.retention_hours);
  options.log = LogEntry;
  if (options.heartbeat * 2 > options.silence_time) {
    std::fprintf(stderr,
                 "farpoint-server: --silence-ms is %llu, less than two heartbeats of %llu ms; "
                 "raise it\n",
                 static_cast<unsigned long long>(flags.silence_ms),
                 static_cast<unsigned long long>(flags.heartbeat_ms));
    return kServiceExitUsage;
  }

  absl::StatusOr<std::unique_ptr<Coordinator>> coordinator = Coordinator::Open(std::move(options));
  if (!coordinator.ok()) {
    return ReportFatal(kProgram, coordinator.status());
  }
  absl::StatusOr<std::unique_ptr<GrpcServer>> server =
      GrpcServer::Start(**coordinator, flags.listen);
  if (!server.ok()) {
    return ReportFatal(kProgram, server.status());
  }
  const std::string port = std::to_string((*server)->port());
  if (!flags.port_file.empty()) {
    const absl::Status written =
        WriteFileAtomically(flags.port_file, std::as_bytes(std::span(port.data(), port.size())));
    if (!written.ok()) return ReportFatal(kProgram, Annotate(written, "--port-file"));
  }
  const std::string host = flags.listen.substr(0, flags.listen.rfind(':'));
  std::printf("listening on %s:%s\n", host.c_str(), port.c_str());
  std::fflush(stdout);
  WriteLog(LogLevel::kInfo, std::string(kProgram) + " " FARPOINT_VERSION " listening on " + host +
                                ":" + port + ", store '" + flags.store + "'");

  while (!signals.Wait(std::chrono::hours(1))) {
  }
  WriteLog(LogLevel::kInfo, "draining: no new leases; a second signal ends at once");
  (*server)->StopServing();
  (*coordinator)->Drain();
  const auto end = std::chrono::steady_clock::now() + std::chrono::seconds(flags.drain_seconds);
  while ((*coordinator)->ActiveLeases() > 0 && std::chrono::steady_clock::now() < end) {
    if (signals.Wait(std::chrono::milliseconds(50))) break;
  }
  (*server)->Shutdown(std::chrono::milliseconds(500));
  server->reset();
  coordinator->reset();
  WriteLog(LogLevel::kInfo, "stopped");
  return 0;
}

}  // namespace
}  // namespace farpoint

int main(int argc, char** argv) { return farpoint::Main(argc, argv); }

// farpoint-server: flags, log, signals. Everything else is the coordinator's.
#include <unistd.h>

#include <CLI/CLI.hpp>
#include <algorithm>
#include <chrono>
#include <cstdio>
#include <memory>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "core/base/blob.h"
#include "core/base/machine.h"
#include "proto/access.h"
#include "proto/service_flags.h"
#include "proto/service_main.h"
#include "proto/tls_files.h"
#include "server/coordinator.h"
#include "server/coordinator_meter.h"
#include "server/grpc_server.h"
#include "server/scene_baker.h"
#include "server/web_server.h"

namespace farpoint {
namespace {

constexpr const char* kProgram = "farpoint-server";

struct ServerFlags {
  std::string listen = "127.0.0.1:7447";
  std::string store, port_file, log_level = "info", log_format = "text";
  unsigned threads = 0;
  uint64_t silence_ms = 4000, lease_ms = 120000, heartbeat_ms = 1000, speculate_after_ms = 1000;
  uint64_t reconnect_ms = 500, stall_ms = 3000;
  double audit_fraction = 0.02;
  std::string blob_dir, web, metrics;
  uint64_t retention_hours = 24 * 7, drain_seconds = 30;
  uint64_t max_blob_bytes = uint64_t{1} << 36;
  uint64_t bake_cache_mib = kDefaultBakeCacheBytes >> 20;
  JobLimits limits;
  TlsFlags tls;
  std::string tokens, revoked;
  uint64_t max_connections = 8192, max_connections_per_host = 0, max_calls_per_second = 500;
  uint64_t network_memory_mib = 48;
  uint64_t max_jobs_per_client = 1000, max_bytes_per_client = uint64_t{1} << 40;
};

void DefineSecurityFlags(CLI::App& app, ServerFlags& flags) {
  app.add_option(
      "--certs", flags.tls.directory,
      "Folder of farpoint certs: speak TLS, with its ca.pem, server.pem, server.key, tokens "
      "and revoked");
  app.add_option("--tls-ca", flags.tls.paths.ca, "The authority's certificate, if not in --certs");
  app.add_option("--tls-cert", flags.tls.paths.certificate, "The coordinator's certificate");
  app.add_option("--tls-key", flags.tls.paths.key, "Its key");
  app.add_option("--tokens", flags.tokens,
                 "Tokens that stand in for a client's certificate "
                 "[tokens in --certs]");
  app.add_option("--revoked", flags.revoked,
                 "Certificates that count no longer [revoked in --certs]");
  app.add_flag("--insecure", flags.tls.insecure,
               "Listen beyond this machine without TLS: who reaches the port can do everything");
  const auto limit = [&app](const char* name, uint64_t& value, const char* text) {
    app.add_option(name, value, text)
        ->check(CLI::Range(uint64_t{1}, uint64_t{1} << 62))
        ->capture_default_str();
  };
  limit("--max-connections", flags.max_connections, "Most connections");
  app.add_option("--max-connections-per-host", flags.max_connections_per_host,
                 "Most connections of one host; 0: 512 with TLS, 4096 without")
      ->check(CLI::Range(uint64_t{0}, uint64_t{1} << 62))
      ->capture_default_str();
  limit("--network-memory-mib", flags.network_memory_mib,
        "Memory for what connections send, together; beyond it calls are ended, to be tried again");
  limit("--max-calls-per-second", flags.max_calls_per_second, "Of a client; with TLS only");
  limit("--max-jobs-per-client", flags.max_jobs_per_client, "Not ended; with TLS only");
  limit("--max-bytes-per-client", flags.max_bytes_per_client, "Of scene files; with TLS only");
}

void DefineFlags(CLI::App& app, ServerFlags& flags) {
  app.set_version_flag("--version", "farpoint-server " FARPOINT_VERSION);
  app.set_config("--config", "", "Flags from a file: one NAME=VALUE a line, without the dashes");
  app.allow_config_extras(CLI::config_extras_mode::error);
  app.add_option("--listen", flags.listen, "HOST:PORT to listen on; port 0 takes a free one")
      ->capture_default_str();
  app.add_option("--store", flags.store, "Folder for jobs, blobs and tiles")->required();
  app.add_option("--threads", flags.threads, "Threads that bake scenes; 0: all cores");
  app.add_option(
      "--web", flags.web,
      "HOST:PORT of a web page that shows jobs, workers and images; it has /metrics, too");
  app.add_option("--metrics", flags.metrics, "HOST:PORT of /metrics alone, for Prometheus");
  app.add_option("--port-file", flags.port_file, "Write the chosen port to this file");
  app.add_option("--log-format", flags.log_format, "How the log is written: for people or programs")
      ->check(CLI::IsMember(LogFormatNames()))
      ->capture_default_str();
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
  number("--reconnect-ms", flags.reconnect_ms, 0,
         "A lease is lost when the connection to its worker broke and stays broken so long");
  number("--stall-ms", flags.stall_ms, 100,
         "A lease is lost when its worker renders without progress or processor time so long");
  number("--speculate-after-ms", flags.speculate_after_ms, 1,
         "A slow tile is copied to an idle worker no sooner");
  app.add_option("--audit-fraction", flags.audit_fraction,
                 "Share of the tiles that another worker renders again in secret; 0: none")
      ->check(CLI::Range(0.0, 1.0))
      ->capture_default_str();
  app.add_option(
      "--blob-dir", flags.blob_dir,
      "Folder for scenes and trees, which workers may read by their --blob-dir [blobs in "
      "the store]");
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

// What the flags say of who may connect and do what.
absl::StatusOr<GrpcServerOptions> ServerOptionsOf(const ServerFlags& flags) {
  GrpcServerOptions options;
  if (flags.tls.empty()) {
    FP_RETURN_IF_ERROR(Annotate(CheckMayBePlain(flags.tls, flags.listen), "--listen"));
  } else {
    FP_ASSIGN_OR_RETURN(const TlsPaths paths, FindTls(flags.tls, Role::kServer));
    FP_ASSIGN_OR_RETURN(options.tls, LoadTls(paths, TlsUse::kServer, NowUnixS()));
    if (options.tls->facts.role != Role::kServer) {
      return absl::FailedPreconditionError("'" + paths.certificate + "': has the role " +
                                           std::string(NameOf(options.tls->facts.role)) +
                                           ", a coordinator's has server; see farpoint certs add");
    }
  }
  const std::string& folder = flags.tls.directory;
  const auto in_folder = [&](const std::string& given, const char* name) {
    return given.empty() && !folder.empty() ? folder + "/" + name : given;
  };
  options.tokens_file = in_folder(flags.tokens, "tokens");
  options.revoked_file = in_folder(flags.revoked, "revoked");
  options.max_connections = flags.max_connections;
  options.max_connections_per_host = flags.max_connections_per_host;
  // One over TLS takes some 80 KiB, which a stranger's does, too; in the clear 20.
  if (options.max_connections_per_host == 0) {
    options.max_connections_per_host = options.tls ? 512 : 4096;
  }
  options.calls_per_second = static_cast<double>(flags.max_calls_per_second);
  options.network_bytes = flags.network_memory_mib << 20;
  options.max_jobs_per_client = flags.max_jobs_per_client;
  options.max_bytes_per_client = flags.max_bytes_per_client;
  // Each connection takes a descriptor; the store, blobs and bakes take some, too.
  constexpr uint64_t kOtherFiles = 256;
  const uint64_t files = RaiseOpenFileLimit();
  if (files < options.max_connections + kOtherFiles) {
    options.max_connections = std::max<uint64_t>(files / 2, files - std::min(files, kOtherFiles));
  }
  options.ledger_file = flags.store + "/clients.sqlite";
  std::string blobs = flags.store + "/blobs";
  if (!flags.blob_dir.empty()) blobs = flags.blob_dir;
  options.has_blob = [blobs](const Digest& digest) {
    return ::access((blobs + "/" + digest.Hex()).c_str(), F_OK) == 0;
  };
  options.blob_directory = flags.blob_dir;
  options.facts = [store = flags.store, limits = flags.limits,
                   max_blob_bytes = flags.max_blob_bytes] {
    ServerFacts facts;
    LookAround(store, facts);
    facts.limits = limits;
    facts.max_blob_bytes = max_blob_bytes;
    return facts;
  };
  options.refused = [](std::string text) { WriteLog(LogLevel::kWarning, text); };
  return options;
}

// The page and the metrics, on the addresses that the flags name.
absl::StatusOr<std::vector<std::unique_ptr<HttpServer>>> StartWeb(
    const ServerFlags& flags, const std::optional<TlsMaterial>& tls, CoordinatorMeter& meter,
    GrpcServer& api) {
  std::vector<std::unique_ptr<HttpServer>> servers;
  const auto start = [&](const char* name, const std::string& address, bool page) -> absl::Status {
    if (address.empty()) return absl::OkStatus();
    WebServerOptions options{.address = address, .tls = tls, .page = page};
    if (!page && IsLoopback(address)) {
      options.tls.reset();
      options.open_metrics = true;
    }
    const bool secure = options.tls.has_value();
    absl::StatusOr<std::unique_ptr<HttpServer>> server =
        StartWebServer(std::move(options), meter, api);
    if (!server.ok()) return Annotate(server.status(), std::string("--") + name);
    const std::string text = std::string(name) + " on " + (secure ? "https://" : "http://") +
                             address.substr(0, address.rfind(':')) + ":" +
                             std::to_string((*server)->port()) + (page ? "/" : "/metrics");
    std::printf("%s\n", text.c_str());
    std::fflush(stdout);
    WriteLog(LogLevel::kInfo, text);
    servers.push_back(*std::move(server));
    return absl::OkStatus();
  };
  FP_RETURN_IF_ERROR(start("web", flags.web, true));
  FP_RETURN_IF_ERROR(start("metrics", flags.metrics, false));
  return servers;
}

void LogEntry(const CoordinatorLogEntry& entry) {
  WriteLog(entry.level, entry.text,
           {.job = entry.job, .tile = entry.tile, .attempt = entry.attempt, .worker = entry.worker},
           entry.detail);
}

int Main(int argc, char** argv) {
  ServerFlags flags;
  CLI::App app{"farpoint-server: takes jobs, bakes their scenes, hands tiles to workers."};
  DefineFlags(app, flags);
  DefineSecurityFlags(app, flags);
  if (const std::optional<int> code = ParseServiceFlags(app, kProgram, argc, argv)) return *code;
  if (const absl::Status bad = CheckHostPort("--listen", flags.listen, /*any_port=*/true);
      !bad.ok()) {
    ReportFatal(kProgram, bad);
    return kServiceExitUsage;
  }
  for (const auto& [name, address] :
       {std::pair{"--web", flags.web}, std::pair{"--metrics", flags.metrics}}) {
    absl::Status bad;
    if (!address.empty()) bad = CheckHostPort(name, address, /*any_port=*/true);
    if (bad.ok() && !address.empty() && flags.tls.empty()) {
      bad = Annotate(CheckMayBePlain(flags.tls, address), name);
    }
    if (bad.ok()) continue;
    ReportFatal(kProgram, bad);
    return kServiceExitUsage;
  }
  StartLog(kProgram, flags.log_level, flags.log_format);
  const StopSignals signals;
  absl::StatusOr<GrpcServerOptions> server_options = ServerOptionsOf(flags);
  if (!server_options.ok()) {
    ReportFatal(kProgram, server_options.status());
    return absl::IsInvalidArgument(server_options.status()) ? kServiceExitUsage
                                                            : kServiceExitPermanent;
  }
  const bool tls = server_options->tls.has_value();
  if (!tls && !IsLoopback(flags.listen)) {
    WriteLog(
        LogLevel::kWarning,
        "--insecure: no encryption and no authentication on " + flags.listen +
            "; whoever reaches this port can read all scenes, submit jobs and pose as a worker");
  }

  CoordinatorOptions options;
  options.store_directory = flags.store;
  const auto stages = std::make_shared<StageMeter>();
  options.baker =
      MakeMeteredBaker(MakeCoreBaker(flags.threads, flags.bake_cache_mib << 20), stages);
  options.limits = flags.limits;
  options.max_blob_bytes = flags.max_blob_bytes;
  options.heartbeat = std::chrono::milliseconds(flags.heartbeat_ms);
  options.silence_time = std::chrono::milliseconds(flags.silence_ms);
  options.reconnect_time = std::chrono::milliseconds(flags.reconnect_ms);
  options.stall_time = std::chrono::milliseconds(flags.stall_ms);
  options.audit_fraction = flags.audit_fraction;
  options.blob_directory = flags.blob_dir;
  options.lease_time = std::chrono::milliseconds(flags.lease_ms);
  options.speculate_after = std::chrono::milliseconds(flags.speculate_after_ms);
  options.retention = std::chrono::hours(flags.retention_hours);
  const auto losses = std::make_shared<LossMeter>();
  options.log = [losses](const CoordinatorLogEntry& entry) {
    losses->Count(entry.lost);
    LogEntry(entry);
  };
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
  const std::optional<TlsMaterial> tls_material = server_options->tls;
  CoordinatorMeter meter(**coordinator, stages, losses);
  absl::StatusOr<std::unique_ptr<GrpcServer>> server =
      GrpcServer::Start(meter, flags.listen, *std::move(server_options));
  if (!server.ok()) {
    return ReportFatal(kProgram, server.status());
  }
  absl::StatusOr<std::vector<std::unique_ptr<HttpServer>>> web =
      StartWeb(flags, tls_material, meter, **server);
  if (!web.ok()) return ReportFatal(kProgram, web.status());
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
                                ":" + port + (tls ? ", TLS" : ", in the clear") + ", store '" +
                                flags.store + "'");

  std::optional<TlsWatch> watch;
  if (tls) watch.emplace(tls_material->paths, TlsUse::kServer);
  while (!signals.Wait(std::chrono::seconds(1))) {
    if (!watch) continue;
    const std::optional<absl::StatusOr<TlsMaterial>> now = watch->Look(NowUnixS());
    if (!now) continue;
    absl::Status renewed = now->ok() ? (*server)->Renew(**now) : now->status();
    for (const std::unique_ptr<HttpServer>& one : *web) {
      // One for Prometheus on loopback is in the clear.
      const absl::Status of_page = now->ok() ? one->Renew(**now) : absl::OkStatus();
      if (!absl::IsFailedPrecondition(of_page)) renewed.Update(of_page);
    }
    if (renewed.ok()) {
      WriteLog(LogLevel::kInfo, "the certificate was replaced: new connections see it");
    } else {
      WriteLog(LogLevel::kError, "the certificate was replaced by one that cannot be used: " +
                                     std::string(renewed.message()));
    }
  }
  WriteLog(LogLevel::kInfo, "draining: no new leases; a second signal ends at once");
  (*server)->StopServing();
  (*coordinator)->Drain();
  const auto end = std::chrono::steady_clock::now() + std::chrono::seconds(flags.drain_seconds);
  while ((*coordinator)->ActiveLeases() > 0 && std::chrono::steady_clock::now() < end) {
    if (signals.Wait(std::chrono::milliseconds(50))) break;
  }
  web->clear();
  (*server)->Shutdown(std::chrono::milliseconds(500));
  server->reset();
  coordinator->reset();
  WriteLog(LogLevel::kInfo, "stopped");
  return 0;
}

}  // namespace
}  // namespace farpoint

int main(int argc, char** argv) { return farpoint::Main(argc, argv); }

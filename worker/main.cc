// farpoint-worker: flags, log, signals. Everything else is the worker's.
#include <unistd.h>

#include <CLI/CLI.hpp>
#include <atomic>
#include <chrono>
#include <cstdio>
#include <cstdlib>
#include <functional>
#include <mutex>
#include <optional>
#include <string>
#include <thread>
#include <utility>

#include "core/base/executor.h"
#include "proto/access.h"
#include "proto/certificate.h"
#include "proto/http_server.h"
#include "proto/metrics_text.h"
#include "proto/service_flags.h"
#include "proto/service_main.h"
#include "proto/tls_files.h"
#include "worker/blob_cache.h"
#include "worker/crash_reporter.h"
#include "worker/fingerprint.h"
#include "worker/grpc_link.h"
#include "worker/tile_renderer.h"
#include "worker/worker.h"
#include "worker/worker_meter.h"

namespace farpoint {
namespace {

constexpr const char* kProgram = "farpoint-worker";

struct WorkerFlags {
  std::string coordinator, cache, blob_dir, name, metrics, log_level = "info", log_format = "text";
  unsigned threads = 0;
  uint64_t cache_bytes = uint64_t{64} << 30;
  uint64_t cached_scenes = 2;
  uint64_t drain_seconds = 10;
  TlsFlags tls;
};

std::string DefaultCache() {
  if (const char* xdg = std::getenv("XDG_CACHE_HOME"); xdg != nullptr && *xdg != '\0') {
    return std::string(xdg) + "/farpoint";
  }
  if (const char* home = std::getenv("HOME"); home != nullptr && *home != '\0') {
    return std::string(home) + "/.cache/farpoint";
  }
  return "";
}

std::string DefaultName() {
  char host[128] = "worker";
  ::gethostname(host, sizeof(host) - 1);
  return std::string(host) + ":" + std::to_string(::getpid());
}

void DefineFlags(CLI::App& app, WorkerFlags& flags) {
  app.set_version_flag("--version", "farpoint-worker " FARPOINT_VERSION);
  app.set_config("--config", "", "Flags from a file: one NAME=VALUE a line, without the dashes");
  app.allow_config_extras(CLI::config_extras_mode::error);
  app.add_option("--coordinator", flags.coordinator, "HOST:PORT of farpoint-server")->required();
  app.add_option("--cache", flags.cache, "Folder for scenes; workers of one machine may share it")
      ->capture_default_str();
  app.add_option("--cache-bytes", flags.cache_bytes, "Most bytes in the cache")
      ->check(CLI::Range(uint64_t{1} << 20, uint64_t{1} << 62))
      ->capture_default_str();
  app.add_option(
      "--certs", flags.tls.directory,
      "Folder of farpoint certs: speak TLS, with its ca.pem and the worker's certificate");
  app.add_option("--tls-ca", flags.tls.paths.ca, "The authority's certificate, if not in --certs");
  app.add_option("--tls-cert", flags.tls.paths.certificate, "The worker's certificate");
  app.add_option("--tls-key", flags.tls.paths.key, "Its key");
  app.add_flag("--insecure", flags.tls.insecure,
               "Talk without TLS to a coordinator that is not on this machine");
  app.add_option("--blob-dir", flags.blob_dir,
                 "Folder of the site's shared file system with scenes and trees (the coordinator's "
                 "--blob-dir): they are copied from there, not sent");
  app.add_option("--threads", flags.threads, "Threads; 0: all cores")->capture_default_str();
  app.add_option("--name", flags.name, "Shown by `farpoint status`")->capture_default_str();
  app.add_option("--cached-scenes", flags.cached_scenes, "Scenes kept in memory")
      ->check(CLI::Range(1, 1000))
      ->capture_default_str();
  app.add_option("--drain-seconds", flags.drain_seconds,
                 "How long a stop lets the tile in work go on before it is given back")
      ->check(CLI::Range(0, 86400))
      ->capture_default_str();
  app.add_option("--metrics", flags.metrics, "HOST:PORT of /metrics, for Prometheus");
  app.add_option("--log-format", flags.log_format, "How the log is written: for people or programs")
      ->check(CLI::IsMember(LogFormatNames()))
      ->capture_default_str();
  app.add_option("--log-level", flags.log_level, "What is logged to stderr")
      ->check(CLI::IsMember(LogLevelNames()))
      ->capture_default_str();
}

void LogEntry(const WorkerLogEntry& entry) {
  WriteLog(entry.level, entry.text,
           {.job = entry.job, .tile = entry.tile, .attempt = entry.attempt});
}

// How to reach the coordinator. kInvalidArgument: the flags contradict each other.
absl::StatusOr<ChannelSecurity> SecurityOf(const WorkerFlags& flags) {
  ChannelSecurity security;
  if (flags.tls.empty()) {
    FP_RETURN_IF_ERROR(Annotate(CheckMayBePlain(flags.tls, flags.coordinator), "--coordinator"));
    return security;
  }
  FP_ASSIGN_OR_RETURN(const TlsPaths paths, FindTls(flags.tls, Role::kWorker));
  FP_ASSIGN_OR_RETURN(security.tls, LoadTls(paths, TlsUse::kPeer, NowUnixS()));
  if (security.tls->certificate.empty()) {
    return absl::InvalidArgumentError(
        "--tls-cert: not given; a worker needs a certificate, tokens are for clients");
  }
  return security;
}

// On loopback open to everybody who is there; else, with TLS, to whoever shows a certificate of the
// farm. Null if it is not wanted.
// `authority` is whose certificates count, now.
absl::StatusOr<std::unique_ptr<HttpServer>> StartMetrics(const WorkerFlags& flags,
                                                         const ChannelSecurity& security,
                                                         const WorkerMeter& meter,
                                                         const BlobCache& cache,
                                                         std::function<std::string()> authority) {
  if (flags.metrics.empty()) return nullptr;
  HttpServerOptions options;
  options.address = flags.metrics;
  options.threads = 4;
  if (!IsLoopback(flags.metrics)) options.tls = security.tls;
  options.ask_for_certificate = options.tls.has_value();
  const bool secure = options.tls.has_value();
  const unsigned threads =
      flags.threads != 0 ? flags.threads : std::max(1u, std::thread::hardware_concurrency());
  FP_ASSIGN_OR_RETURN(
      std::unique_ptr<HttpServer> server,
      HttpServer::Start(options, [&meter, &cache, threads, secure,
                                  authority = std::move(authority)](const HttpRequest& request) {
        if (secure) {
          const absl::Status known =
              request.certificates.empty()
                  ? absl::UnauthenticatedError("show a certificate of this farm")
                  : CheckIssued(request.certificates, authority(), /*server=*/false, NowUnixS());
          if (!known.ok()) {
            return HttpResponse{.status = HttpStatusOf(known),
                                .body = std::string(known.message()) + "\n"};
          }
        }
        if (request.path != "/metrics") {
          return HttpResponse{.status = 404, .body = "only /metrics is here\n"};
        }
        return HttpResponse{.content_type = kMetricsContentType,
                            .body = meter.Metrics(cache.finds(), threads)};
      }));
  WriteLog(LogLevel::kInfo, std::string("metrics on ") + (secure ? "https://" : "http://") +
                                flags.metrics.substr(0, flags.metrics.rfind(':')) + ":" +
                                std::to_string(server->port()) + "/metrics");
  return server;
}

// The farm's authority, which may be replaced while others read it.
class Authority {
 public:
  explicit Authority(std::string pem) : pem_(std::move(pem)) {}
  void Set(std::string pem) {
    std::lock_guard lock(mutex_);
    pem_ = std::move(pem);
  }
  std::string Get() const {
    std::lock_guard lock(mutex_);
    return pem_;
  }

 private:
  mutable std::mutex mutex_;
  std::string pem_;  // guarded by mutex_
};

// If the certificate was replaced, connects anew with it, and shows it with the metrics.
void TakeNewCertificate(TlsWatch& watch, const ChannelSecurity& before, GrpcLink& link,
                        HttpServer* metrics, Authority& authority) {
  const std::optional<absl::StatusOr<TlsMaterial>> now = watch.Look(NowUnixS());
  if (!now) return;
  if (!now->ok()) {
    WriteLog(LogLevel::kError, "the certificate was replaced by one that cannot be used: " +
                                   std::string(now->status().message()));
    return;
  }
  ChannelSecurity security = before;
  security.tls = **now;
  link.Reconnect(security);
  authority.Set(security.tls->ca);
  if (metrics != nullptr) {
    const absl::Status renewed = metrics->Renew(*security.tls);
    // On loopback they are in the clear.
    if (!renewed.ok() && !absl::IsFailedPrecondition(renewed)) {
      WriteLog(LogLevel::kError, "--metrics: " + std::string(renewed.message()));
    }
  }
  WriteLog(LogLevel::kInfo, "the certificate was replaced: connected anew with it");
}

int Main(int argc, char** argv) {
  WorkerFlags flags;
  flags.cache = DefaultCache();
  flags.name = DefaultName();
  CLI::App app{"farpoint-worker: renders tiles for a farpoint-server."};
  DefineFlags(app, flags);
  if (const std::optional<int> code = ParseServiceFlags(app, kProgram, argc, argv)) return *code;
  if (flags.cache.empty()) {
    std::fprintf(stderr, "farpoint-worker: there is no home folder; give --cache DIR\n");
    return kServiceExitUsage;
  }
  if (const absl::Status bad =
          CheckHostPort("--coordinator", flags.coordinator, /*any_port=*/false);
      !bad.ok()) {
    ReportFatal(kProgram, bad);
    return kServiceExitUsage;
  }
  StartLog(kProgram, flags.log_level, flags.log_format);
  const StopSignals signals;
  const absl::StatusOr<ChannelSecurity> security = SecurityOf(flags);
  if (!security.ok()) {
    ReportFatal(kProgram, security.status());
    return absl::IsInvalidArgument(security.status()) ? kServiceExitUsage : kServiceExitPermanent;
  }
  if (!security->tls && !IsLoopback(flags.coordinator)) {
    WriteLog(LogLevel::kWarning, "--insecure: whoever is on the way to " + flags.coordinator +
                                     " can read scenes and change pixels");
  }

  if (!flags.metrics.empty()) {
    absl::Status bad = CheckHostPort("--metrics", flags.metrics, /*any_port=*/true);
    if (bad.ok() && flags.tls.empty()) {
      bad = Annotate(CheckMayBePlain(flags.tls, flags.metrics), "--metrics");
    }
    if (!bad.ok()) {
      ReportFatal(kProgram, bad);
      return kServiceExitUsage;
    }
  }

  WorkerOptions options;
  {
    Executor executor(flags.threads);
    const absl::StatusOr<Digest> fingerprint = ComputeFingerprint(executor);
    if (!fingerprint.ok()) {
      return ReportFatal(kProgram, Annotate(fingerprint.status(), "the self-test failed"));
    }
    options.fingerprint = *fingerprint;
  }
  options.threads = flags.threads;
  options.name = flags.name;
  options.cached_scenes = flags.cached_scenes;
  options.drain_time = std::chrono::seconds(flags.drain_seconds);
  options.log = LogEntry;

  const std::unique_ptr<GrpcLink> link = GrpcLink::Connect(flags.coordinator, *security);
  WorkerMeter meter(*link, *link);
  const absl::StatusOr<std::unique_ptr<BlobCache>> cache =
      BlobCache::Open({.directory = flags.cache,
                       .max_bytes = flags.cache_bytes,
                       .warn = [](const std::string& text) { WriteLog(LogLevel::kWarning, text); },
                       .shared_directory = flags.blob_dir},
                      meter);
  if (!cache.ok()) return ReportFatal(kProgram, Annotate(cache.status(), "--cache"));
  const std::unique_ptr<TileRenderer> renderer = MakeCoreRenderer();
  Authority authority(security->tls ? security->tls->ca : std::string());
  const absl::StatusOr<std::unique_ptr<HttpServer>> metrics =
      StartMetrics(flags, *security, meter, **cache, [&authority] { return authority.Get(); });
  if (!metrics.ok()) return ReportFatal(kProgram, Annotate(metrics.status(), "--metrics"));
  Worker worker(std::move(options), meter, **cache, *renderer);
  WriteLog(LogLevel::kInfo, std::string(kProgram) + " " FARPOINT_VERSION " for " +
                                flags.coordinator + ", cache '" + flags.cache + "'");

  const CrashReporter crashes([&](const std::string& cause) { worker.ReportCrash(cause); });
  std::atomic<bool> ended = false;
  std::thread stopper([&] {
    std::optional<TlsWatch> watch;
    if (security->tls) watch.emplace(security->tls->paths, TlsUse::kPeer);
    auto next_look = std::chrono::steady_clock::now() + std::chrono::seconds(1);
    while (!ended.load()) {
      if (!signals.Wait(std::chrono::milliseconds(100))) {
        if (watch && std::chrono::steady_clock::now() >= next_look) {
          next_look = std::chrono::steady_clock::now() + std::chrono::seconds(1);
          TakeNewCertificate(*watch, *security, *link, metrics->get(), authority);
        }
        continue;
      }
      WriteLog(LogLevel::kInfo, "stopping: the tile in work is finished or given back");
      worker.Stop();
    }
  });
  const absl::Status status = worker.Run();
  ended = true;
  stopper.join();
  if (!status.ok()) return ReportFatal(kProgram, status);
  WriteLog(LogLevel::kInfo, "stopped");
  return 0;
}

}  // namespace
}  // namespace farpoint

int main(int argc, char** argv) { return farpoint::Main(argc, argv); }

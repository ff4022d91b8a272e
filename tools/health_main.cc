// farpoint-health: whether a coordinator or worker can serve, for HEALTHCHECK of containers and
// probes of Kubernetes, whose own gRPC probe knows no TLS.
#include <CLI/CLI.hpp>
#include <chrono>
#include <csignal>
#include <cstdio>
#include <optional>
#include <string>

#include "core/base/blob.h"
#include "proto/health_probe.h"
#include "proto/service_flags.h"
#include "proto/service_main.h"
#include "proto/tls_files.h"

namespace farpoint {
namespace {

constexpr const char* kProgram = "farpoint-health";

struct HealthFlags {
  std::string address;
  TlsFlags tls;
  std::string server_name;
  double timeout_s = 3;
  bool metrics = false;
};

void DefineFlags(CLI::App& app, HealthFlags& flags) {
  app.set_version_flag("--version", "farpoint-health " FARPOINT_VERSION);
  app.add_option("ADDRESS", flags.address, "HOST:PORT of a coordinator, or with --metrics a worker")
      ->required();
  app.add_option("--certs", flags.tls.directory,
                 "Folder of farpoint certs with ca.pem: speak TLS. On this machine's own addresses "
                 "the coordinator may show the certificate of the folder, whatever host it names");
  app.add_option("--tls-ca", flags.tls.paths.ca, "The authority's certificate, if not in --certs");
  app.add_option("--server-name", flags.server_name,
                 "Name that the certificate must hold [the address's host]");
  app.add_flag("--metrics", flags.metrics,
               "Ask for /metrics in the clear: a worker's --metrics on loopback");
  app.add_option("--timeout", flags.timeout_s, "Seconds to wait for the answer")
      ->check(CLI::Range(0.01, 3600.0))
      ->capture_default_str();
}

// What --certs and --tls-ca mean; none: in the clear.
absl::StatusOr<std::optional<HealthTls>> TlsOf(const HealthFlags& flags) {
  if (flags.tls.empty()) return std::nullopt;
  const std::string& folder = flags.tls.directory;
  if (!folder.empty() && !flags.tls.paths.ca.empty()) {
    return absl::InvalidArgumentError("--certs and --tls-ca: give one of them");
  }
  TlsPaths paths;
  paths.ca = folder.empty() ? flags.tls.paths.ca : folder + "/ca.pem";
  FP_ASSIGN_OR_RETURN(const TlsMaterial authority, LoadTls(paths, TlsUse::kPeer, NowUnixS()));
  HealthTls tls{.ca = authority.ca, .name = flags.server_name};
  if (tls.name.empty() && !folder.empty() && IsLoopback(flags.address)) {
    TlsFlags own;
    own.directory = folder;
    FP_ASSIGN_OR_RETURN(const TlsPaths server, FindTls(own, Role::kServer));
    FP_ASSIGN_OR_RETURN(const Blob pem, ReadFile(server.certificate, 1 << 20));
    FP_ASSIGN_OR_RETURN(
        const CertificateFacts facts,
        ReadCertificate({reinterpret_cast<const char*>(pem.bytes().data()), pem.size()},
                        server.certificate));
    if (!facts.hosts.empty()) tls.name = facts.hosts.front();
    // A wildcard stands for one label, any.
    if (tls.name.starts_with("*.")) tls.name.replace(0, 1, "coordinator");
  }
  return tls;
}

int Main(int argc, char** argv) {
  HealthFlags flags;
  CLI::App app{"farpoint-health: ends with 0 if a coordinator or worker can serve."};
  DefineFlags(app, flags);
  if (const std::optional<int> code = ParseServiceFlags(app, kProgram, argc, argv)) return *code;
  absl::Status bad = CheckHostPort("ADDRESS", flags.address, /*any_port=*/false);
  if (bad.ok() && flags.metrics && (!flags.tls.empty() || !flags.server_name.empty())) {
    bad = absl::InvalidArgumentError("--metrics: is asked in the clear; leave the TLS flags out");
  }
  if (!bad.ok()) {
    ReportFatal(kProgram, bad);
    return kServiceExitUsage;
  }
  std::signal(SIGPIPE, SIG_IGN);
  const std::chrono::milliseconds timeout(static_cast<int64_t>(flags.timeout_s * 1000));
  absl::Status health;
  if (flags.metrics) {
    health = AskMetrics(flags.address, timeout);
  } else {
    const absl::StatusOr<std::optional<HealthTls>> tls = TlsOf(flags);
    if (!tls.ok() && absl::IsInvalidArgument(tls.status())) {
      ReportFatal(kProgram, tls.status());
      return kServiceExitUsage;
    }
    health = tls.ok() ? AskHealth(flags.address, *tls, timeout) : tls.status();
  }
  if (!health.ok()) return ReportFatal(kProgram, health);
  std::printf("%s serves\n", flags.address.c_str());
  return 0;
}

}  // namespace
}  // namespace farpoint

int main(int argc, char** argv) { return farpoint::Main(argc, argv); }

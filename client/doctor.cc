#include "client/doctor.h"

#include <netinet/in.h>
#include <sys/socket.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <cmath>
#include <cstdlib>
#include <cstring>
#include <filesystem>
#include <map>
#include <nlohmann/json.hpp>
#include <optional>
#include <utility>

#include "client/exit_code.h"
#include "core/base/posix_file.h"
#include "core/scene/asset.h"
#include "proto/resolve.h"

namespace farpoint {

namespace {

constexpr int64_t kMaxSkewMs = 60'000;
constexpr int64_t kDayS = 24 * 3600;
constexpr int64_t kSoonS = 14 * kDayS;
// Below this a bake of any size, or a job's tiles, may not fit.
constexpr uint64_t kMinFreeDisk = uint64_t{1} << 30;
constexpr uint64_t kMinFreeMemory = uint64_t{256} << 20;
constexpr uint64_t kMinOpenFiles = 256;
constexpr uint64_t kMinServerFiles = 1024;
// docs/benchmarks.md: the peak of a bake, and what a worker maps.
constexpr uint64_t kBakeBytesPerSurfel = 115, kTreeBytesPerSurfel = 27;
// A scene's files unpack and are held besides what rays need of them.
constexpr uint64_t kSceneGrowth = 4;
constexpr uint64_t kBytesPerListedFile = 96;  // digest and frame of a file in a job's message

std::string Size(uint64_t bytes) {
  static constexpr const char* kUnits[] = {"bytes", "KiB", "MiB", "GiB", "TiB", "PiB", "EiB"};
  double value = static_cast<double>(bytes);
  size_t unit = 0;
  while (value >= 1024 && unit + 1 < std::size(kUnits)) {
    value /= 1024;
    ++unit;
  }
  char text[40];
  std::snprintf(text, sizeof(text), unit == 0 ? "%.0f %s" : "%.1f %s", value, kUnits[unit]);
  return text;
}

std::string Count(size_t count, const std::string& noun) {
  return std::to_string(count) + " " + noun + (count == 1 ? "" : "s");
}

class Report {
 public:
  void Good(std::string what, std::string text) {
    findings.push_back({Health::kGood, std::move(what), std::move(text), absl::StatusCode::kOk});
  }
  void Doubt(std::string what, std::string text) {
    findings.push_back(
        {Health::kDoubtful, std::move(what), std::move(text), absl::StatusCode::kOk});
  }
  void Bad(std::string what, std::string text,
           absl::StatusCode code = absl::StatusCode::kFailedPrecondition) {
    findings.push_back({Health::kBad, std::move(what), std::move(text), code});
  }
  void Bad(std::string what, const absl::Status& status) {
    Bad(std::move(what), std::string(status.message()), status.code());
  }
  void Add(std::vector<Finding> more) {
    for (Finding& one : more) findings.push_back(std::move(one));
  }
  std::vector<Finding> findings;
};

// --- This machine -----------------------------------------------------------------------------

void LookAtFolder(const std::string& what, const std::string& flag, const std::string& folder,
                  bool made_if_absent, Report& report) {
  std::error_code error;
  std::string there = folder;
  if (made_if_absent) {
    // The nearest folder above that is there decides whether it can be made.
    while (!std::filesystem::exists(there, error) && there.find('/') != std::string::npos &&
           there.rfind('/') > 0) {
      there = there.substr(0, there.rfind('/'));
    }
    if (!std::filesystem::exists(there, error)) there = ".";
  }
  if (std::filesystem::exists(there, error) && !std::filesystem::is_directory(there, error)) {
    return report.Bad(what,
                      flag + " " + folder + ": '" + there + "' is no folder; name another one");
  }
  if (const absl::Status status = CheckWritable(there); !status.ok()) {
    if (absl::IsNotFound(status)) {
      return report.Bad(what, flag + " " + folder +
                                  ": there is no such folder; create it, or correct "
                                  "the path (is its file system mounted?)");
    }
    return report.Bad(what,
                      flag + " " + std::string(status.message()) +
                          "; give this user the right to write there, or name another folder");
  }
  const auto disk = ReadDiskFacts(there);
  if (disk.ok() && disk->free_bytes < kMinFreeDisk) {
    return report.Bad(what, flag + " " + folder + ": only " + Size(disk->free_bytes) + " of " +
                                Size(disk->total_bytes) +
                                " are free there; free some, or name a folder on another disk");
  }
  report.Good(what, flag + " " + folder + " can be written" +
                        (disk.ok() ? ", " + Size(disk->free_bytes) + " are free" : std::string()));
}

void LookAtPort(const std::string& address, Report& report) {
  const absl::StatusOr<AddressList> list = Resolve(address, ResolveFor::kListening);
  if (!list.ok()) {
    return report.Bad("listen", "--listen " + address + ": " +
                                    std::string(list.status().message()) +
                                    "; name an address of this machine, as in 0.0.0.0:7447");
  }
  int failed = 0;
  for (const addrinfo* at = list->get(); at != nullptr && failed == 0; at = at->ai_next) {
    const Descriptor fd(::socket(at->ai_family, SOCK_STREAM | SOCK_CLOEXEC, 0));
    const int on = 1;
    if (!fd.valid()) continue;
    ::setsockopt(fd.get(), SOL_SOCKET, SO_REUSEADDR, &on, sizeof(on));
    if (at->ai_family == AF_INET6)
      ::setsockopt(fd.get(), IPPROTO_IPV6, IPV6_V6ONLY, &on, sizeof(on));
    if (::bind(fd.get(), at->ai_addr, at->ai_addrlen) != 0 || ::listen(fd.get(), 1) != 0)
      failed = errno;
  }
  switch (failed) {
    case 0:
      return report.Good("listen", "--listen " + address + " is free");
    case EADDRINUSE:
      return report.Bad("listen",
                        "--listen " + address +
                            ": another process listens there (ss -ltnp names it); stop it, or "
                            "take another port");
    case EADDRNOTAVAIL:
      return report.Bad("listen",
                        "--listen " + address +
                            ": that is no address of this machine (ip addr lists them); take "
                            "one of its own, or 0.0.0.0");
    case EACCES:
      return report.Bad(
          "listen", "--listen " + address + ": ports below 1024 are for root; take a higher one");
    default:
      return report.Bad("listen", "--listen " + address + ": " + std::strerror(failed) +
                                      "; take another address");
  }
}

// --- The scene --------------------------------------------------------------------------------

void LookAtScene(const DoctorRequest& request, const std::optional<CoordinatorHealth>& health,
                 Report& report) {
  const auto asset = CollectAsset(request.scene);
  if (!asset.ok()) return report.Bad("scene", asset.status());
  uint64_t bytes = 0, largest = 0, listed = 0;
  std::string largest_name;
  for (const auto& [uri, blob] : asset->files) {
    bytes += blob.size();
    listed += uri.size() + kBytesPerListedFile;
    if (blob.size() > largest) {
      largest = blob.size();
      largest_name = uri;
    }
  }
  const uint64_t need = kSceneGrowth * bytes + request.points * kBakeBytesPerSurfel;
  const uint64_t worker_need = kSceneGrowth * bytes + request.points * kTreeBytesPerSurfel;
  const auto compare = [&](const std::string& where, uint64_t needed, uint64_t available) {
    if (available == 0 || needed <= available) return;
    report.Bad("memory",
               "the scene takes about " + Size(needed) + " of memory, " + where + " has " +
                   Size(available) +
                   " left; render with fewer --points, free memory, or take a larger machine");
  };
  const uint64_t own = ReadMemoryFacts().available_bytes;
  compare("this machine", health ? worker_need : need, own);
  if (!health) {
    return report.Good("scene", request.scene + ": " + std::to_string(asset->files.size()) +
                                    " files, " + Size(bytes) + ", about " + Size(need) +
                                    " of memory");
  }
  compare("the coordinator", need, health->memory_available_bytes);
  const auto over = [&](uint64_t value, uint64_t limit) { return limit != 0 && value > limit; };
  if (over(listed, health->max_request_bytes)) {
    report.Bad("limits", "the list of the scene's files is a message of about " + Size(listed) +
                             ", the coordinator takes " + Size(health->max_request_bytes) +
                             "; put the scene into fewer files, as a .glb");
  }
  if (over(largest, health->max_blob_bytes)) {
    report.Bad("limits", "'" + largest_name + "' has " + Size(largest) +
                             ", the coordinator takes files of up to " +
                             Size(health->max_blob_bytes) +
                             "; make it smaller, or raise farpoint-server's --max-blob-bytes");
  }
  if (over(bytes, health->limits.max_asset_bytes)) {
    report.Bad("limits", "the scene's files have " + Size(bytes) + ", the coordinator takes " +
                             Size(health->limits.max_asset_bytes) +
                             "; make it smaller, or raise farpoint-server's --max-asset-bytes");
  }
  if (over(request.points, health->limits.max_surfels)) {
    report.Bad("limits", std::to_string(request.points) +
                             " surfels are asked for, the coordinator takes " +
                             std::to_string(health->limits.max_surfels) +
                             "; ask for fewer --points, or raise farpoint-server's --max-surfels");
  }
  if (over(health->bytes + bytes, health->max_bytes)) {
    report.Bad("limits",
               "'" + health->caller_name + "' may store " + Size(health->max_bytes) +
                   " on the coordinator and stores " + Size(health->bytes) +
                   " already; wait until older jobs are purged, or raise farpoint-server's "
                   "--max-bytes-per-client");
  }
  report.Good("scene",
              request.scene + ": " + Count(asset->files.size(), "file") + ", " + Size(bytes));
}

// --- The way to the coordinator ---------------------------------------------------------------

// How to connect; none if that is not clear.
std::optional<ChannelSecurity> LookAtCertificates(const DoctorRequest& request, Report& report) {
  ChannelSecurity security;
  if (request.tls.empty()) {
    if (!request.token_file.empty()) {
      report.Bad("token",
                 "--token-file: a token without TLS would be readable on the way; add --tls-ca");
      return std::nullopt;
    }
    if (request.coordinator.empty()) return security;
    if (const absl::Status status = CheckMayBePlain(request.tls, request.coordinator);
        !status.ok()) {
      report.Bad("tls", status);
      return std::nullopt;
    }
    return security;
  }
  absl::StatusOr<TlsPaths> paths = TlsPaths{.ca = request.tls.directory + "/ca.pem"};
  if (request.token_file.empty() || request.tls.directory.empty()) {
    paths = FindTls(request.tls, request.role);
  }
  if (!paths.ok()) {
    report.Bad("certificate", paths.status());
    return std::nullopt;
  }
  if (!request.token_file.empty()) {
    absl::StatusOr<std::string> token = ReadTokenFile(request.token_file);
    if (!token.ok()) {
      report.Bad("token", token.status());
      return std::nullopt;
    }
    security.token = *std::move(token);
  }
  const TlsUse use = request.role == Role::kServer ? TlsUse::kServer : TlsUse::kPeer;
  absl::StatusOr<TlsMaterial> tls = LoadTls(*paths, use, NowUnixS());
  if (!tls.ok()) {
    report.Bad("certificate", tls.status());
    return std::nullopt;
  }
  security.tls = *std::move(tls);
  if (security.tls->certificate.empty()) {
    report.Good("certificate", "'" + paths->ca + "' is an authority's");
    return security;
  }
  const CertificateFacts& facts = security.tls->facts;
  const bool fits =
      facts.role == request.role || (request.role == Role::kClient && facts.role == Role::kAdmin);
  if (!fits) {
    report.Bad("role", "'" + paths->certificate + "' is the certificate of a " +
                           std::string(NameOf(facts.role)) + " ('" + facts.name + "'), but a " +
                           std::string(NameOf(request.role)) +
                           "'s is wanted; name that one, or say --role " +
                           std::string(NameOf(facts.role)));
    return security;
  }
  report.Good("certificate", "'" + paths->certificate + "': " + std::string(NameOf(facts.role)) +
                                 " '" + facts.name + "', until " + UtcText(facts.not_after_s));
  return security;
}

std::optional<CoordinatorHealth> LookAtCoordinator(const DoctorRequest& request,
                                                   const ChannelSecurity& security,
                                                   const Connect& connect, Report& report) {
  const std::string& address = request.coordinator;
  if (const absl::Status status = ProbeConnection(address, security, request.patience);
      !status.ok()) {
    report.Bad("connection", status);
    return std::nullopt;
  }
  report.Good("connection", address + " answers" + (security.tls ? " over TLS" : " in the clear"));
  const std::unique_ptr<FarmLink> link = connect(security);
  OwnFacts own;
  own.tls = security.tls.has_value();
  if (own.tls) own.certificate_not_after_s = security.tls->facts.not_after_s;
  const int64_t before = NowUnixS() * 1000;
  absl::StatusOr<CoordinatorHealth> health = link->Diagnose();
  own.unix_ms = (before + NowUnixS() * 1000) / 2;
  if (health.ok()) {
    report.Add(JudgeCoordinator(*health, own));
    return *std::move(health);
  }
  switch (health.status().code()) {
    case absl::StatusCode::kUnimplemented:
      report.Bad(
          "version",
          "the coordinator at " + address +
              " is older than this farpoint " FARPOINT_VERSION
              " and cannot say how it is, or is no coordinator; use one version on all machines");
      break;
    case absl::StatusCode::kUnauthenticated:
      report.Bad(request.token_file.empty() ? "certificate" : "token", health.status());
      break;
    case absl::StatusCode::kPermissionDenied:
      report.Bad("role", health.status());
      break;
    default:
      report.Bad("connection", health.status());
  }
  return std::nullopt;
}

void LookAtBlobs(const std::string& folder, const CoordinatorHealth& health, Report& report) {
  if (health.blob_directory.empty()) {
    return report.Bad("blobs",
                      "--blob-dir " + folder +
                          ": the coordinator shares no folder of blobs; start farpoint-server with "
                          "--blob-dir, or leave it out on workers");
  }
  std::error_code error;
  if (!health.blob_mark.empty() &&
      std::filesystem::exists(folder + "/" + health.blob_mark, error)) {
    return report.Good("blobs", "--blob-dir " + folder + " is the coordinator's");
  }
  report.Bad("blobs",
             "--blob-dir " + folder + " is not the folder that the coordinator shares as '" +
                 health.blob_directory +
                 "'; mount the same file system on both machines, or name where it is mounted "
                 "here");
}

}  // namespace

std::vector<Finding> JudgeProcess(const OpenFileFacts& files) {
  Report report;
  if (files.limit != 0 && files.limit < kMinOpenFiles) {
    report.Bad("files",
               "a process may have only " + std::to_string(files.limit) +
                   " open files here; raise the limit (ulimit -n 65536, or LimitNOFILE= of a "
                   "systemd unit)");
  }
  if (report.findings.empty()) {
    report.Good("machine", "processor and limits are fit; " +
                               Size(ReadMemoryFacts().available_bytes) + " of memory are left");
  }
  return std::move(report.findings);
}

std::vector<Finding> JudgeCoordinator(const CoordinatorHealth& health, const OwnFacts& own) {
  Report report;
  if (health.oldest_protocol_version > kProtocolVersion ||
      health.protocol_version < kOldestProtocolVersion) {
    const bool coordinator_old = health.protocol_version < kOldestProtocolVersion;
    report.Bad("version", "the coordinator (farpoint " + health.version + ") speaks protocol " +
                              std::to_string(health.oldest_protocol_version) + " to " +
                              std::to_string(health.protocol_version) +
                              ", this farpoint " FARPOINT_VERSION " protocol " +
                              std::to_string(kOldestProtocolVersion) + " to " +
                              std::to_string(kProtocolVersion) + "; update " +
                              (coordinator_old ? "the coordinator" : "this side"));
  } else if (health.version != FARPOINT_VERSION) {
    report.Doubt("version", "the coordinator is farpoint " + health.version +
                                ", this is " FARPOINT_VERSION
                                "; clients may differ, workers must have the coordinator's");
  } else {
    report.Good("version", "farpoint " + health.version + ", protocol " +
                               std::to_string(std::min(health.protocol_version, kProtocolVersion)));
  }
  if (health.unix_ms != 0 && std::llabs(health.unix_ms - own.unix_ms) > kMaxSkewMs) {
    const int64_t seconds = (health.unix_ms - own.unix_ms) / 1000;
    report.Bad("clock", "the coordinator's clock is " + std::to_string(std::llabs(seconds)) +
                            " s " + (seconds > 0 ? "ahead of" : "behind") +
                            " this machine's, so certificates and logs disagree; run NTP on both");
  }
  if (health.draining) {
    report.Bad(
        "draining",
        "the coordinator drains: it was told to stop and takes no new jobs; wait until it is "
        "started again",
        absl::StatusCode::kUnavailable);
  }
  if (!health.store_error.empty()) {
    report.Bad("store", "the coordinator cannot write its store (" + health.store_error +
                            "); free the disk or correct the rights of the folder");
  } else if (health.store_total_bytes != 0 && health.store_free_bytes < kMinFreeDisk) {
    report.Bad("store", "the coordinator's store has only " + Size(health.store_free_bytes) +
                            " of " + Size(health.store_total_bytes) +
                            " left; free the disk, lower --retention-hours, or move the store");
  }
  if (health.memory_total_bytes != 0 && health.memory_available_bytes < kMinFreeMemory) {
    report.Bad("memory", "the coordinator's machine has only " +
                             Size(health.memory_available_bytes) +
                             " of memory left, too little for a bake; free some, or lower "
                             "--bake-cache-mib");
  }
  if (health.open_files_limit != 0 && health.open_files_limit < kMinServerFiles) {
    report.Bad("files",
               "the coordinator may have only " + std::to_string(health.open_files_limit) +
                   " open files, connections among them; start it with a higher limit (ulimit "
                   "-n 65536, or LimitNOFILE=)");
  } else if (health.max_connections != 0 && health.connections * 10 >= health.max_connections * 9) {
    report.Bad("files", "the coordinator has " + std::to_string(health.connections) + " of " +
                            std::to_string(health.max_connections) +
                            " connections; raise its --max-connections and ulimit -n");
  }
  if (health.max_jobs != 0 && health.jobs >= health.max_jobs) {
    report.Bad("limits",
               "'" + health.caller_name + "' has " + std::to_string(health.jobs) +
                   " jobs that have not ended, as many as are allowed; wait for one, or raise "
                   "farpoint-server's --max-jobs-per-client");
  }
  const auto expires = [&](const std::string& whose, int64_t not_after_s) {
    const int64_t left_s = not_after_s - own.unix_ms / 1000;
    if (not_after_s == 0 || left_s > kSoonS) return;
    report.Doubt("certificate", whose + " certificate expires in " +
                                    std::to_string(std::max<int64_t>(0, left_s / kDayS)) +
                                    " days; make a new one with farpoint certs add");
  };
  expires("the coordinator's", health.certificate_not_after_s);
  if (own.tls) expires("this side's", own.certificate_not_after_s);
  report.Add(JudgeWorkers(health.workers));
  return std::move(report.findings);
}

std::vector<Finding> JudgeWorkers(std::span<const WorkerStatus> workers) {
  Report report;
  if (std::all_of(workers.begin(), workers.end(), [](const auto& w) { return w.gone; })) {
    report.Bad("workers",
               std::string(workers.empty() ? "no worker is registered" : "all workers are gone") +
                   ", so no tile is rendered; start farpoint-worker --coordinator "
                   "HOST:PORT (its log says what keeps it away)",
               absl::StatusCode::kUnavailable);
    return std::move(report.findings);
  }
  std::map<Digest, std::vector<std::string>> by_fingerprint;
  size_t set_aside = 0, gone = 0;
  for (const WorkerStatus& worker : workers) {
    if (worker.gone) {
      ++gone;
      continue;
    }
    by_fingerprint[worker.fingerprint].push_back(worker.name);
    set_aside += worker.set_aside ? 1 : 0;
  }
  if (by_fingerprint.size() > 1) {
    const auto most = std::max_element(
        by_fingerprint.begin(), by_fingerprint.end(),
        [](const auto& a, const auto& b) { return a.second.size() < b.second.size(); });
    std::string odd;
    size_t count = 0;
    for (const auto& [fingerprint, names] : by_fingerprint) {
      if (fingerprint == most->first) continue;
      for (const std::string& name : names) {
        if (++count <= 3) odd += (odd.empty() ? "'" : ", '") + name + "'";
      }
    }
    report.Bad("fingerprints",
               std::to_string(count) + " of " + Count(workers.size() - gone, "worker") + " (" +
                   odd + (count > 3 ? ", …" : "") +
                   ") compute other pixels than the rest and get no tile of the same job; "
                   "use one build and one make of processor for all workers");
  }
  if (set_aside > 0) {
    report.Bad("workers", std::to_string(set_aside) + " of " +
                              Count(workers.size() - gone, "worker") +
                              " failed again and again and get no work for a while; farpoint "
                              "workers names them, their logs say why");
  }
  if (report.findings.empty()) {
    const size_t there = workers.size() - gone;
    report.Good("workers", there == 1 ? "1 worker is there"
                                      : std::to_string(there) + " workers are there and agree");
  }
  if (gone > 0) {
    report.Doubt("workers", Count(gone, "worker") + (gone == 1 ? " is" : " are") +
                                " gone: killed, or cut off; farpoint workers names " +
                                (gone == 1 ? "it" : "them"));
  }
  return std::move(report.findings);
}

std::vector<Finding> Examine(const DoctorRequest& request, const Connect& connect) {
  Report report;
  report.Add(JudgeProcess(ReadOpenFileFacts()));
  const std::optional<ChannelSecurity> security = LookAtCertificates(request, report);
  std::optional<CoordinatorHealth> health;
  if (request.coordinator.empty()) {
    report.Doubt("connection",
                 "no coordinator was named, so none was asked; give --coordinator "
                 "HOST:PORT");
  } else if (security) {
    health = LookAtCoordinator(request, *security, connect, report);
  }
  if (!request.listen.empty()) LookAtPort(request.listen, report);
  // The store is made by whoever starts a coordinator, its folder above is not.
  if (!request.store.empty()) LookAtFolder("store", "--store", request.store, false, report);
  if (!request.cache.empty()) LookAtFolder("cache", "--cache", request.cache, true, report);
  if (!request.blob_directory.empty()) {
    std::error_code error;
    if (!std::filesystem::is_directory(request.blob_directory, error)) {
      report.Bad("blobs",
                 "--blob-dir " + request.blob_directory +
                     ": there is no such folder; mount the shared file system, or correct the "
                     "path");
    } else if (health) {
      LookAtBlobs(request.blob_directory, *health, report);
    }
  }
  if (!request.scene.empty()) LookAtScene(request, health, report);
  return std::move(report.findings);
}

std::string FindingsText(std::span<const Finding> findings) {
  std::string text;
  for (const Finding& one : findings) {
    text += one.health == Health::kGood  ? "ok     "
            : one.health == Health::kBad ? "FAULT  "
                                         : "note   ";
    text += one.what + ": " + one.text + "\n";
  }
  return text;
}

std::string FindingsJson(std::span<const Finding> findings) {
  nlohmann::json list = nlohmann::json::array();
  size_t faults = 0;
  for (const Finding& one : findings) {
    faults += one.health == Health::kBad ? 1 : 0;
    list.push_back({{"health", one.health == Health::kGood  ? "ok"
                               : one.health == Health::kBad ? "fault"
                                                            : "note"},
                    {"what", one.what},
                    {"text", one.text}});
  }
  return nlohmann::json{{"faults", faults}, {"findings", list}}.dump(
             2, ' ', false, nlohmann::json::error_handler_t::replace) +
         "\n";
}

absl::Status OutcomeOf(std::span<const Finding> findings) {
  size_t faults = 0;
  bool permanent = false;
  for (const Finding& one : findings) {
    if (one.health != Health::kBad) continue;
    ++faults;
    permanent = permanent || ExitCodeOf(absl::Status(one.code, "")) != kExitTryAgain;
  }
  if (faults == 0) return absl::OkStatus();
  return absl::Status(
      permanent ? absl::StatusCode::kFailedPrecondition : absl::StatusCode::kUnavailable,
      std::to_string(faults) + (faults == 1 ? " fault was found" : " faults were found"));
}

}  // namespace farpoint

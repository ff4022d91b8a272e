#include "proto/tls_files.h"

#include <sys/stat.h>

#include <algorithm>
#include <cerrno>
#include <chrono>
#include <filesystem>
#include <utility>
#include <vector>

#include "core/base/blob.h"
#include "core/base/posix_file.h"

namespace farpoint {

namespace fs = std::filesystem;

namespace {

constexpr size_t kMaxFileBytes = size_t{1} << 20;

absl::StatusOr<std::string> ReadText(const std::string& path) {
  FP_ASSIGN_OR_RETURN(const Blob blob, ReadFile(path, kMaxFileBytes));
  return std::string(reinterpret_cast<const char*>(blob.bytes().data()), blob.size());
}

// A key that others can read is no secret.
absl::Status CheckSecret(const std::string& path) {
  struct stat facts {};
  if (::stat(path.c_str(), &facts) != 0) return FileError("cannot read", path, errno);
  const unsigned allowed = facts.st_uid == 0 ? 0740U : 0700U;
  if ((facts.st_mode & 0777U & ~allowed) == 0) return absl::OkStatus();
  return absl::FailedPreconditionError(
      "'" + path +
      "': this private key can be read or changed by others than its "
      "owner; chmod 600 " +
      path);
}

// Of several mistakes with a certificate the one that explains the others comes first.
absl::Status CheckOwn(const TlsPaths& paths, const TlsMaterial& material, TlsUse use,
                      int64_t now_s) {
  FP_RETURN_IF_ERROR(CheckSecret(paths.key));
  FP_RETURN_IF_ERROR(CheckKey(material.certificate, material.key, "'" + paths.key + "'"));
  return Annotate(CheckIssued(material.certificate, material.ca, use == TlsUse::kServer, now_s),
                  "'" + paths.certificate + "'");
}

}  // namespace

TlsPaths PathsIn(const std::string& directory, const std::string& name) {
  return {.ca = directory + "/ca.pem",
          .certificate = directory + "/" + name + ".pem",
          .key = directory + "/" + name + ".key"};
}

absl::StatusOr<TlsMaterial> LoadTls(const TlsPaths& paths, TlsUse use, int64_t now_s) {
  if (paths.ca.empty()) {
    return absl::FailedPreconditionError(
        "--tls-ca: not given; name the authority's certificate, ca.pem of farpoint certs init");
  }
  if (paths.certificate.empty() != paths.key.empty()) {
    return absl::FailedPreconditionError(
        std::string(paths.key.empty() ? "--tls-key" : "--tls-cert") +
        ": not given; certificate and key belong together");
  }
  if (use == TlsUse::kServer && paths.certificate.empty()) {
    return absl::FailedPreconditionError(
        "--tls-cert: not given; a coordinator needs a certificate (farpoint certs init)");
  }
  TlsMaterial material;
  material.paths = paths;
  FP_ASSIGN_OR_RETURN(material.ca, ReadText(paths.ca));
  FP_ASSIGN_OR_RETURN(const CertificateFacts ca,
                      ReadCertificate(material.ca, "'" + paths.ca + "'"));
  if (!ca.authority) {
    return absl::FailedPreconditionError("'" + paths.ca + "': is the certificate of '" + ca.name +
                                         "', not of an authority; name ca.pem");
  }
  if (paths.certificate.empty()) return material;
  FP_ASSIGN_OR_RETURN(material.certificate, ReadText(paths.certificate));
  FP_ASSIGN_OR_RETURN(material.key, ReadText(paths.key));
  FP_ASSIGN_OR_RETURN(material.facts,
                      ReadCertificate(material.certificate, "'" + paths.certificate + "'"));
  FP_RETURN_IF_ERROR(CheckOwn(paths, material, use, now_s));
  return material;
}

TlsWatch::TlsWatch(TlsPaths paths, TlsUse use) : paths_(std::move(paths)), use_(use) {
  seen_ = Signature();
}

std::string TlsWatch::Signature() const {
  std::string text;
  for (const std::string* path : {&paths_.ca, &paths_.certificate, &paths_.key}) {
    struct stat facts {};
    if (path->empty() || ::stat(path->c_str(), &facts) != 0) {
      text += "-;";
      continue;
    }
    for (const int64_t part :
         {int64_t{facts.st_mtim.tv_sec}, int64_t{facts.st_mtim.tv_nsec}, int64_t{facts.st_size},
          static_cast<int64_t>(facts.st_ino), int64_t{facts.st_mode}}) {
      text += std::to_string(part) + ",";
    }
    text += ";";
  }
  return text;
}

std::optional<absl::StatusOr<TlsMaterial>> TlsWatch::Look(int64_t now_s) {
  const std::string now = Signature();
  if (now == seen_ || now == told_) return std::nullopt;
  absl::StatusOr<TlsMaterial> material = LoadTls(paths_, use_, now_s);
  if (material.ok()) {
    seen_ = now;
    return material;
  }
  if (std::exchange(failed_, now) != now) return std::nullopt;
  told_ = now;
  return material;
}

absl::StatusOr<TlsPaths> FindTls(const TlsFlags& flags, Role role) {
  if (flags.directory.empty()) return flags.paths;
  if (!flags.paths.empty()) {
    return absl::InvalidArgumentError(
        "--certs: names a folder, and --tls-ca, --tls-cert, --tls-key name files; give one of "
        "both");
  }
  const std::string name(NameOf(role));
  TlsPaths paths = PathsIn(flags.directory, name);
  std::error_code error;
  if (fs::exists(paths.certificate, error)) return paths;
  std::vector<std::string> found;
  for (fs::directory_iterator at(flags.directory, error), end; !error && at != end;
       at.increment(error)) {
    if (at->path().extension() != ".pem" || at->path().filename() == "ca.pem") continue;
    const absl::StatusOr<std::string> pem = ReadText(at->path().string());
    if (!pem.ok()) continue;
    const auto facts = ReadCertificate(*pem, "");
    if (!facts.ok()) continue;
    // Admins may do what clients may.
    if (facts->role == role || (role == Role::kClient && facts->role == Role::kAdmin)) {
      found.push_back(at->path().stem().string());
    }
  }
  if (error) return FileError("--certs: cannot list", flags.directory, error.value());
  if (found.size() == 1) return PathsIn(flags.directory, found[0]);
  if (found.empty()) return paths;  // which LoadTls does not find
  std::sort(found.begin(), found.end());
  std::string list;
  for (size_t i = 0; i < std::min<size_t>(found.size(), 5); ++i) list += " " + found[i];
  return absl::InvalidArgumentError("--certs: '" + flags.directory + "' holds " +
                                    std::to_string(found.size()) + " certificates for a " + name +
                                    ":" + list + (found.size() > 5 ? " …" : "") +
                                    "; name one by --tls-ca, --tls-cert and --tls-key");
}

absl::Status CheckMayBePlain(const TlsFlags& flags, const std::string& address) {
  if (IsLoopback(address) || flags.insecure) return absl::OkStatus();
  return absl::InvalidArgumentError(
      "'" + address +
      "' is not on this machine, and without TLS everybody on the way could read and "
      "change what is sent; give --certs DIR (farpoint certs init makes it), or "
      "--insecure if you trust the network and whoever is on it");
}

int64_t NowUnixS() {
  return std::chrono::duration_cast<std::chrono::seconds>(
             std::chrono::system_clock::now().time_since_epoch())
      .count();
}

}  // namespace farpoint

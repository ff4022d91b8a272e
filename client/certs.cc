#include "client/certs.h"

#include <fcntl.h>
#include <sys/file.h>
#include <sys/stat.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <filesystem>
#include <utility>

#include "core/base/blob.h"
#include "core/base/posix_file.h"
#include "proto/certificate.h"
#include "proto/tls_files.h"

namespace farpoint {

namespace fs = std::filesystem;

namespace {

constexpr int64_t kDayS = 24 * 3600;
// Clocks differ: what is made now holds on a machine that is a little behind.
constexpr int64_t kBackdatedS = 300;
constexpr uint32_t kAuthorityLives = 10;  // times as long as what it issues
constexpr size_t kMaxFileBytes = size_t{16} << 20;

absl::StatusOr<std::string> ReadText(const std::string& path) {
  FP_ASSIGN_OR_RETURN(const Blob blob, ReadFile(path, kMaxFileBytes));
  return std::string(reinterpret_cast<const char*>(blob.bytes().data()), blob.size());
}

// Files that are made together: all of them, or none.
class NewFiles {
 public:
  ~NewFiles() {
    for (const std::string& path : made_) ::unlink(path.c_str());
  }
  absl::Status Write(const std::string& path, const std::string& text, mode_t mode) {
    const Descriptor fd(
        ::open(path.c_str(), O_WRONLY | O_CREAT | O_EXCL | O_CLOEXEC | O_NOFOLLOW, mode));
    if (!fd.valid() && errno == EEXIST) {
      return absl::FailedPreconditionError(
          "'" + path +
          "' is there already and is not overwritten; choose another "
          "name or folder, or move it away");
    }
    if (!fd.valid()) return DiskError("cannot create", path, errno);
    made_.push_back(path);
    // Whatever the umask says.
    if (::fchmod(fd.get(), mode) != 0) return DiskError("cannot protect", path, errno);
    FP_RETURN_IF_ERROR(
        WriteAll(fd.get(), std::as_bytes(std::span(text.data(), text.size())), path));
    if (::fsync(fd.get()) != 0) return DiskError("cannot flush", path, errno);
    return absl::OkStatus();
  }
  void Keep() { made_.clear(); }

 private:
  std::vector<std::string> made_;
};

absl::Status WritePair(NewFiles& files, const std::string& directory, const std::string& name,
                       const CertificateAndKey& pair) {
  FP_RETURN_IF_ERROR(files.Write(directory + "/" + name + ".key", pair.key, 0600));
  return files.Write(directory + "/" + name + ".pem", pair.certificate, 0644);
}

std::string Line(const std::string& directory, const std::string& name,
                 const CertificateFacts& facts) {
  std::string hosts;
  for (const std::string& host : facts.hosts) hosts += (hosts.empty() ? ", for " : " ") + host;
  return directory + "/" + name + ".pem, .key: " +
         (facts.authority ? "authority '" + facts.name + "'" : std::string(NameOf(facts.role))) +
         hosts + ", until " + UtcText(facts.not_after_s);
}

std::vector<std::string> OwnHosts() {
  std::vector<std::string> hosts = {"localhost", "127.0.0.1", "::1"};
  char name[256] = "";
  if (::gethostname(name, sizeof(name) - 1) == 0 && name[0] != '\0') hosts.emplace_back(name);
  return hosts;
}

// What a list says now; nothing if it is not there.
absl::StatusOr<std::string> ReadList(const std::string& path) {
  absl::StatusOr<std::string> text = ReadText(path);
  if (absl::IsNotFound(text.status())) return std::string();
  return text;
}

// The folder's lists change under a lock, whole or not at all.
class ListFile {
 public:
  static absl::StatusOr<ListFile> Open(const std::string& directory, const std::string& name) {
    ListFile file;
    file.path_ = directory + "/" + name;
    file.lock_ = Descriptor(::open(directory.c_str(), O_RDONLY | O_DIRECTORY | O_CLOEXEC));
    if (!file.lock_.valid()) return FileError("cannot open the folder", directory, errno);
    if (::flock(file.lock_.get(), LOCK_EX) != 0) return FileError("cannot lock", directory, errno);
    FP_ASSIGN_OR_RETURN(file.text, ReadList(file.path_));
    return file;
  }
  absl::Status Save() const {
    const std::string part = path_ + ".part";
    ::unlink(part.c_str());
    NewFiles files;
    FP_RETURN_IF_ERROR(files.Write(part, text, 0600));
    if (::rename(part.c_str(), path_.c_str()) != 0)
      return DiskError("cannot rename to", path_, errno);
    files.Keep();
    return absl::OkStatus();
  }
  const std::string& path() const { return path_; }
  std::string text;

 private:
  std::string path_;
  Descriptor lock_;
};

absl::StatusOr<CertificateAndKey> ReadAuthority(const std::string& directory) {
  CertificateAndKey authority;
  FP_ASSIGN_OR_RETURN(authority.certificate, ReadText(directory + "/ca.pem"));
  absl::StatusOr<std::string> key = ReadText(directory + "/ca.key");
  if (absl::IsNotFound(key.status())) {
    return absl::NotFoundError(
        "'" + directory +
        "/ca.key' is not there; certificates are made where the authority's key "
        "is");
  }
  FP_RETURN_IF_ERROR(key.status());
  authority.key = *std::move(key);
  return authority;
}

// Every certificate of the folder but the authority's: its file's name without .pem, and what it
// says.
absl::StatusOr<std::vector<std::pair<std::string, CertificateFacts>>> AllIn(
    const std::string& directory) {
  std::vector<std::pair<std::string, CertificateFacts>> all;
  std::error_code error;
  for (fs::directory_iterator at(directory, error), end; !error && at != end; at.increment(error)) {
    if (at->path().extension() != ".pem") continue;
    const absl::StatusOr<std::string> pem = ReadText(at->path().string());
    if (!pem.ok()) continue;
    auto facts = ReadCertificate(*pem, at->path().string());
    if (facts.ok()) all.emplace_back(at->path().stem().string(), *std::move(facts));
  }
  if (error) return FileError("cannot list", directory, error.value());
  std::sort(all.begin(), all.end(), [](const auto& a, const auto& b) {
    return std::pair(!a.second.authority, a.first) < std::pair(!b.second.authority, b.first);
  });
  return all;
}

}  // namespace

absl::StatusOr<std::vector<std::string>> InitCerts(const CertsInit& init, int64_t now_s) {
  const std::string& directory = init.directory;
  std::error_code error;
  const bool made_folder = fs::create_directories(directory, error);
  if (error) return DiskError("cannot create", directory, error.value());
  if (made_folder) fs::permissions(directory, fs::perms::owner_all, error);
  if (fs::exists(directory + "/ca.pem", error) || fs::exists(directory + "/ca.key", error)) {
    return absl::FailedPreconditionError(
        "'" + directory +
        "' holds an authority already; farpoint certs add makes one more "
        "certificate, --dir names another folder");
  }
  const int64_t from = now_s - kBackdatedS, to = now_s + int64_t{init.days} * kDayS;
  FP_ASSIGN_OR_RETURN(
      const CertificateAndKey authority,
      MakeAuthority("farpoint-ca", from, now_s + int64_t{init.days} * kAuthorityLives * kDayS));

  std::vector<CertificateRequest> wanted;
  wanted.push_back({.name = "server",
                    .role = Role::kServer,
                    .hosts = init.server_hosts.empty() ? OwnHosts() : init.server_hosts});
  for (uint32_t i = 1; i <= init.workers; ++i) {
    wanted.push_back({.name = init.workers == 1 ? "worker" : "worker" + std::to_string(i),
                      .role = Role::kWorker,
                      .hosts = {}});
  }
  for (const std::string& name : init.clients) {
    wanted.push_back({.name = name, .role = Role::kClient, .hosts = {}});
  }
  if (init.clients.empty())
    wanted.push_back({.name = "client", .role = Role::kClient, .hosts = {}});

  NewFiles files;
  FP_RETURN_IF_ERROR(WritePair(files, directory, "ca", authority));
  FP_ASSIGN_OR_RETURN(const CertificateFacts ca, ReadCertificate(authority.certificate, directory));
  std::vector<std::string> lines = {Line(directory, "ca", ca)};
  for (CertificateRequest& request : wanted) {
    request.not_before_s = from;
    request.not_after_s = to;
    FP_ASSIGN_OR_RETURN(const CertificateAndKey pair, IssueCertificate(authority, request));
    FP_RETURN_IF_ERROR(WritePair(files, directory, request.name, pair));
    FP_ASSIGN_OR_RETURN(const CertificateFacts facts, ReadCertificate(pair.certificate, directory));
    lines.push_back(Line(directory, request.name, facts));
  }
  files.Keep();
  return lines;
}

absl::StatusOr<std::vector<std::string>> AddCertificate(const CertsAdd& add, int64_t now_s) {
  FP_RETURN_IF_ERROR(CheckName(add.name));
  if (add.name == "ca")
    return absl::InvalidArgumentError("'ca' is the authority; take another name");
  FP_ASSIGN_OR_RETURN(const CertificateAndKey authority, ReadAuthority(add.directory));
  const CertificateRequest request{
      .name = add.name,
      .role = add.role,
      .hosts = add.role == Role::kServer && add.hosts.empty() ? OwnHosts() : add.hosts,
      .not_before_s = now_s - kBackdatedS,
      .not_after_s = now_s + int64_t{add.days} * kDayS};
  FP_ASSIGN_OR_RETURN(const CertificateAndKey pair, IssueCertificate(authority, request));
  NewFiles files;
  FP_RETURN_IF_ERROR(WritePair(files, add.directory, add.name, pair));
  FP_ASSIGN_OR_RETURN(const CertificateFacts facts,
                      ReadCertificate(pair.certificate, add.directory));
  files.Keep();
  return std::vector<std::string>{Line(add.directory, add.name, facts)};
}

absl::StatusOr<std::vector<std::string>> ShowCerts(const std::string& directory, int64_t now_s) {
  FP_ASSIGN_OR_RETURN(const auto all, AllIn(directory));
  const std::string revoked_path = directory + "/revoked", tokens_path = directory + "/tokens";
  FP_ASSIGN_OR_RETURN(const std::string revoked_text, ReadList(revoked_path));
  FP_ASSIGN_OR_RETURN(const std::vector<std::string> revoked,
                      ParseRevoked(revoked_text, revoked_path));
  FP_ASSIGN_OR_RETURN(const std::string tokens_text, ReadList(tokens_path));
  FP_ASSIGN_OR_RETURN(const std::vector<TokenEntry> tokens, ParseTokens(tokens_text, tokens_path));
  const absl::StatusOr<std::string> ca = ReadText(directory + "/ca.pem");
  std::vector<std::string> lines;
  for (const auto& [name, facts] : all) {
    std::string line = Line(directory, name, facts) + ", serial " + facts.serial;
    if (std::find(revoked.begin(), revoked.end(), facts.serial) != revoked.end()) {
      line += "; REVOKED";
    } else if (!facts.authority && ca.ok()) {
      const absl::StatusOr<std::string> pem = ReadText(directory + "/" + name + ".pem");
      const absl::Status good =
          pem.ok() ? CheckIssued(*pem, *ca, facts.role == Role::kServer, now_s) : pem.status();
      if (!good.ok()) line += "; " + std::string(good.message());
    } else if (facts.not_after_s < now_s) {
      line += "; expired";
    }
    lines.push_back(std::move(line));
  }
  for (const TokenEntry& token : tokens) {
    lines.push_back("token of '" + token.name + "': " + std::string(NameOf(token.role)) +
                    ", until " + UtcText(token.expires_unix_s) +
                    (token.expires_unix_s <= now_s ? "; expired" : ""));
  }
  if (lines.empty()) {
    return absl::NotFoundError(
        "'" + directory +
        "' holds neither certificates nor tokens; farpoint certs init makes them");
  }
  return lines;
}

absl::StatusOr<std::string> AddToken(const CertsToken& token, int64_t now_s) {
  FP_RETURN_IF_ERROR(CheckName(token.name));
  FP_ASSIGN_OR_RETURN(ListFile file, ListFile::Open(token.directory, "tokens"));
  FP_RETURN_IF_ERROR(ParseTokens(file.text, file.path()).status());
  FP_ASSIGN_OR_RETURN(const std::string digits, RandomHexDigits(64));
  const std::string text = "fp_" + digits;
  if (!file.text.empty() && file.text.back() != '\n') file.text += '\n';
  file.text += FormatToken({.hash = TokenHash(text),
                            .name = token.name,
                            .role = token.role,
                            .expires_unix_s = now_s + int64_t{token.days} * kDayS});
  FP_RETURN_IF_ERROR(file.Save());
  return text;
}

absl::StatusOr<std::vector<std::string>> Revoke(const std::string& directory,
                                                const std::string& name, int64_t now_s) {
  std::vector<std::string> lines;
  {
    FP_ASSIGN_OR_RETURN(ListFile file, ListFile::Open(directory, "tokens"));
    FP_ASSIGN_OR_RETURN(const std::vector<TokenEntry> tokens, ParseTokens(file.text, file.path()));
    std::string kept;
    for (const TokenEntry& token : tokens) {
      if (token.name == name) {
        lines.push_back("a token of '" + name + "' counts no longer");
      } else {
        kept += FormatToken(token);
      }
    }
    if (!lines.empty()) {
      file.text = kept;
      FP_RETURN_IF_ERROR(file.Save());
    }
  }
  FP_ASSIGN_OR_RETURN(const auto all, AllIn(directory));
  FP_ASSIGN_OR_RETURN(ListFile file, ListFile::Open(directory, "revoked"));
  FP_ASSIGN_OR_RETURN(const std::vector<std::string> known, ParseRevoked(file.text, file.path()));
  bool changed = false;
  if (!file.text.empty() && file.text.back() != '\n') file.text += '\n';
  for (const auto& [stem, facts] : all) {
    if (facts.authority || (facts.name != name && stem != name && facts.serial != name)) continue;
    if (std::find(known.begin(), known.end(), facts.serial) != known.end()) {
      lines.push_back("the certificate of '" + facts.name + "' was revoked before");
      continue;
    }
    file.text += facts.serial + " " + facts.name + " " + UtcText(now_s) + "\n";
    lines.push_back(
        "the certificate of '" + facts.name + "' (serial " + facts.serial +
        ") counts no longer; a coordinator with its own folder needs the new 'revoked'");
    changed = true;
  }
  if (changed) FP_RETURN_IF_ERROR(file.Save());
  if (lines.empty()) {
    return absl::NotFoundError("'" + directory + "' has neither a token nor a certificate of '" +
                               name + "'; farpoint certs show lists them");
  }
  return lines;
}

}  // namespace farpoint

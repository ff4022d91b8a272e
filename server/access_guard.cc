#include "server/access_guard.h"

#include <sys/stat.h>

#include <algorithm>
#include <utility>

#include "core/base/blob.h"
#include "proto/certificate.h"
#include "proto/tls_files.h"

namespace farpoint {

namespace {

using std::chrono::steady_clock;

constexpr size_t kMaxListBytes = size_t{16} << 20;
// What strangers show is forgotten when there is much of it.
constexpr size_t kMaxKnown = 4096, kMaxBuckets = 65536;
constexpr size_t kMaxPemBytes = size_t{64} << 10;
constexpr std::chrono::milliseconds kLookPeriod{500};
// A refusal is looked at anew after a while: clocks are set, and lists change.
constexpr int64_t kRefusalHoldsS = 5;
constexpr double kBurstSeconds = 4;
constexpr int kMaxTold = 20;
constexpr std::chrono::seconds kTellPeriod{10};
constexpr std::string_view kBearer = "Bearer ";

absl::StatusOr<std::string> ReadList(const std::string& path) {
  FP_ASSIGN_OR_RETURN(const Blob blob, ReadFile(path, kMaxListBytes));
  return std::string(reinterpret_cast<const char*>(blob.bytes().data()), blob.size());
}

}  // namespace

AccessGuard::AccessGuard(AccessOptions options)
    : options_(std::move(options)),
      clock_(options_.clock ? options_.clock : std::make_shared<SteadyClock>()) {
  tokens_file_.path = options_.tokens_file;
  revoked_file_.path = options_.revoked_file;
  ca_file_.path = options_.ca_file;
  ca_ = options_.ca;
  telling_since_ = next_look_ = clock_->Now();
  std::lock_guard lock(mutex_);
  Reload();
}

bool AccessGuard::Changed(WatchedFile& file) {
  struct stat facts {};
  int64_t ns = 0, size = 0;
  uint64_t inode = 0;
  if (!file.path.empty() && ::stat(file.path.c_str(), &facts) == 0) {
    ns = int64_t{facts.st_mtim.tv_sec} * 1'000'000'000 + facts.st_mtim.tv_nsec;
    size = facts.st_size;
    inode = facts.st_ino;
  }
  const bool changed = file.seen_ns != ns || file.size != size || file.inode != inode;
  file.seen_ns = ns;
  file.size = size;
  file.inode = inode;
  return changed;
}

void AccessGuard::Reload() {
  const auto now = clock_->Now();
  if (now < next_look_) return;
  next_look_ = now + kLookPeriod;
  if (Changed(tokens_file_)) {
    tokens_file_.error = absl::OkStatus();
    tokens_.clear();
    if (tokens_file_.inode != 0) {
      absl::StatusOr<std::vector<TokenEntry>> entries = std::vector<TokenEntry>{};
      const absl::StatusOr<std::string> text = ReadList(tokens_file_.path);
      if (text.ok()) entries = ParseTokens(*text, tokens_file_.path);
      tokens_file_.error = text.ok() ? entries.status() : text.status();
      if (tokens_file_.error.ok()) {
        for (TokenEntry& entry : *entries) tokens_[entry.hash] = std::move(entry);
      }
    }
  }
  if (Changed(ca_file_) && ca_file_.inode != 0) {
    // A file that is being replaced is none for a moment: what was known goes on.
    if (absl::StatusOr<std::string> text = ReadList(ca_file_.path);
        text.ok() && ReadCertificate(*text, "the authority").ok() && *text != ca_) {
      ca_ = *std::move(text);
      known_.clear();
    }
  }
  if (Changed(revoked_file_)) {
    revoked_file_.error = absl::OkStatus();
    revoked_.clear();
    if (revoked_file_.inode != 0) {
      absl::StatusOr<std::vector<std::string>> serials = std::vector<std::string>{};
      const absl::StatusOr<std::string> text = ReadList(revoked_file_.path);
      if (text.ok()) serials = ParseRevoked(*text, revoked_file_.path);
      revoked_file_.error = text.ok() ? serials.status() : text.status();
      if (revoked_file_.error.ok()) {
        revoked_ = *std::move(serials);
        std::sort(revoked_.begin(), revoked_.end());
      }
    }
  }
}

absl::StatusOr<Caller> AccessGuard::ByCertificate(std::string_view pem) {
  if (pem.size() > kMaxPemBytes) {
    return absl::UnauthenticatedError("the certificates shown are larger than 64 KiB");
  }
  const int64_t now_s = options_.unix_s ? options_.unix_s() : NowUnixS();
  const Digest hash = Sha256().Update(pem).Finish();
  std::unique_lock lock(mutex_);
  Reload();
  auto at = known_.find(hash);
  if (at == known_.end() || now_s > at->second.valid_until_s) {
    const std::string ca = ca_;
    lock.unlock();
    Known known;
    known.refusal = CheckIssued(pem, ca, /*server=*/false, now_s);
    known.valid_until_s = now_s + kRefusalHoldsS;
    if (known.refusal.ok()) {
      const auto facts = ReadCertificate(pem, "the certificate");
      if (facts.ok()) {
        known.caller = {facts->role, facts->name};
        known.serial = facts->serial;
        // Checked anew each minute, so that one in between cannot expire unseen for long.
        known.valid_until_s = std::min(facts->not_after_s, now_s + 60);
      }
      known.refusal = facts.status();
      if (facts.ok() && facts->role == Role::kNone) {
        known.refusal =
            absl::PermissionDeniedError("the certificate of '" + facts->name +
                                        "' carries no role; make one with farpoint certs add");
      }
    }
    lock.lock();
    if (known_.size() >= kMaxKnown) known_.clear();
    at = known_.insert_or_assign(hash, std::move(known)).first;
  }
  const Known& known = at->second;
  FP_RETURN_IF_ERROR(known.refusal);
  if (!revoked_file_.error.ok()) {
    // It is there for a reason.
    return absl::UnauthenticatedError(
        "the coordinator cannot read its list of revoked certificates, so it takes none: " +
        std::string(revoked_file_.error.message()));
  }
  if (std::binary_search(revoked_.begin(), revoked_.end(), known.serial)) {
    return absl::UnauthenticatedError("the certificate of '" + known.caller.name + "' (serial " +
                                      known.serial +
                                      ") was revoked; ask for a new one (farpoint certs add)");
  }
  return known.caller;
}

absl::StatusOr<Caller> AccessGuard::ByToken(std::string_view authorization) {
  if (!authorization.starts_with(kBearer)) {
    return absl::UnauthenticatedError("the header 'authorization' is not 'Bearer TOKEN'");
  }
  const std::string_view token = authorization.substr(kBearer.size());
  if (!LooksLikeToken(token)) {
    return absl::UnauthenticatedError(
        "what was given is no token; farpoint certs token makes one on the coordinator's machine");
  }
  const int64_t now_s = options_.unix_s ? options_.unix_s() : NowUnixS();
  const Digest hash = TokenHash(token);
  std::lock_guard lock(mutex_);
  Reload();
  if (!tokens_file_.error.ok()) {
    return absl::UnauthenticatedError("the coordinator cannot read its list of tokens: " +
                                      std::string(tokens_file_.error.message()));
  }
  const auto at = tokens_.find(hash);
  if (at == tokens_.end()) {
    return absl::UnauthenticatedError(
        "the token is not known here; it was revoked or belongs to another farm (farpoint certs "
        "token "
        "makes one)");
  }
  if (now_s >= at->second.expires_unix_s) {
    return absl::UnauthenticatedError("the token of '" + at->second.name + "' expired on " +
                                      UtcText(at->second.expires_unix_s) +
                                      "; make a new one with farpoint certs token");
  }
  return Caller{at->second.role, at->second.name};
}

absl::StatusOr<Caller> AccessGuard::Identify(const Credentials& credentials) {
  if (!credentials.certificates.empty()) return ByCertificate(credentials.certificates);
  if (!credentials.authorization.empty()) return ByToken(credentials.authorization);
  return absl::UnauthenticatedError(
      "this coordinator wants to know who calls; give --certs DIR, or --tls-ca and --token-file");
}

absl::Status AccessGuard::CheckRate(const Caller& caller) {
  if (caller.role == Role::kWorker || options_.calls_per_second <= 0) return absl::OkStatus();
  const double most = std::max(1.0, options_.calls_per_second * kBurstSeconds);
  const auto now = clock_->Now();
  std::lock_guard lock(mutex_);
  if (buckets_.size() > kMaxBuckets) buckets_.clear();
  const auto [at, fresh] = buckets_.try_emplace(caller.name, Bucket{most, now});
  Bucket& bucket = at->second;
  bucket.calls =
      std::min(most, bucket.calls + options_.calls_per_second *
                                        std::chrono::duration<double>(now - bucket.filled).count());
  bucket.filled = now;
  if (bucket.calls < 1) {
    return absl::ResourceExhaustedError(
        "'" + caller.name + "' makes more than " +
        std::to_string(static_cast<int>(options_.calls_per_second)) +
        " calls a second; wait a little and make fewer");
  }
  bucket.calls -= 1;
  return absl::OkStatus();
}

absl::Status AccessGuard::Admit(std::string_view method, const Credentials& credentials) {
  if (IsOpenMethod(method)) return absl::OkStatus();
  const absl::Status status = [&]() -> absl::Status {
    FP_ASSIGN_OR_RETURN(const Caller caller, Identify(credentials));
    FP_RETURN_IF_ERROR(CheckMayCall(caller, method));
    return CheckRate(caller);
  }();
  if (!status.ok()) Tell(method, status);
  return status;
}

AccessGuard::Refusals AccessGuard::refusals() {
  std::lock_guard lock(mutex_);
  return refusals_;
}

void AccessGuard::Tell(std::string_view method, const absl::Status& status) {
  {
    std::lock_guard lock(mutex_);
    if (absl::IsPermissionDenied(status)) {
      ++refusals_.permission_denied;
    } else if (absl::IsResourceExhausted(status)) {
      ++refusals_.too_many_calls;
    } else {
      ++refusals_.unauthenticated;
    }
    if (!options_.refused) return;
    const auto now = clock_->Now();
    if (now - telling_since_ >= kTellPeriod) {
      telling_since_ = now;
      told_ = 0;
    }
    if (++told_ > kMaxTold) return;
  }
  // What a stranger sent is not repeated into the log beyond its printable beginning.
  std::string clean(method.substr(0, 100));
  for (char& c : clean) {
    if (static_cast<unsigned char>(c) < 0x20 || static_cast<unsigned char>(c) > 0x7e) c = '?';
  }
  options_.refused("refused " + clean + ": " + std::string(status.message()));
}

}  // namespace farpoint

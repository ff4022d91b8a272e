// Decides about every call of a coordinator that speaks TLS, before its handler runs: who calls, by
// certificate or token, whether that role may call this method, and whether it calls too often.
// Checking the certificate here and not in the handshake
// (docs/decisions/0026-security-of-the-service.md) lets a refusal say why to both sides, and lets
// an expiry or a revocation count for connections that are open. No gRPC. Thread-safe.
#pragma once

#include <chrono>
#include <cstdint>
#include <functional>
#include <map>
#include <memory>
#include <mutex>
#include <string>
#include <string_view>
#include <unordered_map>
#include <vector>

#include "core/base/clock.h"
#include "core/base/hash.h"
#include "core/base/status.h"
#include "proto/access.h"

namespace farpoint {

struct AccessOptions {
  std::string ca;            // PEM: who issues certificates
  std::string ca_file;       // read again when it changes, if it can be read; empty: never
  std::string tokens_file;   // proto/access.h, ParseTokens; empty or absent: no tokens
  std::string revoked_file;  // ParseRevoked; empty or absent: none
  // Of one client or admin, over all of its connections; workers are not limited.
  double calls_per_second = 500;
  std::shared_ptr<const Clock> clock;        // none: SteadyClock
  std::function<int64_t()> unix_s;           // none: NowUnixS
  std::function<void(std::string)> refused;  // told of refusals, at most 20 in ten seconds
};

class AccessGuard {
 public:
  explicit AccessGuard(AccessOptions options);

  // What the peer shows: its certificates as PEM, its own first (empty: none), and the header
  // `authorization` (empty: none; then a certificate decides, else the token does).
  struct Credentials {
    std::string_view certificates, authorization;
  };
  // OK if the handler may run. kUnauthenticated: nothing shown, or what is shown does not hold;
  // kPermissionDenied: the role may not; kResourceExhausted: too many calls, with how long to wait.
  // Health and reflection are open to everybody.
  absl::Status Admit(std::string_view method, const Credentials& credentials);
  // Who an admitted call is from.
  absl::StatusOr<Caller> Identify(const Credentials& credentials);

  // Calls that were not admitted, since the start, by cause.
  struct Refusals {
    uint64_t unauthenticated = 0, permission_denied = 0, too_many_calls = 0;
  };
  Refusals refusals();

 private:
  struct Known {
    Caller caller;
    std::string serial;
    int64_t valid_until_s = 0;
    absl::Status refusal;  // or why not
  };
  struct Bucket {
    double calls = 0;
    std::chrono::steady_clock::time_point filled;
  };
  // A file that is read again when it changes.
  struct WatchedFile {
    std::string path;
    int64_t seen_ns = -1, size = -1;
    uint64_t inode = 0;
    absl::Status error;  // the last version cannot be read
  };

  absl::StatusOr<Caller> ByCertificate(std::string_view pem);
  absl::StatusOr<Caller> ByToken(std::string_view authorization);
  absl::Status CheckRate(const Caller& caller);
  // Under mutex_. Looks at most every half second.
  void Reload();
  bool Changed(WatchedFile& file);
  void Tell(std::string_view method, const absl::Status& status);

  const AccessOptions options_;
  const std::shared_ptr<const Clock> clock_;
  std::mutex mutex_;
  std::chrono::steady_clock::time_point next_look_;  // guarded by mutex_, as all below
  WatchedFile tokens_file_, revoked_file_, ca_file_;
  std::string ca_;
  std::unordered_map<Digest, TokenEntry, DigestHasher> tokens_;
  std::vector<std::string> revoked_;                       // sorted
  std::unordered_map<Digest, Known, DigestHasher> known_;  // by the hash of the PEM
  std::map<std::string, Bucket, std::less<>> buckets_;     // by name
  std::chrono::steady_clock::time_point telling_since_;
  int told_ = 0;
  Refusals refusals_;
};

}  // namespace farpoint

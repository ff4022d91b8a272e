// Who may do what at a coordinator: roles, the methods that each may call, tokens, and which
// addresses need no encryption. Pure functions, thread-safe; certificates are proto/certificate.h.
#pragma once

#include <array>
#include <cstdint>
#include <optional>
#include <string>
#include <string_view>
#include <vector>

#include "core/base/hash.h"
#include "core/base/status.h"

namespace farpoint {

// A certificate carries one of the first four as URI among its subject alternative names.
enum class Role {
  kServer,  // a coordinator; may call nothing
  kWorker,  // renders: leases, returns tiles, reads blobs
  kClient,  // submits, reads all, changes its own jobs
  kAdmin,   // the same of everybody's jobs
  kNone,    // not known: no role
};
// "server", "worker", "client", "admin", "none"
std::string_view NameOf(Role role);
std::optional<Role> RoleFromName(std::string_view name);
// "farpoint:role:worker"; none for anything else.
std::string RoleUri(Role role);
std::optional<Role> RoleFromUri(std::string_view uri);

// Who calls. Without TLS nobody can be told apart: kAdmin without a name.
struct Caller {
  Role role = Role::kNone;
  std::string name;  // a certificate's common name, or a token's; empty without TLS
};

// `method` is gRPC's path, "/farpoint.v1.JobService/Submit".
// Whether anybody may call it who reaches the port: health, and reflection.
bool IsOpenMethod(std::string_view method);
// kPermissionDenied says which role is needed. A method that is not known is left to be refused as
// such. Methods of BlobService other than FindMissing and Put are a worker's: who can read blobs
// can read everybody's scenes.
absl::Status CheckMayCall(const Caller& caller, std::string_view method);

// --- Names ------------------------------------------------------------------------------------

// Of certificates and tokens: 1 to 64 of letters, digits, '.', '-', '_' and '@', beginning with a
// letter or digit. kInvalidArgument.
absl::Status CheckName(std::string_view name);

// --- Tokens -----------------------------------------------------------------------------------

// A token is "fp_" and 64 hexadecimal digits: 256 random bits. That is why its plain SHA-256 is
// kept and compared: there is nothing to guess.
bool LooksLikeToken(std::string_view text);
Digest TokenHash(std::string_view token);

struct TokenEntry {
  Digest hash;
  std::string name;
  Role role = Role::kClient;  // or kAdmin
  int64_t expires_unix_s = 0;
};
// A line for each token, `sha256 name role expires_unix_s`; empty lines and those that start with #
// are comments. kInvalidArgument names `file` and line. At most 100,000 lines.
absl::StatusOr<std::vector<TokenEntry>> ParseTokens(std::string_view text, std::string_view file);
std::string FormatToken(const TokenEntry& entry);  // with the line's end

// Serial numbers of certificates that count no longer, one on each line, followed by anything.
// kInvalidArgument names `file` and line.
absl::StatusOr<std::vector<std::string>> ParseRevoked(std::string_view text, std::string_view file);

// --- Addresses --------------------------------------------------------------------------------

// "[::1]:80" is "::1" and "80".
struct HostPort {
  std::string host, port;
};
HostPort SplitHostPort(std::string_view address);
// Whether `address` (HOST:PORT) is this machine whatever a name server says: localhost,
// 127.0.0.0/8,
// ::1.
bool IsLoopback(std::string_view address);

// "2026-11-22 15:04 UTC"
std::string UtcText(int64_t unix_s);

}  // namespace farpoint

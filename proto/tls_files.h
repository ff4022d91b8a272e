// The TLS files of a process: the farm's authority, its own certificate and key. Reading them
// checks all that can be known without a peer, so that a mistake is named where it was made and not
// as a failed handshake.
#pragma once

#include <cstdint>
#include <optional>
#include <string>

#include "core/base/status.h"
#include "proto/certificate.h"

namespace farpoint {

struct TlsPaths {
  std::string ca, certificate, key;
  bool empty() const { return ca.empty() && certificate.empty() && key.empty(); }
};
// What `farpoint certs` calls them: DIR/ca.pem, DIR/NAME.pem, DIR/NAME.key.
TlsPaths PathsIn(const std::string& directory, const std::string& name);

struct TlsMaterial {
  std::string ca, certificate, key;  // PEM; the last two empty: known by a token
  CertificateFacts facts;            // of the certificate
  TlsPaths paths;                    // where they were read
};
enum class TlsUse { kServer, kPeer };

// The files of `paths`, of at most 1 MiB each; `certificate` and `key` both or neither, and for
// kServer both. Errors name file and cure: kNotFound, kPermissionDenied; kInvalidArgument: no PEM;
// kFailedPrecondition: the key is another's, may be read by others than its owner (a key of root
// may be read by its group), or a path is missing; kUnauthenticated: the certificate has expired,
// is not valid yet at `now_s`, or another authority's.
absl::StatusOr<TlsMaterial> LoadTls(const TlsPaths& paths, TlsUse use, int64_t now_s);

// Finds out that the files were replaced, as they are before a certificate expires. They are not
// replaced at one instant: an error is told when they have stood still from one look to the next,
// once. Not thread-safe.
class TlsWatch {
 public:
  TlsWatch(TlsPaths paths, TlsUse use);
  // What lies there now if it is not what lay there before; LoadTls's error if it cannot be used:
  // then what was read before goes on being the process's.
  std::optional<absl::StatusOr<TlsMaterial>> Look(int64_t now_s);

 private:
  std::string Signature() const;

  const TlsPaths paths_;
  const TlsUse use_;
  std::string seen_, failed_, told_;  // signatures
};

// What stands on a command line: --certs, or --tls-ca, --tls-cert and --tls-key, or neither.
struct TlsFlags {
  std::string directory;
  TlsPaths paths;
  bool insecure = false;
  bool empty() const { return directory.empty() && paths.empty(); }
};
// The files that the flags mean for a process of `role`. In the folder it is ROLE.pem; if that is
// not there, the only certificate of the role (for kClient also of kAdmin). kInvalidArgument if
// there are several, which it lists, or if both folder and files are given.
absl::StatusOr<TlsPaths> FindTls(const TlsFlags& flags, Role role);
// What to say to who would talk in the clear to `address`: kInvalidArgument unless that is loopback
// or `insecure` was given.
absl::Status CheckMayBePlain(const TlsFlags& flags, const std::string& address);

// Seconds of the Unix clock.
int64_t NowUnixS();

}  // namespace farpoint

// X.509 certificates of a farm: made, read and checked. ECDSA on P-256 with SHA-256 (FIPS 186-4),
// RFC 5280. A farm has one authority; it issues a certificate to each coordinator, worker and user,
// whose role is a URI among its subject alternative names (proto/access.h). All texts are PEM. Pure
// functions, thread-safe; times are seconds of the Unix clock.
#pragma once

#include <cstdint>
#include <string>
#include <string_view>
#include <vector>

#include "core/base/status.h"
#include "proto/access.h"

namespace farpoint {

struct CertificateFacts {
  std::string name;    // common name
  std::string issuer;  // common name of who signed it
  std::string serial;  // lower-case hexadecimal digits
  Role role = Role::kNone;
  bool authority = false;
  std::vector<std::string> hosts;  // a coordinator's DNS names and IP addresses
  int64_t not_before_s = 0, not_after_s = 0;
};
// The first certificate of `pem`. kInvalidArgument, with `what` (a path) in front, if there is
// none.
absl::StatusOr<CertificateFacts> ReadCertificate(std::string_view pem, std::string_view what);

// Whether `pem` (first the certificate, then any in between) leads to one of `authorities` and
// holds at the time `now_s`, for a peer that connects (`server` false) or one that is connected to.
// kUnauthenticated: it has expired, is not valid yet, or somebody else issued it; the text names
// the certificate, says why and what to do.
absl::Status CheckIssued(std::string_view pem, std::string_view authorities, bool server,
                         int64_t now_s);
// kFailedPrecondition unless `key` is the private key of the certificate `pem`; kInvalidArgument if
// it is no key. `what` is its path.
absl::Status CheckKey(std::string_view pem, std::string_view key, std::string_view what);
// Whether the certificate names `host` (a DNS name, also by wildcard, or an IP address).
// kUnauthenticated lists the hosts that it names.
absl::Status CheckHost(std::string_view pem, const std::string& host);

struct CertificateAndKey {
  std::string certificate, key;
};
struct CertificateRequest {
  std::string name;                // CheckName
  Role role = Role::kNone;         // not kNone
  std::vector<std::string> hosts;  // kServer: DNS names and IP addresses, at least one; else none
  int64_t not_before_s = 0, not_after_s = 0;
};
// `name` for people; the common name gets random digits too, so that two authorities are never
// mixed up. kInternal if the library fails.
absl::StatusOr<CertificateAndKey> MakeAuthority(const std::string& name, int64_t not_before_s,
                                                int64_t not_after_s);
// Nobody's certificate outlives the authority's: not_after_s is cut to that.
absl::StatusOr<CertificateAndKey> IssueCertificate(const CertificateAndKey& authority,
                                                   const CertificateRequest& request);
// Cryptographically strong.
absl::StatusOr<std::string> RandomHexDigits(size_t digits);

}  // namespace farpoint

// farpoint certs: the certificates and tokens of a farm, made without any other tool. A folder
// holds
//
//   ca.pem, ca.key          the authority. Whoever has ca.key can make a worker or an admin: it
//   belongs on
//                           the one machine where certificates are made, and nowhere else
//   NAME.pem, NAME.key      a certificate and its key; server, worker1, alice, …
//   tokens, revoked         what the coordinator reads (proto/access.h), also while it runs
//
// Nothing that is there is overwritten; keys and tokens can be read by their owner alone.
#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include "core/base/status.h"
#include "proto/access.h"

namespace farpoint {

struct CertsInit {
  std::string directory;
  std::vector<std::string> server_hosts;  // none: this machine's names and loopback
  uint32_t workers = 1;                   // worker1 … workerN; one alone: worker
  std::vector<std::string> clients;       // names; none: client
  uint32_t days = 365;                    // of all but the authority, which holds ten times as long
};
// Makes the authority, a coordinator's, the workers' and the clients' certificates. Returns what it
// made, a line for each file. kFailedPrecondition if there is an authority already.
absl::StatusOr<std::vector<std::string>> InitCerts(const CertsInit& init, int64_t now_s);

struct CertsAdd {
  std::string directory;
  std::string name;  // of the file and of whom it is for
  Role role = Role::kClient;
  std::vector<std::string> hosts;  // kServer only
  uint32_t days = 365;
};
// One more certificate of the folder's authority. Takes it away again if it cannot be kept whole.
absl::StatusOr<std::vector<std::string>> AddCertificate(const CertsAdd& add, int64_t now_s);

// What is in the folder: name, role, hosts, serial number, until when, and what is wrong with it.
absl::StatusOr<std::vector<std::string>> ShowCerts(const std::string& directory, int64_t now_s);

struct CertsToken {
  std::string directory;
  std::string name;
  Role role = Role::kClient;  // or kAdmin
  uint32_t days = 365;
};
// Adds a token's hash to the folder's `tokens` and returns the token, which is kept nowhere.
absl::StatusOr<std::string> AddToken(const CertsToken& token, int64_t now_s);

// Takes all tokens of this name away, and adds the certificates of this name, or of this serial
// number, to `revoked`. kNotFound if there is nothing of the kind.
absl::StatusOr<std::vector<std::string>> Revoke(const std::string& directory,
                                                const std::string& name, int64_t now_s);

}  // namespace farpoint

// Certificates for tests with real processes: what `farpoint certs` makes, and what it does not
// make: expired ones, those of the future, those of other farms.
#pragma once

#include <gtest/gtest.h>
#include <sys/stat.h>

#include <fstream>
#include <iterator>
#include <string>
#include <vector>

#include "proto/certificate.h"
#include "proto/tls_files.h"
#include "tests/integration/farm.h"

namespace farpoint {

inline constexpr int64_t kTestDayS = 24 * 3600;

inline std::string ReadWhole(const std::string& path) {
  std::ifstream file(path, std::ios::binary);
  return {std::istreambuf_iterator<char>(file), {}};
}
inline void WriteSecret(const std::string& path, const std::string& text) {
  std::ofstream(path, std::ios::binary) << text;
  ASSERT_EQ(::chmod(path.c_str(), 0600), 0);
}

// A folder DIR/{ca,server,worker,alice,bob}.{pem,key}, by the program itself.
inline std::string MakeCerts(Farm& farm, const std::string& name = "certs") {
  const std::string folder = farm.File(name);
  const RunResult made = farm.Client({"certs", "init", "--dir", folder, "--server",
                                      "127.0.0.1,localhost", "--clients", "alice,bob"});
  EXPECT_EQ(made.exit_code, 0) << made.err;
  return folder;
}

// Another certificate of the folder's authority, NAME.pem and NAME.key.
inline void IssueInto(const std::string& folder, const std::string& name, Role role,
                      int64_t not_before_s, int64_t not_after_s,
                      const std::vector<std::string>& hosts = {}) {
  const CertificateAndKey authority{ReadWhole(folder + "/ca.pem"), ReadWhole(folder + "/ca.key")};
  const auto issued = IssueCertificate(authority, {.name = name,
                                                   .role = role,
                                                   .hosts = hosts,
                                                   .not_before_s = not_before_s,
                                                   .not_after_s = not_after_s});
  ASSERT_TRUE(issued.ok()) << issued.status();
  std::ofstream(folder + "/" + name + ".pem", std::ios::binary) << issued->certificate;
  WriteSecret(folder + "/" + name + ".key", issued->key);
}

inline std::vector<std::string> TlsFlagsOf(const std::string& folder, const std::string& name) {
  return {"--tls-ca",  folder + "/ca.pem",          "--tls-cert", folder + "/" + name + ".pem",
          "--tls-key", folder + "/" + name + ".key"};
}

// What a program would use if it did not look at its own files first.
inline TlsMaterial Unchecked(const std::string& ca_folder, const std::string& folder,
                             const std::string& name) {
  return {.ca = ReadWhole(ca_folder + "/ca.pem"),
          .certificate = ReadWhole(folder + "/" + name + ".pem"),
          .key = ReadWhole(folder + "/" + name + ".key"),
          .facts = {}};
}

}  // namespace farpoint

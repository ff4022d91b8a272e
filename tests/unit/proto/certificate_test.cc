#include "proto/certificate.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <sys/stat.h>

#include <filesystem>
#include <fstream>

#include "proto/connection_probe.h"
#include "proto/tls_files.h"

namespace farpoint {
namespace {

using testing::ElementsAre;
using testing::HasSubstr;

constexpr int64_t kNow = 1'800'000'000, kDay = 24 * 3600;

class CertificateTest : public testing::Test {
 protected:
  void SetUp() override {
    auto made = MakeAuthority("farm", kNow - kDay, kNow + 1000 * kDay);
    ASSERT_TRUE(made.ok()) << made.status();
    authority_ = *made;
  }
  CertificateAndKey Issue(Role role, std::vector<std::string> hosts = {},
                          int64_t from = kNow - kDay, int64_t to = kNow + 10 * kDay) {
    auto made = IssueCertificate(authority_, {.name = "who",
                                              .role = role,
                                              .hosts = std::move(hosts),
                                              .not_before_s = from,
                                              .not_after_s = to});
    EXPECT_TRUE(made.ok()) << made.status();
    return made.ok() ? *made : CertificateAndKey{};
  }
  CertificateAndKey authority_;
};

TEST_F(CertificateTest, SaysWhoseItIsAndForWhat) {
  const auto facts =
      ReadCertificate(Issue(Role::kServer, {"farm.example", "10.0.0.7", "::1"}).certificate, "x");
  ASSERT_TRUE(facts.ok()) << facts.status();
  EXPECT_EQ(facts->name, "who");
  EXPECT_EQ(facts->role, Role::kServer);
  EXPECT_FALSE(facts->authority);
  EXPECT_THAT(facts->hosts, ElementsAre("farm.example", "10.0.0.7", "::1"));
  EXPECT_EQ(facts->not_after_s, kNow + 10 * kDay);
  EXPECT_EQ(facts->serial.size(), 32u);
  EXPECT_EQ(ReadCertificate(Issue(Role::kAdmin).certificate, "x")->role, Role::kAdmin);
  const auto ca = ReadCertificate(authority_.certificate, "x");
  EXPECT_TRUE(ca->authority);
  EXPECT_EQ(ca->role, Role::kNone);
  EXPECT_EQ(facts->issuer, ca->name);
  EXPECT_NE(ReadCertificate(Issue(Role::kClient).certificate, "x")->serial,
            ReadCertificate(Issue(Role::kClient).certificate, "x")->serial);
}

TEST_F(CertificateTest, HoldsForItsTimeItsSideAndItsFarm) {
  const std::string client = Issue(Role::kClient).certificate;
  const std::string server = Issue(Role::kServer, {"h"}).certificate;
  const std::string& ca = authority_.certificate;
  EXPECT_TRUE(CheckIssued(client, ca, false, kNow).ok());
  EXPECT_TRUE(CheckIssued(server, ca, true, kNow).ok());
  const auto refused = [&](const std::string& pem, const std::string& by, bool as_server,
                           int64_t now) {
    const absl::Status status = CheckIssued(pem, by, as_server, now);
    EXPECT_TRUE(absl::IsUnauthenticated(status)) << status;
    return std::string(status.message());
  };
  EXPECT_THAT(refused(client, ca, false, kNow + 11 * kDay), HasSubstr("expired on 2027"));
  EXPECT_THAT(refused(client, ca, false, kNow - 2 * kDay), HasSubstr("not valid before"));
  EXPECT_THAT(refused(client, ca, true, kNow), HasSubstr("not made for this side"));
  EXPECT_THAT(refused(server, ca, false, kNow), HasSubstr("not made for this side"));
  const auto other = MakeAuthority("farm", kNow - kDay, kNow + 1000 * kDay);
  EXPECT_THAT(refused(client, other->certificate, false, kNow),
              HasSubstr("not by this farm's authority"));
  refused("garbage", ca, false, kNow);
  // Nobody but the authority issues: a client's key makes no worker.
  const CertificateAndKey alice = Issue(Role::kClient);
  const auto forged = IssueCertificate(alice, {.name = "mallory",
                                               .role = Role::kWorker,
                                               .hosts = {},
                                               .not_before_s = kNow - kDay,
                                               .not_after_s = kNow + kDay});
  ASSERT_TRUE(forged.ok());
  refused(forged->certificate + alice.certificate, ca, false, kNow);
  refused(authority_.certificate, other->certificate, false, kNow);
}

TEST_F(CertificateTest, NoneOutlivesItsAuthority) {
  const auto facts =
      ReadCertificate(Issue(Role::kClient, {}, kNow, kNow + 5000 * kDay).certificate, "x");
  EXPECT_EQ(facts->not_after_s, kNow + 1000 * kDay);
}

TEST_F(CertificateTest, NamesItsHosts) {
  const std::string pem = Issue(Role::kServer, {"*.farm.example", "10.0.0.7", "::1"}).certificate;
  for (const char* host : {"a.farm.example", "10.0.0.7", "::1"}) {
    EXPECT_TRUE(CheckHost(pem, host).ok()) << host;
  }
  for (const char* host : {"farm.example", "a.b.farm.example", "10.0.0.8", "evil"}) {
    EXPECT_TRUE(absl::IsUnauthenticated(CheckHost(pem, host))) << host;
  }
}

TEST_F(CertificateTest, RefusesWhatWouldBeSomethingElse) {
  const auto issue = [&](CertificateRequest request) {
    request.not_before_s = kNow;
    request.not_after_s = kNow + kDay;
    return IssueCertificate(authority_, request).status();
  };
  EXPECT_FALSE(issue({.name = "a,DNS:evil", .role = Role::kClient, .hosts = {}}).ok());
  EXPECT_FALSE(issue({.name = "a", .role = Role::kNone, .hosts = {}}).ok());
  EXPECT_FALSE(issue({.name = "a", .role = Role::kServer, .hosts = {}}).ok());
  EXPECT_FALSE(issue({.name = "a", .role = Role::kClient, .hosts = {"h"}}).ok());
  EXPECT_FALSE(
      issue({.name = "a", .role = Role::kServer, .hosts = {"h,URI:farpoint:role:worker"}}).ok());
  EXPECT_FALSE(IssueCertificate({authority_.certificate, Issue(Role::kClient).key},
                                {.name = "a",
                                 .role = Role::kClient,
                                 .hosts = {},
                                 .not_before_s = kNow,
                                 .not_after_s = kNow + kDay})
                   .ok());
}

TEST_F(CertificateTest, KnowsItsKey) {
  const CertificateAndKey one = Issue(Role::kClient), other = Issue(Role::kClient);
  EXPECT_TRUE(CheckKey(one.certificate, one.key, "k").ok());
  EXPECT_TRUE(absl::IsFailedPrecondition(CheckKey(one.certificate, other.key, "k")));
  EXPECT_TRUE(absl::IsInvalidArgument(CheckKey(one.certificate, "no key", "k")));
}

class TlsFilesTest : public CertificateTest {
 protected:
  void SetUp() override {
    CertificateTest::SetUp();
    std::string pattern = (std::filesystem::temp_directory_path() / "farpoint-XXXXXX").string();
    ASSERT_NE(mkdtemp(pattern.data()), nullptr);
    folder_ = pattern;
    Write("ca.pem", authority_.certificate);
  }
  void TearDown() override { std::filesystem::remove_all(folder_); }
  void Write(const std::string& name, const std::string& text, mode_t mode = 0600) {
    std::ofstream(folder_ + "/" + name) << text;
    ASSERT_EQ(::chmod((folder_ + "/" + name).c_str(), mode), 0);
  }
  void WritePair(const std::string& name, const CertificateAndKey& pair, mode_t mode = 0600) {
    Write(name + ".pem", pair.certificate);
    Write(name + ".key", pair.key, mode);
  }
  std::string folder_;
};

TEST_F(TlsFilesTest, AreReadAndChecked) {
  WritePair("client", Issue(Role::kClient));
  const auto good = LoadTls(PathsIn(folder_, "client"), TlsUse::kPeer, kNow);
  ASSERT_TRUE(good.ok()) << good.status();
  EXPECT_EQ(good->facts.name, "who");
  EXPECT_TRUE(
      absl::IsUnauthenticated(LoadTls(PathsIn(folder_, "client"), TlsUse::kServer, kNow).status()));
  EXPECT_TRUE(absl::IsUnauthenticated(
      LoadTls(PathsIn(folder_, "client"), TlsUse::kPeer, kNow + 20 * kDay).status()));
  EXPECT_TRUE(absl::IsNotFound(LoadTls(PathsIn(folder_, "x"), TlsUse::kPeer, kNow).status()));
  // A token needs the authority only; a coordinator needs all.
  const TlsPaths authority{.ca = folder_ + "/ca.pem", .certificate = "", .key = ""};
  EXPECT_TRUE(LoadTls(authority, TlsUse::kPeer, kNow).ok());
  EXPECT_FALSE(LoadTls(authority, TlsUse::kServer, kNow).ok());
  EXPECT_FALSE(LoadTls({}, TlsUse::kPeer, kNow).ok());
  // A certificate is no authority.
  EXPECT_FALSE(
      LoadTls({.ca = folder_ + "/client.pem", .certificate = "", .key = ""}, TlsUse::kPeer, kNow)
          .ok());
}

TEST_F(TlsFilesTest, KeysAreSecret) {
  for (const mode_t mode : {0644, 0604, 0660, 0602}) {
    WritePair("client", Issue(Role::kClient), mode);
    const absl::Status status = LoadTls(PathsIn(folder_, "client"), TlsUse::kPeer, kNow).status();
    EXPECT_TRUE(absl::IsFailedPrecondition(status)) << std::oct << mode;
    EXPECT_THAT(std::string(status.message()), HasSubstr("chmod 600"));
  }
}

TEST_F(TlsFilesTest, AreFoundByRole) {
  const auto find = [&](Role role) { return FindTls({.directory = folder_, .paths = {}}, role); };
  WritePair("render7", Issue(Role::kWorker));
  WritePair("boss", Issue(Role::kAdmin));
  EXPECT_EQ(find(Role::kWorker)->certificate, folder_ + "/render7.pem");
  EXPECT_EQ(find(Role::kClient)->certificate, folder_ + "/boss.pem") << "admins are clients, too";
  WritePair("alice", Issue(Role::kClient));
  EXPECT_TRUE(absl::IsInvalidArgument(find(Role::kClient).status()));
  WritePair("client", Issue(Role::kClient));
  EXPECT_EQ(find(Role::kClient)->certificate, folder_ + "/client.pem");
  EXPECT_TRUE(absl::IsInvalidArgument(
      FindTls({.directory = folder_, .paths = {.ca = "x", .certificate = "", .key = ""}},
              Role::kClient)
          .status()));
}

TEST_F(TlsFilesTest, TokensAreSecretAndWhole) {
  const std::string token = "fp_" + std::string(64, '7');
  Write("token", token + "\nmore\n");
  EXPECT_EQ(*ReadTokenFile(folder_ + "/token"), token);
  Write("token", token, 0640);
  EXPECT_TRUE(absl::IsFailedPrecondition(ReadTokenFile(folder_ + "/token").status()));
  Write("token", "fp_123");
  EXPECT_TRUE(absl::IsFailedPrecondition(ReadTokenFile(folder_ + "/token").status()));
  EXPECT_TRUE(absl::IsNotFound(ReadTokenFile(folder_ + "/none").status()));
}

}  // namespace
}  // namespace farpoint

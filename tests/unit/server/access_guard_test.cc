#include "server/access_guard.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <fstream>

#include "proto/certificate.h"
#include "tests/unit/server/temp_folder.h"

namespace farpoint {
namespace {

using testing::HasSubstr;

constexpr int64_t kNow = 1'800'000'000, kDay = 24 * 3600;
constexpr char kStatus[] = "/farpoint.v1.JobService/Status";
constexpr char kLease[] = "/farpoint.v1.WorkerService/Lease";

class AccessGuardTest : public testing::Test {
 protected:
  void SetUp() override {
    authority_ = *MakeAuthority("farm", kNow - kDay, kNow + 1000 * kDay);
    clock_ = std::make_shared<FakeClock>();
    Restart(100);
  }
  void Restart(double calls_per_second) {
    guard_ = std::make_unique<AccessGuard>(
        AccessOptions{.ca = authority_.certificate,
                      .tokens_file = folder_ / "tokens",
                      .revoked_file = folder_ / "revoked",
                      .calls_per_second = calls_per_second,
                      .clock = clock_,
                      .unix_s = [this] { return now_; },
                      .refused = [this](std::string text) { told_.push_back(std::move(text)); }});
  }
  std::string Issue(const std::string& name, Role role, int64_t to = kNow + 10 * kDay) {
    return IssueCertificate(authority_, {.name = name,
                                         .role = role,
                                         .hosts = {},
                                         .not_before_s = kNow - kDay,
                                         .not_after_s = to})
        ->certificate;
  }
  void WriteList(const std::string& name, const std::string& text) {
    std::ofstream(folder_ / name) << text;
    clock_->Advance(std::chrono::seconds(1));
  }
  absl::Status ByCertificate(const std::string& method, const std::string& pem) {
    return guard_->Admit(method, {pem, ""});
  }
  absl::Status ByToken(const std::string& method, const std::string& token) {
    return guard_->Admit(method, {"", "Bearer " + token});
  }

  TempFolder folder_;
  CertificateAndKey authority_;
  std::shared_ptr<FakeClock> clock_;
  int64_t now_ = kNow;
  std::vector<std::string> told_;
  std::unique_ptr<AccessGuard> guard_;
};

TEST_F(AccessGuardTest, TellsRolesApart) {
  const std::string alice = Issue("alice", Role::kClient), w1 = Issue("w1", Role::kWorker);
  EXPECT_TRUE(ByCertificate(kStatus, alice).ok());
  EXPECT_TRUE(ByCertificate(kLease, w1).ok());
  EXPECT_TRUE(absl::IsPermissionDenied(ByCertificate(kLease, alice)));
  EXPECT_TRUE(absl::IsPermissionDenied(ByCertificate(kStatus, w1)));
  EXPECT_TRUE(absl::IsUnauthenticated(guard_->Admit(kStatus, {"", ""})));
  EXPECT_TRUE(guard_->Admit("/grpc.health.v1.Health/Check", {"", ""}).ok());
  const auto caller = guard_->Identify({alice, ""});
  ASSERT_TRUE(caller.ok());
  EXPECT_EQ(caller->name, "alice");
  EXPECT_EQ(caller->role, Role::kClient);
}

TEST_F(AccessGuardTest, AnExpiryEndsWhatWasAdmittedBefore) {
  const std::string brief = Issue("brief", Role::kClient, kNow + 30);
  EXPECT_TRUE(ByCertificate(kStatus, brief).ok());
  now_ = kNow + 31;
  EXPECT_TRUE(absl::IsUnauthenticated(ByCertificate(kStatus, brief)));
  // A clock that is set right helps at once, but for a few seconds.
  now_ = kNow + 5;
  clock_->Advance(std::chrono::seconds(10));
  now_ = kNow + 29;
  Restart(100);
  EXPECT_TRUE(ByCertificate(kStatus, brief).ok());
}

TEST_F(AccessGuardTest, ListsAreReadAgainWhenTheyChange) {
  const std::string alice = Issue("alice", Role::kClient);
  const std::string token = "fp_" + std::string(64, '3');
  EXPECT_TRUE(absl::IsUnauthenticated(ByToken(kStatus, token)));
  WriteList("tokens", FormatToken({TokenHash(token), "carol", Role::kClient, kNow + 100}));
  EXPECT_TRUE(ByToken(kStatus, token).ok());
  EXPECT_TRUE(absl::IsPermissionDenied(ByToken(kLease, token)));
  now_ = kNow + 100;
  EXPECT_THAT(std::string(ByToken(kStatus, token).message()), HasSubstr("expired"));
  now_ = kNow;
  WriteList("tokens", "");
  EXPECT_TRUE(absl::IsUnauthenticated(ByToken(kStatus, token)));

  EXPECT_TRUE(ByCertificate(kStatus, alice).ok());
  WriteList("revoked", ReadCertificate(alice, "x")->serial + " alice\n");
  EXPECT_THAT(std::string(ByCertificate(kStatus, alice).message()), HasSubstr("revoked"));
  WriteList("revoked", "");
  EXPECT_TRUE(ByCertificate(kStatus, alice).ok());
  // A list that cannot be read lets nobody in by that way.
  WriteList("revoked", "what is this\n");
  EXPECT_TRUE(absl::IsUnauthenticated(ByCertificate(kStatus, alice)));
  WriteList("tokens", "damaged\n");
  EXPECT_THAT(std::string(ByToken(kStatus, token).message()), HasSubstr("tokens:1"));
}

TEST_F(AccessGuardTest, ACertificateCountsBeforeAToken) {
  const std::string token = "fp_" + std::string(64, '3');
  WriteList("tokens", FormatToken({TokenHash(token), "carol", Role::kAdmin, kNow + 100}));
  EXPECT_EQ(guard_->Identify({Issue("alice", Role::kClient), "Bearer " + token})->name, "alice");
  // A bad certificate is not made good by a token.
  now_ = kNow + 20 * kDay;
  EXPECT_FALSE(guard_->Identify({Issue("alice", Role::kClient), "Bearer " + token}).ok());
}

TEST_F(AccessGuardTest, ClientsAreLimitedAndWorkersAreNot) {
  Restart(10);
  const std::string alice = Issue("alice", Role::kClient), bob = Issue("bob", Role::kClient);
  const std::string again = Issue("alice", Role::kClient), w1 = Issue("w1", Role::kWorker);
  int admitted = 0;
  while (ByCertificate(kStatus, alice).ok()) ASSERT_LT(++admitted, 1000);
  EXPECT_EQ(admitted, 40) << "four seconds' worth at once";
  EXPECT_TRUE(absl::IsResourceExhausted(ByCertificate(kStatus, again))) << "by name";
  EXPECT_TRUE(ByCertificate(kStatus, bob).ok());
  for (int i = 0; i < 1000; ++i) ASSERT_TRUE(ByCertificate(kLease, w1).ok());
  clock_->Advance(std::chrono::seconds(1));
  for (int i = 0; i < 10; ++i) EXPECT_TRUE(ByCertificate(kStatus, alice).ok()) << i;
  EXPECT_FALSE(ByCertificate(kStatus, alice).ok());
}

TEST_F(AccessGuardTest, RefusalsAreToldButDoNotFloodTheLog) {
  for (int i = 0; i < 1000; ++i) {
    (void)guard_->Admit("/evil\n2026 [info] all is well", {"", ""});
  }
  EXPECT_EQ(told_.size(), 20u);
  EXPECT_EQ(told_[0].find('\n'), std::string::npos);
  clock_->Advance(std::chrono::seconds(11));
  (void)guard_->Admit(kStatus, {"", ""});
  EXPECT_EQ(told_.size(), 21u);
}

TEST_F(AccessGuardTest, StrangersDoNotFillItsMemory) {
  for (int i = 0; i < 10000; ++i) {
    (void)guard_->Admit(kStatus, {"certificate " + std::to_string(i), ""});
  }
  EXPECT_TRUE(ByCertificate(kStatus, Issue("alice", Role::kClient)).ok());
  EXPECT_TRUE(
      absl::IsUnauthenticated(guard_->Admit(kStatus, {std::string(size_t{1} << 20, 'x'), ""})));
}

}  // namespace
}  // namespace farpoint

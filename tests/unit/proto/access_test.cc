#include "proto/access.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

namespace farpoint {
namespace {

using testing::HasSubstr;

TEST(Access, RolesSurviveTheirNamesAndUris) {
  for (const Role role : {Role::kServer, Role::kWorker, Role::kClient, Role::kAdmin}) {
    EXPECT_EQ(RoleFromName(NameOf(role)), role);
    EXPECT_EQ(RoleFromUri(RoleUri(role)), role);
  }
  for (const char* other : {"", "none", "root", "Worker"})
    EXPECT_EQ(RoleFromName(other), std::nullopt);
  for (const char* other : {"farpoint:role:", "farpoint:role:none", "urn:role:worker", "worker",
                            "farpoint:role:worker "}) {
    EXPECT_EQ(RoleFromUri(other), std::nullopt) << other;
  }
}

// Who may call what: every pair.
TEST(Access, EachRoleMayCallItsOwnMethods) {
  struct Row {
    const char* method;
    bool worker, client, server, none;
  };
  constexpr Row kRows[] = {
      {"/farpoint.v1.WorkerService/Register", true, false, false, false},
      {"/farpoint.v1.WorkerService/Lease", true, false, false, false},
      {"/farpoint.v1.WorkerService/Attend", true, false, false, false},
      {"/farpoint.v1.BlobService/Get", true, false, false, false},
      {"/farpoint.v1.BlobService/SomethingNew", true, false, false, false},
      {"/farpoint.v1.BlobService/Put", false, true, false, false},
      {"/farpoint.v1.BlobService/FindMissing", false, true, false, false},
      {"/farpoint.v1.JobService/Submit", false, true, false, false},
      {"/farpoint.v1.JobService/Status", false, true, false, false},
      {"/farpoint.v1.JobService/Diagnose", true, true, false, false},
      {"/grpc.health.v1.Health/Check", true, true, true, true},
      {"/grpc.reflection.v1alpha.ServerReflection/ServerReflectionInfo", true, true, true, true},
      {"/unknown.Service/Method", true, true, false, false},
      {"", true, true, false, false},
  };
  for (const Row& row : kRows) {
    SCOPED_TRACE(row.method);
    EXPECT_EQ(CheckMayCall({Role::kWorker, "w"}, row.method).ok(), row.worker);
    EXPECT_EQ(CheckMayCall({Role::kClient, "c"}, row.method).ok(), row.client);
    EXPECT_EQ(CheckMayCall({Role::kAdmin, "a"}, row.method).ok(), row.client);
    EXPECT_EQ(CheckMayCall({Role::kServer, "s"}, row.method).ok(), row.server);
    EXPECT_EQ(CheckMayCall({Role::kNone, "n"}, row.method).ok(), row.none);
  }
  const absl::Status refused =
      CheckMayCall({Role::kClient, "alice"}, "/farpoint.v1.WorkerService/Register");
  EXPECT_TRUE(absl::IsPermissionDenied(refused));
  EXPECT_THAT(std::string(refused.message()), HasSubstr("'alice' has the role client"));
}

TEST(Access, NamesAreHarmless) {
  for (const char* good : {"a", "worker1", "alice@example.org", "A-b_c.d"}) {
    EXPECT_TRUE(CheckName(good).ok()) << good;
  }
  for (const std::string& bad : {std::string(), std::string("../ca"), std::string("a b"),
                                 std::string(".hidden"), std::string("-flag"), std::string("a\nb"),
                                 std::string("a/b"), std::string(65, 'a'), std::string("ä")}) {
    EXPECT_TRUE(absl::IsInvalidArgument(CheckName(bad))) << bad;
  }
}

TEST(Access, TokensSurviveTheirList) {
  const TokenEntry entry{TokenHash("fp_x"), "carol", Role::kAdmin, 1'900'000'000};
  const auto read = ParseTokens("# of a farm\n\n" + FormatToken(entry), "tokens");
  ASSERT_TRUE(read.ok()) << read.status();
  ASSERT_EQ(read->size(), 1u);
  EXPECT_EQ((*read)[0].hash, entry.hash);
  EXPECT_EQ((*read)[0].name, "carol");
  EXPECT_EQ((*read)[0].role, Role::kAdmin);
  EXPECT_EQ((*read)[0].expires_unix_s, 1'900'000'000);
}

TEST(Access, DamagedListsAreRefusedByLine) {
  const std::string hash(64, 'a');
  for (const std::string& bad :
       {std::string("short carol client 1"), hash + " carol worker 1", hash + " carol client",
        hash + " carol client x", hash + " carol client 1 more", hash + " ../x client 1"}) {
    const absl::Status status = ParseTokens("\n" + bad + "\n", "tokens").status();
    EXPECT_TRUE(absl::IsInvalidArgument(status)) << bad;
    EXPECT_THAT(std::string(status.message()), HasSubstr("tokens:2"));
  }
  EXPECT_EQ(*ParseRevoked("AB12 alice 2026\n#x\n", "r"), std::vector<std::string>{"ab12"});
  EXPECT_TRUE(absl::IsInvalidArgument(ParseRevoked("xyz\n", "r").status()));
}

TEST(Access, OnlyThisMachineIsLoopback) {
  for (const char* own : {"127.0.0.1:1", "127.8.9.10:1", "localhost:1", "[::1]:1"}) {
    EXPECT_TRUE(IsLoopback(own)) << own;
  }
  for (const char* other :
       {"0.0.0.0:1", "[::]:1", "10.0.0.1:1", "127.0.0.1.evil.example:1", "127.evil:1",
        "localhost.evil:1", "[::2]:1", "farm:1", "", ":1", "127.1:1"}) {
    EXPECT_FALSE(IsLoopback(other)) << other;
  }
}

TEST(Access, TimesAreReadable) { EXPECT_EQ(UtcText(1'000'000'000), "2001-09-09 01:46 UTC"); }

}  // namespace
}  // namespace farpoint

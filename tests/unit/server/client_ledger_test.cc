#include "server/client_ledger.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <map>
#include <set>

#include "tests/unit/server/temp_folder.h"

namespace farpoint {
namespace {

using testing::HasSubstr;

Digest Named(const std::string& name) { return Sha256().Update(name).Finish(); }

class ClientLedgerTest : public testing::Test {
 protected:
  void Open(uint64_t max_jobs, uint64_t max_bytes) {
    ledger_.reset();
    ClientLedgerOptions options;
    options.path = folder_ / "clients.sqlite";
    options.has_blob = [this](const Digest& digest) { return !gone_.contains(digest); };
    options.is_active = [this](const JobId& job) -> std::optional<bool> {
      const auto at = active_.find(job.value);
      if (at == active_.end()) return std::nullopt;
      return at->second;
    };
    options.max_jobs = max_jobs;
    options.max_bytes = max_bytes;
    auto opened = ClientLedger::Open(std::move(options));
    ASSERT_TRUE(opened.ok()) << opened.status();
    ledger_ = *std::move(opened);
  }
  void Submit(const std::string& client, const std::string& job) {
    active_[job] = true;
    ASSERT_TRUE(ledger_->Submitted(client, {job}).ok());
  }

  TempFolder folder_;
  std::set<Digest> gone_;
  std::map<std::string, bool> active_;
  std::unique_ptr<ClientLedger> ledger_;
};

TEST_F(ClientLedgerTest, JobsAreTheirClientsAcrossRestarts) {
  Open(2, 0);
  Submit("alice", "1");
  Submit("alice", "2");
  Submit("bob", "3");
  EXPECT_TRUE(absl::IsResourceExhausted(ledger_->MaySubmit("alice")));
  EXPECT_TRUE(ledger_->MaySubmit("bob").ok());
  Open(2, 0);
  EXPECT_EQ(ledger_->OwnerOf({"1"}), "alice");
  EXPECT_EQ(ledger_->OwnerOf({"3"}), "bob");
  EXPECT_EQ(ledger_->OwnerOf({"4"}), "");
  EXPECT_FALSE(ledger_->MaySubmit("alice").ok());
  active_["1"] = false;  // ended
  EXPECT_TRUE(ledger_->MaySubmit("alice").ok());
  active_.erase("2");  // purged
  EXPECT_EQ(ledger_->UseOf("alice")->jobs, 0u);
  EXPECT_EQ(ledger_->OwnerOf({"2"}), "");
  // A repeated submission does not change whose it is.
  ASSERT_TRUE(ledger_->Submitted("bob", {"1"}).ok());
  EXPECT_EQ(ledger_->OwnerOf({"1"}), "alice");
}

TEST_F(ClientLedgerTest, BytesCountForTheFirstWhoSentThem) {
  Open(0, 100);
  ASSERT_TRUE(ledger_->Stored("alice", Named("a"), 60).ok());
  ASSERT_TRUE(ledger_->Stored("bob", Named("a"), 60).ok());
  EXPECT_EQ(ledger_->UseOf("alice")->bytes, 60u);
  EXPECT_EQ(ledger_->UseOf("bob")->bytes, 0u);
  EXPECT_TRUE(ledger_->BeginTransfer("alice", 40).ok());
  const absl::Status refused = ledger_->BeginTransfer("alice", 41).status();
  EXPECT_TRUE(absl::IsResourceExhausted(refused));
  EXPECT_THAT(std::string(refused.message()), HasSubstr("stores 60 bytes"));
  EXPECT_FALSE(ledger_->BeginTransfer("alice", ~uint64_t{0}).ok()) << "no overflow";
  EXPECT_FALSE(ledger_->BeginTransfer("bob", 101).ok());
  // What has left the store makes room.
  gone_.insert(Named("a"));
  EXPECT_TRUE(ledger_->BeginTransfer("alice", 100).ok());
  EXPECT_EQ(ledger_->UseOf("alice")->bytes, 0u);
}

TEST_F(ClientLedgerTest, WhatIsOnItsWayCounts) {
  Open(0, 100);
  auto one = ledger_->BeginTransfer("alice", 60);
  ASSERT_TRUE(one.ok());
  const absl::Status refused = ledger_->BeginTransfer("alice", 60).status();
  EXPECT_TRUE(absl::IsResourceExhausted(refused));
  EXPECT_THAT(std::string(refused.message()), HasSubstr("sends 60"));
  EXPECT_TRUE(ledger_->BeginTransfer("bob", 60).ok()) << "of each client";
  one->reset();
  EXPECT_TRUE(ledger_->BeginTransfer("alice", 60).ok());
}

TEST_F(ClientLedgerTest, WithoutLimitsNothingIsRefused) {
  Open(0, 0);
  for (int i = 0; i < 100; ++i) Submit("alice", std::to_string(i));
  EXPECT_TRUE(ledger_->MaySubmit("alice").ok());
  EXPECT_TRUE(ledger_->BeginTransfer("alice", ~uint64_t{0}).ok());
}

TEST(ClientLedger, AFileThatIsNoneIsAClearError) {
  const TempFolder folder;
  const auto opened = ClientLedger::Open(
      {.path = folder / "no/such/folder", .has_blob = nullptr, .is_active = nullptr});
  EXPECT_TRUE(absl::IsUnavailable(opened.status()));
  EXPECT_THAT(std::string(opened.status().message()), HasSubstr("folder"));
}

}  // namespace
}  // namespace farpoint

#include "server/blob_store.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <filesystem>
#include <fstream>

#include "tests/unit/server/temp_folder.h"

namespace farpoint {
namespace {

namespace fs = std::filesystem;

std::unique_ptr<BlobStore> OpenOrDie(const std::string& folder, uint64_t limit = 1 << 20) {
  absl::StatusOr<std::unique_ptr<BlobStore>> store = BlobStore::Open(folder, limit);
  EXPECT_TRUE(store.ok()) << store.status();
  return store.ok() ? *std::move(store) : nullptr;
}

std::string TextOf(const Blob& blob) {
  return {reinterpret_cast<const char*>(blob.bytes().data()), blob.size()};
}
std::span<const std::byte> BytesOf(const std::string& text) {
  return std::as_bytes(std::span(text.data(), text.size()));
}

class BlobStoreTest : public ::testing::TestWithParam<bool> {
 protected:
  BlobStoreTest() : store_(OpenOrDie(GetParam() ? "" : folder_ / "blobs")) {}
  TempFolder folder_;
  std::unique_ptr<BlobStore> store_;
};
INSTANTIATE_TEST_SUITE_P(Homes, BlobStoreTest, ::testing::Values(false, true),
                         [](const auto& info) { return info.param ? "Memory" : "Folder"; });

TEST_P(BlobStoreTest, KeepsWhatItWasGiven) {
  const Blob blob = Blob::FromString("some bytes");
  EXPECT_FALSE(store_->Contains(blob.Hash()));
  EXPECT_TRUE(absl::IsNotFound(store_->Get(blob.Hash()).status()));
  ASSERT_TRUE(store_->Put(blob.Hash(), blob).ok());
  ASSERT_TRUE(store_->Put(blob.Hash(), blob).ok());
  EXPECT_TRUE(store_->Contains(blob.Hash()));
  EXPECT_EQ(TextOf(*store_->Get(blob.Hash())), "some bytes");
  const Blob empty;
  ASSERT_TRUE(store_->Put(empty.Hash(), empty).ok());
  EXPECT_EQ(store_->Get(empty.Hash())->size(), 0u);
}

TEST_P(BlobStoreTest, TakesPieces) {
  const Digest digest = Blob::FromString("one two three").Hash();
  const auto writer = store_->StartPut(digest, 13);
  ASSERT_TRUE(writer.ok());
  for (const std::string piece : {"one ", "two ", "three"}) {
    ASSERT_TRUE((*writer)->Append(BytesOf(piece)).ok());
  }
  EXPECT_FALSE(store_->Contains(digest));
  ASSERT_TRUE((*writer)->Commit().ok());
  EXPECT_EQ(TextOf(*store_->Get(digest)), "one two three");
}

TEST_P(BlobStoreTest, RefusesWrongContentsAndSizes) {
  const Digest digest = Blob::FromString("right").Hash();
  EXPECT_TRUE(absl::IsDataLoss(store_->Put(digest, Blob::FromString("wrong"))));
  {
    const auto writer = store_->StartPut(digest, 5);
    ASSERT_TRUE((*writer)->Append(BytesOf("wrong")).ok());
    EXPECT_TRUE(absl::IsDataLoss((*writer)->Commit()));
  }
  {
    const auto writer = store_->StartPut(digest, 5);
    ASSERT_TRUE((*writer)->Append(BytesOf("rig")).ok());
    EXPECT_TRUE(absl::IsDataLoss((*writer)->Commit()));
  }
  {
    const auto writer = store_->StartPut(digest, 5);
    EXPECT_TRUE(absl::IsInvalidArgument((*writer)->Append(BytesOf("righter"))));
  }
  EXPECT_TRUE(absl::IsResourceExhausted(store_->StartPut(digest, (1 << 20) + 1).status()));
  EXPECT_TRUE(absl::IsResourceExhausted(
      store_->Put(digest, Blob::FromString(std::string((1 << 20) + 1, 'x')))));
  EXPECT_FALSE(store_->Contains(digest));
}

TEST(BlobStore, UnfinishedFilesAreRemoved) {
  TempFolder folder;
  const Digest digest = Blob::FromString("right").Hash();
  {
    const auto store = OpenOrDie(folder.path());
    {
      const auto writer = store->StartPut(digest, 5);
      ASSERT_TRUE((*writer)->Append(BytesOf("rig")).ok());
      EXPECT_FALSE(fs::is_empty(folder.path()));
    }
    EXPECT_TRUE(fs::is_empty(folder.path()));
  }
  std::ofstream(folder / (digest.Hex() + ".0.part")) << "rig";  // what a kill leaves
  const auto store = OpenOrDie(folder.path());
  EXPECT_TRUE(fs::is_empty(folder.path()));
}

TEST(BlobStore, DamageIsFoundAtFirstUseAndTheFileRemoved) {
  TempFolder folder;
  const Blob blob = Blob::FromString("some bytes");
  ASSERT_TRUE(OpenOrDie(folder.path())->Put(blob.Hash(), blob).ok());
  std::ofstream(folder / blob.Hash().Hex()) << "some bites";
  const auto store = OpenOrDie(folder.path());
  EXPECT_TRUE(store->Contains(blob.Hash()));
  const auto got = store->Get(blob.Hash());
  EXPECT_TRUE(absl::IsDataLoss(got.status())) << got.status();
  EXPECT_THAT(std::string(got.status().message()), ::testing::HasSubstr(folder.path()));
  EXPECT_FALSE(store->Contains(blob.Hash()));
  ASSERT_TRUE(store->Put(blob.Hash(), blob).ok());
  EXPECT_TRUE(store->Get(blob.Hash()).ok());
}

TEST(BlobStore, SeveralMaySendTheSameBlob) {
  TempFolder folder;
  const auto store = OpenOrDie(folder.path());
  const Digest digest = Blob::FromString("right").Hash();
  const auto a = store->StartPut(digest, 5), b = store->StartPut(digest, 5);
  ASSERT_TRUE((*a)->Append(BytesOf("rig")).ok());
  ASSERT_TRUE((*b)->Append(BytesOf("right")).ok());
  ASSERT_TRUE((*b)->Commit().ok());
  ASSERT_TRUE((*a)->Append(BytesOf("ht")).ok());
  ASSERT_TRUE((*a)->Commit().ok());
  EXPECT_EQ(TextOf(*store->Get(digest)), "right");
}

TEST(BlobStore, UnusedBlobsGoWhenTheyAreOld) {
  TempFolder folder;
  const auto store = OpenOrDie(folder.path());
  const Blob old = Blob::FromString("old"), kept = Blob::FromString("kept"),
             fresh = Blob::FromString("fresh");
  for (const Blob& blob : {old, kept, fresh}) ASSERT_TRUE(store->Put(blob.Hash(), blob).ok());
  const Blob mapped = *store->Get(old.Hash());
  const auto yesterday = fs::file_time_type::clock::now() - std::chrono::hours(24);
  fs::last_write_time(folder / old.Hash().Hex(), yesterday);
  fs::last_write_time(folder / kept.Hash().Hex(), yesterday);
  EXPECT_EQ(store->RemoveUnused({kept.Hash()}, std::chrono::hours(1)), 1u);
  EXPECT_FALSE(store->Contains(old.Hash()));
  EXPECT_TRUE(store->Contains(kept.Hash()));
  EXPECT_TRUE(store->Contains(fresh.Hash()));
  EXPECT_EQ(TextOf(mapped), "old");
}

}  // namespace
}  // namespace farpoint

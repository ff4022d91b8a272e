#include "worker/blob_cache.h"

#include <gtest/gtest.h>

#include <filesystem>
#include <fstream>
#include <map>
#include <thread>

#include "tests/unit/server/temp_folder.h"

namespace farpoint {
namespace {

namespace fs = std::filesystem;

std::string TextOf(const Blob& blob) {
  return {reinterpret_cast<const char*>(blob.bytes().data()), blob.size()};
}

// A coordinator's blobs, sent in small pieces, with faults on demand.
class FakeStreamer final : public BlobStreamer {
 public:
  Digest Add(const std::string& content) {
    const Digest digest = Sha256().Update(content).Finish();
    contents[digest] = content;
    return digest;
  }
  absl::Status Stream(const Digest& digest, uint64_t offset, const Sink& sink) override {
    {
      std::lock_guard lock(mutex);
      offsets.push_back(offset);
    }
    const auto at = contents.find(digest);
    if (at == contents.end()) return absl::NotFoundError("no such blob");
    const std::string& all = at->second;
    if (offset > all.size()) return absl::OutOfRangeError("beyond the end");
    do {
      if (offset >= break_at) {
        break_at = SIZE_MAX;
        return absl::UnavailableError("cut off");
      }
      const std::string piece = all.substr(offset, 10);
      FP_RETURN_IF_ERROR(sink(all.size(), std::as_bytes(std::span(piece.data(), piece.size()))));
      offset += piece.size();
      std::this_thread::sleep_for(pause);
    } while (offset < all.size());
    return absl::OkStatus();
  }
  std::map<Digest, std::string> contents;
  std::mutex mutex;
  std::vector<uint64_t> offsets;  // of the calls
  size_t break_at = SIZE_MAX;     // the stream breaks once, there
  std::chrono::milliseconds pause{0};
};

class BlobCacheTest : public ::testing::Test {
 protected:
  std::unique_ptr<BlobCache> Open(uint64_t max_bytes = 1 << 20, uint64_t max_blob = 1 << 20,
                                  const std::string& shared = "") {
    auto cache =
        BlobCache::Open({folder_.path(), max_bytes, max_blob,
                         [this](const std::string& text) { warnings_.push_back(text); }, shared},
                        streamer_);
    EXPECT_TRUE(cache.ok()) << cache.status();
    return *std::move(cache);
  }
  TempFolder folder_;
  FakeStreamer streamer_;
  std::vector<std::string> warnings_;
  const std::string content_ = std::string(95, 'a') + "the end";
};

TEST_F(BlobCacheTest, FetchesOnce) {
  const Digest digest = streamer_.Add(content_);
  auto cache = Open();
  EXPECT_EQ(TextOf(*cache->Get(digest, {})), content_);
  EXPECT_EQ(TextOf(*cache->Get(digest, {})), content_);
  cache = Open();
  EXPECT_EQ(TextOf(*cache->Get(digest, {})), content_);
  EXPECT_EQ(streamer_.offsets, std::vector<uint64_t>{0});
  EXPECT_FALSE(fs::exists(folder_ / (digest.Hex() + ".part")));
}

TEST_F(BlobCacheTest, EmptyBlobsAreBlobs) {
  const Digest digest = streamer_.Add("");
  EXPECT_EQ(Open()->Get(digest, {})->size(), 0u);
}

TEST_F(BlobCacheTest, AnInterruptedDownloadGoesOnInTheNextProcessToo) {
  const Digest digest = streamer_.Add(content_);
  int calls = 0;
  ASSERT_TRUE(absl::IsCancelled(Open()->Get(digest, [&] { return ++calls < 5; }).status()));
  EXPECT_EQ(TextOf(*Open()->Get(digest, {})), content_);
  EXPECT_EQ(streamer_.offsets, (std::vector<uint64_t>{0, 40}));
}

TEST_F(BlobCacheTest, AnInterruptedDownloadIsTakenUpAgain) {
  const Digest digest = streamer_.Add(content_);
  streamer_.break_at = 40;
  EXPECT_EQ(TextOf(*Open()->Get(digest, {})), content_);
  EXPECT_EQ(streamer_.offsets, (std::vector<uint64_t>{0, 40}));
}

TEST_F(BlobCacheTest, TheSharedFolderGoesBeforeTheCoordinator) {
  TempFolder shared;
  const Digest there = streamer_.Add(content_), damaged = streamer_.Add("12345678901234567890"),
               missing = streamer_.Add("not in the folder"), empty = streamer_.Add("");
  std::ofstream(shared / there.Hex()) << content_;
  std::ofstream(shared / damaged.Hex()) << "1234567890XXX4567890";
  std::ofstream(shared / empty.Hex());
  auto cache = Open(1 << 20, 1 << 20, shared.path());
  EXPECT_EQ(TextOf(*cache->Get(there, {})), content_);
  EXPECT_EQ(cache->Get(empty, {})->size(), 0u);
  EXPECT_TRUE(streamer_.offsets.empty()) << "the coordinator was asked";
  // What was copied stays when the folder goes.
  std::filesystem::remove(shared / there.Hex());
  EXPECT_EQ(TextOf(*Open(1 << 20, 1 << 20, shared.path())->Get(there, {})), content_);
  EXPECT_TRUE(streamer_.offsets.empty());

  EXPECT_EQ(TextOf(*cache->Get(damaged, {})), "12345678901234567890");
  ASSERT_EQ(warnings_.size(), 1u);
  EXPECT_NE(warnings_[0].find("other contents"), std::string::npos) << warnings_[0];
  EXPECT_EQ(TextOf(*cache->Get(missing, {})), "not in the folder");
  EXPECT_EQ(warnings_.size(), 1u);
  EXPECT_EQ(streamer_.offsets, (std::vector<uint64_t>{0, 0}));
}

TEST_F(BlobCacheTest, ADamagedPartIsThrownAwayAndFetchedAgain) {
  const Digest digest = streamer_.Add(content_);
  std::ofstream(folder_ / (digest.Hex() + ".part")) << std::string(50, 'x');
  EXPECT_EQ(TextOf(*Open()->Get(digest, {})), content_);
  EXPECT_EQ(streamer_.offsets, (std::vector<uint64_t>{50, 0}));
}

TEST_F(BlobCacheTest, APartThatIsTooLongIsThrownAway) {
  const Digest digest = streamer_.Add(content_);
  std::ofstream(folder_ / (digest.Hex() + ".part")) << std::string(500, 'x');
  EXPECT_EQ(TextOf(*Open()->Get(digest, {})), content_);
}

TEST_F(BlobCacheTest, ADamagedFileIsFetchedAgain) {
  const Digest digest = streamer_.Add(content_);
  ASSERT_TRUE(Open()->Get(digest, {}).ok());
  EXPECT_TRUE(warnings_.empty());
  std::ofstream(folder_ / digest.Hex()) << std::string(content_.size(), 'x');
  EXPECT_EQ(TextOf(*Open()->Get(digest, {})), content_);
  EXPECT_EQ(streamer_.offsets.size(), 2u);
  ASSERT_EQ(warnings_.size(), 1u);
  EXPECT_NE(warnings_[0].find(digest.Hex() + "' was damaged"), std::string::npos);
}

TEST_F(BlobCacheTest, WrongContentsAreRefused) {
  const Digest digest = Sha256().Update("expected").Finish();
  streamer_.contents[digest] = "something else";
  EXPECT_TRUE(absl::IsDataLoss(Open()->Get(digest, {}).status()));
  EXPECT_TRUE(fs::is_empty(folder_.path()));
  EXPECT_TRUE(absl::IsNotFound(Open()->Get(Sha256().Update("?").Finish(), {}).status()));
}

TEST_F(BlobCacheTest, TooLargeBlobsAreRefusedBeforeTheyAreWritten) {
  const Digest digest = streamer_.Add(content_);
  EXPECT_TRUE(absl::IsResourceExhausted(Open(1 << 20, 50)->Get(digest, {}).status()));
  EXPECT_EQ(fs::file_size(folder_ / (digest.Hex() + ".part")), 0u);
}

TEST_F(BlobCacheTest, ProgressIsToldAndMayEndIt) {
  const Digest digest = streamer_.Add(content_);
  int calls = 0;
  ASSERT_TRUE(absl::IsCancelled(Open()->Get(digest, [&] { return ++calls < 3; }).status()));
  ASSERT_TRUE(Open()->Get(digest, [&] { return ++calls > 0; }).ok());
  EXPECT_GE(calls, 10);
  EXPECT_EQ(streamer_.offsets, (std::vector<uint64_t>{0, 20}));
}

TEST_F(BlobCacheTest, TheLeastRecentlyUsedGoFirst) {
  const Digest a = streamer_.Add(std::string(100, 'a')), b = streamer_.Add(std::string(100, 'b')),
               c = streamer_.Add(std::string(100, 'c'));
  const auto cache = Open(250);
  const auto now = fs::file_time_type::clock::now();
  const Blob mapped = *cache->Get(a, {});
  ASSERT_TRUE(cache->Get(b, {}).ok());
  fs::last_write_time(folder_ / a.Hex(), now - std::chrono::hours(2));
  fs::last_write_time(folder_ / b.Hex(), now - std::chrono::hours(1));
  ASSERT_TRUE(cache->Get(c, {}).ok());
  EXPECT_FALSE(fs::exists(folder_ / a.Hex()));
  EXPECT_TRUE(fs::exists(folder_ / b.Hex()));
  EXPECT_EQ(TextOf(mapped), std::string(100, 'a'));
}

TEST_F(BlobCacheTest, WorkersThatShareAFolderFetchOnce) {
  const Digest digest = streamer_.Add(content_);
  streamer_.pause = std::chrono::milliseconds(10);
  const auto one = Open(), two = Open();
  std::thread other([&] { EXPECT_EQ(TextOf(*one->Get(digest, {})), content_); });
  EXPECT_EQ(TextOf(*two->Get(digest, {})), content_);
  other.join();
  EXPECT_EQ(streamer_.offsets.size(), 1u);
}

}  // namespace
}  // namespace farpoint

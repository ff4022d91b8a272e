#include "core/base/blob.h"

#include <gtest/gtest.h>
#include <unistd.h>

#include <cstdint>
#include <cstring>
#include <filesystem>
#include <fstream>
#include <string>

namespace farpoint {
namespace {

namespace fs = std::filesystem;

// A fresh folder, removed at the end.
class BlobFile : public testing::Test {
 protected:
  BlobFile() {
    folder_ = fs::path(testing::TempDir()) / ("farpoint_blob_" + std::to_string(::getpid()));
    fs::create_directories(folder_);
  }
  ~BlobFile() override { fs::remove_all(folder_); }
  std::string Path(const std::string& name) const { return folder_ / name; }
  static std::span<const std::byte> Bytes(std::string_view text) {
    return std::as_bytes(std::span(text.data(), text.size()));
  }
  static std::string Text(const Blob& blob) {
    return {reinterpret_cast<const char*>(blob.bytes().data()), blob.size()};
  }
  fs::path folder_;
};

TEST(Blob, CopiesShareTheBytes) {
  Blob copy;
  {
    const Blob blob = Blob::FromString("some bytes that no small buffer holds, to be sure");
    copy = blob;
    EXPECT_EQ(copy.bytes().data(), blob.bytes().data());
  }
  EXPECT_EQ(copy.size(), 49u);
  EXPECT_EQ(copy.Hash(), HashBytes(copy.bytes()));
  EXPECT_EQ(Blob().size(), 0u);
}

TEST(Blob, OfAShortStringOutlivesIt) {
  Blob blob;
  {
    std::string text = "abc";
    blob = Blob::FromString(std::move(text));
  }
  EXPECT_EQ(blob.Hash().Hex().substr(0, 8), "ba7816bf");
}

TEST(Blob, IsAlignedForVectors) {
  for (const size_t size : {1, 15, 16, 17, 1000}) {
    const Blob from_vector = Blob::FromVector(std::vector<std::byte>(size));
    EXPECT_EQ(reinterpret_cast<uintptr_t>(from_vector.bytes().data()) % 16, 0u) << size;
    const Blob from_string = Blob::FromString(std::string(size, 'x'));
    EXPECT_EQ(reinterpret_cast<uintptr_t>(from_string.bytes().data()) % 16, 0u) << size;
  }
}

TEST_F(BlobFile, WriteMapAndReadAgree) {
  const std::string text(100001, 'q');
  ASSERT_TRUE(WriteFileAtomically(Path("f"), Bytes(text)).ok());
  EXPECT_FALSE(fs::exists(Path("f.part")));
  const absl::StatusOr<Blob> mapped = Blob::MapFile(Path("f"));
  ASSERT_TRUE(mapped.ok()) << mapped.status();
  EXPECT_EQ(Text(*mapped), text);
  const absl::StatusOr<Blob> read = ReadFile(Path("f"));
  ASSERT_TRUE(read.ok()) << read.status();
  EXPECT_EQ(Text(*read), text);
}

TEST_F(BlobFile, EmptyFilesAreEmptyBlobs) {
  ASSERT_TRUE(WriteFileAtomically(Path("empty"), {}).ok());
  EXPECT_EQ(Blob::MapFile(Path("empty"))->size(), 0u);
  EXPECT_EQ(ReadFile(Path("empty"))->size(), 0u);
}

TEST_F(BlobFile, AMappingSurvivesTheReplacementOfItsFile) {
  ASSERT_TRUE(WriteFileAtomically(Path("f"), Bytes("old content")).ok());
  const absl::StatusOr<Blob> old = Blob::MapFile(Path("f"));
  ASSERT_TRUE(WriteFileAtomically(Path("f"), Bytes("new")).ok());
  EXPECT_EQ(Text(*old), "old content");
  EXPECT_EQ(Text(*Blob::MapFile(Path("f"))), "new");
}

TEST_F(BlobFile, ErrorsNameThePath) {
  const absl::Status missing = Blob::MapFile(Path("none")).status();
  EXPECT_EQ(missing.code(), absl::StatusCode::kNotFound);
  EXPECT_NE(missing.message().find(Path("none")), absl::string_view::npos);
  EXPECT_EQ(ReadFile(Path("none")).status().code(), absl::StatusCode::kNotFound);
  EXPECT_EQ(Blob::MapFile(folder_).status().code(), absl::StatusCode::kInvalidArgument);
  const absl::Status unwritable = WriteFileAtomically(Path("no/such/folder"), Bytes("x"));
  EXPECT_EQ(unwritable.code(), absl::StatusCode::kNotFound);
  EXPECT_NE(unwritable.message().find(Path("no/such/folder")), absl::string_view::npos);
}

TEST_F(BlobFile, AFailedReplacementLeavesNoRestAndTheTargetAsItWas) {
  fs::create_directory(Path("target"));
  std::ofstream(Path("target") + "/inside") << "x";
  EXPECT_FALSE(WriteFileAtomically(Path("target"), Bytes("x")).ok());
  EXPECT_TRUE(fs::exists(Path("target") + "/inside"));
  EXPECT_FALSE(fs::exists(Path("target.part")));
}

TEST_F(BlobFile, ReadFileRefusesWhatIsTooLarge) {
  ASSERT_TRUE(WriteFileAtomically(Path("f"), Bytes("12345")).ok());
  EXPECT_TRUE(ReadFile(Path("f"), 5).ok());
  EXPECT_EQ(ReadFile(Path("f"), 4).status().code(), absl::StatusCode::kResourceExhausted);
}

}  // namespace
}  // namespace farpoint

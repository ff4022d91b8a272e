#include "core/base/posix_file.h"

#include <fcntl.h>
#include <gtest/gtest.h>
#include <unistd.h>

#include <cerrno>
#include <cstdio>
#include <fstream>
#include <iterator>

namespace farpoint {
namespace {

std::span<const std::byte> BytesOf(std::string_view text) {
  return std::as_bytes(std::span(text.data(), text.size()));
}

TEST(PosixFile, ErrorsNameThePathAndWhetherToTryAgain) {
  const absl::Status missing = FileError("cannot open", "/a/b", ENOENT);
  EXPECT_TRUE(absl::IsNotFound(missing));
  EXPECT_EQ(missing.message(), "cannot open '/a/b': No such file or directory");
  EXPECT_TRUE(absl::IsPermissionDenied(FileError("cannot open", "x", EACCES)));
  EXPECT_TRUE(absl::IsUnavailable(FileError("cannot open", "x", ENOSPC)));
  EXPECT_TRUE(absl::IsUnavailable(FileError("cannot open", "x", EIO)));
  EXPECT_TRUE(absl::IsUnavailable(DiskError("cannot write", "x", ENOENT)));
  EXPECT_TRUE(absl::IsUnavailable(DiskError("cannot write", "x", EDQUOT)));
}

TEST(PosixFile, WritesInOrderAndAtOffsets) {
  const std::string path = ::testing::TempDir() + "posix_file_" + std::to_string(::getpid());
  {
    const Descriptor file(::open(path.c_str(), O_RDWR | O_CREAT | O_TRUNC | O_CLOEXEC, 0600));
    ASSERT_TRUE(file.valid());
    ASSERT_TRUE(WriteAll(file.get(), BytesOf("abc"), path).ok());
    ASSERT_TRUE(WriteAll(file.get(), BytesOf("def"), path).ok());
    ASSERT_TRUE(WriteAllAt(file.get(), 1, BytesOf("XY"), path).ok());
  }
  std::ifstream in(path);
  EXPECT_EQ(std::string(std::istreambuf_iterator<char>(in), {}), "aXYdef");
  const Descriptor readonly(::open(path.c_str(), O_RDONLY | O_CLOEXEC));
  const absl::Status refused = WriteAll(readonly.get(), BytesOf("x"), path);
  EXPECT_TRUE(absl::IsUnavailable(refused));
  EXPECT_NE(refused.message().find(path), absl::string_view::npos);
  std::remove(path.c_str());
}

TEST(PosixFile, ADescriptorClosesWhatItHolds) {
  const int fd = ::open("/dev/null", O_RDONLY | O_CLOEXEC);
  {
    Descriptor a(fd);
    Descriptor b(std::move(a));
    EXPECT_FALSE(a.valid());
    EXPECT_EQ(b.get(), fd);
  }
  EXPECT_EQ(::fcntl(fd, F_GETFD), -1);
}

}  // namespace
}  // namespace farpoint

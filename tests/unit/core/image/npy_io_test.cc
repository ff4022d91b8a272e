#include "core/image/npy_io.h"

#include <gtest/gtest.h>

#include <cstring>
#include <random>
#include <string>

#include "tests/unit/core/image/image_testing.h"

namespace farpoint {
namespace {

// A .npy file of format version 1 or 2.
std::string Npy(const std::string& dict, const std::string& payload, int version = 1) {
  std::string header = dict;
  const size_t prefix = version == 1 ? 10 : 12;
  while ((prefix + header.size() + 1) % 64 != 0) header += ' ';
  header += '\n';
  std::string file = "\x93NUMPY";
  file += static_cast<char>(version);
  file += '\0';
  for (size_t i = 8; i < prefix; ++i) {
    file += static_cast<char>(header.size() >> (8 * (i - 8)) & 255);
  }
  return file + header + payload;
}

std::string Dict(const std::string& descr, const std::string& shape) {
  return "{'descr': '" + descr + "', 'fortran_order': False, 'shape': " + shape + ", }";
}

template <typename T>
std::string Raw(std::vector<T> values) {
  return {reinterpret_cast<const char*>(values.data()), values.size() * sizeof(T)};
}

class NpyIo : public ImageFiles {
 protected:
  absl::StatusOr<NpyArray2d> Read(const std::string& file) const {
    WriteRaw("a.npy", file);
    return ReadNpy2d(Path("a.npy"));
  }
};

TEST_F(NpyIo, ReadsEachTypeRowByRow) {
  const std::vector<double> expected = {1, 0, 0, 0, 1, 1};
  const struct {
    const char* descr;
    std::string payload;
  } cases[] = {{"|b1", Raw<uint8_t>({1, 0, 0, 0, 1, 1})},
               {"|u1", Raw<uint8_t>({1, 0, 0, 0, 1, 1})},
               {"<f4", Raw<float>({1, 0, 0, 0, 1, 1})},
               {"<f8", Raw<double>({1, 0, 0, 0, 1, 1})}};
  for (const auto& c : cases) {
    for (const int version : {1, 2}) {
      const absl::StatusOr<NpyArray2d> array =
          Read(Npy(Dict(c.descr, "(2, 3)"), c.payload, version));
      ASSERT_TRUE(array.ok()) << array.status();
      EXPECT_EQ(array->rows, 2);
      EXPECT_EQ(array->cols, 3);
      EXPECT_EQ(array->values, expected) << c.descr;
    }
  }
}

TEST_F(NpyIo, KeysMayComeInAnyOrder) {
  EXPECT_TRUE(Read(Npy("{\"shape\":(1,1),'fortran_order':False,'descr':'|u1'}", "x")).ok());
}

TEST_F(NpyIo, RefusesWhatItDoesNotRead) {
  const std::string four(4, 'x');
  for (const std::string& file :
       {Npy(Dict(">f4", "(1, 1)"), four), Npy(Dict("<i4", "(1, 1)"), four),
        Npy(Dict("|O", "(1, 1)"), four), Npy(Dict("|u1", "(4,)"), four),
        Npy(Dict("|u1", "(1, 2, 2)"), four), Npy(Dict("|u1", "()"), four),
        Npy(Dict("|u1", "(0, 4)"), ""), Npy(Dict("|u1", "(65537, 1)"), std::string(65537, 'x')),
        Npy("{'descr': '|u1', 'fortran_order': True, 'shape': (2, 2), }", four),
        Npy(Dict("|u1", "(2, 2)"), four, 4)}) {
    const absl::Status status = Read(file).status();
    EXPECT_EQ(status.code(), absl::StatusCode::kInvalidArgument) << status;
    EXPECT_NE(status.message().find("a.npy"), absl::string_view::npos);
  }
}

TEST_F(NpyIo, RefusesDamagedHeadersAndLengths) {
  const std::string four(4, 'x');
  for (const std::string& file :
       {Npy(Dict("|u1", "(2, 2)"), four + "x"), Npy(Dict("|u1", "(2, 2)"), "xxx"),
        Npy(Dict("|u1", "(65536, 65536)"), four), Npy(Dict("<f8", "(65536, 65536)"), four),
        Npy(Dict("|u1", "(99999999999999999999, 1)"), four), Npy(Dict("|u1", "(-1, -4)"), four),
        Npy("{'descr': '|u1', 'shape': (2, 2)}", four),
        Npy("{'descr': '|u1', 'descr': '|u1', 'fortran_order': False, 'shape': (2, 2)}", four),
        Npy("{'descr': '|u1', 'fortran_order': False, 'shape': (2, 2), 'more': 'x'}", four),
        Npy("{'descr': '|u1', 'fortran_order': False, 'shape': (2, 2)} trailing", four),
        Npy("os.system('x')", four), Npy("", four)}) {
    EXPECT_EQ(Read(file).status().code(), absl::StatusCode::kDataLoss) << file;
  }
}

TEST_F(NpyIo, EveryTruncationIsRefused) {
  const std::string file = Npy(Dict("<f4", "(2, 3)"), Raw<float>({1, 2, 3, 4, 5, 6}));
  ASSERT_TRUE(Read(file).ok());
  for (size_t size = 0; size < file.size(); ++size) {
    EXPECT_FALSE(Read(file.substr(0, size)).ok()) << size;
  }
}

TEST_F(NpyIo, RandomDamageNeverReadsOutside) {
  const std::string good = Npy(Dict("|u1", "(2, 3)"), "abcdef");
  std::mt19937 random(3);
  for (int i = 0; i < 3000; ++i) {
    std::string file = good;
    for (int k = 0; k < 2; ++k) file[random() % file.size()] = static_cast<char>(random());
    const absl::StatusOr<NpyArray2d> array = Read(file);
    if (array.ok()) {
      ASSERT_EQ(array->values.size(), static_cast<size_t>(array->rows) * array->cols);
    }
  }
}

}  // namespace
}  // namespace farpoint

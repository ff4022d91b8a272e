#include "core/base/byte_io.h"

#include <gtest/gtest.h>

#include <cstdint>
#include <random>
#include <string>
#include <vector>

#include "core/base/blob.h"

namespace farpoint {
namespace {

struct Record {
  uint16_t number = 0;
  std::string name;
  std::vector<double> values;
  std::vector<uint8_t> tail;
  bool operator==(const Record&) const = default;
};

std::vector<std::byte> Encode(const Record& r) {
  ByteWriter writer;
  writer.Put(r.number);
  writer.PutString(r.name);
  writer.PutArray<double>(r.values);
  writer.PutArray<uint8_t>(r.tail);
  return writer.Take();
}

absl::StatusOr<Record> Decode(std::span<const std::byte> bytes) {
  ByteReader reader(bytes);
  Record r;
  FP_RETURN_IF_ERROR(reader.Get(r.number, "number"));
  FP_RETURN_IF_ERROR(reader.GetString(r.name, "name"));
  std::span<const double> values;
  FP_RETURN_IF_ERROR(reader.GetArray(values, "values"));
  r.values.assign(values.begin(), values.end());
  std::span<const uint8_t> tail;
  FP_RETURN_IF_ERROR(reader.GetArray(tail, "tail"));
  r.tail.assign(tail.begin(), tail.end());
  FP_RETURN_IF_ERROR(reader.ExpectEnd());
  return r;
}

const Record kRecord = {513, "a name", {1.5, -2.25, 1e300}, {1, 2, 3, 4, 5}};

TEST(ByteIo, RoundTrips) {
  for (const Record& r : {kRecord, Record{}, Record{1, "", {}, {9}}}) {
    const Blob blob = Blob::FromVector(Encode(r));
    const absl::StatusOr<Record> back = Decode(blob.bytes());
    ASSERT_TRUE(back.ok()) << back.status();
    EXPECT_EQ(*back, r);
  }
}

TEST(ByteIo, ArraysStartAtMultiplesOfSixteen) {
  const Blob blob = Blob::FromVector(Encode(kRecord));
  ByteReader reader(blob.bytes());
  uint16_t number;
  std::string name;
  std::span<const double> values;
  ASSERT_TRUE(reader.Get(number, "").ok());
  ASSERT_TRUE(reader.GetString(name, "").ok());
  ASSERT_TRUE(reader.GetArray(values, "").ok());
  const auto offset = reinterpret_cast<const std::byte*>(values.data()) - blob.bytes().data();
  EXPECT_EQ(offset % 16, 0);
  EXPECT_EQ(number, 513);
  EXPECT_EQ(blob.bytes()[0], std::byte{1});  // little-endian
  EXPECT_EQ(blob.bytes()[1], std::byte{2});
}

TEST(ByteIo, EveryTruncationIsRefused) {
  const std::vector<std::byte> bytes = Encode(kRecord);
  for (size_t size = 0; size < bytes.size(); ++size) {
    // A copy of its own, so that a sanitizer sees a read beyond the end.
    const Blob cut = Blob::FromVector({bytes.begin(), bytes.begin() + size});
    EXPECT_EQ(Decode(cut.bytes()).status().code(), absl::StatusCode::kDataLoss) << size;
  }
}

TEST(ByteIo, WhatFollowsTheEndIsRefused) {
  std::vector<std::byte> bytes = Encode(kRecord);
  bytes.push_back(std::byte{0});
  const absl::Status status = Decode(Blob::FromVector(bytes).bytes()).status();
  EXPECT_EQ(status.code(), absl::StatusCode::kDataLoss);
  EXPECT_NE(status.message().find("1 bytes follow"), absl::string_view::npos);
}

TEST(ByteIo, TheErrorNamesFieldAndOffset) {
  const std::vector<std::byte> bytes = Encode(kRecord);
  const Blob cut = Blob::FromVector({bytes.begin(), bytes.begin() + 4});
  const absl::Status status = Decode(cut.bytes()).status();
  EXPECT_NE(status.message().find("'name' at byte 2"), absl::string_view::npos) << status;
}

TEST(ByteIo, AnnouncedSizesThatOverflowAreRefused) {
  for (const uint64_t count :
       {UINT64_MAX, UINT64_MAX / 8 + 1, uint64_t{1} << 61, uint64_t{1} << 32, uint64_t{3}}) {
    ByteWriter writer;
    writer.Put(count);
    writer.Put<uint64_t>(0);
    writer.Put<double>(1.0);
    writer.Put<double>(2.0);
    const Blob blob = Blob::FromVector(writer.Take());
    ByteReader reader(blob.bytes());
    std::span<const double> values;
    EXPECT_EQ(reader.GetArray(values, "values").code(), absl::StatusCode::kDataLoss) << count;
  }
}

TEST(ByteIo, StringsHaveALimit) {
  ByteWriter writer;
  writer.PutString(std::string(100, 'x'));
  const Blob blob = Blob::FromVector(writer.Take());
  std::string text;
  EXPECT_TRUE(ByteReader(blob.bytes()).GetString(text, "text", 100).ok());
  EXPECT_FALSE(ByteReader(blob.bytes()).GetString(text, "text", 99).ok());
}

TEST(ByteIo, RandomDamageNeverReadsOutside) {
  const std::vector<std::byte> bytes = Encode(kRecord);
  std::mt19937 random(1);
  int accepted = 0;
  for (int i = 0; i < 20000; ++i) {
    std::vector<std::byte> damaged = bytes;
    for (int k = 0; k < 3; ++k) {
      damaged[random() % damaged.size()] = static_cast<std::byte>(random());
    }
    damaged.resize(random() % (damaged.size() + 1));
    const Blob blob = Blob::FromVector(std::move(damaged));
    accepted += Decode(blob.bytes()).ok();
  }
  EXPECT_LT(accepted, 20000);
}

}  // namespace
}  // namespace farpoint

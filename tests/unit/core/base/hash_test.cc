#include "core/base/hash.h"

#include <gtest/gtest.h>

#include <string>

namespace farpoint {
namespace {

Digest HashText(std::string_view text) { return Sha256().Update(text).Finish(); }

// FIPS 180-4 examples (NIST, "SHA256.pdf") and the long message of RFC 6234.
TEST(Hash, MatchesPublishedVectors) {
  EXPECT_EQ(HashText("").Hex(), "e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855");
  EXPECT_EQ(HashText("abc").Hex(),
            "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad");
  EXPECT_EQ(HashText("abcdbcdecdefdefgefghfghighijhijkijkljklmklmnlmnomnopnopq").Hex(),
            "248d6a61d20638b8e5c026930c3e6039a33ce45964ff2167f6ecedd419db06c1");
  EXPECT_EQ(HashText(std::string(1000000, 'a')).Hex(),
            "cdc76e5c9914fb9281a1c7e284d73e67f1809a48a497200e046d39ccc7112cd0");
}

TEST(Hash, IsIndependentOfHowTheDataIsSplit) {
  std::string data;
  for (int i = 0; i < 1000; ++i) data.push_back(static_cast<char>(i * 37));
  const Digest whole = HashBytes(std::as_bytes(std::span(data.data(), data.size())));
  for (size_t cut = 0; cut <= data.size(); cut += 61) {
    const std::string_view view(data);
    EXPECT_EQ(Sha256().Update(view.substr(0, cut)).Update(view.substr(cut)).Finish(), whole) << cut;
  }
}

TEST(Hash, IntegersAreLittleEndianAndOfFixedWidth) {
  EXPECT_EQ(Sha256().UpdateU32(0x04030201u).Finish(), HashText("\x01\x02\x03\x04"));
  EXPECT_EQ(Sha256().UpdateU64(0x0807060504030201ull).Finish(),
            HashText("\x01\x02\x03\x04\x05\x06\x07\x08"));
}

TEST(Digest, HexRoundTrips) {
  const Digest digest = HashText("abc");
  const absl::StatusOr<Digest> back = Digest::FromHex(digest.Hex());
  ASSERT_TRUE(back.ok()) << back.status();
  EXPECT_EQ(*back, digest);
  EXPECT_FALSE(digest.empty());
  EXPECT_TRUE(Digest{}.empty());
}

TEST(Digest, UpperCaseHexIsRead) {
  std::string text = HashText("abc").Hex();
  for (char& c : text) c = static_cast<char>(std::toupper(static_cast<unsigned char>(c)));
  const absl::StatusOr<Digest> digest = Digest::FromHex(text);
  ASSERT_TRUE(digest.ok());
  EXPECT_EQ(*digest, HashText("abc"));
}

TEST(Digest, WrongHexIsRefused) {
  const std::string good = HashText("abc").Hex();
  std::string no_digit = good, zero = good;
  no_digit[0] = 'g';
  zero[63] = '\0';
  for (const std::string& bad : {std::string(), good.substr(1), good + '0', no_digit, zero}) {
    EXPECT_EQ(Digest::FromHex(bad).status().code(), absl::StatusCode::kInvalidArgument) << bad;
  }
}

}  // namespace
}  // namespace farpoint

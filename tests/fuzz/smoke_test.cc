// A smoke run of the fuzzers that needs no libFuzzer: each target on its seeds and on bytes that
// were changed by a fixed recipe. `./dev fuzz` looks further.
#include <gtest/gtest.h>

#include <cstring>
#include <string>

#include "core/math/sampling.h"
#include "tests/fuzz/fuzz_target.h"

namespace farpoint {
namespace {

// Enough to reach each kind of change at each kind of field of a small seed.
constexpr uint64_t kChanges = 10000;
constexpr size_t kMaxBytes = 1 << 16;

class Random {
 public:
  explicit Random(uint64_t key) : key_(key) {}
  uint64_t Next() { return HashKey(key_, ++count_); }
  size_t Below(size_t n) { return n == 0 ? 0 : Next() % n; }

 private:
  uint64_t key_, count_ = 0;
};

// One to four changes: bits, bytes, numbers of the kind that sizes and floats are, runs taken out,
// doubled, cut off, or from the other seed.
FuzzBytes Changed(FuzzBytes bytes, const FuzzBytes& other, uint64_t key) {
  Random random(key);
  const size_t changes = 1 + random.Below(4);
  for (size_t c = 0; c < changes && !bytes.empty(); ++c) {
    const size_t at = random.Below(bytes.size());
    const size_t run = std::min(bytes.size() - at, 1 + random.Below(64));
    switch (random.Below(8)) {
      case 0:
        bytes[at] ^= static_cast<std::byte>(1u << random.Below(8));
        break;
      case 1:
        bytes[at] = static_cast<std::byte>(random.Next());
        break;
      case 2: {
        constexpr uint64_t kNumbers[] = {
            0,          1,          0xff,       0x7fffffff,        0x80000000,
            0xffffffff, 0x7f800000, 0x7fc00000, 0xff7fffff,        0x10000,
            ~0ull,      1ull << 63, 1ull << 32, 0x7ff0000000000000};
        const uint64_t number = kNumbers[random.Below(std::size(kNumbers))];
        const size_t width = size_t{1} << random.Below(4);
        const size_t aligned = at / width * width;
        std::memcpy(bytes.data() + aligned, &number, std::min(width, bytes.size() - aligned));
        break;
      }
      case 3:
        bytes.resize(at);
        break;
      case 4:
        bytes.erase(bytes.begin() + static_cast<ptrdiff_t>(at),
                    bytes.begin() + static_cast<ptrdiff_t>(at + run));
        break;
      case 5: {
        const FuzzBytes copy(bytes.begin() + static_cast<ptrdiff_t>(at),
                             bytes.begin() + static_cast<ptrdiff_t>(at + run));
        bytes.insert(bytes.begin() + static_cast<ptrdiff_t>(random.Below(bytes.size())),
                     copy.begin(), copy.end());
        break;
      }
      case 6: {  // a digit of a text
        constexpr std::string_view kText = "0123456789-+.eE\"[]{},:/ \n#%naif";
        bytes[at] = static_cast<std::byte>(kText[random.Below(kText.size())]);
        break;
      }
      default: {
        if (other.empty()) break;
        const size_t from = random.Below(other.size());
        const size_t length = std::min(run, other.size() - from);
        const size_t room = std::min(length, bytes.size() - at);
        std::copy_n(other.begin() + static_cast<ptrdiff_t>(from), room,
                    bytes.begin() + static_cast<ptrdiff_t>(at));
      }
    }
  }
  if (bytes.size() > kMaxBytes) bytes.resize(kMaxBytes);
  return bytes;
}

std::vector<FuzzTarget> Targets() {
  std::vector<FuzzTarget> targets(CoreFuzzTargets().begin(), CoreFuzzTargets().end());
#ifdef FARPOINT_FUZZ_WIRE
  targets.insert(targets.end(), WireFuzzTargets().begin(), WireFuzzTargets().end());
#endif
  return targets;
}

class FuzzSmoke : public testing::TestWithParam<FuzzTarget> {};

TEST_P(FuzzSmoke, SeedsAreAcceptedAndChangedBytesAreSurvived) {
  const FuzzTarget& target = GetParam();
  const std::vector<FuzzBytes> seeds = target.seeds();
  ASSERT_FALSE(seeds.empty());
  for (size_t i = 0; i < seeds.size(); ++i) {
    EXPECT_FALSE(seeds[i].empty());
    EXPECT_TRUE(target.run(seeds[i])) << "seed " << i;
  }
  target.run({});
  uint64_t refused = 0;
  for (uint64_t i = 0; i < kChanges; ++i) {
    const FuzzBytes& seed = seeds[i % seeds.size()];
    const FuzzBytes bytes =
        Changed(seed, seeds[(i + 1) % seeds.size()], HashKey(i, target.name.size()));
    refused += !target.run(bytes);
  }
  EXPECT_GT(refused, 0u);
}

INSTANTIATE_TEST_SUITE_P(Targets, FuzzSmoke, testing::ValuesIn(Targets()),
                         [](const auto& info) { return std::string(info.param.name); });

}  // namespace
}  // namespace farpoint

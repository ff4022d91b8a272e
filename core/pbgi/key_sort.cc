#include "core/pbgi/key_sort.h"

#include <algorithm>
#include <array>
#include <vector>

namespace farpoint {

namespace {

constexpr int kDigitBits = 11;
constexpr size_t kDigits = size_t{1} << kDigitBits;
constexpr size_t kPiece = size_t{1} << 17;
// Below this, histograms cost more than comparisons.
constexpr size_t kSmall = 4096;

}  // namespace

void SortByKey(BulkVector<KeyedIndex>& items, Executor& executor) {
  const size_t n = items.size();
  if (n <= kSmall) {
    std::stable_sort(items.begin(), items.end(),
                     [](const KeyedIndex& a, const KeyedIndex& b) { return a.key < b.key; });
    return;
  }
  const size_t pieces = (n + kPiece - 1) / kPiece;
  std::vector<uint64_t> differing_in(pieces);
  executor.ForEachPiece(n, kPiece, [&](size_t begin, size_t end) {
    uint64_t bits = 0;
    for (size_t i = begin; i < end; ++i) bits |= items[i].key ^ items[0].key;
    differing_in[begin / kPiece] = bits;
  });
  uint64_t differing = 0;
  for (const uint64_t bits : differing_in) differing |= bits;
  std::vector<std::array<uint32_t, kDigits>> first(pieces);
  BulkVector<KeyedIndex> sorted(n);
  for (int shift = 0; shift < 64; shift += kDigitBits) {
    const auto digit = [shift](uint64_t key) { return (key >> shift) & (kDigits - 1); };
    if (digit(differing) == 0) continue;
    executor.ForEachPiece(n, kPiece, [&](size_t begin, size_t end) {
      auto& count = first[begin / kPiece];
      count.fill(0);
      for (size_t i = begin; i < end; ++i) ++count[digit(items[i].key)];
    });
    // Where each piece puts its first item of each digit.
    uint32_t at = 0;
    for (size_t d = 0; d < kDigits; ++d) {
      for (auto& of_piece : first) {
        const uint32_t count = of_piece[d];
        of_piece[d] = at;
        at += count;
      }
    }
    executor.ForEachPiece(n, kPiece, [&](size_t begin, size_t end) {
      auto& next = first[begin / kPiece];
      for (size_t i = begin; i < end; ++i) sorted[next[digit(items[i].key)]++] = items[i];
    });
    items.swap(sorted);
  }
}

}  // namespace farpoint

#include "core/base/bulk_vector.h"

#include <sys/mman.h>

#include <cstdint>
#include <new>

namespace farpoint {

namespace {

constexpr size_t kHugePage = size_t{1} << 21;
constexpr size_t kAlignment = 64;
// From here on pages of its own.
constexpr size_t kLarge = 2 * kHugePage;

size_t RoundedUp(size_t bytes) { return (bytes + kHugePage - 1) / kHugePage * kHugePage; }

}  // namespace

void* AllocateBulk(size_t bytes) {
  if (bytes < kLarge) return ::operator new(bytes, std::align_val_t(kAlignment));
  if (bytes > SIZE_MAX / 2) throw std::bad_alloc();
  const size_t size = RoundedUp(bytes);
  // One more, of which what lies before the first and behind the last huge page goes back.
  void* const mapped =
      ::mmap(nullptr, size + kHugePage, PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS, -1, 0);
  if (mapped == MAP_FAILED) throw std::bad_alloc();
  const auto at = reinterpret_cast<uintptr_t>(mapped);
  const uintptr_t first = (at + kHugePage - 1) / kHugePage * kHugePage;
  if (first != at) ::munmap(mapped, first - at);
  const size_t behind = at + kHugePage - first;
  if (behind != 0) ::munmap(reinterpret_cast<void*>(first + size), behind);
  // A wish: without huge pages all works the same.
  ::madvise(reinterpret_cast<void*>(first), size, MADV_HUGEPAGE);
  return reinterpret_cast<void*>(first);
}

void FreeBulk(void* p, size_t bytes) noexcept {
  if (bytes < kLarge) {
    ::operator delete(p, std::align_val_t(kAlignment));
  } else {
    ::munmap(p, RoundedUp(bytes));
  }
}

}  // namespace farpoint

// Vectors for millions of elements that are filled in parallel.
//
// A large one has pages of its own, huge ones where the system gives them: it costs fewer page
// faults, and its memory goes back to the system when it is destroyed. Elements that are added
// without a value are not initialised: who resizes sets all of them.
#pragma once

#include <cstddef>
#include <type_traits>
#include <vector>

namespace farpoint {

// At a multiple of 64 bytes. Throws std::bad_alloc.
void* AllocateBulk(size_t bytes);
void FreeBulk(void* p, size_t bytes) noexcept;

template <typename T>
struct BulkAllocator {
  using value_type = T;
  static_assert(std::is_trivially_copyable_v<T> && std::is_trivially_destructible_v<T>);

  BulkAllocator() = default;
  template <typename U>
  BulkAllocator(const BulkAllocator<U>&) {}
  T* allocate(size_t n) { return static_cast<T*>(AllocateBulk(n * sizeof(T))); }
  void deallocate(T* p, size_t n) { FreeBulk(p, n * sizeof(T)); }
  template <typename U>
  void construct(U*) noexcept {}  // not initialised
  template <typename U, typename... Args>
  void construct(U* p, Args&&... args) {
    ::new (static_cast<void*>(p)) U(static_cast<Args&&>(args)...);
  }
  template <typename U>
  bool operator==(const BulkAllocator<U>&) const {
    return true;
  }
};

template <typename T>
using BulkVector = std::vector<T, BulkAllocator<T>>;

}  // namespace farpoint

// Vectors whose first element lies at a multiple of 64 bytes: a cache line, and more than any SIMD
// load of ours asks for.
#pragma once

#include <cstddef>
#include <new>
#include <vector>

namespace farpoint {

inline constexpr size_t kBlobAlignment = 64;

template <typename T>
struct AlignedAllocator {
  using value_type = T;
  AlignedAllocator() = default;
  template <typename U>
  AlignedAllocator(const AlignedAllocator<U>&) {}
  T* allocate(size_t n) {
    return static_cast<T*>(::operator new(n * sizeof(T), std::align_val_t(kBlobAlignment)));
  }
  void deallocate(T* p, size_t) { ::operator delete(p, std::align_val_t(kBlobAlignment)); }
  template <typename U>
  bool operator==(const AlignedAllocator<U>&) const {
    return true;
  }
};

template <typename T>
using AlignedVector = std::vector<T, AlignedAllocator<T>>;

}  // namespace farpoint

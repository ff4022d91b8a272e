// What bakes leave for later ones: products of single stages, by the digest of all that decides
// them. Never more than a limit in bytes; the least recently used goes first. Thread-safe.
#pragma once

#include <cstdint>
#include <list>
#include <memory>
#include <mutex>
#include <unordered_map>

#include "core/base/hash.h"

namespace farpoint {

class BakeCache {
 public:
  explicit BakeCache(uint64_t max_bytes) : max_bytes_(max_bytes) {}
  BakeCache(const BakeCache&) = delete;
  BakeCache& operator=(const BakeCache&) = delete;

  // The product, or null. T must be the type that was put under this key: the digest of a key
  // covers the name of the stage.
  template <typename T>
  std::shared_ptr<const T> Find(const Digest& key) {
    return std::static_pointer_cast<const T>(FindAny(key));
  }
  // Keeps `value`, which holds `bytes`. One larger than the limit is not kept. A key that is there
  // keeps its value: equal keys have equal products.
  template <typename T>
  void Put(const Digest& key, std::shared_ptr<const T> value, uint64_t bytes) {
    PutAny(key, std::move(value), bytes);
  }

  uint64_t max_bytes() const { return max_bytes_; }
  uint64_t size_bytes() const;

 private:
  struct Entry {
    Digest key;
    std::shared_ptr<const void> value;
    uint64_t bytes;
  };
  std::shared_ptr<const void> FindAny(const Digest& key);
  void PutAny(const Digest& key, std::shared_ptr<const void> value, uint64_t bytes);

  const uint64_t max_bytes_;
  mutable std::mutex mutex_;
  std::list<Entry> entries_;  // guarded by mutex_; the last used first
  std::unordered_map<Digest, std::list<Entry>::iterator, DigestHasher> by_key_;  // the same
  uint64_t size_bytes_ = 0;                                                      // the same
};

}  // namespace farpoint

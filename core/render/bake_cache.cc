#include "core/render/bake_cache.h"

#include <utility>

namespace farpoint {

std::shared_ptr<const void> BakeCache::FindAny(const Digest& key) {
  const std::lock_guard lock(mutex_);
  const auto it = by_key_.find(key);
  if (it == by_key_.end()) return nullptr;
  entries_.splice(entries_.begin(), entries_, it->second);
  return it->second->value;
}

void BakeCache::PutAny(const Digest& key, std::shared_ptr<const void> value, uint64_t bytes) {
  if (bytes > max_bytes_) return;
  // What is dropped is destroyed after the lock is released.
  std::list<Entry> dropped;
  const std::lock_guard lock(mutex_);
  if (const auto it = by_key_.find(key); it != by_key_.end()) {
    entries_.splice(entries_.begin(), entries_, it->second);
    return;
  }
  while (size_bytes_ + bytes > max_bytes_) {
    const auto last = std::prev(entries_.end());
    size_bytes_ -= last->bytes;
    by_key_.erase(last->key);
    dropped.splice(dropped.begin(), entries_, last);
  }
  entries_.push_front({key, std::move(value), bytes});
  by_key_.emplace(key, entries_.begin());
  size_bytes_ += bytes;
}

uint64_t BakeCache::size_bytes() const {
  const std::lock_guard lock(mutex_);
  return size_bytes_;
}

}  // namespace farpoint

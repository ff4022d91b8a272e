// Who runs loops in parallel. Kernels get an Executor passed in and never start threads.
//
// Determinism: ForEach says nothing about the order in which indices run, so a body may write only
// to what belongs to its index; sums over indices are made afterwards, in index order.
//
// After each piece there is a Pulse (core/base/pulse.h).
#pragma once

#include <cstddef>
#include <functional>
#include <memory>

namespace farpoint {

class Executor {
 public:
  // `threads` >= 1; 0 means all cores that this process may use. At most as many run as there are
  // cores.
  explicit Executor(unsigned threads);
  ~Executor();
  Executor(const Executor&) = delete;
  Executor& operator=(const Executor&) = delete;

  unsigned threads() const { return threads_; }

  // Calls body(i) once for each i in [0, count), on up to threads() threads; returns when all are
  // done. Work is stolen in pieces of at least `grain` indices. The body must not throw.
  void ForEach(size_t count, size_t grain, const std::function<void(size_t)>& body);

  // Splits [0, count) into pieces of exactly `piece` indices (the last may be shorter) and calls
  // body(begin, end) once for each. Piece borders depend on `piece` only, never on threads().
  void ForEachPiece(size_t count, size_t piece,
                    const std::function<void(size_t begin, size_t end)>& body);

 private:
  struct Impl;
  unsigned threads_;
  std::unique_ptr<Impl> impl_;
};

}  // namespace farpoint

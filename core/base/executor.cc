#include "core/base/executor.h"

#include <sched.h>
#include <tbb/blocked_range.h>
#include <tbb/parallel_for.h>
#include <tbb/task_arena.h>

#include <algorithm>

#include "core/base/fp_trap.h"
#include "core/base/pulse.h"

#ifdef __SANITIZE_THREAD__
extern "C" void __tsan_acquire(void* address);
extern "C" void __tsan_release(void* address);
#endif

namespace farpoint {

namespace {

// What the thread sanitizer cannot see, as oneTBB is built without it: a loop begins after what was
// done before it, and ends after all of its bodies.
class LoopOrder {
 public:
  void Begins() { Release(&begin_); }
  void BodyBegins() { Acquire(&begin_); }
  void BodyEnds() { Release(&end_); }
  void Ends() { Acquire(&end_); }

 private:
#ifdef __SANITIZE_THREAD__
  static void Acquire(void* at) { __tsan_acquire(at); }
  static void Release(void* at) { __tsan_release(at); }
#else
  static void Acquire(void*) {}
  static void Release(void*) {}
#endif
  char begin_ = 0, end_ = 0;
};

unsigned UsableCores() {
  cpu_set_t set;
  CPU_ZERO(&set);
  if (::sched_getaffinity(0, sizeof(set), &set) != 0) return 1;
  return static_cast<unsigned>(std::max(1, CPU_COUNT(&set)));
}

}  // namespace

struct Executor::Impl {
  // More threads than cores would only wait for each other, and oneTBB grants none (it says so on
  // stderr).
  explicit Impl(unsigned threads) : arena(static_cast<int>(std::min(threads, UsableCores()))) {}
  tbb::task_arena arena;
};

Executor::Executor(unsigned threads)
    : threads_(threads == 0 ? UsableCores() : threads), impl_(std::make_unique<Impl>(threads_)) {}

Executor::~Executor() = default;

void Executor::ForEach(size_t count, size_t grain, const std::function<void(size_t)>& body) {
  if (count == 0) return;
  if (threads_ == 1) {
    const FpTrap trap;
    grain = std::max<size_t>(1, grain);
    for (size_t begin = 0; begin < count; begin += grain) {
      const size_t end = begin + std::min(grain, count - begin);
      for (size_t i = begin; i < end; ++i) body(i);
      Pulse();
    }
    return;
  }
  LoopOrder order;
  order.Begins();
  impl_->arena.execute([&] {
    tbb::parallel_for(tbb::blocked_range<size_t>(0, count, std::max<size_t>(1, grain)),
                      [&](const tbb::blocked_range<size_t>& range) {
                        const FpTrap trap;
                        order.BodyBegins();
                        for (size_t i = range.begin(); i != range.end(); ++i) body(i);
                        order.BodyEnds();
                        Pulse();
                      });
  });
  order.Ends();
}

void Executor::ForEachPiece(size_t count, size_t piece,
                            const std::function<void(size_t begin, size_t end)>& body) {
  piece = std::max<size_t>(1, piece);
  const size_t pieces = (count + piece - 1) / piece;
  ForEach(pieces, 1, [&](size_t i) { body(i * piece, std::min(count, (i + 1) * piece)); });
}

}  // namespace farpoint
